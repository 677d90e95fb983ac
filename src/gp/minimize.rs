//! Minimisation within bounds.
//!
//! BFGS with an active set: variables at a bound that the gradient pushes outwards are held, the others move along the
//! quasi-Newton direction, and every trial point is projected onto the box (Bertsekas 1982; Nocedal & Wright 2006,
//! section 16.7). With four variables there is nothing for a limited memory to save, so the Hessian is kept whole.

use nalgebra::{SMatrix, SVector};

#[derive(Debug, Clone, Copy)]
pub struct Settings {
    /// Ends when no component of the projected gradient is larger.
    pub gradient_tolerance: f64,
    /// Ends when a step lowers the value by less than this, relative to the value (or to 1).
    pub relative_decrease: f64,
    pub max_iterations: usize,
}

impl Default for Settings {
    fn default() -> Self {
        Self { gradient_tolerance: 1e-4, relative_decrease: 2e-9, max_iterations: 200 }
    }
}

#[derive(Debug, Clone, PartialEq)]
pub struct Minimum<const N: usize> {
    pub x: [f64; N],
    pub value: f64,
    pub evaluations: usize,
    /// A tolerance was met, not the limit of iterations.
    pub converged: bool,
}

/// Armijo's constant: the share of the predicted decrease that a step must bring.
const SUFFICIENT_DECREASE: f64 = 1e-4;
/// A line search gives up after so many halvings.
const MAX_BACKTRACKS: usize = 30;
/// No variable moves further in one step: the variables are logarithms, so this is a factor of e².
const MAX_STEP: f64 = 2.0;

/// Minimises `f` over the box \[`lower`, `upper`\] from `start` (moved into the box first). `f` returns its value and
/// gradient, or `None` where it is not defined: such points are never accepted.
///
/// Returns `None` when `f` is not defined at the start.
pub fn minimize<const N: usize>(
    mut f: impl FnMut(&[f64; N]) -> Option<(f64, [f64; N])>,
    start: [f64; N],
    lower: [f64; N],
    upper: [f64; N],
    settings: &Settings,
) -> Option<Minimum<N>> {
    let mut f = |x: &SVector<f64, N>| f(&x.data.0[0]).map(|(value, gradient)| (value, SVector::from(gradient)));
    let project = |x: SVector<f64, N>| SVector::<f64, N>::from_fn(|i, _| x[i].clamp(lower[i], upper[i]));
    let mut x = project(SVector::from(start));
    let (mut value, mut gradient) = f(&x)?;
    let mut hessian = SMatrix::<f64, N, N>::identity() * gradient.amax().max(1.0);
    let mut evaluations = 1;
    let mut converged = false;

    for _ in 0..settings.max_iterations {
        let projected_gradient = project(x - gradient) - x;
        if projected_gradient.amax() <= settings.gradient_tolerance {
            converged = true;
            break;
        }
        let held: [bool; N] =
            std::array::from_fn(|i| (x[i] <= lower[i] && gradient[i] > 0.0) || (x[i] >= upper[i] && gradient[i] < 0.0));
        let direction = quasi_newton_direction(&hessian, &gradient, &held);

        // Backtracking along the projected path.
        let mut step = (MAX_STEP / direction.amax()).min(1.0);
        let mut accepted = None;
        for _ in 0..MAX_BACKTRACKS {
            let trial = project(x + direction * step);
            evaluations += 1;
            let predicted = gradient.dot(&(trial - x));
            match f(&trial) {
                Some((trial_value, trial_gradient)) if trial_value <= value + SUFFICIENT_DECREASE * predicted => {
                    accepted = Some((trial, trial_value, trial_gradient));
                    break;
                }
                // The minimum of the parabola through what is known, kept within [0.1, 0.5] of the step.
                Some((trial_value, _)) => {
                    let curvature = trial_value - value - predicted;
                    step *= (-0.5 * predicted / curvature).clamp(0.1, 0.5);
                }
                None => step *= 0.25,
            }
        }
        let Some((next, next_value, next_gradient)) = accepted else {
            // No descent along a descent direction: the value is as low as its rounding allows.
            converged = true;
            break;
        };
        update_hessian(&mut hessian, &(next - x), &(next_gradient - gradient));
        let decrease = value - next_value;
        (x, value, gradient) = (next, next_value, next_gradient);
        if decrease <= settings.relative_decrease * value.abs().max(1.0) {
            converged = true;
            break;
        }
    }
    Some(Minimum { x: x.into(), value, evaluations, converged })
}

/// −B⁻¹ g over the free variables, zero for the held ones.
fn quasi_newton_direction<const N: usize>(
    hessian: &SMatrix<f64, N, N>,
    gradient: &SVector<f64, N>,
    held: &[bool; N],
) -> SVector<f64, N> {
    let mut reduced = *hessian;
    let mut free_gradient = *gradient;
    for i in (0..N).filter(|&i| held[i]) {
        reduced.row_mut(i).fill(0.0);
        reduced.column_mut(i).fill(0.0);
        reduced[(i, i)] = 1.0;
        free_gradient[i] = 0.0;
    }
    // The update keeps B positive definite; should rounding break that, steepest descent still descends.
    reduced.cholesky().map_or(-free_gradient, |factor| -factor.solve(&free_gradient))
}

/// Powell's damped BFGS update (Nocedal & Wright 2006, procedure 18.2): positive definite whatever the curvature.
fn update_hessian<const N: usize>(hessian: &mut SMatrix<f64, N, N>, s: &SVector<f64, N>, y: &SVector<f64, N>) {
    let bs = *hessian * s;
    let sbs = s.dot(&bs);
    if sbs <= 0.0 {
        return;
    }
    let sy = s.dot(y);
    let theta = if sy >= 0.2 * sbs { 1.0 } else { 0.8 * sbs / (sbs - sy) };
    let r = y * theta + bs * (1.0 - theta);
    *hessian += r * r.transpose() / s.dot(&r) - bs * bs.transpose() / sbs;
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Rosenbrock's valley in two variables, minimum 0 at (1, 1).
    fn rosenbrock(x: &[f64; 2]) -> Option<(f64, [f64; 2])> {
        let (a, b) = (1.0 - x[0], x[1] - x[0] * x[0]);
        Some((a * a + 100.0 * b * b, [-2.0 * a - 400.0 * x[0] * b, 200.0 * b]))
    }

    #[test]
    fn the_bottom_of_a_curved_valley_is_found() {
        let minimum = minimize(
            rosenbrock,
            [-1.2, 1.0],
            [-5.0; 2],
            [5.0; 2],
            &Settings { gradient_tolerance: 1e-8, ..Settings::default() },
        )
        .expect("defined");
        assert!(minimum.converged && minimum.evaluations < 100, "{minimum:?}");
        assert!(minimum.x.iter().all(|x| (x - 1.0).abs() < 1e-4), "{minimum:?}");
    }

    #[test]
    fn a_bound_that_cuts_the_minimum_off_is_met() {
        // With x₀ ≤ ½ the minimum is at (½, ¼).
        let minimum = minimize(rosenbrock, [-1.2, 1.0], [-5.0; 2], [0.5, 5.0], &Settings::default()).expect("defined");
        assert!((minimum.x[0] - 0.5).abs() < 1e-12 && (minimum.x[1] - 0.25).abs() < 1e-3, "{minimum:?}");
    }

    #[test]
    fn undefined_regions_are_backed_out_of() {
        // −log x + x is defined for x > 0 only; minimum at 1.
        let f = |x: &[f64; 1]| (x[0] > 0.0).then(|| (x[0] - x[0].ln(), [1.0 - 1.0 / x[0]]));
        let minimum = minimize(f, [4.0], [-10.0], [10.0], &Settings::default()).expect("defined at the start");
        assert!((minimum.x[0] - 1.0).abs() < 1e-3, "{minimum:?}");
        assert_eq!(minimize(f, [-1.0], [-10.0], [10.0], &Settings::default()), None);
    }
}
