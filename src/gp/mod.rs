//! Gaussian-process regression over the plane: pure mathematics, knows neither images nor files.
//!
//! A feature z is modelled as a smooth field f plus independent noise e, z\[i\] = f(s\[i\]) + e\[i\], at positions s in
//! metres. [`fit`] finds the hyperparameters that maximise the log marginal likelihood; [`Posterior`] is what is then
//! known of f anywhere. Several features that share their hyperparameters share one factorization.

pub mod fit;
mod kernel;
pub mod likelihood;
pub mod minimize;
mod starts;

use faer::linalg::solvers::{Llt, Solve};
use faer::linalg::triangular_solve::solve_lower_triangular_in_place;
use faer::{Mat, MatRef, Par, Side};

pub use kernel::{Hyperparameters, squared_exponential};

use crate::types::PositionM;
use kernel::covariances;

#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum GpError {
    #[error("the covariance matrix of {points} points is not positive definite at {hyperparameters:?}")]
    NotPositiveDefinite { points: usize, hyperparameters: Hyperparameters },
}

/// Learning positions with what every feature's fit needs of them.
#[derive(Debug, Clone)]
pub struct LearningPositions {
    positions: Vec<PositionM>,
    /// Number of the recording each position is from.
    recordings: Vec<usize>,
    /// (s_i − s_j)² on either axis, n × n \[m²\].
    squared_distance_m2: [Mat<f64>; 2],
    spacing_m: f64,
}

/// On simulated towns surveyed on two days, 2.5 m from frame to frame, length scales after the pooled spacing, a quarter
/// of that within the days, localize a third day with no gross error; twice as long ones are worse, four times as long
/// ones gross (RMSE 0.9–1.0, 1.4, 4–10 m).
const LEAST_SPACING_SHARE: f64 = 0.25;

impl LearningPositions {
    /// Positions of one recording.
    pub fn new(positions: Vec<PositionM>) -> Self {
        let recordings = vec![0; positions.len()];
        Self::of_recordings(positions, &recordings)
    }

    /// Positions with the number of the recording each is from.
    ///
    /// # Panics
    /// When there are more of one than of the other.
    pub fn of_recordings(positions: Vec<PositionM>, recordings: &[usize]) -> Self {
        assert_eq!(positions.len(), recordings.len(), "one recording a position");
        let n = positions.len();
        let pooled_m = fit::median_neighbour_spacing_m(&positions, &vec![0; n]);
        let spacing_m = pooled_m.max(LEAST_SPACING_SHARE * fit::median_neighbour_spacing_m(&positions, recordings));
        let squared_distance_m2 =
            [0, 1].map(|axis| Mat::from_fn(n, n, |i, j| (positions[i][axis] - positions[j][axis]).powi(2)));
        Self { positions, recordings: recordings.to_vec(), squared_distance_m2, spacing_m }
    }

    /// Number of the recording each position is from.
    pub fn recordings(&self) -> &[usize] {
        &self.recordings
    }

    pub fn len(&self) -> usize {
        self.positions.len()
    }

    pub fn is_empty(&self) -> bool {
        self.positions.is_empty()
    }

    pub fn positions(&self) -> &[PositionM] {
        &self.positions
    }

    /// Median distance to the nearest position elsewhere \[m\], but at least a quarter of what it is within recordings: the
    /// tenth recording of a street brings images of it, not the detail that frames so close to each other would show. Zero
    /// where all positions are one.
    pub fn spacing_m(&self) -> f64 {
        self.spacing_m
    }

    /// The kernel matrix K, n × n, lower triangle (the upper one is left zero).
    fn kernel_matrix(&self, hyperparameters: &Hyperparameters) -> Mat<f64> {
        let n = self.len();
        let [d1, d2] = &self.squared_distance_m2;
        let mut k = Mat::zeros(n, n);
        for j in 0..n {
            let below = &mut k.col_as_slice_mut(j)[j..];
            covariances(&d1.col_as_slice(j)[j..], &d2.col_as_slice(j)[j..], hyperparameters, below);
        }
        k
    }

    /// K = Q Λ Qᵀ at `hyperparameters`, without noise.
    pub fn correlation_eigen(&self, hyperparameters: &Hyperparameters) -> KernelEigen {
        let n = self.len();
        match self.kernel_matrix(hyperparameters).self_adjoint_eigen(Side::Lower) {
            Ok(eigen) => KernelEigen {
                values: eigen.S().column_vector().iter().map(|&value| value.max(0.0)).collect(),
                vectors: eigen.U().to_owned(),
            },
            // Only for entries that are no numbers, which positions from a file never are; then every direction is null.
            Err(_) => KernelEigen { values: vec![0.0; n], vectors: Mat::identity(n, n) },
        }
    }

    /// The Cholesky factor of R = K + σ_e² I.
    fn factorize(&self, hyperparameters: &Hyperparameters) -> Result<Llt<f64>, GpError> {
        factorize_with_noise(self.kernel_matrix(hyperparameters), hyperparameters.noise_std.powi(2))
            .ok_or(GpError::NotPositiveDefinite { points: self.len(), hyperparameters: *hyperparameters })
    }
}

/// The Cholesky factor of `k` + `noise_variance` I; `None` when that is not positive definite in floating point.
fn factorize_with_noise(mut k: Mat<f64>, noise_variance: f64) -> Option<Llt<f64>> {
    for i in 0..k.nrows() {
        k[(i, i)] += noise_variance;
    }
    k.llt(Side::Lower).ok()
}

/// Eigendecomposition of a kernel matrix; values in rising order, none negative.
pub struct KernelEigen {
    pub values: Vec<f64>,
    /// Q, n × n, one vector a column.
    pub vectors: Mat<f64>,
}

/// What is known of one or more fields with the same hyperparameters after n observations of each.
pub struct Posterior<'a> {
    learning: &'a LearningPositions,
    hyperparameters: Hyperparameters,
    factor: Llt<f64>,
    /// R⁻¹ Z, n × fields.
    weights: Mat<f64>,
}

/// Posterior at m points.
pub struct Prediction {
    /// m × fields.
    pub mean: Mat<f64>,
    /// Variance of the noise-free field at each point, the same for all fields; never negative.
    pub variance: Vec<f64>,
}

/// Points predicted at a time: bounds the memory at `n × CHUNK` numbers.
const CHUNK: usize = 256;

impl<'a> Posterior<'a> {
    /// `observed`: n × fields.
    ///
    /// # Errors
    /// When R is not positive definite in floating point.
    pub fn new(
        learning: &'a LearningPositions,
        observed: MatRef<f64>,
        hyperparameters: Hyperparameters,
    ) -> Result<Self, GpError> {
        let factor = learning.factorize(&hyperparameters)?;
        let weights = factor.solve(observed);
        Ok(Self { learning, hyperparameters, factor, weights })
    }

    /// Posterior mean and variance, Do et al. (2015), eq. 6:
    ///
    /// ```text
    /// μ*(s) = cᵀ R⁻¹ z        v*(s) = σ_f² − cᵀ R⁻¹ c        c = k(s, S_n)
    /// ```
    pub fn predict(&self, points: &[PositionM]) -> Prediction {
        let n = self.learning.len();
        let mut mean = Mat::zeros(points.len(), self.weights.ncols());
        let mut variance = Vec::with_capacity(points.len());
        let mut squared_distance_m2 = [vec![0.0; n], vec![0.0; n]];
        for (chunk, points) in points.chunks(CHUNK).enumerate() {
            let mut c = Mat::zeros(n, points.len());
            for (j, point) in points.iter().enumerate() {
                for (axis, squares) in squared_distance_m2.iter_mut().enumerate() {
                    let to_point =
                        self.learning.positions.iter().map(|position| (position[axis] - point[axis]).powi(2));
                    squares.iter_mut().zip(to_point).for_each(|(square, value)| *square = value);
                }
                let [d1, d2] = &squared_distance_m2;
                covariances(d1, d2, &self.hyperparameters, c.col_as_slice_mut(j));
            }
            mean.as_mut().subrows_mut(chunk * CHUNK, points.len()).copy_from(c.transpose() * &self.weights);
            solve_lower_triangular_in_place(self.factor.L(), c.as_mut(), Par::Seq);
            variance.extend((0..points.len()).map(|j| {
                let explained: f64 = c.col(j).iter().map(|v| v * v).sum();
                (self.hyperparameters.signal_std.powi(2) - explained).max(0.0)
            }));
        }
        Prediction { mean, variance }
    }

    /// Leave-one-out residuals z\[i\] − μ₋ᵢ(s\[i\]), n × fields, and the variances they should have, noise included:
    /// Rasmussen & Williams (2006), eq. 5.12.
    ///
    /// ```text
    /// z_i − μ₋ᵢ = [R⁻¹ z]_i / [R⁻¹]_ii        σ²₋ᵢ = 1 / [R⁻¹]_ii
    /// ```
    pub fn leave_one_out(&self) -> (Mat<f64>, Vec<f64>) {
        let n = self.learning.len();
        let inverse = self.factor.solve(Mat::<f64>::identity(n, n));
        let variance: Vec<f64> = (0..n).map(|i| 1.0 / inverse[(i, i)]).collect();
        let residual = Mat::from_fn(n, self.weights.ncols(), |i, r| self.weights[(i, r)] * variance[i]);
        (residual, variance)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::golden::{golden, list};

    /// Positions and values of `golden.json`, key `gp`.
    pub(super) fn golden_gp() -> (LearningPositions, Vec<f64>, Hyperparameters) {
        let gp = &golden()["gp"];
        let positions = (0..30)
            .map(|i| {
                let i = f64::from(i);
                [10.0 * (0.618_033_988_749_894_9 * i).fract(), 6.0 * (0.754_877_666_246_692_7 * i).fract()]
            })
            .collect();
        let theta = list(&gp["theta_log_sf_se_l1_l2"]).try_into().expect("four");
        (LearningPositions::new(positions), list(&gp["z"]), Hyperparameters::from_log(theta))
    }

    fn column(values: &[f64]) -> Mat<f64> {
        Mat::from_fn(values.len(), 1, |i, _| values[i])
    }

    #[test]
    fn prediction_equals_the_reference_values() {
        let (learning, z, theta) = golden_gp();
        let gp = &golden()["gp"];
        let points: Vec<PositionM> = gp["query"]
            .as_array()
            .expect("a list")
            .iter()
            .map(|point| list(point).try_into().expect("two coordinates"))
            .collect();
        let prediction =
            Posterior::new(&learning, column(&z).as_ref(), theta).expect("positive definite").predict(&points);
        for (i, (mean, variance)) in list(&gp["mean"]).iter().zip(list(&gp["var"])).enumerate() {
            assert!((prediction.mean[(i, 0)] / mean - 1.0).abs() < 1e-6, "{} {mean}", prediction.mean[(i, 0)]);
            assert!((prediction.variance[i] / variance - 1.0).abs() < 1e-6);
        }
    }

    #[test]
    fn far_away_the_prior_comes_back_and_without_noise_the_data() {
        let (learning, z, theta) = golden_gp();
        let noise_free = Hyperparameters { noise_std: 1e-6, ..theta };
        let posterior = Posterior::new(&learning, column(&z).as_ref(), noise_free).expect("positive definite");
        let far = posterior.predict(&[[1e4, -1e4]]);
        assert_eq!(far.mean[(0, 0)], 0.0);
        assert!((far.variance[0] - theta.signal_std.powi(2)).abs() < 1e-12);
        let there = posterior.predict(learning.positions());
        for (i, z) in z.iter().enumerate() {
            assert!((there.mean[(i, 0)] - z).abs() < 1e-4, "{} {z}", there.mean[(i, 0)]);
            assert!(there.variance[i] < 1e-6);
        }
    }

    #[test]
    fn leave_one_out_equals_leaving_one_out() {
        let (learning, z, theta) = golden_gp();
        let (residual, variance) =
            Posterior::new(&learning, column(&z).as_ref(), theta).expect("positive definite").leave_one_out();
        for left in [0, 13, 29] {
            let others = |i: &usize| *i != left;
            let rest = LearningPositions::new((0..30).filter(others).map(|i| learning.positions()[i]).collect());
            let observed: Vec<f64> = (0..30).filter(others).map(|i| z[i]).collect();
            let prediction = Posterior::new(&rest, column(&observed).as_ref(), theta)
                .expect("positive definite")
                .predict(&[learning.positions()[left]]);
            assert!((residual[(left, 0)] - (z[left] - prediction.mean[(0, 0)])).abs() < 1e-9);
            assert!((variance[left] - prediction.variance[0] - theta.noise_std.powi(2)).abs() < 1e-9);
        }
    }
}
