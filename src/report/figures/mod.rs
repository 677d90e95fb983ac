//! The figures, one file a family: each takes a [`Dataset`] and answers with a [`Figure`](super::figure::Figure), or with the
//! reason why there is none.

mod elimination;
mod errors;
mod frame;
mod likelihood;
mod paths;
mod reliability;
mod splits;
mod surfaces;
mod timeline;

pub use errors::{RECALL_AT_M, cases, recall_at};
pub use frame::shown_row;
pub use paths::extent_of;

use super::dataset::Dataset;
use super::figure::Drawn;
use crate::train::SurveyedFrame;

/// All figures of a dataset, in the order they are read.
pub fn all(dataset: &Dataset) -> Vec<Drawn> {
    let mut drawn = Vec::new();
    drawn.push(errors::comparison(dataset));
    drawn.push(errors::distribution(dataset));
    drawn.push(errors::recall(dataset));
    drawn.push(paths::estimates(dataset));
    drawn.push(paths::error_map(dataset));
    drawn.push(timeline::timeline(dataset));
    drawn.push(reliability::reliability(dataset));
    drawn.push(likelihood::likelihood(dataset));
    drawn.push(elimination::elimination(dataset));
    drawn.push(surfaces::surfaces(dataset));
    drawn.push(frame::frame(dataset));
    drawn.push(splits::splits(dataset));
    drawn
}

/// The time of a frame since the first \[s\], where it is known.
fn time_s(frames: &[SurveyedFrame], row: usize) -> Option<f64> {
    Some(frames[row].time_s? - frames[0].time_s?)
}
