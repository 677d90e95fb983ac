//! Which features to keep, without fooling oneself: folds and a smooth score.
//!
//! Backward elimination asks the validation images some m²/2 times which feature hurts, by the error of a best cell,
//! which jumps: it finds features that hurt these images. Here features are put in order once, by how well each can be
//! predicted at all, and only their number is chosen, by a score without jumps, on images that the Gaussian processes
//! have not seen, and in favour of fewer features where the score does not tell.

use faer::Mat;
use rand::SeedableRng;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;

use super::group::LearnedGroup;
use crate::gp::{GpError, LearningPositions};
use crate::localize::FieldOnCells;
use crate::map::CandidateCells;
use crate::types::{PositionM, distance_m};

const FOLDS: usize = 5;
/// Fewer features than this are not considered.
const FEWEST: usize = 4;
/// Each number considered is the one before divided by this.
const SHRINK: f64 = std::f64::consts::SQRT_2;
/// Temperatures tried: 1, 1.5, …, 1.5^15 ≈ 440. Correlated features say the same thing several times.
const TEMPERATURE_STEP: f64 = 1.5;
const TEMPERATURES: i32 = 16;

/// The features to keep, in rising order.
///
/// For every fold the Gaussian processes are conditioned on the other folds, scaling and hyperparameters as they are. A
/// held-out image at s scores
///
/// ```text
/// log Σ_c p_c exp(−½ |s − c|² / h²)        p ∝ exp(S / T), S the summed log-likelihood, T the best of a grid
/// ```
///
/// that is, the log of the posterior mass near where it was taken. Of all numbers of features whose mean score is within
/// one standard error of the best, the smallest is taken.
pub fn folded_selection(
    group: &LearnedGroup,
    learning: &LearningPositions,
    cells: &CandidateCells,
    seed: u64,
) -> Result<Vec<usize>, GpError> {
    let order = by_predictability(group, learning)?;
    let sizes = sizes(order.len());
    let centers_m = cells.centers_m();
    let near_m = cells.grid.step_m.max(learning.spacing_m());
    let mut shuffled: Vec<usize> = (0..learning.len()).collect();
    shuffled.shuffle(&mut ChaCha8Rng::seed_from_u64(seed));

    // Size × temperature × held-out image.
    let mut scores = vec![vec![Vec::new(); TEMPERATURES as usize]; sizes.len()];
    for fold in 0..FOLDS.min(learning.len()) {
        let held: Vec<usize> = shuffled.iter().copied().skip(fold).step_by(FOLDS).collect();
        let rest: Vec<usize> = (0..learning.len()).filter(|row| !held.contains(row)).collect();
        let positions = learning.of_rows(&rest);
        let field = group.of_rows(&rest).on_cells(&positions, &centers_m)?;
        for (size, scores) in sizes.iter().zip(&mut scores) {
            let kept = &order[..*size];
            let field = field.select(kept);
            let of_images: Vec<Vec<f64>> = held
                .par_iter()
                .map(|&row| {
                    let features: Vec<f32> = kept.iter().map(|&r| group.learning[(row, r)] as f32).collect();
                    score(group, &field, &features, learning.positions()[row], &centers_m, near_m)
                })
                .collect();
            for of_image in of_images {
                scores.iter_mut().zip(of_image).for_each(|(scores, score)| scores.push(score));
            }
        }
    }
    let at_best_temperature: Vec<Vec<f64>> = scores
        .into_iter()
        .map(|by_temperature| {
            by_temperature.into_iter().max_by(|a, b| mean(a).total_cmp(&mean(b))).expect("temperatures are tried")
        })
        .collect();
    let mut kept = order[..sizes[smallest_not_worse(&at_best_temperature)]].to_vec();
    kept.sort_unstable();
    Ok(kept)
}

/// Features by log (variance / mean squared leave-one-out error), largest first.
fn by_predictability(group: &LearnedGroup, learning: &LearningPositions) -> Result<Vec<usize>, GpError> {
    let residual: Mat<f64> = group.leave_one_out(learning)?;
    let square = |matrix: &Mat<f64>, r: usize| matrix.col(r).iter().map(|v| v * v).sum::<f64>();
    let gain: Vec<f64> = (0..group.features())
        .map(|r| {
            square(&group.learning, r).max(f64::MIN_POSITIVE).ln() - square(&residual, r).max(f64::MIN_POSITIVE).ln()
        })
        .collect();
    let mut order: Vec<usize> = (0..gain.len()).collect();
    order.sort_by(|&a, &b| gain[b].total_cmp(&gain[a]));
    Ok(order)
}

/// Numbers of features to consider, largest first.
fn sizes(all: usize) -> Vec<usize> {
    let mut sizes = vec![all];
    let mut size = all as f64 / SHRINK;
    while size.round() as usize >= FEWEST {
        sizes.push(size.round() as usize);
        size /= SHRINK;
    }
    sizes.dedup();
    sizes
}

/// The score of one image at every temperature.
fn score(
    group: &LearnedGroup,
    field: &FieldOnCells,
    features: &[f32],
    truth_m: PositionM,
    centers_m: &[PositionM],
    near_m: f64,
) -> Vec<f64> {
    let mut log_likelihood = vec![0.0; centers_m.len()];
    field.add_log_likelihood(features, group.recipe.noise, 1.0, &mut Vec::new(), &mut log_likelihood);
    let greatest = log_likelihood.iter().copied().fold(f32::NEG_INFINITY, f32::max);
    let nearness: Vec<f64> =
        centers_m.iter().map(|&c| (-0.5 * (distance_m(c, truth_m) / near_m).powi(2)).exp()).collect();
    (0..TEMPERATURES)
        .map(|i| {
            let coldness = TEMPERATURE_STEP.powi(-i);
            let (mut near, mut all) = (0.0, 0.0);
            for (value, nearness) in log_likelihood.iter().zip(&nearness) {
                let mass = (f64::from(value - greatest) * coldness).exp();
                all += mass;
                near += mass * nearness;
            }
            (near / all).max(1e-12).ln()
        })
        .collect()
}

/// The last of `scores` (by image) whose mean is within one standard error of the best; they come with ever fewer
/// features. The standard error is that of the difference image by image.
fn smallest_not_worse(scores: &[Vec<f64>]) -> usize {
    let best =
        (0..scores.len()).max_by(|&a, &b| mean(&scores[a]).total_cmp(&mean(&scores[b]))).expect("sizes are tried");
    let not_worse = |candidate: &Vec<f64>| {
        let difference: Vec<f64> = scores[best].iter().zip(candidate).map(|(best, score)| best - score).collect();
        let loss = mean(&difference);
        let variance = difference.iter().map(|d| (d - loss).powi(2)).sum::<f64>() / difference.len() as f64;
        loss <= (variance / difference.len() as f64).sqrt()
    };
    scores.iter().rposition(not_worse).unwrap_or(best)
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len().max(1) as f64
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::features::Descriptor;
    use crate::map::{Recipe, RecipeName};

    /// 160 positions on a loop; property 0..8 follow the place, the other 64 are noise.
    #[test]
    fn features_that_are_noise_are_left_out() {
        let n = 160;
        let turn = |i: usize| std::f64::consts::TAU * i as f64 / n as f64;
        let positions: Vec<PositionM> = (0..n).map(|i| [20.0 * turn(i).cos(), 20.0 * turn(i).sin()]).collect();
        let learning = LearningPositions::new(positions);
        let noise = |i: usize, k: usize| ((i * 7919 + k * 104_729) as f64 * 12.9898).sin() * 43_758.545_3 % 1.0;
        let d = Descriptor::Sp.dimensions();
        let properties = Mat::from_fn(n, d, |i, k| match k {
            0..8 => ((1 + k / 2) as f64 * turn(i) + k as f64).sin() + 0.05 * noise(i, k),
            _ => noise(i, k),
        });
        let recipe = Recipe::new(RecipeName::Paper, &[Descriptor::Sp]).groups[0];
        let group = LearnedGroup::learn(recipe, &learning, properties.as_ref(), Mat::zeros(0, d).as_ref(), || {})
            .expect("it varies");
        let cells = CandidateCells::around(learning.positions(), 1.0, Some(3.0)).expect("a small grid");
        let kept = folded_selection(&group, &learning, &cells, 0).expect("positive definite");
        assert!(kept.len() < 40, "{kept:?}");
        // Whitening orders by variance, of which the eight that follow the place have most.
        assert!((0..8).filter(|r| kept.contains(r)).count() >= 4, "{kept:?}");
    }

    #[test]
    fn fewer_features_win_unless_they_score_worse() {
        let scores = |shift: f64| (0..20).map(|i| shift + 0.1 * f64::from(i % 3)).collect::<Vec<f64>>();
        assert_eq!(smallest_not_worse(&[scores(0.0), scores(0.0), scores(-1.0)]), 1);
        assert_eq!(smallest_not_worse(&[scores(-2.0), scores(0.0), scores(-1.0)]), 1);
        assert_eq!(sizes(16), [16, 11, 8, 6, 4]);
        assert_eq!(sizes(2), [2]);
    }
}
