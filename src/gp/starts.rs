//! Where the search for hyperparameters begins.

use std::cmp::Ordering;

use faer::{Mat, MatRef};
use rayon::prelude::*;

use super::fit::{Bounds, extent_m};
use super::{Hyperparameters, LearningPositions};

/// Length scales of the grid of starts, as multiples of the extent.
const START_LENGTH_RATIOS: [f64; 7] = [0.006, 0.02, 0.05, 0.12, 0.3, 0.75, 2.0];
/// Noise variance over signal variance of the grid of starts.
const START_NOISE_RATIOS: [f64; 8] = [1e-4, 1e-3, 1e-2, 0.05, 0.2, 0.6, 2.0, 10.0];
/// More positions than this are thinned for the starts: they are only where the search begins.
const MAX_START_POSITIONS: usize = 300;
/// Points of the grid that are less likely than the best by more than this are no starts: polishing brings about as much
/// to either.
const START_GAP: f64 = 1.0;
const MAX_STARTS: usize = 3;

/// For every feature up to [`MAX_STARTS`] points of a fixed grid, the most likely first: those that are no less likely than
/// their neighbours, and than the best less [`START_GAP`].
///
/// For given length scales the correlation matrix C = Q Λ Qᵀ is the same for all features. With w = Qᵀ z, noise ratio
/// ρ = σ_e²/σ_f² and the signal variance at its optimum σ_f² = 1/n Σ w_i² / (λ_i + ρ),
///
/// ```text
/// L = −n/2 log σ_f² − ½ Σ log(λ_i + ρ) + const
/// ```
///
/// so one eigendecomposition a pair of length scales serves all features and noise ratios (Rasmussen & Williams 2006,
/// section 5.4.1; Kammann & Wand 2003 for the profile).
pub(super) fn starts(
    learning: &LearningPositions,
    features: MatRef<f64>,
    bounds: &Bounds,
) -> Vec<Vec<Hyperparameters>> {
    let step = learning.len().div_ceil(MAX_START_POSITIONS);
    let thinned;
    let (learning, features) = if step == 1 {
        (learning, features.to_owned())
    } else {
        let rows: Vec<usize> = (0..learning.len()).step_by(step).collect();
        thinned = LearningPositions::new(rows.iter().map(|&i| learning.positions()[i]).collect());
        (&thinned, Mat::from_fn(rows.len(), features.ncols(), |i, r| features[(rows[i], r)]))
    };
    let lengths_m = extent_m(learning.positions()).map(|extent_m| {
        let mut along = START_LENGTH_RATIOS.map(|ratio| (ratio * extent_m).max(bounds.min_length_scale_m)).to_vec();
        along.dedup();
        along
    });
    let pairs: Vec<[f64; 2]> =
        lengths_m[0].iter().flat_map(|&l1| lengths_m[1].iter().map(move |&l2| [l1, l2])).collect();
    let grid: Vec<Vec<(f64, Hyperparameters)>> =
        pairs.par_iter().map(|&pair| profile(learning, &features, pair)).collect();
    (0..features.ncols())
        .map(|feature| {
            let of_feature: Vec<_> = grid.iter().map(|of_pair| of_pair[feature]).collect();
            let mut maxima = local_maxima(&of_feature, lengths_m[1].len());
            maxima.sort_by(|a, b| b.0.total_cmp(&a.0));
            let least = maxima[0].0 - START_GAP;
            maxima
                .into_iter()
                .filter(|start| start.0.partial_cmp(&least) != Some(Ordering::Less))
                .take(MAX_STARTS)
                .map(|(_, start)| start)
                .collect()
        })
        .collect()
}

/// The points of a grid of `columns` columns that are no less likely than those around them.
fn local_maxima(grid: &[(f64, Hyperparameters)], columns: usize) -> Vec<(f64, Hyperparameters)> {
    let near = |i: usize, count: usize| i.saturating_sub(1)..(i + 2).min(count);
    let is_maximum = |&i: &usize| {
        let around = near(i / columns, grid.len() / columns)
            .flat_map(|row| near(i % columns, columns).map(move |column| row * columns + column));
        // Written so that what is no number is a maximum: something must be.
        !around.into_iter().any(|other| grid[other].0 > grid[i].0)
    };
    (0..grid.len()).filter(is_maximum).map(|i| grid[i]).collect()
}

/// The best noise ratio and signal variance of every feature for the given length scales, with its log likelihood (up
/// to a constant).
fn profile(learning: &LearningPositions, features: &Mat<f64>, length_scale_m: [f64; 2]) -> Vec<(f64, Hyperparameters)> {
    let n = learning.len();
    let unit = Hyperparameters { signal_std: 1.0, noise_std: 0.0, length_scale_m };
    let eigen = learning.correlation_eigen(&unit);
    let mut projected = eigen.vectors.transpose() * features;
    for j in 0..projected.ncols() {
        projected.col_mut(j).iter_mut().for_each(|w| *w *= *w);
    }
    let reciprocal = Mat::from_fn(START_NOISE_RATIOS.len(), n, |r, i| 1.0 / (eigen.values[i] + START_NOISE_RATIOS[r]));
    let log_determinant =
        START_NOISE_RATIOS.map(|ratio| eigen.values.iter().map(|value| (value + ratio).ln()).sum::<f64>());
    let signal_variance = &reciprocal * &projected;
    (0..features.ncols())
        .map(|feature| {
            let best = (0..START_NOISE_RATIOS.len())
                .map(|r| {
                    let variance = (signal_variance[(r, feature)] / n as f64).max(f64::MIN_POSITIVE);
                    (-0.5 * (n as f64 * variance.ln() + log_determinant[r]), variance, START_NOISE_RATIOS[r])
                })
                .max_by(|a, b| a.0.total_cmp(&b.0));
            let (likelihood, variance, ratio) = best.expect("the grid is not empty");
            let hyperparameters =
                Hyperparameters { signal_std: variance.sqrt(), noise_std: (ratio * variance).sqrt(), length_scale_m };
            (likelihood, hyperparameters)
        })
        .collect()
}
