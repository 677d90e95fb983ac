//! How far the figures of a table can be trusted, and which differences in it are real.
//!
//! Frames of a drive are no independent witnesses: neighbours see the same street in the same light and err together, and
//! the same stretch of the drive is in the test sets of several seeds. So nothing is drawn frame by frame:
//!
//! - An **interval** is the span of the middle 95 % of [`DRAWS`] bootstrap figures. For each, stretches of the drive are
//!   drawn with replacement, the same for all seeds and methods, and the seeds themselves: a moving-block bootstrap along
//!   the drive (Künsch 1989; circular, Politis & Romano 1992), crossed with one over the splits (Owen 2007). A stretch is a
//!   twentieth of the drive, as in the blocked split.
//! - A **difference** between two methods is taken on the same frames of the same splits, with the same draws. Its `p` is
//!   the share of sign flips, one sign a stretch, that make the mean difference of errors as large as it is: how often that
//!   happens where neither method is better. All comparisons of one table count as one family (Holm 1979).
//!
//! What this assumes: stretches err independently of one another, and under "neither is better" a stretch's difference is
//! as likely to be of either sign. What it does not say: how figures vary from one drive, day or place to another. One
//! drive is one drive; for that, evaluate others against a map.

mod bootstrap;
mod compare;
mod text;

use serde::Serialize;

use super::entry::Entry;
use bootstrap::{Draw, Errors, Figures, draws};
pub use text::{LEGEND, text};

/// Bootstrap draws.
pub const DRAWS: usize = 2000;
/// Times that signs are drawn for a `p`.
pub const FLIPS: usize = 9999;
/// Share of the draws within an interval.
pub const LEVEL: f64 = 0.95;
/// A drive is cut into so many stretches: the blocks that are drawn.
pub const STRETCHES: usize = crate::train::BLOCKS;
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

/// A figure, and the interval that holds [`LEVEL`] of its bootstrap draws.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Estimate {
    pub value: f64,
    pub low: f64,
    pub high: f64,
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
    pub rmse_m: Estimate,
    pub mean_m: Estimate,
    pub median_m: Estimate,
    pub p95_m: Estimate,
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
    /// Mean error of `method` minus that of `reference`.
    pub mean_difference_m: Estimate,
    /// The same of the median errors.
    pub median_difference_m: Estimate,
    /// Share of the frames on which `method` errs by less.
    pub closer_share: Estimate,
    /// Of the mean difference, by sign flips of stretches.
    pub p: f64,
    /// The same for the family of all comparisons of the section.
    pub p_holm: f64,
    /// `p_holm` is less than [`SIGNIFICANT`].
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
        let Some(drive) = bootstrap::Drive::of(rows) else { return };
        let seeds = methods.iter().map(|(_, errors)| errors.seeds()).max().unwrap_or(0);
        let draws = draws(&drive, seeds, SEED);
        let of_median = methods.iter().find(|(method, _)| method.features == "median").map(|(_, errors)| errors);
        for (method, errors) in &methods {
            self.methods.extend(of_method(section, method, errors, of_median, &draws));
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
                compare::compare(section, (method, errors), (reference, of_reference), &drive, &draws, SEED)
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

impl Estimate {
    /// `value` with the interval of what the draws brought.
    fn of(value: f64, mut drawn: Vec<f64>) -> Self {
        drawn.retain(|value| value.is_finite());
        drawn.sort_by(f64::total_cmp);
        if drawn.is_empty() {
            return Self { value, low: value, high: value };
        }
        let tail = 0.5 * (1.0 - LEVEL);
        Self { value, low: crate::metrics::quantile(&drawn, tail), high: crate::metrics::quantile(&drawn, 1.0 - tail) }
    }
}

fn of_method(
    section: &Section,
    method: &Method,
    errors: &Errors,
    of_median: Option<&Errors>,
    draws: &[Draw],
) -> Option<MethodStatistics> {
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
        rmse_m: estimate(&|f| f.rmse_m),
        mean_m: estimate(&|f| f.mean_m),
        median_m: estimate(&|f| f.median_m),
        p95_m: estimate(&|f| f.p95_m),
        skill,
        recall: std::array::from_fn(|i| estimate(&|f| f.recall[i])),
        rmse_of_seeds_m: seeds().map(|f| f.rmse_m).collect(),
        median_of_seeds_m: seeds().map(|f| f.median_m).collect(),
    })
}
