//! Features whose noise is white: the default recipe's scaling.
//!
//! Whitening (eq. 1 of the paper) makes the spread *over places* the identity, so that a direction in which all places
//! look alike counts as much as one that tells them apart. Here the noise *within a place* is made the identity
//! instead, and the directions that vary most over places, measured in that noise, become the features: Fisher's
//! discriminant (Rao 1948), with a Gaussian process as the model of what a place looks like.

use faer::linalg::triangular_solve::{solve_lower_triangular_in_place, solve_upper_triangular_in_place};
use faer::{Mat, MatRef, Par, Side};

use super::axes::{Axes, add_ridge};
use super::group::LearnError;
use crate::features::scaling::{Scaling, ScalingError};
use crate::gp::{GpError, Hyperparameters, LearningPositions, Posterior};
use crate::map::NoiseWhiteningSettings;
use crate::types::distance_m;

/// What is learned: the scaling, and one set of hyperparameters for all features.
#[derive(Debug, Clone)]
pub struct NoiseWhitening {
    pub scaling: Scaling,
    pub hyperparameters: Hyperparameters,
}

/// Noise-to-signal variance ratios that are tried: 2^−10, 2^−9.5, …, 2^2.5.
const LOG2_NOISE_RATIOS: std::ops::RangeInclusive<i32> = -20..=5;

/// Learns from `properties`, n × d, at `learning` positions, and `changes`, p × d: how the properties of learning images
/// changed under perturbations (none is allowed).
///
/// 1. Y = mean + P D Vᵀ (thin SVD); Z = P D, n × r.
/// 2. A Gaussian process with length scale ℓ = `length_scale_spacings` × the median spacing and noise ratio q for all
///    directions; q minimises the squared leave-one-out error |E|², E_i = \[R⁻¹Z\]_i / \[R⁻¹\]_ii.
/// 3. Noise covariance C = EᵀE/n + (ΔV)ᵀ(ΔV)/p + ridge · mean eigenvalue · I. Where a place was recorded several times,
///    E holds in place of the leave-one-out errors those of every recording under the Gaussian process of the others:
///    what another day changes, measured.
/// 4. Generalised eigenvectors g of ZᵀZ/n g = λ C g with gᵀ C g = 1, largest λ first; features z = gᵀ Vᵀ (y − mean).
/// 5. The predictive variance is scaled to 1 on average over the learning positions, as step 3 has it.
///
/// # Errors
/// As [`Scaling::learn`], and when a kernel matrix is not positive definite in floating point.
pub fn learn(
    settings: &NoiseWhiteningSettings,
    learning: &LearningPositions,
    properties: MatRef<f64>,
    changes: MatRef<f64>,
) -> Result<NoiseWhitening, LearnError> {
    let n = properties.nrows();
    if n < 2 {
        return Err(ScalingError::TooFewImages { rows: n }.into());
    }
    let axes = Axes::of(properties).ok_or(ScalingError::NoVariance { rows: n })?;
    let z = &axes.z;

    let length_m = (settings.length_scale_spacings * learning.spacing_m()).max(1e-6);
    let unit = Hyperparameters { signal_std: 1.0, noise_std: 0.0, length_scale_m: [length_m; 2] };
    let loo = leave_one_out(learning, z.as_ref(), &unit);

    let between = between_recordings(learning, z.as_ref(), &unit, loo.noise_ratio)?;
    let residual = between.as_ref().unwrap_or(&loo.residual);
    let mut noise = residual.transpose() * residual * (1.0 / residual.nrows() as f64);
    if changes.nrows() > 0 {
        noise += axes.covariance_of(changes);
    }
    add_ridge(&mut noise, settings.ridge);
    let signal = z.transpose() * z * (1.0 / n as f64);
    let directions =
        discriminant_directions(&signal, &noise, settings.features).ok_or(ScalingError::NoVariance { rows: n })?;
    let projection = (&axes.basis * directions).transpose().to_owned();
    let scale = 1.0 / loo.mean_variance;
    let hyperparameters = Hyperparameters {
        signal_std: scale.sqrt(),
        noise_std: (loo.noise_ratio * scale).sqrt(),
        length_scale_m: [length_m; 2],
    };
    Ok(NoiseWhitening { scaling: Scaling { mean: axes.mean, projection }, hyperparameters })
}

/// Fewer frames than this at places that several recordings saw say nothing about the change between them.
const MIN_SEEN_AGAIN: usize = 32;

/// Residuals of `z`, n × r, at positions within a length scale of another recording's, under the Gaussian process of all
/// other recordings: one row each. `None` where recordings hardly meet, or there is only one.
fn between_recordings(
    learning: &LearningPositions,
    z: MatRef<f64>,
    unit: &Hyperparameters,
    noise_ratio: f64,
) -> Result<Option<Mat<f64>>, GpError> {
    let (positions, recordings) = (learning.positions(), learning.recordings());
    let hyperparameters = Hyperparameters { noise_std: noise_ratio.sqrt(), ..*unit };
    let mut numbers = recordings.to_vec();
    numbers.sort_unstable();
    numbers.dedup();
    let mut residuals: Vec<Vec<f64>> = Vec::new();
    for &number in &numbers {
        let others: Vec<usize> = (0..learning.len()).filter(|&i| recordings[i] != number).collect();
        let near = |&i: &usize| {
            recordings[i] == number
                && others.iter().any(|&j| distance_m(positions[i], positions[j]) <= unit.length_scale_m[0])
        };
        let seen_again: Vec<usize> = (0..learning.len()).filter(near).collect();
        if seen_again.is_empty() {
            continue;
        }
        let elsewhen = LearningPositions::new(others.iter().map(|&j| positions[j]).collect());
        let observed = Mat::from_fn(others.len(), z.ncols(), |j, r| z[(others[j], r)]);
        let here: Vec<_> = seen_again.iter().map(|&i| positions[i]).collect();
        let predicted = Posterior::new(&elsewhen, observed.as_ref(), hyperparameters)?.predict(&here).mean;
        let row = |(at, &i): (usize, &usize)| (0..z.ncols()).map(|r| z[(i, r)] - predicted[(at, r)]).collect();
        residuals.extend(seen_again.iter().enumerate().map(row));
    }
    let enough = residuals.len() >= MIN_SEEN_AGAIN;
    Ok(enough.then(|| Mat::from_fn(residuals.len(), z.ncols(), |i, r| residuals[i][r])))
}

struct LeaveOneOut {
    noise_ratio: f64,
    /// E, n × r.
    residual: Mat<f64>,
    /// Mean of 1/\[R⁻¹\]_ii: the predictive variance at the learning positions, for unit signal variance.
    mean_variance: f64,
}

/// Leave-one-out residuals of all columns of `z` at the noise ratio that makes their sum of squares least.
fn leave_one_out(learning: &LearningPositions, z: MatRef<f64>, unit: &Hyperparameters) -> LeaveOneOut {
    let n = learning.len();
    let eigen = learning.correlation_eigen(unit);
    let rotated = eigen.vectors.transpose() * z;
    LOG2_NOISE_RATIOS
        .map(|half_log2| {
            let noise_ratio = 2.0_f64.powf(0.5 * f64::from(half_log2));
            let reciprocal: Vec<f64> = eigen.values.iter().map(|value| 1.0 / (value + noise_ratio)).collect();
            let variance: Vec<f64> = (0..n)
                .map(|i| 1.0 / (0..n).map(|k| eigen.vectors[(i, k)].powi(2) * reciprocal[k]).sum::<f64>())
                .collect();
            let scaled = Mat::from_fn(n, z.ncols(), |k, r| reciprocal[k] * rotated[(k, r)]);
            let weights = &eigen.vectors * scaled;
            let residual = Mat::from_fn(n, z.ncols(), |i, r| weights[(i, r)] * variance[i]);
            let mean_variance = variance.iter().sum::<f64>() / n as f64;
            LeaveOneOut { noise_ratio, residual, mean_variance }
        })
        .min_by(|a, b| a.residual.squared_norm_l2().total_cmp(&b.residual.squared_norm_l2()))
        .expect("ratios are tried")
}

/// The `count` generalised eigenvectors of largest λ of signal g = λ noise g, as columns with gᵀ noise g = 1; each one's
/// largest entry positive.
fn discriminant_directions(signal: &Mat<f64>, noise: &Mat<f64>, count: usize) -> Option<Mat<f64>> {
    let factor = noise.llt(Side::Lower).ok()?;
    // L⁻¹ S L⁻ᵀ, whose eigenvectors w give g = L⁻ᵀ w.
    let mut half = signal.clone();
    solve_lower_triangular_in_place(factor.L(), half.as_mut(), Par::Seq);
    let mut whitened = half.transpose().to_owned();
    solve_lower_triangular_in_place(factor.L(), whitened.as_mut(), Par::Seq);
    let eigen = whitened.self_adjoint_eigen(Side::Lower).ok()?;
    let rank = signal.nrows();
    let count = count.min(rank);
    // Eigenvalues come in rising order.
    let mut directions = Mat::from_fn(rank, count, |i, r| eigen.U()[(i, rank - 1 - r)]);
    solve_upper_triangular_in_place(factor.L().transpose(), directions.as_mut(), Par::Seq);
    for r in 0..count {
        let dominant = directions.col(r).iter().fold(0.0_f64, |most, &v| if v.abs() > most.abs() { v } else { most });
        directions.col_mut(r).iter_mut().for_each(|v| *v *= dominant.signum());
    }
    Some(directions)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// 60 positions on a line; property 0 follows the place, 1 is loud noise, 2 follows the place but changes from day
    /// to day, 3 is constant.
    fn drive() -> (LearningPositions, Mat<f64>, Mat<f64>) {
        let learning = LearningPositions::new((0..60).map(|i| [f64::from(i), 0.0]).collect());
        let noise = |i: usize, k: usize| ((i * 7919 + k * 104_729) as f64 * 12.9898).sin();
        let properties = Mat::from_fn(60, 4, |i, k| match k {
            0 => (0.15 * i as f64).sin() + 0.02 * noise(i, 0),
            1 => 5.0 * noise(i, 1),
            2 => (0.11 * i as f64).cos() + 0.02 * noise(i, 2),
            _ => 4.0,
        });
        let changes = Mat::from_fn(120, 4, |i, k| if k == 2 { 3.0 * noise(i, 9) } else { 0.0 });
        (learning, properties, changes)
    }

    const SETTINGS: NoiseWhiteningSettings =
        NoiseWhiteningSettings { features: 96, length_scale_spacings: 2.0, ridge: 0.05 };

    #[test]
    fn the_first_feature_tells_places_apart_and_days_do_not_move_it() {
        let (learning, properties, changes) = drive();
        let learned = learn(&SETTINGS, &learning, properties.as_ref(), changes.as_ref()).expect("varies");
        assert_eq!(learned.scaling.features(), 3);
        let first = |k: usize| learned.scaling.projection[(0, k)].abs();
        assert!(first(0) > 10.0 * first(1) && first(0) > 10.0 * first(2), "{:?}", learned.scaling.projection);
        let calm = learn(&SETTINGS, &learning, properties.as_ref(), Mat::zeros(0, 4).as_ref()).expect("varies");
        let strength = |scaling: &Scaling, k: usize| (0..2).map(|r| scaling.projection[(r, k)].powi(2)).sum::<f64>();
        assert!(strength(&calm.scaling, 2) > 10.0 * strength(&learned.scaling, 2));
    }

    /// Property 2 is another on another day; one drive cannot know, two can.
    #[test]
    fn what_changed_between_two_recordings_is_trusted_less() {
        let (_, properties, _) = drive();
        let positions = || (0..120).map(|i| [f64::from(i / 2), 0.3 * f64::from(i % 2)]).collect();
        let both = Mat::from_fn(120, 4, |i, k| match (k, i % 2) {
            (2, 1) => 3.0 * (0.4 * i as f64).sin(),
            _ => properties[(i / 2, k)],
        });
        let day: Vec<usize> = (0..120).map(|i| i % 2).collect();
        let two = LearningPositions::of_recordings(positions(), &day);
        let none = Mat::zeros(0, 4);
        let learned = learn(&SETTINGS, &two, both.as_ref(), none.as_ref()).expect("varies");
        let first = |k: usize| learned.scaling.projection[(0, k)].abs();
        assert!(first(0) > 10.0 * first(2), "{:?}", learned.scaling.projection);
        // Residuals are those under the other recording's Gaussian process, and recordings that never meet have none.
        let unit = Hyperparameters { signal_std: 1.0, noise_std: 0.0, length_scale_m: [2.0; 2] };
        let residual = between_recordings(&two, both.as_ref(), &unit, 0.1).expect("positive definite").expect("two");
        assert_eq!((residual.nrows(), residual.ncols()), (120, 4));
        let change = |k: usize| residual.col(k).iter().map(|v| v * v).sum::<f64>() / 120.0;
        assert!(change(2) > 30.0 * change(0), "{} {}", change(2), change(0));
        let apart: Vec<_> = (0..120).map(|i| [f64::from(i / 2), 90.0 * f64::from(i % 2)]).collect();
        let apart = LearningPositions::of_recordings(apart, &day);
        assert!(between_recordings(&apart, both.as_ref(), &unit, 0.1).expect("positive definite").is_none());
    }

    #[test]
    fn leave_one_out_equals_that_of_the_posterior() {
        let (learning, properties, _) = drive();
        let unit = Hyperparameters { signal_std: 1.0, noise_std: 0.0, length_scale_m: [2.0; 2] };
        let loo = leave_one_out(&learning, properties.as_ref(), &unit);
        let hyperparameters = Hyperparameters { noise_std: loo.noise_ratio.sqrt(), ..unit };
        let posterior =
            crate::gp::Posterior::new(&learning, properties.as_ref(), hyperparameters).expect("positive definite");
        let (residual, variance) = posterior.leave_one_out();
        assert!((&residual - &loo.residual).norm_max() < 1e-8);
        assert!((variance.iter().sum::<f64>() / 60.0 - loo.mean_variance).abs() < 1e-8);
    }

    #[test]
    fn directions_are_of_unit_noise_and_uncorrelated() {
        let noise = Mat::from_fn(3, 3, |i, j| if i == j { 2.0 + i as f64 } else { 0.5 });
        let signal = Mat::from_fn(3, 3, |i, j| ((i + 1) * (j + 1)) as f64 + if i == j { 1.0 } else { 0.0 });
        let directions = discriminant_directions(&signal, &noise, 3).expect("positive definite");
        let white = directions.transpose() * &noise * &directions;
        let diagonal = directions.transpose() * &signal * &directions;
        for r in 0..3 {
            for s in 0..3 {
                assert!((white[(r, s)] - f64::from(u8::from(r == s))).abs() < 1e-9);
                assert!(r == s || diagonal[(r, s)].abs() < 1e-9);
            }
        }
        assert!(diagonal[(0, 0)] > diagonal[(1, 1)] && diagonal[(1, 1)] > diagonal[(2, 2)]);
    }
}
