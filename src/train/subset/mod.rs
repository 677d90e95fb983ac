//! Which features to keep: backward sequential elimination on validation images.

mod search;
mod table;

use rayon::prelude::*;

use crate::metrics::component_median;
use crate::types::{PositionM, distance_m};
use search::Search;
pub use table::LikelihoodTable;

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
/// Every step needs argmax_s Σ_(x ≠ r) L_x(s) for every query and every feature r that is left: [`Search`] finds it without
/// looking at more than a few cells. The result is that of the full search, exactly.
pub fn backward_elimination(table: &LikelihoodTable, on_step: impl Fn(usize)) -> Elimination {
    let mut kept: Vec<usize> = (0..table.features).collect();
    let mut searches: Vec<Search> = table.queries.par_iter().map(|query| Search::new(query, table)).collect();
    let mut path = Elimination { removed: Vec::new(), rmse_m: Vec::new() };
    let rmse_m = |sum: f64| (sum / table.queries.len() as f64).sqrt();
    let at_start = searches.iter().map(|search| squared_error(search, search.best(), table)).sum();
    path.rmse_m.push(rmse_m(at_start));

    while kept.len() > 1 {
        // Sum over the queries of the squared error without each of the kept features.
        let of_queries: Vec<Vec<f64>> = searches
            .par_iter_mut()
            .map(|search| {
                search.find_best_without_each(&kept);
                kept.iter().map(|&r| squared_error(search, search.best_without(r), table)).collect()
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
        searches.par_iter_mut().for_each(|search| search.remove(removed));
        path.removed.push(removed);
        path.rmse_m.push(rmse_m(least));
        on_step(path.removed.len());
    }
    path.removed.extend(kept);
    path.rmse_m.push(median_rmse_m(table));
    path
}

fn squared_error(search: &Search, cell: usize, table: &LikelihoodTable) -> f64 {
    distance_m(table.centers_m[cell], search.query.truth_m).powi(2)
}

/// RMSE of answering the component-wise median of the true positions: Ω = ∅.
fn median_rmse_m(table: &LikelihoodTable) -> f64 {
    let truths: Vec<PositionM> = table.queries.iter().map(|query| query.truth_m).collect();
    let center = component_median(&truths);
    let sum: f64 = truths.iter().map(|&truth| distance_m(truth, center).powi(2)).sum();
    (sum / truths.len() as f64).sqrt()
}

#[cfg(test)]
mod tests {
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

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
            table.push(truth_m, log_likelihood);
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

    /// Centres, true positions and log-likelihoods: many cells, so that blocks are passed over; features of very different
    /// sizes, so that both bounds matter; plateaus where `coarse`, so that ties occur.
    fn seeded(coarse: bool, seed: u64) -> (Vec<PositionM>, Vec<(PositionM, Vec<f32>)>) {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let cells = 700;
        let centers_m: Vec<PositionM> = (0..cells).map(|g| [f64::from(g % 25), f64::from(g / 25)]).collect();
        let queries = (0..9).map(|_| {
            let truth_m = [random.random_range(0.0..25.0), random.random_range(0.0..28.0)];
            let mut log_likelihood = Vec::new();
            for r in 0..FEATURES {
                let (sharpness, noise) = (0.002 * 1.7_f64.powi(r as i32), random.random_range(0.0..4.0));
                let seen_m: PositionM = truth_m.map(|c| c + random.random_range(-3.0..3.0));
                log_likelihood.extend(centers_m.iter().map(|&center| {
                    let value = -sharpness * distance_m(center, seen_m).powi(2) - noise * random.random_range(0.0..1.0);
                    (if coarse { value.round() } else { value }) as f32
                }));
            }
            (truth_m, log_likelihood)
        });
        let queries = queries.collect();
        (centers_m, queries)
    }

    const FEATURES: usize = 19;

    /// The same, every sum looked at.
    fn full_search(centers_m: &[PositionM], queries: &[(PositionM, Vec<f32>)]) -> (Vec<usize>, Vec<f64>) {
        let row = |values: &[f32], r: usize| values[r * centers_m.len()..(r + 1) * centers_m.len()].to_vec();
        let mut sums: Vec<Vec<f64>> = vec![vec![0.0; centers_m.len()]; queries.len()];
        for (sum, (_, values)) in sums.iter_mut().zip(queries) {
            for r in 0..FEATURES {
                sum.iter_mut().zip(row(values, r)).for_each(|(sum, l)| *sum += f64::from(l));
            }
        }
        let error = |truth_m: PositionM, sums: &[f64]| {
            let best = (0..sums.len()).fold(0, |best, cell| if sums[cell] > sums[best] { cell } else { best });
            distance_m(centers_m[best], truth_m).powi(2)
        };
        let (mut kept, mut removed) = ((0..FEATURES).collect::<Vec<_>>(), Vec::new());
        let at_start = queries.iter().zip(&sums).map(|((truth_m, _), sums)| error(*truth_m, sums)).sum::<f64>();
        let mut rmse_m = vec![(at_start / queries.len() as f64).sqrt()];
        while kept.len() > 1 {
            let without = |sum: &[f64], values: &[f32], r: usize| -> Vec<f64> {
                sum.iter().zip(row(values, r)).map(|(sum, l)| sum - f64::from(l)).collect()
            };
            let of_feature = |&r: &usize| {
                let errors = queries.iter().zip(&sums).map(|((truth_m, l), sum)| error(*truth_m, &without(sum, l, r)));
                errors.sum::<f64>()
            };
            let errors: Vec<f64> = kept.iter().map(of_feature).collect();
            let least = (0..kept.len()).fold(0, |least, k| if errors[k] < errors[least] { k } else { least });
            let r = kept.remove(least);
            sums.iter_mut().zip(queries).for_each(|(sum, (_, values))| *sum = without(sum, values, r));
            removed.push(r);
            rmse_m.push((errors[least] / queries.len() as f64).sqrt());
        }
        removed.extend(kept);
        (removed, rmse_m)
    }

    #[test]
    fn passing_blocks_over_changes_nothing() {
        for (coarse, seed) in [(false, 1), (true, 1), (false, 2), (true, 2), (false, 3), (true, 3)] {
            let (centers_m, queries) = seeded(coarse, seed);
            let mut table = LikelihoodTable::new(FEATURES, centers_m.clone());
            queries.iter().for_each(|(truth_m, values)| table.push(*truth_m, values.clone()));
            let path = backward_elimination(&table, |_| {});
            let (removed, rmse_m) = full_search(&centers_m, &queries);
            assert_eq!((&path.removed, &path.rmse_m[..FEATURES]), (&removed, &rmse_m[..]), "seed {seed}");
        }
    }
}
