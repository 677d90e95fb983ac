//! omniloc tells a vehicle where it is from one omnidirectional camera.
//!
//! A camera looks into a donut-shaped panoramic lens and sees the whole horizon in one image. On a survey drive these
//! images are recorded together with positions; the recording becomes a *map*, in which every property of the image is a
//! Gaussian process over the plane; and a later image is where in the map it most likely was taken. The method is that of
//! Do, Jadaliha, Choi and Lim, “Feature selection for position estimation using an omnidirectional camera”, Image and
//! Vision Computing 39 (2015) 1–9, cited as Do et al. (2015).
//!
//! Data flows one way, and the folders are the stages:
//!
//! ```text
//! images and positions ─► recording ─► panorama ─► features ─┬─► train ─► map      one Gaussian process a feature
//!                                                            └─► localize          against the map ─► position
//! ```
//!
//! | module | what it is for |
//! |---|---|
//! | [`types`] | words every folder may use: positions, calibration, images |
//! | [`devices`] | hardware in, stamped values out |
//! | [`recording`] | MCAP on disk; import and export of image folders |
//! | [`gnss`] | bytes of the serial line → positions, yaws, times |
//! | [`sync`] | where the vehicle was when a frame was exposed |
//! | [`jpeg`] | JPEG in, luma out |
//! | [`calibrate`] | finds the donut in the image |
//! | [`panorama`] | unwraps the donut |
//! | [`features`] | panorama → descriptor → features |
//! | [`gp`] | Gaussian-process regression: pure mathematics |
//! | [`map`] | what localizing needs to know of a place, and its file |
//! | [`localize`] | frames against the map: likelihood, filter, states, heading, smoother |
//! | [`outputs`] | estimates → JSON lines and NMEA sentences, to whoever listens |
//! | [`train`] | recordings → map: recipes, splits, selection |
//! | [`metrics`] | error figures of position estimates |
//! | [`evaluate`] | the protocol's results and the paper's tables |
//! | `report` | figures and the page that shows them |
//! | [`world`] | simulated places, drives and receivers |
//! | [`config`] | one TOML file → the settings that the modules own |
//! | [`doctor`] | what is wrong with devices and computer, and what to do |
//! | [`runtime`] | which task feeds which; keeps devices running; starts and stops |
//! | [`commands`] | the program: one file a command |
//!
//! # Frames and units
//!
//! The map frame is ENU: x east, y north, in metres from the recording's origin. Yaw is counted from east,
//! counter-clockwise, in radians. Pixel centres are at integer coordinates, x to the right, y down. Names end with their
//! unit: `_m _rad _deg _px _ns`. `f32` for pixels, descriptors and fields on cells, `f64` for geometry and Gaussian
//! processes.

pub mod calibrate;
pub mod commands;
pub mod config;
pub mod devices;
pub mod doctor;
pub mod evaluate;
pub mod features;
pub mod gnss;
#[cfg(test)]
mod golden;
pub mod gp;
pub mod jpeg;
pub mod localize;
pub mod map;
pub mod metrics;
pub mod outputs;
pub mod panorama;
pub mod recording;
#[cfg(feature = "report")]
pub mod report;
pub mod runtime;
pub mod sync;
pub mod train;
pub mod types;
pub mod world;
