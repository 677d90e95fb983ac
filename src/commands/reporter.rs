//! `evaluate --report`: collects what the report shows while recordings are evaluated, and writes it.

use std::fs;
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

use anyhow::Context;
use sha2::{Digest, Sha256};

use super::BadArgument;
use super::options::command_line;
use super::progress::Progress;
use crate::evaluate::{Case, Evaluation};
use crate::map::FeatureMap;
use crate::recording::Recording;
use crate::report::{Dataset, MapFacts, Report, ReportStep, utc_text};
use crate::train::{Outcomes, Survey, Trial};
use crate::types::PositionM;

/// A report in the making.
pub struct Reporter {
    folder: PathBuf,
    settings: Vec<(String, String)>,
    datasets: Vec<Dataset>,
    /// What the map was learned from.
    learned: Vec<Recording>,
}

impl Reporter {
    /// A report that goes to `folder`.
    ///
    /// # Errors
    /// There is something that must not be replaced, or a report, and `force` is not given.
    pub fn new(folder: &Path, force: bool, settings: Vec<(String, String)>) -> anyhow::Result<Self> {
        check_folder(folder, force)?;
        Ok(Self { folder: folder.into(), settings, datasets: Vec::new(), learned: Vec::new() })
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
        let context = || format!("writing the report {}", self.folder.display());
        remove_old(&self.folder).with_context(context)?;
        report.write(&self.folder, recordings, &self.learned, on_step).with_context(context)?;
        Ok(self.folder.join(PAGE))
    }
}

const PAGE: &str = "index.html";
const JSON: &str = "report.json";
const FIGURES: &str = "figures";

/// Refuses a folder that holds anything but a report, and a report unless `force` is given.
fn check_folder(folder: &Path, force: bool) -> anyhow::Result<()> {
    let bad = |what: String| Err(BadArgument(format!("--report {}: {what}", folder.display())).into());
    let Ok(facts) = fs::metadata(folder) else {
        let parent = folder.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or(Path::new("."));
        return if parent.is_dir() { Ok(()) } else { bad(format!("there is no folder {}", parent.display())) };
    };
    if !facts.is_dir() {
        return bad("exists and is not a folder; choose another name".into());
    }
    let is_ours = |path: &Path| match path.file_name().and_then(|name| name.to_str()) {
        Some(PAGE | JSON) => path.is_file(),
        Some(FIGURES) => {
            fs::read_dir(path).is_ok_and(|entries| entries.flatten().all(|entry| is_figure(&entry.path())))
        }
        _ => false,
    };
    let entries = fs::read_dir(folder).with_context(|| format!("reading the folder {}", folder.display()))?;
    let entries: Vec<PathBuf> = entries.flatten().map(|entry| entry.path()).collect();
    if let Some(foreign) = entries.iter().find(|path| !is_ours(path)) {
        let name = foreign.file_name().unwrap_or_default().to_string_lossy().into_owned();
        return bad(format!("holds {name}, which is no part of a report; choose another name"));
    }
    if !entries.is_empty() && !force {
        return bad("holds a report already; give --force to replace it".into());
    }
    Ok(())
}

fn is_figure(path: &Path) -> bool {
    path.is_file() && path.extension().is_some_and(|extension| extension == "svg" || extension == "png")
}

/// Removes the parts of an earlier report, so that no figure of it is left among the new ones.
fn remove_old(folder: &Path) -> std::io::Result<()> {
    let remove = |path: &Path| match fs::remove_file(path) {
        Err(error) if error.kind() != std::io::ErrorKind::NotFound => Err(error),
        _ => Ok(()),
    };
    // The page first: it must not show what is not there.
    remove(&folder.join(PAGE))?;
    remove(&folder.join(JSON))?;
    if let Ok(entries) = fs::read_dir(folder.join(FIGURES)) {
        for entry in entries.flatten().filter(|entry| is_figure(&entry.path())) {
            remove(&entry.path())?;
        }
    }
    Ok(())
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_reports_are_replaced_and_only_when_told() {
        let temporary = tempfile::tempdir().expect("a temporary folder");
        let folder = temporary.path().join("report");
        assert!(check_folder(&folder, false).is_ok(), "not there yet");
        fs::create_dir_all(folder.join(FIGURES)).expect("a folder");
        fs::write(folder.join(FIGURES).join("old.svg"), "").expect("writes");
        fs::write(folder.join(PAGE), "").expect("writes");
        let refused = check_folder(&folder, false).expect_err("it is there");
        assert!(refused.to_string().contains("--force"), "{refused}");
        assert!(check_folder(&folder, true).is_ok());
        remove_old(&folder).expect("removes");
        assert!(!folder.join(FIGURES).join("old.svg").exists() && !folder.join(PAGE).exists());
        fs::write(folder.join("thesis.tex"), "").expect("writes");
        let refused = check_folder(&folder, true).expect_err("it is not ours");
        assert!(refused.to_string().contains("thesis.tex"), "{refused}");
        let refused = check_folder(&temporary.path().join("no/folder"), true).expect_err("nowhere");
        assert!(refused.to_string().contains("there is no folder"), "{refused}");
    }
}
