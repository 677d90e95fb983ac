//! Where the vehicle was when a frame was exposed.
//!
//! Three clocks meet here, and none of them is the date of the computer:
//!
//! ```text
//!  monotonic clock   ──●────────●────────●────────●────────●──────►   stamps of frames (start of the exposure)
//!                      1        2        3        4        5          and arrivals of samples
//!
//!  receiver's clock  ────■───────────■───────────■───────────■────►   UTC, UTC of some day, or time since it was
//!                         ╲           ╲           ╲           ╲       switched on: when a sample was taken
//!                          ╲ latency   ╲           ╲           ╲
//!  arrival           ───────▼───────────▼─────────────▼─────────▼─►   offset + smallest latency + jitter
//! ```
//!
//! - `ClockMap`: `arrival − sample time` of all samples lies above the offset of the receiver's
//!   clock by the latency of the line, whose jitter is never negative. The lower envelope over two minutes therefore
//!   follows the clock, drift and steps included. It gives *zero-latency time*: as if the fastest sample had taken no
//!   time at all.
//! - `Latency`: what remains is the smallest latency, a constant that one-way data cannot show. It is
//!   found from edges of the receiver's pulse, else from turns that camera and receiver both saw, else it is a setting.
//! - A frame's exposure is carried to zero-latency time, and the samples on both sides of it are interpolated.
//!
//! [`Synchronizer`] puts this together without a clock, a thread or a file: what it is told in which order decides what
//! it says, so that a replay says the same. Only [`latency_from_recording`] reads a file.

// The same estimates on every computer.
#![cfg_attr(not(test), deny(clippy::disallowed_methods))]

mod camera_turns;
mod clock_map;
mod interpolate;
mod latency;
mod pair;
mod pulses;
mod receiver_clocks;
mod recorded;
mod synchronizer;
#[cfg(test)]
mod tests;
mod timeline;
mod visual_rotation;
mod yaw_lag;

use serde::{Deserialize, Serialize};

pub use camera_turns::CameraTurns;
pub use latency::{LatencyEstimate, LatencySource};
pub use pair::{InvalidReason, Pair};
pub use recorded::{RecordedLag, latency_from_recording};
pub use synchronizer::{Statistics, Synchronizer};
pub use visual_rotation::VisualRotation;

/// How frames are paired with positions: the table `[sync]`.
#[derive(Debug, Clone, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct Settings {
    /// No position is interpolated between fixes further apart than this.
    #[serde(default = "default_max_gap_s")]
    pub max_gap_s: f64,
    /// No yaw is interpolated between headings further apart than this.
    #[serde(default = "default_max_heading_gap_s")]
    pub max_heading_gap_s: f64,
    /// Pairs whose position is less certain are not valid: one standard deviation, each axis.
    #[serde(default = "default_max_position_std_m")]
    pub max_position_std_m: f64,
    /// After the exposure, fixes are waited for so long. More than the latency and the gap together.
    #[serde(default = "default_max_wait_s")]
    pub max_wait_s: f64,
    /// Smallest time from a sample to the arrival of its last byte, as long as neither pulse nor turns show it.
    #[serde(default = "default_serial_latency_s")]
    pub serial_latency_s: f64,
    /// One standard deviation of it. Defaults to as much as most receivers have, known no better than that.
    #[serde(default = "default_serial_latency_std_s")]
    pub serial_latency_std_s: f64,
    /// Magnetic against true north, east positive: for receivers that only state a magnetic heading.
    #[serde(default)]
    pub magnetic_declination_deg: f64,
}

/// Two intervals of a receiver with 4 Hz, and a little.
fn default_max_gap_s() -> f64 {
    0.6
}

fn default_max_heading_gap_s() -> f64 {
    0.6
}

fn default_max_position_std_m() -> f64 {
    10.0
}

fn default_max_wait_s() -> f64 {
    2.5
}

/// Reported for receivers on a serial line: from some 10 ms to 0.5 s.
fn default_serial_latency_s() -> f64 {
    0.15
}

fn default_serial_latency_std_s() -> f64 {
    0.15
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            max_gap_s: default_max_gap_s(),
            max_heading_gap_s: default_max_heading_gap_s(),
            max_position_std_m: default_max_position_std_m(),
            max_wait_s: default_max_wait_s(),
            serial_latency_s: default_serial_latency_s(),
            serial_latency_std_s: default_serial_latency_std_s(),
            magnetic_declination_deg: 0.0,
        }
    }
}

impl Settings {
    /// Refuses values that no vehicle can have.
    ///
    /// # Errors
    /// Which key, what was found and what is expected.
    pub fn check(&self) -> Result<(), String> {
        let table = [
            ("max_gap_s", self.max_gap_s, 0.01, 10.0),
            ("max_heading_gap_s", self.max_heading_gap_s, 0.01, 10.0),
            ("max_position_std_m", self.max_position_std_m, 0.01, 1000.0),
            ("max_wait_s", self.max_wait_s, 0.1, 30.0),
            ("serial_latency_s", self.serial_latency_s, 0.0, 1.0),
            ("serial_latency_std_s", self.serial_latency_std_s, 0.001, 1.0),
            ("magnetic_declination_deg", self.magnetic_declination_deg, -180.0, 180.0),
        ];
        for (key, found, least, most) in table {
            if !(least..=most).contains(&found) {
                return Err(format!("{key} is {found}, expected {least} to {most}"));
            }
        }
        let needed_s = self.max_gap_s + self.serial_latency_s;
        if self.max_wait_s < needed_s {
            let sum = "max_gap_s + serial_latency_s";
            return Err(format!("max_wait_s is {}, expected at least {sum} = {needed_s}", self.max_wait_s));
        }
        Ok(())
    }
}
