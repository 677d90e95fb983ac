//! Hyperparameters by maximum likelihood.

use faer::linalg::solvers::DenseSolveCore;
use faer::linalg::solvers::Solve;
use faer::{Mat, MatRef, Side};
use multiversion::multiversion;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::minimize::{self, minimize};
use super::{GpError, Hyperparameters, LearningPositions};
use crate::types::PositionM;

/// The box the hyperparameters are looked for in.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Bounds {
    /// Signal and noise standard deviation, as multiples of the feature's own standard deviation.
    pub signal_std_ratio: [f64; 2],
    pub noise_std_ratio: [f64; 2],
    /// Length scales as multiples of the extent of the learning positions along their axis.
    pub length_scale_ratio: [f64; 2],
    /// Length scales are also at least this \[m\]: a field that changes between neighbouring learning positions cannot
    /// be told from noise by (4), but can by (10).
    pub min_length_scale_m: f64,
}

impl Bounds {
    /// Those of the paper's recipe: wide open.
    pub const PAPER: Self = Self {
        signal_std_ratio: [1e-3, 1e2],
        noise_std_ratio: [1e-3, 1e1],
        length_scale_ratio: [5e-3, 2e1],
        min_length_scale_m: 0.0,
    };

    /// (lower, upper) of the logarithms for a feature with standard deviation `std`.
    fn in_logs(&self, std: f64, extent_m: [f64; 2]) -> ([f64; 4], [f64; 4]) {
        let side = |side: usize| {
            let length =
                |axis: usize| (self.length_scale_ratio[side] * extent_m[axis]).max(self.min_length_scale_m).ln();
            [(self.signal_std_ratio[side] * std).ln(), (self.noise_std_ratio[side] * std).ln(), length(0), length(1)]
        };
        (side(0), side(1))
    }
}

/// One feature's fit.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Fit {
    pub hyperparameters: Hyperparameters,
    pub log_likelihood: f64,
    pub evaluations: usize,
    /// What is to be said about it; empty when all is well.
    pub warnings: Vec<Warning>,
}

/// What can be wrong with an optimum.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Warning {
    SignalAtBound,
    NoiseAtBound,
    LengthScaleAtLowerBound,
    LengthScaleAtUpperBound,
    /// The field explains less than a hundredth of the variance: the feature says nothing about the place.
    OnlyNoise,
    /// A length scale is below the spacing of the positions: indistinguishable from noise, but not when predicting.
    LengthScaleBelowSpacing,
    NotConverged,
}

impl Warning {
    pub fn describe(self) -> &'static str {
        match self {
            Self::SignalAtBound => "signal deviation at its bound",
            Self::NoiseAtBound => "noise deviation at its bound",
            Self::LengthScaleAtLowerBound => "length scale at its lower bound",
            Self::LengthScaleAtUpperBound => "length scale at its upper bound",
            Self::OnlyNoise => "explained by noise alone",
            Self::LengthScaleBelowSpacing => "length scale below the spacing of the positions",
            Self::NotConverged => "optimiser stopped before it converged",
        }
    }
}

/// Log marginal likelihood, Do et al. (2015), eq. 4:
///
/// ```text
/// L(θ) = −½ zᵀ R⁻¹ z − ½ log|R| − n/2 log 2π        R = K + σ_e² I
/// ```
pub fn log_marginal_likelihood(
    learning: &LearningPositions,
    z: &[f64],
    hyperparameters: &Hyperparameters,
) -> Result<f64, GpError> {
    let factor = learning.factorize(hyperparameters)?;
    let z = Mat::from_fn(z.len(), 1, |i, _| z[i]);
    Ok(likelihood_of(&factor, z.as_ref(), factor.solve(&z).as_ref()))
}

fn likelihood_of(factor: &faer::linalg::solvers::Llt<f64>, z: MatRef<f64>, a: MatRef<f64>) -> f64 {
    let half_log_determinant: f64 = factor.L().diagonal().column_vector().iter().map(|d| d.ln()).sum();
    let quadratic: f64 = z.col(0).iter().zip(a.col(0).iter()).map(|(z, a)| z * a).sum();
    -0.5 * quadratic - half_log_determinant - 0.5 * z.nrows() as f64 * std::f64::consts::TAU.ln()
}

/// L(θ) and its gradient with respect to the logarithms (log σ_f, log σ_e, log ℓ_1, log ℓ_2): with a = R⁻¹ z and
/// M = R⁻¹ − a aᵀ,
///
/// ```text
/// ∂L/∂log σ_f = −Σ_ij M_ij K_ij        ∂L/∂log σ_e = −σ_e² tr M
/// ∂L/∂log ℓ_k = −½ Σ_ij M_ij K_ij (s_ik − s_jk)² / ℓ_k²
/// ```
pub fn likelihood_and_gradient(
    learning: &LearningPositions,
    z: &[f64],
    hyperparameters: &Hyperparameters,
) -> Result<(f64, [f64; 4]), GpError> {
    let n = learning.len();
    let k = learning.kernel_matrix(hyperparameters);
    let noise_variance = hyperparameters.noise_std.powi(2);
    let mut r = k.clone();
    for i in 0..n {
        r[(i, i)] += noise_variance;
    }
    let factor = r
        .llt(Side::Lower)
        .map_err(|_| GpError::NotPositiveDefinite { points: n, hyperparameters: *hyperparameters })?;
    let z = Mat::from_fn(n, 1, |i, _| z[i]);
    let a = factor.solve(&z);
    let likelihood = likelihood_of(&factor, z.as_ref(), a.as_ref());
    let inverse = factor.inverse();

    let [d1, d2] = &learning.squared_distance_m2;
    let [mut signal, mut noise, mut length_1, mut length_2] = [0.0; 4];
    let a = a.col_as_slice(0);
    for j in 0..n {
        noise -= noise_variance * (inverse[(j, j)] - a[j] * a[j]);
        // Half of the diagonal, then the column below it: the matrices are symmetric.
        signal -= 0.5 * (inverse[(j, j)] - a[j] * a[j]) * k[(j, j)];
        let [inverse, k, d1, d2] = [&inverse, &k, d1, d2].map(|matrix| &matrix.col_as_slice(j)[j + 1..]);
        let sums = column_sums(inverse, &a[j + 1..], a[j], k, d1, d2);
        signal -= sums[0];
        length_1 -= sums[1];
        length_2 -= sums[2];
    }
    let [l1, l2] = hyperparameters.length_scale_m;
    Ok((likelihood, [2.0 * signal, noise, length_1 / (l1 * l1), length_2 / (l2 * l2)]))
}

/// Σ M_ij K_ij, Σ M_ij K_ij d1_ij and Σ M_ij K_ij d2_ij over the rows i given, with M_ij = R⁻¹_ij − a_i a_j.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2+fma"))]
fn column_sums(inverse: &[f64], a: &[f64], a_j: f64, k: &[f64], d1: &[f64], d2: &[f64]) -> [f64; 3] {
    // One sum a lane: sums in order could not be taken several at once.
    const LANES: usize = 8;
    let mut lanes = [[0.0; LANES]; 3];
    let n = inverse.len();
    let whole = n - n % LANES;
    for first in (0..whole).step_by(LANES) {
        let next = |values: &[f64]| -> [f64; LANES] { std::array::from_fn(|lane| values[first..first + LANES][lane]) };
        let (inverse, a, k, d1, d2) = (next(inverse), next(a), next(k), next(d1), next(d2));
        for lane in 0..LANES {
            let mk = (inverse[lane] - a[lane] * a_j) * k[lane];
            lanes[0][lane] += mk;
            lanes[1][lane] += mk * d1[lane];
            lanes[2][lane] += mk * d2[lane];
        }
    }
    for i in whole..n {
        let mk = (inverse[i] - a[i] * a_j) * k[i];
        lanes[0][0] += mk;
        lanes[1][0] += mk * d1[i];
        lanes[2][0] += mk * d2[i];
    }
    lanes.map(|lanes| lanes.iter().sum())
}

/// Fits every column of `features` (n × d) on its own, in parallel. `on_done` is called once a feature.
///
/// The likelihood has several optima, so each fit starts from the best point of a fixed grid over length scales and
/// noise ratio, which all features share (see [`starts`]), and is then polished by bounded BFGS with the exact gradient.
pub fn fit_each(
    learning: &LearningPositions,
    features: MatRef<f64>,
    bounds: &Bounds,
    on_done: impl Fn() + Sync,
) -> Vec<Fit> {
    let spacing_m = median_neighbour_spacing_m(learning.positions());
    let starts = starts(learning, features, bounds);
    starts
        .into_par_iter()
        .enumerate()
        .map(|(feature, start)| {
            let z: Vec<f64> = features.col(feature).iter().copied().collect();
            let fit = fit_one(learning, &z, bounds, start, spacing_m);
            on_done();
            fit
        })
        .collect()
}

fn fit_one(learning: &LearningPositions, z: &[f64], bounds: &Bounds, start: Hyperparameters, spacing_m: f64) -> Fit {
    let (lower, upper) = bounds.in_logs(standard_deviation(z), extent_m(learning.positions()));
    let objective = |log: &[f64; 4]| {
        let (value, gradient) = likelihood_and_gradient(learning, z, &Hyperparameters::from_log(*log)).ok()?;
        value.is_finite().then(|| (-value, gradient.map(|g| -g)))
    };
    let settings = minimize::Settings::default();
    let minimum = minimize(objective, start.to_log(), lower, upper, &settings).or_else(|| {
        // R is numerically singular at the start: begin again with much noise, where it cannot be.
        let safe = Hyperparameters { noise_std: start.signal_std, ..start };
        minimize(objective, safe.to_log(), lower, upper, &settings)
    });
    let Some(minimum) = minimum else {
        // Only where z holds no finite numbers; callers have checked that. Keep the prior, and say so.
        return Fit {
            hyperparameters: start,
            log_likelihood: f64::NEG_INFINITY,
            evaluations: 2,
            warnings: vec![Warning::NotConverged],
        };
    };
    let hyperparameters = Hyperparameters::from_log(minimum.x);
    let warnings = warnings(&hyperparameters, &minimum, &lower, &upper, spacing_m);
    Fit { hyperparameters, log_likelihood: -minimum.value, evaluations: minimum.evaluations, warnings }
}

fn warnings(
    hyperparameters: &Hyperparameters,
    minimum: &minimize::Minimum<4>,
    lower: &[f64; 4],
    upper: &[f64; 4],
    spacing_m: f64,
) -> Vec<Warning> {
    const NEAR: f64 = 1e-6;
    let at_lower = |i: usize| minimum.x[i] <= lower[i] + NEAR;
    let at_upper = |i: usize| minimum.x[i] >= upper[i] - NEAR;
    let explained = hyperparameters.signal_std.powi(2);
    [
        (at_lower(0) || at_upper(0), Warning::SignalAtBound),
        (at_lower(1) || at_upper(1), Warning::NoiseAtBound),
        (at_lower(2) || at_lower(3), Warning::LengthScaleAtLowerBound),
        (at_upper(2) || at_upper(3), Warning::LengthScaleAtUpperBound),
        (explained < 0.01 * (explained + hyperparameters.noise_std.powi(2)), Warning::OnlyNoise),
        (
            hyperparameters.length_scale_m.iter().any(|&length_m| length_m < (1.0 - NEAR) * spacing_m),
            Warning::LengthScaleBelowSpacing,
        ),
        (!minimum.converged, Warning::NotConverged),
    ]
    .into_iter()
    .filter_map(|(holds, warning)| holds.then_some(warning))
    .collect()
}

/// Length scales of the grid of starts, as multiples of the extent.
const START_LENGTH_RATIOS: [f64; 6] = [0.02, 0.05, 0.12, 0.3, 0.75, 2.0];
/// Noise variance over signal variance of the grid of starts.
const START_NOISE_RATIOS: [f64; 8] = [1e-4, 1e-3, 1e-2, 0.05, 0.2, 0.6, 2.0, 10.0];
/// More positions than this are thinned for the starts: they are only where the search begins.
const MAX_START_POSITIONS: usize = 300;

/// For every feature the most likely point of a fixed grid.
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
fn starts(learning: &LearningPositions, features: MatRef<f64>, bounds: &Bounds) -> Vec<Hyperparameters> {
    let step = learning.len().div_ceil(MAX_START_POSITIONS);
    let thinned;
    let (learning, features) = if step == 1 {
        (learning, features.to_owned())
    } else {
        let rows: Vec<usize> = (0..learning.len()).step_by(step).collect();
        thinned = LearningPositions::new(rows.iter().map(|&i| learning.positions()[i]).collect());
        (&thinned, Mat::from_fn(rows.len(), features.ncols(), |i, r| features[(rows[i], r)]))
    };
    let extent_m = extent_m(learning.positions());
    let pairs: Vec<[f64; 2]> = START_LENGTH_RATIOS
        .iter()
        .flat_map(|&l1| START_LENGTH_RATIOS.map(|l2| [l1 * extent_m[0], l2 * extent_m[1]]))
        .map(|pair| pair.map(|length_m| length_m.max(bounds.min_length_scale_m)))
        .collect();
    let candidates: Vec<Vec<(f64, Hyperparameters)>> =
        pairs.par_iter().map(|&pair| profile(learning, &features, pair)).collect();
    (0..features.ncols())
        .map(|feature| {
            let best = candidates.iter().map(|of_pair| of_pair[feature]).max_by(|a, b| a.0.total_cmp(&b.0));
            best.expect("the grid is not empty").1
        })
        .collect()
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

/// Extent of the positions along either axis \[m\]; an axis along which they (nearly) coincide counts as a hundredth of
/// the other.
pub fn extent_m(positions: &[PositionM]) -> [f64; 2] {
    let along = |axis: usize| {
        let (low, high) = positions
            .iter()
            .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), p| (p[axis].min(low), p[axis].max(high)));
        (high - low).max(0.0)
    };
    let (east, north) = (along(0), along(1));
    let least = (0.01 * east.max(north)).max(f64::MIN_POSITIVE);
    [east.max(least), north.max(least)]
}

/// Positions closer than this are one place: a receiver slower than the camera repeats its fixes.
const SAME_PLACE_M: f64 = 1e-6;

/// Median over the positions of the distance to the nearest position elsewhere \[m\]: several images of one place count as
/// one place. Zero where all positions are one.
pub fn median_neighbour_spacing_m(positions: &[PositionM]) -> f64 {
    let mut nearest: Vec<f64> = positions
        .iter()
        .filter_map(|&p| {
            let distances = positions.iter().map(|&q| crate::types::distance_m(p, q));
            distances.filter(|&distance_m| distance_m > SAME_PLACE_M).min_by(f64::total_cmp)
        })
        .collect();
    nearest.sort_by(f64::total_cmp);
    nearest.get(nearest.len() / 2).copied().unwrap_or(0.0)
}

/// Square root of the mean square about the mean.
fn standard_deviation(z: &[f64]) -> f64 {
    let n = z.len() as f64;
    let mean = z.iter().sum::<f64>() / n;
    let variance = z.iter().map(|z| (z - mean).powi(2)).sum::<f64>() / n;
    variance.sqrt().max(f64::MIN_POSITIVE.sqrt())
}

#[cfg(test)]
mod tests {
    use super::super::tests::golden_gp;
    use super::*;
    use crate::golden::{golden, list};

    #[test]
    fn likelihood_and_gradient_equal_the_reference_values() {
        let (learning, z, theta) = golden_gp();
        let gp = &golden()["gp"];
        let (likelihood, gradient) = likelihood_and_gradient(&learning, &z, &theta).expect("positive definite");
        let expected = -gp["nll"].as_f64().expect("a number");
        assert!((likelihood / expected - 1.0).abs() < 1e-6, "{likelihood} instead of {expected}");
        assert_eq!(likelihood, log_marginal_likelihood(&learning, &z, &theta).expect("positive definite"));
        // The reference is the gradient of the negative log likelihood.
        for (found, expected) in gradient.iter().zip(list(&gp["grad"])) {
            assert!((-found / expected - 1.0).abs() < 1e-6, "{found} instead of {}", -expected);
        }
    }

    #[test]
    fn gradient_equals_the_central_difference() {
        let (learning, z, _) = golden_gp();
        const STEP: f64 = 1e-5;
        for log in [[0.0, -1.0, 0.5, 1.0], [-1.0, 0.5, -1.0, 2.0], [1.0, -3.0, 1.5, 0.0], [-2.0, -2.0, 3.0, 3.0]] {
            let at = |log: [f64; 4]| {
                log_marginal_likelihood(&learning, &z, &Hyperparameters::from_log(log)).expect("positive definite")
            };
            let (_, gradient) =
                likelihood_and_gradient(&learning, &z, &Hyperparameters::from_log(log)).expect("positive definite");
            for (i, &slope) in gradient.iter().enumerate() {
                let shifted = |by: f64| std::array::from_fn(|k| log[k] + if k == i { by } else { 0.0 });
                let difference = (at(shifted(STEP)) - at(shifted(-STEP))) / (2.0 * STEP);
                let scale = slope.abs().max(1.0);
                assert!((slope - difference).abs() < 1e-5 * scale, "{log:?} {i}: {slope} {difference}");
            }
        }
    }

    #[test]
    fn the_optimum_equals_the_reference_value() {
        let (learning, z, _) = golden_gp();
        let gp = &golden()["gp"];
        let features = Mat::from_fn(z.len(), 1, |i, _| z[i]);
        let fit = &fit_each(&learning, features.as_ref(), &Bounds::PAPER, || {})[0];
        let best = gp["best_loglik"].as_f64().expect("a number");
        assert!(fit.log_likelihood > best - 1e-6, "{} is worse than {best}", fit.log_likelihood);
        for (found, expected) in fit.hyperparameters.to_log().iter().zip(list(&gp["best_theta_log"])) {
            assert!((found - expected).abs() < 1e-3, "{found} instead of {expected}");
        }
        assert_eq!(fit.warnings, []);
    }

    #[test]
    fn pure_noise_and_a_field_finer_than_the_spacing_are_warned_about() {
        let (learning, _, _) = golden_gp();
        let noise = Mat::from_fn(30, 1, |i, _| (12.9898 * (i * i) as f64).sin());
        let fit = &fit_each(&learning, noise.as_ref(), &Bounds::PAPER, || {})[0];
        assert!(!fit.warnings.is_empty(), "{fit:?}");
        let bounded = Bounds { min_length_scale_m: 1.5, ..Bounds::PAPER };
        let fit = &fit_each(&learning, noise.as_ref(), &bounded, || {})[0];
        assert!(!fit.warnings.contains(&Warning::LengthScaleBelowSpacing), "{fit:?}");
    }

    #[test]
    fn repeated_positions_do_not_shrink_the_spacing() {
        let held: Vec<PositionM> = (0..30).map(|i| [f64::from(i / 3) * 2.0, 0.0]).collect();
        assert_eq!(median_neighbour_spacing_m(&held), 2.0);
        assert_eq!(median_neighbour_spacing_m(&[[1.0, 1.0]; 4]), 0.0);
    }

    #[test]
    fn positions_on_a_line_have_a_fit() {
        let learning = LearningPositions::new((0..40).map(|i| [f64::from(i), 2.0]).collect());
        let z = Mat::from_fn(40, 1, |i, _| (i as f64 * 0.3).sin());
        let fit = &fit_each(&learning, z.as_ref(), &Bounds::PAPER, || {})[0];
        assert!(fit.log_likelihood.is_finite() && fit.hyperparameters.length_scale_m[0] > 1.0, "{fit:?}");
    }
}
