//! How a vehicle may have moved between two frames.

use super::belief::Mode;
use crate::types::PositionM;

/// A motion that is known to a deviation, the same on either axis.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Motion {
    pub mean_m: PositionM,
    pub std_m: f64,
}

/// Says how the vehicle has moved. [`ConstantVelocity`] needs nothing but the frames; whoever has odometry or a yaw rate
/// makes a model of them.
pub trait MotionModel: Send {
    /// The motion over the next `dt_s` seconds, at least 0.
    fn predict(&mut self, dt_s: f64) -> Motion;
    /// The pictures show that the vehicle has been slower than this.
    fn limit(&mut self, speed_mps: f64);
    /// What the last frame says of the position by itself. `None`: it is not known where the vehicle is, and motions so far
    /// mean nothing.
    fn observe(&mut self, seen: Option<&Mode>);
    /// East, north \[m/s\], if it is known.
    fn velocity_mps(&self) -> Option<[f64; 2]>;
}

/// What a vehicle can do.
#[derive(Debug, Clone, Copy, PartialEq, serde::Deserialize, serde::Serialize)]
#[serde(deny_unknown_fields, default)]
pub struct MotionSettings {
    /// No vehicle is faster.
    pub speed_limit_mps: f64,
    /// One standard deviation of the change of velocity over a second, on either axis.
    pub acceleration_mps2: f64,
    /// Deviation of the position over a second from any smooth motion, on either axis.
    pub diffusion_m: f64,
}

impl Default for MotionSettings {
    fn default() -> Self {
        Self { speed_limit_mps: 20.0, acceleration_mps2: 3.0, diffusion_m: 0.3 }
    }
}

impl MotionSettings {
    /// # Errors
    /// Says which value cannot be, and what is expected.
    pub fn check(&self) -> Result<(), String> {
        for (name, value, range) in [
            ("speed_limit_mps", self.speed_limit_mps, 0.1..=200.0),
            ("acceleration_mps2", self.acceleration_mps2, 0.01..=100.0),
            ("diffusion_m", self.diffusion_m, 0.001..=100.0),
        ] {
            if !range.contains(&value) {
                return Err(format!("{name} = {value}: expected {} to {}", range.start(), range.end()));
            }
        }
        Ok(())
    }
}

/// The velocity stays the same but for a white acceleration: a Kalman filter of what single frames say (Bar-Shalom et al.
/// 2001, section 6.2), both axes alike.
#[derive(Debug, Clone)]
pub struct ConstantVelocity {
    settings: MotionSettings,
    track: Option<Track>,
}

#[derive(Debug, Clone, Copy)]
struct Track {
    position_m: PositionM,
    velocity_mps: [f64; 2],
    /// Variances of position and velocity, and their covariance.
    pp: f64,
    pv: f64,
    vv: f64,
}

impl Track {
    fn slow_to(&mut self, limit_mps: f64) {
        let speed_mps = libm::hypot(self.velocity_mps[0], self.velocity_mps[1]);
        if speed_mps > limit_mps {
            self.velocity_mps = self.velocity_mps.map(|v| v * limit_mps / speed_mps);
        }
    }
}

impl ConstantVelocity {
    pub fn new(settings: MotionSettings) -> Self {
        Self { settings, track: None }
    }
}

impl MotionModel for ConstantVelocity {
    fn predict(&mut self, dt_s: f64) -> Motion {
        let MotionSettings { speed_limit_mps, acceleration_mps2, diffusion_m } = self.settings;
        // Anywhere within reach: a disc of radius r has the deviation r/2 on either axis.
        let widest_m = libm::hypot(0.5 * speed_limit_mps * dt_s, diffusion_m * dt_s.sqrt());
        let Some(track) = &mut self.track else { return Motion { mean_m: [0.0; 2], std_m: widest_m } };
        let q = acceleration_mps2.powi(2);
        let jitter_m2 = q * dt_s.powi(3) / 3.0 + diffusion_m.powi(2) * dt_s;
        let mean_m = track.velocity_mps.map(|v| v * dt_s);
        let std_m = (track.vv * dt_s * dt_s + jitter_m2).sqrt();
        track.position_m = [track.position_m[0] + mean_m[0], track.position_m[1] + mean_m[1]];
        track.pp += 2.0 * track.pv * dt_s + track.vv * dt_s * dt_s + jitter_m2;
        track.pv += track.vv * dt_s + q * dt_s * dt_s / 2.0;
        track.vv += q * dt_s;
        Motion { mean_m, std_m: std_m.min(widest_m) }
    }

    fn limit(&mut self, speed_mps: f64) {
        let Some(track) = &mut self.track else { return };
        track.slow_to(speed_mps);
        track.vv = track.vv.min(speed_mps * speed_mps);
        track.pv = track.pv.clamp(-(track.pp * track.vv).sqrt(), (track.pp * track.vv).sqrt());
    }

    fn observe(&mut self, seen: Option<&Mode>) {
        let Some(seen) = seen else {
            self.track = None;
            return;
        };
        let variance_m2 = 0.5 * (seen.covariance.ee_m2 + seen.covariance.nn_m2);
        let Some(track) = &mut self.track else {
            let vv = (0.5 * self.settings.speed_limit_mps).powi(2);
            self.track = Some(Track { position_m: seen.mean_m, velocity_mps: [0.0; 2], pp: variance_m2, pv: 0.0, vv });
            return;
        };
        let total = track.pp + variance_m2;
        let (gain_p, gain_v) = (track.pp / total, track.pv / total);
        for axis in [0, 1] {
            let surprise_m = seen.mean_m[axis] - track.position_m[axis];
            track.position_m[axis] += gain_p * surprise_m;
            track.velocity_mps[axis] += gain_v * surprise_m;
        }
        track.slow_to(self.settings.speed_limit_mps);
        track.vv -= gain_v * track.pv;
        track.pv -= gain_p * track.pv;
        track.pp -= gain_p * track.pp;
    }

    fn velocity_mps(&self) -> Option<[f64; 2]> {
        let known = |track: &&Track| track.vv.sqrt() < 0.25 * self.settings.speed_limit_mps;
        self.track.as_ref().filter(known).map(|track| track.velocity_mps)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::types::PositionCovariance;

    fn seen(mean_m: PositionM, std_m: f64) -> Mode {
        let variance_m2 = std_m * std_m;
        let covariance = PositionCovariance { ee_m2: variance_m2, en_m2: 0.0, nn_m2: variance_m2 };
        Mode { probability: 1.0, mean_m, covariance }
    }

    #[test]
    fn a_steady_motion_is_learned() {
        let mut model = ConstantVelocity::new(MotionSettings::default());
        let first = model.predict(0.5);
        assert_eq!(first.mean_m, [0.0; 2]);
        assert!((first.std_m - 5.0).abs() < 0.1, "half of what it can drive: {first:?}");
        for i in 0..20 {
            model.observe(Some(&seen([3.0 * f64::from(i), -f64::from(i)], 0.5)));
            model.predict(0.5);
        }
        let motion = model.predict(0.5);
        assert!((motion.mean_m[0] - 3.0).abs() < 0.1 && (motion.mean_m[1] + 1.0).abs() < 0.1, "{motion:?}");
        assert!(motion.std_m < 2.0, "{motion:?}");
        model.observe(None);
        assert_eq!(model.velocity_mps(), None);
    }

    /// A motion predicted in one step or in many is as uncertain.
    #[test]
    fn the_track_s_uncertainty_does_not_depend_on_the_frame_rate() {
        let run = |steps: u32| {
            let mut model = ConstantVelocity::new(MotionSettings::default());
            model.observe(Some(&seen([0.0, 0.0], 0.5)));
            (0..steps).for_each(|_| _ = model.predict(1.0 / f64::from(steps)));
            let track = model.track.expect("a track");
            (track.pp, track.pv, track.vv)
        };
        let (one, many) = (run(1), run(64));
        for (a, b) in [(one.0, many.0), (one.1, many.1), (one.2, many.2)] {
            assert!((a / b - 1.0).abs() < 0.02, "{one:?} {many:?}");
        }
    }

    #[test]
    fn nothing_is_faster_than_the_limit() {
        let mut model = ConstantVelocity::new(MotionSettings { speed_limit_mps: 2.0, ..MotionSettings::default() });
        for i in 0..10 {
            model.observe(Some(&seen([10.0 * f64::from(i), 0.0], 0.1)));
            model.predict(1.0);
        }
        let motion = model.predict(1.0);
        assert!(motion.mean_m[0] <= 2.0 + 1e-9 && motion.std_m < 1.1, "{motion:?}");
    }

    #[test]
    fn impossible_settings_are_refused() {
        let settings = MotionSettings { speed_limit_mps: -1.0, ..MotionSettings::default() };
        assert_eq!(settings.check(), Err("speed_limit_mps = -1: expected 0.1 to 200".into()));
    }
}
