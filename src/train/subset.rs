//! Which features to keep: backward sequential elimination on validation images.

use multiversion::multiversion;
use rayon::prelude::*;

use crate::metrics::component_median;
use crate::types::{PositionM, distance_m};

/// Log-likelihoods of validation images: for every query, feature and candidate cell.
///
/// Every query's cells are also summarised in blocks, which is what makes elimination fast; see
/// [`backward_elimination`].
pub struct LikelihoodTable {
    features: usize,
    centers_m: Vec<PositionM>,
    queries: Vec<Query>,
}

struct Query {
    truth_m: PositionM,
    /// Feature × block: the values of [`BLOCK`] cells, zeros beyond the last cell.
    log_likelihood: Vec<Block>,
    /// [`LANES`] features × block × feature: the smallest value of each block.
    block_minimum: Vec<[f32; LANES]>,
}

/// Values of neighbouring cells: just a cache line.
#[derive(Clone, Copy)]
#[repr(align(64))]
struct Block([f32; BLOCK]);

/// Cells a block: small against the number of cells.
const BLOCK: usize = 16;
/// Features whose bounds are looked at together.
const LANES: usize = 8;

impl LikelihoodTable {
    pub fn new(features: usize, centers_m: Vec<PositionM>) -> Self {
        Self { features, centers_m, queries: Vec::new() }
    }

    /// Adds one validation image; `log_likelihood` is feature × cell.
    ///
    /// # Panics
    /// When the table is not of that size.
    pub fn push(&mut self, truth_m: PositionM, log_likelihood: &[f32]) {
        let cells = self.centers_m.len();
        assert_eq!(log_likelihood.len(), self.features * cells, "one value a feature and cell");
        let (blocks, rows) = (cells.div_ceil(BLOCK), self.features.div_ceil(LANES));
        let mut query = Query {
            truth_m,
            log_likelihood: vec![Block([0.0; BLOCK]); blocks * self.features],
            block_minimum: vec![[0.0; LANES]; blocks * rows],
        };
        for (r, row) in log_likelihood.chunks_exact(cells.max(1)).enumerate() {
            for (block, values) in row.chunks(BLOCK).enumerate() {
                query.log_likelihood[r * blocks + block].0[..values.len()].copy_from_slice(values);
                query.block_minimum[r / LANES * blocks + block][r % LANES] = least_of(values);
            }
        }
        self.queries.push(query);
    }

    pub fn queries(&self) -> usize {
        self.queries.len()
    }

    /// The estimate of every query from the features `kept`: the first cell of greatest summed log-likelihood.
    pub fn estimates_m(&self, kept: &[usize]) -> Vec<PositionM> {
        self.queries.par_iter().map(|query| self.centers_m[RunningSum::over(query, kept, self).best]).collect()
    }
}

/// The path of a backward elimination.
#[derive(Debug, Clone, PartialEq)]
pub struct Elimination {
    /// Features in the order they were removed, all of them.
    pub removed: Vec<usize>,
    /// Validation RMSE \[m\] with 0, 1, … features removed; the last is that of answering the median position.
    pub rmse_m: Vec<f64>,
}

impl Elimination {
    /// The set of least RMSE on the path, in rising order; of equals the smallest. Do et al. (2015), eq. 14, with the
    /// empty set as a candidate: an empty answer says that no feature helps.
    pub fn best_subset(&self) -> Vec<usize> {
        let least = self.rmse_m.iter().copied().fold(f64::INFINITY, f64::min);
        let removed = self.rmse_m.iter().rposition(|&rmse_m| rmse_m == least).unwrap_or(0);
        self.subset_after(removed)
    }

    /// What is left after `removed` removals, in rising order.
    pub fn subset_after(&self, removed: usize) -> Vec<usize> {
        let mut kept = self.removed[removed..].to_vec();
        kept.sort_unstable();
        kept
    }
}

/// Backward sequential elimination, Do et al. (2015), eqs. 12–14 and Algorithm 1, line 5:
///
/// ```text
/// RMSE(Ω) = √(1/n Σ_i |s_i − s*_i(Ω)|²)        Ω_(l−1) = Ω_l − argmin_r RMSE(Ω_l − r)
/// ```
///
/// Ties remove the smallest index. `on_step` is called after every removal.
///
/// With S = Σ_r L_r kept for every query and cell, trying to remove r needs argmax (S − L_r). Over a block of cells
/// max (S − L_r) ≤ max S − min L_r: blocks that cannot beat the best cell found so far are passed over, which is nearly
/// all of them. The result is that of the full search, exactly.
pub fn backward_elimination(table: &LikelihoodTable, on_step: impl Fn(usize)) -> Elimination {
    let mut kept: Vec<usize> = (0..table.features).collect();
    let mut sums: Vec<RunningSum> =
        table.queries.par_iter().map(|query| RunningSum::over(query, &kept, table)).collect();
    let mut path = Elimination { removed: Vec::new(), rmse_m: Vec::new() };
    let square = |query: &Query, cell: usize| distance_m(table.centers_m[cell], query.truth_m).powi(2);
    let rmse_m = |sum: f64| (sum / table.queries.len() as f64).sqrt();
    let at_start = table.queries.iter().zip(&sums).map(|(query, sum)| square(query, sum.best)).sum();
    path.rmse_m.push(rmse_m(at_start));

    while kept.len() > 1 {
        // Sum over the queries of the squared error without each of the kept features.
        let of_queries: Vec<Vec<f64>> = table
            .queries
            .par_iter()
            .zip(&sums)
            .map(|(query, sum)| {
                let best = sum.best_without_each(query, &kept);
                kept.iter().map(|&r| square(query, best[r / LANES].cell[r % LANES])).collect()
            })
            .collect();
        // In the order of the queries, so that rounding, and with it ties, is the same on any number of threads.
        let mut squared_errors = vec![0.0; kept.len()];
        for of_query in of_queries {
            squared_errors.iter_mut().zip(of_query).for_each(|(sum, square)| *sum += square);
        }
        let least = squared_errors.iter().copied().fold(f64::INFINITY, f64::min);
        let position = squared_errors.iter().position(|&error| error <= least).unwrap_or(0);
        let removed = kept.remove(position);
        table.queries.par_iter().zip(&mut sums).for_each(|(query, sum)| sum.remove(query, removed));
        path.removed.push(removed);
        path.rmse_m.push(rmse_m(least));
        on_step(path.removed.len());
    }
    path.removed.extend(kept);
    path.rmse_m.push(median_rmse_m(table));
    path
}

/// RMSE of answering the component-wise median of the true positions: Ω = ∅.
fn median_rmse_m(table: &LikelihoodTable) -> f64 {
    let truths: Vec<PositionM> = table.queries.iter().map(|query| query.truth_m).collect();
    let center = component_median(&truths);
    let sum: f64 = truths.iter().map(|&truth| distance_m(truth, center).powi(2)).sum();
    (sum / truths.len() as f64).sqrt()
}

impl Query {
    fn of_feature(&self, r: usize, blocks: usize) -> &[Block] {
        &self.log_likelihood[r * blocks..(r + 1) * blocks]
    }
}

/// S = Σ_r L_r over the kept features, for one query.
struct RunningSum {
    features: usize,
    /// By blocks, as in [`Query`]; −∞ beyond the last cell.
    sum: Vec<[f64; BLOCK]>,
    block_maximum: Vec<f64>,
    /// First cell of greatest sum.
    best: usize,
}

impl RunningSum {
    fn over(query: &Query, kept: &[usize], table: &LikelihoodTable) -> Self {
        let cells = table.centers_m.len();
        let mut sum = vec![[0.0; BLOCK]; cells.div_ceil(BLOCK)];
        sum.as_flattened_mut()[cells..].fill(f64::NEG_INFINITY);
        for &r in kept {
            for (sum, values) in sum.iter_mut().zip(query.of_feature(r, cells.div_ceil(BLOCK))) {
                sum.iter_mut().zip(&values.0).for_each(|(sum, &l)| *sum += f64::from(l));
            }
        }
        let mut running = Self { features: table.features, sum, block_maximum: Vec::new(), best: 0 };
        running.summarise();
        running
    }

    fn remove(&mut self, query: &Query, r: usize) {
        let blocks = self.sum.len();
        for (sum, values) in self.sum.iter_mut().zip(query.of_feature(r, blocks)) {
            sum.iter_mut().zip(&values.0).for_each(|(sum, &l)| *sum -= f64::from(l));
        }
        self.summarise();
    }

    fn summarise(&mut self) {
        self.block_maximum.clear();
        self.block_maximum.extend(self.sum.iter().map(greatest_of));
        let greatest = self.block_maximum.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let block = self.block_maximum.iter().position(|&maximum| maximum >= greatest).unwrap_or(0);
        let within = self.sum.get(block).and_then(|sums| sums.iter().position(|&sum| sum >= greatest));
        self.best = block * BLOCK + within.unwrap_or(0);
    }

    /// First cell of greatest S − L_r for each of the features `kept`.
    fn best_without_each(&self, query: &Query, kept: &[usize]) -> Vec<BestCells> {
        let mut best = vec![BestCells::NONE; self.features.div_ceil(LANES)];
        let start = self.best / BLOCK;
        for &r in kept {
            // The block of the greatest sum first, for a bound that hardly any other block reaches.
            best[r / LANES].value[r % LANES] = f64::NEG_INFINITY;
        }
        let mut candidates: Vec<Candidate> = kept.iter().map(|&r| Candidate::new(start, r)).collect();
        search(&candidates, self, query, &mut best);
        candidates.clear();
        list_candidates(self, query, &best, &mut candidates);
        search(&candidates, self, query, &mut best);
        best
    }
}

/// A block that could hold the best cell without a feature.
#[derive(Clone, Copy)]
struct Candidate {
    block: u32,
    feature: u32,
}

impl Candidate {
    fn new(block: usize, feature: usize) -> Self {
        Self { block: block as u32, feature: feature as u32 }
    }
}

/// Best cell so far without each of [`LANES`] features, and S − L_r there.
#[derive(Clone, Copy)]
struct BestCells {
    value: [f64; LANES],
    cell: [usize; LANES],
}

/// Every block that could beat what is in `best`.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2+fma"))]
fn list_candidates(sum: &RunningSum, query: &Query, best: &[BestCells], candidates: &mut Vec<Candidate>) {
    let start = sum.best / BLOCK;
    let rows = query.block_minimum.chunks_exact(sum.block_maximum.len().max(1));
    for (row, (best, minima)) in best.iter().zip(rows).enumerate() {
        for (block, (&maximum, minima)) in sum.block_maximum.iter().zip(minima).enumerate() {
            // Without a branch a feature: most cannot be better in this block.
            let mut possible = false;
            for (value, &minimum) in best.value.iter().zip(minima) {
                possible |= maximum - f64::from(minimum) >= *value;
            }
            if possible && block != start {
                for (lane, (value, &minimum)) in best.value.iter().zip(minima).enumerate() {
                    if maximum - f64::from(minimum) >= *value {
                        candidates.push(Candidate::new(block, row * LANES + lane));
                    }
                }
            }
        }
    }
}

/// Searches the `candidates`. They are listed first and searched then, because nearly all the time goes into fetching
/// their values from memory, and so several are on their way at once.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2+fma"))]
fn search(candidates: &[Candidate], sum: &RunningSum, query: &Query, best: &mut [BestCells]) {
    let blocks = sum.sum.len();
    for candidate in candidates {
        let (block, feature) = (candidate.block as usize, candidate.feature as usize);
        let values = &query.log_likelihood[feature * blocks + block];
        best[feature / LANES].search(feature % LANES, block, &sum.sum[block], values);
    }
}

impl BestCells {
    /// No cell is better than this: what features that are not kept are left with.
    const NONE: Self = Self { value: [f64::INFINITY; LANES], cell: [usize::MAX; LANES] };

    /// Improves the best of feature `lane` by what block `block` holds; of equals the first cell.
    #[inline(always)]
    fn search(&mut self, lane: usize, block: usize, sum: &[f64; BLOCK], values: &Block) {
        let mut differences = *sum;
        differences.iter_mut().zip(&values.0).for_each(|(difference, &l)| *difference -= f64::from(l));
        let greatest = greatest_of(&differences);
        let first = block * BLOCK;
        if greatest > self.value[lane] || (greatest == self.value[lane] && first < self.cell[lane]) {
            let within = differences.iter().position(|&difference| difference == greatest).unwrap_or(0);
            (self.value[lane], self.cell[lane]) = (greatest, first + within);
        }
    }
}

/// The greatest of a block, compared in pairs so that several are compared at once.
#[inline(always)]
fn greatest_of(block: &[f64; BLOCK]) -> f64 {
    let mut values = *block;
    let mut half = BLOCK / 2;
    while half > 0 {
        for i in 0..half {
            values[i] = if values[i + half] > values[i] { values[i + half] } else { values[i] };
        }
        half /= 2;
    }
    values[0]
}

/// The least of at most a block.
fn least_of(values: &[f32]) -> f32 {
    let mut least = [f32::INFINITY; 4];
    for (i, &value) in values.iter().enumerate() {
        least[i % 4] = if value < least[i % 4] { value } else { least[i % 4] };
    }
    least.into_iter().fold(f32::INFINITY, f32::min)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::golden::{golden, list};

    /// The table of `golden.json`, key `backward`.
    fn golden_table() -> LikelihoodTable {
        let centers_m = (0..25).map(|g| [f64::from(g % 5), f64::from(g / 5)]).collect();
        let mut table = LikelihoodTable::new(5, centers_m);
        for q in 0..6 {
            let q = f64::from(q);
            let truth_m = [0.7 * q, (1.3 * q).rem_euclid(4.0)];
            let log_likelihood: Vec<f32> = (0..5 * 25)
                .map(|i| {
                    let (r, g) = (f64::from(i / 25), i % 25);
                    let (x, y) = (f64::from(g % 5), f64::from(g / 5));
                    let far = (x - truth_m[0]).powi(2) + (y - truth_m[1]).powi(2);
                    (-far * (0.2 + 0.1 * r) + 2.5 * (1.7 * q + 2.3 * r + 0.9 * f64::from(g)).sin()) as f32
                })
                .collect();
            table.push(truth_m, &log_likelihood);
        }
        table
    }

    #[test]
    fn the_path_equals_the_reference_values() {
        let backward = &golden()["backward"];
        let path = backward_elimination(&golden_table(), |_| {});
        let removed: Vec<f64> = path.removed.iter().map(|&r| r as f64).collect();
        assert_eq!(removed, list(&backward["removed"]));
        for (found, expected) in path.rmse_m.iter().zip(list(&backward["rmse"])) {
            assert!((found / expected - 1.0).abs() < 1e-6, "{found} instead of {expected}");
        }
        let keep: Vec<f64> = path.best_subset().iter().map(|&r| r as f64).collect();
        assert_eq!(keep, list(&backward["keep"]));
    }

    /// Many cells, so that blocks are passed over; plateaus, so that ties occur.
    fn seeded_table(coarse: bool) -> LikelihoodTable {
        let cells = 500;
        let centers_m = (0..cells).map(|g| [f64::from(g % 25), f64::from(g / 25)]).collect();
        let mut table = LikelihoodTable::new(9, centers_m);
        let mut state = 1_u64;
        let mut noise = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 40) as f32 / (1 << 24) as f32
        };
        for q in 0..12_i32 {
            let truth_m = [f64::from(q * 7 % 25), f64::from(q * 5 % 20)];
            let log_likelihood: Vec<f32> = (0..9 * cells)
                .map(|i| {
                    let (r, g) = (i / cells, i % cells);
                    let far = (f64::from(g % 25) - truth_m[0]).powi(2) + (f64::from(g / 25) - truth_m[1]).powi(2);
                    let value = -0.02 * (f64::from(r) + 0.3) * far + 3.0 * f64::from(noise());
                    (if coarse { value.round() } else { value }) as f32
                })
                .collect();
            table.push(truth_m, &log_likelihood);
        }
        table
    }

    #[test]
    fn passing_blocks_over_changes_nothing() {
        for coarse in [false, true] {
            let table = seeded_table(coarse);
            let path = backward_elimination(&table, |_| {});
            let mut kept: Vec<usize> = (0..9).collect();
            for (step, &removed) in path.removed[..8].iter().enumerate() {
                let rmse_m: Vec<f64> = kept
                    .iter()
                    .map(|&r| {
                        let rest: Vec<usize> = kept.iter().copied().filter(|&k| k != r).collect();
                        let errors = table.estimates_m(&rest);
                        let squares = errors.iter().zip(&table.queries).map(|(&e, q)| distance_m(e, q.truth_m).powi(2));
                        (squares.sum::<f64>() / 12.0).sqrt()
                    })
                    .collect();
                let least = rmse_m.iter().copied().fold(f64::INFINITY, f64::min);
                let first = rmse_m.iter().position(|&e| e < least + 1e-12).expect("a least");
                assert_eq!((kept[first], least), (removed, path.rmse_m[step + 1]), "step {step}");
                kept.retain(|&r| r != removed);
            }
        }
    }
}
