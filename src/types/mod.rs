//! Words every folder may use. Nothing here uses anything else of ours.

// The same estimates on every computer.
#![cfg_attr(not(test), deny(clippy::disallowed_methods))]

mod calibration;
mod estimate;
mod geodesy;
mod geometry;
mod gnss;
mod image;
mod pool;
mod text;
mod time;

pub use calibration::{AzimuthSense, CalibrationError, DonutCalibration, LensKind};
pub use estimate::{
    EstimateWarnings, EstimatedHeading, EstimatedPose, LocalizationState, PositionCovariance, PositionEstimate,
};
pub use geodesy::{Geodetic, LocalFrame};
pub use geometry::{PositionM, distance_m, wrap_angle_rad};
pub use gnss::{Fix, FixQuality, GnssSample, Heading, North, SampleTime, TimeScale};
pub use image::{LumaImage, Tiles};
pub use pool::{BufferPool, PooledBytes};
pub use text::counted;
pub use time::{Clock, ClockReading, ManualClock, NS_PER_S, ScaledClock, SystemClock};
