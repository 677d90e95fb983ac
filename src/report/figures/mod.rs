//! The figures, one file a family: each takes a [`Dataset`] and answers with a [`Figure`](super::figure::Figure), or with the
//! reason why there is none.

mod elimination;
mod errors;
mod frame;
mod likelihood;
mod paired;
mod paths;
mod reliability;
mod splits;
mod surfaces;
mod timeline;
mod words;

pub use errors::{RECALL_AT_M, cases, recall_at};
pub use frame::shown_row;
pub use paths::extent_of;

use super::dataset::Dataset;
use super::figure::Drawn;
use crate::train::SurveyedFrame;

/// All figures of a dataset, in the order they are read.
pub fn all(dataset: &Dataset) -> Vec<Drawn> {
    vec![
        errors::comparison(dataset),
        errors::distribution(dataset),
        paired::paired(dataset),
        errors::recall(dataset),
        paths::estimates(dataset),
        paths::error_map(dataset),
        timeline::timeline(dataset),
        reliability::reliability(dataset),
        likelihood::likelihood(dataset),
        elimination::elimination(dataset),
        words::words(dataset),
        surfaces::surfaces(dataset),
        frame::frame(dataset),
        splits::splits(dataset),
    ]
}

/// The time of a frame since the first \[s\], where it is known.
fn time_s(frames: &[SurveyedFrame], row: usize) -> Option<f64> {
    Some(frames[row].time_s? - frames[0].time_s?)
}
