//! The directions in which images of a survey vary, and the ridge on what perturbs them: what the learning of features
//! and the comparison of images have in common.

use faer::linalg::solvers::Svd;
use faer::{Mat, MatRef};

/// Directions whose singular value is below this share of the largest are null.
const NULL_SINGULAR_RATIO: f64 = 1e-5;

/// Y = mean + Z Vᵀ: the thin singular value decomposition without its null directions.
#[derive(Debug, Clone)]
pub struct Axes {
    /// d.
    pub mean: Vec<f64>,
    /// V, d × r.
    pub basis: Mat<f64>,
    /// Z, n × r.
    pub z: Mat<f64>,
}

impl Axes {
    /// Of properties, n × d. `None` where nothing varies.
    pub fn of(properties: MatRef<f64>) -> Option<Self> {
        let (n, d) = (properties.nrows(), properties.ncols());
        let mean: Vec<f64> = (0..d).map(|k| properties.col(k).iter().sum::<f64>() / n as f64).collect();
        let centered = Mat::from_fn(n, d, |i, k| properties[(i, k)] - mean[k]);
        let svd = Svd::new_thin(centered.as_ref()).ok()?;
        let singular: Vec<f64> = svd.S().column_vector().iter().copied().collect();
        let largest = singular.first().copied().unwrap_or(0.0);
        let rank = singular.iter().take_while(|&&s| s > NULL_SINGULAR_RATIO * largest).count();
        let z = Mat::from_fn(n, rank, |i, r| svd.U()[(i, r)] * singular[r]);
        (rank > 0).then(|| Self { mean, basis: svd.V().subcols(0, rank).to_owned(), z })
    }

    /// (Δ V)ᵀ (Δ V) / p of changes Δ of properties, p × d with p ≥ 1: r × r.
    pub fn covariance_of(&self, changes: MatRef<f64>) -> Mat<f64> {
        let projected = changes * &self.basis;
        projected.transpose() * &projected * (1.0 / changes.nrows() as f64)
    }
}

/// Adds `ridge` × the mean eigenvalue to the diagonal, so that no direction counts as free of noise.
pub fn add_ridge(covariance: &mut Mat<f64>, ridge: f64) {
    let rank = covariance.nrows();
    let mean_eigenvalue = (0..rank).map(|r| covariance[(r, r)]).sum::<f64>() / rank as f64;
    (0..rank).for_each(|r| covariance[(r, r)] += ridge * mean_eigenvalue + f64::MIN_POSITIVE);
}
