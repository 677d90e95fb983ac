//! One descriptor, learned: scaling, Gaussian processes, and their values on the candidate cells.

use faer::{Mat, MatRef};
use rayon::prelude::*;

use super::noise_whitening;
use crate::features::scaling::{Scaling, ScalingError};
use crate::gp::fit::fit_each;
use crate::gp::{GpError, Hyperparameters, LearningPositions, Posterior};
use crate::localize::FieldOnCells;
use crate::map::{GroupHyperparameters, GroupRecipe, Model};
use crate::types::PositionM;

/// What was learned of one descriptor's k features.
#[derive(Debug, Clone)]
pub struct LearnedGroup {
    pub recipe: GroupRecipe,
    pub scaling: Scaling,
    pub hyperparameters: GroupHyperparameters,
    /// Learning features, n × k.
    pub learning: Mat<f64>,
    /// Number of features before any was left out.
    pub rank: usize,
}

#[derive(Debug, thiserror::Error)]
pub enum LearnError {
    #[error(transparent)]
    Scaling(#[from] ScalingError),
    #[error(transparent)]
    Gp(#[from] GpError),
}

impl LearnedGroup {
    /// Learns from `properties`, n × d, at the `learning` positions; `changes`, p × d, as in
    /// [`noise_whitening::learn`]. `on_feature` is called for every feature fitted.
    pub fn learn(
        recipe: GroupRecipe,
        learning: &LearningPositions,
        properties: MatRef<f64>,
        changes: MatRef<f64>,
        on_feature: impl Fn() + Sync,
    ) -> Result<Self, LearnError> {
        let (scaling, hyperparameters) = match recipe.model {
            Model::EachFeature { scaling: method, bounds } => {
                let scaling = Scaling::learn(method, properties)?;
                let features = scaling.apply(properties);
                let fits = fit_each(learning, features.as_ref(), &bounds, on_feature);
                (scaling, GroupHyperparameters::Each(fits))
            }
            Model::SharedField(settings) => {
                let learned = noise_whitening::learn(&settings, learning, properties, changes)?;
                (learned.scaling, GroupHyperparameters::Shared(learned.hyperparameters))
            }
        };
        let features = scaling.apply(properties);
        Ok(Self { recipe, rank: scaling.features(), scaling, hyperparameters, learning: features })
    }

    /// The same group, of the features `kept` only.
    pub fn select(&self, kept: &[usize]) -> Self {
        let hyperparameters = match &self.hyperparameters {
            GroupHyperparameters::Each(fits) => {
                GroupHyperparameters::Each(kept.iter().map(|&r| fits[r].clone()).collect())
            }
            shared => shared.clone(),
        };
        Self {
            recipe: self.recipe,
            scaling: self.scaling.select(kept),
            hyperparameters,
            learning: Mat::from_fn(self.learning.nrows(), kept.len(), |i, r| self.learning[(i, kept[r])]),
            rank: self.rank,
        }
    }

    /// The same scaling and hyperparameters, conditioned on `properties` at other positions.
    pub fn conditioned_on(&self, properties: MatRef<f64>) -> Self {
        Self { learning: self.scaling.apply(properties), ..self.clone() }
    }

    /// The same scaling and hyperparameters, conditioned on some of the learning images.
    pub fn of_rows(&self, rows: &[usize]) -> Self {
        let learning = Mat::from_fn(rows.len(), self.features(), |i, r| self.learning[(rows[i], r)]);
        Self { learning, ..self.clone() }
    }

    /// Number of features k.
    pub fn features(&self) -> usize {
        self.scaling.features()
    }

    /// Summed log marginal likelihood of the features `kept`; `None` where features are not fitted one by one.
    pub fn log_likelihood(&self, kept: &[usize]) -> Option<f64> {
        match &self.hyperparameters {
            GroupHyperparameters::Each(fits) => Some(kept.iter().map(|&r| fits[r].log_likelihood).sum()),
            GroupHyperparameters::Shared(_) => None,
        }
    }

    /// Posterior means (feature × cell) and predictive variances (feature × cell, or one row shared by all features) at
    /// `centers_m`.
    pub fn predict(
        &self,
        learning: &LearningPositions,
        centers_m: &[PositionM],
    ) -> Result<(Vec<f32>, Vec<f32>), GpError> {
        let noisy = |variance: f64, hyperparameters: &Hyperparameters| {
            (variance + hyperparameters.noise_std.powi(2)).max(f64::from(f32::MIN_POSITIVE)) as f32
        };
        match &self.hyperparameters {
            GroupHyperparameters::Each(fits) => {
                let rows: Vec<(Vec<f32>, Vec<f32>)> = fits
                    .par_iter()
                    .enumerate()
                    .map(|(r, fit)| {
                        let z = self.learning.as_ref().subcols(r, 1);
                        let prediction = Posterior::new(learning, z, fit.hyperparameters)?.predict(centers_m);
                        let mean = prediction.mean.col(0).iter().map(|&mean| mean as f32).collect();
                        let variance = prediction.variance.iter().map(|&v| noisy(v, &fit.hyperparameters)).collect();
                        Ok((mean, variance))
                    })
                    .collect::<Result<_, GpError>>()?;
                let (means, variances): (Vec<_>, Vec<_>) = rows.into_iter().unzip();
                Ok((means.concat(), variances.concat()))
            }
            GroupHyperparameters::Shared(hyperparameters) => {
                let posterior = Posterior::new(learning, self.learning.as_ref(), *hyperparameters)?;
                let prediction = posterior.predict(centers_m);
                let mean = (0..self.features())
                    .flat_map(|r| prediction.mean.col(r).iter().map(|&mean| mean as f32).collect::<Vec<_>>())
                    .collect();
                Ok((mean, prediction.variance.iter().map(|&v| noisy(v, hyperparameters)).collect()))
            }
        }
    }

    /// [`predict`](Self::predict), ready to match frames against.
    pub fn on_cells(&self, learning: &LearningPositions, centers_m: &[PositionM]) -> Result<FieldOnCells, GpError> {
        let (mean, variance) = self.predict(learning, centers_m)?;
        Ok(FieldOnCells::new(self.features(), centers_m.len(), mean, &variance))
    }
}
