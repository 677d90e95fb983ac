//! `evaluate --report` in a program that was built without reports: says so, before any work is done.

use std::path::{Path, PathBuf};

use super::BadArgument;
use super::progress::Progress;
use crate::evaluate::{Case, Evaluation, InputFile};
use crate::map::FeatureMap;
use crate::recording::Recording;
use crate::train::{Outcomes, Survey, Trial};
use crate::types::PositionM;

/// There is none.
pub enum Reporter {}

impl Reporter {
    pub fn new(_: &Path, _: bool, _: Vec<(String, String)>) -> anyhow::Result<Self> {
        let text = "--report: this omniloc was built without reports, as for a vehicle; build it on the desk with \
                    `cargo build --release`";
        Err(BadArgument(text.into()).into())
    }

    pub fn take_inputs(&mut self, _: &[InputFile]) {
        match *self {}
    }

    pub fn begin(&mut self, _: &Recording, _: &Survey, _: &[PositionM]) {
        match *self {}
    }

    pub fn take_trial(&mut self, _: &Survey, _: &Case, _: &Trial, _: &Outcomes) -> anyhow::Result<()> {
        match *self {}
    }

    pub fn take_map(&mut self, _: &Survey, _: &Path, _: &FeatureMap, _: &[Recording]) {
        match *self {}
    }

    pub fn take_evaluation(&mut self, _: &Evaluation) {
        match *self {}
    }

    pub fn write(self, _: &[Recording], _: &Progress) -> anyhow::Result<PathBuf> {
        match self {}
    }
}
