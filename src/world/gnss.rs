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

impl ReceiverSettings {
    /// # Errors
    /// What is wrong with them, in words.
    pub fn check(&self) -> Result<(), String> {
        let values = [
            ("rate_hz", self.rate_hz, 0.1..=1000.0),
            ("drift_std_m", self.drift_std_m, 0.0..=1000.0),
            ("drift_time_s", self.drift_time_s, 0.1..=1e6),
            ("position_noise_std_m", self.position_noise_std_m, 0.0..=1000.0),
            ("vertical_factor", self.vertical_factor, 0.0..=100.0),
            ("yaw_bias_std_rad", self.yaw_bias_std_rad, 0.0..=4.0),
            ("yaw_noise_std_rad", self.yaw_noise_std_rad, 0.0..=4.0),
            ("velocity_noise_std_mps", self.velocity_noise_std_mps, 0.0..=100.0),
        ];
        match values.into_iter().find(|(_, found, range)| !range.contains(found)) {
            Some((key, found, range)) => {
                Err(format!("{key} is {found}, expected {} to {}", range.start(), range.end()))
            }
            None => Ok(()),
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
    /// # Panics
    /// When the settings do not pass their [`check`](ReceiverSettings::check).
    pub fn new(drive: &Drive, origin: Geodetic, seed: u64, settings: ReceiverSettings) -> Self {
        settings.check().expect("whoever read the settings checked them");
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        types::NS_PER_S,
        world::{DriveSettings, World},
    };

    fn world_and_drive() -> (World, Drive) {
        let world = World::corridor(1);
        let drive = Drive::new(&world, &DriveSettings::default());
        (world, drive)
    }

    fn errors_m(seed: u64, settings: &ReceiverSettings, count: usize) -> Vec<[f64; 3]> {
        let (world, drive) = world_and_drive();
        let frame = LocalFrame::new(world.origin);
        Receiver::new(&drive, world.origin, seed, settings.clone())
            .take(count)
            .map(|sample| {
                let [x, y] = drive.pose_at(sample.time_s).position_m;
                let [east, north, up] = frame.to_enu_m(sample.position);
                [east - x, north - y, up]
            })
            .collect()
    }

    #[test]
    fn the_position_error_has_the_deviation_and_the_correlation_it_is_said_to_have() {
        // One sample a second for 200 correlation times, of eight receivers.
        let settings = ReceiverSettings { rate_hz: 1.0, position_noise_std_m: 0.0, ..ReceiverSettings::default() };
        let (mut squares, mut products, mut n) = ([0.0; 3], 0.0, 0.0);
        for seed in 0..8 {
            let errors = errors_m(seed, &settings, 12_000);
            for pair in errors.windows(61) {
                (0..3).for_each(|axis| squares[axis] += pair[0][axis].powi(2));
                products += pair[0][0] * pair[60][0];
                n += 1.0;
            }
        }
        let [east, north, up] = squares.map(|sum: f64| (sum / n).sqrt());
        // About 800 independent values: the deviation is known to 2.5 %, taken three times.
        assert!((east - 0.6).abs() < 0.05 && (north - 0.6).abs() < 0.05, "{east} {north}");
        assert!((up - 0.9).abs() < 0.08, "{up}");
        let correlation = products / squares[0];
        assert!((correlation - (-1.0_f64).exp()).abs() < 0.08, "{correlation} after one correlation time");
    }

    #[test]
    fn the_rate_does_not_change_the_drift() {
        let at_rate = |rate_hz: f64| {
            let settings = ReceiverSettings { rate_hz, position_noise_std_m: 0.0, ..ReceiverSettings::default() };
            let errors = errors_m(1, &settings, (600.0 * rate_hz) as usize);
            let steps = (10.0 * rate_hz) as usize;
            let change: f64 = errors.iter().zip(&errors[steps..]).map(|(a, b)| (b[0] - a[0]).powi(2)).sum();
            (change / (errors.len() - steps) as f64).sqrt()
        };
        // After Δt the error has changed by σ √(2 (1 − exp(−Δt / τ))).
        let expected_m = 0.6 * (2.0 * (1.0 - (-10.0_f64 / 60.0).exp())).sqrt();
        for rate_hz in [1.0, 10.0, 100.0] {
            assert!((at_rate(rate_hz) / expected_m - 1.0).abs() < 0.35, "{} {expected_m}", at_rate(rate_hz));
        }
    }

    #[test]
    fn yaw_has_a_bias_that_stays_and_noise_that_does_not() {
        let (world, drive) = world_and_drive();
        let (mut biases, mut noise) = (0.0, 0.0);
        for seed in 0..200 {
            let receiver = Receiver::new(&drive, world.origin, seed, ReceiverSettings::default());
            let errors: Vec<f64> = receiver
                .take(100)
                .map(|sample| wrap_angle_rad(sample.yaw_rad - drive.pose_at(sample.time_s).yaw_rad).to_degrees())
                .collect();
            let mean = errors.iter().sum::<f64>() / 100.0;
            biases += mean * mean / 200.0;
            noise += errors.iter().map(|error| (error - mean).powi(2)).sum::<f64>() / 99.0 / 200.0;
        }
        assert!((biases.sqrt() - 0.5).abs() < 0.08, "{}", biases.sqrt());
        assert!((noise.sqrt() - 0.2).abs() < 0.01, "{}", noise.sqrt());
    }

    #[test]
    fn tunnels_have_no_fix_and_jumps_are_off_by_what_was_asked_for() {
        let (world, drive) = world_and_drive();
        let outages = Outages { tunnels_s: vec![2.0..3.0], jumps: vec![(5.0..6.0, [30.0, -40.0])] };
        let settings = ReceiverSettings { outages, ..ReceiverSettings::default() };
        let frame = LocalFrame::new(world.origin);
        let samples: Vec<ReceiverSample> = Receiver::new(&drive, world.origin, 3, settings).take(800).collect();
        assert_eq!(samples.iter().filter(|sample| !sample.has_fix).count(), 100);
        assert_eq!(samples[200].position, samples[199].position, "the last position is kept");
        let error_m = |sample: &ReceiverSample| {
            let [x, y] = drive.pose_at(sample.time_s).position_m;
            let [east, north, _] = frame.to_enu_m(sample.position);
            (east - x).hypot(north - y)
        };
        assert!((error_m(&samples[550]) - 50.0).abs() < 4.0, "{}", error_m(&samples[550]));
        assert!(error_m(&samples[650]) < 4.0);
    }

    #[test]
    fn velocity_is_that_of_the_position() {
        let (world, drive) = world_and_drive();
        let exact = ReceiverSettings {
            drift_std_m: 0.0,
            position_noise_std_m: 0.0,
            velocity_noise_std_mps: 0.0,
            ..ReceiverSettings::default()
        };
        let frame = LocalFrame::new(world.origin);
        let samples: Vec<ReceiverSample> = Receiver::new(&drive, world.origin, 3, exact).take(6000).collect();
        for pair in samples.windows(3).step_by(50) {
            let [a, b] = [pair[0], pair[2]].map(|sample| frame.to_enu_m(sample.position));
            for axis in 0..2 {
                let moved_mps = (b[axis] - a[axis]) / 0.02;
                assert!((moved_mps - pair[1].velocity_enu_mps[axis]).abs() < 0.03, "{pair:?}");
            }
        }
        assert_eq!(((samples[100].time_s - samples[0].time_s) * NS_PER_S as f64).round(), NS_PER_S as f64);
    }

    #[test]
    fn random_outages_lie_within_the_drive_and_follow_from_the_seed() {
        let outages = Outages::random(4, 300.0, 2, 3);
        assert_eq!(outages, Outages::random(4, 300.0, 2, 3));
        assert_ne!(outages, Outages::random(5, 300.0, 2, 3));
        assert_eq!((outages.tunnels_s.len(), outages.jumps.len()), (2, 3));
        assert!(outages.tunnels_s.iter().all(|when_s| when_s.start >= 0.0 && when_s.end <= 300.0), "{outages:?}");
    }
}
