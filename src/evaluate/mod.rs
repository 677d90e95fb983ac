//! Figures.

mod metrics;

pub use metrics::ErrorFigures;
