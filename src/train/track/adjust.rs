//! Least squares over the errors of all positions: what the equations are, and how they are solved.

use super::skyline::{Skyline, SkylineFactor};

/// Σ coefficient · unknown = right, up to a normal error.
#[derive(Debug, Clone, PartialEq)]
pub struct Equation {
    pub terms: Vec<(usize, f64)>,
    pub right: f64,
    pub variance: f64,
    /// Some errors of this kind are far larger than their variance says: a jump of the receiver, a wrong match.
    pub has_outliers: bool,
}

#[derive(Debug, Clone)]
pub struct Solution {
    pub unknowns: Vec<f64>,
    /// Cholesky factor of the normal matrix at the last weights.
    pub factor: SkylineFactor,
    /// Weight of each equation in 0..1.25, 1 for an error of one standard deviation.
    pub weights: Vec<f64>,
    /// Σ w r²/σ².
    pub cost: f64,
}

/// Degrees of freedom of Student's t, as which errors with outliers are modelled.
const FREEDOM: f64 = 4.0;
const REWEIGHTINGS: usize = 8;

impl Equation {
    fn residual(&self, unknowns: &[f64]) -> f64 {
        self.right - self.terms.iter().map(|&(at, coefficient)| coefficient * unknowns[at]).sum::<f64>()
    }

    /// Expectation step of the t distribution (Lange, Little & Taylor 1989, eq. 3.5): (ν + 1) / (ν + r²/σ²).
    fn weight(&self, unknowns: &[f64]) -> f64 {
        match self.has_outliers {
            true => (FREEDOM + 1.0) / (FREEDOM + self.residual(unknowns).powi(2) / self.variance),
            false => 1.0,
        }
    }
}

/// The least-squares solution with weights as given; `None` when the equations do not determine all unknowns.
pub fn solve_weighted(count: usize, equations: &[Equation], weights: Vec<f64>) -> Option<Solution> {
    let mut first: Vec<usize> = (0..count).collect();
    for equation in equations {
        let least = equation.terms.iter().map(|&(at, _)| at).min().unwrap_or(0);
        equation.terms.iter().for_each(|&(at, _)| first[at] = first[at].min(least));
    }
    let mut normal = Skyline::zeros(first);
    let mut unknowns = vec![0.0; count];
    for (equation, weight) in equations.iter().zip(&weights) {
        let weight = weight / equation.variance;
        for (k, &(at, coefficient)) in equation.terms.iter().enumerate() {
            unknowns[at] += weight * coefficient * equation.right;
            for (l, &(other, other_coefficient)) in equation.terms[..=k].iter().enumerate() {
                // A term that is there twice meets itself off its own place, and only once.
                let twice = if other == at && l != k { 2.0 } else { 1.0 };
                normal.add(at, other, twice * weight * coefficient * other_coefficient);
            }
        }
    }
    let factor = normal.factorize()?;
    factor.solve(&mut unknowns);
    let squared =
        |(equation, weight): (&Equation, &f64)| weight * equation.residual(&unknowns).powi(2) / equation.variance;
    let cost = equations.iter().zip(&weights).map(squared).sum();
    Some(Solution { unknowns, factor, weights, cost })
}

/// The robust solution: iteratively reweighted.
pub fn solve(count: usize, equations: &[Equation]) -> Option<Solution> {
    let mut solution = solve_weighted(count, equations, vec![1.0; equations.len()])?;
    for _ in 0..REWEIGHTINGS {
        let weights = equations.iter().map(|equation| equation.weight(&solution.unknowns)).collect();
        solution = solve_weighted(count, equations, weights)?;
    }
    Some(solution)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn equation(terms: &[(usize, f64)], right: f64, has_outliers: bool) -> Equation {
        Equation { terms: terms.to_vec(), right, variance: 0.01, has_outliers }
    }

    #[test]
    fn repeated_terms_add_up_and_the_cost_is_that_of_the_residuals() {
        // (1 + 2) x = 6 and x = 1: 9 x + x = 18 + 1.
        let equations = [equation(&[(0, 1.0), (0, 2.0)], 6.0, false), equation(&[(0, 1.0)], 1.0, false)];
        let solution = solve(1, &equations).expect("determined");
        assert!((solution.unknowns[0] - 1.9).abs() < 1e-12);
        assert!((solution.cost - (0.3_f64.powi(2) + 0.9_f64.powi(2)) / 0.01).abs() < 1e-9);
        assert!(solve(2, &equations).is_none(), "nothing is said of the second unknown");
    }

    #[test]
    fn an_outlier_does_not_carry_the_rest_away() {
        let mut equations: Vec<Equation> = (0..9).map(|i| equation(&[(0, 1.0)], 0.01 * f64::from(i), true)).collect();
        equations.push(equation(&[(0, 1.0)], 50.0, true));
        let solution = solve(1, &equations).expect("determined");
        assert!((solution.unknowns[0] - 0.04).abs() < 0.02, "{:?}", solution.unknowns);
        assert!(solution.weights[9] < 1e-3);
    }
}
