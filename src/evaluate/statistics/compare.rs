//! Is a difference real?

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::bootstrap::{Draw, Errors, Figures, Units};
use super::{Comparison, Estimate, FLIPS, LEAST_UNITS, Method, SIGNIFICANT, Section};

/// `None` where no frame has an estimate of both.
pub fn compare(
    section: &Section,
    (method, errors): (&Method, &Errors),
    (reference, of_reference): (&Method, &Errors),
    units: &Units,
    draws: &[Draw],
    seed: u64,
) -> Option<Comparison> {
    let (errors, of_reference) = errors.paired(of_reference);
    let as_drawn = Draw::everything(errors.seeds());
    let both = |draw: &Draw| Some((errors.figures(draw)?, of_reference.figures(draw)?));
    let found = both(&as_drawn)?;
    let of_units = errors.units(units);
    let draws = if of_units < LEAST_UNITS { &[] } else { draws };
    let drawn: Vec<(Figures, Figures)> = draws.iter().filter_map(both).collect();
    let difference = |of: fn(&Figures) -> f64| {
        let of_pair = |(own, other): &(Figures, Figures)| of(own) - of(other);
        Estimate::of(of_pair(&found), drawn.iter().map(of_pair).collect())
    };
    let pairs = pairs(&errors, &of_reference);
    let closer = |draw: &Draw| closer_share(&pairs, draw);
    let p = (of_units >= LEAST_UNITS).then(|| sign_flip_p(&unit_sums(&pairs, units), seed));
    Some(Comparison {
        section: section.clone(),
        method: method.clone(),
        reference: reference.clone(),
        seeds: errors.seeds(),
        frames: errors.frames(),
        units: of_units,
        mean_difference_m: difference(|f| f.mean_m),
        median_difference_m: difference(|f| f.median_m),
        closer_share: Estimate::of(closer(&as_drawn)?, draws.iter().filter_map(closer).collect()),
        p,
        p_holm: p,
        is_real: false,
    })
}

/// Per seed, frames with the errors of either method.
type Pairs = Vec<Vec<(usize, f64, f64)>>;

fn pairs(errors: &Errors, of_reference: &Errors) -> Pairs {
    errors
        .by_frame()
        .zip(of_reference.by_frame())
        .map(|(own, other)| own.into_iter().map(|(index, error_m)| (index, error_m, other[&index])).collect())
        .collect()
}

/// Share of the frames that the method errs less on, mean over the seeds; of frames on which both err alike, half.
fn closer_share(pairs: &Pairs, draw: &Draw) -> Option<f64> {
    let of_seed = |&seed: &usize| {
        let (mut closer, mut all) = (0.0, 0);
        for &(index, own_m, other_m) in pairs.get(seed)? {
            let times = draw.times(index);
            all += times;
            closer += times as f64
                * if own_m < other_m {
                    1.0
                } else if own_m == other_m {
                    0.5
                } else {
                    0.0
                };
        }
        (all > 0).then(|| closer / f64::from(all as u32))
    };
    let shares: Vec<f64> = draw.seeds().iter().filter_map(of_seed).collect();
    (!shares.is_empty()).then(|| shares.iter().sum::<f64>() / shares.len() as f64)
}

/// What every unit adds to the mean difference over frames and seeds.
fn unit_sums(pairs: &Pairs, units: &Units) -> Vec<f64> {
    let mut sums = vec![0.0; units.most()];
    let seeds = pairs.iter().filter(|of_seed| !of_seed.is_empty()).count();
    for of_seed in pairs {
        for &(index, own_m, other_m) in of_seed {
            sums[units.unit_of(index)] += (own_m - other_m) / (of_seed.len() * seeds) as f64;
        }
    }
    sums
}

/// Share of random signs of the `sums` that make their total as large as it is (Edgington & Onghena 2007: what was found
/// counts as one of them); of all signs there are where those are not more than are drawn.
fn sign_flip_p(sums: &[f64], seed: u64) -> f64 {
    let found = sums.iter().sum::<f64>().abs();
    // Rounding must not tell apart what is the same.
    let as_large = found * (1.0 - 1e-9);
    if 1_usize.checked_shl(sums.len() as u32).is_some_and(|all| all <= FLIPS) {
        let total = |signs: usize| {
            let signed = sums.iter().enumerate().map(|(i, sum)| if signs >> i & 1 == 0 { *sum } else { -sum });
            signed.sum::<f64>().abs()
        };
        let all = 1 << sums.len();
        return (0..all).filter(|&signs| total(signs) >= as_large).count() as f64 / all as f64;
    }
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let flipped = |random: &mut ChaCha8Rng| {
        sums.iter().map(|sum| if random.random::<bool>() { *sum } else { -sum }).sum::<f64>().abs()
    };
    let larger = (0..FLIPS).filter(|_| flipped(&mut random) >= as_large).count();
    (1 + larger) as f64 / (1 + FLIPS) as f64
}

/// Holm's step-down adjustment: among all `comparisons`, a false discovery of any is as rare as `p_holm` says.
pub fn with_family_wise_p(mut comparisons: Vec<Comparison>) -> Vec<Comparison> {
    let mut order: Vec<(usize, f64)> =
        comparisons.iter().enumerate().filter_map(|(i, comparison)| Some((i, comparison.p?))).collect();
    order.sort_by(|a, b| a.1.total_cmp(&b.1));
    let mut at_least: f64 = 0.0;
    for (rank, &(i, p)) in order.iter().enumerate() {
        at_least = at_least.max((order.len() - rank) as f64 * p).min(1.0);
        comparisons[i].p_holm = Some(at_least);
        let Estimate { low, high, .. } = comparisons[i].mean_difference_m;
        comparisons[i].is_real =
            at_least < SIGNIFICANT && (low.is_some_and(|low| low > 0.0) || high.is_some_and(|high| high < 0.0));
    }
    comparisons
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_difference_of_one_sign_everywhere_is_real_and_of_changing_sign_is_not() {
        let same: Vec<f64> = (0..20).map(|i| 1.0 + 0.1 * f64::from(i % 3)).collect();
        assert!(sign_flip_p(&same, 0) < 0.001);
        let changing: Vec<f64> = (0..20).map(|i| if i % 2 == 0 { 1.0 } else { -1.05 }).collect();
        assert!(sign_flip_p(&changing, 0) > 0.5);
        assert_eq!(sign_flip_p(&[0.0; 20], 0), 1.0);
        // One stretch that makes all of it is as likely to be of either sign.
        let mut one = [0.0; 20];
        one[7] = 30.0;
        assert_eq!(sign_flip_p(&one, 0), 1.0);
    }

    #[test]
    fn five_runs_that_all_agree_are_two_of_thirty_two_signs() {
        assert_eq!(sign_flip_p(&[1.0, 2.0, 0.5, 1.5, 3.0], 0), 2.0 / 32.0);
        assert_eq!(sign_flip_p(&[1.0, 2.0], 0), 0.5);
    }

    /// Where neither is better, p is below 5 % in 5 % of the cases.
    #[test]
    fn p_is_uniform_under_the_null_hypothesis() {
        let mut random = ChaCha8Rng::seed_from_u64(5);
        let small = (0..400)
            .filter(|_| {
                let sums: Vec<f64> = (0..20).map(|_| random.random_range(-1.0..1.0)).collect();
                sign_flip_p(&sums, 0) < 0.05
            })
            .count();
        // Four standard deviations about 20.
        assert!((3..=37).contains(&small), "{small}");
    }

    #[test]
    fn holm_s_adjustment_equals_a_hand_computed_one() {
        let unknown = Estimate { value: 1.0, low: Some(0.5), high: Some(1.5) };
        let method = Method { recipe: None, features: String::new(), estimator: "single" };
        let comparison = |p: f64| Comparison {
            section: Section { dataset: String::new(), split: None, noisy: false, fixed: false },
            method: method.clone(),
            reference: method.clone(),
            seeds: 1,
            frames: 1,
            units: 20,
            mean_difference_m: unknown,
            median_difference_m: unknown,
            closer_share: unknown,
            p: Some(p),
            p_holm: Some(p),
            is_real: false,
        };
        let adjusted = with_family_wise_p([0.04, 0.01, 0.03, 0.5].map(comparison).into());
        let found: Vec<f64> = adjusted.iter().filter_map(|c| c.p_holm).collect();
        for (found, expected) in found.iter().zip([0.09, 0.04, 0.09, 0.5]) {
            assert!((found - expected).abs() < 1e-12, "{found} {expected}");
        }
        assert_eq!(adjusted.iter().map(|c| c.is_real).collect::<Vec<_>>(), [false, true, false, false]);
        // Seeds that disagree leave it open.
        let open = Comparison { mean_difference_m: Estimate { low: Some(-0.1), ..unknown }, ..comparison(0.01) };
        assert!(!with_family_wise_p(vec![open])[0].is_real);
    }
}
