//! How far a frame's log-likelihood is to be trusted: one divisor a map, learned from frames that it has not seen.
//!
//! Features of one frame are not independent, and a group's k of them are not k observations; the summed log-likelihood
//! is sharper than the errors are. Divided by the *temperature* T it is as sharp as frames that were held back show:
//! p(cell) ∝ exp(log-likelihood / T).
//!
//! The positions of those frames err too, and what they err by must not be taken for errors of the frames: what is judged
//! is p(position) = Σ p(cell) N(position; cell, σ² I), σ the deviation of the position.

use rayon::prelude::*;

use crate::localize::most_likely_cell;
use crate::map::CandidateCells;
use crate::types::{PositionM, distance_m};

/// Temperatures that are tried: 2^−1, 2^−0.75, …, 2^7.
const LOG2_QUARTERS: std::ops::RangeInclusive<i32> = -4..=28;
/// Fewer frames than this say nothing about the spread of errors.
const MIN_FRAMES: usize = 8;
/// Cells that weigh less than this share of the nearest one are left out.
const LEAST_WEIGHT: f64 = 1e-4;

/// The temperature at which frames with these log-likelihoods (one row of cells each) most likely are at `positions_m`,
/// which are known to `std_m` on either axis: least mean −log of the probability of the cell nearest the position, or of
/// those around it if it may be wrong. `None` with too few frames.
pub fn fit_temperature(
    cells: &CandidateCells,
    log_likelihoods: &[&[f32]],
    positions_m: &[PositionM],
    std_m: &[f64],
) -> Option<f64> {
    if log_likelihoods.len() < MIN_FRAMES {
        return None;
    }
    let centers_m = cells.centers_m();
    let tried: Vec<f64> = LOG2_QUARTERS.map(|quarters| 2.0_f64.powf(0.25 * f64::from(quarters))).collect();
    // Frame × temperature; summed in order, so that the same frames always give the same temperature.
    let surprises: Vec<Vec<f64>> = log_likelihoods
        .par_iter()
        .zip(positions_m.par_iter().zip(std_m))
        .map(|(row, (&position_m, &std_m))| {
            let there = cells_around(&centers_m, position_m, std_m);
            tried.iter().map(|&temperature| surprise(row, &there, temperature)).collect()
        })
        .collect();
    let cost = |i: usize| surprises.iter().map(|of_frame| of_frame[i]).sum::<f64>();
    let best = (0..tried.len()).min_by(|&a, &b| cost(a).total_cmp(&cost(b)));
    best.map(|best| tried[best])
}

/// Whether the cell nearest `truth_m` lies in the smallest region that holds `probability` at this temperature.
pub fn covers(
    cells: &CandidateCells,
    log_likelihood: &[f32],
    truth_m: PositionM,
    temperature: f64,
    probability: f64,
) -> bool {
    credible_level(cells, log_likelihood, truth_m, temperature) < probability
}

/// Where `truth_m` lies in the regions that hold more and more: the probability of all cells that are likelier than the one
/// nearest to it. A region of `probability` holds whole cells, up to the one with which it is reached, and covers all levels
/// below: a little more than was asked for where cells are coarse.
pub fn credible_level(cells: &CandidateCells, log_likelihood: &[f32], truth_m: PositionM, temperature: f64) -> f64 {
    let relative = relative_probabilities(log_likelihood, temperature);
    let at_truth = relative[nearest_cell(&cells.centers_m(), truth_m)];
    let likelier: f64 = relative.iter().filter(|&&p| p > at_truth).sum();
    likelier / relative.iter().sum::<f64>()
}

/// −log of the mean probability of the cells `there`, by their weights, which sum to 1.
fn surprise(log_likelihood: &[f32], there: &[(usize, f64)], temperature: f64) -> f64 {
    let relative = relative_probabilities(log_likelihood, temperature);
    // By the likeliest of them: far from the summit all of them round to nothing.
    let of = |cell: usize| f64::from(log_likelihood[cell]) / temperature;
    let most = there.iter().map(|&(cell, _)| of(cell)).fold(f64::NEG_INFINITY, f64::max);
    let mean = there.iter().map(|&(cell, weight)| weight * (of(cell) - most).exp()).sum::<f64>();
    let greatest = of(most_likely_cell(log_likelihood));
    greatest - most - mean.ln() + relative.iter().sum::<f64>().ln()
}

/// The cells in which something may be that is known to be at `position_m` to `std_m`, with weights that sum to 1: the
/// nearest one alone if the position is exact, or the deviation far below a cell.
fn cells_around(centers_m: &[PositionM], position_m: PositionM, std_m: f64) -> Vec<(usize, f64)> {
    let nearest = nearest_cell(centers_m, position_m);
    if std_m <= 0.0 {
        return vec![(nearest, 1.0)];
    }
    // Relative to the nearest one, so that not all weights round to nothing.
    let squared = |cell: usize| (distance_m(position_m, centers_m[cell]) / std_m).powi(2);
    let least = squared(nearest);
    let weights = (0..centers_m.len()).map(|cell| (cell, (0.5 * (least - squared(cell))).exp()));
    let mut there: Vec<(usize, f64)> = weights.filter(|&(_, weight)| weight >= LEAST_WEIGHT).collect();
    let total: f64 = there.iter().map(|(_, weight)| weight).sum();
    there.iter_mut().for_each(|(_, weight)| *weight /= total);
    there
}

/// Probabilities of the cells, up to a factor: 1 for the likeliest.
fn relative_probabilities(log_likelihood: &[f32], temperature: f64) -> Vec<f64> {
    let greatest = f64::from(log_likelihood[most_likely_cell(log_likelihood)]);
    log_likelihood.iter().map(|&value| ((f64::from(value) - greatest) / temperature).exp()).collect()
}

fn nearest_cell(centers_m: &[PositionM], truth_m: PositionM) -> usize {
    let distances = centers_m.iter().map(|&center_m| distance_m(truth_m, center_m)).enumerate();
    distances.min_by(|a, b| a.1.total_cmp(&b.1)).map_or(0, |(cell, _)| cell)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Frames whose errors are normal with 1 m on either axis, and a log-likelihood `sharper` times too sharp.
    fn frames(sharper: f64) -> (CandidateCells, Vec<Vec<f32>>, Vec<PositionM>) {
        let cells = CandidateCells::around(&[[0.0, 0.0], [20.0, 20.0]], 0.5, None).expect("a small grid");
        let quantiles = [-1.645, -1.036, -0.674, -0.385, -0.126, 0.126, 0.385, 0.674, 1.036, 1.645];
        let truth_m: Vec<PositionM> = (0..100).map(|i| [10.0 + quantiles[i % 10], 10.0 + quantiles[i / 10]]).collect();
        let row = |_: &PositionM| {
            let log = |c: &PositionM| -0.5 * sharper * ((c[0] - 10.0).powi(2) + (c[1] - 10.0).powi(2));
            cells.centers_m().iter().map(|c| log(c) as f32).collect()
        };
        let rows = truth_m.iter().map(row).collect();
        (cells, rows, truth_m)
    }

    /// Share of the frames that are covered with 95 %.
    fn coverage(cells: &CandidateCells, rows: &[Vec<f32>], truth_m: &[PositionM], temperature: f64) -> f64 {
        let covered =
            rows.iter().zip(truth_m).filter(|(row, truth_m)| covers(cells, row, **truth_m, temperature, 0.95));
        covered.count() as f64 / rows.len() as f64
    }

    #[test]
    fn overconfidence_is_undone() {
        for sharper in [1.0, 8.0, 32.0] {
            let (cells, rows, truth_m) = frames(sharper);
            let slices: Vec<&[f32]> = rows.iter().map(Vec::as_slice).collect();
            let temperature = fit_temperature(&cells, &slices, &truth_m, &[0.0; 100]).expect("100 frames");
            assert!((temperature / sharper).log2().abs() <= 0.51, "{temperature} for {sharper}");
            let covered = coverage(&cells, &rows, &truth_m, temperature);
            assert!((0.85..=1.0).contains(&covered), "{covered}");
        }
        let (cells, rows, truth_m) = frames(32.0);
        assert!(coverage(&cells, &rows, &truth_m, 1.0) < 0.4, "too sharp covers too little");
    }

    /// Frames that are exact, at positions that err by 1 m on either axis: the frames are not to blame.
    #[test]
    fn errors_of_the_positions_are_not_taken_for_errors_of_the_frames() {
        let (cells, _, positions_m) = frames(1.0);
        let row: Vec<f32> =
            cells.centers_m().iter().map(|c| -(50.0 * distance_m(*c, [10.0, 10.0]).powi(2)) as f32).collect();
        let rows = vec![row.as_slice(); positions_m.len()];
        let believed = |std_m: f64| fit_temperature(&cells, &rows, &positions_m, &[std_m; 100]).expect("100 frames");
        // exp(-50 d²) has a variance of 0.01 m²; of that of the positions, their own is taken off: as a ratio, to the next
        // temperatures that are tried.
        let variance_m2 = positions_m.iter().map(|p| (p[0] - 10.0).powi(2)).sum::<f64>() / 100.0;
        for std_m in [0.0, 0.5, 0.7] {
            let expected = 100.0 * (variance_m2 - std_m * std_m);
            assert!((believed(std_m) / expected).log2().abs() < 0.51, "{} at {std_m}", believed(std_m));
        }
        assert!(believed(1.0) < 8.0, "{}", believed(1.0));
    }

    #[test]
    fn weights_of_cells_are_those_of_the_normal_distribution() {
        let centers_m = [[0.0, 0.0], [1.0, 0.0], [2.0, 0.0], [40.0, 0.0]];
        assert_eq!(cells_around(&centers_m, [0.9, 0.0], 0.0), [(1, 1.0)]);
        assert_eq!(cells_around(&centers_m, [0.9, 0.0], 0.01), [(1, 1.0)]);
        let there = cells_around(&centers_m, [0.5, 0.0], 1.0);
        let sum = 2.0 + (-1.0_f64).exp();
        let expected = [1.0 / sum, 1.0 / sum, (-1.0_f64).exp() / sum];
        assert_eq!(there.len(), 3, "40 m is too far");
        for (&(_, weight), expected) in there.iter().zip(expected) {
            assert!((weight - expected).abs() < 1e-12, "{there:?}");
        }
    }

    #[test]
    fn a_handful_of_frames_says_nothing() {
        let (cells, rows, truth_m) = frames(1.0);
        assert_eq!(fit_temperature(&cells, &[&rows[0]], &truth_m[..1], &[0.0]), None);
    }
}
