//! Estimates as NMEA 0183 sentences that do not pass for those of a satellite receiver.
//!
//! | sentence | says |
//! |---|---|
//! | GST | standard deviations: error ellipse, north, east \[m] |
//! | GGA | time, position, quality 6 (estimated), no satellites, no dilution, height |
//! | PGRME | estimated horizontal error: the radius that half of all positions are within \[m] |
//! | RMC | time, date, position, speed, course, status A with mode E (estimated) |
//! | HDT | true heading |
//!
//! - The talker is `IN`, integrated navigation, and never a satellite system's.
//! - Only a localized estimate has a position. Otherwise GGA says quality 0, RMC status V with mode N, both without a
//!   position; GST and PGRME are not sent and HDT is empty.
//! - Dilution (HDOP) relates errors of satellite ranges to that of the position. There are no ranges, so it is empty; so
//!   are the ranges' RMS and the deviation of the height in GST.
//! - The map is a plane: the height is that of its origin above the ellipsoid, and the separation is 0, as
//!   `docs/arduino-lines.md` has it.
//! - While UTC is not known, time and date are empty. GST, which refers to the GGA of the same time, is then not sent,
//!   and neither is a GGA beside an RMC.
//!
//! The last rule, the order and PGRME are for gpsd (`driver_nmea0183.c`; tried with 3.22 of Debian 12): it takes a GGA of
//! fewer than three satellites for no fix until the RMC behind it says otherwise, a second GGA with the same time (or
//! with none) for a receiver that hangs, prints a GST behind an RMC into the next attitude report, and knows errors
//! (`epx`, `epy`) only from dilutions or PGRME. It reports quality 6 as status 5, dead reckoning.

use serde::{Deserialize, Serialize};

use super::{
    TimedEstimate,
    json_lines::speed_mps,
    text::{Utc, push_decimal, push_units, push_whole, rounded_units},
};
use crate::{
    gnss::xor,
    types::{EstimatedPose, Geodetic, LocalFrame, PositionCovariance},
};

/// What a sentence may have, with `$` and line end \[bytes\].
pub const MAX_SENTENCE_BYTES: usize = 82;

const MPS_PER_KNOT: f64 = 1852.0 / 3600.0;

/// Below this the direction of the last steps says little about where the vehicle goes \[m/s\].
const MIN_COURSE_SPEED_MPS: f64 = 0.5;

/// A kind of sentence, in the order they are sent.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Sentence {
    Gst,
    Gga,
    Pgrme,
    Rmc,
    Hdt,
}

impl Sentence {
    pub const ALL: [Self; 5] = [Self::Gst, Self::Gga, Self::Pgrme, Self::Rmc, Self::Hdt];
}

/// Writes the sentences of an estimate.
#[derive(Debug, Clone)]
pub struct NmeaWriter {
    map_frame: LocalFrame,
    altitude_m: f64,
    sentences: Vec<Sentence>,
}

impl NmeaWriter {
    /// `origin`: of the map.
    pub fn new(origin: Geodetic, sentences: &[Sentence]) -> Self {
        let mut sentences = sentences.to_vec();
        sentences.sort_unstable();
        Self { map_frame: LocalFrame::new(origin), altitude_m: origin.altitude_m, sentences }
    }

    /// Appends the sentences.
    pub fn write(&self, timed: &TimedEstimate, out: &mut Vec<u8>) {
        let utc = timed.utc_ns.map(|utc_ns| Utc::rounded(utc_ns, 1000));
        let placed = timed.estimate.pose.as_ref().and_then(|pose| {
            let place = self.map_frame.plane_to_geodetic(pose.position_m);
            place.is_plausible().then_some((pose, place))
        });
        for sentence in &self.sentences {
            match sentence {
                Sentence::Gst if utc.is_some() => self.gst(utc, placed, out),
                Sentence::Gst => {}
                Sentence::Gga if utc.is_some() || !self.sentences.contains(&Sentence::Rmc) => {
                    self.gga(utc, placed, out);
                }
                Sentence::Gga => {}
                Sentence::Pgrme => self.pgrme(placed, out),
                Sentence::Rmc => self.rmc(utc, placed, out),
                Sentence::Hdt => self.hdt(placed, out),
            }
        }
    }

    fn gst(&self, utc: Option<Utc>, placed: Option<Placed>, out: &mut Vec<u8>) {
        let Some((pose, _)) = placed else { return };
        let Ellipse { major_m, minor_m, orientation_deg } = Ellipse::of(&pose.covariance);
        let mut line = Line::begin(out, "INGST");
        line.time(utc);
        line.empty(1);
        line.decimal(major_m, 3);
        line.decimal(minor_m, 3);
        line.degrees(orientation_deg, 180.0, 1);
        line.decimal(pose.covariance.nn_m2.max(0.0).sqrt(), 3);
        line.decimal(pose.covariance.ee_m2.max(0.0).sqrt(), 3);
        line.empty(1);
        line.end();
    }

    fn gga(&self, utc: Option<Utc>, placed: Option<Placed>, out: &mut Vec<u8>) {
        let mut line = Line::begin(out, "INGGA");
        line.time(utc);
        line.coordinates(placed.map(|(_, place)| place));
        line.text(if placed.is_some() { "6" } else { "0" });
        line.text("00");
        line.empty(1);
        if placed.is_some() {
            line.decimal(self.altitude_m, 1);
            line.text("M");
            line.text("0.0");
        } else {
            line.empty(1);
            line.text("M");
            line.empty(1);
        }
        line.text("M");
        line.empty(2);
        line.end();
    }

    /// Without the height's error and without that of all three axes, which are not known.
    fn pgrme(&self, placed: Option<Placed>, out: &mut Vec<u8>) {
        let Some((pose, _)) = placed else { return };
        let mut line = Line::begin(out, "PGRME");
        line.decimal(Ellipse::of(&pose.covariance).half_within_m(), 2);
        line.text("M");
        line.empty(1);
        line.text("M");
        line.empty(1);
        line.text("M");
        line.end();
    }

    fn rmc(&self, utc: Option<Utc>, placed: Option<Placed>, out: &mut Vec<u8>) {
        let mut line = Line::begin(out, "INRMC");
        line.time(utc);
        line.text(if placed.is_some() { "A" } else { "V" });
        line.coordinates(placed.map(|(_, place)| place));
        let speed_mps = placed.and_then(|(pose, _)| speed_mps(pose));
        match speed_mps {
            Some(speed_mps) => line.decimal(speed_mps / MPS_PER_KNOT, 2),
            None => line.empty(1),
        }
        match placed.and_then(|(pose, _)| pose.velocity_mps) {
            Some([east_mps, north_mps]) if speed_mps >= Some(MIN_COURSE_SPEED_MPS) => {
                line.degrees(libm::atan2(east_mps, north_mps).to_degrees(), 360.0, 1);
            }
            _ => line.empty(1),
        }
        line.date(utc);
        line.empty(2);
        line.text(if placed.is_some() { "E" } else { "N" });
        line.end();
    }

    fn hdt(&self, placed: Option<Placed>, out: &mut Vec<u8>) {
        let mut line = Line::begin(out, "INHDT");
        match placed.and_then(|(pose, _)| pose.heading) {
            Some(heading) => line.degrees(90.0 - heading.yaw_rad.to_degrees(), 360.0, 2),
            None => line.empty(1),
        }
        line.text("T");
        line.end();
    }
}

/// A pose, and where on Earth that is.
type Placed<'a> = (&'a EstimatedPose, Geodetic);

/// One standard deviation along the axes of the error ellipse.
struct Ellipse {
    major_m: f64,
    minor_m: f64,
    /// Of the major axis, from north, clockwise.
    orientation_deg: f64,
}

impl Ellipse {
    /// Eigenvalues m ± r of the covariance, with m its mean variance and r² = ((ee − nn) / 2)² + en²; the major axis lies
    /// at ½ atan2(2 en, ee − nn) from east.
    fn of(covariance: &PositionCovariance) -> Self {
        let PositionCovariance { ee_m2, en_m2, nn_m2 } = *covariance;
        let (mean_m2, half_difference_m2) = (0.5 * (ee_m2 + nn_m2), 0.5 * (ee_m2 - nn_m2));
        let radius_m2 = (half_difference_m2 * half_difference_m2 + en_m2 * en_m2).sqrt();
        let from_east_rad = 0.5 * libm::atan2(2.0 * en_m2, ee_m2 - nn_m2);
        Self {
            major_m: (mean_m2 + radius_m2).max(0.0).sqrt(),
            minor_m: (mean_m2 - radius_m2).max(0.0).sqrt(),
            orientation_deg: 90.0 - from_east_rad.to_degrees(),
        }
    }

    /// Radius of the circle that a position is within with probability ½: 0.5887 (σ₁ + σ₂) is exact for a circle and off
    /// by at most 3 % up to a ratio of 1 : 4; 0.6745 σ₁ is exact for a line.
    fn half_within_m(&self) -> f64 {
        (0.5887 * (self.major_m + self.minor_m)).max(0.6745 * self.major_m)
    }
}

/// A sentence under way.
struct Line<'a> {
    out: &'a mut Vec<u8>,
    start: usize,
}

impl<'a> Line<'a> {
    fn begin(out: &'a mut Vec<u8>, header: &str) -> Self {
        let start = out.len();
        out.push(b'$');
        out.extend(header.as_bytes());
        Self { out, start }
    }

    fn text(&mut self, field: &str) {
        self.out.push(b',');
        self.out.extend(field.as_bytes());
    }

    fn empty(&mut self, fields: usize) {
        self.out.extend(std::iter::repeat_n(b',', fields));
    }

    /// Empty if it is no number, or one that would make the sentence too long.
    fn decimal(&mut self, value: f64, decimals: u32) {
        const LIMIT: f64 = 100_000.0;
        self.out.push(b',');
        if value.abs() < LIMIT {
            push_decimal(self.out, value, decimals);
        }
    }

    /// An angle from 0 to less than `turn_deg`, also when rounded.
    fn degrees(&mut self, angle_deg: f64, turn_deg: f64, decimals: u32) {
        self.out.push(b',');
        let (Some(units), Some(turn)) =
            (rounded_units(angle_deg.rem_euclid(turn_deg), decimals), rounded_units(turn_deg, decimals))
        else {
            return;
        };
        push_units(self.out, units.rem_euclid(turn).unsigned_abs(), decimals, 1);
    }

    /// hhmmss.sss
    fn time(&mut self, utc: Option<Utc>) {
        self.out.push(b',');
        let Some(Utc { hours, minutes, seconds, fraction, .. }) = utc else { return };
        [hours, minutes, seconds].iter().for_each(|&value| push_whole(self.out, value, 2));
        self.out.push(b'.');
        push_whole(self.out, fraction, 3);
    }

    /// ddmmyy
    fn date(&mut self, utc: Option<Utc>) {
        self.out.push(b',');
        let Some(Utc { year, month, day, .. }) = utc else { return };
        [day, month, year % 100].iter().for_each(|&value| push_whole(self.out, value, 2));
    }

    /// Latitude, N or S, longitude, E or W.
    fn coordinates(&mut self, place: Option<Geodetic>) {
        let Some(Geodetic { latitude_deg, longitude_deg, .. }) = place else { return self.empty(4) };
        self.coordinate(latitude_deg, 2, ["N", "S"]);
        self.coordinate(longitude_deg, 3, ["E", "W"]);
    }

    /// Degrees and minutes with six decimals, 2 mm on the ground: counted in millionths of a minute, so that 59.9999999
    /// minutes make a degree.
    fn coordinate(&mut self, degrees: f64, degree_digits: usize, [positive, negative]: [&str; 2]) {
        const DECIMALS: u32 = 6;
        const MILLIONTHS_PER_DEGREE: u64 = 60_000_000;
        self.out.push(b',');
        let units = (degrees.abs() * MILLIONTHS_PER_DEGREE as f64).round() as u64;
        push_whole(self.out, units / MILLIONTHS_PER_DEGREE, degree_digits);
        push_units(self.out, units % MILLIONTHS_PER_DEGREE, DECIMALS, 2);
        self.text(if degrees < 0.0 && units > 0 { negative } else { positive });
    }

    /// The sum, in hexadecimal, and the line end.
    fn end(self) {
        const DIGITS: &[u8; 16] = b"0123456789ABCDEF";
        let sum = xor(&self.out[self.start + 1..]);
        let [high, low] = [sum >> 4, sum & 0xF].map(|digit| DIGITS[usize::from(digit)]);
        self.out.extend([b'*', high, low, b'\r', b'\n']);
    }
}

#[cfg(test)]
#[path = "nmea_tests.rs"]
mod tests;
