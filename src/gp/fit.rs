//! Hyperparameters by maximum likelihood.

use faer::MatRef;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::likelihood::Terms;
use super::minimize::{self, minimize};
use super::starts::starts;
use super::{Hyperparameters, LearningPositions};
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

/// Fits every column of `features` (n × d) on its own, in parallel. `on_done` is called once a feature.
///
/// The likelihood has several optima. So each fit starts from the best points of a fixed grid over length scales and noise
/// ratio, which all features share (see [`starts`]); each is polished by bounded BFGS with the exact gradient, and the
/// most likely result is taken.
pub fn fit_each(
    learning: &LearningPositions,
    features: MatRef<f64>,
    bounds: &Bounds,
    on_done: impl Fn() + Sync,
) -> Vec<Fit> {
    let spacing_m = learning.spacing_m();
    let starts = starts(learning, features, bounds);
    starts
        .into_par_iter()
        .enumerate()
        .map(|(feature, starts)| {
            let z: Vec<f64> = features.col(feature).iter().copied().collect();
            let fits: Vec<Fit> =
                starts.into_iter().map(|start| fit_one(learning, &z, bounds, start, spacing_m)).collect();
            let evaluations = fits.iter().map(|fit| fit.evaluations).sum();
            // Of equals the first.
            let better = |best: Fit, fit: Fit| if fit.log_likelihood > best.log_likelihood { fit } else { best };
            let best = fits.into_iter().reduce(better).expect("the grid has a greatest point");
            on_done();
            Fit { evaluations, ..best }
        })
        .collect()
}

/// The optimum for `z` that is reached from `start`.
///
/// The signal variance is at its optimum for every noise ratio and length scales (see [`Terms`]), within its bounds and
/// those of the noise, so that only (log ρ, log ℓ_1, log ℓ_2) are looked for. Signal and noise share the variance of z: as
/// variables on their own they would form a curved ridge, which is long to follow.
fn fit_one(learning: &LearningPositions, z: &[f64], bounds: &Bounds, start: Hyperparameters, spacing_m: f64) -> Fit {
    let (lower, upper) = bounds.in_logs(standard_deviation(z), extent_m(learning.positions()));
    let profile = |&[log_ratio, l1, l2]: &[f64; 3]| {
        let terms = Terms::new(learning, z, [l1.exp(), l2.exp()], log_ratio.exp())?;
        let signal_variance = bounded_signal_variance(&terms, log_ratio, &lower, &upper);
        Some((terms, signal_variance))
    };
    let objective = |x: &[f64; 3]| {
        let (terms, (log_variance, noise_is_held)) = profile(x)?;
        let [signal, noise, l1, l2] = terms.gradient(log_variance.exp());
        // With the signal held the noise moves, ½ log σ_e² a unit, and the other way round; free, they balance.
        let ratio = if noise_is_held { -0.5 * signal } else { 0.5 * noise };
        let likelihood = terms.likelihood(log_variance.exp());
        likelihood.is_finite().then_some((-likelihood, [-ratio, -l1, -l2]))
    };
    let ratio_between = |noise: f64, signal: f64| 2.0 * (noise - signal);
    let lower_x = [ratio_between(lower[1], upper[0]), lower[2], lower[3]];
    let upper_x = [ratio_between(upper[1], lower[0]), upper[2], upper[3]];
    let [signal, noise, l1, l2] = start.to_log();
    let settings = minimize::Settings::default();
    let minimum = minimize(objective, [ratio_between(noise, signal), l1, l2], lower_x, upper_x, &settings)
        // A is numerically singular at the start: begin again with much noise, where it cannot be.
        .or_else(|| minimize(objective, [0.0, l1, l2], lower_x, upper_x, &settings));
    let found = minimum.and_then(|minimum| profile(&minimum.x).map(|(_, (log_variance, _))| (minimum, log_variance)));
    let Some((minimum, log_variance)) = found else {
        // Only where z holds no finite numbers; callers have checked that. Keep the prior, and say so.
        return Fit {
            hyperparameters: start,
            log_likelihood: f64::NEG_INFINITY,
            evaluations: 2,
            warnings: vec![Warning::NotConverged],
        };
    };
    let [log_ratio, l1, l2] = minimum.x;
    let log = [0.5 * log_variance, 0.5 * (log_ratio + log_variance), l1, l2];
    let hyperparameters = Hyperparameters::from_log(log);
    let warnings = warnings(&hyperparameters, minimum.converged, &log, &lower, &upper, spacing_m);
    Fit { hyperparameters, log_likelihood: -minimum.value, evaluations: minimum.evaluations, warnings }
}

/// The logarithm of the best signal variance that keeps signal and noise in the box, and whether it is the noise that is
/// at its bound.
fn bounded_signal_variance(terms: &Terms, log_ratio: f64, lower: &[f64; 4], upper: &[f64; 4]) -> (f64, bool) {
    let best = terms.best_signal_variance().ln();
    let (of_signal, of_noise) = (2.0 * lower[0], 2.0 * lower[1] - log_ratio);
    if best <= of_signal.max(of_noise) {
        return (of_signal.max(of_noise), of_noise > of_signal);
    }
    let (of_signal, of_noise) = (2.0 * upper[0], 2.0 * upper[1] - log_ratio);
    if best >= of_signal.min(of_noise) {
        return (of_signal.min(of_noise), of_noise < of_signal);
    }
    (best, false)
}

fn warnings(
    hyperparameters: &Hyperparameters,
    converged: bool,
    log: &[f64; 4],
    lower: &[f64; 4],
    upper: &[f64; 4],
    spacing_m: f64,
) -> Vec<Warning> {
    const NEAR: f64 = 1e-6;
    let at_lower = |i: usize| log[i] <= lower[i] + NEAR;
    let at_upper = |i: usize| log[i] >= upper[i] - NEAR;
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
        (!converged, Warning::NotConverged),
    ]
    .into_iter()
    .filter_map(|(holds, warning)| holds.then_some(warning))
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

/// Median over the positions of the distance to the nearest position elsewhere in the same recording \[m\]: several images
/// of one place count as one place. Zero where all positions of a recording are one.
pub(crate) fn median_neighbour_spacing_m(positions: &[PositionM], recording: &[usize]) -> f64 {
    let mut nearest: Vec<f64> = positions
        .iter()
        .zip(recording)
        .filter_map(|(&p, of_p)| {
            let same = positions.iter().zip(recording).filter(|(_, of_q)| *of_q == of_p);
            let distances = same.map(|(&q, _)| crate::types::distance_m(p, q));
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
    use faer::Mat;

    use super::super::tests::golden_gp;
    use super::*;
    use crate::golden::{golden, list};
    use crate::gp::likelihood::log_marginal_likelihood;

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

    /// 60 positions along a loop, and features from smooth to fine, with no noise, some, and hardly anything else.
    fn many_features() -> (LearningPositions, Mat<f64>) {
        let positions = (0..60).map(f64::from).map(|i| [20.0 * (0.11 * i).cos() + 0.3 * (7.0 * i).sin(), 0.4 * i]);
        let mut state = 1_u64;
        let mut noise = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 11) as f64 / (1_u64 << 53) as f64 - 0.5
        };
        let positions: Vec<PositionM> = positions.collect();
        let features = Mat::from_fn(60, 24, |i, r| {
            let [x, y] = positions[i];
            let (wave, share) = (0.05 * 1.25_f64.powi(r as i32), [0.0, 0.1, 0.4, 1.0, 3.0, 1e3][r % 6]);
            (wave * x).sin() + (0.6 * wave * y).cos() + share * noise()
        });
        (LearningPositions::new(positions), features)
    }

    #[test]
    fn no_step_within_the_box_is_uphill_from_an_optimum() {
        let (learning, features) = many_features();
        let fits = fit_each(&learning, features.as_ref(), &Bounds::PAPER, || {});
        for (r, fit) in fits.iter().enumerate() {
            let z = features.col_as_slice(r);
            let (lower, upper) = Bounds::PAPER.in_logs(standard_deviation(z), extent_m(learning.positions()));
            let log = fit.hyperparameters.to_log();
            for i in 0..4 {
                assert!(
                    log[i] >= lower[i] - 1e-9 && log[i] <= upper[i] + 1e-9,
                    "feature {r}: {log:?} {lower:?} {upper:?}"
                );
                for step in [-0.02, 0.02] {
                    let mut beside = log;
                    beside[i] = (beside[i] + step).clamp(lower[i], upper[i]);
                    let likelihood = log_marginal_likelihood(&learning, z, &Hyperparameters::from_log(beside));
                    let uphill = likelihood.map_or(f64::NEG_INFINITY, |l| l - fit.log_likelihood);
                    assert!(uphill < 1e-3, "feature {r}: {uphill} by moving {i} of {log:?} by {step}");
                }
            }
        }
    }

    #[test]
    fn another_start_leads_to_nothing_better() {
        let (learning, features) = many_features();
        let fits = fit_each(&learning, features.as_ref(), &Bounds::PAPER, || {});
        let extent_m = extent_m(learning.positions());
        for (r, fit) in fits.iter().enumerate() {
            let z = features.col_as_slice(r);
            for ratio in [0.01, 0.15, 1.0] {
                let length_scale_m = extent_m.map(|extent_m| ratio * extent_m);
                let start = Hyperparameters { signal_std: 0.8, noise_std: 0.5, length_scale_m };
                let other = fit_one(&learning, z, &Bounds::PAPER, start, 0.0);
                let gain = other.log_likelihood - fit.log_likelihood;
                assert!(gain < 1e-3, "feature {r}: {gain} from {ratio}, {fit:?} {other:?}");
            }
        }
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
    fn more_recordings_shrink_the_spacing_only_so_far() {
        let lane = |shift_m: f64| (0..20).map(move |i| [2.0 * f64::from(i), shift_m]);
        let spacing_m = |shift_m: f64| {
            let recording: Vec<usize> = (0..40).map(|i| i / 20).collect();
            LearningPositions::of_recordings(lane(0.0).chain(lane(shift_m)).collect(), &recording).spacing_m()
        };
        assert_eq!([0.1, 0.8, 5.0].map(spacing_m), [0.5, 0.8, 2.0]);
    }

    #[test]
    fn repeated_positions_do_not_shrink_the_spacing() {
        let held: Vec<PositionM> = (0..30).map(|i| [f64::from(i / 3) * 2.0, 0.0]).collect();
        assert_eq!(LearningPositions::new(held).spacing_m(), 2.0);
        assert_eq!(LearningPositions::new(vec![[1.0, 1.0]; 4]).spacing_m(), 0.0);
    }

    #[test]
    fn a_constant_feature_has_a_fit() {
        let (learning, _, _) = golden_gp();
        for value in [0.0, 0.7] {
            let fit = &fit_each(&learning, Mat::full(30, 1, value).as_ref(), &Bounds::PAPER, || {})[0];
            assert!(fit.hyperparameters.to_log().iter().all(|log| log.is_finite()), "{fit:?}");
        }
    }

    #[test]
    fn positions_on_a_line_have_a_fit() {
        let learning = LearningPositions::new((0..40).map(|i| [f64::from(i), 2.0]).collect());
        let z = Mat::from_fn(40, 1, |i, _| (i as f64 * 0.3).sin());
        let fit = &fit_each(&learning, z.as_ref(), &Bounds::PAPER, || {})[0];
        assert!(fit.log_likelihood.is_finite() && fit.hyperparameters.length_scale_m[0] > 1.0, "{fit:?}");
    }
}
