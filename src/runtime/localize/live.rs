//! A live drive: from a configuration to positions.

use std::{
    fs, io,
    os::unix::fs::MetadataExt,
    path::{Path, PathBuf},
    sync::{
        Arc, Mutex, PoisonError,
        atomic::{AtomicBool, Ordering},
    },
    thread::JoinHandle,
    time::Duration,
};

use anyhow::Context;
use tokio::{select, time::MissedTickBehavior};
use tracing::{info, warn};

use super::{
    newest::Newest,
    session::{Counts, Session, SessionError},
};
use crate::{
    config::{Camera, LocalizeConfig},
    devices::{CameraEvent, Stop},
    localize::Timings,
    map::OpenMap,
    outputs::{OutputReport, Outputs},
    recording::recorder::{Head, Recorder, RecorderHandle, RecorderReport},
    runtime::{
        drive::{self, SIMULATED_START},
        live::DeviceRun,
        service::Service,
        signals::StopSignals,
        supervisor::{self, join_within, supervise},
        system::{SystemMonitor, SystemStatus, knows_date},
    },
    types::{Clock, PositionEstimate},
};

/// Part of the time to stop that the camera and the localizer have.
const STOP_LIMIT: Duration = Duration::from_secs(3);
const RECORDER_STOP_LIMIT: Duration = Duration::from_secs(12);

/// How it goes, once a second.
#[derive(Debug, Clone, Default)]
pub struct LocalizeStatus {
    /// `ok`, or a word for what is wrong.
    pub camera_health: &'static str,
    pub counts: Counts,
    /// Frames that came faster than they could be looked at.
    pub passed_over: u64,
    pub frames_per_s: f64,
    pub last: Option<PositionEstimate>,
    pub timings: Timings,
    pub system: SystemStatus,
}

/// How it ended.
#[derive(Debug)]
pub struct LocalizeReport {
    pub status: LocalizeStatus,
    pub outputs: Vec<OutputReport>,
    pub recorder: Option<RecorderReport>,
}

/// What the localizer's thread tells the rest.
#[derive(Debug, Default)]
struct Shared {
    counts: Counts,
    last: Option<PositionEstimate>,
    timings: Timings,
    /// Why it has ended before it was told to.
    error: Option<SessionError>,
}

/// Localizes as `config` says, until it is told to stop or the camera ends as a replay does; `each_second` is told the
/// status and says it in a line.
pub fn localize(
    config: &LocalizeConfig,
    each_second: impl FnMut(&LocalizeStatus) -> String,
) -> anyhow::Result<LocalizeReport> {
    let map = open_map(&config.map.file)?;
    let watched = MapWatch::new(&config.map.file);
    let outputs = Outputs::start(&config.outputs, map.info.origin)?;
    let calibration = drive::calibration_json(&map.info.calibration);
    let session = start_session(map, config)?;
    let simulated = config.simulation.as_ref().map(drive::simulate);
    let simulation = simulated.as_ref().map(|(simulation, world)| (simulation.clone(), world));
    // A camera renders its world first, which takes a while: the clocks start when it is ready.
    let camera = drive::camera(&config.camera, simulation.as_ref())?.context("there is no camera to localize with")?;
    let start = match &config.camera {
        Camera::Simulated => Some(SIMULATED_START),
        Camera::Replay(replay) => Some(drive::first_clocks(&replay.recording)?),
        _ => None,
    };
    let speed = config.simulation.as_ref().map_or(1.0, |simulation| simulation.speed) * config.replay_speed;
    let clock = drive::clock(start, speed, simulation.as_ref().map(|(simulation, _)| simulation));

    let date = DateWatch::new(&clock, start.is_none());
    let recorder = start_recorder(config, calibration, &clock)?;

    let frames = Arc::new(Newest::default());
    let shared = Arc::<Mutex<Shared>>::default();
    let health = Arc::new(Mutex::new("starting"));
    let stop = Stop::default();
    let camera = start_camera(camera, &frames, &health, &clock, &stop)?;
    let outputs = Arc::new(outputs);
    let sinks = Sinks { outputs: outputs.clone(), recorder: recorder.as_ref().map(Recorder::handle) };
    let localizer = start_localizer(session, &frames, &shared, sinks, &date)?;

    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().context("starting the runtime")?;
    let second = Duration::from_secs_f64(1.0 / speed);
    let mut watch = Watch { frames, shared, health, map: watched, system: SystemMonitor::default(), date, clock };
    let outcome = runtime.block_on(until_stopped(&mut watch, second, &localizer, each_second));

    stop.stop();
    runtime.block_on(join_within(&[camera], STOP_LIMIT));
    watch.frames.close();
    runtime.block_on(join_within(&[localizer], STOP_LIMIT));
    outcome?;
    let status = watch.status(0.0);
    let error = watch.shared().error.take();
    let recorder = recorder.map(|recorder| recorder.finish(RECORDER_STOP_LIMIT));
    // The localizer's thread has its own handle; once that has ended this is the last.
    let outputs = Arc::try_unwrap(outputs).map_or_else(|outputs| outputs.reports(), Outputs::finish);
    match error {
        Some(error) => Err(error).with_context(|| config.map.file.display().to_string()),
        None => Ok(LocalizeReport { status, outputs, recorder }),
    }
}

/// Opens a map, without reading more of it than it says of the whole.
pub fn open_map(path: &Path) -> anyhow::Result<OpenMap> {
    let context = || format!("loading the map {}", path.display());
    let file = fs::File::open(path).with_context(context)?;
    OpenMap::open(Box::new(file)).with_context(context)
}

/// What localizes on `map`, as `config` says.
pub fn start_session(map: OpenMap, config: &LocalizeConfig) -> anyhow::Result<Session> {
    Session::new(map, config.motion, config.map.memory_bytes())
        .with_context(|| format!("loading the map {}", config.map.file.display()))
}

fn start_camera(
    mut camera: DeviceRun<CameraEvent>,
    frames: &Arc<Newest>,
    health: &Arc<Mutex<&'static str>>,
    clock: &Arc<dyn Clock>,
    stop: &Stop,
) -> anyhow::Result<JoinHandle<()>> {
    let (to, ended, health, well) = (frames.clone(), frames.clone(), health.clone(), health.clone());
    let run = move |clock: &dyn Clock, stop: &Stop| {
        camera(clock, stop, &mut |event| {
            *lock(&well) = "ok";
            to.push(event);
        })
    };
    let report = move |outcome| match outcome {
        supervisor::Outcome::Failed { health: word } => *lock(&health) = word,
        supervisor::Outcome::Ended => {
            *lock(&health) = "ended";
            ended.close();
        }
    };
    supervise("camera", clock.clone(), stop.clone(), run, report).context("starting the thread camera")
}

/// Where estimates go.
struct Sinks {
    outputs: Arc<Outputs>,
    recorder: Option<RecorderHandle>,
}

impl Sinks {
    fn send(&self, estimate: &PositionEstimate, utc_ns: Option<i64>) {
        self.outputs.send(estimate, utc_ns);
        if let Some(recorder) = &self.recorder {
            recorder.push_estimate(estimate);
        }
    }
}

fn start_recorder(
    config: &LocalizeConfig,
    calibration_json: Vec<u8>,
    clock: &Arc<dyn Clock>,
) -> anyhow::Result<Option<Recorder>> {
    let Some(settings) = &config.recorder else { return Ok(None) };
    let boot_id = drive::boot_id();
    let mut head = Head::new(&config.resolved(), &config.vehicle.name, &boot_id, clock.read());
    head.calibration_json = Some(calibration_json);
    head.name_source(&config.vehicle.name);
    head.name_command("localize");
    Ok(Some(drive::start_recorder(settings, head, &boot_id, clock)?))
}

fn start_localizer(
    mut session: Session,
    frames: &Arc<Newest>,
    shared: &Arc<Mutex<Shared>>,
    sinks: Sinks,
    date: &DateWatch,
) -> anyhow::Result<JoinHandle<()>> {
    let (frames, shared, date) = (frames.clone(), shared.clone(), date.clone());
    let run = move || {
        while let Some(event) = frames.next() {
            match session.take(&event) {
                Ok(Some(estimate)) => sinks.send(&estimate, date.utc_ns(estimate.stamp_ns)),
                Ok(None) => {}
                Err(error) => {
                    lock(&shared).error = Some(error);
                    return;
                }
            }
            let mut shared = lock(&shared);
            (shared.counts, shared.last) = (session.counts(), session.last().copied());
            shared.timings = *session.timings();
        }
    };
    std::thread::Builder::new().name("localizer".into()).spawn(run).context("starting the thread localizer")
}

/// Whether the clock is right, looked at once a second.
#[derive(Clone)]
struct DateWatch {
    clock: Arc<dyn Clock>,
    /// A simulated or replayed clock is.
    is_of_computer: bool,
    is_known: Arc<AtomicBool>,
}

impl DateWatch {
    fn new(clock: &Arc<dyn Clock>, is_of_computer: bool) -> Self {
        let watch = Self { clock: clock.clone(), is_of_computer, is_known: Arc::default() };
        watch.look();
        watch
    }

    fn look(&self) {
        let is_known = !self.is_of_computer || knows_date(self.clock.read().realtime_ns);
        self.is_known.store(is_known, Ordering::Relaxed);
    }

    /// UTC of a stamp, if it is known.
    fn utc_ns(&self, stamp_ns: u64) -> Option<i64> {
        let now = self.clock.read();
        let utc_ns = now.realtime_ns - (now.monotonic_ns as i64 - stamp_ns as i64);
        self.is_known.load(Ordering::Relaxed).then_some(utc_ns)
    }
}

/// What is looked at once a second.
struct Watch {
    frames: Arc<Newest>,
    shared: Arc<Mutex<Shared>>,
    health: Arc<Mutex<&'static str>>,
    map: MapWatch,
    system: SystemMonitor,
    date: DateWatch,
    clock: Arc<dyn Clock>,
}

impl Watch {
    fn shared(&self) -> std::sync::MutexGuard<'_, Shared> {
        lock(&self.shared)
    }

    fn status(&mut self, frames_per_s: f64) -> LocalizeStatus {
        let system = self.system.look(self.clock.monotonic_ns());
        let shared = self.shared();
        LocalizeStatus {
            camera_health: *lock(&self.health),
            counts: shared.counts,
            passed_over: self.frames.passed_over(),
            frames_per_s,
            last: shared.last,
            timings: shared.timings,
            system,
        }
    }
}

async fn until_stopped(
    watch: &mut Watch,
    second: Duration,
    localizer: &JoinHandle<()>,
    mut each_second: impl FnMut(&LocalizeStatus) -> String,
) -> anyhow::Result<()> {
    let mut stop_signals = StopSignals::listen()?;
    let service = Service::ready();
    let mut seconds = tokio::time::interval(second);
    seconds.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let mut frames_before = 0;
    loop {
        select! {
            _ = seconds.tick() => {
                watch.map.look();
                watch.date.look();
                let frames = watch.shared().counts.frames;
                let status = watch.status((frames - frames_before) as f64);
                // Frames that come and are not looked at.
                let hangs = status.camera_health == "ok" && frames == frames_before;
                frames_before = frames;
                let line = each_second(&status);
                service.second([if hangs { "silent" } else { status.camera_health }], &line);
                if localizer.is_finished() {
                    info!("all frames are done with");
                    return Ok(());
                }
            }
            () = stop_signals.received() => {
                service.stopping();
                return Ok(());
            }
        }
    }
}

/// Notices when the file of the map is changed: what runs is the map as it was read.
struct MapWatch {
    path: PathBuf,
    facts: Option<[u64; 4]>,
}

impl MapWatch {
    fn new(path: &Path) -> Self {
        Self { path: path.into(), facts: facts(path).ok() }
    }

    fn look(&mut self) {
        let now = facts(&self.path);
        if now.as_ref().ok() == self.facts.as_ref() {
            return;
        }
        match &now {
            Ok(_) => warn!(map = %self.path.display(), "the map's file was changed: start again to use it"),
            Err(error) => {
                warn!(map = %self.path.display(), %error, "the map's file is gone: going on with what was read")
            }
        }
        self.facts = now.ok();
    }
}

/// What changes with a file.
fn facts(path: &Path) -> io::Result<[u64; 4]> {
    let facts = fs::metadata(path)?;
    Ok([facts.ino(), facts.len(), facts.mtime() as u64, facts.mtime_nsec() as u64])
}

fn lock<T>(mutex: &Mutex<T>) -> std::sync::MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
