//! What is wrong with this computer and its devices, and what to do about it.
//!
//! Devices are looked at through the drivers that a drive uses, so that what the doctor sees is what a drive will see. Each
//! look is turned into [`Finding`]s by a function that knows no device: those are tested without one.

mod camera;
mod computer;
mod disk;
mod pins;
mod receiver;

use std::{
    collections::BTreeMap,
    path::Path,
    sync::{Arc, mpsc},
    thread,
    time::{Duration, Instant},
};

use anyhow::Context;
use serde::Serialize;

use crate::{
    config::{Camera, Gnss, LocalizeConfig, RecordConfig},
    devices::{
        DeviceError, Stop,
        gpio::{self, Led},
    },
    map::MapInfo,
    runtime::{
        drive::{self, SIMULATED_START},
        live::DeviceRun,
        localize::live::open_map,
    },
    types::{Clock, ClockReading, DonutCalibration},
};

/// One thing that was looked at.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Finding {
    /// A short fixed phrase.
    pub check: &'static str,
    pub verdict: Verdict,
    pub found: String,
    /// What to do; empty where all is well.
    #[serde(skip_serializing_if = "String::is_empty")]
    pub advice: String,
    /// What was measured, for programs; names end with their units.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub figures: BTreeMap<&'static str, u64>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Verdict {
    Ok,
    /// It works, but not as it should.
    Warning,
    /// So it cannot work.
    Problem,
}

impl Finding {
    fn ok(check: &'static str, found: impl Into<String>) -> Self {
        Self { check, verdict: Verdict::Ok, found: found.into(), advice: String::new(), figures: BTreeMap::new() }
    }

    fn warning(check: &'static str, found: impl Into<String>, advice: impl Into<String>) -> Self {
        Self { verdict: Verdict::Warning, advice: advice.into(), ..Self::ok(check, found) }
    }

    fn problem(check: &'static str, found: impl Into<String>, advice: impl Into<String>) -> Self {
        Self { verdict: Verdict::Problem, advice: advice.into(), ..Self::ok(check, found) }
    }
}

/// What is to work.
#[derive(Debug)]
pub enum Purpose {
    Record(Box<RecordConfig>),
    Localize(Box<LocalizeConfig>),
}

/// Looks at everything that `purpose` needs; `each` is told what was found, as it is found.
///
/// # Errors
/// When a simulated or replayed device cannot be set up. What is wrong with real ones is a finding.
pub fn examine(purpose: &Purpose, mut each: impl FnMut(Finding)) -> anyhow::Result<()> {
    let mut tell = |findings: Vec<Finding>| findings.into_iter().for_each(&mut each);
    let (simulation, chosen, vehicle) = match purpose {
        Purpose::Record(config) => (&config.simulation, &config.camera, &config.vehicle),
        Purpose::Localize(config) => (&config.simulation, &config.camera, &config.vehicle),
    };
    let simulated = simulation.as_ref().map(drive::simulate);
    let simulation = simulated.as_ref().map(|(simulation, world)| (simulation.clone(), world));
    let start = match (&simulation, chosen) {
        (Some(_), _) => Some(SIMULATED_START),
        (None, Camera::Replay(replay)) => Some(drive::first_clocks(&replay.recording)?),
        (None, _) => None,
    };

    let known = vehicle.calibration.as_deref().map(read_calibration).transpose();
    let mut expected = camera::Expected::Calibration(known.unwrap_or_else(|error| {
        let advice = "`omniloc calibrate` makes one; without the key nothing is calibrated yet";
        tell(vec![Finding::problem("calibration", format!("{error:#}"), advice)]);
        None
    }));
    if let Purpose::Localize(config) = purpose {
        match open_map(&config.map.file) {
            Ok(map) => {
                let cells = map.cells.len();
                tell(of_map(&config.map.file, cells, &map.info, config.outputs.has_nmea()));
                expected = camera::Expected::Map(Box::new(map.info));
            }
            Err(error) => {
                let advice = "copy it there again, or train it: omniloc train REC --out AREA.map";
                tell(vec![Finding::problem("map", format!("{error:#}"), advice)]);
            }
        }
    }

    let camera = drive::camera(chosen, simulation.as_ref())?;
    let speed = simulation.as_ref().map_or(1.0, |(simulation, _)| simulation.settings.speed);
    let clock = drive::clock(start, speed, simulation.as_ref().map(|(simulation, _)| simulation));
    let mut bytes_per_s = None;
    match camera {
        None => tell(vec![Finding::ok("camera", "none is asked for")]),
        Some(camera) => {
            let look = camera::Look::at(camera, &clock);
            bytes_per_s = look.bytes_per_s();
            tell(camera::findings(&look, chosen, &expected));
        }
    }
    if let Purpose::Record(config) = purpose {
        let ports = tempfile::tempdir().context("making a folder for pseudo-terminals")?;
        let stop = Stop::default();
        match drive::gnss(config, simulation.as_ref(), ports.path(), &clock, &stop)? {
            None => tell(vec![Finding::ok("receiver", "none is asked for")]),
            Some(line) => {
                let look = receiver::Look::at(line.driver, &config.decoder, &clock);
                let port = match &config.gnss {
                    Gnss::Serial(settings) => Some(settings.port.as_path()),
                    _ => None,
                };
                tell(receiver::findings(&look, port));
                stop.stop();
                if let Some(player) = line.player {
                    let _ = player.join();
                }
            }
        }
        if config.gpio.driver != gpio::Driver::None
            && let Some(pins) =
                drive::pins(config, simulation.as_ref().map(|(simulation, _)| simulation), &Led::default())?
        {
            tell(pins::findings(&pins::Look::at(pins, &clock), &config.gpio));
        }
    }
    let recorder = match purpose {
        Purpose::Record(config) => Some(&config.recorder),
        Purpose::Localize(config) => config.recorder.as_ref(),
    };
    if let Some(recorder) = recorder {
        tell(disk::examine(recorder, bytes_per_s));
    }
    tell(computer::examine());
    Ok(())
}

/// What the map is, and whether it is enough for what is to be said.
fn of_map(path: &Path, cells: usize, info: &MapInfo, says_nmea: bool) -> Vec<Finding> {
    let found = format!("{}: {cells} cells, {} groups", path.display(), info.groups.len());
    let mut findings = vec![Finding::ok("map", found)];
    if says_nmea && info.origin.is_none() {
        let advice =
            "survey with a receiver, or `omniloc import --origin`, and train again; or take outputs.nmea_* out";
        let found = "NMEA is to be sent, but the map does not know where on Earth it lies";
        findings.push(Finding::problem("outputs", found, advice));
    }
    findings
}

fn read_calibration(path: &Path) -> anyhow::Result<DonutCalibration> {
    let json = drive::read_calibration(path)?;
    Ok(serde_json::from_slice(&json)?)
}

/// Runs a device until it ends, `limit` has passed or `each` has seen enough; `each` is given its events with the time
/// since the start. A device that fails is not started again.
fn look_at<Event: Send + 'static>(
    mut device: DeviceRun<Event>,
    clock: &Arc<dyn Clock>,
    limit: Duration,
    mut each: impl FnMut(Event, ClockReading) -> bool,
) -> Result<(), DeviceError> {
    /// A driver that does not stop within this hangs, and is left behind.
    const STOP_LIMIT: Duration = Duration::from_secs(3);
    let (sender, events) = mpsc::channel();
    let (stop, clocks) = (Stop::default(), clock.clone());
    let stops = stop.clone();
    let thread = thread::spawn(move || device(&*clocks, &stops, &mut |event| _ = sender.send(event)));
    let deadline = Instant::now() + limit;
    loop {
        let left = deadline.saturating_duration_since(Instant::now());
        let Ok(event) = events.recv_timeout(left) else { break };
        if !each(event, clock.read()) {
            break;
        }
    }
    stop.stop();
    let deadline = Instant::now() + STOP_LIMIT;
    while !thread.is_finished() && Instant::now() < deadline {
        thread::sleep(Duration::from_millis(10));
    }
    match thread.is_finished() {
        true => thread.join().unwrap_or(Ok(())),
        false => Err(DeviceError::TimedOut { device: "the driver".into(), silence_s: STOP_LIMIT.as_secs_f64() }),
    }
}

/// What a device that fails says of itself, without what [`advice`] has.
fn fault(error: &DeviceError) -> String {
    match error {
        DeviceError::NotPermitted { device, .. } => format!("{device} may not be opened"),
        error => error.to_string(),
    }
}

/// What to do about a device that fails. `list`: a folder with the names of those that are there.
fn advice(error: &DeviceError, key: &str, list: &Path) -> String {
    match error {
        DeviceError::NotPresent { .. } => match names_in(list).as_slice() {
            [] => format!("plug it in; none of its kind is there ({} is empty)", list.display()),
            names => format!("plug it in, or set `{key}` to what is there: {}", names.join(", ")),
        },
        DeviceError::Busy { .. } => {
            "stop the program that uses it: systemctl stop omniloc-record omniloc-localize, or see `fuser -v` on it"
                .into()
        }
        DeviceError::NotPermitted { hint, .. } => hint.clone(),
        DeviceError::TimedOut { .. } => "check cable and power; plug it out and in again".into(),
        DeviceError::Disconnected { .. } => {
            "check plug, cable and power supply: it vanished while it was looked at".into()
        }
        DeviceError::Unsupported { .. } => "change the configuration to what it offers".into(),
        DeviceError::BadData { .. } => "check cable and settings; plug it out and in again".into(),
        DeviceError::Io { .. } => "plug it out and in again; `dmesg` may know more".into(),
    }
}

fn names_in(folder: &Path) -> Vec<String> {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    let mut names: Vec<String> = entries.map(|entry| entry.path().display().to_string()).collect();
    names.sort_unstable();
    names
}
