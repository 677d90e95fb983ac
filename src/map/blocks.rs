//! Squares of cells that lie together in a map's file, so that a part of a large map can be read by itself.

use std::collections::BTreeMap;

use super::CandidateCells;

/// Cells on either side of a block.
pub const BLOCK_SIDE: u32 = 16;

/// The candidates among the cells of a square.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Block {
    /// Column and row of its first cell in the grid.
    pub corner: [u32; 2],
    /// Indices of its candidates, rising.
    pub cells: Vec<u32>,
}

impl Block {
    /// The blocks that hold `cells`, by row, then column; none is empty.
    pub fn all_of(cells: &CandidateCells) -> Vec<Self> {
        let mut blocks: BTreeMap<[u32; 2], Vec<u32>> = BTreeMap::new();
        for (index, &[i, j]) in (0..).zip(cells.indices()) {
            blocks.entry([j / BLOCK_SIDE, i / BLOCK_SIDE]).or_default().push(index);
        }
        blocks
            .into_iter()
            .map(|([row, column], cells)| Self { corner: [column * BLOCK_SIDE, row * BLOCK_SIDE], cells })
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_cell_lies_in_one_block() {
        let road: Vec<_> = (0..90).map(|i| [f64::from(i), 0.4 * f64::from(i)]).collect();
        let cells = CandidateCells::around(&road, 1.0, Some(4.0)).expect("a small grid");
        let blocks = Block::all_of(&cells);
        let mut all: Vec<u32> = blocks.iter().flat_map(|block| block.cells.clone()).collect();
        all.sort_unstable();
        assert_eq!(all, (0..cells.len() as u32).collect::<Vec<_>>());
        for block in &blocks {
            assert!(block.cells.is_sorted() && !block.cells.is_empty());
            for &cell in &block.cells {
                let at = cells.indices()[cell as usize];
                assert!([0, 1].iter().all(|&axis| (0..BLOCK_SIDE).contains(&(at[axis] - block.corner[axis]))));
            }
        }
    }
}
