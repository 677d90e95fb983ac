//! The covariance function and its hyperparameters.

use multiversion::multiversion;
use serde::{Deserialize, Serialize};

use crate::types::PositionM;

/// Hyperparameters of one Gaussian process, θ = (σ_f, σ_e, ℓ_1, ℓ_2) > 0. The standard deviations are in units of the
/// feature.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Hyperparameters {
    pub signal_std: f64,
    pub noise_std: f64,
    /// East and north.
    pub length_scale_m: [f64; 2],
}

impl Hyperparameters {
    /// (log σ_f, log σ_e, log ℓ_1, log ℓ_2): what the optimiser moves.
    pub fn to_log(self) -> [f64; 4] {
        [self.signal_std.ln(), self.noise_std.ln(), self.length_scale_m[0].ln(), self.length_scale_m[1].ln()]
    }

    pub fn from_log(log: [f64; 4]) -> Self {
        let [signal_std, noise_std, l1, l2] = log.map(f64::exp);
        Self { signal_std, noise_std, length_scale_m: [l1, l2] }
    }
}

/// Squared-exponential covariance, one length scale an axis (ARD), without the noise term: Do et al. (2015), eq. 2;
/// Rasmussen & Williams (2006), eq. 5.1 with M₂ of eq. 5.2.
///
/// ```text
/// k(a, b) = σ_f² exp(−½ Σᵢ (aᵢ − bᵢ)² / ℓᵢ²)
/// ```
pub fn squared_exponential(a: PositionM, b: PositionM, hyperparameters: &Hyperparameters) -> f64 {
    let r2: f64 = (0..2).map(|i| ((a[i] - b[i]) / hyperparameters.length_scale_m[i]).powi(2)).sum();
    hyperparameters.signal_std.powi(2) * (-0.5 * r2).exp()
}

/// σ_f² exp(−½ Σᵢ dᵢ / ℓᵢ²) of squared distances d₁, d₂ \[m²\] on either axis: [`squared_exponential`] of a whole column.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2+fma"))]
pub(super) fn covariances(d1: &[f64], d2: &[f64], hyperparameters: &Hyperparameters, covariances: &mut [f64]) {
    let variance = hyperparameters.signal_std.powi(2);
    let [w1, w2] = hyperparameters.length_scale_m.map(|length_m| -0.5 / (length_m * length_m));
    for (covariance, (d1, d2)) in covariances.iter_mut().zip(d1.iter().zip(d2)) {
        *covariance = variance * exp_of_negative(w1 * d1 + w2 * d2);
    }
}

/// eˣ for x ≤ 0 to 2 units in the last place, and 0 below −700, where the kernel is nothing beside any noise. Written
/// without calls and branches, so that several are computed at once.
///
/// ```text
/// x = k ln 2 + r,  k whole, |r| ≤ ½ ln 2        eˣ = 2ᵏ Σ rⁱ / i!,  i = 0 … 13
/// ```
#[inline(always)]
fn exp_of_negative(x: f64) -> f64 {
    const LEAST: f64 = -700.0;
    /// ln 2 in two parts; the first has so few digits that its product with k is exact.
    const LN_2_HIGH: f64 = 6.931_471_803_691_238e-1;
    const LN_2_LOW: f64 = 1.908_214_929_270_587_7e-10;
    /// Adding 1.5 · 2⁵² rounds to a whole number, which is then found in the lowest bits.
    const ROUND: f64 = 6_755_399_441_055_744.0;
    const EXPONENT_BIAS: u64 = 1023;
    const MANTISSA_BITS: u32 = 52;
    // Not `max`, which would hide that x is no number.
    let clamped = if x < LEAST { LEAST } else { x };
    let shifted = clamped * std::f64::consts::LOG2_E + ROUND;
    let k = shifted - ROUND;
    let r = clamped - k * LN_2_HIGH - k * LN_2_LOW;
    let mut series = INVERSE_FACTORIALS[0];
    for coefficient in &INVERSE_FACTORIALS[1..] {
        series = series * r + coefficient;
    }
    let power = f64::from_bits(shifted.to_bits().wrapping_add(EXPONENT_BIAS) << MANTISSA_BITS);
    if x < LEAST { 0.0 } else { series * power }
}

/// 1/13!, 1/12!, …, 1/0!.
const INVERSE_FACTORIALS: [f64; 14] = {
    let mut inverse = [1.0; 14];
    let (mut i, mut factorial) = (1, 1.0);
    while i < 14 {
        factorial *= i as f64;
        inverse[13 - i] = 1.0 / factorial;
        i += 1;
    }
    inverse
};

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exponential_equals_the_library_s() {
        for i in 0..=70_000 {
            let x = -0.01 * f64::from(i) * (1.0 - 1e-7 * f64::from(i));
            let (found, expected) = (exp_of_negative(x), x.exp());
            assert!((found - expected).abs() <= 4.5e-16 * expected, "exp({x}) = {expected}, not {found}");
        }
        assert_eq!((exp_of_negative(0.0), exp_of_negative(-1e9), exp_of_negative(f64::NEG_INFINITY)), (1.0, 0.0, 0.0));
        assert!(exp_of_negative(f64::NAN).is_nan());
    }

    #[test]
    fn a_column_equals_its_entries() {
        let hyperparameters = Hyperparameters { signal_std: 1.3, noise_std: 0.0, length_scale_m: [2.0, 0.7] };
        let d: Vec<f64> = (0..21).map(|i| 0.3 * f64::from(i)).collect();
        let mut column = vec![0.0; d.len()];
        covariances(&d, &d, &hyperparameters, &mut column);
        for (d, found) in d.iter().zip(column) {
            let expected = squared_exponential([d.sqrt(), 0.0], [0.0, d.sqrt()], &hyperparameters);
            assert!((found / expected - 1.0).abs() < 1e-14, "{found} instead of {expected}");
        }
    }
}
