//! Positions on the Earth: WGS84 and the local ENU frame, by way of ECEF (earth-centred, earth-fixed).
//!
//! Sines and arcs come from crate `libm`: those of the system's library differ in the last digit from computer to
//! computer, and replays give the same bytes on all.

use libm::{atan2, sin, sincos};
use serde::{Deserialize, Serialize};

use super::PositionM;

/// Semi-major axis of WGS84 \[m\] and flattening: NIMA TR8350.2, table 3.1.
const SEMI_MAJOR_AXIS_M: f64 = 6_378_137.0;
const FLATTENING: f64 = 1.0 / 298.257_223_563;
/// e² = f (2 − f).
const ECCENTRICITY_SQUARED: f64 = FLATTENING * (2.0 - FLATTENING);

/// A position on WGS84.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Geodetic {
    pub latitude_deg: f64,
    pub longitude_deg: f64,
    /// Above the ellipsoid, not above sea level \[m\].
    pub altitude_m: f64,
}

impl Geodetic {
    /// Latitude in −90..=90, longitude in −180..=180, altitude within 100 km: whatever lies outside is a mistake.
    pub fn is_plausible(&self) -> bool {
        self.latitude_deg.abs() <= 90.0 && self.longitude_deg.abs() <= 180.0 && self.altitude_m.abs() <= 100_000.0
    }

    /// ECEF x, y, z \[m\].
    fn to_ecef_m(self) -> [f64; 3] {
        let (sin_lat, cos_lat) = sincos(self.latitude_deg.to_radians());
        let (sin_lon, cos_lon) = sincos(self.longitude_deg.to_radians());
        let prime_vertical_m = SEMI_MAJOR_AXIS_M / (1.0 - ECCENTRICITY_SQUARED * sin_lat * sin_lat).sqrt();
        let axis_distance_m = (prime_vertical_m + self.altitude_m) * cos_lat;
        let z_m = (prime_vertical_m * (1.0 - ECCENTRICITY_SQUARED) + self.altitude_m) * sin_lat;
        [axis_distance_m * cos_lon, axis_distance_m * sin_lon, z_m]
    }

    /// Fixed point of tan φ = (z + e² N sin φ) / p; each round shrinks the error by about e² = 0.0067 near the ground.
    fn from_ecef_m([x, y, z]: [f64; 3]) -> Self {
        const ROUNDS: usize = 8;
        let p = (x * x + y * y).sqrt();
        let mut latitude = atan2(z, p * (1.0 - ECCENTRICITY_SQUARED));
        for _ in 0..ROUNDS {
            let sin_lat = sin(latitude);
            let n = SEMI_MAJOR_AXIS_M / (1.0 - ECCENTRICITY_SQUARED * sin_lat * sin_lat).sqrt();
            latitude = atan2(z + ECCENTRICITY_SQUARED * n * sin_lat, p);
        }
        let (sin_lat, cos_lat) = sincos(latitude);
        // p cos φ + z sin φ = N (1 − e² sin² φ) + h, which is sound at the poles as well.
        let w = (1.0 - ECCENTRICITY_SQUARED * sin_lat * sin_lat).sqrt();
        let altitude_m = p * cos_lat + z * sin_lat - SEMI_MAJOR_AXIS_M * w;
        Self { latitude_deg: latitude.to_degrees(), longitude_deg: atan2(y, x).to_degrees(), altitude_m }
    }
}

/// The ENU frame that touches the ellipsoid's parallel surface at its origin.
#[derive(Debug, Clone, Copy)]
pub struct LocalFrame {
    origin_ecef_m: [f64; 3],
    /// Rows: the unit vectors east, north, up in ECEF.
    axes: [[f64; 3]; 3],
}

impl LocalFrame {
    pub fn new(origin: Geodetic) -> Self {
        let (sin_lat, cos_lat) = sincos(origin.latitude_deg.to_radians());
        let (sin_lon, cos_lon) = sincos(origin.longitude_deg.to_radians());
        let east = [-sin_lon, cos_lon, 0.0];
        let north = [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat];
        let up = [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat];
        Self { origin_ecef_m: origin.to_ecef_m(), axes: [east, north, up] }
    }

    /// East, north, up \[m\] → WGS84.
    pub fn to_geodetic(&self, enu_m: [f64; 3]) -> Geodetic {
        let ecef = |i: usize| self.origin_ecef_m[i] + (0..3).map(|axis| self.axes[axis][i] * enu_m[axis]).sum::<f64>();
        Geodetic::from_ecef_m([ecef(0), ecef(1), ecef(2)])
    }

    /// A position on the plane at the origin's height → WGS84.
    pub fn plane_to_geodetic(&self, [east_m, north_m]: PositionM) -> Geodetic {
        self.to_geodetic([east_m, north_m, 0.0])
    }

    /// WGS84 → east, north, up \[m\].
    pub fn to_enu_m(&self, position: Geodetic) -> [f64; 3] {
        let ecef = position.to_ecef_m();
        self.axes.map(|axis| (0..3).map(|i| axis[i] * (ecef[i] - self.origin_ecef_m[i])).sum())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn geodetic([latitude_deg, longitude_deg, altitude_m]: [f64; 3]) -> Geodetic {
        Geodetic { latitude_deg, longitude_deg, altitude_m }
    }

    /// Origin (lat, lon, alt), ENU \[m\], WGS84 by `pymap3d.enu2geodetic(*enu, *origin)`, pymap3d 3.2.0.
    const REFERENCE: [[[f64; 3]; 3]; 5] = [
        [[40.82, -73.9, 30.0], [100.0, 200.0, 5.0], [40.82180096728886, -73.89881462990364, 35.003926093821576]],
        [[40.82, -73.9, 30.0], [-2500.0, 1200.0, -30.0], [40.830802084109436, -73.92963842043136, 0.6024124426490228]],
        [[-33.9, 151.2, 0.0], [100.0, 200.0, 5.0], [-33.89819690452221, 151.20108114043268, 5.0039300973314464]],
        [[78.22, 15.65, 450.0], [-2500.0, 1200.0, -30.0], [78.2307264658446, 15.540257651230089, 420.60089576186334]],
        [[0.0, 179.999, 10.0], [100.0, 200.0, 5.0], [0.001808734670848824, 179.9998983131714, 15.003940763908894]],
    ];

    #[test]
    fn conversion_agrees_with_pymap3d() {
        for [origin, enu_m, expected] in REFERENCE {
            let found = LocalFrame::new(geodetic(origin)).to_geodetic(enu_m);
            // 1e-10 degrees are 0.01 mm; f64 carries ECEF to about 1e-9 m.
            assert!((found.latitude_deg - expected[0]).abs() < 1e-10, "{found:?} instead of {expected:?}");
            assert!((found.longitude_deg - expected[1]).abs() < 1e-10, "{found:?} instead of {expected:?}");
            assert!((found.altitude_m - expected[2]).abs() < 1e-6, "{found:?} instead of {expected:?}");
        }
    }

    #[test]
    fn enu_to_wgs84_and_back_is_the_same_point() {
        for origin in [[0.0, 0.0, 0.0], [90.0, 0.0, 0.0], [-89.9, 170.0, 2000.0], [47.0, -180.0, 500.0]] {
            let frame = LocalFrame::new(geodetic(origin));
            for enu_m in [[0.0, 0.0, 0.0], [1234.5, -987.6, 12.0], [-0.001, 0.002, 0.0]] {
                let back = frame.to_enu_m(frame.to_geodetic(enu_m));
                for axis in 0..3 {
                    assert!((back[axis] - enu_m[axis]).abs() < 1e-7, "{origin:?}: {back:?} instead of {enu_m:?}");
                }
            }
        }
    }
}
