//! Log-likelihoods of validation images on the candidate cells.

use std::array;

use crate::types::PositionM;

/// Log-likelihoods of validation images: for every query, feature and candidate cell.
///
/// The cells are kept in blocks of neighbours in the plane, and the blocks in groups, both with their smallest values:
/// that is what makes elimination fast.
pub struct LikelihoodTable {
    pub(super) features: usize,
    pub(super) centers_m: Vec<PositionM>,
    /// The cells in the order they are kept in: see [`neighbours_together`].
    pub(super) order: Vec<u32>,
    pub(super) queries: Vec<Query>,
}

pub(super) struct Query {
    pub truth_m: PositionM,
    /// Feature × cell.
    log_likelihood: Vec<f32>,
    /// The last rows once more, filled up so that blocks may reach beyond the last cell.
    last_rows: Vec<f32>,
    cells: usize,
    /// Feature × group × block: the smallest value.
    pub block_minimum: Vec<[f32; GROUP]>,
    /// Group × feature, [`LANES`] features together: the smallest value of the whole group.
    pub group_minimum: Vec<[f32; LANES]>,
    /// The greatest |value|.
    pub greatest_size: f32,
}

/// Cells a block: small against the number of cells.
pub(super) const BLOCK: usize = 16;
/// Blocks a group.
pub(super) const GROUP: usize = 8;
/// Features whose bounds are looked at together.
pub(super) const LANES: usize = 8;

impl LikelihoodTable {
    pub fn new(features: usize, centers_m: Vec<PositionM>) -> Self {
        let order = neighbours_together(&centers_m);
        Self { features, centers_m, order, queries: Vec::new() }
    }

    /// Adds one validation image; `log_likelihood` is feature × cell.
    ///
    /// # Panics
    /// When the table is not of that size.
    pub fn push(&mut self, truth_m: PositionM, mut log_likelihood: Vec<f32>) {
        let cells = self.centers_m.len();
        assert_eq!(log_likelihood.len(), self.features * cells, "one value a feature and cell");
        let (groups, rows) = (self.groups(), self.features.div_ceil(LANES));
        let mut block_minimum = Vec::with_capacity(self.features * groups);
        let mut group_minimum = vec![[0.0; LANES]; groups * rows];
        let mut sizes = [0.0_f32; BLOCK];
        let mut ordered = vec![[0.0; BLOCK]; groups * GROUP];
        for (r, row) in log_likelihood.chunks_exact_mut(cells.max(1)).enumerate() {
            for (value, &cell) in ordered.as_flattened_mut().iter_mut().zip(&self.order) {
                *value = row[cell as usize];
            }
            for (group, blocks) in ordered.as_chunks::<GROUP>().0.iter().enumerate() {
                let minima = array::from_fn(|block| least_of(&blocks[block]));
                for block in blocks {
                    sizes.iter_mut().zip(block).for_each(|(size, value)| *size = greater(*size, value.abs()));
                }
                group_minimum[group * rows + r / LANES][r % LANES] = least_of(&minima);
                block_minimum.push(minima);
            }
            row.copy_from_slice(&ordered.as_flattened()[..cells]);
        }
        let greatest_size = sizes.into_iter().fold(0.0, greater);
        let whole_groups = self.order.len();
        let first = (0..self.features).find(|r| r * cells + whole_groups > log_likelihood.len()).unwrap_or(0);
        let mut last_rows = log_likelihood[first * cells..].to_vec();
        last_rows.resize(last_rows.len() + whole_groups - cells, 0.0);
        self.queries.push(Query {
            truth_m,
            log_likelihood,
            last_rows,
            cells,
            block_minimum,
            group_minimum,
            greatest_size,
        });
    }

    pub(super) fn groups(&self) -> usize {
        self.order.len() / (GROUP * BLOCK)
    }
}

impl Query {
    /// The values of feature `r` in the order of the table, by blocks. Beyond the last cell there is something.
    pub fn blocks(&self, r: usize) -> &[[f32; BLOCK]] {
        let (first, length) = (r * self.cells, self.cells.next_multiple_of(GROUP * BLOCK));
        let row = self.log_likelihood.get(first..first + length).unwrap_or_else(|| {
            let first = self.last_rows.len() - length - (self.log_likelihood.len() - self.cells - first);
            &self.last_rows[first..first + length]
        });
        row.as_chunks().0
    }
}

/// The indices of `centers_m` in an order in which every [`BLOCK`] of them are neighbours, and nearly so every group: a
/// k-d tree, which halves the cells along the longer side of their bounding box. Within a block the indices rise, so that
/// the first of equals is also the one of smallest index. The last group is filled up with repetitions of the last cell.
fn neighbours_together(centers_m: &[PositionM]) -> Vec<u32> {
    let mut order: Vec<u32> = (0..centers_m.len() as u32).collect();
    let mut parts: Vec<&mut [u32]> = vec![&mut order];
    while let Some(part) = parts.pop() {
        if part.len() <= BLOCK {
            part.sort_unstable();
            continue;
        }
        let coordinate = |cell: u32, axis: usize| centers_m[cell as usize][axis];
        let side_m = |axis: usize| {
            let along = part.iter().map(|&cell| coordinate(cell, axis));
            let (low, high) =
                along.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), c| (low.min(c), high.max(c)));
            high - low
        };
        let axis = usize::from(side_m(1) > side_m(0));
        // Whole blocks, so that only the very last may be short.
        let half = part.len().div_ceil(BLOCK).div_ceil(2) * BLOCK;
        part.select_nth_unstable_by(half, |&a, &b| coordinate(a, axis).total_cmp(&coordinate(b, axis)).then(a.cmp(&b)));
        let (low, high) = part.split_at_mut(half);
        parts.extend([low, high]);
    }
    let last = order.last().copied().unwrap_or(0);
    order.resize(centers_m.len().next_multiple_of(GROUP * BLOCK), last);
    order
}

/// The least of `values`, compared in pairs so that several are compared at once. `N` is a power of two.
#[inline(always)]
fn least_of<const N: usize>(values: &[f32; N]) -> f32 {
    let mut values = *values;
    let mut half = N / 2;
    while half > 0 {
        for i in 0..half {
            values[i] = if values[i + half] < values[i] { values[i + half] } else { values[i] };
        }
        half /= 2;
    }
    values[0]
}

/// `f32::max` as one instruction: it need not mind NaN.
#[inline(always)]
fn greater(a: f32, b: f32) -> f32 {
    if a > b { a } else { b }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn blocks_hold_neighbours_and_every_cell_once() {
        let centers_m: Vec<PositionM> = (0..55 * 79).map(|i| [f64::from(i % 55), f64::from(i / 55)]).collect();
        let order = neighbours_together(&centers_m);
        let mut sorted = order[..centers_m.len()].to_vec();
        sorted.sort_unstable();
        assert!(sorted.iter().enumerate().all(|(i, &cell)| i == cell as usize));
        assert_eq!(order.len(), 34 * GROUP * BLOCK);
        for block in order[..centers_m.len()].chunks(BLOCK) {
            assert!(block.is_sorted());
            for axis in [0, 1] {
                let along = block.iter().map(|&cell| centers_m[cell as usize][axis]);
                let side_m = along.clone().fold(f64::MIN, f64::max) - along.fold(f64::MAX, f64::min);
                assert!(side_m <= 7.0, "{side_m} m for 16 cells of 1 m");
            }
        }
    }

    #[test]
    fn a_table_without_cells_or_of_one_place_is_ordered_too() {
        assert!(neighbours_together(&[]).is_empty());
        let order = neighbours_together(&[[3.0, 3.0]; 40]);
        assert_eq!(order.len(), GROUP * BLOCK);
        assert!(order[..40].iter().enumerate().all(|(i, &cell)| i == cell as usize));
    }
}
