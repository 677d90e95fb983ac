//! omniloc tells a vehicle where it is from one omnidirectional camera.

pub mod calibrate;
pub mod commands;
pub mod evaluate;
pub mod features;
#[cfg(test)]
mod golden;
pub mod gp;
pub mod jpeg;
pub mod localize;
pub mod map;
pub mod panorama;
pub mod recording;
pub mod train;
pub mod types;
