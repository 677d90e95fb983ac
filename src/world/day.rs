//! Another day at the same place: light and weather, parked cars, traffic and people.

use std::f64::consts::{PI, TAU};

use rand::Rng;

use super::random::{Stream, stream};

/// What changes from day to day. The place stays.
#[derive(Debug, Clone, PartialEq)]
pub struct Day {
    /// Chooses clouds, which places are parked on, which lamps burn, and all ways of cars and people.
    pub seed: u64,
    /// Direction of the sun from east, counter-clockwise, and its height above the horizon.
    pub sun_azimuth_rad: f64,
    pub sun_elevation_rad: f64,
    /// 0: clear sky and hard shadows; 1: no sun at all.
    pub overcast: f64,
    /// Factor on all brightness: the camera's exposure and gain.
    pub exposure: f64,
    /// Share of the parking places that are taken.
    pub parked_share: f64,
    /// Cars on the move in each direction round the block.
    pub moving_cars: usize,
    pub people: usize,
}

impl Day {
    /// Some day: every seed another one.
    pub fn new(seed: u64) -> Self {
        let mut random = stream(seed, Stream::Light);
        // The sun is in the south, as it is where the default origin lies.
        let sun_azimuth_rad = -random.random_range(0.1 * PI..0.9 * PI);
        Self {
            seed,
            sun_azimuth_rad,
            sun_elevation_rad: TAU * random.random_range(18.0..58.0) / 360.0,
            overcast: if random.random_bool(0.4) {
                random.random_range(0.7..1.0)
            } else {
                random.random_range(0.0..0.6)
            },
            exposure: random.random_range(0.85..1.2),
            parked_share: random.random_range(0.25..0.75),
            moving_cars: random.random_range(1..5),
            people: random.random_range(4..16),
        }
    }

    /// Nobody about, no car: only the light of day `seed`.
    pub fn deserted(seed: u64) -> Self {
        Self { parked_share: 0.0, moving_cars: 0, people: 0, ..Self::new(seed) }
    }

    /// Towards the sun: east, north, up.
    pub(super) fn to_sun(&self) -> [f32; 3] {
        let (sin, cos) = self.sun_elevation_rad.sin_cos();
        [cos * self.sun_azimuth_rad.cos(), cos * self.sun_azimuth_rad.sin(), sin].map(|component| component as f32)
    }
}
