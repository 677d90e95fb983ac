//! `omniloc train --update`: a drive is added to a map, and never makes it worse unnoticed.

mod common;

use std::{fs, path::Path};

use common::{
    map::{SEED, folder, map},
    omniloc,
};

fn recording(folder: &Path, name: &str, extra: &[&str]) -> std::path::PathBuf {
    let [dataset, recording] = [name.to_owned(), format!("{name}.mcap")].map(|name| folder.join(name));
    omniloc()
        .args(["simulate", "--world", "corridor", "--size", "320x180", "--position-std-m", "0"])
        .args(extra)
        .arg("--out")
        .arg(&dataset)
        .assert()
        .success();
    omniloc().arg("import").arg(&dataset).arg("--out").arg(&recording).assert().success();
    recording
}

fn update(recording: &Path, out: &Path, extra: &[&str]) -> assert_cmd::assert::Assert {
    omniloc().args(["train", "--update"]).arg(map()).arg(recording).arg("--out").arg(out).args(extra).assert()
}

#[test]
fn another_day_is_added_and_what_it_does_is_said() {
    let temporary = tempfile::tempdir().expect("a temporary folder");
    let out = temporary.path().join("both.map");
    let other_day = recording(temporary.path(), "other-day", &["--seed", SEED, "--day", "2", "--frames", "60"]);
    let done = update(&other_day, &out, &[]).success();
    let text = String::from_utf8_lossy(&done.get_output().stdout).into_owned();
    for words in ["added           60 frames", "of the map, before", "of the map, after", "of the drive, after"] {
        assert!(text.contains(words), "`{words}` is missing: {text}");
    }
    let info = omniloc().arg("info").arg(&out).assert().success();
    let text = String::from_utf8_lossy(&info.get_output().stdout).into_owned();
    assert!(text.contains("corridor-7-day-1, 120 frames") && text.contains("corridor-7-day-2, 60 frames"), "{text}");
    // The same drive once more would count twice.
    let mut again = omniloc();
    again.args(["train", "--update"]).arg(&out).arg(&other_day).arg("--out").arg(temporary.path().join("thrice.map"));
    let refused = again.assert().code(1);
    assert!(String::from_utf8_lossy(&refused.get_output().stderr).contains("already"));
}

/// Another corridor of the same size: its frames are nothing like the map's at the same positions.
#[test]
fn a_drive_that_spoils_the_map_is_not_added_unless_asked_for() {
    let temporary = tempfile::tempdir().expect("a temporary folder");
    let out = temporary.path().join("spoiled.map");
    let other_place = recording(temporary.path(), "other-place", &["--seed", "99", "--frames", "120"]);
    let refused = update(&other_place, &out, &[]).code(1);
    let message = String::from_utf8_lossy(&refused.get_output().stderr).into_owned();
    assert!(message.contains("worse") && message.contains("--even-if-worse"), "{message}");
    assert!(!out.exists());
    update(&other_place, &out, &["--even-if-worse"]).success();
    assert!(out.exists());
}

#[test]
fn what_makes_no_sense_is_refused() {
    let temporary = tempfile::tempdir().expect("a temporary folder");
    let out = temporary.path().join("out.map");
    let survey = folder().join("survey.mcap");
    update(&survey, &map(), &["--force"]).code(2);
    update(&survey, &out, &["--select", "none"]).code(2);
    let mut two = omniloc();
    two.args(["train", "--update"]).arg(map()).arg(&survey).arg(&survey).arg("--out").arg(&out).assert().code(2);
    fs::write(temporary.path().join("no.map"), b"no map").expect("writes");
    let mut none = omniloc();
    none.args(["train", "--update"]).arg(temporary.path().join("no.map")).arg(&survey).arg("--out").arg(&out);
    none.assert().code(1);
    assert!(!out.exists());
}
