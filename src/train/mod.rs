//! Offline.

pub mod noise_whitening;
pub mod perturbation;
mod split;
mod subset;

pub use split::{Split, SplitError, SplitKind};
pub use subset::{Elimination, LikelihoodTable, backward_elimination, component_median};
