//! The way of README's page "On the Pi", from a camera that nobody has calibrated to positions, with simulated devices.

mod common;

use std::{
    fs,
    path::{Path, PathBuf},
};

use common::{
    drive::{command, configure, finished, stderr, wait},
    omniloc, run,
};
use serde_json::Value;

/// Records a drive of the corridor as `simulation` says, with this calibration if any; the segments that are whole.
fn drive(folder: &Path, simulation: &str, calibration: Option<&Path>) -> Vec<PathBuf> {
    fs::create_dir_all(folder).expect("a folder");
    // So that what is measured is not the receiver.
    let receiver = "[simulation.receiver]\nrate_hz = 50.0\nposition_std_m = 0.05";
    let config = configure(folder, &format!("place_seed = 5\n{simulation}\n{receiver}"), &[]);
    let mut text = fs::read_to_string(&config).expect("readable");
    text = text.replace("[recorder]", "[recorder]\nsegment_s = 10");
    if let Some(calibration) = calibration {
        text = text.replace("[camera]", &format!("calibration = \"{}\"\n[camera]", calibration.display()));
    }
    fs::write(&config, text).expect("writes");
    let output = wait(command(&config).spawn().expect("starts"));
    let segments = finished(folder);
    assert!(!segments.is_empty(), "{}", stderr(&output));
    segments
}

#[test]
fn a_camera_is_calibrated_a_drive_recorded_a_map_learned_and_another_drive_localized() {
    let temporary = tempfile::tempdir().expect("a temporary folder");
    let path = |name: &str| temporary.path().join(name);

    let first = drive(&path("first"), "duration_s = 8.0", None);
    let donut = path("donut.json");
    let (code, said, errors) =
        run(omniloc().arg("calibrate").args(&first).arg("--out").arg(&donut).arg("--overlay").arg(path("donut.png")));
    assert!(code == 0 && said.contains("sure"), "{said}{errors}");

    // Several segments, of which the last is shorter.
    let survey = drive(&path("survey"), "duration_s = 24.0", Some(&donut));
    assert!(survey.len() >= 2, "{survey:?}");
    let (map, json) = (path("area.map"), path("errors.json"));
    let (code, said, errors) =
        run(omniloc().arg("train").args(&survey).args(["--grid-step-m", "0.2"]).arg("--out").arg(&map));
    assert!(code == 0, "{said}{errors}");

    // The same way at other speeds.
    let other = drive(&path("other"), "duration_s = 16.0\ndrive_seed = 2", Some(&donut));
    let (code, said, errors) =
        run(omniloc().arg("evaluate").arg(&other[0]).arg("--map").arg(&map).arg("--json").arg(&json));
    assert!(code == 0, "{said}{errors}");
    let evaluated: Value = serde_json::from_slice(&fs::read(&json).expect("readable")).expect("JSON");
    let median_m = evaluated["results"][0]["median_m"].as_f64().expect("a median");
    assert!(median_m < 0.3, "{said}");
}
