//! How far the figures of a table can be trusted, and which differences in it are real.
//!
//! Frames of a drive are no independent witnesses: neighbours see the same street in the same light and err together, and
//! the same stretch of the drive is in the test sets of several seeds. So nothing is drawn frame by frame:
//!
//! - An **interval** is the span of the middle 95 % of [`DRAWS`] bootstrap figures. For each, stretches of the drive are
//!   drawn with replacement, the same for all seeds and methods, and the seeds themselves: a moving-block bootstrap along
//!   the drive (Künsch 1989; circular, Politis & Romano 1992), crossed with one over the splits (Owen 2007). A stretch is a
//!   twentieth of the drive, as in the blocked split. Where frames are held out in runs, as in that split, nothing less than
//!   a run is drawn, with all its seeds: its frames lie equally far from what was learned, and err together.
//! - A **difference** between two methods is taken on the same frames of the same splits, with the same draws. Its `p` is
//!   the share of sign flips, one sign a stretch or run, that make the mean difference of errors as large as it is: how often that
//!   happens where neither method is better. All comparisons of one table count as one family (Holm 1979).
//!
//! Of a single run nothing can be said, and of few runs little: five cannot bring `p` below 2 / 2⁵, and intervals drawn from
//! them are too short.
//!
//! What this assumes: stretches err independently of one another (on `drive-378` the correlation of errors falls below 0.2
//! within 12 frames, a stretch has 19; where errors stay alike over half a stretch or more, intervals are too short), and under "neither is better" a stretch's difference is
//! as likely to be of either sign. What it does not say: how figures vary from one drive, day or place to another. One
//! drive is one drive; for that, evaluate others against a map.

mod bootstrap;
mod compare;
mod text;

use serde::Serialize;

use super::entry::Entry;
use bootstrap::{Draw, Errors, Figures, Units, draws};
pub use text::{LEGEND, text};

/// Bootstrap draws.
pub const DRAWS: usize = 2000;
/// Times that signs are drawn for a `p`.
pub const FLIPS: usize = 9999;
/// Share of the draws within an interval.
pub const LEVEL: f64 = 0.95;
/// A drive is cut into so many stretches: the blocks that are drawn.
pub const STRETCHES: usize = crate::train::BLOCKS;
/// Fewer stretches or runs than these say nothing of others.
pub const LEAST_UNITS: usize = 2;
/// Differences with a smaller `p` are called real.
pub const SIGNIFICANT: f64 = 0.05;
/// Errors up to these are counted by the recalls \[m\].
pub use crate::metrics::RECALL_M;

const SEED: u64 = 0;

/// The key `statistics` of the JSON.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Statistics {
    pub draws: usize,
    pub flips: usize,
    pub level: f64,
    pub stretches: usize,
    pub recall_m: [f64; 4],
    /// One a row of the tables, the seeds taken together.
    pub methods: Vec<MethodStatistics>,
    /// Every method of a table against the one that the table is about, but for those whose errors are of labels.
    pub comparisons: Vec<Comparison>,
}

/// Rows that were measured on the same frames.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Section {
    pub dataset: String,
    /// `None` for a drive against a map.
    pub split: Option<String>,
    pub noisy: bool,
    pub fixed: bool,
}

/// What gave the answers.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Method {
    pub recipe: Option<&'static str>,
    pub features: String,
    pub estimator: &'static str,
}

/// A figure, and the interval that holds [`LEVEL`] of its bootstrap draws; `None` where there is nothing to draw from.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Estimate {
    pub value: f64,
    pub low: Option<f64>,
    pub high: Option<f64>,
}

/// Figures of one method, mean over the seeds; of the frames it has an estimate for, but for the recalls, which are of all.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct MethodStatistics {
    #[serde(flatten)]
    pub section: Section,
    #[serde(flatten)]
    pub method: Method,
    pub seeds: usize,
    /// Test frames with an estimate, all seeds together.
    pub frames: usize,
    /// Stretches of the drive that they are of, or runs that were held out as wholes.
    pub units: usize,
    pub rmse_m: Estimate,
    pub mean_m: Estimate,
    pub median_m: Estimate,
    pub p95_m: Estimate,
    /// The largest error of all seeds.
    pub emax_m: f64,
    /// 1 − RMSE / RMSE of always answering the median position.
    pub skill: Option<Estimate>,
    /// Share of all test frames with an error up to [`RECALL_M`].
    pub recall: [Estimate; 4],
    /// Of every seed, in their order: how much a split alone moves the figure.
    pub rmse_of_seeds_m: Vec<f64>,
    pub median_of_seeds_m: Vec<f64>,
}

/// `method` against `reference` on the frames that both have an estimate for: positive differences are in favour of
/// `reference`.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Comparison {
    #[serde(flatten)]
    pub section: Section,
    pub method: Method,
    pub reference: Method,
    pub seeds: usize,
    pub frames: usize,
    pub units: usize,
    /// Mean error of `method` minus that of `reference`.
    pub mean_difference_m: Estimate,
    /// The same of the median errors.
    pub median_difference_m: Estimate,
    /// Share of the frames on which `method` errs by less.
    pub closer_share: Estimate,
    /// Of the mean difference, by sign flips of the units; `None` where there is but one.
    pub p: Option<f64>,
    /// The same for the family of all comparisons of the section.
    pub p_holm: Option<f64>,
    /// `p_holm` is less than [`SIGNIFICANT`], and the interval of the mean difference, which seeds have a part in, does not
    /// hold 0.
    pub is_real: bool,
}

impl Default for Statistics {
    fn default() -> Self {
        Self {
            draws: DRAWS,
            flips: FLIPS,
            level: LEVEL,
            stretches: STRETCHES,
            recall_m: RECALL_M,
            methods: Vec::new(),
            comparisons: Vec::new(),
        }
    }
}

impl Statistics {
    /// Of `entries`, all with their frames.
    pub fn of(entries: &[Entry]) -> Self {
        let mut sections: Vec<Section> = Vec::new();
        for entry in entries {
            let section = Section::of(entry);
            if !sections.contains(&section) {
                sections.push(section);
            }
        }
        let mut statistics = Self::default();
        for section in sections {
            let rows: Vec<&Entry> = entries.iter().filter(|entry| Section::of(entry) == section).collect();
            statistics.add(&section, &rows);
        }
        statistics
    }

    fn add(&mut self, section: &Section, rows: &[&Entry]) {
        let mut methods: Vec<(Method, Errors)> = Vec::new();
        for entry in rows {
            let method = Method::of(entry);
            if !methods.iter().any(|(seen, _)| *seen == method) {
                let seeds: Vec<&Entry> = rows.iter().copied().filter(|other| Method::of(other) == method).collect();
                methods.push((method, Errors::of(&seeds)));
            }
        }
        let Some(units) = Units::of(rows) else { return };
        let seeds = methods.iter().map(|(_, errors)| errors.seeds()).max().unwrap_or(0);
        let draws = draws(&units, seeds, SEED);
        let of_median = methods.iter().find(|(method, _)| method.features == "median").map(|(_, errors)| errors);
        for (method, errors) in &methods {
            self.methods.extend(of_method(section, method, errors, of_median, &units, &draws));
        }
        // The row that the table is about: the last of the last recipe.
        let is_answer = |(method, _): &&(Method, Errors)| method.recipe.is_some() && method.estimator == "single";
        if let Some((reference, of_reference)) = methods.iter().rfind(is_answer) {
            // Errors of labels (eq. 15) are not of positions: 0 up to 5 m from the truth.
            let has_labels = |method: &Method| {
                rows.iter().any(|entry| Method::of(entry) == *method && entry.classified_share.is_some())
            };
            let others = methods.iter().filter(|(method, _)| method != reference && !has_labels(method));
            let compared = others.filter_map(|(method, errors)| {
                compare::compare(section, (method, errors), (reference, of_reference), &units, &draws, SEED)
            });
            self.comparisons.extend(compare::with_family_wise_p(compared.collect()));
        }
    }
}

impl Section {
    pub fn of(entry: &Entry) -> Self {
        Self { dataset: entry.dataset.clone(), split: entry.split.clone(), noisy: entry.noisy, fixed: entry.fixed }
    }
}

impl Method {
    pub fn of(entry: &Entry) -> Self {
        Self { recipe: entry.recipe, features: entry.features.clone(), estimator: entry.estimator }
    }
}

/// A `p` with three decimals; smaller ones only as such.
pub fn p_text(p: f64) -> String {
    if p < 0.001 { "< 0.001".into() } else { format!("{p:.3}") }
}

impl Estimate {
    /// `value` with the interval of what the draws brought.
    fn of(value: f64, mut drawn: Vec<f64>) -> Self {
        drawn.retain(|value| value.is_finite());
        drawn.sort_by(f64::total_cmp);
        if drawn.is_empty() {
            return Self { value, low: None, high: None };
        }
        let tail = 0.5 * (1.0 - LEVEL);
        let at = |share: f64| Some(crate::metrics::quantile(&drawn, share));
        Self { value, low: at(tail), high: at(1.0 - tail) }
    }
}

fn of_method(
    section: &Section,
    method: &Method,
    errors: &Errors,
    of_median: Option<&Errors>,
    units: &Units,
    draws: &[Draw],
) -> Option<MethodStatistics> {
    let of_units = errors.units(units);
    let draws = if of_units < LEAST_UNITS { &[] } else { draws };
    let as_drawn = Draw::everything(errors.seeds());
    let found = errors.figures(&as_drawn)?;
    let drawn: Vec<Figures> = draws.iter().filter_map(|draw| errors.figures(draw)).collect();
    let estimate = |of: &dyn Fn(&Figures) -> f64| Estimate::of(of(&found), drawn.iter().map(of).collect());
    let skill = of_median.and_then(|of_median| {
        let skill = |draw: &Draw| errors.skill(of_median, draw);
        Some(Estimate::of(skill(&as_drawn)?, draws.iter().filter_map(skill).collect()))
    });
    let seeds = || (0..errors.seeds()).filter_map(|seed| errors.figures(&Draw::only(seed)));
    Some(MethodStatistics {
        section: section.clone(),
        method: method.clone(),
        seeds: errors.seeds(),
        frames: errors.frames(),
        units: of_units,
        rmse_m: estimate(&|f| f.rmse_m),
        mean_m: estimate(&|f| f.mean_m),
        median_m: estimate(&|f| f.median_m),
        p95_m: estimate(&|f| f.p95_m),
        emax_m: errors.largest_m(),
        skill,
        recall: std::array::from_fn(|i| estimate(&|f| f.recall[i])),
        rmse_of_seeds_m: seeds().map(|f| f.rmse_m).collect(),
        median_of_seeds_m: seeds().map(|f| f.median_m).collect(),
    })
}

#[cfg(test)]
mod tests {
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;
    use crate::evaluate::FrameEntry;

    /// A row with frames that err by so much; `None`: no estimate.
    pub fn entry(seed: u64, errors_m: &[(usize, Option<f64>)]) -> Entry {
        let frame = |&(index, error_m): &(usize, Option<f64>)| FrameEntry {
            index,
            truth_e_m: 5.0,
            truth_n_m: 7.0,
            est_e_m: error_m.map(|error_m| 5.0 + error_m),
            est_n_m: error_m.map(|_| 7.0),
            ..FrameEntry::default()
        };
        let frames = errors_m.iter().map(frame).collect();
        Entry { seed: Some(seed), estimator: "single", frames: Some(frames), ..Entry::default() }
    }

    /// A row of every seed: a quarter of the frames of a drive of 400, whose errors are `error_m` of the frame.
    fn rows(recipe: Option<&'static str>, features: &str, seeds: u64, error_m: impl Fn(usize) -> f64) -> Vec<Entry> {
        let of_seed = |seed: u64| {
            let frames = (0..400).filter(|i| (i * 7 + seed as usize * 3).is_multiple_of(4));
            let errors_m: Vec<(usize, Option<f64>)> = frames.map(|i| (i, Some(error_m(i)))).collect();
            Entry { recipe, features: features.into(), split: Some("random".into()), ..entry(seed, &errors_m) }
        };
        (0..seeds).map(of_seed).collect()
    }

    #[test]
    fn no_p_is_written_as_zero() {
        let found = [1.0, 0.049_6, 0.001, 0.000_99, 1e-4].map(p_text);
        assert_eq!(found, ["1.000", "0.050", "0.001", "< 0.001", "< 0.001"]);
    }

    #[test]
    fn methods_are_compared_with_the_last_row_of_the_last_recipe() {
        let wavy = |i: usize| 1.5 + (i as f64 * 0.05).sin();
        let mut entries = rows(Some("paper"), "fft", 3, |i| wavy(i) + 0.5);
        entries.extend(rows(Some("default"), "fused", 3, wavy));
        entries.extend(rows(None, "as-good", 3, |i| wavy(i) + if i / 20 % 2 == 0 { 0.3 } else { -0.3 }));
        let labels = rows(None, "bow", 3, |_| 0.0).into_iter();
        entries.extend(labels.map(|entry| Entry { classified_share: Some(1.0), ..entry }));
        entries.extend(rows(None, "median", 3, |_| 30.0));
        let statistics = Statistics::of(&entries);
        assert_eq!(statistics.methods.len(), 5);
        let compared: Vec<(&str, bool)> =
            statistics.comparisons.iter().map(|c| (c.method.features.as_str(), c.is_real)).collect();
        assert_eq!(compared, [("fft", true), ("as-good", false), ("median", true)]);
        let fft = &statistics.comparisons[0];
        assert_eq!((fft.reference.features.as_str(), fft.seeds, fft.frames), ("fused", 3, 300));
        let Estimate { value, low, high } = fft.mean_difference_m;
        let all = [Some(value), low, high];
        assert!(all.iter().flatten().filter(|&&difference| (difference - 0.5).abs() < 1e-9).count() == 3, "{fft:?}");
        assert_eq!(fft.closer_share.value, 0.0);
        assert!((statistics.methods[0].emax_m - 3.0).abs() < 1e-3, "{:?}", statistics.methods[0]);
        let fused = &statistics.methods[1];
        assert!(
            fused.rmse_m.low < Some(fused.rmse_m.value) && Some(fused.rmse_m.value) < fused.rmse_m.high,
            "{fused:?}"
        );
        assert!(fused.skill.expect("there is a median").value > 0.9 && fused.rmse_of_seeds_m.len() == 3);
        let lines = text(&statistics).lines().count();
        assert_eq!(lines, 1 + 1 + 1 + 5, "{}", text(&statistics));
    }

    /// Every frame of every run errs by 1 m more, and yet runs are no more than they are.
    #[test]
    fn frames_of_a_run_are_no_witnesses_of_their_own() {
        let of_runs = |features: &str, error_m: f64, runs: &[[usize; 2]]| {
            let frames = runs.iter().flat_map(|&[first, last]| first..=last);
            let errors_m: Vec<(usize, Option<f64>)> =
                frames.map(|i| (i, Some(error_m + 0.1 * (i % 7) as f64))).collect();
            let held_out_runs = Some(runs.to_vec());
            Entry { recipe: Some("default"), features: features.into(), held_out_runs, ..entry(0, &errors_m) }
        };
        let compared = |runs: &[[usize; 2]]| {
            let statistics = Statistics::of(&[of_runs("fft", 2.0, runs), of_runs("fused", 1.0, runs)]);
            assert!(statistics.methods.iter().all(|method| method.units == runs.len()));
            (statistics.methods[0].rmse_m, statistics.comparisons[0].clone())
        };
        let (rmse_m, comparison) = compared(&[[0, 17], [56, 74], [132, 150], [189, 206], [302, 320]]);
        assert!(rmse_m.low < Some(rmse_m.value) && Some(rmse_m.value) < rmse_m.high);
        assert_eq!((comparison.p, comparison.is_real, comparison.units), (Some(0.0625), false, 5));
        let (rmse_m, comparison) = compared(&[[0, 17]]);
        assert_eq!((rmse_m.low, rmse_m.high, comparison.p, comparison.p_holm), (None, None, None, None));
        assert!(comparison.mean_difference_m.low.is_none() && !comparison.is_real);
        assert!(text(&Statistics::of(&[of_runs("fft", 2.0, &[[0, 17]])])).contains("[-, -]"));
    }

    /// Errors of neighbours are alike, over a third of a stretch; the mean over all drives is 5.
    #[test]
    fn intervals_hold_the_figure_of_all_drives_as_often_as_they_say() {
        let mut random = ChaCha8Rng::seed_from_u64(3);
        let drives = 120;
        let holds = |random: &mut ChaCha8Rng| {
            let mut state = 0.0;
            let errors_m: Vec<(usize, Option<f64>)> = (0..400)
                .map(|i| {
                    state = 0.75 * state + 0.66 * random.random_range(-1.0..1.0);
                    (i, Some(5.0 + state))
                })
                .collect();
            let row = entry(0, &errors_m);
            let errors = Errors::of(&[&row]);
            let units = Units::of(&[&row]).expect("there are frames");
            let drawn =
                draws(&units, 1, 0).into_iter().step_by(4).filter_map(|draw| Some(errors.figures(&draw)?.mean_m));
            let Estimate { low, high, .. } = Estimate::of(5.0, drawn.collect());
            low <= Some(5.0) && Some(5.0) < high
        };
        let held = (0..drives).filter(|_| holds(&mut random)).count();
        // A few blocks make intervals a little short: 90 % would be good, and this is three deviations below.
        assert!(f64::from(held as u32) > 0.82 * f64::from(drives), "{held} of {drives}");
    }
}
