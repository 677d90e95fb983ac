//! Frames of another drive against a map.

use faer::Mat;
use rayon::prelude::*;

use super::sequence::{Sequence, sequences};
use crate::features::COMPASS_BYTES;
use crate::localize::{MapFields, Observation};
use crate::map::FeatureMap;
use crate::train::{Survey, covers, locate};
use crate::types::PositionM;

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
}

/// What became of a drive on a map.
#[derive(Debug, Clone)]
pub struct AgainstMap {
    /// Frames on their own: one outcome a group, and one of all groups fused if there are several.
    pub single: Vec<MapOutcome>,
    /// The frames one after the other; empty where they have no time.
    pub sequences: Vec<Sequence>,
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
            estimates_m.push(locate(&map.cells, &log_likelihood, map.info.refine));
            let is_covered = covers(&map.cells, &log_likelihood, truth_m[row], map.info.temperature, 0.95);
            let nowhere = MapFields::log_likelihood_nowhere(groups, &features);
            Answer { estimates_m, is_covered, features, log_likelihood, nowhere }
        })
        .collect();
    let covered = answers.iter().filter(|answer| answer.is_covered).count() as f64 / survey.len().max(1) as f64;

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
        });
    }
    AgainstMap { single: outcomes, sequences: in_order(survey, map, &answers) }
}

/// One frame on its own.
struct Answer {
    /// One a group, and the fused one last.
    estimates_m: Vec<PositionM>,
    is_covered: bool,
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
