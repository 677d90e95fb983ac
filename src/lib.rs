//! omniloc tells a vehicle where it is from one omnidirectional camera.

pub mod calibrate;
pub mod commands;
pub mod jpeg;
pub mod types;
