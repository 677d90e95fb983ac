//! Error figures of a set of position estimates.

use serde::Serialize;

use crate::types::{PositionM, distance_m};

/// Figures of the position errors \[m\] of n estimates.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct ErrorFigures {
    pub n: usize,
    pub rmse_m: f64,
    pub median_m: f64,
    pub p90_m: f64,
    pub p95_m: f64,
    pub max_m: f64,
    /// Share of the errors over 10 m.
    pub share_over_10m: f64,
    /// Share of the errors up to each of [`RECALL_M`].
    pub recall: [f64; 4],
    /// 1 − RMSE / RMSE of always giving the same answer, the component-wise median of the learning positions: 1 is
    /// perfect, 0 knows nothing, below 0 misleads.
    pub skill: f64,
}

/// Distances that recalls are counted within \[m\].
pub const RECALL_M: [f64; 4] = [1.0, 2.0, 5.0, 10.0];

impl ErrorFigures {
    /// `know_nothing_m` is the answer that the skill is measured against. `None` for no estimates.
    pub fn of(estimates_m: &[PositionM], truth_m: &[PositionM], know_nothing_m: PositionM) -> Option<Self> {
        let mut errors_m: Vec<f64> = estimates_m.iter().zip(truth_m).map(|(&e, &t)| distance_m(e, t)).collect();
        if errors_m.is_empty() {
            return None;
        }
        errors_m.sort_by(f64::total_cmp);
        let rmse_m = root_mean_square(&errors_m);
        let of_median: Vec<f64> = truth_m.iter().map(|&t| distance_m(t, know_nothing_m)).collect();
        Some(Self {
            n: errors_m.len(),
            rmse_m,
            median_m: quantile(&errors_m, 0.5),
            p90_m: quantile(&errors_m, 0.9),
            p95_m: quantile(&errors_m, 0.95),
            max_m: errors_m[errors_m.len() - 1],
            share_over_10m: errors_m.iter().filter(|&&e| e > 10.0).count() as f64 / errors_m.len() as f64,
            recall: RECALL_M
                .map(|within_m| errors_m.partition_point(|&e| e <= within_m) as f64 / errors_m.len() as f64),
            skill: 1.0 - rmse_m / root_mean_square(&of_median),
        })
    }
}

/// Component-wise median; the mean of the two middle values where their number is even.
pub fn component_median(positions: &[PositionM]) -> PositionM {
    [0, 1].map(|axis| {
        let mut values: Vec<f64> = positions.iter().map(|p| p[axis]).collect();
        values.sort_by(f64::total_cmp);
        let middle = values.len() / 2;
        match values.len() {
            0 => 0.0,
            n if n % 2 == 1 => values[middle],
            _ => 0.5 * (values[middle - 1] + values[middle]),
        }
    })
}

/// What regions of 95 % are worth that held the true position in the share `covered` of so many frames. Between the verdicts
/// lies what happens by chance in 95 % of such drives, were their frames independent.
fn coverage_verdict(covered: f64, frames: usize) -> &'static str {
    const STATED: f64 = 0.95;
    let by_chance = BAND_DEVIATIONS * (STATED * (1.0 - STATED) / frames.max(1) as f64).sqrt();
    if covered < STATED - by_chance {
        "over-confident"
    } else if covered > STATED + by_chance {
        "too cautious"
    } else {
        "as stated"
    }
}

/// 1.96 standard deviations hold 95 %.
const BAND_DEVIATIONS: f64 = 1.96;

/// Between these lies the mean NEES of n independent frames with a probability of 95 %: χ² with 2n degrees of freedom over
/// n, by the cube root of Wilson and Hilferty (1931).
pub fn nees_bounds(n: usize) -> [f64; 2] {
    let freedom = 2.0 * n as f64;
    let bound = |z: f64| {
        let a = 2.0 / (9.0 * freedom);
        2.0 * (1.0 - a + z * a.sqrt()).powi(3)
    };
    [bound(-BAND_DEVIATIONS), bound(BAND_DEVIATIONS)]
}

/// What a stated uncertainty is worth whose regions of 95 % held the true position in the share `covered` of so many frames,
/// and whose NEES was so much on average: both must agree. As in `mixed: as stated by coverage, too cautious by NEES`.
pub fn uncertainty_verdict(covered: f64, nees_mean: Option<f64>, frames: usize) -> String {
    let by_coverage = coverage_verdict(covered, frames);
    let [low, high] = nees_bounds(frames.max(1));
    let by_nees = match nees_mean {
        None => by_coverage,
        Some(nees) if nees < low => "too cautious",
        Some(nees) if nees <= high => "as stated",
        Some(_) => "over-confident",
    };
    if by_nees == by_coverage {
        return by_coverage.into();
    }
    format!("mixed: {by_coverage} by coverage, {by_nees} by NEES")
}

pub(crate) fn root_mean_square(values: &[f64]) -> f64 {
    (values.iter().map(|v| v * v).sum::<f64>() / values.len() as f64).sqrt()
}

/// Quantile of sorted values, interpolated linearly between order statistics (Hyndman & Fan 1996, type 7).
pub(crate) fn quantile(sorted: &[f64], q: f64) -> f64 {
    let at = q * (sorted.len() - 1) as f64;
    let (below, fraction) = (at.floor() as usize, at.fract());
    let above = (below + 1).min(sorted.len() - 1);
    sorted[below] + fraction * (sorted[above] - sorted[below])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn figures_equal_hand_computed_ones() {
        let truth_m = [[0.0, 0.0], [10.0, 0.0], [0.0, 10.0], [20.0, 20.0]];
        let estimates_m = [[0.0, 0.0], [13.0, 4.0], [0.0, 11.0], [20.0, 32.0]];
        let figures = ErrorFigures::of(&estimates_m, &truth_m, [5.0, 5.0]).expect("there are estimates");
        // Errors 0, 5, 1, 12.
        assert_eq!((figures.n, figures.max_m, figures.share_over_10m), (4, 12.0, 0.25));
        assert!((figures.rmse_m - (170.0_f64 / 4.0).sqrt()).abs() < 1e-12);
        assert_eq!((figures.median_m, figures.recall), (3.0, [0.5, 0.5, 0.75, 0.75]));
        assert!((figures.p90_m - (5.0 + 0.7 * 7.0)).abs() < 1e-12);
        // From (5, 5): distances² 50, 50, 50, 450.
        assert!((figures.skill - (1.0 - (170.0_f64 / 600.0).sqrt())).abs() < 1e-12);
        assert_eq!(ErrorFigures::of(&[], &[], [0.0; 2]), None);
    }

    #[test]
    fn always_the_median_has_no_skill() {
        let truth_m = [[0.0, 0.0], [10.0, 0.0], [0.0, 10.0]];
        let figures = ErrorFigures::of(&[[0.0, 0.0]; 3], &truth_m, [0.0, 0.0]).expect("there are estimates");
        assert!(figures.skill.abs() < 1e-12);
    }

    #[test]
    fn coverage_is_judged_by_how_many_frames_it_is_of() {
        // 1.96 deviations are 4.3 % of 100 frames, 1.35 % of 1000.
        for (covered, frames, expected) in [
            (0.95, 100, "as stated"),
            (0.91, 100, "as stated"),
            (0.91, 1000, "over-confident"),
            (0.90, 100, "over-confident"),
            (0.99, 100, "as stated"),
            (1.0, 100, "too cautious"),
            (1.0, 20, "as stated"),
            (0.97, 1000, "too cautious"),
        ] {
            assert_eq!(coverage_verdict(covered, frames), expected, "{covered} of {frames}");
        }
    }

    #[test]
    fn bounds_of_the_mean_nees_are_those_of_chi_square() {
        // Quantiles of χ²(200) at 2.5 and 97.5 %: 162.728, 241.058 (scipy.stats.chi2.ppf).
        let [low, high] = nees_bounds(100);
        assert!((low - 1.627_28).abs() < 2e-3 && (high - 2.410_58).abs() < 2e-3, "{low} {high}");
    }

    #[test]
    fn coverage_and_nees_must_agree() {
        let verdict = |covered: f64, nees: f64| uncertainty_verdict(covered, Some(nees), 100);
        assert_eq!(verdict(0.95, 2.0), "as stated");
        assert_eq!(verdict(0.8, 6.0), "over-confident");
        assert_eq!(verdict(1.0, 0.4), "too cautious");
        assert_eq!(verdict(0.96, 0.4), "mixed: as stated by coverage, too cautious by NEES");
        assert_eq!(verdict(0.96, f64::INFINITY), "mixed: as stated by coverage, over-confident by NEES");
        assert_eq!(uncertainty_verdict(0.8, None, 100), "over-confident");
    }

    #[test]
    fn median_is_component_wise() {
        assert_eq!(component_median(&[[0.0, 5.0], [1.0, 1.0], [9.0, 2.0]]), [1.0, 2.0]);
        assert_eq!(component_median(&[[0.0, 5.0], [1.0, 1.0]]), [0.5, 3.0]);
    }
}
