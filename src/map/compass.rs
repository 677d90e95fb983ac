//! Panoramas of known heading.

use crate::features::COMPASS_BYTES;
use crate::types::{AzimuthSense, PositionM};

/// What headings are taken from: signatures of the learning panoramas, and where and which way they were taken.
#[derive(Debug, Clone, PartialEq)]
pub struct Compass {
    /// n positions \[m\].
    pub positions_m: Vec<PositionM>,
    /// n, from east, counter-clockwise.
    pub yaws_rad: Vec<f64>,
    /// n × [`COMPASS_BYTES`]: see [`crate::features::Describer::compass`].
    pub signatures: Vec<i8>,
    /// +1 where the columns of a panorama run counter-clockwise as seen from above, −1 where clockwise.
    pub sense: f64,
    /// One standard deviation of a heading.
    pub std_rad: f64,
}

impl Compass {
    pub fn signature(&self, i: usize) -> &[i8] {
        &self.signatures[i * COMPASS_BYTES..(i + 1) * COMPASS_BYTES]
    }

    /// The sense of panoramas with this azimuth.
    pub fn sense_of(azimuth: AzimuthSense) -> f64 {
        match azimuth {
            AzimuthSense::Ccw => 1.0,
            AzimuthSense::Cw => -1.0,
        }
    }
}
