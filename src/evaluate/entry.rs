//! Results as they are printed and written: one entry a recipe, type of features, split and seed.

use std::f64::consts::{FRAC_PI_2, TAU};

use serde::Serialize;

use super::sequence::{Sequence, SequenceFigures};
use crate::metrics::ErrorFigures;
use crate::types::{LocalizationState, PositionM, counted};

/// One row of the evaluation. The names are a contract with scripts: keys are added, never renamed; `null` where a
/// figure has no meaning.
#[derive(Debug, Clone, Default, Serialize)]
pub struct Entry {
    pub dataset: String,
    pub recipe: Option<&'static str>,
    pub features: String,
    pub estimator: &'static str,
    pub split: Option<String>,
    pub seed: Option<u64>,
    pub noisy: bool,
    pub fixed: bool,
    pub n_learning: usize,
    pub n_validation: usize,
    pub n_test: usize,
    /// Frames the tested model was learned from: with the validation frames where the recipe refits.
    pub n_learned_from: usize,
    pub m: Option<usize>,
    pub rank: Option<usize>,
    pub kept: Option<usize>,
    pub compression: Option<f64>,
    pub rmse_all_test_m: Option<f64>,
    pub rmse_be_validation_m: Option<f64>,
    pub rmse_be_test_m: Option<f64>,
    pub emax_test_m: Option<f64>,
    pub rmse_m: Option<f64>,
    pub median_m: Option<f64>,
    pub p90_m: Option<f64>,
    pub p95_m: Option<f64>,
    pub share_over_10m: Option<f64>,
    /// Share of all test frames whose estimate errs by so much at most.
    pub recall_1m: Option<f64>,
    pub recall_2m: Option<f64>,
    pub recall_5m: Option<f64>,
    pub recall_10m: Option<f64>,
    pub skill: Option<f64>,
    pub heading_median_deg: Option<f64>,
    /// Share of the test frames that have an estimate; the first of them, since the first frame.
    pub localized_share: Option<f64>,
    pub first_localized_s: Option<f64>,
    pub first_localized_m: Option<f64>,
    pub nees_mean: Option<f64>,
    pub coverage_95: Option<f64>,
    /// What features or settings were chosen on: `validation`, `folds` of the frames learned from, or nothing. Never the
    /// test frames.
    pub chosen_on: Option<&'static str>,
    /// Of a bag of words: learning images that are asked, and share of the test frames with the right label (eq. 15).
    pub neighbours: Option<usize>,
    pub classified_share: Option<f64>,
    pub bic_all: Option<f64>,
    pub bic_kept: Option<f64>,
    /// First and last index of every run of test frames, where they were held out in runs: their errors go together.
    #[serde(skip)]
    pub held_out_runs: Option<Vec<[usize; 2]>>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub frames: Option<Vec<FrameEntry>>,
}

/// One frame's estimate.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct FrameEntry {
    pub index: usize,
    pub truth_e_m: f64,
    pub truth_n_m: f64,
    /// `None` where no position is said.
    pub est_e_m: Option<f64>,
    pub est_n_m: Option<f64>,
    pub cov_ee_m2: Option<f64>,
    pub cov_en_m2: Option<f64>,
    pub cov_nn_m2: Option<f64>,
    /// From north, clockwise, 0 to 2π.
    pub heading_rad: Option<f64>,
    pub state: Option<&'static str>,
}

impl Entry {
    /// The figures of the estimate that the recipe stands for.
    pub fn with_figures(self, figures: Option<ErrorFigures>) -> Self {
        Self {
            rmse_m: figures.map(|f| f.rmse_m),
            median_m: figures.map(|f| f.median_m),
            p90_m: figures.map(|f| f.p90_m),
            p95_m: figures.map(|f| f.p95_m),
            share_over_10m: figures.map(|f| f.share_over_10m),
            recall_1m: figures.map(|f| f.recall[0]),
            recall_2m: figures.map(|f| f.recall[1]),
            recall_5m: figures.map(|f| f.recall[2]),
            recall_10m: figures.map(|f| f.recall[3]),
            skill: figures.map(|f| f.skill),
            emax_test_m: figures.map(|f| f.max_m),
            ..self
        }
    }

    /// The frames with their estimates.
    pub fn with_frames(self, indices: &[usize], truth_m: &[PositionM], estimates_m: &[PositionM]) -> Self {
        let frames = indices.iter().zip(truth_m).zip(estimates_m).map(|((&index, truth_m), estimate_m)| FrameEntry {
            index,
            truth_e_m: truth_m[0],
            truth_n_m: truth_m[1],
            est_e_m: Some(estimate_m[0]),
            est_n_m: Some(estimate_m[1]),
            cov_ee_m2: None,
            cov_en_m2: None,
            cov_nn_m2: None,
            heading_rad: None,
            state: None,
        });
        Self { frames: Some(frames.collect()), ..self }
    }

    /// The figures of a drive as a whole. Frames without a position are not recalled.
    pub fn with_sequence(self, figures: &SequenceFigures) -> Self {
        let of_all = |recall: Option<f64>| recall.map(|recall| recall * figures.share);
        Self {
            recall_1m: of_all(self.recall_1m),
            recall_2m: of_all(self.recall_2m),
            recall_5m: of_all(self.recall_5m),
            recall_10m: of_all(self.recall_10m),
            heading_median_deg: figures.heading_median_deg,
            localized_share: Some(figures.share),
            first_localized_s: Some(figures.first_s),
            first_localized_m: Some(figures.first_m),
            nees_mean: Some(figures.nees_mean),
            coverage_95: Some(figures.coverage_95),
            ..self
        }
    }

    /// The frames with the poses of a drive.
    pub fn with_poses(self, indices: &[usize], truth_m: &[PositionM], sequence: &Sequence) -> Self {
        let frames = indices.iter().zip(truth_m).zip(sequence.poses.iter().zip(&sequence.states));
        let frames = frames.map(|((&index, truth_m), (pose, state))| FrameEntry {
            index,
            truth_e_m: truth_m[0],
            truth_n_m: truth_m[1],
            est_e_m: pose.map(|pose| pose.position_m[0]),
            est_n_m: pose.map(|pose| pose.position_m[1]),
            cov_ee_m2: pose.map(|pose| pose.covariance.ee_m2),
            cov_en_m2: pose.map(|pose| pose.covariance.en_m2),
            cov_nn_m2: pose.map(|pose| pose.covariance.nn_m2),
            heading_rad: pose
                .and_then(|pose| pose.heading)
                .map(|heading| (FRAC_PI_2 - heading.yaw_rad).rem_euclid(TAU)),
            state: state.map(LocalizationState::name),
        });
        Self { frames: Some(frames.collect()), ..self }
    }

    /// What entries have in common that are averaged over seeds.
    pub fn row_key(&self) -> (String, Option<&'static str>, bool, bool, String) {
        let split = self.split.clone().unwrap_or_default();
        (split, self.recipe, self.noisy, self.fixed, self.features.clone())
    }
}

/// The entries as a text table, seeds averaged: the shape of the paper's Tables 1 and 2, and beside it what tells more.
pub fn table(entries: &[Entry]) -> String {
    let mut keys = Vec::new();
    for entry in entries {
        if !keys.contains(&entry.row_key()) {
            keys.push(entry.row_key());
        }
    }
    let mut text = String::new();
    let mut split_before = None;
    for key in keys {
        let rows: Vec<&Entry> = entries.iter().filter(|entry| entry.row_key() == key).collect();
        if split_before.as_ref() != Some(&key.0) {
            text += &heading(rows[0], rows.len());
            split_before = Some(key.0.clone());
        }
        text += &line(&rows);
    }
    text
}

fn heading(first: &Entry, seeds: usize) -> String {
    let n_test = counted(first.n_test, "test frame");
    let counts = format!("{} learning, {} validation, {n_test}", first.n_learning, first.n_validation);
    let title = match (&first.split, seeds) {
        (Some(split), 1) => format!("{split} split: {counts}"),
        (Some(split), _) => format!("{split} split: {counts}, mean over {seeds} seeds"),
        (None, _) => format!("against a map: {}", counted(first.n_test, "frame")),
    };
    format!(
        "\n{title}\n{:8} {:26} {:>6} {:>5} {:>5} {:>12} {:>7} {:>7} {:>7} {:>7} | {:>7} {:>7} {:>7} {:>7} {:>6} {:>6} | {:>8} {:>8}\n",
        "recipe",
        "features",
        "images",
        "m",
        "rank",
        "kept",
        "all T",
        "BE V",
        "BE T",
        "e_max",
        "RMSE",
        "median",
        "P90",
        "P95",
        ">10 m",
        "skill",
        "BIC all",
        "BIC kept"
    )
}

fn line(rows: &[&Entry]) -> String {
    let first = rows[0];
    let mean = |of: &dyn Fn(&Entry) -> Option<f64>| -> Option<f64> {
        let values: Option<Vec<f64>> = rows.iter().map(|entry| of(entry)).collect();
        values.map(|values| values.iter().sum::<f64>() / values.len() as f64)
    };
    let number = |value: Option<f64>, width: usize, decimals: usize| match value {
        // Rounded to zero is zero, without a sign.
        Some(value) if value.abs() < 0.5 * 10.0_f64.powi(-(decimals as i32)) => format!("{:>width$.decimals$}", 0.0),
        Some(value) => format!("{value:>width$.decimals$}"),
        None => format!("{:>width$}", "-"),
    };
    let in_meters = |value: Option<f64>| {
        let decimals = if value.is_some_and(|v| v.abs() < 9.995) { 2 } else { 1 };
        number(value, 7, decimals)
    };
    let meters = |of: &dyn Fn(&Entry) -> Option<f64>| in_meters(mean(of));
    let count = |of: fn(&Entry) -> Option<usize>| mean(&|entry| of(entry).map(|n| n as f64));
    let kept = match (count(|e| e.kept), mean(&|e| e.compression)) {
        (Some(kept), Some(compression)) => format!("{kept:.0} ({compression:.1})"),
        (Some(kept), None) => format!("{kept:.0}"),
        _ => "-".into(),
    };
    let variant = match (first.noisy, first.fixed) {
        (true, _) => " (noisy)",
        (_, true) => " (fixed)",
        _ => "",
    };
    format!(
        "{:8} {:26} {:>6} {} {} {kept:>12} {} {} {} {} | {} {} {} {} {} {} | {} {}\n",
        first.recipe.unwrap_or("-"),
        format!("{}{variant}", first.features),
        first.n_learned_from,
        number(count(|e| e.m), 5, 0),
        number(count(|e| e.rank), 5, 0),
        meters(&|e| e.rmse_all_test_m),
        meters(&|e| e.rmse_be_validation_m),
        meters(&|e| e.rmse_be_test_m),
        in_meters(emax_m(rows)),
        meters(&|e| e.rmse_m),
        meters(&|e| e.median_m),
        meters(&|e| e.p90_m),
        meters(&|e| e.p95_m),
        number(mean(&|e| e.share_over_10m.map(|share| 100.0 * share)), 5, 1) + "%",
        number(mean(&|e| e.skill), 6, 2),
        number(mean(&|e| e.bic_all), 8, 0),
        number(mean(&|e| e.bic_kept), 8, 0),
    )
}

/// Largest test error of all entries \[m\]: the mean of maxima would be the maximum of nothing.
pub fn emax_m(entries: &[&Entry]) -> Option<f64> {
    entries.iter().map(|entry| entry.emax_test_m).reduce(|a, b| Some(a?.max(b?))).flatten()
}

/// What the columns mean, for under the tables.
pub const LEGEND: &str = "\
All errors in metres, from the positions as recorded, or from --truth, also where the positions that are learned from
are corrected. images: what the tested model was learned from; the default recipe chooses nothing on the validation
frames, so that, once measured on them (BE V), it learns from them too. m properties, rank after scaling, kept by the
selection (m / kept). RMSE: all T with all features on the test frames; BE V and BE T with the features kept, on
validation and test frames; e_max the largest test error of all seeds, where all else is their mean. Right of the bar,
the estimate the recipe stands for. skill: 1 - RMSE / RMSE of always answering the median position; 1 is perfect, 0 knows
nothing. Where features are chosen, BE V is of the frames they were chosen on: it flatters. Rows of features are of single
frames; `filtered` and `smoothed` take all features and the frames one after the other, filtered only those for which it
says a position.

Without a recipe: nearest, the learning image with the most similar z-scored properties; aligned, by circular correlation
of small panoramas; bow-nearest, by visual words; median, always the median position. bow is the paper's bag of words:
labels are test positions, and its errors are of labels (eq. 15), 0 where the label is right, up to 5 m away: they are not
to be compared with the others. Words, and for bow neighbours, are chosen on the validation frames, like the paper's
features; nothing is chosen on the test frames.
";

#[cfg(test)]
mod tests {
    use super::*;

    fn entry(seed: u64, rmse_m: f64) -> Entry {
        Entry {
            recipe: Some("paper"),
            features: "fft".into(),
            estimator: "single",
            split: Some("random".into()),
            seed: Some(seed),
            m: Some(128),
            rmse_m: Some(rmse_m),
            ..Entry::default()
        }
    }

    #[test]
    fn seeds_are_averaged_into_one_row() {
        let of = |seed, rmse_m, emax_m| Entry { emax_test_m: Some(emax_m), ..entry(seed, rmse_m) };
        let text = table(&[of(0, 1.0, 4.0), of(1, 3.0, 7.5)]);
        assert!(text.contains("mean over 2 seeds") && text.contains("2.00") && text.lines().count() == 4, "{text}");
        // The largest error of all is no mean.
        assert!(text.contains("7.50") && !text.contains("5.75"), "{text}");
    }

    #[test]
    fn the_contract_s_keys_are_there_and_null_where_they_mean_nothing() {
        let json = serde_json::to_value(entry(0, 1.0)).expect("plain data");
        for key in [
            "recipe",
            "features",
            "estimator",
            "split",
            "seed",
            "noisy",
            "fixed",
            "n_learning",
            "n_validation",
            "n_test",
            "m",
            "rank",
            "kept",
            "compression",
            "rmse_all_test_m",
            "rmse_be_validation_m",
            "rmse_be_test_m",
            "emax_test_m",
            "rmse_m",
            "median_m",
            "p90_m",
            "p95_m",
            "share_over_10m",
            "recall_1m",
            "recall_2m",
            "recall_5m",
            "recall_10m",
            "chosen_on",
            "neighbours",
            "classified_share",
            "skill",
            "heading_median_deg",
            "localized_share",
            "first_localized_s",
            "first_localized_m",
            "nees_mean",
            "coverage_95",
            "bic_all",
            "bic_kept",
        ] {
            assert!(json.get(key).is_some(), "{key} is missing");
        }
        assert!(json["nees_mean"].is_null() && json.get("frames").is_none());
    }
}
