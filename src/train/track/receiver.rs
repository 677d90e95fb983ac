//! How far off a receiver is, by how its error changes over a drive whose shape images have shown.
//!
//! But for their mean, which no image shows, points and passes tell the errors b of a recording to a decimetre. They may be of
//! Gauss-Markov processes of many deviations σ and correlation times τ: a drive lasts a few correlation times only. Each
//! counts by its likelihood, the mean integrated out, and what is known of receivers beforehand:
//!
//! ```text
//! −2 log L = log |C| + log 1ᵀC⁻¹1 + bᵀC⁻¹b − (1ᵀC⁻¹b)² / 1ᵀC⁻¹1            C_ij = σ² exp(−|t_i − t_j| / τ) + ε² δ_ij
//! ```
//!
//! for either axis. What matters is how far off the mean may be, of which the variance over a drive of length T is
//!
//! ```text
//! V = σ² v(τ)                  v(τ) = 2 τ/T (1 − τ/T (1 − exp(−T/τ)))
//! ```
//!
//! Found are the mean logarithm of τ, and the σ at which V is what it is on average.

use faer::linalg::solvers::Solve;
use faer::{Mat, Side};

/// Deviation and correlation time of a receiver's error on either axis.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Receiver {
    pub std_m: f64,
    pub time_s: f64,
}

/// Errors are looked at so far apart, or further in a long drive \[s\].
const APART_S: f64 = 4.0;
const MOST_SAMPLES: usize = 80;
const FEWEST_SAMPLES: usize = 8;
/// What the errors are known to, but for their mean \[m\].
const KNOWN_TO_M: f64 = 0.1;
/// Logarithms of what receivers do beforehand: deviations of 0.3 to 1.2 m, correlation times of 20 to 80 s are usual.
const USUAL: Receiver = Receiver { std_m: 0.6, time_s: 40.0 };
const USUAL_LOG_STD: f64 = 0.7;
/// What is tried: factors of the usual deviation in fourths and of the usual time in halves of a power of 2.
const STD_QUARTERS: std::ops::RangeInclusive<i32> = -16..=12;
const TIME_HALVES: std::ops::RangeInclusive<i32> = -6..=6;

impl Receiver {
    /// Variance of the mean over a drive of this length, of unit variance at any instant.
    fn of_mean(time_s: f64, drive_s: f64) -> f64 {
        let share = time_s / drive_s.max(1e-3);
        2.0 * share * (1.0 - share * (1.0 - (-1.0 / share).exp()))
    }

    /// By the errors of a drive at rising times; `None` where there are too few.
    pub fn of_errors(time_s: &[f64], error_m: &[[f64; 2]]) -> Option<Self> {
        let drive_s = time_s.last()? - time_s.first()?;
        let apart_s = APART_S.max(drive_s / MOST_SAMPLES as f64);
        let mut rows: Vec<usize> = Vec::new();
        for (row, &at_s) in time_s.iter().enumerate() {
            if rows.last().is_none_or(|&last| at_s - time_s[last] >= apart_s) {
                rows.push(row);
            }
        }
        if rows.len() < FEWEST_SAMPLES {
            return None;
        }
        let at_s: Vec<f64> = rows.iter().map(|&row| time_s[row]).collect();
        let b = Mat::from_fn(rows.len(), 3, |i, k| if k < 2 { error_m[rows[i]][k] } else { 1.0 });
        let mut tried = Vec::new();
        for quarters in STD_QUARTERS {
            for halves in TIME_HALVES {
                let factors = [0.25 * f64::from(quarters), 0.5 * f64::from(halves)].map(f64::exp2);
                let receiver = Self { std_m: USUAL.std_m * factors[0], time_s: USUAL.time_s * factors[1] };
                let unusual = factors.iter().map(|factor| (factor.ln() / USUAL_LOG_STD).powi(2)).sum::<f64>();
                tried.push((receiver, -0.5 * (receiver.misfit(&at_s, &b)? + unusual)));
            }
        }
        let best = tried.iter().map(|(_, log)| *log).fold(f64::NEG_INFINITY, f64::max);
        let weighed: Vec<(Self, f64)> =
            tried.into_iter().map(|(receiver, log)| (receiver, (log - best).exp())).collect();
        let total: f64 = weighed.iter().map(|(_, weight)| weight).sum();
        let mean = |of: &dyn Fn(&Self) -> f64| weighed.iter().map(|(r, weight)| weight * of(r)).sum::<f64>() / total;
        let time_s = mean(&|receiver| receiver.time_s.ln()).exp();
        let variance_m2 = mean(&|receiver| receiver.std_m.powi(2) * Self::of_mean(receiver.time_s, drive_s));
        Some(Self { std_m: (variance_m2 / Self::of_mean(time_s, drive_s)).sqrt(), time_s })
    }

    /// −2 log L of both axes, the first columns of `b`; the third one is of ones.
    fn misfit(&self, at_s: &[f64], b: &Mat<f64>) -> Option<f64> {
        let n = at_s.len();
        let covariance = Mat::from_fn(n, n, |i, j| {
            let known_to_m2 = if i == j { KNOWN_TO_M.powi(2) } else { 0.0 };
            self.std_m.powi(2) * (-(at_s[i] - at_s[j]).abs() / self.time_s).exp() + known_to_m2
        });
        let factor = covariance.llt(Side::Lower).ok()?;
        let products = b.transpose() * factor.solve(b);
        let log_determinant = 2.0 * (0..n).map(|i| factor.L()[(i, i)].ln()).sum::<f64>();
        let ones = products[(2, 2)];
        let of_axis = |axis: usize| products[(axis, axis)] - products[(axis, 2)].powi(2) / ones;
        Some(2.0 * (log_determinant + ones.ln()) + of_axis(0) + of_axis(1))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::train::perturbation::standard_normal;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    /// Many drives of three minutes with receivers that err by 0.6 m, alike for 20 or 60 s, known but for the mean: its square is
    /// three quarters of what is thought, drive by drive. That is the price of not knowing σ and τ.
    #[test]
    fn a_mean_error_is_thought_as_large_as_it_is_or_a_little_larger() {
        let mut random = ChaCha8Rng::seed_from_u64(1);
        let mut normal = || f64::from(standard_normal(&mut random));
        let (mut ratios, drives) = (0.0, 60);
        for drive in 0..drives {
            let correlation_s = if drive % 2 == 0 { 20.0 } else { 60.0 };
            let time_s: Vec<f64> = (0..360).map(|i| 0.5 * f64::from(i)).collect();
            let kept = (-0.5_f64 / correlation_s).exp();
            let mut error_m = vec![[0.6 * normal(), 0.6 * normal()]];
            for i in 1..time_s.len() {
                let before: [f64; 2] = error_m[i - 1];
                error_m.push(before.map(|b| kept * b + 0.6 * (1.0 - kept * kept).sqrt() * normal()));
            }
            let mean_m = [0, 1].map(|k| error_m.iter().map(|b| b[k]).sum::<f64>() / time_s.len() as f64);
            let known_m: Vec<[f64; 2]> =
                error_m.iter().map(|b| [0, 1].map(|k| b[k] - mean_m[k] + 0.05 * normal())).collect();
            let found = Receiver::of_errors(&time_s, &known_m).expect("enough errors");
            assert!((0.1..3.0).contains(&found.std_m), "{found:?}");
            let thought_m2 = 2.0 * found.std_m.powi(2) * Receiver::of_mean(found.time_s, 179.5);
            ratios += (mean_m[0].powi(2) + mean_m[1].powi(2)) / thought_m2;
        }
        let ratio = ratios / f64::from(drives);
        assert!((0.5..1.1).contains(&ratio), "{ratio}");
    }

    #[test]
    fn errors_of_centimetres_are_not_taken_for_half_a_metre() {
        let time_s: Vec<f64> = (0..300).map(f64::from).collect();
        let error_m: Vec<[f64; 2]> = time_s.iter().map(|t| [0.02 * (0.3 * t).sin(), 0.02 * (0.2 * t).cos()]).collect();
        let found = Receiver::of_errors(&time_s, &error_m).expect("enough errors");
        assert!(found.std_m < 0.25, "{found:?}");
        assert_eq!(Receiver::of_errors(&time_s[..20], &error_m[..20]), None);
    }

    #[test]
    fn the_variance_of_a_mean_has_its_limits() {
        assert!((Receiver::of_mean(1e6, 1.0) - 1.0).abs() < 1e-3, "a drive that is short beside the time");
        assert!((Receiver::of_mean(1.0, 1e3) - 2e-3).abs() < 1e-5, "and one that is long");
    }
}
