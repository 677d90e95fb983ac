//! import, export, info and check as a script sees them.

mod common;

use std::{fs, path::Path, process};

use common::{HEADER, TinyDataset, jpeg, names, omniloc, run};

#[test]
fn the_same_data_set_gives_the_same_bytes() {
    let dataset = TinyDataset::new();
    let (first, second) = (dataset.import("a.mcap"), dataset.import("b.mcap"));
    assert!(fs::read(first).expect("readable") == fs::read(second).expect("readable"));
}

#[test]
fn import_export_import_changes_nothing() {
    let dataset = TinyDataset::new();
    let first = dataset.path("first.mcap");
    omniloc()
        .arg("import")
        .arg(dataset.folder())
        .arg("--out")
        .arg(&first)
        .args(["--origin", "-33.9,151.2,12.5"])
        .assert()
        .success();
    let exported = dataset.path("another name");
    omniloc().arg("export").arg(&first).args(["--to", "dataset", "--out"]).arg(&exported).assert().success();
    let second = dataset.path("second.mcap");
    omniloc().arg("import").arg(&exported).arg("--out").arg(&second).assert().success();
    assert!(fs::read(&first).expect("readable") == fs::read(&second).expect("readable"), "recordings differ");

    for name in names(&dataset.folder().join("images")) {
        let [before, after] =
            [dataset.folder(), exported.clone()].map(|folder| fs::read(folder.join("images").join(&name)));
        assert!(before.expect("readable") == after.expect("readable"), "{name}");
    }
    let rows = |folder: &Path| {
        let text = fs::read_to_string(folder.join("positions.csv")).expect("readable");
        let parsed = |field: &str| field.parse::<f64>().map_err(|_| field.to_owned());
        text.lines().map(|line| line.split(',').map(parsed).collect()).collect::<Vec<Vec<_>>>()
    };
    assert_eq!(
        rows(&exported),
        rows(&dataset.folder()),
        "numbers are equal as f64 (protobuf knows no -0), text as it was"
    );
    assert_eq!(
        fs::read(exported.join("donut.json")).expect("readable"),
        fs::read(dataset.folder().join("donut.json")).expect("readable")
    );
}

#[test]
fn bad_data_sets_are_refused_and_leave_nothing() {
    type Spoil = fn(&TinyDataset);
    let table: [(&str, Spoil, &[&str]); 20] = [
        (
            "missing column",
            |d| d.write("positions.csv", b"index,file,x_m,y_m,yaw_rad\n"),
            &["positions.csv, line 1", "missing time_s"],
        ),
        ("extra column", |d| d.write("positions.csv", format!("{HEADER},z_m\n").as_bytes()), &["unexpected z_m"]),
        ("NaN", |d| d.write_rows(&["0,0000.jpg,NaN,0,,"]), &["positions.csv, line 2, field `x_m`", "finite", "`NaN`"]),
        ("infinite", |d| d.write_rows(&["0,0000.jpg,0,inf,,"]), &["line 2, field `y_m`", "`inf`"]),
        ("text", |d| d.write_rows(&["0,0000.jpg,0,0,,noon"]), &["line 2, field `time_s`", "`noon`"]),
        (
            "duplicate index",
            |d| d.write_rows(&["4,0000.jpg,0,0,,", "4,0001.jpg,0,0,,"]),
            &["line 3, field `index`", "line 2 has it"],
        ),
        (
            "duplicate file",
            |d| d.write_rows(&["4,0000.jpg,0,0,,", "5,images/0000.jpg,0,0,,"]),
            &["line 3, field `file`"],
        ),
        (
            "escaping path",
            |d| d.write_rows(&["0,../donut.json,0,0,,"]),
            &["field `file`", "inside images/", "`../donut.json`"],
        ),
        ("missing image", |d| d.write_rows(&["0,9999.jpg,0,0,,"]), &["9999.jpg", "line 2", "no such file"]),
        ("zero bytes", |d| d.write("images/0003.jpg", b""), &["0003.jpg", "line 5", "empty"]),
        ("truncated image", |d| d.write("images/0003.jpg", &jpeg(96, 96, 3)[..700]), &["0003.jpg", "truncated"]),
        ("not an image", |d| d.write("images/0003.jpg", b"hello"), &["0003.jpg", "not a JPEG"]),
        ("PNG", |d| d.write("images/0003.jpg", b"\x89PNG\r\n\x1a\n"), &["0003.jpg", "PNG", "convert"]),
        (
            "huge image",
            |d| {
                let mut bytes = jpeg(96, 96, 3);
                let size = bytes.windows(2).position(|pair| pair == [0xFF, 0xC0]).expect("has a size") + 5;
                bytes[size..size + 4].copy_from_slice(&[0xFF, 0xFF, 0xFF, 0xFF]);
                d.write("images/0003.jpg", &bytes);
            },
            &["0003.jpg", "65535 x 65535", "64 million"],
        ),
        (
            "huge file",
            |d| {
                let file = fs::File::create(d.folder().join("images/0003.jpg")).expect("creates");
                file.set_len((64 << 20) + 1).expect("a sparse file");
            },
            &["0003.jpg", "67108865 bytes"],
        ),
        (
            "mixed calibrations",
            |d| d.write("images/0003.jpg", &jpeg(96, 104, 3)),
            &["0003.jpg", "96 x 104", "96 x 96", "mixed calibrations"],
        ),
        (
            "donut outside",
            |d| d.write("donut.json", common::DONUT.replace("40.0", "60.0").as_bytes()),
            &["donut.json", "outside the frame", "96 x 96"],
        ),
        ("donut not JSON", |d| d.write("donut.json", b"{"), &["donut.json", "not a donut calibration"]),
        (
            "no donut",
            |d| fs::remove_file(d.folder().join("donut.json")).expect("removes"),
            &["donut.json", "omniloc calibrate"],
        ),
        (
            "time goes back",
            |d| d.write_rows(&["0,0000.jpg,0,0,,5", "1,0001.jpg,0,0,,4"]),
            &["line 3, field `time_s`", "not before 5"],
        ),
    ];
    for (name, spoil, expected) in table {
        let dataset = TinyDataset::new();
        spoil(&dataset);
        let (code, stdout, stderr) =
            run(omniloc().arg("import").arg(dataset.folder()).arg("--out").arg(dataset.path("out.mcap")));
        assert_eq!((code, stdout.as_str()), (1, ""), "{name}: {stderr}");
        for part in expected {
            assert!(stderr.contains(part), "{name}: `{part}` is not in: {stderr}");
        }
        assert_eq!(names(dataset.temporary.path()), ["tiny"], "{name}: something was left behind");
    }
}

#[test]
fn bad_arguments_end_with_2() {
    let dataset = TinyDataset::new();
    let recording = dataset.import("a.mcap");
    let before = fs::read(&recording).expect("readable");
    let (folder, recording) = (dataset.folder(), recording.as_path());
    let gpx = dataset.path("a.gpx");
    let table: [(&str, Vec<&Path>, &str); 8] = [
        ("no file", vec!["check".as_ref(), "/nonexistent".as_ref()], "/nonexistent: no such file"),
        (
            "no recording",
            vec!["export".as_ref(), "/none".as_ref(), "--to=csv".as_ref(), "--out".as_ref(), &gpx],
            "/none",
        ),
        ("exists", vec!["import".as_ref(), &folder, "--out".as_ref(), recording], "--force"),
        ("no data set", vec!["import".as_ref(), "/nonexistent".as_ref(), "--out".as_ref(), &gpx], "/nonexistent"),
        (
            "no origin",
            vec!["export".as_ref(), recording, "--to".as_ref(), "gpx".as_ref(), "--out".as_ref(), &gpx],
            "--origin",
        ),
        ("bad origin", vec!["import".as_ref(), &folder, "--origin=91,0".as_ref(), "--out".as_ref(), &gpx], "LAT,LON"),
        (
            "no format",
            vec!["export".as_ref(), recording, "--to".as_ref(), "pdf".as_ref(), "--out".as_ref(), &gpx],
            "geojson",
        ),
        (
            "a device",
            vec!["import".as_ref(), &folder, "--force".as_ref(), "--out".as_ref(), "/dev/full".as_ref()],
            "/dev/full",
        ),
    ];
    for (name, args, expected) in table {
        let (code, _, stderr) = run(omniloc().args(&args));
        assert_eq!(code, 2, "{name}: {stderr}");
        assert!(stderr.contains(expected), "{name}: {stderr}");
    }
    assert_eq!(names(dataset.temporary.path()), ["a.mcap", "tiny"]);
    assert!(fs::read(recording).expect("readable") == before, "a refused import leaves the old recording alone");
}

#[test]
fn an_unwritable_output_is_named() {
    let dataset = TinyDataset::new();
    for (out, expected) in [("missing/a.mcap", "does not exist"), ("tiny/donut.json/a.mcap", "a.mcap: cannot write")] {
        let (code, _, stderr) = run(omniloc().arg("import").arg(dataset.folder()).arg("--out").arg(dataset.path(out)));
        assert_eq!(code, 1, "{stderr}");
        assert!(stderr.contains(expected), "{stderr}");
    }
}

/// A file size limit stands in for a full disk: the write fails in the middle, which needs no root.
#[test]
fn a_write_that_fails_midway_leaves_nothing() {
    let dataset = TinyDataset::new();
    let limited = |args: &[&Path]| {
        let mut shell = process::Command::new("sh");
        shell.args(["-c", "trap '' XFSZ; ulimit -f 8; exec \"$0\" \"$@\"", env!("CARGO_BIN_EXE_omniloc")]);
        let output = shell.args(args).output().expect("sh starts");
        (output.status.code(), String::from_utf8_lossy(&output.stderr).into_owned())
    };
    let out = dataset.path("out.mcap");
    let (code, stderr) = limited(&["import".as_ref(), &dataset.folder(), "--out".as_ref(), &out]);
    assert_eq!(code, Some(1), "{stderr}");
    assert!(stderr.contains("out.mcap: cannot write") && stderr.contains("limit is reached"), "{stderr}");
    assert_eq!(names(dataset.temporary.path()), ["tiny"], "nothing is left behind");

    let out = dataset.path("folder");
    dataset.write("images/0000.jpg", &[jpeg(96, 96, 0), vec![0; 20_000]].concat());
    let padded = dataset.import("padded.mcap");
    let args: [&Path; 6] = ["export".as_ref(), &padded, "--to".as_ref(), "dataset".as_ref(), "--out".as_ref(), &out];
    let (code, stderr) = limited(&args);
    assert_eq!(code, Some(1), "{stderr}");
    assert!(stderr.contains("folder/images/0000.jpg: cannot write"), "{stderr}");
    assert_eq!(names(dataset.temporary.path()), ["padded.mcap", "tiny"], "nothing is left behind");
}

#[test]
fn tracks_and_tables_are_written() {
    let dataset = TinyDataset::new();
    let recording = dataset.import("a.mcap");
    for (format, parts) in [
        ("csv", vec!["index,file,stamp_ns,x_m", "0,0000.jpg,300000000,8.2848,7.5,0.01567,0.30000000000000004,47.0000"]),
        ("geojson", vec!["\"FeatureCollection\"", "\"LineString\"", "\"yaw_rad\": null"]),
        ("gpx", vec!["<trkpt lat=\"47.0000", "<name>images/0001.jpg</name>"]),
        ("kml", vec!["<coordinates>8.0001", "</kml>"]),
    ] {
        let out = dataset.path(format);
        omniloc()
            .arg("export")
            .arg(&recording)
            .args(["--to", format, "--origin", "47,8", "--out"])
            .arg(&out)
            .assert()
            .success();
        let text = fs::read_to_string(&out).expect("readable");
        for part in parts {
            assert!(text.contains(part), "{format}: `{part}` is not in\n{text}");
        }
    }
    let images = dataset.path("pictures");
    omniloc().arg("export").arg(&recording).args(["--to", "images", "--out"]).arg(&images).assert().success();
    assert_eq!(names(&images), names(&dataset.folder().join("images")));
    // Replaced only with --force.
    let again = |force: &[&str]| {
        run(omniloc().arg("export").arg(&recording).args(["--to", "images", "--out"]).arg(&images).args(force)).0
    };
    assert_eq!((again(&[]), again(&["--force"])), (2, 0));
    assert_eq!(names(&images).len(), 5);
}

#[test]
fn info_and_check_describe_a_sound_recording() {
    let dataset = TinyDataset::new();
    let recording = dataset.import("a.mcap");
    let (code, stdout, _) = run(omniloc().arg("info").arg(&recording).arg("--json"));
    let info: serde_json::Value = serde_json::from_str(&stdout).expect("JSON");
    assert_eq!(code, 0);
    assert_eq!(info["topics"]["/camera/image"]["messages"], 5);
    assert_eq!(info["topics"]["/gnss/heading"]["messages"], 4, "one frame has no yaw");
    assert!(info["topics"]["/gnss/fix"].is_null(), "no fix is invented without an origin");
    assert_eq!(info["calibration"]["r_out"], 40.0);
    assert_eq!((&info["usable_frames"], &info["frames_with_yaw"]), (&5.into(), &4.into()));

    let (code, stdout, _) = run(omniloc().arg("info").arg(&recording));
    assert!(code == 0 && stdout.contains("usable frames  5, 4 of them with yaw"), "{stdout}");
    let (code, stdout, _) = run(omniloc().arg("check").arg(&recording).arg("--json"));
    let verdict: serde_json::Value = serde_json::from_str(&stdout).expect("JSON");
    assert_eq!((code, &verdict["sound"], &verdict["images"]), (0, &true.into(), &5.into()));
}

#[test]
fn damage_is_found_and_named() {
    let dataset = TinyDataset::new();
    let sound = fs::read(dataset.import("a.mcap")).expect("readable");
    let flipped = {
        let mut bytes = sound.clone();
        let at = bytes.windows(3).position(|three| three == [0xFF, 0xD8, 0xFF]).expect("an image");
        bytes[at + 200] ^= 0x10;
        bytes
    };
    let table: [(&str, Vec<u8>, &str); 5] = [
        ("empty", vec![], "an empty file"),
        ("text", b"index,file\n".to_vec(), "not an MCAP recording"),
        ("cut", sound[..sound.len() / 2].to_vec(), "omniloc recover"),
        ("end cut", sound[..sound.len() - 3].to_vec(), "omniloc recover"),
        ("one bit", flipped, "CRC of the chunk"),
    ];
    for (name, bytes, expected) in table {
        let path = dataset.path("bad.mcap");
        fs::write(&path, bytes).expect("writes");
        for command in ["check", "info"] {
            let (code, stdout, stderr) = run(omniloc().arg(command).arg(&path));
            assert_eq!(code, 1, "{command} {name}: {stdout}{stderr}");
            let said = stdout + &stderr;
            assert!(said.contains(expected) && said.contains("bad.mcap"), "{command} {name}: {said}");
        }
    }
}

#[test]
fn a_data_set_without_calibration_or_times_can_be_imported() {
    let dataset = TinyDataset::new();
    fs::remove_file(dataset.folder().join("donut.json")).expect("removes");
    dataset.write_rows(&["0,0000.jpg,1,2,,", "1,0001.jpg,1,2,,"]);
    let out = dataset.path("a.mcap");
    let (code, _, stderr) =
        run(omniloc().arg("import").arg(dataset.folder()).arg("--without-calibration").arg("--out").arg(&out));
    assert_eq!(code, 0, "{stderr}");
    assert!(stderr.contains("warning") && stderr.contains("lines 3 and 2"), "repeated positions are named: {stderr}");
    assert!(stderr.contains("3 images") && stderr.contains("0002.jpg"), "unused images are named: {stderr}");
    let (code, stdout, _) = run(omniloc().arg("check").arg(&out));
    assert!(code == 0 && stdout.contains("no calibration"), "{stdout}");
    let error = omniloc::recording::Recording::open(&out).expect_err("training needs a calibration");
    assert!(error.to_string().contains("omniloc calibrate"), "{error}");

    let exported = dataset.path("back");
    omniloc().arg("export").arg(&out).args(["--to", "dataset", "--out"]).arg(&exported).assert().success();
    let text = fs::read_to_string(exported.join("positions.csv")).expect("readable");
    assert_eq!(text, format!("{HEADER}\n0,0000.jpg,1,2,,\n1,0001.jpg,1,2,,\n"), "no time is invented");
}

#[test]
fn frames_without_huffman_tables_are_completed() {
    let dataset = TinyDataset::new();
    let whole = jpeg(96, 96, 3);
    let mut bare = whole.clone();
    while let Some(at) = bare.windows(2).position(|pair| pair == [0xFF, 0xC4]) {
        let length = usize::from(u16::from_be_bytes([bare[at + 2], bare[at + 3]]));
        bare.drain(at..at + 2 + length);
    }
    dataset.write("images/0003.jpg", &bare);
    let (recording, images) = (dataset.import("a.mcap"), dataset.path("pictures"));
    omniloc().arg("export").arg(&recording).args(["--to", "images", "--out"]).arg(&images).assert().success();
    let decoded = image::open(images.join("0003.jpg")).expect("any program can decode it");
    assert_eq!(decoded.to_luma8(), image::load_from_memory(&whole).expect("decodes").to_luma8());
}

#[test]
fn a_reader_that_stops_early_is_no_error() {
    let dataset = TinyDataset::new();
    let recording = dataset.import("a.mcap");
    let mut info = process::Command::new(env!("CARGO_BIN_EXE_omniloc"));
    let mut info = info.arg("info").arg(&recording).stdout(process::Stdio::piped()).spawn().expect("starts");
    drop(info.stdout.take());
    assert_eq!(info.wait().expect("ends").code(), Some(0));
}

/// The recording as other people's programs see it. `tests/run` makes the Python environment and names it.
#[test]
fn python_reads_what_was_recorded() {
    let Some(python) = common::python() else { return };
    let dataset = TinyDataset::new();
    let recording = dataset.path("a.mcap");
    omniloc()
        .arg("import")
        .arg(dataset.folder())
        .arg("--out")
        .arg(&recording)
        .args(["--origin", "47,8,400"])
        .assert()
        .success();
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/python/read_recording.py");
    let output = process::Command::new(&python).arg(script).arg(&recording).arg(dataset.folder()).output();
    let output = output.unwrap_or_else(|error| panic!("OMNILOC_PYTHON={python} does not start: {error}"));
    let said = String::from_utf8_lossy(&output.stdout) + String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{said}");
}
