//! `omniloc doctor` with simulated devices, and with none.

mod common;

use std::{
    fs,
    path::Path,
    process::{Command, Output},
};

use common::{drive::configure, omniloc_path};
use serde_json::Value;

fn doctor(config: &Path, extra: &[&str]) -> Output {
    Command::new(omniloc_path()).args(["doctor", "--config"]).arg(config).args(extra).output().expect("runs")
}

fn findings(output: &Output) -> Vec<(String, String)> {
    let report: Value = serde_json::from_slice(&output.stdout).expect("JSON");
    let text = |finding: &Value, key: &str| finding[key].as_str().expect("text").to_owned();
    let findings = report["findings"].as_array().expect("a list");
    findings.iter().map(|finding| (text(finding, "check"), text(finding, "verdict"))).collect()
}

#[test]
fn a_vehicle_that_is_well_is_told_so() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let config = configure(folder.path(), "duration_s = 60.0", &[]);
    let output = doctor(&config, &["--json"]);
    assert_eq!(output.status.code(), Some(0), "{output:?}");
    let findings = findings(&output);
    for check in
        ["camera", "frame rate", "receiver", "position", "yaw", "disk writes", "temperature", "clock", "sandbox"]
    {
        let found = findings.iter().find(|(name, _)| name == check);
        assert!(found.is_some_and(|(_, verdict)| verdict != "problem"), "{check}: {findings:?}");
    }
    let verdict = |check: &str| &findings.iter().find(|(name, _)| name == check).expect("looked at").1;
    assert!(["camera", "receiver", "position", "yaw"].iter().all(|check| verdict(check) == "ok"), "{findings:?}");
}

#[test]
fn a_receiver_that_says_nothing_is_a_problem_with_advice() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let config = configure(folder.path(), "duration_s = 60.0", &[("receiver-unplugged", 0.0, 50.0)]);
    let output = doctor(&config, &[]);
    assert_eq!(output.status.code(), Some(1), "{output:?}");
    let said = String::from_utf8(output.stdout).expect("text");
    let problem = said.lines().position(|line| line.starts_with("PROBLEM  receiver")).expect(&said);
    assert!(said.lines().nth(problem + 1).is_some_and(|line| line.contains("-> ")), "{said}");
    assert!(said.ends_with("so this cannot record\n"), "{said}");
}

/// What runs the tests is no Raspberry Pi.
#[test]
fn pins_that_are_asked_for_and_not_there_are_a_problem() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let config = configure(folder.path(), "duration_s = 60.0", &[]);
    let text = fs::read_to_string(&config).expect("readable");
    fs::write(&config, format!("{text}[gpio]\ndriver = \"rppal\"\nrecord_button_pin = 17\n")).expect("writes");
    let output = doctor(&config, &["--json"]);
    assert_eq!(output.status.code(), Some(1), "{output:?}");
    assert!(findings(&output).contains(&("pins".into(), "problem".into())), "{output:?}");
}

#[test]
fn a_map_that_is_missing_is_a_problem() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let config = folder.path().join("localize.toml");
    let text = "[vehicle]\nname = \"car\"\n[camera]\ndriver = \"simulated\"\n[map]\nfile = \"none.map\"\n\
                [simulation]\nplace = \"corridor\"\nwidth_px = 320\nheight_px = 180\nframe_rate_hz = 5.0\n";
    fs::write(&config, text).expect("writes");
    let output = doctor(&config, &["--json"]);
    assert_eq!(output.status.code(), Some(1), "{output:?}");
    assert!(findings(&output).contains(&("map".into(), "problem".into())));

    // Everything else is looked at all the same.
    fs::write(&config, text.replace("name = \"car\"", "name = \"car\"\ncalibration = \"none.json\"")).expect("writes");
    let found = findings(&doctor(&config, &["--json"]));
    for (check, verdict) in [("calibration", "problem"), ("map", "problem"), ("camera", "ok"), ("sandbox", "ok")] {
        let is_there = found.iter().any(|(name, said)| name == check && (said == verdict || check == "sandbox"));
        assert!(is_there, "{check}: {found:?}");
    }

    fs::write(&config, "[vehicle]\nname = 3\n").expect("writes");
    assert_eq!(doctor(&config, &[]).status.code(), Some(2));
}
