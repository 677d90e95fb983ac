//! Frames of another drive against a map.

use rayon::prelude::*;

use crate::localize::FieldOnCells;
use crate::map::FeatureMap;
use crate::train::{Survey, locate};
use crate::types::PositionM;

/// Single-frame estimates from one group of the map, or from all of them fused.
#[derive(Debug, Clone)]
pub struct MapOutcome {
    pub features: String,
    pub m: usize,
    pub rank: usize,
    pub kept: usize,
    pub estimates_m: Vec<PositionM>,
}

/// Estimates for every frame of `survey`: one outcome a group, and one of all groups fused if there are several.
pub fn against_map(survey: &Survey, map: &FeatureMap) -> Vec<MapOutcome> {
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
    let estimates_m: Vec<Vec<PositionM>> = rows
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
            of_frame
        })
        .collect();

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
        });
    }
    outcomes
}
