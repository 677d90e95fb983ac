//! How good is it? Error figures, the paper's tables, and other drives against a map; what to compare with, and how far
//! the figures can be trusted.

mod against_map;
pub mod baselines;
mod entry;
mod input;
mod map_baselines;
mod protocol;
mod sequence;
mod shifts;
pub mod statistics;

pub use against_map::{AgainstMap, MapOutcome, against_map, covariance_about, map_entries};
pub use baselines::WordAssignment;
pub use entry::{Entry, FrameEntry, LEGEND, emax_m, table};
pub use input::InputFile;
pub use map_baselines::MapComparison;
pub use protocol::{Case, CaseResults, Protocol, Variant};
pub use sequence::{Sequence, SequenceFigures, SequencePose, nees};
pub use shifts::PositionShift;
pub use statistics::Statistics;

/// All that an evaluation brings.
#[derive(Debug, Clone, Default)]
pub struct Evaluation {
    /// Every one with its frames.
    pub entries: Vec<Entry>,
    /// Of all entries.
    pub statistics: Statistics,
    /// One a bag of words and case.
    pub assignments: Vec<WordAssignment>,
    /// One a trial, or recording of a map, whose positions were smoothed.
    pub shifts: Vec<PositionShift>,
    /// Of all recordings together.
    pub inputs: Vec<InputFile>,
    /// What makes the results doubtful.
    pub warnings: Vec<String>,
}
