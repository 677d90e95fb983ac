//! `omniloc simulate` as a user runs it.

mod common;

use std::{collections::BTreeMap, fs, path::Path};

use common::omniloc;

/// Every file under a folder with its bytes.
fn contents(folder: &Path) -> BTreeMap<String, Vec<u8>> {
    let mut files = BTreeMap::new();
    for entry in fs::read_dir(folder).expect("a folder") {
        let path = entry.expect("an entry").path();
        let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        if path.is_dir() {
            files.extend(contents(&path).into_iter().map(|(inner, bytes)| (format!("{name}/{inner}"), bytes)));
        } else {
            files.insert(name, fs::read(&path).expect("readable"));
        }
    }
    files
}

#[test]
fn a_simulated_drive_is_a_data_set_that_can_be_imported_and_made_again() {
    let temporary = tempfile::tempdir().expect("a temporary folder");
    for world in ["town", "corridor"] {
        let folder = temporary.path().join(world);
        let simulate = |extra: &[&str]| {
            let mut command = omniloc();
            command.args(["simulate", "--world", world, "--frames", "6", "--size", "640x360", "--out"]).arg(&folder);
            command.args(extra).assert()
        };
        simulate(&[]).success();
        let first = contents(&folder);
        assert_eq!(first.len(), 6 + 4, "{:?}", first.keys());
        simulate(&[]).code(2);
        simulate(&["--force"]).success();
        assert_eq!(contents(&folder), first, "the same options give the same files");

        let recording = temporary.path().join(format!("{world}.mcap"));
        let imported = omniloc().arg("import").arg(&folder).arg("--out").arg(&recording).assert().success();
        let text = String::from_utf8_lossy(&imported.get_output().stdout).into_owned();
        assert!(text.contains("6 frames of 640 x 360 px"), "{text}");
        assert!(imported.get_output().stderr.is_empty(), "no warnings");
    }
}

#[test]
fn a_hall_is_photographed_on_a_lattice_and_at_random_places() {
    let temporary = tempfile::tempdir().expect("a temporary folder");
    for (name, how, day, frames) in
        [("survey", ["--spacing-m", "8"], "1", 10..=30), ("test", ["--frames", "4"], "2", 4..=4)]
    {
        let folder = temporary.path().join(name);
        let mut command = omniloc();
        command.args(["simulate", "--world", "hall", "--size", "640x360", "--day", day, "--tilt-deg", "1"]);
        command.args(["--gain-db", "2", "--traffic", "0.5", "--season", "winter"]);
        command.args(how).arg("--out").arg(&folder).assert().success();
        let positions = fs::read_to_string(folder.join("positions.csv")).expect("positions");
        let truth = fs::read_to_string(folder.join("truth.csv")).expect("truth");
        assert!(frames.contains(&(positions.lines().count() - 1)), "{positions}");
        for (line, exact) in positions.lines().zip(truth.lines()).skip(1) {
            let fields: Vec<&str> = line.split(',').collect();
            assert_eq!(format!("{},{},{}", fields[0], fields[2], fields[3]), exact, "positions are exact");
            assert_eq!((fields.len(), fields[5]), (6, ""), "photographs follow in no order");
        }
        let recording = temporary.path().join(format!("{name}.mcap"));
        omniloc().arg("import").arg(&folder).arg("--out").arg(recording).assert().success();
    }
}

#[test]
fn impossible_wishes_are_refused() {
    let temporary = tempfile::tempdir().expect("a temporary folder");
    let out = temporary.path().join("out");
    for wish in [
        ["--size", "64"],
        ["--size", "32x32"],
        ["--length-m", "1e9"],
        ["--lane-shift-m", "nan"],
        ["--frames", "1"],
        ["--spacing-m", "2"],
        ["--traffic", "-1"],
        ["--gain-db", "100"],
        ["--tilt-deg", "nan"],
        ["--season", "monsoon"],
    ] {
        omniloc().args(["simulate", "--out"]).arg(&out).args(wish).assert().code(2);
        assert!(!out.exists(), "{wish:?}");
    }
}
