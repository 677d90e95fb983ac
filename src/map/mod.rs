//! The map.

mod cells;

pub use cells::{CandidateCells, CellsError, Grid};
