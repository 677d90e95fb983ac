//! Another day at the same place: season, light and weather, parked cars, traffic and people.

use std::f64::consts::{PI, TAU};

use rand::Rng;

use super::random::{Stream, standard_normal, stream};

/// How high the sun rises, and what the trees wear.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Season {
    Winter,
    Spring,
    Summer,
    Autumn,
}

impl Season {
    /// Of the sun in the hours when one drives, up to noon at 54.5° north \[°\].
    fn sun_elevations_deg(self) -> [f64; 2] {
        match self {
            Self::Winter => [4.0, 12.0],
            Self::Spring | Self::Autumn => [10.0, 36.0],
            Self::Summer => [20.0, 59.0],
        }
    }
}

/// What changes from day to day. The place stays.
#[derive(Debug, Clone, PartialEq)]
pub struct Day {
    /// Chooses clouds, which places are parked on, which lamps burn, and all ways of cars and people.
    pub seed: u64,
    /// Of the trees.
    pub season: Season,
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

/// Of days whose season nobody asked for.
const SUN_ELEVATIONS_DEG: [f64; 2] = [18.0, 58.0];

impl Day {
    /// Some day: every seed another one.
    pub fn new(seed: u64) -> Self {
        let mut random = stream(seed, Stream::Light);
        // The sun is in the south, as it is where the default origin lies.
        let sun_azimuth_rad = -random.random_range(0.1 * PI..0.9 * PI);
        Self {
            seed,
            season: Season::Summer,
            sun_azimuth_rad,
            sun_elevation_rad: TAU * random.random_range(SUN_ELEVATIONS_DEG[0]..SUN_ELEVATIONS_DEG[1]) / 360.0,
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

    /// The same day at another time of the year.
    pub fn in_season(self, season: Season) -> Self {
        let [lowest_deg, highest_deg] = SUN_ELEVATIONS_DEG;
        let share = (self.sun_elevation_rad.to_degrees() - lowest_deg) / (highest_deg - lowest_deg);
        let [low_deg, high_deg] = season.sun_elevations_deg();
        Self { season, sun_elevation_rad: (low_deg + share * (high_deg - low_deg)).to_radians(), ..self }
    }

    /// `factor` times as many people and cars, parked and moving.
    pub fn with_traffic(self, factor: f64) -> Self {
        let times = |count: usize| (count as f64 * factor).round() as usize;
        Self {
            parked_share: (self.parked_share * factor).min(1.0),
            moving_cars: times(self.moving_cars),
            people: times(self.people),
            ..self
        }
    }

    /// With a gain of the camera that differs from the usual by `deviation_db`, every seed by another amount.
    pub fn with_gain(self, deviation_db: f64) -> Self {
        let gain_db = deviation_db * standard_normal(&mut stream(self.seed, Stream::Gain)).clamp(-2.0, 2.0);
        Self { exposure: self.exposure * 10.0_f64.powf(gain_db / 20.0), ..self }
    }

    /// Towards the sun: east, north, up.
    pub(super) fn to_sun(&self) -> [f32; 3] {
        let (sin, cos) = self.sun_elevation_rad.sin_cos();
        [cos * self.sun_azimuth_rad.cos(), cos * self.sun_azimuth_rad.sin(), sin].map(|component| component as f32)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn seasons_traffic_and_gain_change_what_they_are_asked_to() {
        for seed in 0..50 {
            let day = Day::new(seed);
            let elevation_deg = |season| day.clone().in_season(season).sun_elevation_rad.to_degrees();
            assert!((4.0..12.0).contains(&elevation_deg(Season::Winter)));
            assert!((20.0..59.0).contains(&elevation_deg(Season::Summer)));
            assert!(elevation_deg(Season::Spring) < elevation_deg(Season::Summer));

            let busy = day.clone().with_traffic(3.0);
            assert_eq!([busy.people, busy.moving_cars], [3 * day.people, 3 * day.moving_cars]);
            assert!(busy.parked_share > day.parked_share && busy.parked_share <= 1.0);
            let empty = day.clone().with_traffic(0.0);
            assert_eq!(empty, Day { sun_azimuth_rad: day.sun_azimuth_rad, ..Day::deserted(seed) });

            let factor = day.clone().with_gain(3.0).exposure / day.exposure;
            // 3 dB, and at most twice that.
            assert!(factor != 1.0 && (0.5..2.0).contains(&factor), "{factor}");
            assert_eq!(day.clone().with_gain(0.0), day);
        }
    }
}
