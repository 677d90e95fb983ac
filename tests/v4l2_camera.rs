//! The V4L2 camera against a camera that a library under LD_PRELOAD plays: `tests/v4l2_shim/shim.c`.
//!
//! The library must be loaded before the program starts, so that each test runs this test program again with it, for
//! the one test [`capture`], which writes down what the camera emits.

#![cfg(feature = "vehicle")]

mod common;

use std::{
    cell::RefCell,
    fs,
    io::Write,
    path::PathBuf,
    process::{Child, Command, Stdio},
    time::{Duration, Instant},
};

use common::shim;
use omniloc::{
    devices::{
        CameraEvent, DeviceError, Stop,
        camera_v4l2::{self, Settings},
    },
    jpeg::{LumaDecoder, scan},
    types::SystemClock,
};
use serde::{Deserialize, Serialize};
use tempfile::TempDir;

/// What the captured events are written down as.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
enum Seen {
    Opened { name: String, width_px: u32, height_px: u32, frame_rate_hz: f64, pixel_format: String },
    Frame { sequence: u32, stamp_ns: u64, arrival_ns: u64, damage: Option<String>, size_px: Option<(usize, usize)> },
    Lost { count: u64, reason: String },
    Ended { health: String, message: String },
}

/// What [`capture`] is to do.
#[derive(Debug, Clone, Serialize, Deserialize)]
struct Job {
    settings: Settings,
    /// Stop after so many frames.
    frames: usize,
    /// How often the camera may end with an error before the job is over; it is opened again after 20 ms.
    endings: usize,
    out: PathBuf,
}

const JOB: &str = "OMNILOC_TEST_CAMERA_JOB";

#[test]
#[ignore = "is run by the other tests, under LD_PRELOAD"]
fn capture() {
    let job: Job = serde_json::from_str(&std::env::var(JOB).expect("a job")).expect("parses");
    let out = RefCell::new(fs::File::create(&job.out).expect("a file"));
    let write = |seen: &Seen| {
        let line = serde_json::to_string(seen).expect("serializes") + "\n";
        out.borrow_mut().write_all(line.as_bytes()).expect("writes");
    };
    let stop = Stop::default();
    let (mut frames, mut decoder) = (0, LumaDecoder::new());
    for _ in 0..job.endings {
        let ended = camera_v4l2::run(&job.settings, &SystemClock, &stop, &mut |event| match event {
            CameraEvent::Opened(facts) => write(&Seen::Opened {
                name: facts.name,
                width_px: facts.width_px,
                height_px: facts.height_px,
                frame_rate_hz: facts.frame_rate_hz,
                pixel_format: facts.pixel_format,
            }),
            CameraEvent::Lost(lost) => write(&Seen::Lost { count: lost.count, reason: lost.reason.into() }),
            CameraEvent::Frame(frame) => {
                let whole = scan(&frame.jpeg).is_ok_and(|info| info.has_huffman_tables);
                let luma = decoder.decode(&frame.jpeg).ok().filter(|_| whole);
                write(&Seen::Frame {
                    sequence: frame.sequence,
                    stamp_ns: frame.stamp_ns,
                    arrival_ns: frame.arrival_ns,
                    damage: frame.damage.map(Into::into),
                    size_px: luma.map(|luma| (luma.width_px, luma.height_px)),
                });
                frames += 1;
                if frames == job.frames {
                    stop.stop();
                }
            }
        });
        let (health, message) = match &ended {
            Ok(()) => ("ok", String::new()),
            Err(error) => (error.health(), describe(error)),
        };
        write(&Seen::Ended { health: health.into(), message });
        if ended.is_ok() {
            break;
        }
        std::thread::sleep(Duration::from_millis(20));
    }
}

fn describe(error: &DeviceError) -> String {
    let source = std::error::Error::source(error).map(|source| format!(": {source}")).unwrap_or_default();
    format!("{error}{source}")
}

struct Camera {
    folder: TempDir,
    job: Job,
    environment: Vec<(&'static str, String)>,
}

impl Camera {
    fn new(settings: &str, faults: &str) -> Self {
        let folder = TempDir::new().expect("a temporary folder");
        let device = folder.path().join("video7");
        let settings = format!("device = '{}'\nframe_timeout_ms = 5000\n{settings}", device.display());
        let data = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/data");
        let frames = ["drive/images/0005", "drive/images/0100", "corridor/images/0100"];
        let environment = vec![
            ("SHIM_DEVICE", device.display().to_string()),
            ("SHIM_FRAMES", frames.map(|name| format!("{data}/{name}.jpg")).join(":")),
            ("SHIM_RATE_HZ", "60".into()),
            ("SHIM_LOG", folder.path().join("log").display().to_string()),
            ("SHIM_FAULTS", faults.into()),
        ];
        let out = folder.path().join("seen");
        let settings = toml::from_str(&settings).expect("settings parse");
        Self { job: Job { settings, frames: 12, endings: 1, out }, folder, environment }
    }

    fn start(&self) -> Child {
        let mut command = Command::new(std::env::current_exe().expect("this program"));
        command.args(["--exact", "capture", "--ignored", "--nocapture"]);
        command.env("LD_PRELOAD", shim("v4l2_shim")).env(JOB, serde_json::to_string(&self.job).expect("serializes"));
        command.envs(self.environment.iter().cloned()).stdout(Stdio::null()).stdin(Stdio::null());
        command.spawn().expect("starts")
    }

    fn run(&self) -> Vec<Seen> {
        let status = self.start().wait().expect("ends");
        assert!(status.success(), "{status}");
        self.seen()
    }

    fn seen(&self) -> Vec<Seen> {
        let text = fs::read_to_string(&self.job.out).unwrap_or_default();
        text.lines().map(|line| serde_json::from_str(line).expect("a whole line")).collect()
    }

    fn log(&self) -> String {
        fs::read_to_string(self.folder.path().join("log")).unwrap_or_default()
    }

    /// Nothing against the rules of V4L2, and nothing left behind.
    fn assert_clean(&self) {
        let log = self.log();
        for wrong in ["while mapped", "driver owns", "opened without", "queued"] {
            assert!(!log.contains(wrong), "{log}");
        }
        let closed = log.lines().filter(|line| *line == "close: streaming 0, mapped 0").count();
        assert_eq!(closed, log.lines().filter(|line| line.starts_with("close")).count(), "{log}");
        assert_eq!(closed, log.lines().filter(|line| *line == "open").count(), "{log}");
    }
}

const HD: &str = "width_px = 1280\nheight_px = 720\nframe_rate_hz = 30\n";

fn damage(seen: &[Seen]) -> Vec<(u32, Option<&str>)> {
    let frames = seen.iter().filter_map(|seen| match seen {
        Seen::Frame { sequence, damage, .. } => Some((*sequence, damage.as_deref())),
        _ => None,
    });
    frames.collect()
}

fn lost(seen: &[Seen]) -> Vec<(u64, &str)> {
    let lost = seen.iter().filter_map(|seen| match seen {
        Seen::Lost { count, reason } => Some((*count, reason.as_str())),
        _ => None,
    });
    lost.collect()
}

fn endings(seen: &[Seen]) -> Vec<&str> {
    let endings = seen.iter().filter_map(|seen| match seen {
        Seen::Ended { health, .. } => Some(health.as_str()),
        _ => None,
    });
    endings.collect()
}

#[test]
fn frames_arrive_whole_in_order_and_stamped_with_the_exposure() {
    let camera = Camera::new(&format!("{HD}power_line_hz = 50"), "no_dht padding@3 stray@4");
    let seen = camera.run();
    match &seen[0] {
        Seen::Opened { name, width_px: 1280, height_px: 720, frame_rate_hz: 30.0, pixel_format } => {
            assert_eq!((name.as_str(), pixel_format.as_str()), ("Cam\u{FFFD}ra simul\u{FFFD}e", "MJPG"));
        }
        other => panic!("{other:?}"),
    }
    assert_eq!(damage(&seen), (0..12).map(|sequence| (sequence, None)).collect::<Vec<_>>());
    for seen in &seen {
        if let Seen::Frame { stamp_ns, arrival_ns, size_px, .. } = seen {
            assert_eq!(*size_px, Some((1280, 720)), "opens, tables and all");
            // The library stamps 30 ms before it hands a frame over.
            assert!((29_999_000..1_000_000_000).contains(&(arrival_ns - stamp_ns)), "{arrival_ns} {stamp_ns}");
        }
    }
    assert_eq!((lost(&seen), endings(&seen)), (vec![], vec!["ok"]));
    camera.assert_clean();
    let log = camera.log();
    for step in ["control 980918 1", "control 9a0903 0", "reqbufs 6", "streamon", "streamoff", "reqbufs 0"] {
        assert!(log.lines().any(|line| line == step), "{step}: {log}");
    }
}

#[test]
fn what_is_damaged_or_missing_is_told() {
    let camera = Camera::new(HD, "garbage@0 error@2 truncate@4 empty@5 gap@6 eio@8 past@9 future@10");
    let seen = camera.run();
    let expected = [
        (0, Some("no start marker")),
        (1, None),
        (2, Some("marked damaged by the driver")),
        (3, None),
        (4, Some("no end marker")),
        (9, None),
        (10, None),
        (12, None),
        (13, None),
        (14, None),
        (15, None),
        (16, None),
    ];
    assert_eq!(damage(&seen), expected);
    assert_eq!(lost(&seen), [(1, "empty frame"), (3, "skipped by the camera"), (1, "read error")]);
    let mut last_ns = 0;
    for seen in &seen {
        if let Seen::Frame { stamp_ns, arrival_ns, .. } = seen {
            assert!(*stamp_ns > last_ns);
            last_ns = *stamp_ns;
            // Also those of frames 12 and 13, whose stamps are 100 s off.
            assert!((29_000_000..1_000_000_000).contains(&(arrival_ns - stamp_ns)), "{arrival_ns} {stamp_ns}");
        }
    }
    assert_eq!(endings(&seen), ["ok"]);
    camera.assert_clean();
}

#[test]
fn a_stalled_camera_is_silent() {
    let mut camera = Camera::new(HD, "stall@3");
    camera.job.settings.frame_timeout_ms = 300;
    let seen = camera.run();
    assert_eq!(damage(&seen).len(), 3);
    assert_eq!(endings(&seen), ["silent"]);
    camera.assert_clean();
}

#[test]
fn an_unplugged_camera_is_captured_again_when_it_is_back() {
    let mut camera = Camera::new(HD, "unplug@4");
    camera.environment.push(("SHIM_REPLUG_MS", "200".into()));
    camera.job.endings = 1000;
    let seen = camera.run();
    let endings = endings(&seen);
    assert_eq!((endings[0], endings[endings.len() - 1]), ("disconnected", "ok"));
    assert!(endings.len() > 2 && endings[1..endings.len() - 1].iter().all(|&health| health == "not present"));
    assert_eq!(damage(&seen).len(), 12);
    assert_eq!(seen.iter().filter(|seen| matches!(seen, Seen::Opened { .. })).count(), 2);
    camera.assert_clean();
}

#[test]
fn a_second_program_is_told_that_the_camera_is_busy() {
    let mut first = Camera::new(HD, "");
    let lock = first.folder.path().join("lock").display().to_string();
    first.environment.push(("SHIM_LOCK", lock.clone()));
    first.job.frames = usize::MAX;
    let mut holder = first.start();
    let patience = Instant::now();
    while !first.seen().iter().any(|seen| matches!(seen, Seen::Frame { .. })) {
        assert!(patience.elapsed() < Duration::from_secs(30), "the first program gets no frames");
        std::thread::sleep(Duration::from_millis(20));
    }
    let mut second = Camera::new(HD, "");
    second.environment.push(("SHIM_LOCK", lock));
    let seen = second.run();
    holder.kill().expect("is running");
    holder.wait().expect("ends");
    assert_eq!(endings(&seen), ["busy"]);
    second.assert_clean();
    assert_eq!(endings(&second.run()), ["ok"], "free when its owner is gone");
}

#[test]
fn what_cannot_work_is_refused_with_what_can() {
    let table = [
        ("", "", Some("2"), "not present", "is not there"),
        ("", "", Some("13"), "not permitted", "usermod -aG video"),
        ("", "", Some("1"), "not permitted", "DeviceAllow="),
        ("", "", Some("16"), "busy", "another program"),
        ("metadata_node", "", None, "unsupported", "-video-index0"),
        ("no_streaming", "", None, "unsupported", "streaming"),
        ("no_bandwidth", "", None, "unsupported", "another USB port"),
        (
            "no_mjpg",
            "pixel_format = 'mjpg'",
            None,
            "unsupported",
            "asked for MJPG 1280x720, it gives YUYV; it offers YUYV 640x480 1280x720",
        ),
        ("small", "", None, "unsupported", "it gives 640 x 480; it offers YUYV 640x480; MJPG 640x480"),
    ];
    for (fault, settings, open_errno, health, expected) in table {
        let mut camera = Camera::new(&format!("{HD}{settings}"), fault);
        camera.environment.extend(open_errno.map(|errno| ("SHIM_OPEN_ERRNO", errno.to_owned())));
        match camera.run().as_slice() {
            [Seen::Ended { health: found, message }] => {
                assert_eq!(found, health, "{fault}: {message}");
                assert!(message.contains(expected), "{fault}: {message}");
            }
            other => panic!("{fault}: {other:?}"),
        }
        camera.assert_clean();
    }
}

#[test]
fn raw_frames_of_a_camera_without_mjpg_become_jpeg() {
    let mut camera = Camera::new(
        "width_px = 640\nheight_px = 480\nframe_rate_hz = 7.5\npixel_format = 'auto'",
        "no_mjpg truncate@2",
    );
    camera.job.frames = 5;
    let seen = camera.run();
    match &seen[0] {
        Seen::Opened { pixel_format, frame_rate_hz: 7.5, .. } => assert_eq!(pixel_format, "YUYV"),
        other => panic!("{other:?}"),
    }
    assert_eq!(damage(&seen), [(0, None), (1, None), (2, Some("incomplete image")), (3, None), (4, None)]);
    let sizes = seen.iter().filter(|seen| matches!(seen, Seen::Frame { size_px: Some((640, 480)), .. })).count();
    assert_eq!(sizes, 5);
    camera.assert_clean();
}

#[test]
fn another_clock_rate_or_size_is_lived_with() {
    let mut camera = Camera::new(&format!("{HD}accept_other_size = true"), "realtime end_of_frame refuse_rate small");
    camera.job.frames = 3;
    let seen = camera.run();
    assert!(
        matches!(seen[0], Seen::Opened { frame_rate_hz: 10.0, width_px: 640, height_px: 480, .. }),
        "{:?}",
        seen[0]
    );
    // The library sends its large pictures all the same.
    assert!(damage(&seen).iter().all(|(_, damage)| *damage == Some("wrong image size")), "{seen:?}");
    for seen in &seen {
        if let Seen::Frame { stamp_ns, arrival_ns, .. } = seen {
            assert_eq!(stamp_ns, arrival_ns, "the driver's clock is another one");
        }
    }
    camera.assert_clean();
}

#[test]
fn a_file_that_is_no_camera_is_refused() {
    let settings: Settings = toml::from_str(&format!("device = '/dev/null'\n{HD}")).expect("parses");
    let error = camera_v4l2::run(&settings, &SystemClock, &Stop::default(), &mut |_| {}).expect_err("no camera");
    assert!(error.to_string().contains("no video device"), "{error}");
}
