//! One frame's features against the map: where is it?

mod estimate;
mod likelihood;

pub use estimate::{most_likely_cell, refined_m};
pub use likelihood::FieldOnCells;
