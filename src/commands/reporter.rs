//! `evaluate --report`: collects what the report shows while recordings are evaluated, and writes it.

use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

use anyhow::Context;

use super::options::command_line;
use super::progress::Progress;
use super::report_folder::ReportFolder;
use crate::evaluate::{Case, Evaluation, InputFile};
use crate::map::FeatureMap;
use crate::recording::Recording;
use crate::report::{Dataset, MapFacts, Report, ReportStep, utc_text};
use crate::train::{Outcomes, Survey, Trial};
use crate::types::PositionM;

/// A report in the making.
pub struct Reporter {
    folder: ReportFolder,
    settings: Vec<(String, String)>,
    inputs: Vec<InputFile>,
    datasets: Vec<Dataset>,
    /// What the map was learned from.
    learned: Vec<Recording>,
}

impl Reporter {
    /// A report on `inputs` that goes to `folder`, which is made, and written to, now.
    ///
    /// # Errors
    /// There is something that must not be replaced, or a report, and `force` is not given; or it cannot be written to.
    pub fn new(folder: &Path, force: bool, settings: Vec<(String, String)>) -> anyhow::Result<Self> {
        let folder = ReportFolder::open(folder, force)?;
        Ok(Self { folder, settings, inputs: Vec::new(), datasets: Vec::new(), learned: Vec::new() })
    }

    /// The files that are read.
    pub fn take_inputs(&mut self, inputs: &[InputFile]) {
        self.inputs = inputs.to_vec();
    }

    /// What follows is of this recording.
    pub fn begin(&mut self, recording: &Recording, survey: &Survey, truth_m: &[PositionM]) {
        let sha256 = self.sha256_of(&recording.path);
        self.datasets.push(Dataset::new(recording, sha256, survey, truth_m));
    }

    /// What a recipe brought in the plain variant of a split.
    pub fn take_trial(
        &mut self,
        survey: &Survey,
        case: &Case,
        trial: &Trial,
        outcomes: &Outcomes,
    ) -> anyhow::Result<()> {
        self.current().take_trial(survey, case, trial, outcomes).context("looking into a trial for the report")
    }

    /// The map that is measured against, and the recordings that it was learned from, as far as they are known.
    pub fn take_map(&mut self, survey: &Survey, path: &Path, map: &FeatureMap, learned: &[Recording]) {
        let (path, sha256) = (path.display().to_string(), self.sha256_of(path));
        let facts = MapFacts { path, sha256, info: map.info.clone(), cells: map.cells.len() };
        self.current().take_map(survey, map, facts);
        self.learned = learned.to_vec();
    }

    fn sha256_of(&self, path: &Path) -> String {
        let file = path.display().to_string();
        let input = self.inputs.iter().find(|input| input.file == file);
        input.expect("every recording and map is an input").sha256.clone()
    }

    /// The results of the recording that was begun last.
    pub fn take_evaluation(&mut self, evaluation: &Evaluation) {
        self.current().take_evaluation(evaluation);
    }

    fn current(&mut self) -> &mut Dataset {
        self.datasets.last_mut().expect("a recording was begun")
    }

    /// Writes the report; returns its page.
    pub fn write(mut self, recordings: &[Recording], progress: &Progress) -> anyhow::Result<PathBuf> {
        let now_s = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |since| since.as_secs());
        let report = Report {
            program: env!("CARGO_PKG_VERSION").into(),
            made: utc_text(now_s),
            command: command_line(),
            settings: self.settings,
            inputs: self.inputs,
            datasets: self.datasets,
        };
        let on_step = |step| match step {
            ReportStep::Reading => progress.begin("report: reading the frames that are shown", 1),
            ReportStep::Drawing { figures } => progress.begin("report: drawing", figures),
            ReportStep::Drawn => progress.advance(1),
        };
        let path = self.folder.path().to_path_buf();
        let context = || format!("writing the report {}", path.display());
        let drawing = self.folder.drawing().with_context(context)?;
        report.write(&drawing, recordings, &self.learned, on_step).with_context(context)?;
        self.folder.show().with_context(context)
    }
}
