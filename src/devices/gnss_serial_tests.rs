use std::{
    sync::{Arc, Mutex, PoisonError},
    thread,
    time::Instant,
};

use super::*;
use crate::{
    devices::pty::{Pace, Played, Pty, TimedBytes, received_at_rate},
    gnss::{
        DecoderSettings, GnssDecoder,
        encode::{Measurement, XbusSensor, write_arduino_tick, write_sentence},
    },
    types::{ClockReading, Geodetic, GnssSample, ManualClock, SystemClock},
};

fn settings(port: &Path, baud: Baud) -> Settings {
    Settings { port: port.to_owned(), baud, silence_timeout_s: 0.3 }
}

fn measured() -> Measurement {
    Measurement {
        utc_ns: 1_795_348_800_000_000_000,
        position: Some(Geodetic { latitude_deg: 47.0, longitude_deg: 8.0, altitude_m: 400.0 }),
        position_std_m: [1.0; 3],
        velocity_mps: [10.0, 0.0, 0.0],
        roll_rad: 0.0,
        pitch_rad: 0.0,
        yaw_rad: 0.5,
        yaw_std_rad: 0.01,
        satellites: 9,
        horizontal_dilution: 0.9,
    }
}

fn lines(ticks: std::ops::Range<u64>) -> Vec<u8> {
    let mut bytes = Vec::new();
    ticks.for_each(|tick| write_arduino_tick(tick, &measured(), &mut bytes));
    bytes
}

/// The real driver on a thread of its own, and what it has said so far.
struct Driver {
    events: Arc<Mutex<Vec<SerialEvent>>>,
    stop: Stop,
    thread: thread::JoinHandle<Result<(), DeviceError>>,
}

impl Driver {
    fn start(settings: Settings) -> Self {
        let (events, stop) = (Arc::<Mutex<Vec<SerialEvent>>>::default(), Stop::default());
        let thread = thread::spawn({
            let (events, stop) = (events.clone(), stop.clone());
            move || run(&settings, &SystemClock, &stop, &mut |event| lock(&events).push(event))
        });
        Self { events, stop, thread }
    }

    fn bytes(&self) -> Vec<u8> {
        let bytes = |event: &SerialEvent| match event {
            SerialEvent::Chunk(chunk) => chunk.bytes.clone(),
            SerialEvent::Opened { .. } => Vec::new(),
        };
        lock(&self.events).iter().flat_map(bytes).collect()
    }

    fn wait_for(&self, what: impl Fn(&Self) -> bool) {
        let start = Instant::now();
        while !what(self) {
            assert!(start.elapsed() < Duration::from_secs(20), "waited for nothing: {:?}", lock(&self.events));
            thread::sleep(Duration::from_millis(5));
        }
    }

    fn end(self) -> Result<(), DeviceError> {
        self.thread.join().expect("the driver does not panic")
    }
}

fn lock<T>(mutex: &Mutex<T>) -> std::sync::MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

fn play(pty: &Pty, bytes: Vec<u8>) -> Played {
    let once = [TimedBytes { at_ns: 0, bytes }];
    pty.play(once, Pace::AsRead, &SystemClock, &Stop::default()).expect("a pseudo-terminal can be written to")
}

#[test]
fn bytes_come_through_unchanged_and_stop_is_obeyed_at_once() {
    let pty = Pty::open(None).expect("a pseudo-terminal");
    let driver = Driver::start(settings(pty.path(), Baud::Fixed(115_200)));
    // Every byte there is, and more than any buffer holds.
    let bytes: Vec<u8> = (0..=255).cycle().take(20_000).chain(lines(0..10)).collect();
    assert_eq!(play(&pty, bytes.clone()), Played { written_bytes: bytes.len() as u64, lost_bytes: 0 });
    driver.wait_for(|driver| driver.bytes().len() >= bytes.len());
    assert!(driver.bytes() == bytes);
    let start = Instant::now();
    driver.stop.stop();
    assert!(driver.end().is_ok());
    assert!(start.elapsed() < Duration::from_millis(200), "{:?}", start.elapsed());
}

#[test]
fn unplugged_and_plugged_in_again_it_is_found_by_its_name() {
    let folder = tempfile::tempdir().expect("a folder");
    let link = folder.path().join("usb-Arduino_Mega");
    let pty = Pty::open(Some(&link)).expect("a pseudo-terminal");
    let driver = Driver::start(settings(&link, Baud::Fixed(115_200)));
    play(&pty, lines(0..1));
    driver.wait_for(|driver| driver.bytes().len() == lines(0..1).len());
    drop(pty);
    assert!(matches!(driver.end(), Err(DeviceError::Disconnected { .. })));
    let absent = Driver::start(settings(&link, Baud::Fixed(115_200))).end();
    assert!(matches!(absent, Err(DeviceError::NotPresent { .. })), "{absent:?}");

    let pty = Pty::open(Some(&link)).expect("a pseudo-terminal");
    let driver = Driver::start(settings(&link, Baud::Fixed(115_200)));
    play(&pty, lines(0..1));
    driver.wait_for(|driver| driver.bytes().len() == lines(0..1).len());
    driver.stop.stop();
    assert!(driver.end().is_ok());
}

#[test]
fn silence_is_reported_after_the_timeout() {
    let pty = Pty::open(None).expect("a pseudo-terminal");
    let driver = Driver::start(settings(pty.path(), Baud::Fixed(9_600)));
    play(&pty, lines(0..1));
    let Err(DeviceError::TimedOut { silence_s, .. }) = driver.end() else { panic!("expected a timeout") };
    assert!((0.3..2.0).contains(&silence_s), "{silence_s}");
}

#[test]
fn a_second_process_is_told_that_the_port_is_in_use() {
    let pty = Pty::open(None).expect("a pseudo-terminal");
    let first = Driver::start(settings(pty.path(), Baud::Fixed(115_200)));
    first.wait_for(|driver| !lock(&driver.events).is_empty());
    let second = Driver::start(settings(pty.path(), Baud::Fixed(115_200))).end();
    assert!(matches!(second, Err(DeviceError::Busy { .. })), "{second:?}");
    first.stop.stop();
    assert!(first.end().is_ok());
}

#[test]
fn what_is_no_serial_port_is_refused() {
    for path in ["/", "/dev/null"] {
        let refused = Driver::start(settings(Path::new(path), Baud::Auto)).end();
        assert!(matches!(refused, Err(DeviceError::Unsupported { .. })), "{path}: {refused:?}");
    }
}

#[test]
fn bytes_that_nobody_reads_are_lost_at_a_clocks_pace() {
    let pty = Pty::open(None).expect("a pseudo-terminal");
    let bytes = [TimedBytes { at_ns: 0, bytes: lines(0..1) }];
    let played = pty.play(bytes, Pace::Clock, &SystemClock, &Stop::default()).expect("plays");
    assert_eq!(played, Played { written_bytes: 0, lost_bytes: lines(0..1).len() as u64 });
}

#[test]
fn lines_through_the_driver_decode() {
    let pty = Pty::open(None).expect("a pseudo-terminal");
    let driver = Driver::start(settings(pty.path(), Baud::Auto));
    play(&pty, lines(0..50));
    driver.wait_for(|driver| driver.bytes().len() == lines(0..50).len());
    driver.stop.stop();
    let mut decoder = GnssDecoder::new(&DecoderSettings::default());
    let mut samples = Vec::new();
    for event in lock(&driver.events).iter() {
        if let SerialEvent::Chunk(chunk) = event {
            decoder.push(chunk, &mut samples);
        }
    }
    let headings = samples.iter().filter(|sample| matches!(sample, GnssSample::Heading(_))).count();
    assert_eq!((decoder.counters().fixes, headings), (5, 50));
}

/// A line on which a device sends the same again and again at a rate of its own, on a clock that reading moves on.
struct FakeLine<'a> {
    clock: &'a ManualClock,
    baud: u32,
    /// Rate of the device, and what it sends in each [`FakeLine::PERIOD_NS`], from each time \[ns] on.
    sends: Vec<(u64, u32, Vec<u8>)>,
    stop_at_ns: u64,
    stop: Stop,
}

impl FakeLine<'_> {
    const PERIOD_NS: u64 = 50_000_000;
}

impl Line for FakeLine<'_> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<Option<usize>> {
        self.clock.advance_ns(Self::PERIOD_NS);
        let now_ns = self.clock.monotonic_ns();
        if now_ns >= self.stop_at_ns {
            self.stop.stop();
        }
        let Some((_, baud, bytes)) = self.sends.iter().rfind(|&&(from_ns, ..)| from_ns <= now_ns) else {
            return Ok(None);
        };
        let received = received_at_rate(bytes, *baud, self.baud);
        buffer[..received.len()].copy_from_slice(&received);
        Ok(Some(received.len()).filter(|&count| count > 0))
    }

    fn set_baud(&mut self, baud: u32) -> io::Result<()> {
        self.baud = baud;
        Ok(())
    }
}

/// The rates announced, each with the time \[s], until the end or a fault.
fn hunt(baud: Baud, sends: Vec<(u64, u32, Vec<u8>)>, for_s: u64) -> (Vec<(u32, f64)>, Result<(), DeviceError>) {
    let clock = ManualClock::new(ClockReading { monotonic_ns: 0, realtime_ns: 0 });
    let stop = Stop::default();
    let settings = Settings { silence_timeout_s: 3.0, ..settings(Path::new("/dev/fake"), baud) };
    let mut hunt = RateHunt::new(baud, 0);
    let mut line =
        FakeLine { clock: &clock, baud: hunt.baud(), sends, stop_at_ns: for_s * NS_PER_S, stop: stop.clone() };
    let mut rates = Vec::new();
    let mut emit = |event| {
        if let SerialEvent::Opened { baud, .. } = event {
            rates.push((baud, clock.monotonic_ns() as f64 * 1e-9));
        }
    };
    let end = read_line(&mut line, &settings, &mut hunt, &clock, &stop, &mut emit);
    (rates, end)
}

/// At 4800 baud no more than this fits into a period.
fn short_line() -> Vec<u8> {
    let mut bytes = Vec::new();
    write_sentence("HEHDT,341.8,T", &mut bytes);
    bytes
}

fn packet() -> Vec<u8> {
    let mut bytes = Vec::new();
    XbusSensor::default().write(&measured(), 0, false, &mut bytes);
    bytes
}

#[test]
fn every_standard_rate_is_found_within_one_round() {
    for baud in [4_800, 9_600, 19_200, 38_400, 57_600, 115_200, 230_400, 460_800, 921_600] {
        for bytes in [short_line(), packet()] {
            let (rates, end) = hunt(Baud::Auto, vec![(0, baud, bytes)], 20);
            assert!(end.is_ok(), "{baud}: {end:?}");
            let &(found, at_s) = rates.last().expect("the port was opened");
            assert_eq!(found, baud);
            assert!(at_s < 15.0, "{baud} found after {at_s} s");
        }
    }
}

#[test]
fn a_receiver_that_speaks_once_a_second_is_heard() {
    let sends: Vec<_> = (0..20)
        .flat_map(|s| [(s * NS_PER_S, 9_600, short_line()), (s * NS_PER_S + 50_000_000, 9_600, Vec::new())])
        .collect();
    let (rates, end) = hunt(Baud::Auto, sends, 20);
    assert!(end.is_ok(), "{end:?}");
    assert_eq!(rates.last().map(|&(baud, _)| baud), Some(9_600));
}

#[test]
fn an_arduino_that_starts_is_waited_for() {
    let boot_noise = vec![0xFF, 0x00, 0x80];
    let sends = vec![
        (200_000_000, 57_600, boot_noise),
        (400_000_000, 57_600, Vec::new()),
        (2 * NS_PER_S, 115_200, lines(0..5)),
    ];
    let (rates, end) = hunt(Baud::Auto, sends, 6);
    assert!(end.is_ok(), "{end:?}");
    assert_eq!(rates.iter().map(|&(baud, _)| baud).collect::<Vec<_>>(), [115_200], "no other rate was settled on");
}

#[test]
fn a_rate_that_works_is_kept_through_silence_and_some_noise() {
    let sends = vec![
        (0, 115_200, lines(0..5)),
        (NS_PER_S, 115_200, Vec::new()),
        (3 * NS_PER_S, 57_600, lines(0..5)),
        (6 * NS_PER_S, 115_200, lines(0..5)),
    ];
    let (rates, end) = hunt(Baud::Auto, sends, 10);
    assert!(end.is_ok(), "{end:?}");
    assert_eq!(rates.len(), 1, "{rates:?}");
}

#[test]
fn lasting_noise_starts_the_hunt_again() {
    let (rates, end) = hunt(Baud::Auto, vec![(0, 115_200, lines(0..5)), (5 * NS_PER_S, 38_400, lines(0..1))], 40);
    assert!(end.is_ok(), "{end:?}");
    assert_eq!(rates.iter().map(|&(baud, _)| baud).collect::<Vec<_>>(), [115_200, 38_400]);
}

#[test]
fn noise_at_every_rate_is_bad_data_and_silence_at_every_rate_is_silence() {
    let noise: Vec<u8> = (0..60_u8).map(|i| i.wrapping_mul(73)).collect();
    let (_, end) = hunt(Baud::Auto, vec![(0, 115_200, noise.clone())], 60);
    assert!(matches!(end, Err(DeviceError::BadData { .. })), "{end:?}");
    let (_, end) = hunt(Baud::Auto, Vec::new(), 60);
    assert!(matches!(end, Err(DeviceError::TimedOut { .. })), "{end:?}");
    // With a rate that was set there is nothing to look for.
    let (_, end) = hunt(Baud::Fixed(9_600), vec![(0, 115_200, lines(0..1))], 60);
    assert!(matches!(end, Err(DeviceError::BadData { .. })), "{end:?}");
    let (_, end) = hunt(Baud::Fixed(9_600), Vec::new(), 60);
    assert!(matches!(end, Err(DeviceError::TimedOut { silence_s, .. }) if silence_s < 3.5), "{end:?}");
}

#[test]
fn settings_name_the_key_and_what_is_expected() {
    let parsed = |text: &str| toml::from_str::<Settings>(text).map_err(|error| error.to_string());
    assert_eq!(parsed("port = \"/dev/ttyACM0\"").expect("has defaults").baud, Baud::Auto);
    assert_eq!(parsed("port = \"/dev/ttyACM0\"\nbaud = 9600").expect("a number").baud, Baud::Fixed(9_600));
    for text in ["port = \"/dev/a\"\nbaud = \"fast\"", "port = \"/dev/a\"\nbaud = -1", "port = \"/dev/a\"\nspeed = 1"] {
        assert!(parsed(text).is_err(), "{text}");
    }
    for (text, key) in [
        ("port = \"ttyACM0\"", "port"),
        ("port = \"/dev/a\"\nbaud = 300", "baud"),
        ("port = \"/dev/a\"\nsilence_timeout_s = 0", "silence_timeout_s"),
        ("port = \"/dev/a\"\nsilence_timeout_s = nan", "silence_timeout_s"),
    ] {
        let error = parsed(text).expect("parses").check().expect_err(text);
        assert!(error.starts_with(key), "{error}");
    }
}
