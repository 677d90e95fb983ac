//! Outputs as a whole: against the real gpsd, a serial line that is unplugged, and a producer that must not wait.

use std::{
    alloc::{GlobalAlloc, Layout, System},
    cell::Cell,
    fs::File,
    io::{BufRead, BufReader, Read},
    net::{SocketAddr, TcpListener, TcpStream},
    os::fd::OwnedFd,
    path::{Path, PathBuf},
    process::{Child, Command, Stdio},
    sync::atomic::{AtomicU8, Ordering},
    thread,
    time::{Duration, Instant},
};

use omniloc::{
    outputs::{Address, OutputError, Outputs, Sentence, SerialSettings, Settings, TcpSettings, UdpSettings},
    types::{
        EstimateWarnings, EstimatedHeading, EstimatedPose, Geodetic, LocalFrame, LocalizationState, NS_PER_S,
        PositionCovariance, PositionEstimate,
    },
};
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use serde_json::Value;

/// Far longer than anything here takes on a busy computer.
const PATIENCE: Duration = Duration::from_secs(60);
const FRAME_NS: u64 = NS_PER_S / 10;
const START_UTC_NS: i64 = 1_795_348_800_000_000_000;
const ORIGIN: Geodetic = Geodetic { latitude_deg: 40.82, longitude_deg: -73.9, altitude_m: 30.0 };
const POSITION_M: [f64; 2] = [-123.456, 78.9];

/// Counts what a thread asks for.
struct CountingAllocator;

thread_local! {
    static ALLOCATIONS: Cell<u64> = const { Cell::new(0) };
}

// SAFETY: everything is passed on to the system's allocator unchanged.
unsafe impl GlobalAlloc for CountingAllocator {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        // At a thread's end its counter is gone; nobody reads it then.
        let _ = ALLOCATIONS.try_with(|count| count.set(count.get() + 1));
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        unsafe { System.dealloc(pointer, layout) }
    }

    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, new_size: usize) -> *mut u8 {
        let _ = ALLOCATIONS.try_with(|count| count.set(count.get() + 1));
        unsafe { System.realloc(pointer, layout, new_size) }
    }
}

#[global_allocator]
static ALLOCATOR: CountingAllocator = CountingAllocator;

fn estimate(number: u64, state: LocalizationState) -> PositionEstimate {
    let pose = EstimatedPose {
        position_m: POSITION_M,
        covariance: PositionCovariance { ee_m2: 0.36, en_m2: -0.04, nn_m2: 0.25 },
        velocity_mps: Some([3.0, 4.0]),
        heading: Some(EstimatedHeading { yaw_rad: 0.5, yaw_std_rad: 0.02 }),
    };
    PositionEstimate {
        sequence: number as u32,
        stamp_ns: number * FRAME_NS,
        state,
        pose: (state == LocalizationState::Localized).then_some(pose),
        single_frame_m: None,
        warnings: EstimateWarnings::default(),
    }
}

fn utc_ns(number: u64) -> i64 {
    START_UTC_NS + (number * FRAME_NS) as i64
}

/// A port that was free a moment ago.
fn free_address() -> SocketAddr {
    TcpListener::bind("127.0.0.1:0").and_then(|listener| listener.local_addr()).expect("a free port")
}

fn tcp(listen: SocketAddr) -> TcpSettings {
    TcpSettings { listen: Address(listen), max_clients: 8, sentences: Sentence::ALL.to_vec(), max_rate_hz: None }
}

fn connect(address: SocketAddr) -> TcpStream {
    let started = Instant::now();
    loop {
        match TcpStream::connect(address) {
            Ok(stream) => break stream,
            Err(error) => assert!(started.elapsed() < PATIENCE, "nobody listens on {address}: {error}"),
        }
        thread::sleep(Duration::from_millis(20));
    }
}

/// A program that ends with the test.
struct Running(Child);

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// A program of Debian's gpsd packages; gpsd itself is not on every user's path.
fn program(name: &str) -> Command {
    let found = ["/usr/sbin", "/usr/bin", "/usr/local/sbin", "/usr/local/bin"].iter();
    let found = found.map(|folder| Path::new(folder).join(name)).find(|path| path.exists());
    let path = found
        .unwrap_or_else(|| panic!("{name} is not installed: tests/run does it, or apt-get install gpsd gpsd-clients"));
    let mut command = Command::new(path);
    command.stdin(Stdio::null()).stderr(Stdio::null());
    command
}

/// What gpsd reports of an output, while estimates go on at 10 Hz: until `is_enough` says so.
fn gpsd_reports(with_utc: bool, mut is_enough: impl FnMut(&Value, &mut LocalizationState) -> bool) {
    let listen = free_address();
    let settings = Settings { nmea_tcp: vec![tcp(listen)], ..Settings::default() };
    let outputs = Outputs::start(&settings, Some(ORIGIN)).expect("starts");
    drop(connect(listen));
    let gpsd_address = free_address();
    let mut gpsd = program("gpsd");
    gpsd.args(["-N", "-n", "-S", &gpsd_address.port().to_string()]).arg(format!("tcp://{listen}"));
    let _gpsd = Running(gpsd.stdout(Stdio::null()).spawn().expect("gpsd starts"));
    drop(connect(gpsd_address));

    const ENOUGH: u8 = u8::MAX;
    const STATES: [LocalizationState; 2] = [LocalizationState::Localized, LocalizationState::Lost];
    let state = AtomicU8::new(0);
    thread::scope(|scope| {
        scope.spawn(|| {
            for number in 0.. {
                let state = state.load(Ordering::Relaxed);
                if state == ENOUGH {
                    break;
                }
                let utc_ns = with_utc.then(|| utc_ns(number));
                outputs.send(&estimate(number, STATES[usize::from(state)]), utc_ns);
                thread::sleep(Duration::from_millis(100));
            }
        });
        let mut gpspipe = program("gpspipe");
        gpspipe.args(["-w", "-x", &PATIENCE.as_secs().to_string(), &gpsd_address.to_string()]);
        let mut gpspipe = Running(gpspipe.stdout(Stdio::piped()).spawn().expect("gpspipe starts"));
        let lines = BufReader::new(gpspipe.0.stdout.take().expect("piped")).lines();
        let mut seen = Vec::new();
        let mut wanted = STATES[0];
        let is_done = lines.map_while(Result::ok).any(|line| {
            // gpsd 3.22 writes some lines that are no JSON; not the ones that count.
            let is_done = serde_json::from_str(&line).is_ok_and(|report| is_enough(&report, &mut wanted));
            state.store(u8::from(wanted != STATES[0]), Ordering::Relaxed);
            seen.push(line);
            is_done
        });
        state.store(ENOUGH, Ordering::Relaxed);
        assert!(is_done, "gpsd said: {seen:#?}");
    });
    let reports = outputs.finish();
    assert!(reports[0].delivered > 0 && reports[0].lost == 0 && !reports[0].has_ended, "{reports:?}");
}

fn number(report: &Value, key: &str) -> Option<f64> {
    report[key].as_f64()
}

/// That the report of a position is right: where, and that it is dead reckoning.
fn check_position(report: &Value) {
    let place = LocalFrame::new(ORIGIN).plane_to_geodetic(POSITION_M);
    let is_near = |key, expected: f64| number(report, key).is_some_and(|found| (found - expected).abs() < 1e-6);
    assert!(is_near("lat", place.latitude_deg) && is_near("lon", place.longitude_deg), "{report}");
    const DEAD_RECKONING: u64 = 5;
    assert_eq!(report["status"].as_u64(), Some(DEAD_RECKONING), "{report}");
    assert!(number(report, "speed").is_some_and(|speed_mps| (speed_mps - 5.0).abs() < 0.01), "{report}");
}

#[test]
fn gpsd_reports_the_position_with_its_errors_until_it_is_lost() {
    let (mut is_placed, mut has_errors, mut has_heading) = (false, false, false);
    gpsd_reports(true, |report, state| {
        match report["class"].as_str() {
            Some("TPV") if report["mode"].as_u64() >= Some(2) => {
                check_position(report);
                assert!(report["time"].as_str().is_some_and(|time| time.starts_with("2026-11-22T12:")), "{report}");
                // 2.45 / √2 of the radius that half of all positions are within, 0.65 m, rounded as PGRME has it.
                if let (Some(east_m), Some(north_m)) = (number(report, "epx"), number(report, "epy")) {
                    assert!((0.5..2.0).contains(&east_m) && (0.5..2.0).contains(&north_m), "{report}");
                    is_placed = true;
                }
            }
            Some("TPV") if *state == LocalizationState::Lost => {
                assert_eq!((report["mode"].as_u64(), &report["lat"]), (Some(1), &Value::Null), "{report}");
                return true;
            }
            Some("GST") => {
                assert_eq!((number(report, "lat"), number(report, "lon")), (Some(0.5), Some(0.6)), "{report}");
                has_errors = true;
            }
            Some("ATT") => {
                has_heading |= number(report, "heading").is_some_and(|deg| (deg - 61.35).abs() < 0.01);
            }
            _ => {}
        }
        if is_placed && has_errors && has_heading {
            *state = LocalizationState::Lost;
        }
        false
    });
}

#[test]
fn gpsd_reports_the_position_also_while_utc_is_not_known() {
    let mut positions = 0;
    gpsd_reports(false, |report, _| {
        if report["class"] == "TPV" {
            check_position(report);
            assert!(report["mode"].as_u64() >= Some(2) && report["time"].is_null(), "{report}");
            positions += 1;
        }
        positions == 5
    });
}

#[test]
fn a_producer_allocates_nothing_whatever_becomes_of_its_outputs() {
    let listen = free_address();
    let serial = SerialSettings {
        port: PathBuf::from("/dev/omniloc-is-not-there"),
        baud: 4800,
        sentences: vec![Sentence::Rmc],
        max_rate_hz: 1.0,
    };
    let udp =
        UdpSettings { target: Address(free_address()), sentences: Sentence::ALL.to_vec(), max_rate_hz: Some(5.0) };
    let settings =
        Settings { nmea_tcp: vec![tcp(listen)], nmea_udp: vec![udp], nmea_serial: vec![serial], ..Settings::default() };
    let outputs = Outputs::start(&settings, Some(ORIGIN)).expect("starts");
    // It never reads.
    let silent = connect(listen);

    const FRAMES: u64 = 10_000;
    let before = ALLOCATIONS.get();
    for number in 0..FRAMES {
        outputs.send(&estimate(number, LocalizationState::Localized), Some(utc_ns(number)));
    }
    assert_eq!(ALLOCATIONS.get() - before, 0);
    // Whatever was lost before, who comes now gets what is sent now.
    let fresh = connect(listen);
    fresh.set_read_timeout(Some(PATIENCE)).expect("sets");
    let mut lines = BufReader::new(fresh).lines();
    let mut newest = 0;
    let is_fresh = (FRAMES..FRAMES + 1000).any(|number| {
        outputs.send(&estimate(number, LocalizationState::Localized), Some(utc_ns(number)));
        newest = number;
        thread::sleep(Duration::from_millis(10));
        outputs.reports()[0].clients == 2
    });
    assert!(is_fresh, "{:?}", outputs.reports());
    outputs.send(&estimate(newest + 1, LocalizationState::Localized), Some(utc_ns(newest + 1)));
    let seconds = (newest + 1) * FRAME_NS / NS_PER_S;
    let time = format!("{:02}{:02}{:02}.{}00", 12 + seconds / 3600, seconds / 60 % 60, seconds % 60, (newest + 1) % 10);
    let arrives = lines.by_ref().map_while(Result::ok).any(|line| line.starts_with(&format!("$INRMC,{time},A,")));
    assert!(arrives, "{time}");
    drop(silent);

    let reports = outputs.finish();
    let sent = newest + 2;
    for (report, expected) in reports.iter().zip([sent, sent / 2, sent / 10]) {
        assert!((report.delivered + report.lost).abs_diff(expected) <= 2, "each is counted once: {report:?}");
    }
    assert_eq!(reports[2].delivered, 0, "{reports:?}");
}

/// A pseudo-terminal that `link` points to: what listens.
fn plug_in(link: &Path) -> File {
    let master: OwnedFd = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY).expect("opens");
    grantpt(&master).and_then(|()| unlockpt(&master)).expect("is ours");
    rustix::io::ioctl_fionbio(&master, true).expect("sets");
    let device = ptsname(&master, Vec::new()).expect("has a name").into_string().expect("ASCII");
    std::os::unix::fs::symlink(device, link).expect("links");
    master.into()
}

#[test]
fn a_serial_line_that_is_plugged_in_later_and_again_is_written_to() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let link = folder.path().join("line");
    let serial = SerialSettings { port: link.clone(), baud: 38_400, sentences: vec![Sentence::Rmc], max_rate_hz: 10.0 };
    let outputs = Outputs::start(&Settings { nmea_serial: vec![serial], ..Settings::default() }, Some(ORIGIN));
    let outputs = outputs.expect("starts");
    let mut number = 0;
    let mut send = |seconds_more: u64| {
        number += 1 + 10 * seconds_more;
        outputs.send(&estimate(number, LocalizationState::Localized), None);
        thread::sleep(Duration::from_millis(20));
    };
    (0..5).for_each(|_| send(0));
    for _ in 0..2 {
        let mut listener = plug_in(&link);
        let started = Instant::now();
        let mut text = String::new();
        while !text.contains("\r\n") {
            assert!(started.elapsed() < PATIENCE, "{:?}", outputs.reports());
            send(0);
            let mut buffer = [0; 512];
            if let Ok(count) = listener.read(&mut buffer) {
                text += str::from_utf8(&buffer[..count]).expect("ASCII");
            }
        }
        assert!(text.starts_with("$INRMC,,A,4049.242"), "{text}");
        drop(listener);
        std::fs::remove_file(&link).expect("unplugs");
        send(1);
    }
    let report = outputs.finish().remove(0);
    assert!(report.delivered >= 2 && report.lost >= 5, "{report:?}");
}

#[test]
fn without_an_origin_there_is_no_nmea() {
    let settings = Settings { nmea_tcp: vec![tcp(free_address())], ..Settings::default() };
    let error = Outputs::start(&settings, None).expect_err("has no position to send");
    assert!(matches!(error, OutputError::NoOrigin), "{error}");
    assert!(Outputs::start(&Settings::default(), None).expect("needs none").finish().is_empty());
}
