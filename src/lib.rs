//! omniloc tells a vehicle where it is from one omnidirectional camera.

pub mod features;
#[cfg(test)]
mod golden;
pub mod gp;
pub mod jpeg;
pub mod panorama;
pub mod types;
