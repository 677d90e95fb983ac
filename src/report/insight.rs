//! What a trial or a map knows beyond its answers: surfaces of its features, and how sure it is of each frame.

use rayon::prelude::*;

use crate::evaluate::{Case, FrameEntry, covariance_about, nees};
use crate::features::Descriptor;
use crate::gp::{GpError, Hyperparameters, LearningPositions};
use crate::localize::{FieldOnCells, MapFields};
use crate::map::{CandidateCells, CellsError, FeatureMap, GroupHyperparameters};
use crate::train::{LearnedGroup, Outcomes, Survey, Trial, credible_level, locate};
use crate::types::{PositionCovariance, PositionM, distance_m};

/// Features of a group that are shown.
const SHOWN_FEATURES: usize = 3;

/// How sure single frames are, by all features fused.
#[derive(Debug, Clone)]
pub struct Insight {
    pub recipe: &'static str,
    /// Split and seed; `None` against a map.
    pub split: Option<(String, Option<u64>)>,
    pub cells: CandidateCells,
    pub learning_m: Vec<PositionM>,
    /// Rows of the survey that were learned from; empty against a map.
    pub learning_rows: Vec<usize>,
    pub temperature: f64,
    pub surfaces: Vec<GroupSurfaces>,
    pub frames: Vec<FrameAnswer>,
    /// Of the frames that are shown: row of the survey, and log-likelihood of every cell.
    pub likelihoods: Vec<(usize, Vec<f32>)>,
}

/// Posterior of some features of a group on the cells.
#[derive(Debug, Clone)]
pub struct GroupSurfaces {
    pub descriptor: Descriptor,
    /// Features of the group in all.
    pub features: usize,
    pub shown: Vec<Surface>,
}

#[derive(Debug, Clone)]
pub struct Surface {
    /// Number among the features that were kept, counted from 1.
    pub feature: usize,
    pub mean: Vec<f32>,
    /// Of the feature as it would be observed: noise included.
    pub variance: Vec<f32>,
    pub hyperparameters: Hyperparameters,
}

/// One frame on its own.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FrameAnswer {
    /// Row of the survey, and the frame's own number.
    pub row: usize,
    pub index: usize,
    pub truth_m: PositionM,
    pub estimate_m: PositionM,
    /// Second moments of the probabilities of the cells about the estimate.
    pub covariance: PositionCovariance,
    /// Probability of the cells that are likelier than the true one.
    pub credible_level: f64,
    pub nees: f64,
}

impl FrameAnswer {
    pub fn error_m(&self) -> f64 {
        distance_m(self.truth_m, self.estimate_m)
    }

    /// Of a frame that came with a pose, the frame at `row`.
    pub fn of_pose(frame: &FrameEntry, row: usize) -> Option<Self> {
        let (truth_m, estimate_m) = ([frame.truth_e_m, frame.truth_n_m], [frame.est_e_m?, frame.est_n_m?]);
        let covariance =
            PositionCovariance { ee_m2: frame.cov_ee_m2?, en_m2: frame.cov_en_m2?, nn_m2: frame.cov_nn_m2? };
        let nees = nees(&covariance, estimate_m, truth_m);
        // Of a normal distribution with two dimensions.
        let credible_level = 1.0 - (-0.5 * nees).exp();
        Some(Self { row, index: frame.index, truth_m, estimate_m, covariance, credible_level, nees })
    }
}

#[derive(Debug, thiserror::Error)]
pub enum InsightError {
    #[error(transparent)]
    Gp(#[from] GpError),
    #[error(transparent)]
    Cells(#[from] CellsError),
}

impl Insight {
    /// Into a trial of the protocol. `None` where no feature was kept.
    pub fn of_trial(
        survey: &Survey,
        case: &Case,
        trial: &Trial,
        truth_m: &[PositionM],
        outcomes: &Outcomes,
    ) -> Result<Option<Self>, InsightError> {
        let mut learning_rows = trial.split.learning.clone();
        if trial.recipe.refit {
            learning_rows.extend(&trial.split.validation);
            learning_rows.sort_unstable();
        }
        let learning_m: Vec<PositionM> = learning_rows.iter().map(|&row| trial.recorded_m[row]).collect();
        let learning = LearningPositions::of_recordings(learning_m.clone(), &survey.recordings_of(&learning_rows));
        let cells = CandidateCells::around(&learning_m, trial.grid_step_m, None)?;
        let centers_m = cells.centers_m();
        let mut surfaces = Vec::new();
        let mut rows: Vec<Vec<f32>> = vec![vec![0.0; cells.len()]; trial.split.test.len()];
        for group in outcomes.groups.iter().filter(|group| group.features() > 0) {
            let (mean, variance) = group.predict(&learning, &centers_m)?;
            surfaces.push(surfaces_of(group, cells.len(), &mean, &variance));
            let field = FieldOnCells::new(group.features(), cells.len(), mean, &variance);
            let properties = survey.properties(group.recipe.descriptor, &trial.split.test);
            let features = group.scaling.apply(properties.as_ref());
            let noise = group.recipe.noise;
            rows.par_iter_mut().enumerate().for_each_init(Vec::new, |scratch, (i, row)| {
                let of_frame: Vec<f32> = features.row(i).iter().map(|&z| z as f32).collect();
                field.add_log_likelihood(&of_frame, noise, scratch, row);
            });
        }
        if surfaces.is_empty() {
            return Ok(None);
        }
        let temperature = outcomes.temperature.unwrap_or(1.0);
        let refine = trial.recipe.refine;
        let frames: Vec<FrameAnswer> = (trial.split.test.par_iter().zip(&rows))
            .map(|(&row, log_likelihood)| {
                let index = survey.frames[row].index;
                answer(&cells, log_likelihood, temperature, refine, row, index, truth_m[row])
            })
            .collect();
        let likelihoods = shown_frames(&frames).into_iter().map(|i| (frames[i].row, rows[i].clone())).collect();
        Ok(Some(Self {
            recipe: trial.recipe.name.name(),
            split: Some((case.split_name.clone(), case.seed)),
            cells,
            learning_m,
            learning_rows,
            temperature,
            surfaces,
            frames,
            likelihoods,
        }))
    }

    /// Into another drive against a map.
    pub fn of_map(survey: &Survey, map: &FeatureMap, truth_m: &[PositionM]) -> Self {
        let fields = MapFields::of(map);
        let everything: Vec<usize> = (0..survey.len()).collect();
        let features: Vec<_> = (map.info.groups.iter().zip(&map.groups))
            .map(|(info, group)| group.scaling.apply(survey.properties(info.recipe.descriptor, &everything).as_ref()))
            .collect();
        let log_likelihood_of = |row: usize| {
            let of_frame = features.iter().flat_map(|features| features.row(row).iter().map(|&z| z as f32));
            let mut log_likelihood = vec![0.0; map.cells.len()];
            fields.add_log_likelihood(&of_frame.collect::<Vec<_>>(), &mut Vec::new(), &mut log_likelihood);
            log_likelihood
        };
        let temperature = map.info.temperature;
        let frames: Vec<FrameAnswer> = everything
            .par_iter()
            .map(|&row| {
                let index = survey.frames[row].index;
                let log_likelihood = log_likelihood_of(row);
                answer(&map.cells, &log_likelihood, temperature, map.info.refine, row, index, truth_m[row])
            })
            .collect();
        let likelihoods = shown_frames(&frames).into_iter().map(|row| (row, log_likelihood_of(row))).collect();
        let c = map.cells.len();
        let surfaces = (map.info.groups.iter().zip(&map.groups))
            .map(|(info, group)| GroupSurfaces {
                descriptor: info.recipe.descriptor,
                features: info.features,
                shown: shown_surfaces(
                    info.features,
                    c,
                    &group.field_mean,
                    &group.field_variance,
                    &info.hyperparameters,
                ),
            })
            .collect();
        Self {
            recipe: map.info.recipe.name(),
            split: None,
            cells: map.cells.clone(),
            learning_m: map.positions_m.clone(),
            learning_rows: Vec::new(),
            temperature,
            surfaces,
            frames,
            likelihoods,
        }
    }
}

fn surfaces_of(group: &LearnedGroup, cells: usize, mean: &[f32], variance: &[f32]) -> GroupSurfaces {
    GroupSurfaces {
        descriptor: group.recipe.descriptor,
        features: group.features(),
        shown: shown_surfaces(group.features(), cells, mean, variance, &group.hyperparameters),
    }
}

/// The features that tell most about the place: whose mean varies most over the cells, by their mean variance.
fn shown_surfaces(
    features: usize,
    cells: usize,
    mean: &[f32],
    variance: &[f32],
    hyperparameters: &GroupHyperparameters,
) -> Vec<Surface> {
    let fitted = |r: usize| match hyperparameters {
        GroupHyperparameters::Each(fits) => fits[r].hyperparameters,
        GroupHyperparameters::Shared(shared) => *shared,
    };
    let row = |values: &[f32], r: usize| values[r * cells..(r + 1) * cells].to_vec();
    let tells = |r: usize| {
        let values = &mean[r * cells..(r + 1) * cells];
        let center = values.iter().map(|&v| f64::from(v)).sum::<f64>() / cells as f64;
        let spread = values.iter().map(|&v| (f64::from(v) - center).powi(2)).sum::<f64>() / cells as f64;
        let of_feature = if variance.len() == cells { variance } else { &variance[r * cells..(r + 1) * cells] };
        spread / of_feature.iter().map(|&v| f64::from(v)).sum::<f64>()
    };
    let mut order: Vec<(f64, usize)> = (0..features).map(|r| (tells(r), r)).collect();
    order.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
    let chosen = order.iter().take(SHOWN_FEATURES).map(|&(_, r)| Surface {
        feature: r + 1,
        mean: row(mean, r),
        variance: row(variance, if variance.len() == cells { 0 } else { r }),
        hyperparameters: fitted(r),
    });
    chosen.collect()
}

fn answer(
    cells: &CandidateCells,
    log_likelihood: &[f32],
    temperature: f64,
    refine: bool,
    row: usize,
    index: usize,
    truth_m: PositionM,
) -> FrameAnswer {
    let estimate_m = locate(cells, log_likelihood, refine);
    let covariance = covariance_about(cells, log_likelihood, temperature, estimate_m);
    FrameAnswer {
        row,
        index,
        truth_m,
        estimate_m,
        covariance,
        credible_level: credible_level(cells, log_likelihood, truth_m, temperature),
        nees: nees(&covariance, estimate_m, truth_m),
    }
}

/// The frames whose likelihood is shown: an ordinary one, one that is hard, and the worst.
fn shown_frames(frames: &[FrameAnswer]) -> Vec<usize> {
    let mut order: Vec<usize> = (0..frames.len()).collect();
    order.sort_by(|&a, &b| frames[a].error_m().total_cmp(&frames[b].error_m()).then(a.cmp(&b)));
    let Some(last) = order.len().checked_sub(1) else { return Vec::new() };
    let mut shown = vec![order[last / 2], order[(0.95 * last as f64).round() as usize], order[last]];
    shown.dedup();
    shown
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_covariance_is_that_of_the_probabilities() {
        let cells = CandidateCells::around(&[[0.0, 0.0], [20.0, 20.0]], 0.5, None).expect("a small grid");
        let (variance_e, variance_n, temperature) = (2.0, 0.8, 5.0);
        let log = |c: &PositionM| {
            -0.5 * temperature * ((c[0] - 10.0).powi(2) / variance_e + (c[1] - 9.0).powi(2) / variance_n)
        };
        let log_likelihood: Vec<f32> = cells.centers_m().iter().map(|c| log(c) as f32).collect();
        let found = answer(&cells, &log_likelihood, temperature, true, 0, 0, [11.0, 9.0]);
        assert_eq!(found.estimate_m, [10.0, 9.0]);
        let of_cell = 0.25 / 12.0;
        assert!((found.covariance.ee_m2 - variance_e - of_cell).abs() < 0.01, "{found:?}");
        assert!((found.covariance.nn_m2 - variance_n - of_cell).abs() < 0.01, "{found:?}");
        assert!(found.covariance.en_m2.abs() < 1e-6 && (found.nees - 1.0 / (2.0 + of_cell)).abs() < 0.01, "{found:?}");
        // Inside the ellipse of e²/σ² = ½: 1 − exp(−¼).
        assert!((found.credible_level - 0.22).abs() < 0.06, "{found:?}");
    }

    #[test]
    fn an_ordinary_a_hard_and_the_worst_frame_are_shown() {
        let frame = |error_m: f64| FrameAnswer {
            row: 0,
            index: 0,
            truth_m: [0.0, 0.0],
            estimate_m: [error_m, 0.0],
            covariance: PositionCovariance::default(),
            credible_level: 0.0,
            nees: 0.0,
        };
        let frames: Vec<_> = (0..101).map(|i| frame(f64::from((i * 37) % 101))).collect();
        let errors: Vec<f64> = shown_frames(&frames).into_iter().map(|i| frames[i].error_m()).collect();
        assert_eq!(errors, [50.0, 95.0, 100.0]);
        assert_eq!(shown_frames(&frames[..1]).len(), 1);
        assert!(shown_frames(&[]).is_empty());
    }
}
