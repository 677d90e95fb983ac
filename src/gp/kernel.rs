//! The covariance function and its hyperparameters.

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
