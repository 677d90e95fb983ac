//! What a report shows of one recording: collected while it is evaluated.

use std::collections::BTreeMap;

use super::figure::slug;
use super::insight::{FrameAnswer, Insight, InsightError};
use super::photograph::Photograph;
use crate::evaluate::{Case, Entry, Evaluation, PositionShift, Statistics, WordAssignment};
use crate::map::{FeatureMap, MapInfo};
use crate::recording::Recording;
use crate::train::{Outcomes, Split, Survey, SurveyedFrame, Trial};
use crate::types::{DonutCalibration, PositionM};

#[derive(Debug, Clone)]
pub struct Dataset {
    /// Name of the recording, and the same for files and addresses, different for every recording of a report.
    pub name: String,
    pub id: String,
    pub provenance: Provenance,
    pub frames: Vec<SurveyedFrame>,
    pub truth_m: Vec<PositionM>,
    /// The results, with their frames.
    pub entries: Vec<Entry>,
    /// Of the plain variant.
    pub splits: Vec<ShownSplit>,
    /// One a recipe and kind of split, of the first seed; one for a map.
    pub insights: Vec<Insight>,
    pub eliminations: Vec<EliminationRun>,
    pub sequences: Vec<ShownSequence>,
    pub statistics: Statistics,
    pub assignments: Vec<WordAssignment>,
    pub shifts: Vec<PositionShift>,
    /// What makes the results doubtful.
    pub warnings: Vec<String>,
    /// The map that was measured against.
    pub map: Option<MapFacts>,
    /// By row.
    pub photographs: BTreeMap<usize, Photograph>,
}

/// Where the data is from.
#[derive(Debug, Clone)]
pub struct Provenance {
    pub path: String,
    pub sha256: String,
    pub frames: usize,
    pub unusable: usize,
    pub length_m: f64,
    pub duration_s: Option<f64>,
    pub extent_m: [f64; 2],
    pub with_yaw: usize,
    /// Median of what the recording states for its positions, one axis.
    pub position_std_m: Option<f64>,
    pub origin_deg: Option<[f64; 2]>,
    pub image_size_px: (usize, usize),
    pub calibration: DonutCalibration,
    /// Metadata of the recording: record, key, value.
    pub metadata: Vec<(String, String, String)>,
}

#[derive(Debug, Clone)]
pub struct ShownSplit {
    pub name: String,
    pub seed: Option<u64>,
    pub split: Split,
}

/// A backward elimination: errors against the number of features kept.
#[derive(Debug, Clone)]
pub struct EliminationRun {
    pub features: String,
    pub split: String,
    pub seed: Option<u64>,
    /// With 0, 1, … features removed.
    pub validation_rmse_m: Vec<f64>,
    pub test_rmse_m: Vec<f64>,
    pub kept: usize,
}

/// One estimator's way through a drive.
#[derive(Debug, Clone)]
pub struct ShownSequence {
    pub estimator: &'static str,
    /// Of the frames with a pose.
    pub answers: Vec<FrameAnswer>,
    /// One a frame; `None` for an estimator that has none.
    pub states: Vec<Option<&'static str>>,
}

impl ShownSequence {
    /// `row_of` tells the row of a frame's number.
    fn of(entry: &Entry, row_of: impl Fn(usize) -> Option<usize>) -> Self {
        let frames = || entry.frames.iter().flatten();
        Self {
            estimator: entry.estimator,
            answers: frames().filter_map(|frame| FrameAnswer::of_pose(frame, row_of(frame.index)?)).collect(),
            states: frames().map(|frame| frame.state).collect(),
        }
    }
}

#[derive(Debug, Clone)]
pub struct MapFacts {
    pub path: String,
    pub sha256: String,
    pub info: MapInfo,
    pub cells: usize,
}

/// What counts as near and as gross: in a room other distances matter than in a street.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Yardstick {
    /// Bounds of the classes that errors are coloured by.
    pub error_classes_m: [f64; 4],
    /// Distances at which a frame counts as found.
    pub recall_m: [f64; 4],
    pub near_m: f64,
    pub gross_m: f64,
}

const STREET: Yardstick =
    Yardstick { error_classes_m: [1.0, 2.0, 5.0, 10.0], recall_m: [1.0, 2.0, 5.0, 10.0], near_m: 2.0, gross_m: 10.0 };
const ROOM: Yardstick =
    Yardstick { error_classes_m: [0.1, 0.2, 0.5, 1.0], recall_m: [0.1, 0.2, 0.5, 1.0], near_m: 0.5, gross_m: 1.0 };

impl Dataset {
    pub fn yardstick(&self) -> Yardstick {
        /// Positions that lie within so much are in a room \[m\].
        const ROOM_M: f64 = 20.0;
        let [east_m, north_m] = self.provenance.extent_m;
        if east_m.hypot(north_m) < ROOM_M { ROOM } else { STREET }
    }

    /// `sha256` is that of the file.
    pub fn new(recording: &Recording, sha256: String, survey: &Survey, truth_m: &[PositionM]) -> Self {
        let positions_m = survey.positions_m();
        let of_axis = |axis: usize, pick: fn(f64, f64) -> f64| positions_m.iter().map(|p| p[axis]).reduce(pick);
        let extent = |axis| of_axis(axis, f64::max).zip(of_axis(axis, f64::min)).map_or(0.0, |(high, low)| high - low);
        let times_s = || recording.survey.iter().filter_map(|frame| frame.known_time_s());
        let timed = times_s().count() == recording.survey.len();
        let mut stated_m: Vec<f64> = recording.survey.iter().filter_map(|frame| frame.position_std_m).collect();
        stated_m.sort_unstable_by(f64::total_cmp);
        let metadata = recording.metadata.iter();
        let provenance = Provenance {
            path: recording.path.display().to_string(),
            sha256,
            frames: survey.len(),
            unusable: recording.unusable.len(),
            length_m: recording.length_m(),
            duration_s: times_s().next_back().zip(times_s().next()).filter(|_| timed).map(|(last, first)| last - first),
            extent_m: [extent(0), extent(1)],
            with_yaw: survey.frames.iter().filter(|frame| frame.yaw_rad.is_some()).count(),
            position_std_m: stated_m.get(stated_m.len() / 2).copied(),
            origin_deg: recording.origin.map(|origin| [origin.latitude_deg, origin.longitude_deg]),
            image_size_px: survey.image_size_px,
            calibration: survey.calibration.clone(),
            metadata: metadata
                .flat_map(|(record, pairs)| pairs.iter().map(move |(k, v)| (record.clone(), k.clone(), v.clone())))
                .collect(),
        };
        Self {
            name: recording.name.clone(),
            id: slug(&recording.name),
            provenance,
            frames: survey.frames.clone(),
            truth_m: truth_m.to_vec(),
            entries: Vec::new(),
            splits: Vec::new(),
            insights: Vec::new(),
            eliminations: Vec::new(),
            sequences: Vec::new(),
            statistics: Statistics::default(),
            assignments: Vec::new(),
            shifts: Vec::new(),
            warnings: Vec::new(),
            map: None,
            photographs: BTreeMap::new(),
        }
    }

    /// Keeps what is shown of a trial of the plain variant.
    pub fn take_trial(
        &mut self,
        survey: &Survey,
        case: &Case,
        trial: &Trial,
        outcomes: &Outcomes,
    ) -> Result<(), InsightError> {
        let (name, seed) = (&case.split_name, case.seed);
        let is_first_seed = !self.splits.iter().any(|split| split.name == *name && split.seed != seed);
        if !self.splits.iter().any(|split| split.name == *name && split.seed == seed) {
            self.splits.push(ShownSplit { name: name.clone(), seed, split: trial.split.clone() });
        }
        let test_m: Vec<PositionM> = trial.split.test.iter().map(|&row| self.truth_m[row]).collect();
        for row in &outcomes.rows {
            let Some(elimination) = &row.elimination else { continue };
            self.eliminations.push(EliminationRun {
                features: row.features.clone(),
                split: name.clone(),
                seed,
                validation_rmse_m: elimination.path.rmse_m.clone(),
                test_rmse_m: elimination.test_m.iter().map(|estimates_m| rmse_m(estimates_m, &test_m)).collect(),
                kept: row.kept,
            });
        }
        if is_first_seed && let Some(insight) = Insight::of_trial(survey, case, trial, &self.truth_m, outcomes)? {
            self.insights.push(insight);
        }
        Ok(())
    }

    /// Keeps what is shown of a map.
    pub fn take_map(&mut self, survey: &Survey, map: &FeatureMap, facts: MapFacts) {
        self.insights.push(Insight::of_map(survey, map, &self.truth_m));
        self.map = Some(facts);
    }

    /// Keeps the results.
    pub fn take_evaluation(&mut self, evaluation: &Evaluation) {
        self.entries = evaluation.entries.clone();
        self.statistics = evaluation.statistics.clone();
        self.assignments = evaluation.assignments.clone();
        self.shifts = evaluation.shifts.clone();
        self.warnings = evaluation.warnings.clone();
        let row_of = |index: usize| self.frames.iter().position(|frame| frame.index == index);
        let of_drive = |entry: &&Entry| entry.estimator != "single";
        self.sequences = self.entries.iter().filter(of_drive).map(|entry| ShownSequence::of(entry, row_of)).collect();
    }

    /// The insight that pictures of single frames are of: the default recipe where there is one.
    pub fn shown_insight(&self) -> Option<&Insight> {
        let of_default = self.insights.iter().find(|insight| insight.recipe == "default");
        of_default.or_else(|| self.insights.first())
    }

    /// Names of the splits, in the order they were evaluated.
    pub fn split_names(&self) -> Vec<String> {
        let mut names: Vec<String> = Vec::new();
        for entry in &self.entries {
            if let Some(split) = &entry.split
                && !names.contains(split)
            {
                names.push(split.clone());
            }
        }
        names
    }
}

fn rmse_m(estimates_m: &[PositionM], truth_m: &[PositionM]) -> f64 {
    let square = |(e, t): (&PositionM, &PositionM)| (e[0] - t[0]).powi(2) + (e[1] - t[1]).powi(2);
    (estimates_m.iter().zip(truth_m).map(square).sum::<f64>() / truth_m.len().max(1) as f64).sqrt()
}
