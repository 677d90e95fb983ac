//! Words every folder may use. Nothing here uses anything else of ours.

mod calibration;
mod geodesy;
mod geometry;
mod image;

pub use calibration::{AzimuthSense, CalibrationError, DonutCalibration, LensKind};
pub use geodesy::{Geodetic, LocalFrame};
pub use geometry::{PositionM, distance_m, wrap_angle_rad};
pub use image::LumaImage;
