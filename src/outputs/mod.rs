//! Position estimates as text: JSON lines and NMEA 0183.

pub mod json_lines;
pub mod nmea;
#[cfg(test)]
mod test_estimates;
mod text;

use crate::types::PositionEstimate;

/// An estimate and when that was.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TimedEstimate {
    pub estimate: PositionEstimate,
    /// UTC of the exposure, since 1970; `None` while it is not known.
    pub utc_ns: Option<i64>,
}
