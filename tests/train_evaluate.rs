//! train, evaluate, info and check of maps as a user runs them, on the real photographs of the sample.

mod common;

use std::{
    fs,
    path::{Path, PathBuf},
};

use common::{DONUT, TinyDataset, jpeg, omniloc, run};
use tempfile::TempDir;

fn sample() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("samples/courtyard-75")
}

/// A recording of the sample's first `frames` photographs.
fn recording(folder: &TempDir, frames: usize) -> PathBuf {
    let dataset = folder.path().join("courtyard");
    fs::create_dir_all(dataset.join("images")).expect("a folder");
    let rows = fs::read_to_string(sample().join("positions.csv")).expect("the sample is shipped");
    let kept: Vec<&str> = rows.lines().take(1 + frames).collect();
    fs::write(dataset.join("positions.csv"), kept.join("\n") + "\n").expect("writes");
    for index in 0..frames {
        let name = format!("images/{index:04}.jpg");
        fs::copy(sample().join(&name), dataset.join(&name)).expect("copies");
    }
    fs::copy(sample().join("donut.json"), dataset.join("donut.json")).expect("copies");
    let out = folder.path().join("courtyard.mcap");
    omniloc().arg("import").arg(&dataset).arg("--out").arg(&out).assert().success();
    out
}

fn folder() -> TempDir {
    TempDir::new().expect("a temporary folder")
}

/// An evaluation of one recipe with one type of features, on one split.
const QUICK: [&str; 6] = ["--features", "gradient", "--recipe", "default", "--split", "random"];

#[test]
fn a_recording_without_a_usable_frame_is_left_out_beside_others() {
    let folder = folder();
    let (good, useless) = (recording(&folder, 12), folder.path().join("useless.mcap"));
    let file = fs::File::create(&useless).expect("creates");
    mcap::Writer::new(file).and_then(|mut writer| writer.finish()).expect("writes");
    let map = folder.path().join("area.map");
    let train = |recordings: &[&PathBuf]| {
        run(omniloc().arg("train").args(recordings).arg("--out").arg(&map).args([
            "--grid-step-m",
            "20",
            "--features",
            "gradient",
        ]))
    };
    let (code, _, stderr) = train(&[&useless]);
    assert!(code == 1 && stderr.contains("no usable frame") && !map.exists(), "{code} {stderr}");
    let (code, stdout, stderr) = train(&[&useless, &good]);
    assert_eq!(code, 0, "{stderr}");
    assert!(stderr.contains("note: left out: ") && stderr.contains("useless.mcap: no usable frame"), "{stderr}");
    assert!(stdout.contains("trained on     courtyard, 12 frames"), "{stdout}");
}

#[test]
fn a_map_is_trained_shown_checked_and_measured_against() {
    let folder = folder();
    let recording = recording(&folder, 24);
    let map = folder.path().join("area.map");
    let (code, stdout, stderr) =
        run(omniloc().arg("train").arg(&recording).arg("--out").arg(&map).args(["--grid-step-m", "5"]));
    assert_eq!(code, 0, "{stderr}");
    assert!(stdout.contains("trained on     courtyard, 24 frames") && stdout.contains("validation"), "{stdout}");
    assert!(stdout.contains("positions      as recorded: too few frames"), "{stdout}");
    assert!(stderr.contains("warning: the map has seen its place only once"), "{stderr}");

    let (code, stdout, _) = run(omniloc().arg("info").arg("--json").arg(&map));
    let info: serde_json::Value = serde_json::from_str(&stdout).expect("JSON");
    assert_eq!((code, info["kind"].as_str(), info["learning_positions"].as_u64()), (0, Some("map"), Some(24)));
    let (code, stdout, _) = run(omniloc().arg("check").arg(&map));
    assert!(code == 0 && stdout.contains("sound"), "{stdout}");

    // Learned by heart: every frame of its own recording is found again, but for the coarse grid.
    let results = folder.path().join("results.json");
    let (code, stdout, stderr) = run(omniloc()
        .arg("evaluate")
        .arg(&recording)
        .arg("--map")
        .arg(&map)
        .arg("--frames")
        .arg("--json")
        .arg(&results));
    assert_eq!(code, 0, "{stderr}");
    assert!(stdout.contains("against a map: 24 frames"), "{stdout}");
    let results: serde_json::Value = serde_json::from_slice(&fs::read(results).expect("written")).expect("JSON");
    let fused = results["results"].as_array().expect("a list").iter().find(|row| row["features"] == "fused");
    let fused = fused.expect("a fused row");
    assert!(fused["median_m"].as_f64().expect("a number") < 10.0, "{fused}");
    assert_eq!(fused["frames"].as_array().expect("a list").len(), 24);
    assert!(fused["nees_mean"].as_f64().expect("single frames have a covariance too") > 0.0, "{fused}");
    assert_eq!(results["program"], env!("CARGO_PKG_VERSION"));
    // Without its images only the map's own features can be compared.
    let methods = |results: &serde_json::Value| -> Vec<String> {
        let rows = results["results"].as_array().expect("a list");
        let baselines = rows.iter().filter(|row| row["recipe"].is_null());
        baselines.map(|row| row["features"].as_str().expect("a name").to_owned()).collect()
    };
    assert!(stderr.contains("no rows for aligned, bow: a map holds features, not images"), "{stderr}");
    assert_eq!(methods(&results), ["nearest", "median"]);
    let with_images = folder.path().join("with-images.json");
    let (code, _, stderr) = run(omniloc()
        .arg("evaluate")
        .arg(&recording)
        .arg("--map")
        .arg(&map)
        .arg("--survey")
        .arg(&recording)
        .args(["--frames", "--json"])
        .arg(&with_images));
    assert_eq!(code, 0, "{stderr}");
    let with_images: serde_json::Value =
        serde_json::from_slice(&fs::read(with_images).expect("written")).expect("JSON");
    assert_eq!(methods(&with_images), ["nearest", "aligned", "bow", "bow-nearest", "median"]);
    let assignment = &with_images["assignments"][0];
    assert_eq!(assignment["test"].as_array().expect("a list").len(), 24);
    assert!(assignment["learning"][0]["label"].is_number() && assignment["classified_share"].is_number());

    // The same call, the same bytes.
    let again = folder.path().join("again.map");
    omniloc().arg("train").arg(&recording).arg("--out").arg(&again).args(["--grid-step-m", "5"]).assert().success();
    assert!(fs::read(&map).expect("readable") == fs::read(&again).expect("readable"), "training is repeatable");
}

#[test]
fn the_protocol_runs_with_both_recipes_and_a_split_from_a_file() {
    let folder = folder();
    let recording = recording(&folder, 24);
    let split = folder.path().join("split.csv");
    let set = |index: usize| ["learning", "validation", "learning", "test"][index % 4];
    let lines: String = (0..24).map(|index| format!("{index},{}\n", set(index))).collect();
    fs::write(&split, format!("index,set\n{lines}")).expect("writes");
    let results = folder.path().join("results.json");
    let (code, stdout, stderr) = run(omniloc()
        .arg("evaluate")
        .arg(&recording)
        .args(["--features", "sp", "--grid-step-m", "5", "--split"])
        .arg(&split)
        .arg("--json")
        .arg(&results));
    assert_eq!(code, 0, "{stderr}");
    assert!(stdout.contains("12 learning, 6 validation, 6 test frames"), "{stdout}");
    let results: serde_json::Value = serde_json::from_slice(&fs::read(results).expect("written")).expect("JSON");
    let rows = results["results"].as_array().expect("a list");
    let recipes: Vec<_> = rows.iter().map(|row| row["recipe"].as_str()).collect();
    assert_eq!(recipes[..2], [Some("paper"), Some("default")]);
    // The photographs are ten metres apart: none has the label of another.
    assert!(stderr.contains("bow: no learning image lies within 5 m of a test position"), "{stderr}");
    let baselines: Vec<_> = rows[2..].iter().map(|row| row["features"].as_str().expect("a name")).collect();
    assert_eq!(baselines, ["nearest", "aligned", "bow-nearest", "median"]);
    for row in rows {
        let recall = ["recall_1m", "recall_2m", "recall_5m", "recall_10m"].map(|key| row[key].as_f64().expect(key));
        assert!(recall.is_sorted() && row["frames"].is_null(), "{row}");
    }
    assert_eq!((&rows[0]["chosen_on"], &rows[1]["chosen_on"]), (&"validation".into(), &serde_json::Value::Null));
    // The default recipe is what the others are compared with.
    let comparisons = results["statistics"]["comparisons"].as_array().expect("a list");
    let compared: Vec<_> = comparisons.iter().map(|c| c["method"]["features"].as_str().expect("a name")).collect();
    assert_eq!(compared, ["sp", "nearest", "aligned", "bow-nearest", "median"]);
    assert!(comparisons.iter().all(|c| c["reference"]["recipe"] == "default" && c["p_holm"].is_number()));
    assert_eq!(results["statistics"]["methods"].as_array().expect("a list").len(), 6);
    let paper = &rows[0];
    assert!(paper["kept"].as_u64() <= paper["rank"].as_u64() && paper["bic_all"].is_number(), "{paper}");
    assert!(paper["seed"].is_null() && paper["n_learned_from"] == 12, "{paper}");
    assert!(rows[1]["n_learned_from"] == 18, "the default recipe refits: {}", rows[1]);
}

/// A drive along its yaw: smoothing moves its positions, and evaluate says how far.
#[test]
fn it_is_said_how_far_smoothing_moved_the_positions() {
    let folder = folder();
    let (dataset, recording) = (folder.path().join("town"), folder.path().join("town.mcap"));
    omniloc()
        .args(["simulate", "--world", "town", "--frames", "60", "--size", "320x180", "--out"])
        .arg(&dataset)
        .assert()
        .success();
    omniloc().arg("import").arg(&dataset).arg("--out").arg(&recording).assert().success();
    let results = folder.path().join("results.json");
    let (code, stdout, stderr) = run(omniloc()
        .arg("evaluate")
        .arg(&recording)
        .args(QUICK)
        .args(["--seeds", "2", "--grid-step-m", "5"])
        .args(["--variants", "plain", "--baselines", "none", "--json"])
        .arg(&results));
    assert_eq!(code, 0, "{stderr}");
    let said = "positions of town-1-day-1 that the default recipe learned from: moved by smoothing, by ";
    assert!(stdout.contains(said) && stdout.contains("m (root mean square, over 2 trials), frame "), "{stdout}");
    let results: serde_json::Value = serde_json::from_slice(&fs::read(results).expect("written")).expect("JSON");
    let shifts = results["position_shifts"].as_array().expect("a list");
    assert_eq!(shifts.len(), 2);
    for shift in shifts {
        let [rms_m, largest_m] = ["rms_m", "largest_m"].map(|key| shift[key].as_f64().expect(key));
        assert!(0.0 < rms_m && rms_m < largest_m && shift["frames"] == 45, "{shift}");
        assert!(shift["track"]["smoothed"]["receiver_std_m"].is_number(), "{shift}");
    }
}

#[test]
fn what_cannot_be_trained_is_refused_and_leaves_nothing() {
    let row = |index: usize, place: &str| format!("{index},{index:04}.jpg,{place},,");
    let one_place: Vec<String> = (0..5).map(|index| row(index, "3,4")).collect();
    let far: Vec<String> = (0..5).map(|index| row(index, &format!("{},0", index * 1_000_000))).collect();
    type Case<'a> = (&'a str, Vec<String>, &'a [&'a str], i32, &'a str);
    let table: [Case; 4] = [
        ("one place", one_place, &[], 1, "learning images are at one place"),
        ("too few", vec![row(0, "0,0"), row(1, "1,0")], &[], 1, "record more frames"),
        ("huge area", far, &[], 2, "use a larger --grid-step-m"),
        (
            "no grid",
            vec![row(0, "0,0"), row(1, "1,0"), row(2, "2,0"), row(3, "3,0")],
            &["--grid-step-m", "0"],
            2,
            "expected 0.001 to 10000 m",
        ),
    ];
    for (case, rows, arguments, expected_code, expected) in table {
        let dataset = TinyDataset::new();
        dataset.write_rows(&rows.iter().map(String::as_str).collect::<Vec<_>>());
        let recording = dataset.import("rec.mcap");
        let map = dataset.path("out.map");
        let (code, _, stderr) = run(omniloc().arg("train").arg(&recording).arg("--out").arg(&map).args(arguments));
        assert_eq!(code, expected_code, "{case}: {stderr}");
        assert!(stderr.contains(expected), "{case}: {stderr}");
        assert!(!map.exists(), "{case}");
    }
}

#[test]
fn recordings_of_two_lenses_make_no_map() {
    let (first, second) = (TinyDataset::new(), TinyDataset::new());
    second.write("donut.json", DONUT.replace("47.5", "46.0").as_bytes());
    let (a, b) = (first.import("a.mcap"), second.import("b.mcap"));
    let (code, _, stderr) = run(omniloc().arg("train").args([&a, &b]).arg("--out").arg(first.path("out.map")));
    assert!(code == 1 && stderr.contains("mixed calibrations") && stderr.contains("b.mcap"), "{stderr}");
    assert!(!first.path("out.map").exists());
}

#[test]
fn a_copy_of_a_recording_is_not_another_one() {
    let dataset = TinyDataset::new();
    let (drive, copy) = (dataset.import("drive.mcap"), dataset.path("copy.mcap"));
    fs::copy(&drive, &copy).expect("copies");
    let (code, _, stderr) = run(omniloc().arg("train").args([&drive, &copy]).arg("--out").arg(dataset.path("out.map")));
    assert!(code == 2 && stderr.contains("copy.mcap holds the same frames"), "{stderr}");
    // A folder stands for all in it.
    let (code, _, stderr) = run(omniloc().arg("train").arg(dataset.temporary.path()).arg("--out").arg("unused.map"));
    assert!(code == 2 && stderr.contains("drive.mcap holds the same frames"), "{stderr}");
}

#[test]
fn an_image_damaged_inside_its_scan_is_named() {
    let dataset = TinyDataset::new();
    // A whole-looking frame with a stretch of ones, which no Huffman code of a JPEG is.
    let mut damaged = jpeg(96, 96, 2);
    let middle = damaged.len() - 600;
    damaged[middle..middle + 200].copy_from_slice(&[0xFF, 0x00].repeat(100));
    dataset.write("images/0002.jpg", &damaged);
    let recording = dataset.import("rec.mcap");
    let (code, _, stderr) = run(omniloc().arg("train").arg(&recording).arg("--out").arg(dataset.path("out.map")));
    assert!(code == 1 && stderr.contains("frame 2") && stderr.contains("not a whole JPEG"), "{stderr}");
}

#[test]
fn damaged_foreign_and_missing_maps_are_refused() {
    let folder = folder();
    let recording = recording(&folder, 16);
    let map = folder.path().join("area.map");
    let small = ["--features", "gradient", "--grid-step-m", "10"];
    omniloc().arg("train").arg(&recording).arg("--out").arg(&map).args(small).assert().success();
    let bytes = fs::read(&map).expect("readable");
    let mut flipped = bytes.clone();
    let middle = flipped.len() / 2;
    flipped[middle] ^= 1;
    let newer = String::from_utf8_lossy(&bytes[..2000]).find("format_version").expect("in the header");
    let mut of_future = bytes.clone();
    let digit = newer + of_future[newer..].iter().position(u8::is_ascii_digit).expect("a version");
    of_future[digit] = b'9';
    for (case, content, expected) in [
        ("cut", &bytes[..bytes.len() / 2], "damaged"),
        ("flipped", &flipped, "checksum"),
        ("newer", &of_future, "version 9, this build reads version 5"),
        ("text", b"not a map at all", "not a map"),
        ("empty", b"", "not a map"),
    ] {
        let bad = folder.path().join(format!("{case}.map"));
        fs::write(&bad, content).expect("writes");
        let (code, _, stderr) = run(omniloc().arg("evaluate").arg(&recording).arg("--map").arg(&bad));
        assert!(code == 1 && stderr.contains(expected) && stderr.contains(case), "{case}: {code} {stderr}");
        let (code, stdout, _) = run(omniloc().arg("check").arg(&bad));
        assert!(code == 1 && stdout.contains("NOT SOUND"), "{case}: {stdout}");
    }
    let (code, _, stderr) = run(omniloc().arg("evaluate").arg(&recording).args(["--map", "nowhere.map"]));
    assert!(code == 2 && stderr.contains("nowhere.map"), "{stderr}");

    // Another lens.
    let tiny = TinyDataset::new();
    let (code, _, stderr) = run(omniloc().arg("evaluate").arg(tiny.import("tiny.mcap")).arg("--map").arg(&map));
    assert!(code == 1 && stderr.contains("the map is of another lens"), "{stderr}");
}

/// A receiver slower than the camera repeats its fixes: the spacing must not collapse.
#[test]
fn held_positions_still_make_a_map() {
    let dataset = TinyDataset::new();
    let rows: Vec<String> = (0..12)
        .map(|index| {
            dataset.write(&format!("images/{index:04}.jpg"), &jpeg(96, 96, index));
            format!("{index},{index:04}.jpg,{},0,,", index / 3 * 4)
        })
        .collect();
    dataset.write_rows(&rows.iter().map(String::as_str).collect::<Vec<_>>());
    let recording = dataset.import("held.mcap");
    let map = dataset.path("held.map");
    let (code, stdout, stderr) = run(omniloc().arg("train").arg(&recording).arg("--out").arg(&map));
    assert!(code == 0 && stdout.contains("length 6.00 m"), "{stdout}{stderr}");
}

#[test]
fn no_output_may_be_an_input_and_arguments_that_contradict_are_refused() {
    let folder = folder();
    let recording = recording(&folder, 16);
    let before = fs::read(&recording).expect("readable");
    let path = recording.to_str().expect("a plain name");
    for arguments in [
        vec!["train", path, "--out", path, "--force"],
        vec!["evaluate", path, "--json", path, "--force"],
        vec!["evaluate", path, "--json", path],
        vec!["export", path, "--to", "csv", "--out", path, "--force"],
        vec!["calibrate", path, "--out", path, "--force"],
        vec!["train", path, path, "--out", "x.map"],
        vec!["train", path, "--out", "x.map", "--within-m", "0"],
        vec!["train", path, "--out", "x.map", "--within-m", "-1"],
        vec!["evaluate", path, "--json", "/dev/null"],
        vec!["evaluate", path, "--map", "x.map", "--seeds", "2"],
        vec!["evaluate", path, "--split", "random,random"],
        vec!["evaluate", path, "--split", "nowhere.csv"],
        vec!["evaluate", path, "--split", "."],
        vec!["evaluate", path, "--truth", "nowhere.csv"],
        vec!["evaluate", path, "--truth", "."],
        vec!["evaluate", path, "--map", "."],
        vec!["evaluate", path, "--seed", "18446744073709551615", "--seeds", "2"],
    ] {
        let (code, _, stderr) = run(omniloc().args(&arguments).current_dir(folder.path()));
        assert_eq!(code, 2, "{arguments:?}: {stderr}");
    }
    assert!(fs::read(&recording).expect("readable") == before, "the recording was overwritten");
    assert!(!folder.path().join("x.map").exists());
}

#[test]
fn outputs_that_cannot_be_written_are_refused_before_the_work() {
    let folder = folder();
    let recording = recording(&folder, 16);
    let occupied = folder.path().join("there.map");
    fs::write(&occupied, b"something").expect("writes");
    let (code, _, stderr) = run(omniloc().arg("train").arg(&recording).arg("--out").arg(&occupied));
    assert!(code == 2 && stderr.contains("--force"), "{stderr}");
    assert_eq!(fs::read(&occupied).expect("readable"), b"something");
    let nowhere = folder.path().join("no/such/folder/results.json");
    let (code, _, stderr) = run(omniloc().arg("evaluate").arg(&recording).arg("--json").arg(&nowhere));
    assert!(code == 2 && stderr.contains("there is no folder"), "{stderr}");
}

#[test]
fn a_bad_split_or_truth_names_its_line() {
    let dataset = TinyDataset::new();
    let recording = dataset.import("rec.mcap");
    let split = dataset.path("split.csv");
    fs::write(&split, "index,set\n0,learning\n1,exam\n").expect("writes");
    let (code, _, stderr) = run(omniloc().arg("evaluate").arg(&recording).arg("--split").arg(&split));
    assert!(code == 1 && stderr.contains("split.csv") && stderr.contains("line 3"), "{stderr}");
    let truth = dataset.path("truth.csv");
    fs::write(&truth, "index,x_m,y_m\n0,1,2\n1,NaN,3\n").expect("writes");
    let (code, _, stderr) = run(omniloc().arg("evaluate").arg(&recording).arg("--truth").arg(&truth));
    assert!(code == 1 && stderr.contains("truth.csv: line 3: x_m is `NaN`"), "{stderr}");
    // As of any other file that holds something else.
    let (code, _, stderr) = run(omniloc().arg("evaluate").arg(&split));
    assert!(code == 1 && stderr.contains("not an MCAP recording"), "{stderr}");
}

#[test]
fn a_truth_of_another_place_is_warned_about() {
    let folder = folder();
    let recording = recording(&folder, 24);
    let rows = fs::read_to_string(sample().join("positions.csv")).expect("the sample is shipped");
    for (east_m, is_doubtful) in [(8.0, false), (1200.0, true)] {
        let lines = rows.lines().skip(1).take(24).map(|line| {
            let fields: Vec<&str> = line.split(',').collect();
            format!("{},{},{}\n", fields[0], fields[2].parse::<f64>().expect("a number") + east_m, fields[3])
        });
        let truth = folder.path().join("truth.csv");
        fs::write(&truth, format!("index,x_m,y_m\n{}", lines.collect::<String>())).expect("writes");
        let results = folder.path().join("results.json");
        let (code, _, stderr) = run(omniloc()
            .arg("evaluate")
            .arg(&recording)
            .args(QUICK)
            .args(["--seeds", "1", "--grid-step-m", "10"])
            .args(["--variants", "plain", "--baselines", "none", "--force", "--truth"])
            .arg(&truth)
            .arg("--json")
            .arg(&results));
        assert_eq!(code, 0, "{stderr}");
        assert_eq!(stderr.contains("more than 1200.0 m from the recorded ones"), is_doubtful, "{stderr}");
        let results: serde_json::Value = serde_json::from_slice(&fs::read(results).expect("written")).expect("JSON");
        assert_eq!(results["warnings"].as_array().expect("a list").len(), usize::from(is_doubtful));
        let roles: Vec<_> = results["inputs"].as_array().expect("a list").iter().map(|input| &input["role"]).collect();
        assert_eq!(roles, ["recording", "truth"]);
    }
}

/// Set by `tests/run`: a Python with the packages of `tests/python/requirements.txt`.
#[test]
fn python_reads_the_map_without_our_code() {
    let Some(python) = common::python() else { return };
    let folder = folder();
    let recording = recording(&folder, 16);
    let map = folder.path().join("area.map");
    omniloc().arg("train").arg(&recording).arg("--out").arg(&map).args(["--grid-step-m", "10"]).assert().success();
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/python/read_map.py");
    let outcome = std::process::Command::new(python).arg(script).arg(&map).output().expect("OMNILOC_PYTHON runs");
    assert!(outcome.status.success(), "{}", String::from_utf8_lossy(&outcome.stderr));
}
