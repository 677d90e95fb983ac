//! From a log-likelihood over cells to a position.

use crate::map::CandidateCells;
use crate::types::PositionM;

/// First cell of greatest log-likelihood.
///
/// # Panics
/// For an empty list.
pub fn most_likely_cell(log_likelihood: &[f32]) -> usize {
    assert!(!log_likelihood.is_empty(), "a map has cells");
    let greatest = log_likelihood.iter().copied().fold(f32::NEG_INFINITY, f32::max);
    log_likelihood.iter().position(|&value| value >= greatest).unwrap_or(0)
}

/// The summit of the parabolas through the best cell and its neighbours, axis by axis: where the likelihood is smooth,
/// its maximum lies between the cells. Never further than half a cell from the best one; an axis along which a
/// neighbour is no candidate keeps the cell's centre.
pub fn refined_m(cells: &CandidateCells, log_likelihood: &[f32], best: usize) -> PositionM {
    let [i, j] = cells.indices()[best];
    let at = |i: Option<u32>, j: Option<u32>| {
        let index = cells.index_of([i?, j?])?;
        Some(f64::from(log_likelihood[index]))
    };
    let peak = f64::from(log_likelihood[best]);
    let offset = |before: Option<f64>, after: Option<f64>| match (before, after) {
        (Some(before), Some(after)) => {
            let curvature = before - 2.0 * peak + after;
            if curvature < 0.0 { (0.5 * (before - after) / curvature).clamp(-0.5, 0.5) } else { 0.0 }
        }
        _ => 0.0,
    };
    let east = offset(at(i.checked_sub(1), Some(j)), at(Some(i + 1), Some(j)));
    let north = offset(at(Some(i), j.checked_sub(1)), at(Some(i), Some(j + 1)));
    let center_m = cells.center_m(best);
    [center_m[0] + east * cells.grid.step_m, center_m[1] + north * cells.grid.step_m]
}

/// The [refined](refined_m) best cell among those at most [`SUMMIT_STEPS`] from `position_m`; `None` where none of them is
/// a candidate.
pub fn summit_near(cells: &CandidateCells, log_likelihood: &[f32], position_m: PositionM) -> Option<PositionM> {
    let near = cells.near(position_m, SUMMIT_STEPS);
    let best = near.max_by(|&a, &b| log_likelihood[a].total_cmp(&log_likelihood[b]))?;
    Some(refined_m(cells, log_likelihood, best))
}

/// A hill's mean and its summit are no further apart.
const SUMMIT_STEPS: i32 = 2;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_summit_of_a_paraboloid_is_found_between_the_cells() {
        let cells = CandidateCells::around(&[[0.0, 0.0], [5.0, 4.0]], 0.5, None).expect("a small grid");
        let summit_m = [2.13, 1.39];
        let log_likelihood: Vec<f32> = cells
            .centers_m()
            .iter()
            .map(|c| (-3.0 * (c[0] - summit_m[0]).powi(2) - 1.5 * (c[1] - summit_m[1]).powi(2)) as f32)
            .collect();
        let best = most_likely_cell(&log_likelihood);
        assert_eq!(cells.center_m(best), [2.0, 1.5]);
        let refined_m = refined_m(&cells, &log_likelihood, best);
        assert_eq!(summit_near(&cells, &log_likelihood, [3.0, 1.0]), Some(refined_m), "two cells off");
        assert_eq!(summit_near(&cells, &log_likelihood, [1e30, -1e30]), None, "no cell is near");
        assert!(
            (refined_m[0] - summit_m[0]).abs() < 1e-5 && (refined_m[1] - summit_m[1]).abs() < 1e-5,
            "{refined_m:?}"
        );
    }

    #[test]
    fn a_summit_on_the_border_stays_on_its_cell() {
        let cells = CandidateCells::around(&[[0.0, 0.0], [1.0, 1.0]], 0.5, None).expect("a small grid");
        let log_likelihood: Vec<f32> = cells.centers_m().iter().map(|c| (-c[0] - c[1]) as f32).collect();
        assert_eq!(refined_m(&cells, &log_likelihood, most_likely_cell(&log_likelihood)), [0.0, 0.0]);
    }
}
