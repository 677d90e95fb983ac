//! omniloc tells a vehicle where it is from one omnidirectional camera.

pub mod commands;
pub mod jpeg;
pub mod recording;
pub mod types;
