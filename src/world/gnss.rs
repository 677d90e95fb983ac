//! A satellite receiver's opinion of where the vehicle is.

use std::ops::Range;

use rand::Rng;
use rand_chacha::ChaCha8Rng;

use super::{
    Drive,
    random::{Stream, standard_normal, stream},
};
use crate::types::{Geodetic, LocalFrame, PositionM, wrap_angle_rad};

/// How wrong the receiver is. All deviations are of one axis.
#[derive(Debug, Clone, PartialEq)]
pub struct ReceiverSettings {
    pub rate_hz: f64,
    /// Slow error of the position: a first-order Gauss-Markov process of this deviation and correlation time.
    pub drift_std_m: f64,
    pub drift_time_s: f64,
    /// Fast error of the position, new in every sample.
    pub position_noise_std_m: f64,
    /// How much larger both are upwards.
    pub vertical_factor: f64,
    /// Error of the yaw that stays for the whole drive, and the one that is new in every sample.
    pub yaw_bias_std_rad: f64,
    pub yaw_noise_std_rad: f64,
    pub velocity_noise_std_mps: f64,
    pub outages: Outages,
}

/// When the receiver has no position, and when it has a wrong one.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Outages {
    /// From, to \[s\]: no fix.
    pub tunnels_s: Vec<Range<f64>>,
    /// From, to \[s\], and by how much the position is off.
    pub jumps: Vec<(Range<f64>, PositionM)>,
}

impl Outages {
    /// `tunnels` of 5 to 20 s and `jumps` of 5 to 40 m for 1 to 5 s, anywhere in `duration_s`.
    pub fn random(seed: u64, duration_s: f64, tunnels: usize, jumps: usize) -> Self {
        let mut random = stream(seed, Stream::Outages);
        let mut interval = |length_s: Range<f64>| {
            let length_s = random.random_range(length_s);
            let from_s = random.random_range(0.0..(duration_s - length_s).max(1e-3));
            (from_s..from_s + length_s, random.random_range(0.0..std::f64::consts::TAU), random.random_range(5.0..40.0))
        };
        Self {
            tunnels_s: (0..tunnels).map(|_| interval(5.0..20.0).0).collect(),
            jumps: (0..jumps)
                .map(|_| {
                    let (when_s, direction_rad, length_m) = interval(1.0..5.0);
                    (when_s, [length_m * direction_rad.cos(), length_m * direction_rad.sin()])
                })
                .collect(),
        }
    }
}

impl Default for ReceiverSettings {
    /// A GNSS/INS unit of the class of the Xsens MTi-G-700 under open sky.
    fn default() -> Self {
        Self {
            rate_hz: 100.0,
            drift_std_m: 0.6,
            drift_time_s: 60.0,
            position_noise_std_m: 0.02,
            vertical_factor: 1.5,
            yaw_bias_std_rad: 0.5_f64.to_radians(),
            yaw_noise_std_rad: 0.2_f64.to_radians(),
            velocity_noise_std_mps: 0.05,
            outages: Outages::default(),
        }
    }
}

/// What the receiver says at one instant.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ReceiverSample {
    /// Since the drive began.
    pub time_s: f64,
    /// Without a fix: the last one.
    pub position: Geodetic,
    /// East, north, up: one standard deviation, as the receiver believes it.
    pub position_std_m: [f64; 3],
    /// From east, counter-clockwise, in (−π, π].
    pub yaw_rad: f64,
    pub yaw_std_rad: f64,
    /// East, north, up.
    pub velocity_enu_mps: [f64; 3],
    pub has_fix: bool,
}

/// Samples without end, evenly in time from 0 on.
#[derive(Debug, Clone)]
pub struct Receiver {
    drive: Drive,
    settings: ReceiverSettings,
    frame: LocalFrame,
    random: ChaCha8Rng,
    yaw_bias_rad: f64,
    drift_m: [f64; 3],
    next: u64,
    last_position: Geodetic,
}

impl Receiver {
    pub fn new(drive: &Drive, origin: Geodetic, seed: u64, settings: ReceiverSettings) -> Self {
        let mut random = stream(seed, Stream::Receiver);
        let yaw_bias_rad = settings.yaw_bias_std_rad * standard_normal(&mut random);
        // The drift begins as it goes on: stationary.
        let drift_m = axes(&settings).map(|factor| factor * settings.drift_std_m * standard_normal(&mut random));
        let frame = LocalFrame::new(origin);
        let last_position = frame.plane_to_geodetic(drive.pose_at(0.0).position_m);
        Self { drive: drive.clone(), settings, frame, random, yaw_bias_rad, drift_m, next: 0, last_position }
    }

    /// Goes on by one step: x ← φ x + σ √(1 − φ²) n with φ = exp(−Δt / τ).
    fn advance_drift(&mut self) {
        let settings = &self.settings;
        let kept = (-1.0 / (settings.rate_hz * settings.drift_time_s)).exp();
        let fresh = settings.drift_std_m * (1.0 - kept * kept).sqrt();
        for (drift_m, factor) in self.drift_m.iter_mut().zip(axes(&self.settings)) {
            *drift_m = kept * *drift_m + factor * fresh * standard_normal(&mut self.random);
        }
    }
}

/// Factors on the deviations east, north, up.
fn axes(settings: &ReceiverSettings) -> [f64; 3] {
    [1.0, 1.0, settings.vertical_factor]
}

impl Iterator for Receiver {
    type Item = ReceiverSample;

    fn next(&mut self) -> Option<ReceiverSample> {
        let time_s = self.next as f64 / self.settings.rate_hz;
        if self.next > 0 {
            self.advance_drift();
        }
        self.next += 1;
        let pose = self.drive.pose_at(time_s);
        let settings = &self.settings;
        let jumped_m =
            settings.outages.jumps.iter().find(|(when_s, _)| when_s.contains(&time_s)).map(|(_, by_m)| *by_m);
        let has_fix = !settings.outages.tunnels_s.iter().any(|when_s| when_s.contains(&time_s));
        let truth_m = [pose.position_m[0], pose.position_m[1], 0.0];
        let wrong_m = jumped_m.map_or([0.0; 3], |[east_m, north_m]| [east_m, north_m, 0.0]);
        let mut enu_m = [0.0; 3];
        for (axis, factor) in axes(settings).into_iter().enumerate() {
            let noise_m = factor * settings.position_noise_std_m * standard_normal(&mut self.random);
            enu_m[axis] = truth_m[axis] + wrong_m[axis] + self.drift_m[axis] + noise_m;
        }
        let yaw_noise_rad = settings.yaw_noise_std_rad * standard_normal(&mut self.random);
        let (sin, cos) = pose.yaw_rad.sin_cos();
        let velocity_mps = [pose.speed_mps * cos, pose.speed_mps * sin, 0.0];
        let velocity_enu_mps =
            velocity_mps.map(|v| v + settings.velocity_noise_std_mps * standard_normal(&mut self.random));
        if has_fix {
            self.last_position = self.frame.to_geodetic(enu_m);
        }
        let position_std_m = settings.drift_std_m.hypot(settings.position_noise_std_m);
        Some(ReceiverSample {
            time_s,
            position: self.last_position,
            position_std_m: axes(settings).map(|factor| factor * position_std_m),
            yaw_rad: wrap_angle_rad(pose.yaw_rad + self.yaw_bias_rad + yaw_noise_rad),
            yaw_std_rad: settings.yaw_bias_std_rad.hypot(settings.yaw_noise_std_rad),
            velocity_enu_mps,
            has_fix,
        })
    }
}
