//! What is known of where a frame was taken.

use std::fmt;

use crate::{recording::proto::omniloc, types::PositionM};

/// Where the vehicle was when one frame was exposed.
#[derive(Debug, Clone, PartialEq)]
pub struct Pair {
    pub sequence: u64,
    /// Start of the exposure, on the monotonic clock.
    pub stamp_ns: u64,
    /// Absent without fixes on both sides.
    pub position_m: Option<PositionM>,
    /// From east, counter-clockwise.
    pub yaw_rad: Option<f64>,
    /// One standard deviation, each axis: of the fixes, of interpolating, and of the time times the speed.
    pub position_std_m: Option<f64>,
    /// Between the fixes on both sides.
    pub interpolation_gap_s: Option<f64>,
    pub interpolation_gap_m: Option<f64>,
    /// That was taken off, and the way driven in it.
    pub serial_latency_s: f64,
    pub serial_latency_m: Option<f64>,
    /// One standard deviation of the time between exposure and position.
    pub time_std_s: f64,
    /// Why it must not be used.
    pub invalid: Option<InvalidReason>,
}

/// Why a pair must not be used.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum InvalidReason {
    FrameDamaged(&'static str),
    NoPositionYet,
    Gap { gap_s: f64 },
    NoFixAfter { waited_s: f64 },
    Uncertain { std_m: f64 },
}

impl fmt::Display for InvalidReason {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::FrameDamaged(why) => write!(f, "frame damaged: {why}"),
            Self::NoPositionYet => write!(f, "no position yet"),
            Self::Gap { gap_s } => write!(f, "gap of {gap_s:.1} s between fixes"),
            Self::NoFixAfter { waited_s } => write!(f, "no fix within {waited_s:.1} s after the exposure"),
            Self::Uncertain { std_m } => write!(f, "position standard deviation {std_m:.0} m"),
        }
    }
}

impl Pair {
    /// The message on `/survey/pair`; its time stamp is the writer's.
    pub fn to_message(&self) -> omniloc::SurveyPair {
        let [east_m, north_m] = self.position_m.unwrap_or_default();
        omniloc::SurveyPair {
            timestamp: None,
            frame_sequence: self.sequence,
            east_m,
            north_m,
            yaw_rad: self.yaw_rad,
            position_std_m: self.position_std_m,
            interpolation_gap_s: self.interpolation_gap_s,
            interpolation_gap_m: self.interpolation_gap_m,
            serial_latency_s: Some(self.serial_latency_s),
            serial_latency_m: self.serial_latency_m,
            time_std_s: Some(self.time_std_s),
            valid: self.invalid.is_none(),
            invalid_reason: self.invalid.map_or_else(String::new, |reason| reason.to_string()),
            source_file: String::new(),
            dataset_time_s: None,
        }
    }
}
