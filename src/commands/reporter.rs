//! `evaluate --report`: collects what the report shows while recordings are evaluated, and writes it.

use std::fs;
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

use anyhow::Context;
use sha2::{Digest, Sha256};

use super::options::command_line;
use super::progress::Progress;
use super::report_folder::ReportFolder;
use crate::evaluate::{Case, Evaluation};
use crate::map::FeatureMap;
use crate::recording::Recording;
use crate::report::{Dataset, MapFacts, Report, ReportStep, utc_text};
use crate::train::{Outcomes, Survey, Trial};
use crate::types::PositionM;

/// A report in the making.
pub struct Reporter {
    folder: ReportFolder,
    settings: Vec<(String, String)>,
    datasets: Vec<Dataset>,
    /// What the map was learned from.
    learned: Vec<Recording>,
}

impl Reporter {
    /// A report that goes to `folder`, which is made, and written to, now.
    ///
    /// # Errors
    /// There is something that must not be replaced, or a report, and `force` is not given; or it cannot be written to.
    pub fn new(folder: &Path, force: bool, settings: Vec<(String, String)>) -> anyhow::Result<Self> {
        let folder = ReportFolder::open(folder, force)?;
        Ok(Self { folder, settings, datasets: Vec::new(), learned: Vec::new() })
    }

    /// What follows is of this recording.
    pub fn begin(&mut self, recording: &Recording, survey: &Survey, truth_m: &[PositionM]) -> anyhow::Result<()> {
        let sha256 = sha256_of(&recording.path)?;
        self.datasets.push(Dataset::new(recording, sha256, survey, truth_m));
        Ok(())
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
    pub fn take_map(
        &mut self,
        survey: &Survey,
        path: &Path,
        map: &FeatureMap,
        learned: &[Recording],
    ) -> anyhow::Result<()> {
        let (path, sha256) = (path.display().to_string(), sha256_of(path)?);
        let facts = MapFacts { path, sha256, info: map.info.clone(), cells: map.cells.len() };
        self.current().take_map(survey, map, facts);
        self.learned = learned.to_vec();
        Ok(())
    }

    /// The results of the recording that was begun last.
    pub fn take_evaluation(&mut self, evaluation: &Evaluation) {
        self.current().take_evaluation(evaluation);
    }

    fn current(&mut self) -> &mut Dataset {
        self.datasets.last_mut().expect("a recording was begun")
    }

    /// Writes the report; returns its page.
    pub fn write(self, recordings: &[Recording], progress: &Progress) -> anyhow::Result<PathBuf> {
        let now_s = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |since| since.as_secs());
        let report = Report {
            program: env!("CARGO_PKG_VERSION").into(),
            made: utc_text(now_s),
            command: command_line(),
            settings: self.settings,
            datasets: self.datasets,
        };
        let on_step = |step| match step {
            ReportStep::Reading => progress.begin("report: reading the frames that are shown", 1),
            ReportStep::Drawing { figures } => progress.begin("report: drawing", figures),
            ReportStep::Drawn => progress.advance(1),
        };
        let path = self.folder.path().to_path_buf();
        let context = || format!("writing the report {}", path.display());
        report.write(self.folder.drawing(), recordings, &self.learned, on_step).with_context(context)?;
        self.folder.show().with_context(context)
    }
}

fn sha256_of(path: &Path) -> anyhow::Result<String> {
    let context = || format!("reading {}", path.display());
    let mut file = fs::File::open(path).with_context(context)?;
    let mut hash = Sha256::new();
    let mut buffer = vec![0; 1 << 16];
    loop {
        let read = std::io::Read::read(&mut file, &mut buffer).with_context(context)?;
        if read == 0 {
            break;
        }
        hash.update(&buffer[..read]);
    }
    Ok(hash.finalize().iter().map(|byte| format!("{byte:02x}")).collect())
}
