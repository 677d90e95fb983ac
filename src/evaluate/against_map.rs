//! Frames of another drive against a map.

use faer::Mat;
use rayon::prelude::*;

use super::entry::Entry;
use super::protocol::{chosen_on, compression};
use super::sequence::{Sequence, SequenceFigures, nees, sequences};
use crate::features::COMPASS_BYTES;
use crate::localize::{MapFields, Observation};
use crate::map::{CandidateCells, FeatureMap};
use crate::metrics::{ErrorFigures, component_median};
use crate::train::{Survey, covers, locate};
use crate::types::{PositionCovariance, PositionM};

/// Single-frame estimates from one group of the map, or from all of them fused.
#[derive(Debug, Clone)]
pub struct MapOutcome {
    pub features: String,
    pub m: usize,
    pub rank: usize,
    pub kept: usize,
    pub estimates_m: Vec<PositionM>,
    /// Share of frames whose true position lies in the region that holds 95 % of the probability, at the map's
    /// temperature; `None` for a group that is only a part of the answer.
    pub coverage_95: Option<f64>,
    /// Mean NEES by the covariance of the same probabilities; `None` alike.
    pub nees_mean: Option<f64>,
}

/// What became of a drive on a map.
#[derive(Debug, Clone)]
pub struct AgainstMap {
    /// Frames on their own: one outcome a group, and one of all groups fused if there are several.
    pub single: Vec<MapOutcome>,
    /// The frames one after the other; empty where they have no time.
    pub sequences: Vec<Sequence>,
}

/// What all rows of the drive `dataset` on a map have in common.
pub(super) fn base_entry(dataset: &str, survey: &Survey, map: &FeatureMap) -> Entry {
    Entry {
        dataset: dataset.into(),
        estimator: "single",
        n_learning: map.positions_m.len(),
        n_learned_from: map.positions_m.len(),
        n_test: survey.len(),
        ..Entry::default()
    }
}

/// The rows of a drive, named `dataset`, on a map: the groups by themselves, fused, and one frame after the other.
pub fn map_entries(dataset: &str, survey: &Survey, map: &FeatureMap, truth_m: &[PositionM]) -> Vec<Entry> {
    let indices: Vec<usize> = survey.frames.iter().map(|frame| frame.index).collect();
    let base = Entry {
        recipe: Some(map.info.recipe.name()),
        chosen_on: chosen_on(map.info.selection),
        ..base_entry(dataset, survey, map)
    };
    let know_nothing_m = component_median(&map.positions_m);
    let outcomes = against_map(survey, map, truth_m);
    let of_single = |outcome: MapOutcome| {
        let entry = Entry {
            features: outcome.features,
            m: Some(outcome.m),
            rank: Some(outcome.rank),
            kept: Some(outcome.kept),
            compression: compression(outcome.m, outcome.kept),
            coverage_95: outcome.coverage_95,
            nees_mean: outcome.nees_mean,
            ..base.clone()
        };
        let figures = ErrorFigures::of(&outcome.estimates_m, truth_m, know_nothing_m);
        entry.with_figures(figures).with_frames(&indices, truth_m, &outcome.estimates_m)
    };
    let mut entries: Vec<Entry> = outcomes.single.into_iter().map(of_single).collect();
    let stamps_ns: Vec<u64> = survey.frames.iter().map(|frame| frame.stamp_ns).collect();
    let yaws_rad: Vec<Option<f64>> = survey.frames.iter().map(|frame| frame.yaw_rad).collect();
    for sequence in &outcomes.sequences {
        let said = sequence.poses.iter().zip(truth_m).filter_map(|(pose, truth_m)| Some((pose.as_ref()?, *truth_m)));
        let (estimates_m, said_truth_m): (Vec<_>, Vec<_>) = said.map(|(pose, truth)| (pose.position_m, truth)).unzip();
        let entry = Entry { features: sequence.estimator.into(), estimator: sequence.estimator, ..base.clone() };
        let entry = entry.with_figures(ErrorFigures::of(&estimates_m, &said_truth_m, know_nothing_m));
        let figures = SequenceFigures::of(sequence, &stamps_ns, truth_m, &yaws_rad);
        let entry = figures.map_or(entry.clone(), |figures| entry.with_sequence(&figures));
        entries.push(entry.with_poses(&indices, truth_m, sequence));
    }
    entries
}

/// Estimates for every frame of `survey`, which in truth are at `truth_m`.
pub fn against_map(survey: &Survey, map: &FeatureMap, truth_m: &[PositionM]) -> AgainstMap {
    let fields = MapFields::of(map);
    let rows: Vec<usize> = (0..survey.len()).collect();
    let features: Vec<_> = map
        .info
        .groups
        .iter()
        .zip(&map.groups)
        .map(|(info, group)| group.scaling.apply(survey.properties(info.recipe.descriptor, &rows).as_ref()))
        .collect();

    let groups = &map.info.groups;

    // Per frame: an estimate a group, and the fused one last.
    let answers: Vec<Answer> = rows
        .par_iter()
        .map_init(Vec::new, |scratch, &row| {
            let of_row = |features: &Mat<f64>| features.row(row).iter().map(|&z| z as f32).collect::<Vec<_>>();
            let features: Vec<f32> = features.iter().flat_map(of_row).collect();
            let mut log_likelihood = vec![0.0; map.cells.len()];
            let mut estimates_m = Vec::with_capacity(groups.len() + 1);
            for group in 0..groups.len() {
                fields.log_likelihood_of_group(group, &features, scratch, &mut log_likelihood);
                estimates_m.push(locate(&map.cells, &log_likelihood, map.info.refine));
            }
            log_likelihood.fill(0.0);
            fields.add_log_likelihood(&features, scratch, &mut log_likelihood);
            let estimate_m = locate(&map.cells, &log_likelihood, map.info.refine);
            estimates_m.push(estimate_m);
            let temperature = map.info.temperature;
            let is_covered = covers(&map.cells, &log_likelihood, truth_m[row], temperature, 0.95);
            let covariance = covariance_about(&map.cells, &log_likelihood, temperature, estimate_m);
            let nees = nees(&covariance, estimate_m, truth_m[row]);
            let nowhere = MapFields::log_likelihood_nowhere(groups, &features);
            Answer { estimates_m, is_covered, nees, features, log_likelihood, nowhere }
        })
        .collect();
    let covered = answers.iter().filter(|answer| answer.is_covered).count() as f64 / survey.len().max(1) as f64;
    let nees_mean = answers.iter().map(|answer| answer.nees).sum::<f64>() / survey.len().max(1) as f64;

    let column = |i: usize| answers.iter().map(|answer| answer.estimates_m[i]).collect();
    let mut outcomes: Vec<MapOutcome> = map
        .info
        .groups
        .iter()
        .enumerate()
        .map(|(i, group)| MapOutcome {
            features: group.recipe.descriptor.name().into(),
            m: group.recipe.descriptor.dimensions(),
            rank: group.rank,
            kept: group.features,
            estimates_m: column(i),
            coverage_95: (groups.len() == 1).then_some(covered),
            nees_mean: (groups.len() == 1).then_some(nees_mean),
        })
        .collect();
    if outcomes.len() > 1 {
        let total = |of: fn(&MapOutcome) -> usize| outcomes.iter().map(of).sum();
        outcomes.push(MapOutcome {
            features: "fused".into(),
            m: total(|outcome| outcome.m),
            rank: total(|outcome| outcome.rank),
            kept: total(|outcome| outcome.kept),
            estimates_m: column(outcomes.len()),
            coverage_95: Some(covered),
            nees_mean: Some(nees_mean),
        });
    }
    AgainstMap { single: outcomes, sequences: in_order(survey, map, &answers) }
}

/// One frame on its own.
struct Answer {
    /// One a group, and the fused one last.
    estimates_m: Vec<PositionM>,
    is_covered: bool,
    nees: f64,
    features: Vec<f32>,
    log_likelihood: Vec<f32>,
    nowhere: Option<f32>,
}

/// The frames one after the other, if it is known when they were taken.
fn in_order(survey: &Survey, map: &FeatureMap, answers: &[Answer]) -> Vec<Sequence> {
    let are_timed = survey.frames.iter().all(|frame| frame.time_s.is_some());
    let in_order = survey.frames.windows(2).all(|pair| pair[0].stamp_ns <= pair[1].stamp_ns);
    if !are_timed || !in_order {
        return Vec::new();
    }
    let compasses = survey.compass().chunks_exact(COMPASS_BYTES).map(Some).chain(std::iter::repeat(None));
    let frames: Vec<Observation> = survey
        .frames
        .iter()
        .zip(answers)
        .zip(compasses)
        .map(|((frame, answer), compass)| Observation {
            sequence: frame.index as u32,
            stamp_ns: frame.stamp_ns,
            log_likelihood: &answer.log_likelihood,
            nowhere: answer.nowhere,
            features: &answer.features,
            compass: compass.unwrap_or(&[]),
        })
        .collect();
    sequences(map, &frames).into()
}

/// Σ p (c − s)(c − s)ᵀ over the cells c, with p ∝ exp(log-likelihood / temperature), and what a cell's own size adds.
pub fn covariance_about(
    cells: &CandidateCells,
    log_likelihood: &[f32],
    temperature: f64,
    about_m: PositionM,
) -> PositionCovariance {
    let greatest = log_likelihood.iter().copied().fold(f32::NEG_INFINITY, f32::max);
    let (mut total, mut ee, mut en, mut nn) = (0.0, 0.0, 0.0, 0.0);
    for (i, &value) in log_likelihood.iter().enumerate() {
        let p = (f64::from(value - greatest) / temperature).exp();
        if p > 0.0 {
            let center_m = cells.center_m(i);
            let [e, n] = [center_m[0] - about_m[0], center_m[1] - about_m[1]];
            total += p;
            ee += p * e * e;
            en += p * e * n;
            nn += p * n * n;
        }
    }
    // Variance of a uniform distribution over a cell.
    let of_cell_m2 = cells.grid.step_m.powi(2) / 12.0;
    PositionCovariance { ee_m2: ee / total + of_cell_m2, en_m2: en / total, nn_m2: nn / total + of_cell_m2 }
}
