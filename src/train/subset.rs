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
    /// Block × feature: the values of [`BLOCK`] cells, zeros beyond the last cell. Blocks that could hold the best cell
    /// are the same for most features, so features lie next to each other.
    log_likelihood: Vec<[f32; BLOCK]>,
    /// Feature × block: the smallest value of each block.
    block_minimum: Vec<f32>,
}

/// Cells a block: a cache line, and small against the number of cells.
const BLOCK: usize = 16;

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
        let blocks = cells.div_ceil(BLOCK);
        let mut query = Query {
            truth_m,
            log_likelihood: vec![[0.0; BLOCK]; blocks * self.features],
            block_minimum: Vec::with_capacity(self.features * blocks),
        };
        for (r, row) in log_likelihood.chunks_exact(cells.max(1)).enumerate() {
            for (block, values) in row.chunks(BLOCK).enumerate() {
                query.log_likelihood[block * self.features + r][..values.len()].copy_from_slice(values);
                query.block_minimum.push(least_of(values));
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
        let squared_errors = table
            .queries
            .par_iter()
            .zip(&sums)
            .map(|(query, sum)| kept.iter().map(|&r| square(query, sum.best_without(query, r))).collect())
            .reduce(|| vec![0.0; kept.len()], |a: Vec<f64>, b: Vec<f64>| a.iter().zip(b).map(|(a, b)| a + b).collect());
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
        let (features, cells) = (table.features, table.centers_m.len());
        let mut sum = vec![[0.0; BLOCK]; cells.div_ceil(BLOCK)];
        sum.as_flattened_mut()[cells..].fill(f64::NEG_INFINITY);
        for (sum, values) in sum.iter_mut().zip(query.log_likelihood.chunks_exact(features)) {
            for &r in kept {
                sum.iter_mut().zip(&values[r]).for_each(|(sum, &l)| *sum += f64::from(l));
            }
        }
        let mut running = Self { features, sum, block_maximum: Vec::new(), best: 0 };
        running.summarise();
        running
    }

    fn remove(&mut self, query: &Query, r: usize) {
        for (sum, values) in self.sum.iter_mut().zip(query.log_likelihood.chunks_exact(self.features)) {
            sum.iter_mut().zip(&values[r]).for_each(|(sum, &l)| *sum -= f64::from(l));
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

    /// First cell of greatest S − L_r.
    fn best_without(&self, query: &Query, r: usize) -> usize {
        let blocks = self.block_maximum.len();
        let minima = &query.block_minimum[r * blocks..(r + 1) * blocks];
        let values = Strided { values: &query.log_likelihood[r..], stride: self.features };
        first_greatest_difference(&self.sum, values, &self.block_maximum, minima, self.best / BLOCK)
    }
}

/// The blocks of one feature.
#[derive(Clone, Copy)]
struct Strided<'a> {
    values: &'a [[f32; BLOCK]],
    stride: usize,
}

/// Blocks whose bounds are looked at together.
const GROUP: usize = 16;

/// The first cell of greatest `sum` − `values`, searched from block `start` on; `maxima` and `minima` are those of the
/// blocks of `sum` and `values`.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2+fma"))]
fn first_greatest_difference(
    sum: &[[f64; BLOCK]],
    values: Strided,
    maxima: &[f64],
    minima: &[f32],
    start: usize,
) -> usize {
    let mut best = (f64::NEG_INFINITY, start);
    // Block `start` first, for a bound that hardly any other block reaches.
    search(start, sum, values, &mut best);
    for (group, (maxima, minima)) in maxima.chunks(GROUP).zip(minima.chunks(GROUP)).enumerate() {
        // Without a branch a block.
        let mut possible = 0_u32;
        for (i, (maximum, &minimum)) in maxima.iter().zip(minima).enumerate() {
            possible |= u32::from(maximum - f64::from(minimum) >= best.0) << i;
        }
        while possible != 0 {
            let i = possible.trailing_zeros() as usize;
            possible &= possible - 1;
            if maxima[i] - f64::from(minima[i]) >= best.0 {
                search(group * GROUP + i, sum, values, &mut best);
            }
        }
    }
    best.1
}

/// Improves `best`, a value and its cell, by what block `block` holds.
#[inline(always)]
fn search(block: usize, sum: &[[f64; BLOCK]], values: Strided, best: &mut (f64, usize)) {
    let mut differences = sum[block];
    for (difference, &l) in differences.iter_mut().zip(&values.values[block * values.stride]) {
        *difference -= f64::from(l);
    }
    let greatest = greatest_of(&differences);
    if greatest > best.0 || (greatest == best.0 && block * BLOCK < best.1) {
        let first = differences.iter().position(|&difference| difference == greatest).unwrap_or(0);
        *best = (greatest, block * BLOCK + first);
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
