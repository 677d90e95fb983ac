//! The paper's protocol on one survey: learn, select, test.

use std::collections::BTreeMap;

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;

use super::group::{LearnError, LearnedGroup};
use super::perturbation::standard_normal;
use super::recognition::{self, HeldBack};
use super::split::Split;
use super::subset::{Elimination, LikelihoodTable, backward_elimination};
use super::survey::Survey;
use super::temperature::fit_temperature;
use crate::gp::fit::Warning;
use crate::gp::{GpError, LearningPositions};
use crate::localize::{FieldOnCells, log_likelihood_nowhere, most_likely_cell, refined_m};
use crate::map::{CandidateCells, CellsError, NoiseModel, Recipe, Selection};
use crate::metrics::component_median;
use crate::types::PositionM;

/// One way of carrying out the protocol.
#[derive(Debug, Clone)]
pub struct Trial<'a> {
    pub recipe: &'a Recipe,
    pub split: &'a Split,
    pub grid_step_m: f64,
    /// Positions to learn from and to select on, one a frame of the survey; whatever was done to them, the test frames'
    /// images had no part in it.
    pub recorded_m: &'a [PositionM],
    /// What they may still be off by, one standard deviation on either axis; 0 where nothing is known of it.
    pub remaining_std_m: &'a [f64],
}

/// What a trial brought.
#[derive(Debug, Clone)]
pub struct Outcomes {
    /// One a group, and one of all groups fused if there are several.
    pub rows: Vec<Outcome>,
    /// The groups, with the features kept.
    pub groups: Vec<LearnedGroup>,
    /// Number of frames they were learned from in the end.
    pub learned_from: usize,
    /// What the fused log-likelihood of the validation frames, none of which was learned from, has to be divided by to be
    /// as sharp as their errors; `None` with too few of them.
    pub temperature: Option<f64>,
    /// Of frames of no place in the map, not divided by the temperature: see
    /// [`MapInfo::least_resemblance`](crate::map::MapInfo::least_resemblance).
    pub least_resemblance: Option<f64>,
}

/// What a trial brought for one row of the table: a group, or all of them fused.
#[derive(Debug, Clone)]
pub struct Outcome {
    /// Name of the descriptor, or `fused`.
    pub features: String,
    /// Properties, features after scaling, and features kept by the selection.
    pub m: usize,
    pub rank: usize,
    pub kept: usize,
    /// Estimates of the test frames, in the order of the split, with all features and with those kept.
    pub all_test_m: Vec<PositionM>,
    pub kept_test_m: Vec<PositionM>,
    /// Estimates of the validation frames with the features kept.
    pub kept_validation_m: Vec<PositionM>,
    /// Bayesian information criterion with all features and with those kept; `None` where features have no likelihood of
    /// their own.
    pub bic_all: Option<f64>,
    pub bic_kept: Option<f64>,
    /// Fits with something to say, by what they say.
    pub warnings: BTreeMap<Warning, usize>,
    /// How features were removed; `None` where they were not removed one by one.
    pub elimination: Option<EliminationOnTest>,
}

/// A backward elimination, and what the test frames, which had no part in it, would have been answered on the way.
#[derive(Debug, Clone, PartialEq)]
pub struct EliminationOnTest {
    pub path: Elimination,
    /// Estimates of the test frames with 0, 1, … features removed, by cells; with all removed the median.
    pub test_m: Vec<Vec<PositionM>>,
}

#[derive(Debug, thiserror::Error)]
pub enum TrialError {
    #[error(transparent)]
    Learn(#[from] LearnError),
    #[error(transparent)]
    Gp(#[from] GpError),
    #[error(transparent)]
    Cells(#[from] CellsError),
    #[error("all {frames} learning images are at one place: there is nothing to localize")]
    OnePlace { frames: usize },
    #[error(
        "{learning} learning and {validation} validation images: at least {MIN_LEARNING} and 1 are needed; record more frames"
    )]
    TooFewFrames { learning: usize, validation: usize },
    #[error(
        "selecting among {features} features on {queries} validation images and {cells} cells needs {gigabytes:.1} GB; \
         use a larger --grid-step-m"
    )]
    TableTooLarge { features: usize, queries: usize, cells: usize, gigabytes: f64 },
    #[error("the selection kept no feature of any type: none helps on the validation images; use --select none")]
    NothingKept,
}

/// Fewer learning images than this have no Gaussian process worth the name.
const MIN_LEARNING: usize = 3;
/// A likelihood table larger than this is refused.
const MAX_TABLE_BYTES: usize = 2 << 30;

/// What a trial is doing, for a progress display.
#[derive(Debug, Clone, Copy)]
pub enum Step {
    /// So many features are about to be fitted to this descriptor.
    Fitting {
        descriptor: &'static str,
        features: usize,
    },
    FeatureFitted,
    Eliminating {
        features: usize,
    },
    FeatureEliminated,
    Done,
}

/// Log-likelihoods of queries at every cell, query × cell, summed over groups.
struct Likelihoods {
    cells: usize,
    values: Vec<f32>,
}

/// Runs `trial` on `survey`.
///
/// A recipe that refits chooses nothing on the validation frames: once measured on them it learns from them too, and is
/// tested so.
pub fn run(survey: &Survey, trial: &Trial, on_step: impl Fn(Step) + Sync) -> Result<Outcomes, TrialError> {
    let first = run_once(survey, trial, &trial.split.learning, &on_step)?;
    if !trial.recipe.refit {
        return Ok(first);
    }
    let mut everything_seen = [&trial.split.learning[..], &trial.split.validation].concat();
    everything_seen.sort_unstable();
    let mut refitted = run_once(survey, trial, &everything_seen, &on_step)?;
    for (row, before) in refitted.rows.iter_mut().zip(first.rows) {
        row.kept_validation_m = before.kept_validation_m;
    }
    Ok(Outcomes { temperature: first.temperature, least_resemblance: first.least_resemblance, ..refitted })
}

fn run_once(
    survey: &Survey,
    trial: &Trial,
    learning_rows: &[usize],
    on_step: &(impl Fn(Step) + Sync),
) -> Result<Outcomes, TrialError> {
    let at = |rows: &[usize]| -> Vec<PositionM> { rows.iter().map(|&row| trial.recorded_m[row]).collect() };
    let split = trial.split;
    let learning = LearningPositions::of_recordings(at(learning_rows), &survey.recordings_of(learning_rows));
    if learning.len() < MIN_LEARNING || split.validation.is_empty() {
        return Err(TrialError::TooFewFrames { learning: learning.len(), validation: split.validation.len() });
    }
    if learning.positions().windows(2).all(|pair| pair[0] == pair[1]) {
        return Err(TrialError::OnePlace { frames: learning.len() });
    }
    let cells = CandidateCells::around(learning.positions(), trial.grid_step_m, None)?;
    let centers_m = cells.centers_m();
    let queries = Queries { survey, trial, validation_m: at(&split.validation) };
    let median_m = component_median(learning.positions());
    let estimate = |likelihoods: &Likelihoods, features: usize| -> Vec<PositionM> {
        let rows = likelihoods.values.chunks_exact(likelihoods.cells);
        match features {
            // The empty set answers the median.
            0 => rows.map(|_| median_m).collect(),
            _ => rows.map(|row| locate(&cells, row, trial.recipe.refine)).collect(),
        }
    };

    let mut outcomes = Vec::new();
    let mut groups = Vec::new();
    let mut fused: Option<[Likelihoods; 3]> = None;
    // Of the validation frames.
    let mut nowhere = Some(vec![0.0; split.validation.len()]);
    for group_recipe in &trial.recipe.groups {
        let descriptor = group_recipe.descriptor;
        on_step(Step::Fitting { descriptor: descriptor.name(), features: descriptor.dimensions() });
        let group = LearnedGroup::learn(
            *group_recipe,
            &learning,
            survey.properties(descriptor, learning_rows).as_ref(),
            survey.changes(descriptor, learning_rows).as_ref(),
            || on_step(Step::FeatureFitted),
        )?;
        let field = group.on_cells(&learning, &centers_m)?;
        let mut elimination = None;
        let kept = match trial.recipe.selection {
            Selection::None => (0..group.features()).collect(),
            Selection::Backward => {
                let path = queries.eliminate(&group, &field, &centers_m, on_step)?;
                let kept = path.best_subset();
                let test_m = queries.test_on_path(&path, &group, &field, &centers_m, median_m);
                elimination = Some(EliminationOnTest { path, test_m });
                kept
            }
        };
        let kept_group = group.select(&kept);
        let kept_field = field.select(&kept);
        let all_test = queries.likelihoods(&group, &field, &split.test);
        let kept_test = queries.likelihoods(&kept_group, &kept_field, &split.test);
        let kept_validation = queries.likelihoods(&kept_group, &kept_field, &split.validation);
        let everything: Vec<usize> = (0..group.features()).collect();
        let bic = |kept: &[usize]| group.log_likelihood(kept).map(|l| bic(l, kept.len(), learning.len()));
        outcomes.push(Outcome {
            features: descriptor.name().to_owned(),
            m: descriptor.dimensions(),
            rank: group.rank,
            kept: kept.len(),
            all_test_m: estimate(&all_test, group.features()),
            kept_test_m: estimate(&kept_test, kept.len()),
            kept_validation_m: estimate(&kept_validation, kept.len()),
            bic_all: bic(&everything),
            bic_kept: bic(&kept),
            warnings: group.hyperparameters.warnings(),
            elimination,
        });
        let of_group = queries.nowhere(&kept_group, &split.validation);
        nowhere = nowhere
            .zip(of_group)
            .map(|(sums, of_group): (Vec<f32>, _)| sums.iter().zip(of_group).map(|(sum, value)| sum + value).collect());
        match &mut fused {
            None => fused = Some([all_test, kept_test, kept_validation]),
            Some(sums) => {
                for (sum, likelihoods) in sums.iter_mut().zip([all_test, kept_test, kept_validation]) {
                    sum.add(&likelihoods);
                }
            }
        }
        groups.push(kept_group);
        on_step(Step::Done);
    }
    let rows: Vec<&[f32]> = fused.as_ref().map_or(Vec::new(), |[_, _, kept_validation]| {
        kept_validation.values.chunks_exact(kept_validation.cells).collect()
    });
    let validation_std_m: Vec<f64> = split.validation.iter().map(|&row| trial.remaining_std_m[row]).collect();
    let temperature = fit_temperature(&cells, &rows, &queries.validation_m, &validation_std_m);
    let least_resemblance = nowhere.and_then(|nowhere| {
        let truth_m = &queries.validation_m;
        let held_back = HeldBack { cells: &cells, log_likelihoods: &rows, nowhere: &nowhere, truth_m };
        recognition::least_resemblance(&held_back, learning.spacing_m())
    });
    if let (Some([all_test, kept_test, kept_validation]), true) = (fused, outcomes.len() > 1) {
        let total = |of: fn(&Outcome) -> usize| -> usize { outcomes.iter().map(of).sum() };
        let sum = |of: fn(&Outcome) -> Option<f64>| outcomes.iter().map(of).sum();
        outcomes.push(Outcome {
            features: "fused".into(),
            m: total(|outcome| outcome.m),
            rank: total(|outcome| outcome.rank),
            kept: total(|outcome| outcome.kept),
            all_test_m: estimate(&all_test, total(|outcome| outcome.rank)),
            kept_test_m: estimate(&kept_test, total(|outcome| outcome.kept)),
            kept_validation_m: estimate(&kept_validation, total(|outcome| outcome.kept)),
            bic_all: sum(|outcome| outcome.bic_all),
            bic_kept: sum(|outcome| outcome.bic_kept),
            warnings: BTreeMap::new(),
            elimination: None,
        });
    }
    Ok(Outcomes { rows: outcomes, groups, learned_from: learning.len(), temperature, least_resemblance })
}

/// −2 Σ L(θ_r) + 4 |Ω| log n: the reading of the Bayesian information criterion that fits the paper's tables, four
/// hyperparameters a feature.
fn bic(log_likelihood: f64, features: usize, learning: usize) -> f64 {
    -2.0 * log_likelihood + 4.0 * features as f64 * (learning as f64).ln()
}

/// The position of greatest log-likelihood: the cell, or the summit next to it.
pub fn locate(cells: &CandidateCells, log_likelihood: &[f32], refine: bool) -> PositionM {
    let best = most_likely_cell(log_likelihood);
    if refine { refined_m(cells, log_likelihood, best) } else { cells.center_m(best) }
}

/// The frames of a trial as queries.
struct Queries<'a> {
    survey: &'a Survey,
    trial: &'a Trial<'a>,
    validation_m: Vec<PositionM>,
}

impl Queries<'_> {
    /// Backward elimination on the validation frames.
    fn eliminate(
        &self,
        group: &LearnedGroup,
        field: &FieldOnCells,
        centers_m: &[PositionM],
        on_step: &(impl Fn(Step) + Sync),
    ) -> Result<Elimination, TrialError> {
        on_step(Step::Eliminating { features: group.features() });
        let (features, queries, cells) = (group.features(), self.validation_m.len(), centers_m.len());
        let bytes = features * queries * cells * size_of::<f32>();
        if bytes > MAX_TABLE_BYTES {
            return Err(TrialError::TableTooLarge { features, queries, cells, gigabytes: bytes as f64 * 1e-9 });
        }
        let mut table = LikelihoodTable::new(group.features(), centers_m.to_vec());
        let features = self.features(group, &self.trial.split.validation);
        let rows: Vec<Vec<f32>> = features.par_iter().map(|row| field.log_likelihood_of_each(row)).collect();
        for (row, &truth_m) in rows.into_iter().zip(&self.validation_m) {
            table.push(truth_m, row);
        }
        Ok(backward_elimination(&table, |_| on_step(Step::FeatureEliminated)))
    }

    /// Answers for the test frames on the way of an elimination: step × frame.
    fn test_on_path(
        &self,
        path: &Elimination,
        group: &LearnedGroup,
        field: &FieldOnCells,
        centers_m: &[PositionM],
        median_m: PositionM,
    ) -> Vec<Vec<PositionM>> {
        let features = self.features(group, &self.trial.split.test);
        let of_frames: Vec<Vec<PositionM>> = features
            .par_iter()
            .map(|features| {
                let each = field.log_likelihood_of_each(features);
                let row = |r: usize| &each[r * centers_m.len()..(r + 1) * centers_m.len()];
                let mut sum = vec![0.0_f32; centers_m.len()];
                (0..group.features()).for_each(|r| sum.iter_mut().zip(row(r)).for_each(|(sum, l)| *sum += l));
                let mut answers_m = vec![centers_m[most_likely_cell(&sum)]];
                for (step, &removed) in path.removed.iter().enumerate() {
                    sum.iter_mut().zip(row(removed)).for_each(|(sum, l)| *sum -= l);
                    let is_empty = step + 1 == path.removed.len();
                    answers_m.push(if is_empty { median_m } else { centers_m[most_likely_cell(&sum)] });
                }
                answers_m
            })
            .collect();
        (0..path.rmse_m.len()).map(|step| of_frames.iter().map(|answers_m| answers_m[step]).collect()).collect()
    }

    fn likelihoods(&self, group: &LearnedGroup, field: &FieldOnCells, rows: &[usize]) -> Likelihoods {
        let features = self.features(group, rows);
        log_likelihoods(field, &features, group.recipe.noise)
    }

    /// Log-likelihoods of no place.
    fn nowhere(&self, group: &LearnedGroup, rows: &[usize]) -> Option<Vec<f32>> {
        let features = self.features(group, rows);
        features.iter().map(|features| log_likelihood_nowhere(features, group.recipe.noise)).collect()
    }

    /// Features of the frames at `rows`, one vector a frame.
    fn features(&self, group: &LearnedGroup, rows: &[usize]) -> Vec<Vec<f32>> {
        features_of(group, self.survey, rows)
    }
}

fn features_of(group: &LearnedGroup, survey: &Survey, rows: &[usize]) -> Vec<Vec<f32>> {
    let features = group.scaling.apply(survey.properties(group.recipe.descriptor, rows).as_ref());
    (0..rows.len()).map(|i| (0..group.features()).map(|r| features[(i, r)] as f32).collect()).collect()
}

fn log_likelihoods(field: &FieldOnCells, features: &[Vec<f32>], noise: NoiseModel) -> Likelihoods {
    let rows: Vec<Vec<f32>> = features
        .par_iter()
        .map_init(Vec::new, |scratch, features| {
            let mut row = vec![0.0; field.cells()];
            field.add_log_likelihood(features, noise, scratch, &mut row);
            row
        })
        .collect();
    Likelihoods { cells: field.cells(), values: rows.concat() }
}

impl Likelihoods {
    fn add(&mut self, other: &Self) {
        for (sum, value) in self.values.iter_mut().zip(&other.values) {
            *sum += value;
        }
    }
}

/// The paper's disturbance of all positions for its “(noisy)” rows: one foot on either axis.
pub const NOISY_POSITION_STD_M: f64 = 0.3048;

/// `positions_m` with seeded Gaussian noise of [`NOISY_POSITION_STD_M`].
pub fn noisy(positions_m: &[PositionM], seed: u64) -> Vec<PositionM> {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    random.set_stream(1);
    let mut normal = || NOISY_POSITION_STD_M * f64::from(standard_normal(&mut random));
    positions_m.iter().map(|p| [p[0] + normal(), p[1] + normal()]).collect()
}
