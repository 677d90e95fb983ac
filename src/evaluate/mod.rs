//! Figures.

mod metrics;
pub mod protocol;

pub use metrics::ErrorFigures;
