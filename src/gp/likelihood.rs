//! The log marginal likelihood and its gradient.

use faer::Mat;
use faer::linalg::solvers::{DenseSolveCore, Solve};
use multiversion::multiversion;

use super::{GpError, Hyperparameters, LearningPositions, factorize_with_noise};

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
    likelihood_and_gradient(learning, z, hyperparameters).map(|(likelihood, _)| likelihood)
}

/// L(θ) and its gradient with respect to the logarithms (log σ_f, log σ_e, log ℓ_1, log ℓ_2).
pub fn likelihood_and_gradient(
    learning: &LearningPositions,
    z: &[f64],
    hyperparameters: &Hyperparameters,
) -> Result<(f64, [f64; 4]), GpError> {
    let noise_ratio = (hyperparameters.noise_std / hyperparameters.signal_std).powi(2);
    let terms = Terms::new(learning, z, hyperparameters.length_scale_m, noise_ratio)
        .ok_or(GpError::NotPositiveDefinite { points: learning.len(), hyperparameters: *hyperparameters })?;
    let signal_variance = hyperparameters.signal_std.powi(2);
    Ok((terms.likelihood(signal_variance), terms.gradient(signal_variance)))
}

/// What the likelihood of z is made of for given length scales and noise ratio ρ = σ_e²/σ_f², whatever the signal
/// variance. With the correlation matrix C = K/σ_f², A = C + ρ I = R/σ_f², b = A⁻¹ z and M = A⁻¹ − b bᵀ/σ_f²,
///
/// ```text
/// L = −½ zᵀb/σ_f² − ½ log|A| − n/2 log σ_f² − n/2 log 2π
/// ∂L/∂log σ_f = −tr M C        ∂L/∂log σ_e = −ρ tr M        ∂L/∂log ℓ_k = −½ Σ_ij M_ij C_ij (s_ik − s_jk)² / ℓ_k²
/// ```
///
/// (Rasmussen & Williams 2006, eq. 5.9), where C = A − ρ I saves the first sum.
pub(super) struct Terms {
    n: f64,
    noise_ratio: f64,
    log_determinant: f64,
    /// zᵀb and bᵀb.
    zb: f64,
    bb: f64,
    /// tr A⁻¹.
    trace: f64,
    /// Σ_ij X_ij C_ij (s_ik − s_jk)² / ℓ_k² for X = A⁻¹ and X = b bᵀ, each for both axes.
    by_length: [[f64; 2]; 2],
}

impl Terms {
    /// `None` where A is not positive definite in floating point.
    pub fn new(learning: &LearningPositions, z: &[f64], length_scale_m: [f64; 2], noise_ratio: f64) -> Option<Self> {
        let n = learning.len();
        let unit = Hyperparameters { signal_std: 1.0, noise_std: noise_ratio.sqrt(), length_scale_m };
        let correlation = learning.kernel_matrix(&unit);
        let factor = factorize_with_noise(correlation.clone(), noise_ratio)?;
        let b = factor.solve(&Mat::from_fn(n, 1, |i, _| z[i]));
        let b = b.col_as_slice(0);
        let inverse = factor.inverse();
        let [d1, d2] = &learning.squared_distance_m2;
        let mut by_length = [[0.0; 2]; 2];
        for j in 0..n {
            // Below the diagonal, where the distance is none: the matrices are symmetric.
            let [inverse, correlation, d1, d2] =
                [&inverse, &correlation, d1, d2].map(|matrix| &matrix.col_as_slice(j)[j + 1..]);
            let sums = column_sums(inverse, &b[j + 1..], correlation, d1, d2);
            for axis in [0, 1] {
                let per_square = 2.0 / length_scale_m[axis].powi(2);
                by_length[0][axis] += per_square * sums[axis];
                by_length[1][axis] += per_square * b[j] * sums[2 + axis];
            }
        }
        Some(Self {
            n: n as f64,
            noise_ratio,
            log_determinant: 2.0 * factor.L().diagonal().column_vector().iter().map(|d| d.ln()).sum::<f64>(),
            zb: z.iter().zip(b).map(|(z, b)| z * b).sum(),
            bb: b.iter().map(|b| b * b).sum(),
            trace: (0..n).map(|i| inverse[(i, i)]).sum(),
            by_length,
        })
    }

    /// The signal variance of greatest likelihood: zᵀb/n.
    pub fn best_signal_variance(&self) -> f64 {
        self.zb / self.n
    }

    pub fn likelihood(&self, signal_variance: f64) -> f64 {
        let scale = self.n * (signal_variance * std::f64::consts::TAU).ln();
        -0.5 * (self.zb / signal_variance + self.log_determinant + scale)
    }

    /// With respect to (log σ_f, log σ_e, log ℓ_1, log ℓ_2).
    pub fn gradient(&self, signal_variance: f64) -> [f64; 4] {
        let noise = self.noise_ratio * (self.trace - self.bb / signal_variance);
        let both = self.n - self.zb / signal_variance;
        let [inverse, outer] = self.by_length;
        let length = |axis: usize| -0.5 * (inverse[axis] - outer[axis] / signal_variance);
        [noise - both, -noise, length(0), length(1)]
    }
}

/// Σ A⁻¹_i C_i d1_i, Σ A⁻¹_i C_i d2_i, Σ b_i C_i d1_i and Σ b_i C_i d2_i over the rows i of a column.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2+fma"))]
fn column_sums(inverse: &[f64], b: &[f64], correlation: &[f64], d1: &[f64], d2: &[f64]) -> [f64; 4] {
    // One sum a lane: sums in order could not be taken several at once.
    const LANES: usize = 8;
    let mut lanes = [[0.0; LANES]; 4];
    let n = inverse.len();
    let whole = n - n % LANES;
    for first in (0..whole).step_by(LANES) {
        let next = |values: &[f64]| -> [f64; LANES] { std::array::from_fn(|lane| values[first..first + LANES][lane]) };
        let (inverse, b, correlation, d1, d2) = (next(inverse), next(b), next(correlation), next(d1), next(d2));
        for lane in 0..LANES {
            let (c1, c2) = (correlation[lane] * d1[lane], correlation[lane] * d2[lane]);
            lanes[0][lane] += inverse[lane] * c1;
            lanes[1][lane] += inverse[lane] * c2;
            lanes[2][lane] += b[lane] * c1;
            lanes[3][lane] += b[lane] * c2;
        }
    }
    for i in whole..n {
        let (c1, c2) = (correlation[i] * d1[i], correlation[i] * d2[i]);
        lanes[0][0] += inverse[i] * c1;
        lanes[1][0] += inverse[i] * c2;
        lanes[2][0] += b[i] * c1;
        lanes[3][0] += b[i] * c2;
    }
    lanes.map(|lanes| lanes.iter().sum())
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
}
