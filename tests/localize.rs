//! `omniloc localize` and `replay --mode localize` as a whole: a map, a camera, and what goes wrong.

mod common;

use std::{
    fs,
    io::{BufRead, BufReader},
    net::TcpStream,
    path::{Path, PathBuf},
    process::{Command, Output, Stdio},
    thread,
    time::Duration,
};

use common::{
    drive::{command as record, configure, finished, messages, stderr, wait},
    map::{SEED, map},
    omniloc_path,
};
use omniloc::recording::{proto::omniloc as proto, topics};
use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;

/// A recorded drive through the same corridor.
fn drive(folder: &Path) -> PathBuf {
    let config = configure(folder, &format!("place_seed = {SEED}\nduration_s = 12.0"), &[]);
    let output = wait(record(&config).spawn().expect("starts"));
    finished(folder).first().unwrap_or_else(|| panic!("{}", stderr(&output))).clone()
}

fn replaying(recording: &Path, extra: &[&str]) -> Command {
    let mut command = Command::new(omniloc_path());
    command.args(["replay", "--mode", "localize", "--map"]).arg(map()).arg(recording).args(extra);
    command
}

fn replay(recording: &Path, extra: &[&str]) -> Output {
    replaying(recording, extra).output().expect("runs")
}

fn lines(output: &Output) -> Vec<Value> {
    let text = String::from_utf8(output.stdout.clone()).expect("text");
    text.lines().map(|line| serde_json::from_str(line).unwrap_or_else(|error| panic!("{line}: {error}"))).collect()
}

#[test]
fn a_replay_says_where_the_vehicle_was_and_the_same_every_time() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let recording = drive(folder.path());
    let out = folder.path().join("estimates.mcap");
    let first = replay(&recording, &["--timings", "--out", &out.to_string_lossy()]);
    assert!(first.status.success(), "{}", stderr(&first));
    assert!(stderr(&first).contains("describe"), "{}", stderr(&first));
    let found = lines(&first);
    let localized: Vec<&Value> = found.iter().filter(|line| line["state"] == "localized").collect();
    assert!(2 * localized.len() > found.len(), "{} of {}", localized.len(), found.len());
    for line in &found {
        assert_eq!(line["e_m"].is_number(), line["state"] == "localized", "{line}");
    }
    // The corridor measures 7 m by 2.7 m.
    for line in localized {
        let (e_m, n_m) = (line["e_m"].as_f64().expect("a number"), line["n_m"].as_f64().expect("a number"));
        assert!((-0.5..7.5).contains(&e_m) && (-0.5..3.2).contains(&n_m), "{line}");
    }

    let recorded = messages::<proto::PositionEstimate>(&out, &topics::POSE_ESTIMATE);
    assert_eq!(recorded.len(), found.len());
    let recorded_bytes = fs::read(&out).expect("readable");
    let again = replay(&recording, &["--force", "--out", &out.to_string_lossy()]);
    assert_eq!(again.stdout, first.stdout);
    assert_eq!(fs::read(&out).expect("readable"), recorded_bytes);

    // Nobody reads: without a file there is nothing left to do, with one it is written all the same.
    let unread = |extra: &[&str]| {
        let mut child = replaying(&recording, extra).stdout(Stdio::piped()).spawn().expect("starts");
        drop(child.stdout.take());
        assert!(child.wait().expect("ends").success());
    };
    unread(&[]);
    unread(&["--force", "--out", &out.to_string_lossy()]);
    assert_eq!(fs::read(&out).expect("readable"), recorded_bytes);
}

/// Writes a configuration for a simulated camera in the map's corridor.
fn localize_config(folder: &Path, simulation: &str, faults: &[(&str, f64, f64)], map: &Path, outputs: &str) -> PathBuf {
    let mut toml = format!(
        "[vehicle]\nname = \"test car\"\n[camera]\ndriver = \"simulated\"\n[map]\nfile = '{}'\n{outputs}\n[simulation]\n\
         place = \"corridor\"\nplace_seed = {SEED}\nwidth_px = 320\nheight_px = 180\nframe_rate_hz = 5.0\n{simulation}\n",
        map.display()
    );
    for (kind, at_s, lasts_s) in faults {
        toml += &format!("[[simulation.faults]]\nkind = \"{kind}\"\nat_s = {at_s:.1}\nlasts_s = {lasts_s:.1}\n");
    }
    let path = folder.join("localize.toml");
    fs::write(&path, toml).expect("writes");
    path
}

fn localize(config: &Path) -> Command {
    let mut command = Command::new(omniloc_path());
    command.arg("localize").arg("--config").arg(config).stdout(Stdio::piped()).stderr(Stdio::piped());
    command
}

/// Frames that a simulated drive of 12 s has, at 5 Hz.
const FRAMES: usize = 60;

#[test]
fn every_fault_of_the_camera_passes() {
    for (kind, unusable) in [("camera-unplugged", 0), ("camera-stalled", 0), ("frames-damaged", 12)] {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let faults = [(kind, 5.0, 3.0)];
        let config = localize_config(folder.path(), "duration_s = 12.0", &faults, &map(), "[outputs.stdout]");
        let output = wait(localize(&config).spawn().expect("starts"));
        assert!(output.status.success(), "{kind}: {}", stderr(&output));
        let found = lines(&output);
        let bad = found.iter().filter(|line| line["warnings"].to_string().contains("bad frame")).count();
        assert!(bad >= unusable, "{kind}: {bad} bad frames");
        assert!(found.len() <= FRAMES && found.len() >= FRAMES / 3, "{kind}: {}", found.len());
        let last = found.last().expect("frames");
        assert_eq!(last["state"], "localized", "{kind}: {last}\n{}", stderr(&output));
    }
}

#[test]
fn a_map_that_is_changed_while_it_is_used_is_noticed() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let own = folder.path().join("own.map");
    fs::copy(map(), &own).expect("copies");
    let outputs = "[outputs.stdout]\n[[outputs.nmea_tcp]]\nlisten = \"127.0.0.1:18471\"";
    let config = localize_config(folder.path(), "duration_s = 600.0", &[], &own, outputs);
    let child = localize(&config).spawn().expect("starts");
    let pid = Pid::from_child(&child);
    let stream = loop {
        match TcpStream::connect("127.0.0.1:18471") {
            Ok(stream) => break stream,
            Err(_) => thread::sleep(Duration::from_millis(50)),
        }
    };
    let mut sentences = BufReader::new(stream).lines();
    // Quality 6 is estimated: no GPS says that of itself.
    let estimated = |line: &String| line.contains("GGA") && line.split(',').nth(6) == Some("6");
    let position = sentences.by_ref().map(|line| line.expect("a sentence")).find(estimated);
    assert!(position.expect("a position").contains(",N,"));
    fs::write(&own, b"no map any more").expect("writes");
    sentences.by_ref().map(|line| line.expect("a sentence")).filter(estimated).nth(12).expect("goes on");
    fs::remove_file(&own).expect("removes");
    sentences.by_ref().map(|line| line.expect("a sentence")).filter(estimated).nth(12).expect("goes on");
    kill_process(pid, Signal::TERM).expect("runs");
    let output = wait(child);
    assert!(output.status.success(), "{}", stderr(&output));
    let log = stderr(&output);
    assert!(log.contains("file was changed") && log.contains("file is gone") && log.contains("SIGTERM"), "{log}");
}

#[test]
fn what_cannot_be_localized_with_is_refused_in_words() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let run = |map: &Path, simulation: &str| {
        let config = localize_config(folder.path(), simulation, &[], map, "[outputs.stdout]");
        let output = wait(localize(&config).spawn().expect("starts"));
        (output.status.code(), stderr(&output))
    };
    let missing = run(&folder.path().join("none.map"), "duration_s = 2.0");
    assert!(missing.0 == Some(2) && missing.1.contains("none.map"), "{missing:?}");

    let cut = folder.path().join("cut.map");
    let bytes = fs::read(map()).expect("readable");
    fs::write(&cut, &bytes[..bytes.len() / 2]).expect("writes");
    let damaged = run(&cut, "duration_s = 2.0");
    assert!(damaged.0 == Some(1) && damaged.1.contains("damaged"), "{damaged:?}");

    // A camera of another size has another donut.
    let config = localize_config(folder.path(), "duration_s = 6.0", &[], &map(), "[outputs.stdout]");
    let text = fs::read_to_string(&config).expect("readable");
    let other = text.replace("width_px = 320\nheight_px = 180", "width_px = 640\nheight_px = 360");
    fs::write(&config, other).expect("writes");
    let output = wait(localize(&config).spawn().expect("starts"));
    let log = stderr(&output);
    assert!(output.status.code() == Some(1) && log.contains("another lens"), "{log}");
    assert!(!String::from_utf8_lossy(&output.stdout).contains("\"localized\""));
}
