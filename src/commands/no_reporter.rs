//! `evaluate --report` in a program that was built without reports: says so, before any work is done.

use std::path::{Path, PathBuf};

use super::BadArgument;
use super::progress::Progress;
use crate::evaluate::{Entry, Sequence};
use crate::map::FeatureMap;
use crate::recording::Recording;
use crate::train::{Outcomes, Survey};
use crate::types::PositionM;

/// There is none.
pub enum Reporter {}

/// What a trial was run on: see `report::TrialFacts`.
pub struct TrialFacts<'a> {
    pub recipe: &'a crate::map::Recipe,
    pub split: &'a crate::train::Split,
    pub split_name: &'a str,
    pub seed: Option<u64>,
    pub grid_step_m: f64,
    pub learned_m: &'a [PositionM],
    pub truth_m: &'a [PositionM],
}

impl Reporter {
    pub fn new(_: &Path, _: bool, _: Vec<(String, String)>) -> anyhow::Result<Self> {
        let text = "--report: this omniloc was built without reports, as for a vehicle; build it on the desk with \
                    `cargo build --release`";
        Err(BadArgument(text.into()).into())
    }

    pub fn begin(&mut self, _: &Recording, _: &Survey, _: &[PositionM]) -> anyhow::Result<()> {
        match *self {}
    }

    pub fn take_trial(&mut self, _: &Survey, _: &TrialFacts, _: &Outcomes) -> anyhow::Result<()> {
        match *self {}
    }

    pub fn take_map(&mut self, _: &Survey, _: &Path, _: &FeatureMap, _: &[Sequence]) -> anyhow::Result<()> {
        match *self {}
    }

    pub fn take_entries(&mut self, _: &[Entry]) {
        match *self {}
    }

    pub fn write(self, _: &[Recording], _: &[Recording], _: &Progress) -> anyhow::Result<PathBuf> {
        match self {}
    }
}
