//! Between two samples.

use libm::hypot;

use crate::types::{PositionM, wrap_angle_rad};

/// How a vehicle's acceleration strays from what interpolation assumes, one standard deviation \[m/s²\]: brisk braking
/// and cornering in town are 2 to 3 m/s².
const ACCELERATION_STD_MPS2: f64 = 1.5;
/// The error of cubic interpolation against that of a straight line; 1/8 when the acceleration changes once between the
/// fixes, at the worst moment.
const CUBIC_SHARE: f64 = 0.125;
/// Stated velocities that differ by more than this from the way between the fixes are not used \[m/s\].
const MAX_VELOCITY_MISMATCH_MPS: f64 = 5.0;

/// A position and how the vehicle moved there.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Waypoint {
    pub position_m: PositionM,
    /// East, north, if known.
    pub velocity_mps: Option<[f64; 2]>,
}

/// Between two waypoints.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Interpolated {
    pub position_m: PositionM,
    /// One standard deviation, each axis, of what interpolating adds.
    pub std_m: f64,
    pub speed_mps: f64,
}

/// The position at `elapsed_s` in 0..=`gap_s` after `before`.
///
/// With both velocities the cubic Hermite polynomial, with w = elapsed / gap
///
/// ```text
/// p(w) = (1 + 2w)(1 − w)² p₀ + w (1 − w)² gap v₀ + w² (3 − 2w) p₁ − w² (1 − w) gap v₁
/// ```
///
/// else the straight line. Its error is that of the acceleration a: a w (1 − w) gap² / 2.
pub fn interpolate(before: &Waypoint, after: &Waypoint, elapsed_s: f64, gap_s: f64) -> Interpolated {
    let w = if gap_s > 0.0 { (elapsed_s / gap_s).clamp(0.0, 1.0) } else { 0.0 };
    let line = |axis: usize| before.position_m[axis] + w * (after.position_m[axis] - before.position_m[axis]);
    let line_std_m = ACCELERATION_STD_MPS2 * w * (1.0 - w) * gap_s * gap_s / 2.0;
    let mean_mps = [0, 1].map(|i| if gap_s > 0.0 { (after.position_m[i] - before.position_m[i]) / gap_s } else { 0.0 });

    let agrees = |v: &[f64; 2]| hypot(v[0] - mean_mps[0], v[1] - mean_mps[1]) <= MAX_VELOCITY_MISMATCH_MPS;
    match [before, after].map(|fix| fix.velocity_mps.filter(agrees)) {
        [Some(v0), Some(v1)] => {
            let u = 1.0 - w;
            let cubic = |i: usize| {
                (1.0 + 2.0 * w) * u * u * before.position_m[i]
                    + w * u * u * gap_s * v0[i]
                    + w * w * (3.0 - 2.0 * w) * after.position_m[i]
                    - w * w * u * gap_s * v1[i]
            };
            // That of the fixes, not of the cubic: noise of the positions would make it wild.
            let velocity_mps = [0, 1].map(|i| u * v0[i] + w * v1[i]);
            Interpolated {
                position_m: [cubic(0), cubic(1)],
                std_m: CUBIC_SHARE * line_std_m,
                speed_mps: hypot(velocity_mps[0], velocity_mps[1]),
            }
        }
        [v0, v1] => {
            let velocity_mps = v0.or(v1).unwrap_or(mean_mps);
            Interpolated {
                position_m: [line(0), line(1)],
                std_m: line_std_m,
                speed_mps: hypot(velocity_mps[0], velocity_mps[1]),
            }
        }
    }
}

/// The yaw at the share `w` in 0..=1 of the way from one yaw to another, the short way round.
pub fn interpolate_yaw_rad(before_rad: f64, after_rad: f64, w: f64) -> f64 {
    wrap_angle_rad(before_rad + w * wrap_angle_rad(after_rad - before_rad))
}

#[cfg(test)]
mod tests {
    use std::f64::consts::PI;

    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn constant_velocity_is_exact(
            p in prop::array::uniform2(-1e4..1e4f64), v in prop::array::uniform2(-40.0..40.0f64),
            gap_s in 0.001..2.0f64, w in 0.0..1.0f64, stated: bool,
        ) {
            let at = |t: f64| [p[0] + v[0] * t, p[1] + v[1] * t];
            let waypoint = |t| Waypoint { position_m: at(t), velocity_mps: stated.then_some(v) };
            let found = interpolate(&waypoint(0.0), &waypoint(gap_s), w * gap_s, gap_s);
            for axis in 0..2 {
                prop_assert!((found.position_m[axis] - at(w * gap_s)[axis]).abs() < 1e-9);
            }
            // The division of rounded positions by the gap loses digits: 1e-12 m / 1 ms.
            prop_assert!((found.speed_mps - v[0].hypot(v[1])).abs() < 1e-6);
        }

        #[test]
        fn constant_acceleration_is_exact_with_velocities_and_within_a_few_deviations_without(
            v in prop::array::uniform2(-20.0..20.0f64), a in prop::array::uniform2(-2.0..2.0f64), w in 0.0..1.0f64,
        ) {
            let gap_s = 0.6;
            let at = |t: f64| [0, 1].map(|i| v[i] * t + a[i] * t * t / 2.0);
            let velocity = |t: f64| [0, 1].map(|i| v[i] + a[i] * t);
            let error = |velocities: bool| {
                let waypoint = |t| Waypoint { position_m: at(t), velocity_mps: velocities.then(|| velocity(t)) };
                let found = interpolate(&waypoint(0.0), &waypoint(gap_s), w * gap_s, gap_s);
                let truth = at(w * gap_s);
                ((found.position_m[0] - truth[0]).hypot(found.position_m[1] - truth[1]), found.std_m)
            };
            prop_assert!(error(true).0 < 1e-9);
            let (error_m, std_m) = error(false);
            prop_assert!(error_m <= 2.0 * std_m + 1e-9);
        }

        #[test]
        fn yaw_goes_the_short_way_round(start in -PI..PI, turn in -3.0..3.0f64, w in 0.0..1.0f64) {
            let found = interpolate_yaw_rad(start, wrap_angle_rad(start + turn), w);
            prop_assert!(wrap_angle_rad(found - (start + w * turn)).abs() < 1e-9);
            prop_assert!((-PI..=PI).contains(&found));
        }
    }

    #[test]
    fn velocities_that_contradict_the_fixes_are_not_used() {
        let waypoint = |east_m: f64| Waypoint { position_m: [east_m, 0.0], velocity_mps: Some([0.0, 30.0]) };
        let found = interpolate(&waypoint(0.0), &waypoint(1.0), 0.05, 0.1);
        assert_eq!(found.position_m, [0.5, 0.0]);
        let same = interpolate(&waypoint(0.0), &waypoint(0.0), 0.0, 0.0);
        assert_eq!(same.position_m, [0.0, 0.0]);
    }
}
