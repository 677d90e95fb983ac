//! From a configuration to a drive: which device, which clock, which disk. The only place that knows them all.

use std::{fs, path::Path, sync::Arc, thread::JoinHandle, time::Duration};

use anyhow::Context;
use rustix::{
    fs::{Access, access},
    io::Errno,
};

pub use super::live::DriveReport;
use super::live::{self, DeviceRun, Devices, DriveSettings};
use crate::{
    config::{Camera, Gnss, LocalizeConfig, RecordConfig, Replay},
    devices::{
        CameraEvent, CameraFacts, GpioEvent, SerialEvent, Stop, camera_v4l2, gnss_serial,
        gpio::{self, Led, SimulatedPins},
        pty::{Pace, Pty, TimedBytes},
        replay::{self, ReplayCamera},
        simulated::{self, DATE_STEP_NS, FaultKind, Simulation},
    },
    recording::{
        DeviceRecord, DeviceRecords, Recording,
        proto::omniloc,
        recorder::{self, Folder, Head, Recorder},
        topics,
    },
    types::{Clock, ClockReading, DonutCalibration, NS_PER_S, ScaledClock, SystemClock},
    world::World,
};

/// Where the clocks of a simulated drive start: a computer that was switched on a while ago.
pub const SIMULATED_START: ClockReading =
    ClockReading { monotonic_ns: 100 * NS_PER_S, realtime_ns: 1_790_000_000 * NS_PER_S as i64 };
/// A simulated drive begins so long after the clocks start: what everything needs to be ready [s in real time], but at
/// most what a receiver may be silent for [s of the clock].
const SIMULATED_LEAD_S: f64 = 0.5;
const LONGEST_LEAD_S: f64 = 2.0;

/// Records a drive as `config` says, until it is told to stop or its devices end; `each_second` is told the status and
/// says it in a line.
pub fn record(
    config: &RecordConfig,
    each_second: impl FnMut(&omniloc::Status) -> String,
) -> anyhow::Result<DriveReport> {
    let simulated = config.simulation.as_ref().map(simulate);
    let start = match (&config.simulation, replayed(config)) {
        (Some(_), _) => Some(SIMULATED_START),
        (None, Some(path)) => Some(first_clocks(path)?),
        (None, None) => None,
    };
    let speed = config.simulation.as_ref().map_or(1.0, |simulation| simulation.speed) * config.replay_speed;
    let mut calibration = config.vehicle.calibration.as_deref().map(read_calibration).transpose()?;
    if let (None, Some(path)) = (&calibration, replayed(config)) {
        calibration = Recording::open_any(path)?.calibration_json().map(<[u8]>::to_vec);
    }
    let simulation = simulated.as_ref().map(|(simulation, world)| (simulation.clone(), world));
    if let Some((simulation, _)) = &simulation {
        calibration.get_or_insert_with(|| calibration_json(&simulation.settings.camera().donut));
    }

    // A camera renders its world first, which takes a while: the clocks start when it is ready.
    let camera = camera(&config.camera, simulation.as_ref())?;
    let clock = clock(start, speed, simulation.as_ref().map(|(simulation, _)| simulation));

    let boot_id = boot_id();
    let mut head = Head::new(&config.resolved(), &config.vehicle.name, &boot_id, clock.read());
    // Of a recording that is replayed: it may be any attachment.
    let donut = calibration.as_deref().and_then(|json| serde_json::from_slice(json).ok());
    head.calibration_json = calibration;
    let start_s = clock.read().monotonic_ns / NS_PER_S;
    let name = format!("{}, {} at {start_s} s", config.vehicle.name, boot_id.get(..8).unwrap_or_default());
    head.name_source(&name);
    let log_offset_ns = head.log_offset_ns;
    let recorder = start_recorder(&config.recorder, head, &boot_id, &clock)?;

    let ports = tempfile::tempdir().context("making a folder for pseudo-terminals")?;
    let stop = Stop::default();
    let line = gnss(config, simulation.as_ref(), ports.path(), &clock, &stop)?;
    let (gnss, player) = line.map_or((None, None), |line| (Some(line.driver), line.player));
    let led = Led::default();
    let devices =
        Devices { camera, gnss, gpio: pins(config, simulation.as_ref().map(|(simulation, _)| simulation), &led)? };
    let settings = DriveSettings {
        decoder: config.decoder.clone(),
        sync: config.sync.clone(),
        log_offset_ns,
        second: Duration::from_secs_f64(1.0 / speed),
        folder: config.recorder.folder.clone(),
        calibration: donut.filter(|donut: &DonutCalibration| donut.check().is_ok()),
        led,
    };
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().context("starting the runtime")?;
    let report = runtime.block_on(live::run(settings, devices, recorder, clock, each_second));
    stop.stop();
    if let Some(player) = player {
        let _ = player.join();
    }
    report
}

/// A recorder that writes to the folder of its settings.
pub fn start_recorder(
    settings: &recorder::Settings,
    head: Head,
    boot_id: &str,
    clock: &Arc<dyn Clock>,
) -> anyhow::Result<Recorder> {
    let folder = &settings.folder;
    let storage = Folder::new(folder).with_context(|| format!("using the folder {}", folder.display()))?;
    // A read-only file system may become writable again; a folder of somebody else does not.
    if access(folder, Access::WRITE_OK) == Err(Errno::ACCESS) {
        anyhow::bail!(
            "{}: this user may not write here: change its owner (chown) or `folder` in [recorder]",
            folder.display()
        );
    }
    Ok(Recorder::start(settings.clone(), head, boot_id, Arc::new(storage), clock.clone())?)
}

/// The world of a simulated drive, and the truth of what happens in it.
pub fn simulate(settings: &simulated::Settings) -> (Simulation, World) {
    let world = settings.world();
    let lead_s = (SIMULATED_LEAD_S * settings.speed).clamp(SIMULATED_LEAD_S, LONGEST_LEAD_S);
    let start_ns = SIMULATED_START.monotonic_ns + (lead_s * 1e9) as u64;
    (Simulation::new(settings, &world, start_ns, SIMULATED_START.realtime_ns), world)
}

/// The camera, if there is one.
pub fn camera(
    camera: &Camera,
    simulation: Option<&(Simulation, &World)>,
) -> anyhow::Result<Option<DeviceRun<CameraEvent>>> {
    Ok(match (camera, simulation) {
        (Camera::V4l2(settings), _) => {
            let settings = settings.clone();
            Some(Box::new(move |clock, stop, emit| camera_v4l2::run(&settings, clock, stop, emit)))
        }
        (Camera::Replay(replay), _) => {
            let mut camera = ReplayCamera::open(&replay.recording, camera_facts(&replay.recording)?)?;
            Some(Box::new(move |clock, stop, emit| camera.run(clock, stop, emit)))
        }
        (Camera::Simulated, Some((simulation, world))) => {
            let mut camera = simulation.camera(world)?;
            Some(Box::new(move |clock, stop, emit| camera.run(clock, stop, emit)))
        }
        (Camera::Simulated, None) => unreachable!("a simulated driver needs [simulation]: checked when it was loaded"),
        (Camera::None, _) => None,
    })
}

/// The clocks of a drive: the computer's, or those of a `start` in a recording or a simulation.
pub fn clock(start: Option<ClockReading>, speed: f64, simulation: Option<&Simulation>) -> Arc<dyn Clock> {
    match start {
        Some(start) => Arc::new(scaled_clock(start, speed, simulation)),
        None => Arc::new(SystemClock),
    }
}

/// A serial line, and the thread that plays a simulated or replayed receiver into it.
pub struct Line {
    pub driver: DeviceRun<SerialEvent>,
    pub player: Option<JoinHandle<()>>,
}

/// The receiver's line, if there is one.
pub fn gnss(
    config: &RecordConfig,
    simulation: Option<&(Simulation, &World)>,
    ports: &Path,
    clock: &Arc<dyn Clock>,
    stop: &Stop,
) -> anyhow::Result<Option<Line>> {
    let link = ports.join("receiver");
    let play = |bytes, unplugged_ns| play(bytes, unplugged_ns, &link, clock, stop);
    let player = match (&config.gnss, simulation) {
        (Gnss::None, _) => return Ok(None),
        (Gnss::Serial(settings), _) => {
            let settings = settings.clone();
            let driver: DeviceRun<SerialEvent> =
                Box::new(move |clock, stop, emit| gnss_serial::run(&settings, clock, stop, emit));
            return Ok(Some(Line { driver, player: None }));
        }
        (Gnss::Replay(replay), _) => play(Box::new(replay::serial_bytes(&replay.recording)?), Vec::new())?,
        (Gnss::Simulated, Some((simulation, world))) => {
            let unplugged_ns = simulation.intervals_ns(FaultKind::ReceiverUnplugged).collect();
            play(Box::new(simulation.receiver(world)), unplugged_ns)?
        }
        (Gnss::Simulated, None) => unreachable!("a simulated driver needs [simulation]: checked when it was loaded"),
    };
    let settings = gnss_serial::Settings {
        port: link,
        baud: gnss_serial::Baud::Fixed(SIMULATED_BAUD),
        silence_timeout_s: SIMULATED_SILENCE_S,
    };
    let ended = player.ended.clone();
    let driver: DeviceRun<SerialEvent> = Box::new(move |clock, stop, emit| {
        let outcome = gnss_serial::run(&settings, clock, stop, emit);
        // At the end of the drive the line is taken away, and that is not a fault.
        if ended.is_stopped() { Ok(()) } else { outcome }
    });
    Ok(Some(Line { driver, player: Some(player.thread) }))
}

/// Speed that a pseudo-terminal pretends to have.
const SIMULATED_BAUD: u32 = 115_200;
/// As for a real receiver.
const SIMULATED_SILENCE_S: f64 = 3.0;

struct Player {
    thread: JoinHandle<()>,
    /// Everything was played.
    ended: Stop,
}

/// Plays bytes into a pseudo-terminal called `link`, which is away while the receiver is unplugged.
fn play(
    bytes: Box<dyn Iterator<Item = TimedBytes> + Send>,
    unplugged_ns: Vec<std::ops::Range<u64>>,
    link: &Path,
    clock: &Arc<dyn Clock>,
    stop: &Stop,
) -> anyhow::Result<Player> {
    let ended = Stop::default();
    let mut pty = Some(Pty::open(Some(link)).context("opening a pseudo-terminal")?);
    let (link, clock, stop, end) = (link.to_owned(), clock.clone(), stop.clone(), ended.clone());
    let thread = std::thread::Builder::new().name("receiver".into()).spawn(move || {
        let mut bytes = bytes.peekable();
        while let Some(next) = bytes.peek() {
            let unplugged = unplugged_ns.iter().find(|interval| interval.contains(&next.at_ns)).cloned();
            if let Some(interval) = unplugged {
                crate::devices::wait_until(interval.start, &*clock, &stop);
                pty = None;
                crate::devices::wait_until(interval.end, &*clock, &stop);
                while bytes.next_if(|next| interval.contains(&next.at_ns)).is_some() {}
            }
            if stop.is_stopped() {
                break;
            }
            let plugged = match pty.take() {
                Some(plugged) => plugged,
                None => match Pty::open(Some(&link)) {
                    Ok(plugged) => plugged,
                    Err(error) => {
                        tracing::error!(%error, "the simulated receiver has no pseudo-terminal");
                        break;
                    }
                },
            };
            let until_unplugged = |next: &TimedBytes| !unplugged_ns.iter().any(|gone| gone.contains(&next.at_ns));
            let piece = std::iter::from_fn(|| bytes.next_if(until_unplugged));
            if let Err(error) = plugged.play(piece, Pace::Clock, &*clock, &stop) {
                tracing::error!(%error, "the simulated receiver failed");
                break;
            }
            pty = Some(plugged);
        }
        end.stop();
        // Dropped here: the driver sees that the line is gone.
        drop(pty);
    });
    Ok(Player { thread: thread.context("starting the thread of the receiver")?, ended })
}

/// The pins; simulated and replayed pulses need no configuration.
pub fn pins(
    config: &RecordConfig,
    simulation: Option<&Simulation>,
    led: &Led,
) -> anyhow::Result<Option<DeviceRun<GpioEvent>>> {
    let mut settings = config.gpio.clone();
    let pins = match (&config.gnss, simulation) {
        (Gnss::Simulated, Some(simulation)) => SimulatedPins::new(simulation.pulses()),
        (Gnss::Replay(replay), _) => SimulatedPins::new(replay::pulses(&replay.recording)?),
        _ if settings.driver == gpio::Driver::None => return Ok(None),
        _ => SimulatedPins::default(),
    };
    if settings.driver == gpio::Driver::None {
        settings.driver = gpio::Driver::Simulated;
    }
    let led = led.clone();
    Ok(Some(Box::new(move |clock, stop, emit| gpio::run(&settings, &led, &pins, clock, stop, emit))))
}

/// The recording that is played instead of a device.
fn replayed(config: &RecordConfig) -> Option<&Path> {
    match (&config.camera, &config.gnss) {
        (Camera::Replay(replay), _) | (_, Gnss::Replay(replay)) => Some(&replay.recording),
        _ => None,
    }
}

/// What the clocks said a little before the first thing in a recording.
pub fn first_clocks(path: &Path) -> anyhow::Result<ClockReading> {
    const LEAD_NS: u64 = NS_PER_S / 10;
    let first = DeviceRecords::open(path)?.next();
    let first = first.with_context(|| format!("{}: nothing in it can be replayed", path.display()))??;
    let offset_ns = match first.record {
        DeviceRecord::Clock(clocks) => clocks.realtime_ns - clocks.monotonic_ns as i64,
        _ => log_offset_ns(&Recording::open_any(path)?) as i64,
    };
    let monotonic_ns = first.stamp_ns.saturating_sub(LEAD_NS);
    Ok(ClockReading { monotonic_ns, realtime_ns: monotonic_ns as i64 + offset_ns })
}

/// Log time minus stamp of a recording; 0 if it does not say.
pub fn log_offset_ns(recording: &Recording) -> u64 {
    let stated = recording.metadata.get(topics::metadata::CLOCK).and_then(|clock| clock.get("log_offset_ns"));
    stated.and_then(|text| text.parse().ok()).unwrap_or(0)
}

/// The head of a recording that is made of another one: its calibration, vehicle and clocks.
pub fn replay_head(recording: &Recording, config: &RecordConfig) -> anyhow::Result<Head> {
    let offset_ns = log_offset_ns(recording);
    let boot_id = recording.metadata.get(topics::metadata::SOURCE).and_then(|source| source.get("boot_id"));
    let start = ClockReading { monotonic_ns: 0, realtime_ns: offset_ns as i64 };
    // Where files lie on this computer says nothing about the drive.
    let mut settings = config.clone();
    settings.recorder.folder = ".".into();
    let replay = Replay { recording: recording.path.file_name().unwrap_or_default().into() };
    settings.camera = Camera::Replay(replay.clone());
    settings.gnss = Gnss::Replay(replay);
    let mut head = Head::new(&settings.resolved(), &recording.name, boot_id.map_or("", String::as_str), start);
    head.calibration_json = recording.calibration_json().map(<[u8]>::to_vec);
    head.name_source(&recording.name);
    Ok(head)
}

/// The head of a recording of estimates.
pub fn localize_head(recording: &Recording, config: &LocalizeConfig) -> Head {
    let start = ClockReading { monotonic_ns: 0, realtime_ns: log_offset_ns(recording) as i64 };
    // Where files lie on this computer says nothing about the drive.
    let mut settings = config.clone();
    settings.camera = Camera::Replay(Replay { recording: recording.path.file_name().unwrap_or_default().into() });
    settings.map.file = config.map.file.file_name().unwrap_or_default().into();
    let boot_id = recording.metadata.get(topics::metadata::SOURCE).and_then(|source| source.get("boot_id"));
    let mut head = Head::new(&settings.resolved(), &recording.name, boot_id.map_or("", String::as_str), start);
    head.calibration_json = recording.calibration_json().map(<[u8]>::to_vec);
    head.name_source(&recording.name);
    head.name_command("localize");
    head
}

/// What a recording says about its camera.
pub fn camera_facts(path: &Path) -> anyhow::Result<CameraFacts> {
    let recording = Recording::open_any(path)?;
    let camera = recording.metadata.get(topics::metadata::CAMERA);
    let text = |key: &str| camera.and_then(|entries| entries.get(key)).cloned();
    let (width_px, height_px) = recording.image_size_px.unwrap_or_default();
    Ok(CameraFacts {
        name: text("name").unwrap_or_else(|| recording.name.clone()),
        width_px: width_px as u32,
        height_px: height_px as u32,
        frame_rate_hz: text("frame_rate_hz").and_then(|rate| rate.parse().ok()).unwrap_or(0.0),
        pixel_format: text("sends").unwrap_or_else(|| "MJPG".into()),
    })
}

fn scaled_clock(start: ClockReading, speed: f64, simulation: Option<&Simulation>) -> ScaledClock {
    let clock = ScaledClock::new(start, speed);
    let set = simulation.and_then(|simulation| simulation.intervals_ns(FaultKind::DateSet).next());
    match set {
        Some(interval) => clock.with_step(interval.start, DATE_STEP_NS),
        None => clock,
    }
}

/// `donut.json` as it is, once it is known to be one.
pub fn read_calibration(path: &Path) -> anyhow::Result<Vec<u8>> {
    let context = || format!("reading the calibration {}", path.display());
    let json = fs::read(path).with_context(context)?;
    let donut: DonutCalibration = serde_json::from_slice(&json).with_context(context)?;
    donut.check().with_context(context)?;
    Ok(json)
}

pub fn calibration_json(donut: &DonutCalibration) -> Vec<u8> {
    serde_json::to_vec_pretty(donut).expect("a calibration is plain numbers")
}

/// Which start of the computer this is; the same for all drives until it is switched off.
pub fn boot_id() -> String {
    let id = fs::read_to_string("/proc/sys/kernel/random/boot_id").unwrap_or_default();
    let id = id.trim();
    if id.is_empty() { "00000000-0000-0000-0000-000000000000".into() } else { id.into() }
}
