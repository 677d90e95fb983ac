//! Whole drives through the synchronizer, against the truth.

mod accuracy;
mod drive;
mod faults;
