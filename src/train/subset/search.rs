//! The best cell of a query without each of the features.

use std::{array, hint};

use multiversion::multiversion;

use super::table::{BLOCK, GROUP, LANES, LikelihoodTable, Query};

/// The search for the cells of greatest log-likelihood of one query.
///
/// With S = Σ_x L_x over the features that are left, leaving out r needs argmax (S − L_r). Two bounds hold over a block or
/// group of cells, where M is what max (S − L_r) was before the features x were removed:
///
/// ```text
/// max (S − L_r) ≤ max S − min L_r        max (S − L_r) ≤ M − Σ_x min L_x
/// ```
///
/// A block that by either cannot reach the best cell found so far is passed over, which is nearly all of them, and mostly
/// by groups. Blocks hold neighbours in the plane, among which S and L_r vary little: that makes the bounds tight. What is
/// found is what a full search finds, exactly; nearly all of the time goes into fetching bounds and values from memory.
pub struct Search<'a> {
    pub query: &'a Query,
    features: usize,
    order: &'a [u32],
    /// Of each block: S, −∞ beyond the last cell.
    sum: Vec<[f64; BLOCK]>,
    /// Group × block, and of each group: max S.
    block_maximum: Vec<[f64; GROUP]>,
    group_maximum: Vec<f64>,
    /// Group × block, and of each group: Σ_x min L_x over the features removed.
    block_removed: Vec<[f64; GROUP]>,
    group_removed: Vec<f64>,
    /// Group × feature.
    block_bounds: Vec<Bounds>,
    /// Group × feature, [`LANES`] features together: [`Bounds::ceiling`] of the whole group.
    group_ceiling: Vec<[f32; LANES]>,
    /// More than all rounding of what the second bound is made of.
    rounding: f64,
    best: Place,
    /// L_r in the block where S is greatest.
    best_block: Vec<[f32; BLOCK]>,
    /// The best cells without each of the features.
    without: Vec<BestCells>,
    /// Groups that could hold the best cell without a feature, and of each the blocks that could, as bits.
    groups: Vec<Candidate>,
    reached: Vec<u8>,
    blocks: Vec<Candidate>,
}

/// Of a feature in the blocks of a group: min L_r, and at least M + Σ_x min L_x as they were when the block was last
/// searched without this feature. On a cache line of its own.
#[derive(Clone, Copy)]
#[repr(align(64))]
struct Bounds {
    minimum: [f32; GROUP],
    ceiling: [f32; GROUP],
}

/// Where S is greatest; of equals the cell of smallest index.
#[derive(Clone, Copy)]
struct Place {
    block: u32,
    cell: u32,
}

/// Best cell so far without each of [`LANES`] features, and S − L_r there.
#[derive(Clone, Copy)]
struct BestCells {
    value: [f64; LANES],
    cell: [u32; LANES],
}

/// A group or block that could hold the best cell without a feature.
#[derive(Clone, Copy)]
struct Candidate {
    index: u32,
    feature: u32,
}

impl<'a> Search<'a> {
    /// Starts with all features.
    pub fn new(query: &'a Query, table: &'a LikelihoodTable) -> Self {
        let (features, groups) = (table.features, table.groups());
        let mut sum = vec![[0.0; BLOCK]; groups * GROUP];
        sum.as_flattened_mut()[table.centers_m.len()..].fill(f64::NEG_INFINITY);
        let rows: Vec<_> = (0..features).map(|r| query.blocks(r)).collect();
        let (fours, rest) = rows.as_chunks::<4>();
        fours.iter().for_each(|four| add(&mut sum, *four));
        rest.iter().for_each(|&row| add(&mut sum, [row]));
        let of_group = |group| query.block_minimum.iter().skip(group).step_by(groups);
        let mut search = Self {
            query,
            features,
            order: &table.order,
            sum,
            block_maximum: vec![[0.0; GROUP]; groups],
            group_maximum: vec![0.0; groups],
            block_removed: vec![[0.0; GROUP]; groups],
            group_removed: vec![0.0; groups],
            block_bounds: (0..groups)
                .flat_map(of_group)
                .map(|&minimum| Bounds { minimum, ceiling: [f32::INFINITY; GROUP] })
                .collect(),
            group_ceiling: vec![[f32::INFINITY; LANES]; query.group_minimum.len()],
            // Fewer than 8 sums of as many numbers as there are features, every one rounded once.
            rounding: 8.0 * f64::EPSILON * (features as f64).powi(2) * f64::from(query.greatest_size),
            best: Place { block: u32::MAX, cell: 0 },
            best_block: vec![[0.0; BLOCK]; features],
            without: vec![BestCells::NONE; features.div_ceil(LANES)],
            groups: Vec::new(),
            reached: Vec::new(),
            blocks: Vec::new(),
        };
        search.block_maximum.as_flattened_mut().iter_mut().zip(&search.sum).for_each(|(m, sum)| *m = greatest_of(sum));
        search.group_maximum.iter_mut().zip(&search.block_maximum).for_each(|(m, blocks)| *m = greatest_of(blocks));
        search.find_best();
        search
    }

    /// The first cell of greatest S.
    pub fn best(&self) -> usize {
        self.best.cell as usize
    }

    /// The first cell of greatest S − L_r, as it was found last.
    pub fn best_without(&self, r: usize) -> usize {
        self.without[r / LANES].cell[r % LANES] as usize
    }

    /// Takes feature `r` away for good.
    pub fn remove(&mut self, r: usize) {
        subtract(self, self.query.blocks(r));
        self.without[r / LANES].value[r % LANES] = f64::INFINITY;
        let groups = self.group_removed.len();
        let minima = &self.query.block_minimum[r * groups..(r + 1) * groups];
        for (removed, &minimum) in self.block_removed.as_flattened_mut().iter_mut().zip(minima.as_flattened()) {
            *removed += f64::from(minimum);
        }
        let minima = self.query.group_minimum.chunks_exact(self.without.len());
        for (removed, minima) in self.group_removed.iter_mut().zip(minima) {
            *removed += f64::from(minima[r / LANES][r % LANES]);
        }
        self.find_best();
    }

    /// Finds the greatest sum.
    fn find_best(&mut self) {
        let greatest = self.group_maximum.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let maxima = self.block_maximum.as_flattened().iter().enumerate();
        let best = maxima.filter(|&(_, &maximum)| maximum >= greatest).map(|(block, _)| {
            let within = self.sum[block].iter().position(|&sum| sum >= greatest).unwrap_or(0);
            Place { block: block as u32, cell: self.order[block * BLOCK + within] }
        });
        let best = best.min_by_key(|place| place.cell).unwrap_or(Place { block: 0, cell: 0 });
        if best.block != self.best.block {
            for (r, values) in self.best_block.iter_mut().enumerate() {
                *values = self.query.blocks(r)[best.block as usize];
            }
        }
        self.best = best;
    }

    /// Finds the first cell of greatest S − L_r for each of the features `kept`.
    pub fn find_best_without_each(&mut self, kept: &[usize]) {
        // The block of the greatest sum first, for a value that hardly any other block reaches.
        search_best_block(self, kept);
        list_groups(self);
        self.list_blocks();
        search_blocks(self);
    }

    /// Lists the blocks of the groups listed that could be better than what is best so far.
    fn list_blocks(&mut self) {
        bound_blocks(self);
        self.blocks.clear();
        for (&Candidate { index: group, feature }, &reached) in self.groups.iter().zip(&self.reached) {
            let mut reached = reached;
            while reached != 0 {
                let index = group * GROUP as u32 + reached.trailing_zeros();
                reached &= reached - 1;
                if index != self.best.block {
                    self.blocks.push(Candidate { index, feature });
                }
            }
        }
    }
}

impl BestCells {
    /// No cell is better than this: what features that are not kept are left with.
    const NONE: Self = Self { value: [f64::INFINITY; LANES], cell: [0; LANES] };

    /// Improves the best without a feature by S − L_r in a block, whose cells are the first of `order`; of equals the cell
    /// of smallest index. Returns the greatest of the block.
    #[inline(always)]
    fn improve(&mut self, lane: usize, differences: &[f64; BLOCK], order: &[u32]) -> f64 {
        let greatest = greatest_of(differences);
        if greatest >= self.value[lane] {
            let within = differences.iter().position(|&difference| difference == greatest).unwrap_or(0);
            if greatest > self.value[lane] || order[within] < self.cell[lane] {
                (self.value[lane], self.cell[lane]) = (greatest, order[within]);
            }
        }
        greatest
    }
}

/// Adds several rows at a time, one after the other: the sums are fetched but once.
fn add<const ROWS: usize>(sum: &mut [[f64; BLOCK]], rows: [&[[f32; BLOCK]]; ROWS]) {
    for (block, sum) in sum.iter_mut().enumerate() {
        for row in rows {
            sum.iter_mut().zip(&row[block]).for_each(|(sum, &l)| *sum += f64::from(l));
        }
    }
}

/// Takes L_r off the sums, and finds the greatest of every block and of every group.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2+fma"))]
fn subtract(search: &mut Search, row: &[[f32; BLOCK]]) {
    let groups = search.sum.as_chunks_mut::<GROUP>().0.iter_mut().zip(row.as_chunks::<GROUP>().0);
    for (((sum, row), of_blocks), of_group) in groups.zip(&mut search.block_maximum).zip(&mut search.group_maximum) {
        for ((sum, values), maximum) in sum.iter_mut().zip(row).zip(of_blocks.iter_mut()) {
            *sum = difference(sum, values);
            *maximum = greatest_of(sum);
        }
        *of_group = greatest_of(of_blocks);
    }
}

#[inline(always)]
fn difference(sum: &[f64; BLOCK], values: &[f32; BLOCK]) -> [f64; BLOCK] {
    array::from_fn(|i| sum[i] - f64::from(values[i]))
}

/// Lists the groups that by their bounds could be better than what is best so far.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2+fma"))]
fn list_groups(search: &mut Search) {
    search.groups.clear();
    let rows = search.without.len().max(1);
    let bounds = search.group_ceiling.chunks_exact(rows).zip(search.query.group_minimum.chunks_exact(rows));
    for (group, (ceilings, minima)) in bounds.enumerate() {
        let (maximum, removed) = (search.group_maximum[group], search.group_removed[group]);
        for (row, (best, ceilings)) in search.without.iter().zip(ceilings).enumerate() {
            // Without a branch a feature: hardly any can be better in this group.
            let mut any = false;
            for (ceiling, value) in ceilings.iter().zip(&best.value) {
                any |= f64::from(*ceiling) - removed >= *value;
            }
            if !any {
                continue;
            }
            let mut reached = 0_u8;
            for (lane, value) in best.value.iter().enumerate() {
                let (since, now) = (f64::from(ceilings[lane]) - removed, maximum - f64::from(minima[row][lane]));
                reached |= u8::from((since >= *value) & (now >= *value)) << lane;
            }
            while reached != 0 {
                let feature = (row * LANES) as u32 + reached.trailing_zeros();
                reached &= reached - 1;
                search.groups.push(Candidate { index: group as u32, feature });
            }
        }
    }
}

/// Which blocks of the groups listed could be better than what is best so far; and the groups' ceilings anew.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2+fma"))]
fn bound_blocks(search: &mut Search) {
    search.reached.clear();
    let bounds = search
        .groups
        .iter()
        .map(|group| &search.block_bounds[group.index as usize * search.features + group.feature as usize]);
    fetch(bounds.map(|bounds| bounds.ceiling[0]));
    for candidate in &search.groups {
        let (group, feature) = (candidate.index as usize, candidate.feature as usize);
        let (row, lane) = (feature / LANES, feature % LANES);
        let (maxima, removed) = (&search.block_maximum[group], &search.block_removed[group]);
        let Bounds { minimum, ceiling } = &search.block_bounds[group * search.features + feature];
        let bounds: [f64; GROUP] = array::from_fn(|block| {
            let (now, since) = (maxima[block] - f64::from(minimum[block]), f64::from(ceiling[block]) - removed[block]);
            if now < since { now } else { since }
        });
        let mut reached = 0_u8;
        for (block, &bound) in bounds.iter().enumerate() {
            reached |= u8::from(bound >= search.without[row].value[lane]) << block;
        }
        search.reached.push(reached);
        let ceiling = greatest_of(&bounds) + search.group_removed[group] + search.rounding;
        search.group_ceiling[group * search.without.len() + row][lane] = (ceiling as f32).next_up();
    }
}

/// Starts the search for each of the features `kept` with the block where S is greatest.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2+fma"))]
fn search_best_block(search: &mut Search, kept: &[usize]) {
    let index = search.best.block as usize;
    let Some(sum) = search.sum.get(index) else { return };
    for &r in kept {
        let best = &mut search.without[r / LANES];
        best.value[r % LANES] = f64::NEG_INFINITY;
        best.improve(r % LANES, &difference(sum, &search.best_block[r]), &search.order[index * BLOCK..]);
    }
}

/// Searches the blocks listed. They are listed first and searched then, so that values of several are on their way from
/// memory at once.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2+fma"))]
fn search_blocks(search: &mut Search) {
    fetch(
        search.blocks.iter().map(|block| search.query.blocks(block.feature as usize)[block.index as usize][BLOCK - 1]),
    );
    for candidate in &search.blocks {
        let (index, feature) = (candidate.index as usize, candidate.feature as usize);
        let differences = difference(&search.sum[index], &search.query.blocks(feature)[index]);
        let best = &mut search.without[feature / LANES];
        let greatest = best.improve(feature % LANES, &differences, &search.order[index * BLOCK..]);
        let (group, block) = (index / GROUP, index % GROUP);
        let ceiling = greatest + search.block_removed[group][block] + search.rounding;
        search.block_bounds[group * search.features + feature].ceiling[block] = (ceiling as f32).next_up();
    }
}

/// Touches values that are about to be used, so that all of them are on their way from memory at once.
#[inline(always)]
fn fetch(values: impl Iterator<Item = f32>) {
    hint::black_box(values.fold(0, |bits, value| bits | value.to_bits()));
}

/// The greatest of `values`, compared in pairs so that several are compared at once. `N` is a power of two.
#[inline(always)]
fn greatest_of<const N: usize>(values: &[f64; N]) -> f64 {
    let mut values = *values;
    let mut half = N / 2;
    while half > 0 {
        for i in 0..half {
            values[i] = if values[i + half] > values[i] { values[i + half] } else { values[i] };
        }
        half /= 2;
    }
    values[0]
}
