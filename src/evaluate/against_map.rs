//! Frames of another drive against a map.

use rayon::prelude::*;

use crate::localize::FieldOnCells;
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

/// Estimates for every frame of `survey`, which in truth are at `truth_m`: one outcome a group, and one of all groups
/// fused if there are several.
pub fn against_map(survey: &Survey, map: &FeatureMap, truth_m: &[PositionM]) -> Vec<MapOutcome> {
    let fields: Vec<FieldOnCells> = map.groups.iter().map(FieldOnCells::of).collect();
    let rows: Vec<usize> = (0..survey.len()).collect();
    let features: Vec<_> = map
        .info
        .groups
        .iter()
        .zip(&map.groups)
        .map(|(info, group)| group.scaling.apply(survey.properties(info.recipe.descriptor, &rows).as_ref()))
        .collect();

    // Per frame: an estimate a group, and the fused one last.
    let (estimates_m, covered): (Vec<Vec<PositionM>>, Vec<bool>) = rows
        .par_iter()
        .map_init(Vec::new, |scratch, &row| {
            let mut fused = vec![0.0; map.cells.len()];
            let mut of_frame: Vec<PositionM> = fields
                .iter()
                .zip(&map.info.groups)
                .zip(&features)
                .map(|((field, info), features)| {
                    let z: Vec<f32> = (0..field.features()).map(|r| features[(row, r)] as f32).collect();
                    let mut alone = vec![0.0; map.cells.len()];
                    field.add_log_likelihood(&z, info.recipe.noise, info.recipe.weight as f32, scratch, &mut alone);
                    fused.iter_mut().zip(&alone).for_each(|(sum, value)| *sum += value);
                    locate(&map.cells, &alone, map.info.refine)
                })
                .collect();
            of_frame.push(locate(&map.cells, &fused, map.info.refine));
            (of_frame, covers(&map.cells, &fused, truth_m[row], map.info.temperature, 0.95))
        })
        .unzip();
    let covered = covered.iter().filter(|&&covered| covered).count() as f64 / survey.len().max(1) as f64;

    let column = |i: usize| estimates_m.iter().map(|of_frame| of_frame[i]).collect();
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
            coverage_95: (fields.len() == 1).then_some(covered),
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
    outcomes
}
