//! Log-likelihood of a frame's features at every candidate cell.

use std::f64::consts::TAU;

use multiversion::multiversion;

use crate::map::{FeatureMap, GroupField, GroupInfo, MapGroup, NoiseModel};

/// A group's Gaussian processes on the candidate cells.
#[derive(Debug, Clone, PartialEq)]
pub struct FieldOnCells {
    features: usize,
    cells: usize,
    /// Posterior mean, feature × cell.
    mean: Vec<f32>,
    /// 1 / p: feature × cell, or one row where all features share it.
    precision: Vec<f32>,
    /// −½ Σ (log p + log 2π) over the features, a cell.
    log_normalizer: Vec<f32>,
}

impl FieldOnCells {
    /// From posterior means (feature × cell) and predictive variances, noise included (feature × cell, or one row shared
    /// by all features).
    ///
    /// # Panics
    /// When the sizes do not belong together.
    pub fn new(features: usize, cells: usize, mean: Vec<f32>, variance: &[f32]) -> Self {
        assert_eq!(mean.len(), features * cells, "one mean a feature and cell");
        assert!(variance.len() == cells || variance.len() == features * cells, "variances shared, or one a feature");
        let share = if variance.len() == cells { features as f64 } else { 1.0 };
        let mut log_normalizer = vec![0.0_f64; cells];
        for row in variance.chunks_exact(cells.max(1)) {
            for (log_normalizer, &p) in log_normalizer.iter_mut().zip(row) {
                *log_normalizer -= 0.5 * share * libm::log(f64::from(p) * TAU);
            }
        }
        Self {
            features,
            cells,
            mean,
            precision: variance.iter().map(|p| 1.0 / p).collect(),
            log_normalizer: log_normalizer.into_iter().map(|value| value as f32).collect(),
        }
    }

    pub fn features(&self) -> usize {
        self.features
    }

    pub fn cells(&self) -> usize {
        self.cells
    }

    /// The same field, of the features `kept` only.
    pub fn select(&self, kept: &[usize]) -> Self {
        let mean = kept.iter().flat_map(|&feature| self.mean_of(feature)).copied().collect();
        let variance: Vec<f32> = if self.precision.len() == self.cells {
            self.precision.iter().map(|precision| 1.0 / precision).collect()
        } else {
            kept.iter().flat_map(|&feature| self.precision_of(feature)).map(|precision| 1.0 / precision).collect()
        };
        Self::new(kept.len(), self.cells, mean, &variance)
    }

    fn precision_of(&self, feature: usize) -> &[f32] {
        let row = if self.precision.len() == self.cells { 0 } else { feature };
        &self.precision[row * self.cells..(row + 1) * self.cells]
    }

    fn mean_of(&self, feature: usize) -> &[f32] {
        &self.mean[feature * self.cells..(feature + 1) * self.cells]
    }

    /// Adds the log-likelihood of `features` at every cell to `log_likelihood`. `scratch` is overwritten.
    ///
    /// # Panics
    /// When `features` or `log_likelihood` is of another length than the field.
    pub fn add_log_likelihood(
        &self,
        features: &[f32],
        noise: NoiseModel,
        scratch: &mut Vec<f32>,
        log_likelihood: &mut [f32],
    ) {
        assert_eq!((features.len(), log_likelihood.len()), (self.features, self.cells), "features and cells");
        scratch.clear();
        scratch.resize(self.cells, 0.0);
        let shared = self.precision.len() == self.cells;
        for (feature, &z) in features.iter().enumerate() {
            match noise {
                NoiseModel::Gaussian if !shared => {
                    add_residual(z, self.mean_of(feature), self.precision_of(feature), scratch);
                }
                _ => add_squared_distance(z, self.mean_of(feature), scratch),
            }
        }
        if shared && noise == NoiseModel::Gaussian {
            scratch.iter_mut().zip(&self.precision).for_each(|(residual, precision)| *residual *= precision);
        }
        let count = self.features as f32;
        for ((out, residual), normalizer) in log_likelihood.iter_mut().zip(&*scratch).zip(&self.log_normalizer) {
            *out += match noise {
                NoiseModel::Gaussian => normalizer - 0.5 * residual,
                NoiseModel::UnknownScale => {
                    0.5 * normalizer - 0.5 * count * libm::logf(residual.max(f32::MIN_POSITIVE))
                }
            };
        }
    }

    /// Eq. 10 of every feature on its own, feature × cell.
    pub fn log_likelihood_of_each(&self, features: &[f32]) -> Vec<f32> {
        let mut table = Vec::with_capacity(self.features * self.cells);
        for (feature, &z) in features.iter().enumerate() {
            let cells = self.mean_of(feature).iter().zip(self.precision_of(feature));
            table.extend(cells.map(|(&mean, &precision)| {
                let residual = (z - mean).powi(2) * precision;
                -0.5 * (residual - libm::logf(precision) + libm::log(TAU) as f32)
            }));
        }
        table
    }
}

/// The log-likelihood of `features` at a place of which nothing is known, whose predicted mean is that of all places, up to
/// a constant of the field: what the best cell is compared with. `None` for a noise model that has none.
pub fn log_likelihood_nowhere(features: &[f32], noise: NoiseModel) -> Option<f32> {
    match noise {
        NoiseModel::Gaussian => None,
        NoiseModel::UnknownScale => {
            let square: f32 = features.iter().map(|z| z * z).sum();
            Some(-0.5 * features.len() as f32 * libm::logf(square.max(f32::MIN_POSITIVE)))
        }
    }
}

/// The fields of a map's groups on the same cells, each with what it counts.
#[derive(Debug, Clone)]
pub struct MapFields {
    groups: Vec<(FieldOnCells, NoiseModel)>,
}

impl MapFields {
    /// `fields`, on `cells` cells each, of `groups`.
    pub fn new(groups: &[GroupInfo], cells: usize, fields: impl IntoIterator<Item = GroupField>) -> Self {
        let of_group = |(info, field): (&GroupInfo, GroupField)| {
            let GroupField { mean, variance } = field;
            let field = FieldOnCells::new(info.features, cells, mean, &variance);
            (field, info.recipe.noise)
        };
        Self { groups: groups.iter().zip(fields).map(of_group).collect() }
    }

    /// Those of a map, on all its cells.
    pub fn of(map: &FeatureMap) -> Self {
        let of_group =
            |group: &MapGroup| GroupField { mean: group.field_mean.clone(), variance: group.field_variance.clone() };
        Self::new(&map.info.groups, map.cells.len(), map.groups.iter().map(of_group))
    }

    /// Adds the log-likelihood of a frame's features, one group's behind the other's, at every cell. `scratch` is
    /// overwritten.
    ///
    /// # Panics
    /// When `features` or `log_likelihood` is of another length than the fields.
    pub fn add_log_likelihood(&self, features: &[f32], scratch: &mut Vec<f32>, log_likelihood: &mut [f32]) {
        let mut rest = features;
        for (field, noise) in &self.groups {
            let of_group;
            (of_group, rest) = rest.split_at(field.features());
            field.add_log_likelihood(of_group, *noise, scratch, log_likelihood);
        }
    }

    /// The log-likelihood by one group alone, in place of what is in `log_likelihood`.
    pub fn log_likelihood_of_group(
        &self,
        group: usize,
        features: &[f32],
        scratch: &mut Vec<f32>,
        log_likelihood: &mut [f32],
    ) {
        let before: usize = self.groups[..group].iter().map(|(field, _)| field.features()).sum();
        let (field, noise) = &self.groups[group];
        log_likelihood.fill(0.0);
        let features = &features[before..before + field.features()];
        field.add_log_likelihood(features, *noise, scratch, log_likelihood);
    }

    /// The log-likelihood of a frame's features at no place, which all cells' are compared with; `None` where a group's
    /// noise model has none.
    pub fn log_likelihood_nowhere(groups: &[GroupInfo], features: &[f32]) -> Option<f32> {
        let mut rest = features;
        groups.iter().try_fold(0.0, |sum, group| {
            let of_group;
            (of_group, rest) = rest.split_at(group.features);
            Some(sum + log_likelihood_nowhere(of_group, group.recipe.noise)?)
        })
    }
}

#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2+fma"))]
fn add_residual(z: f32, mean: &[f32], precision: &[f32], sum: &mut [f32]) {
    for ((sum, mean), precision) in sum.iter_mut().zip(mean).zip(precision) {
        let difference = z - mean;
        *sum += difference * difference * precision;
    }
}

#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2+fma"))]
fn add_squared_distance(z: f32, mean: &[f32], sum: &mut [f32]) {
    for (sum, mean) in sum.iter_mut().zip(mean) {
        let difference = z - mean;
        *sum += difference * difference;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::golden::{golden, list};

    fn field() -> FieldOnCells {
        let mean = vec![0.0, 1.0, 2.0, -1.0, 0.5, 0.25];
        FieldOnCells::new(2, 3, mean, &[0.5, 1.0, 2.0, 0.1, 0.2, 0.4])
    }

    /// Eq. 10 at `golden.json`'s prediction, for z = 0.3.
    #[test]
    fn log_likelihood_equals_the_reference_values() {
        let gp = &golden()["gp"];
        let noise_variance = list(&gp["theta_log_sf_se_l1_l2"])[1].exp().powi(2);
        let mean = list(&gp["mean"]).iter().map(|&mean| mean as f32).collect();
        let variance: Vec<f32> = list(&gp["var"]).iter().map(|&v| (v + noise_variance) as f32).collect();
        let field = FieldOnCells::new(1, 3, mean, &variance);
        for (found, expected) in field.log_likelihood_of_each(&[0.3]).iter().zip(list(&gp["loglik_eq10_z0_3"])) {
            assert!((f64::from(*found) / expected - 1.0).abs() < 1e-6, "{found} instead of {expected}");
        }
    }

    #[test]
    fn the_sum_equals_the_sum_of_each() {
        let (features, mut sum, mut scratch) = ([0.3, -0.7], vec![0.0; 3], Vec::new());
        field().add_log_likelihood(&features, NoiseModel::Gaussian, &mut scratch, &mut sum);
        let each = field().log_likelihood_of_each(&features);
        for (cell, sum) in sum.iter().enumerate() {
            assert!((sum - each[cell] - each[3 + cell]).abs() < 1e-6);
        }
    }

    #[test]
    fn shared_variances_equal_repeated_ones() {
        let mean = vec![0.0, 1.0, 2.0, -1.0, 0.5, 0.25];
        let shared = FieldOnCells::new(2, 3, mean.clone(), &[0.5, 1.0, 2.0]);
        let repeated = FieldOnCells::new(2, 3, mean, &[0.5, 1.0, 2.0, 0.5, 1.0, 2.0]);
        for noise in [NoiseModel::Gaussian, NoiseModel::UnknownScale] {
            let (mut a, mut b, mut scratch) = (vec![0.0; 3], vec![0.0; 3], Vec::new());
            shared.add_log_likelihood(&[0.3, -0.7], noise, &mut scratch, &mut a);
            repeated.add_log_likelihood(&[0.3, -0.7], noise, &mut scratch, &mut b);
            for (a, b) in a.iter().zip(&b) {
                assert!((a - b).abs() < 1e-6);
            }
        }
    }

    /// Whatever the map knows of a cell, the frame's own noise is at its most likely scale there.
    #[test]
    fn unknown_scale_is_the_profile_of_noise_of_the_frame_and_the_map_s_log_variance() {
        let features = [0.3_f32, -0.7];
        let (mut profile, mut scratch) = (vec![0.0; 3], Vec::new());
        field().add_log_likelihood(&features, NoiseModel::UnknownScale, &mut scratch, &mut profile);
        let unit = |scale: f32| FieldOnCells::new(2, 3, vec![0.0, 1.0, 2.0, -1.0, 0.5, 0.25], &[scale; 3]);
        let best = |cell: usize| {
            (1..4000)
                .map(|i| {
                    let each = unit(0.005 * i as f32).log_likelihood_of_each(&features);
                    each[cell] + each[3 + cell]
                })
                .fold(f32::NEG_INFINITY, f32::max)
        };
        let log_variance = [0.5_f32 * 0.1, 1.0 * 0.2, 2.0 * 0.4].map(|product| 0.5 * product.ln());
        let expected = |cell: usize| best(cell) - 0.5 * log_variance[cell];
        let constant = profile[0] - expected(0);
        for (cell, profile) in profile.iter().enumerate() {
            assert!((profile - expected(cell) - constant).abs() < 1e-3, "{cell}");
        }
    }

    /// A frame that resembles no place much is not sent where the map knows nothing and predicts the mean of all places.
    #[test]
    fn an_unknown_cell_must_fit_better_than_a_known_one() {
        let field = FieldOnCells::new(2, 2, vec![1.0, 0.0, 1.0, 0.0], &[1.1, 9.0]);
        let (mut known_and_unknown, mut scratch) = (vec![0.0; 2], Vec::new());
        let faint = [0.4, 0.4];
        field.add_log_likelihood(&faint, NoiseModel::UnknownScale, &mut scratch, &mut known_and_unknown);
        assert!(known_and_unknown[0] > known_and_unknown[1], "{known_and_unknown:?}");
    }
}
