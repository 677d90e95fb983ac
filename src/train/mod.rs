//! Offline.

mod group;
pub mod noise_whitening;
pub mod perturbation;
mod recipe;
mod split;
mod subset;
mod survey;

pub use group::{GroupHyperparameters, LearnError, LearnedGroup};
pub use recipe::{GroupRecipe, Model, PERTURBED_COPIES, Recipe, RecipeName, Selection};
pub use split::{Split, SplitError, SplitKind};
pub use subset::{Elimination, LikelihoodTable, backward_elimination, component_median};
pub use survey::{Survey, SurveyError, SurveyOptions, SurveyedFrame};
