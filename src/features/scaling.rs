//! Properties → features: whitening and z-score, both as one affine map z = W (y − μ).

use faer::linalg::solvers::Svd;
use faer::{Mat, MatRef};
use serde::{Deserialize, Serialize};

/// How properties become features.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ScalingMethod {
    /// Rotated to the principal directions and scaled to unit variance: Do et al. (2015), eq. 1.
    Whitening,
    /// Every property scaled to unit variance on its own.
    ZScore,
}

/// z = W (y − μ): k features from d properties.
#[derive(Debug, Clone)]
pub struct Scaling {
    /// μ, d.
    pub mean: Vec<f64>,
    /// W, k × d.
    pub projection: Mat<f64>,
}

/// Directions whose variance is below this share of the largest are null: rounding, not signal.
const NULL_VARIANCE_RATIO: f64 = 1e-10;

#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum ScalingError {
    #[error("{rows} learning images are too few to scale properties: at least 2 are needed")]
    TooFewImages { rows: usize },
    #[error("all {rows} learning images have the same properties: nothing can be learned from them")]
    NoVariance { rows: usize },
    #[error("property {column} of learning image {row} is not a finite number")]
    NotFinite { row: usize, column: usize },
}

impl Scaling {
    /// Learns the scaling from `properties`, n × d.
    ///
    /// # Errors
    /// When there is nothing to learn from: one image only, or no property that varies.
    pub fn learn(method: ScalingMethod, properties: MatRef<f64>) -> Result<Self, ScalingError> {
        let (n, d) = (properties.nrows(), properties.ncols());
        if n < 2 {
            return Err(ScalingError::TooFewImages { rows: n });
        }
        let finite = |&(row, column): &(usize, usize)| properties[(row, column)].is_finite();
        if let Some((row, column)) = (0..n).flat_map(|i| (0..d).map(move |k| (i, k))).find(|at| !finite(at)) {
            return Err(ScalingError::NotFinite { row, column });
        }
        let mean: Vec<f64> = (0..d).map(|k| properties.col(k).iter().sum::<f64>() / n as f64).collect();
        let centered = Mat::from_fn(n, d, |i, k| properties[(i, k)] - mean[k]);
        let projection = match method {
            ScalingMethod::Whitening => whitening(&centered),
            ScalingMethod::ZScore => z_score(&centered),
        };
        match projection {
            Some(projection) => Ok(Self { mean, projection }),
            None => Err(ScalingError::NoVariance { rows: n }),
        }
    }

    /// Number of properties d.
    pub fn properties(&self) -> usize {
        self.mean.len()
    }

    /// Number of features k: the rank of the properties.
    pub fn features(&self) -> usize {
        self.projection.nrows()
    }

    /// Features of `properties`, n × d → n × k.
    pub fn apply(&self, properties: MatRef<f64>) -> Mat<f64> {
        let centered = Mat::from_fn(properties.nrows(), self.properties(), |i, k| properties[(i, k)] - self.mean[k]);
        centered * self.projection.transpose()
    }

    /// The same scaling, of the features `kept` only.
    pub fn select(&self, kept: &[usize]) -> Self {
        let projection = Mat::from_fn(kept.len(), self.properties(), |r, k| self.projection[(kept[r], k)]);
        Self { mean: self.mean.clone(), projection }
    }
}

/// W = S^(−½) Uᵀ of the covariance U S Uᵀ, from the thin singular value decomposition of the centred n × d matrix
/// A = P D Vᵀ: S = D²/(n − 1), U = V. Rows are ordered by falling variance; null directions are left out; each
/// direction's largest entry is positive, so that the result does not depend on the decomposition's signs.
fn whitening(centered: &Mat<f64>) -> Option<Mat<f64>> {
    let (n, d) = (centered.nrows(), centered.ncols());
    let svd = Svd::new_thin(centered.as_ref()).ok()?;
    let variances: Vec<f64> = svd.S().column_vector().iter().map(|s| s * s / (n - 1) as f64).collect();
    let largest = variances.first().copied().filter(|&variance| variance > 0.0)?;
    let rank = variances.iter().take_while(|&&variance| variance > NULL_VARIANCE_RATIO * largest).count();
    let directions = svd.V();
    Some(Mat::from_fn(rank, d, |r, k| {
        let direction = directions.col(r);
        let dominant =
            direction.iter().fold(0.0_f64, |dominant, &v| if v.abs() > dominant.abs() { v } else { dominant });
        direction[k] * dominant.signum() / variances[r].sqrt()
    }))
}

/// One row a property that varies: 1/σ_k at its place.
fn z_score(centered: &Mat<f64>) -> Option<Mat<f64>> {
    let (n, d) = (centered.nrows(), centered.ncols());
    let variances: Vec<f64> =
        (0..d).map(|k| centered.col(k).iter().map(|v| v * v).sum::<f64>() / (n - 1) as f64).collect();
    let largest = variances.iter().copied().fold(0.0, f64::max);
    let varying: Vec<usize> = (0..d).filter(|&k| variances[k] > NULL_VARIANCE_RATIO * largest).collect();
    let row = |r: usize, k: usize| if varying[r] == k { 1.0 / variances[k].sqrt() } else { 0.0 };
    (!varying.is_empty()).then(|| Mat::from_fn(varying.len(), d, row))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::golden::{golden, list};

    fn golden_properties() -> Mat<f64> {
        Mat::from_fn(12, 4, |i, k| {
            let (i, k) = (i as f64, k as f64);
            (k + 1.0) * (1.3 * i + 2.1 * k).sin() + 0.3 * (3.7 * i * (k + 1.0)).cos()
        })
    }

    #[test]
    fn whitening_equals_the_reference_values() {
        let properties = golden_properties();
        let scaling = Scaling::learn(ScalingMethod::Whitening, properties.as_ref()).expect("full rank");
        let whitening = &golden()["whitening"];
        for (found, expected) in scaling.mean.iter().zip(list(&whitening["mu"])) {
            assert!((found / expected - 1.0).abs() < 1e-6);
        }
        let rows = whitening["W"].as_array().expect("rows");
        assert_eq!(scaling.features(), rows.len());
        for (r, row) in rows.iter().enumerate() {
            for (k, expected) in list(row).iter().enumerate() {
                let found = scaling.projection[(r, k)];
                assert!((found / expected - 1.0).abs() < 1e-6, "W[{r}][{k}]: {found} instead of {expected}");
            }
        }
        let z = scaling.apply(properties.as_ref());
        for (k, expected) in list(&whitening["z0"]).iter().enumerate() {
            assert!((z[(0, k)] / expected - 1.0).abs() < 1e-6);
        }
        for (r, s) in list(&whitening["s"]).iter().enumerate() {
            let variance: f64 = 1.0 / (0..4).map(|k| scaling.projection[(r, k)].powi(2)).sum::<f64>();
            assert!((variance / s - 1.0).abs() < 1e-6);
        }
    }

    #[test]
    fn dependent_and_constant_properties_lower_the_rank() {
        let base = golden_properties();
        let dependent = Mat::from_fn(12, 6, |i, k| match k {
            4 => base[(i, 0)] + 2.0 * base[(i, 2)],
            5 => 7.0,
            k => base[(i, k)],
        });
        let scaling = Scaling::learn(ScalingMethod::Whitening, dependent.as_ref()).expect("some variance");
        let expected = golden()["whitening"]["rank_with_dependent_column"].as_u64().expect("a number");
        assert_eq!(scaling.features() as u64, expected);
        assert_eq!(Scaling::learn(ScalingMethod::ZScore, dependent.as_ref()).expect("some variance").features(), 5);
    }

    #[test]
    fn learning_features_are_uncorrelated_with_unit_variance() {
        let properties = golden_properties();
        let scaling = Scaling::learn(ScalingMethod::Whitening, properties.as_ref()).expect("full rank");
        let z = scaling.apply(properties.as_ref());
        let covariance = z.transpose() * &z;
        for r in 0..4 {
            for s in 0..4 {
                let expected = if r == s { 11.0 } else { 0.0 };
                assert!((covariance[(r, s)] - expected).abs() < 1e-9);
            }
        }
    }

    #[test]
    fn nothing_to_learn_is_an_error() {
        let same = Mat::from_fn(5, 3, |_, k| k as f64);
        let single = Mat::from_fn(1, 3, |_, k| k as f64);
        let infinite = Mat::from_fn(3, 3, |i, k| if (i, k) == (1, 2) { f64::NAN } else { (i * k) as f64 });
        for method in [ScalingMethod::Whitening, ScalingMethod::ZScore] {
            assert_eq!(Scaling::learn(method, same.as_ref()).err(), Some(ScalingError::NoVariance { rows: 5 }));
            assert_eq!(Scaling::learn(method, single.as_ref()).err(), Some(ScalingError::TooFewImages { rows: 1 }));
            let error = Scaling::learn(method, infinite.as_ref()).err();
            assert_eq!(error, Some(ScalingError::NotFinite { row: 1, column: 2 }));
        }
    }
}
