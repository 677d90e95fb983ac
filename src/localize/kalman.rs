//! Where in its hill a vehicle is: a Kalman filter of what frames say by themselves.
//!
//! The cells decide in which hill of the belief a vehicle is, which no normal distribution could. Within the hill the
//! summits of the frames' own likelihoods, between the cells, say it better than the mean of the belief: the flanks of a
//! likelihood, which its temperature raises, are known far less well, and a belief adds up what many frames have of them.
//! The velocity stays the same but for a white acceleration (Bar-Shalom et al. 2001, section 6.2.2).

use nalgebra::{Matrix2, Matrix2x4, Matrix4, Vector2, Vector4};

use super::belief::Mode;
use super::motion::MotionSettings;
use crate::types::{PositionCovariance, PositionM};

/// Deviation from a smooth motion over a second; the rest of a vehicle's diffusion is the lag of a filter on cells \[m\].
const JITTER_M: f64 = 0.1;

/// East, north \[m\] and their velocities \[m/s\].
#[derive(Debug, Clone, Copy)]
pub struct State {
    pub mean: Vector4<f64>,
    pub covariance: Matrix4<f64>,
}

/// From one frame to the next.
#[derive(Debug, Clone, Copy)]
pub struct Transition {
    pub matrix: Matrix4<f64>,
    pub jitter: Matrix4<f64>,
}

impl State {
    /// At the first sighting, at any velocity.
    pub fn first(seen: &Mode, settings: &MotionSettings) -> Self {
        let mut covariance = Matrix4::zeros();
        covariance.fixed_view_mut::<2, 2>(0, 0).copy_from(&noise_of(seen));
        covariance.fixed_view_mut::<2, 2>(2, 2).fill_diagonal((0.5 * settings.speed_limit_mps).powi(2));
        Self { mean: Vector4::new(seen.mean_m[0], seen.mean_m[1], 0.0, 0.0), covariance }
    }

    pub fn predicted(&self, transition: &Transition) -> Self {
        let Transition { matrix, jitter } = transition;
        Self { mean: matrix * self.mean, covariance: matrix * self.covariance * matrix.transpose() + jitter }
    }

    /// With what a frame says; `None` where neither says anything.
    pub fn updated(&self, seen: &Mode) -> Option<Self> {
        let observe = Matrix2x4::identity();
        let innovation: Matrix2<f64> = observe * self.covariance * observe.transpose() + noise_of(seen);
        let gain = self.covariance * observe.transpose() * innovation.try_inverse()?;
        let surprise = Vector2::from(seen.mean_m) - observe * self.mean;
        Some(Self {
            mean: self.mean + gain * surprise,
            covariance: symmetric((Matrix4::identity() - gain * observe) * self.covariance),
        })
    }

    pub fn position_m(&self) -> PositionM {
        [self.mean[0], self.mean[1]]
    }

    pub fn position_covariance(&self) -> PositionCovariance {
        let of = |i, j| self.covariance[(i, j)];
        PositionCovariance { ee_m2: of(0, 0), en_m2: of(0, 1), nn_m2: of(1, 1) }
    }
}

impl Transition {
    pub fn after(dt_s: f64, settings: &MotionSettings) -> Self {
        let q = settings.acceleration_mps2.powi(2);
        let mut matrix = Matrix4::identity();
        let mut jitter = Matrix4::zeros();
        for axis in [0, 1] {
            matrix[(axis, axis + 2)] = dt_s;
            jitter[(axis, axis)] = q * dt_s.powi(3) / 3.0 + JITTER_M.powi(2) * dt_s;
            jitter[(axis, axis + 2)] = q * dt_s.powi(2) / 2.0;
            jitter[(axis + 2, axis)] = q * dt_s.powi(2) / 2.0;
            // Never singular, also between frames of the same instant.
            jitter[(axis + 2, axis + 2)] = q * dt_s + 1e-9;
        }
        Self { matrix, jitter }
    }
}

fn noise_of(seen: &Mode) -> Matrix2<f64> {
    let PositionCovariance { ee_m2, en_m2, nn_m2 } = seen.covariance;
    Matrix2::new(ee_m2, en_m2, en_m2, nn_m2)
}

pub fn symmetric(matrix: Matrix4<f64>) -> Matrix4<f64> {
    (matrix + matrix.transpose()) * 0.5
}
