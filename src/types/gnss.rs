//! What a satellite receiver says.

use super::Geodetic;

/// The clock that a receiver's sample time is counted on.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum TimeScale {
    /// UTC since 1970.
    Utc,
    /// UTC since a midnight whose date is not known; runs on past the next midnight.
    UtcOfDay,
    /// Since the receiver was switched on.
    Device,
}

/// When the receiver took a sample, on its own clock.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SampleTime {
    pub ns: i64,
    pub scale: TimeScale,
}

/// How a position was come by.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FixQuality {
    Autonomous,
    Differential,
    RtkFloat,
    RtkFixed,
    /// Carried on without satellites.
    DeadReckoning,
    /// The receiver says that it is in a simulation or that the position was typed in.
    Simulated,
}

/// A position that passed all checks.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Fix {
    /// When its last byte had arrived, on the monotonic clock.
    pub arrival_ns: u64,
    pub sample_time: Option<SampleTime>,
    pub position: Geodetic,
    /// One standard deviation east, north, up \[m\], if the receiver states it.
    pub position_std_m: Option<[f64; 3]>,
    pub quality: FixQuality,
    pub satellites: Option<u8>,
    pub horizontal_dilution: Option<f64>,
    /// Over ground, and its direction from east, counter-clockwise.
    pub speed_mps: Option<f64>,
    pub course_rad: Option<f64>,
    /// The sentence or packet it came from, such as `GGA` or `MTData2`.
    pub source: &'static str,
}

/// What a heading is counted from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum North {
    True,
    Magnetic,
}

/// A yaw that passed all checks.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Heading {
    pub arrival_ns: u64,
    pub sample_time: Option<SampleTime>,
    /// From east, counter-clockwise, in (−π, π].
    pub yaw_rad: f64,
    /// One standard deviation, if the source states it.
    pub yaw_std_rad: Option<f64>,
    pub north: North,
    /// The sentence or packet it came from, such as `HDT` or `MTData2`.
    pub source: &'static str,
}

/// One thing decoded from the serial line.
#[derive(Debug, Clone, PartialEq)]
pub enum GnssSample {
    Fix(Fix),
    Heading(Heading),
    /// The receiver's clock, stated without a position.
    Time {
        arrival_ns: u64,
        sample_time: SampleTime,
    },
    /// The receiver works but has no position.
    NoFix {
        arrival_ns: u64,
        sample_time: Option<SampleTime>,
    },
    /// Whole and with a right checksum, but not to be believed.
    Rejected {
        arrival_ns: u64,
        reason: &'static str,
    },
}
