//! Positions and angles.
//!
//! The map frame is ENU: x east, y north, both in metres from the map's origin. Yaw is counted from east,
//! counter-clockwise, in radians.

use std::f64::consts::{PI, TAU};

/// East, north \[m\] from the map's origin.
pub type PositionM = [f64; 2];

/// Euclidean distance between two positions \[m\].
pub fn distance_m(a: PositionM, b: PositionM) -> f64 {
    libm::hypot(a[0] - b[0], a[1] - b[1])
}

/// The same direction in (−π, π].
pub fn wrap_angle_rad(angle_rad: f64) -> f64 {
    let wrapped = angle_rad.rem_euclid(TAU);
    if wrapped > PI { wrapped - TAU } else { wrapped }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn wrapping_keeps_the_direction() {
        for turns in -3..=3 {
            for angle_rad in [-3.1, -PI / 2.0, 0.0, 0.5, PI] {
                let wrapped = wrap_angle_rad(angle_rad + f64::from(turns) * TAU);
                assert!((wrapped - angle_rad).abs() < 1e-12, "{angle_rad} became {wrapped}");
            }
        }
        assert_eq!(wrap_angle_rad(-PI), PI);
    }
}
