//! How good is it? Error figures, the paper's tables, and other drives against a map.

mod against_map;
mod entry;
mod sequence;

pub use against_map::{AgainstMap, MapOutcome, against_map};
pub use entry::{Entry, FrameEntry, LEGEND, table};
pub use sequence::{Sequence, SequenceFigures, SequencePose};
