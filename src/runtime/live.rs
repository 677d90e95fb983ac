//! A live survey drive: threads for the devices, one task that pairs, one thread that writes.

use std::{
    path::PathBuf,
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
    thread::JoinHandle,
    time::Duration,
};

use anyhow::Context;
use tokio::{
    select,
    signal::unix::{SignalKind, signal},
    sync::mpsc::{self, Receiver, Sender, error::TrySendError},
    time::MissedTickBehavior,
};
use tracing::info;

use super::{
    service::Service,
    signals::StopSignals,
    supervisor::{Outcome, join_within, supervise},
    survey::{Device, Input, Sink, Survey, Tick},
    system::SystemMonitor,
    turn_watch::TurnWatch,
};
use crate::{
    devices::{
        CameraEvent, DeviceError, GpioEvent, SerialEvent, Stop,
        gpio::{Led, LedPattern},
    },
    gnss::DecoderSettings,
    recording::{
        proto::omniloc,
        recorder::{Entry, Recorder, RecorderHandle, RecorderReport, disk},
    },
    sync,
    types::{Clock, DonutCalibration},
};

/// Everything has ended at the latest this long after the signal; systemd waits longer by default.
pub const STOP_LIMIT: Duration = Duration::from_secs(20);
/// Part of [`STOP_LIMIT`] that devices have to stop.
const DEVICES_STOP_LIMIT: Duration = Duration::from_secs(2);
/// Frames on their way to the survey task: a second, which a busy computer may well take.
const FRAME_QUEUE: usize = 32;
/// Chunks and edges on their way to it: half a minute.
const EVENT_QUEUE: usize = 4096;

/// A device as the runtime runs it: see [`crate::devices`].
pub type DeviceRun<Event> = Box<dyn FnMut(&dyn Clock, &Stop, &mut dyn FnMut(Event)) -> Result<(), DeviceError> + Send>;

/// What is recorded from; `None`: nothing of the kind.
pub struct Devices {
    pub camera: Option<DeviceRun<CameraEvent>>,
    pub gnss: Option<DeviceRun<SerialEvent>>,
    pub gpio: Option<DeviceRun<GpioEvent>>,
}

/// What the survey task has to know beside the devices.
pub struct DriveSettings {
    pub decoder: DecoderSettings,
    pub sync: sync::Settings,
    /// Realtime minus monotonic at the start.
    pub log_offset_ns: u64,
    /// A second of the clock: shorter on the computer's own clock when a simulation runs faster.
    pub second: Duration,
    pub folder: PathBuf,
    /// With it the latency of the serial line shows when the vehicle turns.
    pub calibration: Option<DonutCalibration>,
    /// Shows how the drive is.
    pub led: Led,
}

/// How a drive ended.
#[derive(Debug)]
pub struct DriveReport {
    pub status: omniloc::Status,
    pub recorder: RecorderReport,
    /// Where the recording is.
    pub folder: PathBuf,
    /// Frames were asked for.
    pub has_camera: bool,
}

impl DriveReport {
    /// Every frame that the camera exposed and everything else that was said is on the disk.
    pub fn is_lossless(&self) -> bool {
        let nothing_came = self.has_camera && self.status.frames == 0;
        self.status.frames_dropped == 0 && self.recorder.is_complete && self.recorder.health.lost == 0 && !nothing_came
    }
}

/// Events on their way from a device's thread to the survey task; a full queue loses them, counted.
struct Inlet {
    sender: Sender<Input>,
    refused: Arc<AtomicU64>,
}

impl Inlet {
    fn new(capacity: usize) -> (Self, Receiver<Input>) {
        let (sender, receiver) = mpsc::channel(capacity);
        (Self { sender, refused: Arc::default() }, receiver)
    }

    fn emit(&self, input: Input) {
        if let Err(TrySendError::Full(_)) = self.sender.try_send(input) {
            self.refused.fetch_add(1, Ordering::Relaxed);
        }
    }
}

impl Clone for Inlet {
    fn clone(&self) -> Self {
        Self { sender: self.sender.clone(), refused: self.refused.clone() }
    }
}

/// The recorder as the survey's sink.
struct ToRecorder<'a>(&'a RecorderHandle);

impl Sink for ToRecorder<'_> {
    fn push(&mut self, entry: Entry) -> bool {
        self.0.push(entry)
    }

    fn mark(&mut self) {
        self.0.mark();
    }
}

/// Records until SIGTERM or SIGINT, or until every device has ended by itself as a replay does.
///
/// `each_second` is told the status and says it in a line. The recorder is finished in any case.
pub async fn run(
    settings: DriveSettings,
    devices: Devices,
    recorder: Recorder,
    clock: Arc<dyn Clock>,
    mut each_second: impl FnMut(&omniloc::Status) -> String,
) -> anyhow::Result<DriveReport> {
    let mut stop_signals = StopSignals::listen()?;
    let mut mark = signal(SignalKind::user_defined1()).context("listening for SIGUSR1")?;

    let stop = Stop::default();
    let (frame_inlet, mut frames) = Inlet::new(FRAME_QUEUE);
    let (event_inlet, mut events) = Inlet::new(EVENT_QUEUE);
    let (frames_refused, chunks_refused) = (frame_inlet.refused.clone(), event_inlet.refused.clone());
    let devices_there = (devices.camera.is_some(), devices.gnss.is_some());
    let threads = start_devices(devices, &clock, &stop, &frame_inlet, &event_inlet)?;
    for (device, is_there) in [(Device::Camera, devices_there.0), (Device::Gnss, devices_there.1)] {
        if !is_there {
            event_inlet.emit(Input::Health { device, health: None });
        }
    }

    let mut watch = settings.calibration.map(|calibration| watch_turns(calibration, &event_inlet)).transpose()?;
    let handle = recorder.handle();
    let mut out = ToRecorder(&handle);
    let survey = Survey::new(&settings.decoder, &settings.sync, settings.log_offset_ns);
    let mut survey = survey.map_err(anyhow::Error::msg)?;
    let mut system = SystemMonitor::default();
    let service = Service::ready();
    let mut seconds = tokio::time::interval(settings.second);
    seconds.set_missed_tick_behavior(MissedTickBehavior::Delay);
    loop {
        select! {
            Some(input) = frames.recv() => {
                if let (Input::Camera(CameraEvent::Frame(frame)), Some(watch)) = (&input, &mut watch) {
                    watch.offer(frame.stamp_ns, &frame.jpeg);
                }
                survey.take(input, &mut out);
            }
            Some(input) = events.recv() => survey.take(input, &mut out),
            _ = seconds.tick() => {
                let clocks = clock.read();
                let tick = Tick {
                    clocks: Some(clocks),
                    system: system.look(clocks.monotonic_ns),
                    recorder: handle.health(),
                    frames_refused: frames_refused.swap(0, Ordering::Relaxed),
                    chunks_refused: chunks_refused.swap(0, Ordering::Relaxed),
                };
                survey.take(Input::Tick(tick), &mut out);
                let status = survey.status();
                settings.led.show(pattern(status));
                service.second([status.camera_health.as_str(), &status.gnss_health], &each_second(status));
                if survey.has_ended() && frames.is_empty() && events.is_empty() {
                    info!("all devices have ended");
                    break;
                }
            }
            () = stop_signals.received() => break,
            _ = mark.recv() => { info!(signal = "SIGUSR1", "this piece of the recording is kept"); handle.mark(); }
        }
    }

    service.stopping();
    stop.stop();
    join_within(&threads, DEVICES_STOP_LIMIT).await;
    frames.close();
    events.close();
    while let Ok(input) = events.try_recv() {
        survey.take(input, &mut out);
    }
    while let Ok(input) = frames.try_recv() {
        survey.take(input, &mut out);
    }
    survey.finish(&mut out);
    let status = survey.status().clone();
    let recorder = tokio::task::spawn_blocking(move || recorder.finish(STOP_LIMIT - DEVICES_STOP_LIMIT)).await;
    settings.led.show(LedPattern::Off);
    Ok(DriveReport {
        status,
        recorder: recorder.context("finishing the recording")?,
        folder: settings.folder,
        has_camera: devices_there.0,
    })
}

fn watch_turns(calibration: DonutCalibration, events: &Inlet) -> anyhow::Result<TurnWatch> {
    let inlet = events.clone();
    TurnWatch::start(calibration, move |turn| inlet.emit(Input::Turn(turn))).context("starting the thread turns")
}

/// What the lamp shows: a fault of the disk before devices that are waited for.
fn pattern(status: &omniloc::Status) -> LedPattern {
    if status.disk_health != disk::OK {
        LedPattern::FastBlink
    } else if status.camera_health == "ok" && status.gnss_health == "ok" {
        LedPattern::On
    } else {
        LedPattern::SlowBlink
    }
}

fn start_devices(
    devices: Devices,
    clock: &Arc<dyn Clock>,
    stop: &Stop,
    frames: &Inlet,
    events: &Inlet,
) -> anyhow::Result<Vec<JoinHandle<()>>> {
    let mut threads = Vec::new();
    if let Some(camera) = devices.camera {
        threads.push(start("camera", Device::Camera, camera, Input::Camera, frames, clock, stop)?);
    }
    if let Some(gnss) = devices.gnss {
        threads.push(start("gnss", Device::Gnss, gnss, Input::Serial, events, clock, stop)?);
    }
    if let Some(gpio) = devices.gpio {
        threads.push(start("gpio", Device::Gpio, gpio, Input::Gpio, events, clock, stop)?);
    }
    Ok(threads)
}

fn start<Event: 'static>(
    name: &'static str,
    device: Device,
    mut run: DeviceRun<Event>,
    wrap: fn(Event) -> Input,
    inlet: &Inlet,
    clock: &Arc<dyn Clock>,
    stop: &Stop,
) -> anyhow::Result<JoinHandle<()>> {
    let (values, reports) = (inlet.clone(), inlet.clone());
    let run = move |clock: &dyn Clock, stop: &Stop| run(clock, stop, &mut |event| values.emit(wrap(event)));
    let report = move |outcome| {
        let health = match outcome {
            Outcome::Failed { health } => Some(health),
            Outcome::Ended => None,
        };
        reports.emit(Input::Health { device, health });
    };
    supervise(name, clock.clone(), stop.clone(), run, report).with_context(|| format!("starting the thread {name}"))
}
