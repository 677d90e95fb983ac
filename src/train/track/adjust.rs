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
    /// The length that its error is a share of, if it is; see [`Self::about`].
    pub length: Option<Linear>,
}

/// constant + Σ coefficient · unknown
#[derive(Debug, Clone, PartialEq)]
pub struct Linear {
    pub terms: Vec<(usize, f64)>,
    pub constant: f64,
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
/// A residual that is a larger share of its length is no share of it.
const MOST_SHARE: f64 = 0.5;

impl Linear {
    fn at(&self, unknowns: &[f64]) -> f64 {
        self.constant + sum(&self.terms, unknowns)
    }
}

fn sum(terms: &[(usize, f64)], unknowns: &[f64]) -> f64 {
    terms.iter().map(|&(at, coefficient)| coefficient * unknowns[at]).sum()
}

impl Equation {
    /// `missed` = 0, up to an error that is a share of `length` and some of which are far too large.
    pub fn share_of(length: Linear, missed: Linear, variance: f64) -> Self {
        Self { terms: missed.terms, right: -missed.constant, variance, has_outliers: true, length: Some(length) }
    }

    fn residual(&self, unknowns: &[f64]) -> f64 {
        self.right - sum(&self.terms, unknowns)
    }

    /// With its residual r as a share of its length ℓ, linear about `unknowns`: ℓ₀ r / ℓ, where ℓ₀ is the length there.
    ///
    /// A residual as it stands gets smaller when everything shrinks. Where all else that is known is angles and shares, only
    /// the receiver forbids that, and against hundreds of such equations it gives way: drives came out two hundredths short.
    pub fn about(&self, unknowns: &[f64]) -> Self {
        let Some(length) = &self.length else { return self.clone() };
        let residual = self.residual(unknowns);
        let share = residual / length.at(unknowns);
        // Not where a vehicle stands, and is no length on its way.
        if !share.is_finite() || share.abs() > MOST_SHARE {
            return self.clone();
        }
        // d(ℓ₀ r / ℓ) = dr − (r₀ / ℓ₀) dℓ, and dr = −Σ coefficient · d(unknown).
        let mut terms = self.terms.clone();
        terms.extend(length.terms.iter().map(|&(at, coefficient)| (at, share * coefficient)));
        let right = residual + sum(&terms, unknowns);
        Self { terms, right, ..self.clone() }
    }

    fn weight(&self, unknowns: &[f64]) -> f64 {
        match self.has_outliers {
            true => weight_of(self.residual(unknowns) / self.variance.sqrt()),
            false => 1.0,
        }
    }
}

/// What a residual of so many standard deviations counts. Expectation step of the t distribution (Lange, Little & Taylor
/// 1989, eq. 3.5): (ν + 1) / (ν + r²/σ²).
pub fn weight_of(deviations: f64) -> f64 {
    (FREEDOM + 1.0) / (FREEDOM + deviations * deviations)
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
        solution = solve_about(&solution.unknowns, equations)?;
    }
    Some(solution)
}

/// The solution with weights that the residuals at `unknowns` have.
pub fn solve_about(unknowns: &[f64], equations: &[Equation]) -> Option<Solution> {
    let weights = equations.iter().map(|equation| equation.weight(unknowns)).collect();
    solve_weighted(unknowns.len(), equations, weights)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn equation(terms: &[(usize, f64)], right: f64, has_outliers: bool) -> Equation {
        Equation { terms: terms.to_vec(), right, variance: 0.01, has_outliers, length: None }
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

    #[test]
    fn about_is_the_share_of_the_length_to_first_order() {
        let missed = Linear { terms: vec![(0, 0.7), (1, -0.4)], constant: 0.3 };
        let length = Linear { terms: vec![(0, 1.0), (1, 0.5)], constant: 2.0 };
        let equation = Equation::share_of(length.clone(), missed.clone(), 1.0);
        let here = [0.2, -0.6];
        let about = equation.about(&here);
        assert!((about.residual(&here) - equation.residual(&here)).abs() < 1e-12);
        let share = |unknowns: &[f64]| -missed.at(unknowns) / length.at(unknowns) * length.at(&here);
        for axis in 0..2 {
            let step = |by: f64| std::array::from_fn::<f64, 2, _>(|k| here[k] + if k == axis { by } else { 0.0 });
            let slope = |of: &dyn Fn(&[f64]) -> f64| (of(&step(1e-4)) - of(&step(-1e-4))) / 2e-4;
            assert!((slope(&share) - slope(&|unknowns| about.residual(unknowns))).abs() < 1e-6);
        }
        let stands = Linear { constant: -0.7 * 0.2 + 0.4 * -0.6, terms: vec![(0, 0.7), (1, -0.4)] };
        let nothing = Linear { terms: Vec::new(), constant: 0.0 };
        let equation = Equation::share_of(stands, nothing, 1.0);
        assert_eq!(equation.about(&here), equation, "no length");
    }

    #[test]
    fn what_is_known_as_shares_does_not_shrink() {
        // To and fro in steps of about a metre, whose ratios are known, as is that the next is about as long, to a tenth.
        // How long they are says the receiver alone, whose error changes slowly and is none: nothing is wrong.
        const STEPS: usize = 400;
        let direction = |i: usize| if (i / 20).is_multiple_of(2) { 1.0 } else { -1.0 };
        let steps_m: Vec<f64> = (0..STEPS).map(|i| 1.0 + 0.1 * (2.4 * i as f64).sin()).collect();
        let kept = (-1.0_f64 / 20.0).exp();
        let mut equations = vec![equation(&[(0, 1.0)], 0.0, false)];
        let receiver = |i: usize| Equation {
            variance: 0.36 * (1.0 - kept * kept),
            ..equation(&[(i + 1, 1.0), (i, -kept)], 0.0, false)
        };
        equations.extend((0..STEPS).map(receiver));
        // Σ by · step of the steps i − 1 and i, less their errors.
        let steps = |i: usize, by: [f64; 2]| {
            let [before, here] = [by[0] * direction(i - 1), by[1] * direction(i)];
            Linear {
                terms: vec![(i - 1, before), (i, here - before), (i + 1, -here)],
                constant: by[0] * steps_m[i - 1] + by[1] * steps_m[i],
            }
        };
        for i in 1..STEPS {
            let ratio = [1.0 / steps_m[i - 1], -1.0 / steps_m[i]];
            equations.push(Equation::share_of(steps(i, [0.5, 0.5]), steps(i, ratio), 1e-4));
            equations.push(Equation::share_of(steps(i, [0.5, 0.5]), steps(i, [1.0, -1.0]), 0.01));
        }
        let length_m = |unknowns: &[f64]| {
            let step_m = |i: usize| steps_m[i] - direction(i) * (unknowns[i + 1] - unknowns[i]);
            (0..STEPS).map(step_m).sum::<f64>()
        };
        let plain = solve(STEPS + 1, &equations).expect("determined");
        assert!(length_m(&plain.unknowns) < 0.98 * length_m(&[0.0; STEPS + 1]), "{}", length_m(&plain.unknowns));
        let mut solution = plain;
        for _ in 0..5 {
            let about: Vec<Equation> = equations.iter().map(|equation| equation.about(&solution.unknowns)).collect();
            solution = solve_about(&solution.unknowns, &about).expect("determined");
        }
        let off = length_m(&solution.unknowns) / length_m(&[0.0; STEPS + 1]) - 1.0;
        assert!(off.abs() < 0.002, "{off}");
    }
}
