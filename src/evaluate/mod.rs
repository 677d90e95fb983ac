//! How good is it? Error figures, the paper's tables, and other drives against a map.

mod against_map;
mod entry;

pub use against_map::{MapOutcome, against_map};
pub use entry::{Entry, FrameEntry, LEGEND, table};
