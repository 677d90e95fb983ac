//! Frames against the map: where is the vehicle?
//!
//! ```text
//! JPEG ─► luma ─► panorama ─► properties ─► features ─► log-likelihood of every cell ─► belief ─► estimate
//!                     └─────► compass signature ─────────────────────────────────────────────────► heading
//! ```
//!
//! [`Localizer`] takes frames all the way; [`Tracker`] is the part from the log-likelihood on, which also serves drives
//! that are evaluated offline, where [`smooth`] adds what later frames say of earlier ones. The likelihood is in
//! `likelihood`, maps that are larger than memory in `large`, the discrete Bayes filter in `belief` and `tracker`, where in
//! its hill of the belief the vehicle is in `kalman`, the motion between frames in `motion`, what a frame is worth beside
//! those before it in `news`, and when a position may be said in `state`.

// The same estimates on every computer.
#![cfg_attr(not(test), deny(clippy::disallowed_methods))]

mod belief;
mod estimate;
mod heading;
mod kalman;
mod large;
mod likelihood;
mod localizer;
mod motion;
mod news;
mod smoother;
mod state;
mod tracker;

pub use belief::Mode;
pub use estimate::{most_likely_cell, refined_m, summit_near};
pub use likelihood::{FieldOnCells, MapFields, log_likelihood_nowhere};
pub use localizer::{FIELDS_IN_MEMORY_BYTES, FrameError, Localizer, LocalizerError, Stage, Timings};
pub use motion::{ConstantVelocity, Motion, MotionModel, MotionSettings};
pub use smoother::{Smoothed, smooth};
pub use tracker::{Observation, Tracked, Tracker};
