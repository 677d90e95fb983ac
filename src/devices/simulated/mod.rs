//! Devices that are not there: a camera and a receiver in a simulated world, with faults on request.
//!
//! The receiver's bytes go through a pseudo-terminal into the real serial driver; frames come from a renderer with the
//! clock's pace. What the vehicle does is a function of time alone, so that camera and receiver agree.

mod camera;
mod receiver;

use serde::{Deserialize, Serialize};

pub use camera::SimulatedCamera;
pub use receiver::SimulatedReceiver;

use crate::{
    types::NS_PER_S,
    world::{self, Camera, CameraError, Day, Drive, DriveSettings, Outages, Pose, Renderer, World},
};

/// The table `[simulation]`: what is driven through, and what goes wrong.
#[derive(Debug, Clone, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct Settings {
    pub place: Place,
    /// Another seed is another place.
    #[serde(default = "default_seed")]
    pub place_seed: u64,
    /// Light, traffic and parked cars of one day.
    #[serde(default = "default_seed")]
    pub day_seed: u64,
    /// Speeds, stops and noise of one drive.
    #[serde(default = "default_seed")]
    pub drive_seed: u64,
    /// How far right of the usual lane the vehicle is driven.
    #[serde(default)]
    pub lane_shift_m: f64,
    /// The drive ends after this time; without it, when the whole route has been driven once.
    pub duration_s: Option<f64>,
    /// How many times as fast as real time the drive passes.
    #[serde(default = "default_speed")]
    pub speed: f64,
    #[serde(default = "default_width_px")]
    pub width_px: u32,
    #[serde(default = "default_height_px")]
    pub height_px: u32,
    #[serde(default = "default_frame_rate_hz")]
    pub frame_rate_hz: f64,
    #[serde(default)]
    pub receiver: Receiver,
    #[serde(default)]
    pub faults: Vec<Fault>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Place {
    Town,
    Corridor,
}

/// The simulated receiver and its serial line: the table `[simulation.receiver]`.
#[derive(Debug, Clone, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct Receiver {
    #[serde(default)]
    pub protocol: ReceiverProtocol,
    #[serde(default = "default_receiver_rate_hz")]
    pub rate_hz: f64,
    /// Smallest time from a sample to the arrival of its last byte.
    #[serde(default = "default_latency_s")]
    pub latency_s: f64,
    /// Mean of what comes on top, exponentially distributed.
    #[serde(default = "default_jitter_s")]
    pub jitter_s: f64,
    /// The pulse a second is wired to a pin.
    #[serde(default = "default_pulse")]
    pub pulse: bool,
    /// One standard deviation of the position, each axis; it wanders over a minute.
    #[serde(default = "default_position_std_m")]
    pub position_std_m: f64,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Deserialize, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum ReceiverProtocol {
    /// As the Arduino sends it.
    #[default]
    Nmea,
    Xbus,
}

/// Something that goes wrong for a while.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct Fault {
    pub kind: FaultKind,
    /// After the start of the drive.
    pub at_s: f64,
    #[serde(default = "default_lasts_s")]
    pub lasts_s: f64,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum FaultKind {
    /// The node vanishes and comes back.
    CameraUnplugged,
    /// The camera is there and sends nothing.
    CameraStalled,
    /// Frames end in the middle.
    FramesDamaged,
    /// The port vanishes and comes back.
    ReceiverUnplugged,
    ReceiverSilent,
    /// Random bytes instead of sentences.
    ReceiverGarbage,
    /// Bytes as a port at another rate sees them.
    ReceiverWrongBaud,
    /// Positions are 300 m off.
    PositionJump,
    /// The receiver works and sees no satellites.
    Tunnel,
    /// The computer's date is set back by ten years, for good.
    DateSet,
}

/// A jump is this far, east and north \[m\].
const JUMP_M: [f64; 2] = [300.0, 0.0];
/// Ten years, with the leap days among them.
pub const DATE_STEP_NS: i64 = -(3652 * 86_400 * NS_PER_S as i64);

fn default_seed() -> u64 {
    1
}

fn default_speed() -> f64 {
    1.0
}

fn default_width_px() -> u32 {
    1280
}

fn default_height_px() -> u32 {
    720
}

fn default_frame_rate_hz() -> f64 {
    30.0
}

fn default_receiver_rate_hz() -> f64 {
    100.0
}

fn default_latency_s() -> f64 {
    0.06
}

fn default_jitter_s() -> f64 {
    0.005
}

fn default_pulse() -> bool {
    true
}

fn default_position_std_m() -> f64 {
    0.6
}

fn default_lasts_s() -> f64 {
    5.0
}

impl Default for Receiver {
    fn default() -> Self {
        Self {
            protocol: ReceiverProtocol::default(),
            rate_hz: default_receiver_rate_hz(),
            latency_s: default_latency_s(),
            jitter_s: default_jitter_s(),
            pulse: default_pulse(),
            position_std_m: default_position_std_m(),
        }
    }
}

impl Settings {
    /// Refuses what no simulation can do.
    ///
    /// # Errors
    /// Which key, what was found and what is expected.
    pub fn check(&self) -> Result<(), String> {
        let within = |key: &str, found: f64, low: f64, high: f64| {
            if (low..=high).contains(&found) {
                Ok(())
            } else {
                Err(format!("{key} is {found}, expected {low} to {high}"))
            }
        };
        within("duration_s", self.duration_s.unwrap_or(1.0), 0.1, 86_400.0)?;
        within("speed", self.speed, 0.01, 1000.0)?;
        within("width_px", self.width_px.into(), 160.0, 4096.0)?;
        within("height_px", self.height_px.into(), 120.0, 4096.0)?;
        within("frame_rate_hz", self.frame_rate_hz, 0.1, 120.0)?;
        within("lane_shift_m", self.lane_shift_m, -1.0, 3.0)?;
        within("receiver.rate_hz", self.receiver.rate_hz, 1.0, 400.0)?;
        within("receiver.latency_s", self.receiver.latency_s, 0.0, 0.9)?;
        within("receiver.jitter_s", self.receiver.jitter_s, 0.0, 0.5)?;
        within("receiver.position_std_m", self.receiver.position_std_m, 0.0, 100.0)?;
        for fault in &self.faults {
            within("faults.at_s", fault.at_s, 0.0, 86_400.0)?;
            within("faults.lasts_s", fault.lasts_s, 0.0, 86_400.0)?;
        }
        Ok(())
    }

    pub fn world(&self) -> World {
        match self.place {
            Place::Town => World::town_block(self.place_seed),
            Place::Corridor => World::corridor(self.place_seed),
        }
    }

    /// The lens that the simulated camera looks into.
    pub fn camera(&self) -> Camera {
        let camera = match self.place {
            Place::Town => Camera::town(),
            Place::Corridor => Camera::corridor(),
        };
        camera.scaled_to(self.width_px as usize, self.height_px as usize)
    }

    /// When faults of this kind are, from the start of the drive.
    fn intervals_s(&self, kind: FaultKind) -> impl Iterator<Item = std::ops::Range<f64>> {
        let faults = self.faults.iter().filter(move |fault| fault.kind == kind);
        faults.map(|fault| fault.at_s..fault.at_s + fault.lasts_s)
    }

    fn has(&self, kind: FaultKind, time_s: f64) -> bool {
        self.intervals_s(kind).any(|interval_s| interval_s.contains(&time_s))
    }
}

/// A drive on the clock: what camera and receiver have in common.
#[derive(Debug, Clone)]
pub struct Simulation {
    pub settings: Settings,
    drive: Drive,
    /// When the drive begins, on the monotonic clock.
    start_ns: u64,
    /// UTC at that instant [ns since 1970].
    start_utc_ns: i64,
}

impl Simulation {
    pub fn new(settings: &Settings, world: &World, start_ns: u64, start_utc_ns: i64) -> Self {
        let drive = DriveSettings {
            seed: settings.drive_seed,
            lane_shift_m: settings.lane_shift_m,
            ..DriveSettings::default()
        };
        Self { settings: settings.clone(), drive: Drive::new(world, &drive), start_ns, start_utc_ns }
    }

    pub fn duration_s(&self) -> f64 {
        self.settings.duration_s.unwrap_or_else(|| self.drive.duration_s())
    }

    /// When faults of this kind are, on the clock.
    pub fn intervals_ns(&self, kind: FaultKind) -> impl Iterator<Item = std::ops::Range<u64>> {
        self.settings.intervals_s(kind).map(|interval_s| self.stamp_ns(interval_s.start)..self.stamp_ns(interval_s.end))
    }

    fn is_troubled_by(&self, kind: FaultKind, stamp_ns: u64) -> bool {
        self.settings.has(kind, self.time_s(stamp_ns))
    }

    /// The truth.
    pub fn pose_at(&self, stamp_ns: u64) -> Pose {
        self.drive.pose_at(self.time_s(stamp_ns))
    }

    fn time_s(&self, stamp_ns: u64) -> f64 {
        (stamp_ns as f64 - self.start_ns as f64) * 1e-9
    }

    fn stamp_ns(&self, time_s: f64) -> u64 {
        self.start_ns + (time_s * 1e9).round() as u64
    }

    fn utc_ns(&self, stamp_ns: u64) -> i64 {
        self.start_utc_ns + (stamp_ns as i64 - self.start_ns as i64)
    }

    /// Edges of the pulse during the drive: the stamps of whole UTC seconds.
    pub fn pulses(&self) -> impl Iterator<Item = u64> + Send + use<> {
        let into_second_ns = self.start_utc_ns.rem_euclid(NS_PER_S as i64) as u64;
        let first_ns = self.start_ns + (NS_PER_S - into_second_ns) % NS_PER_S;
        let end_ns = self.stamp_ns(if self.settings.receiver.pulse { self.duration_s() } else { 0.0 });
        (first_ns..end_ns).step_by(NS_PER_S as usize)
    }

    /// The camera of this drive.
    ///
    /// # Errors
    /// A camera that cannot be.
    pub fn camera(&self, world: &World) -> Result<SimulatedCamera, CameraError> {
        let settings = &self.settings;
        let renderer = Renderer::new(world, &Day::new(settings.day_seed), &settings.camera())?;
        Ok(SimulatedCamera::new(self.clone(), renderer))
    }

    /// The bytes of the receiver of this drive.
    pub fn receiver(&self, world: &World) -> SimulatedReceiver {
        let outages = Outages {
            tunnels_s: self.settings.intervals_s(FaultKind::Tunnel).collect(),
            jumps: self.settings.intervals_s(FaultKind::PositionJump).map(|when_s| (when_s, JUMP_M)).collect(),
        };
        let settings = world::ReceiverSettings {
            rate_hz: self.settings.receiver.rate_hz,
            drift_std_m: self.settings.receiver.position_std_m,
            outages,
            ..world::ReceiverSettings::default()
        };
        let samples = world::Receiver::new(&self.drive, world.origin, self.settings.drive_seed, settings);
        SimulatedReceiver::new(self.clone(), samples)
    }
}
