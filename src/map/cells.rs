//! Candidate cells: where the vehicle may be.

use std::ops::Range;

use serde::{Deserialize, Serialize};

use crate::types::{PositionM, distance_m};

/// Cells of a regular grid. Cell (i, j) has its centre at `origin + step · (i, j)`.
#[derive(Debug, Clone, PartialEq)]
pub struct CandidateCells {
    pub grid: Grid,
    /// Cells that are candidates, by row (north), then column.
    cells: Vec<[u32; 2]>,
}

#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Grid {
    pub origin_m: PositionM,
    pub step_m: f64,
    pub columns: u32,
    pub rows: u32,
}

#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum CellsError {
    #[error("grid step {step_m:e} m: expected {MIN_STEP_M} to {MAX_STEP_M} m")]
    BadStep { step_m: f64 },
    #[error(
        "{cells:.0} candidate cells at a grid step of {step_m} m are more than {MAX_CELLS}; use a larger --grid-step-m"
    )]
    TooMany { cells: f64, step_m: f64 },
    #[error(
        "no cell lies within {within_m} m of a learning position: expected a positive number, such as the grid step"
    )]
    NoneNear { within_m: f64 },
}

/// A step outside these bounds is a mistake.
const MIN_STEP_M: f64 = 1e-3;
const MAX_STEP_M: f64 = 1e4;
/// Further from the origin than this is no position on Earth.
const MAX_COORDINATE_M: f64 = 1e8;
/// More cells than this are a mistake in the step or the positions.
const MAX_CELLS: u32 = 1_000_000;

impl CandidateCells {
    /// The grid over the bounding box of `positions`; with `within_m`, only cells at most that far from one of them.
    ///
    /// # Errors
    /// When the step is not positive, or so small that the grid would not fit.
    pub fn around(positions: &[PositionM], step_m: f64, within_m: Option<f64>) -> Result<Self, CellsError> {
        if !(MIN_STEP_M..=MAX_STEP_M).contains(&step_m) {
            return Err(CellsError::BadStep { step_m });
        }
        let bound =
            |axis: usize, pick: fn(f64, f64) -> f64| positions.iter().map(|p| p[axis]).reduce(pick).unwrap_or(0.0);
        let origin_m = [bound(0, f64::min), bound(1, f64::min)];
        // A position on the far border keeps its cell however the division rounds.
        let count = |axis: usize| ((bound(axis, f64::max) - origin_m[axis]) / step_m - 1e-9).ceil().max(0.0) + 1.0;
        let (columns, rows) = (count(0), count(1));
        if columns * rows > f64::from(MAX_CELLS) {
            return Err(CellsError::TooMany { cells: columns * rows, step_m });
        }
        let grid = Grid { origin_m, step_m, columns: columns as u32, rows: rows as u32 };
        let all = (0..grid.rows).flat_map(|j| (0..grid.columns).map(move |i| [i, j]));
        let near = |cell: &[u32; 2]| {
            let center = grid.center_m(*cell);
            within_m.is_none_or(|within_m| positions.iter().any(|&p| distance_m(p, center) <= within_m))
        };
        let cells: Vec<[u32; 2]> = all.filter(near).collect();
        match within_m {
            Some(within_m) if cells.is_empty() => Err(CellsError::NoneNear { within_m }),
            _ => Ok(Self { grid, cells }),
        }
    }

    /// Cells read from a file.
    ///
    /// # Errors
    /// Says which cell lies outside the grid or out of order.
    pub fn from_parts(grid: Grid, cells: Vec<[u32; 2]>) -> Result<Self, String> {
        if !grid.is_plausible() {
            return Err(format!("impossible grid: {} m steps, {} x {} cells", grid.step_m, grid.columns, grid.rows));
        }
        let ordered = cells.windows(2).all(|pair| (pair[0][1], pair[0][0]) < (pair[1][1], pair[1][0]));
        if let Some(cell) = cells.iter().find(|cell| cell[0] >= grid.columns || cell[1] >= grid.rows) {
            return Err(format!("cell {cell:?} outside the grid of {} x {}", grid.columns, grid.rows));
        }
        if !ordered || cells.is_empty() {
            return Err("the cells are not in order".into());
        }
        Ok(Self { grid, cells })
    }

    /// The candidates in a part of the grid, on a grid of their own; `None` if there are none.
    ///
    /// # Panics
    /// When the part lies outside the grid.
    pub fn within(&self, columns: Range<u32>, rows: Range<u32>) -> Option<Self> {
        assert!(columns.end <= self.grid.columns && rows.end <= self.grid.rows, "a part of the grid");
        let grid = Grid {
            origin_m: self.grid.center_m([columns.start, rows.start]),
            columns: columns.end - columns.start,
            rows: rows.end - rows.start,
            ..self.grid
        };
        let inside = self.cells.iter().filter(|[i, j]| columns.contains(i) && rows.contains(j));
        let cells: Vec<[u32; 2]> = inside.map(|[i, j]| [i - columns.start, j - rows.start]).collect();
        (!cells.is_empty()).then_some(Self { grid, cells })
    }

    pub fn len(&self) -> usize {
        self.cells.len()
    }

    pub fn is_empty(&self) -> bool {
        self.cells.is_empty()
    }

    pub fn indices(&self) -> &[[u32; 2]] {
        &self.cells
    }

    /// Centres of all cells, in order \[m\].
    pub fn centers_m(&self) -> Vec<PositionM> {
        self.cells.iter().map(|&cell| self.grid.center_m(cell)).collect()
    }

    pub fn center_m(&self, index: usize) -> PositionM {
        self.grid.center_m(self.cells[index])
    }

    /// The candidate at column `i`, row `j` of the grid, if it is one.
    pub fn index_of(&self, [i, j]: [u32; 2]) -> Option<usize> {
        self.cells.binary_search_by_key(&(j, i), |cell| (cell[1], cell[0])).ok()
    }

    /// The candidates at most `steps` columns and rows from the grid cell nearest to `position_m`.
    pub fn near(&self, position_m: PositionM, steps: i32) -> impl Iterator<Item = usize> {
        let [column, row] = [0, 1].map(|axis| (position_m[axis] - self.grid.origin_m[axis]) / self.grid.step_m);
        let around = move |middle: f64| {
            let places = (-steps..=steps).map(move |step| middle.round() + f64::from(step));
            places.filter(|place| (0.0..=f64::from(u32::MAX)).contains(place)).map(|place| place as u32)
        };
        around(row).flat_map(move |j| around(column).map(move |i| [i, j])).filter_map(|cell| self.index_of(cell))
    }
}

impl Grid {
    /// The step for an area when none is asked for: 0.1 m where the positions lie within a room, 1 m outdoors.
    pub fn usual_step_m(positions: &[PositionM]) -> f64 {
        const ROOM_M: f64 = 20.0;
        let extent_m = crate::gp::fit::extent_m(positions);
        if libm::hypot(extent_m[0], extent_m[1]) < ROOM_M { 0.1 } else { 1.0 }
    }

    /// A grid that training could have made.
    fn is_plausible(&self) -> bool {
        let cells = u64::from(self.columns) * u64::from(self.rows);
        (MIN_STEP_M..=MAX_STEP_M).contains(&self.step_m)
            && self.origin_m.iter().all(|o| o.abs() <= MAX_COORDINATE_M)
            && (1..=u64::from(MAX_CELLS)).contains(&cells)
    }

    fn center_m(&self, [i, j]: [u32; 2]) -> PositionM {
        [self.origin_m[0] + self.step_m * f64::from(i), self.origin_m[1] + self.step_m * f64::from(j)]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_grid_covers_the_bounding_box() {
        let positions = [[1.0, 2.0], [4.2, 2.5], [2.0, 3.0]];
        let cells = CandidateCells::around(&positions, 0.5, None).expect("a small grid");
        assert_eq!((cells.grid.columns, cells.grid.rows, cells.len()), (8, 3, 24));
        assert_eq!(cells.center_m(0), [1.0, 2.0]);
        assert_eq!(cells.center_m(23), [4.5, 3.0]);
        for (index, &cell) in cells.indices().iter().enumerate() {
            assert_eq!(cells.index_of(cell), Some(index));
        }
    }

    #[test]
    fn far_cells_are_left_out() {
        let cells = CandidateCells::around(&[[0.0, 0.0], [10.0, 10.0]], 1.0, Some(1.5)).expect("a small grid");
        assert_eq!(cells.len(), 2 * 4);
        assert_eq!(cells.index_of([5, 5]), None);
        assert_eq!(cells.index_of([1, 1]).map(|index| cells.center_m(index)), Some([1.0, 1.0]));
    }

    #[test]
    fn a_part_keeps_its_places() {
        let cells = CandidateCells::around(&[[0.0, 0.0], [10.0, 10.0]], 0.5, Some(2.0)).expect("a small grid");
        assert_eq!(cells.within(0..3, 15..21), None);
        let part = cells.within(14..21, 16..20).expect("the far corner");
        let inside = |p: &&PositionM| (7.0..=10.0).contains(&p[0]) && (8.0..=9.5).contains(&p[1]);
        assert_eq!(part.centers_m(), cells.centers_m().iter().filter(inside).copied().collect::<Vec<_>>());
        assert!(part.len() > 4 && part.index_of([6, 3]).is_some());
    }

    #[test]
    fn impossible_steps_are_refused() {
        for step_m in [0.0, -1.0, f64::NAN, f64::INFINITY] {
            assert!(matches!(CandidateCells::around(&[[0.0, 0.0]], step_m, None), Err(CellsError::BadStep { .. })));
        }
        let error = CandidateCells::around(&[[0.0, 0.0], [1e6, 1e6]], 0.1, None).expect_err("too many");
        assert!(error.to_string().contains("--grid-step-m"), "{error}");
    }
}
