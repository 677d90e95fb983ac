//! `omniloc record` and `replay` as a whole: simulated devices, real tasks, and what goes wrong.

mod common;

use std::{
    collections::BTreeMap,
    fs,
    path::{Path, PathBuf},
    process::{Child, Command, Output, Stdio},
    thread,
    time::{Duration, Instant},
};

use common::{
    drive::{PATIENCE, configure, finished, health, messages, start, stderr, wait},
    omniloc_path,
};
use omniloc::{
    recording::{DeviceRecords, Recording, proto::omniloc as proto, topics},
    types::NS_PER_S,
};
use rustix::process::{Pid, Signal, kill_process};

/// A drive long enough for a fault in its middle, small enough for a busy computer.
const DURATION_S: f64 = 14.0;
struct Drive {
    folder: tempfile::TempDir,
    output: Output,
    path: PathBuf,
    first_ns: u64,
    statuses: Vec<(u64, proto::Status)>,
    pairs: Vec<(u64, proto::SurveyPair)>,
    /// Reason → count, per topic.
    dropped: BTreeMap<(String, String), u64>,
}

impl Drive {
    fn record(simulation: &str, faults: &[(&str, f64, f64)]) -> Self {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let config = configure(folder.path(), simulation, faults);
        let output = wait(start(&config));
        let paths = finished(folder.path());
        assert_eq!(paths.len(), 1, "{}", stderr(&output));
        let path = paths[0].clone();
        let mut dropped = BTreeMap::new();
        for (_, loss) in messages::<proto::Dropped>(&path, &topics::DROPPED) {
            *dropped.entry((loss.topic, loss.reason)).or_default() += loss.count;
        }
        let pairs = messages(&path, &topics::SURVEY_PAIR);
        // The simulated drive begins half a second after the clocks, which start at 100 s.
        let first_ns = 100 * NS_PER_S + NS_PER_S / 2;
        Self { folder, output, first_ns, statuses: messages(&path, &topics::STATUS), pairs, dropped, path }
    }

    fn valid_between(&self, from_s: f64, to_s: f64) -> (usize, usize) {
        let within = self.pairs.iter().filter(|(stamp_ns, _)| {
            let time_s = (*stamp_ns as f64 - self.first_ns as f64) * 1e-9;
            (from_s..to_s).contains(&time_s)
        });
        let valid: Vec<bool> = within.map(|(_, pair)| pair.valid).collect();
        (valid.iter().filter(|valid| **valid).count(), valid.len())
    }

    fn lost(&self, topic: &topics::Topic, reason: &str) -> u64 {
        self.dropped.get(&(topic.name.to_owned(), reason.to_owned())).copied().unwrap_or(0)
    }
}

/// What a fault from 4 s to 9 s of a drive of 14 s must leave in the recording.
struct Expected {
    kind: &'static str,
    camera: &'static str,
    gnss: &'static str,
    /// Usable pairs in the middle of the fault: none, all, or it does not matter.
    pairs_meanwhile: Option<bool>,
    /// Frames come meanwhile.
    frames_meanwhile: bool,
}

const FAULTS: [Expected; 9] = [
    Expected {
        kind: "camera-unplugged",
        camera: "not present",
        gnss: "ok",
        pairs_meanwhile: None,
        frames_meanwhile: false,
    },
    Expected { kind: "camera-stalled", camera: "silent", gnss: "ok", pairs_meanwhile: None, frames_meanwhile: false },
    Expected { kind: "frames-damaged", camera: "ok", gnss: "ok", pairs_meanwhile: Some(false), frames_meanwhile: true },
    Expected {
        kind: "receiver-unplugged",
        camera: "ok",
        gnss: "not present",
        pairs_meanwhile: Some(false),
        frames_meanwhile: true,
    },
    Expected {
        kind: "receiver-silent",
        camera: "ok",
        gnss: "silent",
        pairs_meanwhile: Some(false),
        frames_meanwhile: true,
    },
    Expected {
        kind: "receiver-garbage",
        camera: "ok",
        gnss: "unreadable",
        pairs_meanwhile: Some(false),
        frames_meanwhile: true,
    },
    Expected {
        kind: "receiver-wrong-baud",
        camera: "ok",
        gnss: "unreadable",
        pairs_meanwhile: Some(false),
        frames_meanwhile: true,
    },
    Expected { kind: "tunnel", camera: "ok", gnss: "no fix", pairs_meanwhile: Some(false), frames_meanwhile: true },
    Expected { kind: "date-set", camera: "ok", gnss: "ok", pairs_meanwhile: Some(true), frames_meanwhile: true },
];

#[test]
fn each_fault_is_reported_and_recording_goes_on() {
    let check = |expected: &Expected| {
        let Expected { kind, camera, gnss, pairs_meanwhile, frames_meanwhile } = *expected;
        let drive = Drive::record(&format!("duration_s = {DURATION_S}"), &[(kind, 4.0, 5.0)]);
        let said = || format!("{kind}: {}", stderr(&drive.output));
        assert!(health(&drive.statuses, |status| &status.camera_health).contains(camera), "{}", said());
        assert!(health(&drive.statuses, |status| &status.gnss_health).contains(gnss), "{}", said());
        assert!(health(&drive.statuses, |status| &status.disk_health).iter().all(|word| word == "ok"), "{}", said());

        // Some 15 each; a busy computer may lose many, but not nearly all.
        let (before, _) = drive.valid_between(1.0, 3.5);
        let (meanwhile, frames) = drive.valid_between(5.5, 8.5);
        let (after, _) = drive.valid_between(11.0, DURATION_S);
        assert!(before >= 3 && after >= 3, "{before} {after} {}", said());
        match pairs_meanwhile {
            Some(true) => assert!(meanwhile >= 4, "{meanwhile} {}", said()),
            Some(false) => assert_eq!(meanwhile, 0, "{}", said()),
            None => {}
        }
        assert_eq!(frames > 0, frames_meanwhile, "{frames} {}", said());
        if kind == "frames-damaged" {
            assert!(drive.lost(&topics::CAMERA_IMAGE, "no end marker") >= 7, "{:?}", drive.dropped);
        }
        assert_eq!(omniloc::recording::verify(&drive.path).expect("readable").problems, Vec::<String>::new());
    };
    thread::scope(|scope| FAULTS.iter().map(|expected| scope.spawn(move || check(expected))).for_each(drop));
}

#[test]
fn a_jump_of_the_position_is_refused_and_said() {
    let drive = Drive::record(&format!("duration_s = {DURATION_S}"), &[("position-jump", 6.0, 0.5)]);
    let refused: u64 =
        drive.dropped.iter().filter(|((topic, _), _)| *topic == topics::GNSS_FIX.name).map(|(_, count)| count).sum();
    assert!(refused >= 2, "{:?} {}", drive.dropped, stderr(&drive.output));
    let furthest_m = drive.pairs.iter().filter(|(_, pair)| pair.valid).map(|(_, pair)| pair.east_m.abs());
    assert!(furthest_m.fold(0.0, f64::max) < 50.0, "no pair is 300 m away");
}

/// The time by which a position is off, from the way driven: its error along the way, divided by the speed \[s\].
fn time_errors_s(drive: &Drive, simulation: &omniloc::devices::simulated::Simulation) -> Vec<f64> {
    let moving = drive.pairs.iter().filter(|(_, pair)| pair.valid).filter_map(|(stamp_ns, pair)| {
        let truth = simulation.pose_at(*stamp_ns);
        let error_m = [pair.east_m - truth.position_m[0], pair.north_m - truth.position_m[1]];
        let (sin, cos) = truth.yaw_rad.sin_cos();
        (truth.speed_mps > 4.0).then(|| (error_m[0] * cos + error_m[1] * sin) / truth.speed_mps)
    });
    moving.collect()
}

fn rms(values: &[f64]) -> f64 {
    (values.iter().map(|value| value * value).sum::<f64>() / values.len() as f64).sqrt()
}

/// A drive round a block behind a line that is 300 ms late, with jitter, and how far off in time its pairs are \[s\].
fn late_drive() -> (Drive, Vec<f64>) {
    let receiver = "[simulation.receiver]\nrate_hz = 100.0\nlatency_s = 0.3\njitter_s = 0.04\nposition_std_m = 0.0";
    let settings = format!("duration_s = 30.0\nplace_seed = 3\n{receiver}");
    let folder = tempfile::tempdir().expect("a temporary folder");
    let config = configure(folder.path(), &settings, &[]);
    let text = fs::read_to_string(&config).expect("readable").replace("\"corridor\"", "\"town\"");
    fs::write(&config, text).expect("writes");
    let loaded = omniloc::config::RecordConfig::load(&config).expect("loads");
    let (simulation, world) = omniloc::runtime::drive::simulate(&loaded.simulation.expect("simulated"));
    let output = wait(start(&config));
    let path = finished(folder.path()).remove(0);
    let mut drive = Drive {
        output,
        first_ns: 0,
        statuses: messages(&path, &topics::STATUS),
        pairs: messages(&path, &topics::SURVEY_PAIR),
        dropped: BTreeMap::new(),
        folder,
        path,
    };
    // Positions count from the first fix, the truth from the middle of the world.
    let origin = Recording::open_any(&drive.path).expect("sound").origin.expect("an origin");
    let offset_m = omniloc::types::LocalFrame::new(world.origin).to_enu_m(origin);
    for (_, pair) in &mut drive.pairs {
        pair.east_m += offset_m[0];
        pair.north_m += offset_m[1];
    }
    let errors_s = time_errors_s(&drive, &simulation);
    (drive, errors_s)
}

/// The pulse shows the latency. On a busy computer the jitter is larger.
#[test]
fn pairs_are_right_to_20_ms_behind_a_line_that_is_300_ms_late() {
    let (drive, errors_s) = late_drive();
    // The first seconds have no pulse yet.
    assert!(errors_s.len() > 40, "{} {}", errors_s.len(), stderr(&drive.output));
    let settled = &errors_s[errors_s.len() / 4..];
    assert!(rms(settled) < 0.020, "{:.4} s RMS", rms(settled));
    let stated: Vec<f64> = drive.pairs.iter().rev().take(60).filter_map(|(_, pair)| pair.time_std_s).collect();
    assert!(rms(&stated) < 0.020, "stated {:.4} s", rms(&stated));
    let latency_s = drive.pairs.last().and_then(|(_, pair)| pair.serial_latency_s).expect("an estimate");
    assert!((0.29..0.33).contains(&latency_s), "{latency_s}");
}

#[test]
fn sigterm_ends_cleanly_and_what_sigkill_leaves_is_mended_at_the_next_start() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let config = configure(folder.path(), "duration_s = 600.0", &[]);
    let part = |folder: &Path| {
        let entries = fs::read_dir(folder.join("recordings")).map(|entries| {
            let bytes = entries.flatten().filter(|entry| entry.path().extension().is_some_and(|e| e == "part"));
            bytes.map(|entry| entry.metadata().map_or(0, |facts| facts.len())).sum::<u64>()
        });
        entries.unwrap_or(0)
    };
    let wait_for_data = |child: &mut Child| {
        let started = Instant::now();
        while part(folder.path()) < 100_000 && started.elapsed() < PATIENCE {
            assert!(child.try_wait().expect("waits").is_none(), "it goes on");
            thread::sleep(Duration::from_millis(50));
        }
    };
    let mut killed = start(&config);
    wait_for_data(&mut killed);
    killed.kill().expect("kills");
    killed.wait().expect("ends");
    assert_eq!(finished(folder.path()).len(), 0);

    let mut terminated = start(&config);
    let started = Instant::now();
    while finished(folder.path()).is_empty() && started.elapsed() < PATIENCE {
        thread::sleep(Duration::from_millis(50));
    }
    wait_for_data(&mut terminated);
    kill_process(Pid::from_child(&terminated), Signal::USR1).expect("marks");
    thread::sleep(Duration::from_millis(1500));
    kill_process(Pid::from_child(&terminated), Signal::TERM).expect("asks to end");
    let output = wait(terminated);
    assert!(matches!(output.status.code(), Some(0 | 3)), "{:?} {}", output.status, stderr(&output));
    let paths = finished(folder.path());
    assert_eq!((paths.len(), part(folder.path())), (2, 0), "{}", stderr(&output));
    for path in &paths {
        let verdict = omniloc::recording::verify(path).expect("readable");
        assert!(verdict.is_complete && verdict.problems.is_empty(), "{:?}", verdict.problems);
        assert!(verdict.images >= 3, "{}", verdict.images);
    }
    let names = common::names(&folder.path().join("recordings"));
    assert!(names.iter().any(|name| name.ends_with(".keep")), "marked: {names:?}");
}

#[test]
fn a_replay_makes_the_same_bytes_every_time_and_through_the_drivers_the_same_pairs() {
    let drive = Drive::record(&format!("duration_s = {DURATION_S}"), &[("camera-unplugged", 5.0, 2.0)]);
    let out = |name: &str| drive.folder.path().join(name);
    let replay = |name: &str, speed: &str| {
        let mut command = Command::new(omniloc_path());
        command.args(["replay", "--mode", "record", "--speed", speed, "--out"]).arg(out(name)).arg(&drive.path);
        command.stdout(Stdio::piped()).stderr(Stdio::piped());
        let output = wait(command.spawn().expect("starts"));
        assert!(matches!(output.status.code(), Some(0 | 3)), "{}", stderr(&output));
    };
    replay("a.mcap", "max");
    replay("b.mcap", "max");
    assert!(fs::read(out("a.mcap")).expect("readable") == fs::read(out("b.mcap")).expect("readable"));
    let again = messages::<proto::SurveyPair>(&out("a.mcap"), &topics::SURVEY_PAIR);
    assert_eq!(again.len(), drive.pairs.len());
    let valid = |pairs: &[(u64, proto::SurveyPair)]| pairs.iter().filter(|(_, pair)| pair.valid).count();
    assert!(valid(&again).abs_diff(valid(&drive.pairs)) <= 3, "{} {}", valid(&again), valid(&drive.pairs));
    for ((_, again), (_, first)) in again.iter().zip(&drive.pairs).filter(|((_, a), (_, b))| a.valid && b.valid) {
        let apart_m = (again.east_m - first.east_m).hypot(again.north_m - first.north_m);
        assert!(apart_m < 0.1, "{apart_m} m at frame {}", first.frame_sequence);
    }
    let images = |path: &Path| {
        let records = DeviceRecords::open(path).expect("opens").map(|record| record.expect("sound"));
        let is_image = |record: &_| matches!(record, omniloc::recording::DeviceRecord::Image { .. });
        records.filter(|timed| is_image(&timed.record)).collect::<Vec<_>>()
    };
    assert_eq!(images(&out("a.mcap")), images(&drive.path), "frames with their stamps");

    replay("live", "4");
    let live = fs::read_dir(out("live")).expect("readable").next().expect("a segment").expect("entry").path();
    let pairs = messages::<proto::SurveyPair>(&live, &topics::SURVEY_PAIR);
    assert!(valid(&pairs) * 10 >= valid(&drive.pairs) * 7, "{} of {}", valid(&pairs), valid(&drive.pairs));
}

#[test]
fn a_drive_reads_with_the_public_python_packages() {
    let Some(python) = common::python() else { return };
    let drive = Drive::record("duration_s = 6.0\n[simulation.receiver]\nprotocol = \"xbus\"", &[]);
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/python/read_drive.py");
    let output = Command::new(&python).arg(script).arg(&drive.path).output();
    let output = output.unwrap_or_else(|error| panic!("OMNILOC_PYTHON={python} does not start: {error}"));
    assert!(output.status.success(), "{}", stderr(&output));
    let (valid, frames) = drive.valid_between(0.0, 6.0);
    assert_eq!(String::from_utf8_lossy(&output.stdout).trim(), format!("{frames} frames, {valid} usable"));
    assert!(valid > 10, "{valid} of {frames}: MTData2 packets are understood");
}

#[test]
fn a_wrong_configuration_is_the_callers_mistake() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let config = configure(folder.path(), "duration_s = 600.0", &[("meteor", 1.0, 1.0)]);
    let output = wait(start(&config));
    assert_eq!(output.status.code(), Some(2));
    assert!(stderr(&output).contains("drive.toml:"), "{}", stderr(&output));
    assert!(!folder.path().join("recordings").exists(), "nothing was begun");

    let config = configure(folder.path(), "duration_s = 600.0", &[]);
    let text = fs::read_to_string(&config).expect("readable");
    fs::write(&config, text.replace("\"test car\"", "\"test car\"\ncalibration = \"none.json\"")).expect("writes");
    let output = wait(start(&config));
    assert!(output.status.code() == Some(2) && stderr(&output).contains("none.json"), "{}", stderr(&output));

    let mut check = common::omniloc();
    let config = configure(folder.path(), "duration_s = 600.0", &[]);
    let (code, resolved, _) = common::run(check.arg("record").arg("--check").arg("--config").arg(&config));
    assert_eq!(code, 0);
    assert!(resolved.contains("max_gap_s = 0.6"), "{resolved}");
}
