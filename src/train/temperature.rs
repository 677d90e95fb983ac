//! How far a frame's log-likelihood is to be trusted: one divisor a map, learned from frames that it has not seen.
//!
//! Features of one frame are not independent, and a group's k of them are not k observations; the summed log-likelihood
//! is sharper than the errors are. Divided by the *temperature* T it is as sharp as frames that were held back show:
//! p(cell) ∝ exp(log-likelihood / T).

use rayon::prelude::*;

use crate::localize::most_likely_cell;
use crate::map::CandidateCells;
use crate::types::{PositionM, distance_m};

/// Temperatures that are tried: 2^−1, 2^−0.75, …, 2^7.
const LOG2_QUARTERS: std::ops::RangeInclusive<i32> = -4..=28;
/// Fewer frames than this say nothing about the spread of errors.
const MIN_FRAMES: usize = 8;

/// The temperature at which frames with these log-likelihoods (one row of cells each) most likely are at `truth_m`: least
/// mean −log of the probability of the cell nearest the true position. `None` with too few frames.
pub fn fit_temperature(cells: &CandidateCells, log_likelihoods: &[&[f32]], truth_m: &[PositionM]) -> Option<f64> {
    if log_likelihoods.len() < MIN_FRAMES {
        return None;
    }
    let centers_m = cells.centers_m();
    let tried: Vec<f64> = LOG2_QUARTERS.map(|quarters| 2.0_f64.powf(0.25 * f64::from(quarters))).collect();
    // Frame × temperature; summed in order, so that the same frames always give the same temperature.
    let surprises: Vec<Vec<f64>> = log_likelihoods
        .par_iter()
        .zip(truth_m)
        .map(|(row, &truth_m)| {
            let at = nearest_cell(&centers_m, truth_m);
            tried.iter().map(|&temperature| surprise(row, at, temperature)).collect()
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

/// The probability of all cells that are likelier than the one nearest `truth_m`: the smallest region that holds more than
/// that holds `truth_m`. Uniform in 0..1 over frames where the probabilities are right.
pub fn credible_level(cells: &CandidateCells, log_likelihood: &[f32], truth_m: PositionM, temperature: f64) -> f64 {
    let relative = relative_probabilities(log_likelihood, temperature);
    let at_truth = relative[nearest_cell(&cells.centers_m(), truth_m)];
    let likelier: f64 = relative.iter().filter(|&&p| p > at_truth).sum();
    likelier / relative.iter().sum::<f64>()
}

/// −log of the probability of cell `at`.
fn surprise(log_likelihood: &[f32], at: usize, temperature: f64) -> f64 {
    let relative = relative_probabilities(log_likelihood, temperature);
    let greatest = f64::from(log_likelihood[most_likely_cell(log_likelihood)]);
    (greatest - f64::from(log_likelihood[at])) / temperature + relative.iter().sum::<f64>().ln()
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
            let temperature = fit_temperature(&cells, &slices, &truth_m).expect("100 frames");
            assert!((temperature / sharper).log2().abs() <= 0.51, "{temperature} for {sharper}");
            let covered = coverage(&cells, &rows, &truth_m, temperature);
            assert!((0.85..=1.0).contains(&covered), "{covered}");
        }
        let (cells, rows, truth_m) = frames(32.0);
        assert!(coverage(&cells, &rows, &truth_m, 1.0) < 0.4, "too sharp covers too little");
    }

    #[test]
    fn a_handful_of_frames_says_nothing() {
        let (cells, rows, truth_m) = frames(1.0);
        assert_eq!(fit_temperature(&cells, &[&rows[0]], &truth_m[..1]), None);
    }
}
