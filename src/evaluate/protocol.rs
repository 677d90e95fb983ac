//! The paper's protocol on one recording: the cases, and the rows that each of them brings.

use faer::Mat;

use super::baselines::{Baseline, BaselineRows, Frames, Views};
use super::entry::Entry;
use super::shifts::PositionShift;
use super::statistics::Section;
use crate::features::Descriptor;
use crate::map::{Grid, Recipe, Selection, Smoothing};
use crate::metrics::ErrorFigures;
use crate::train::{Outcome, Outcomes, Similarity, Split, Step, Survey, TrackSmoother, Trial, TrialError, noisy, run};
use crate::types::PositionM;

/// What is done to the frames of a random split before anything is learned.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum Variant {
    Plain,
    /// Noise on all positions.
    Noisy,
    /// Every panorama turned by its yaw.
    Fixed,
}

/// A split of the frames, and what is done to them.
#[derive(Debug, Clone, PartialEq)]
pub struct Case {
    pub split_name: String,
    pub split: Split,
    /// `None` for a split from a file.
    pub seed: Option<u64>,
    pub variant: Variant,
}

impl Case {
    /// As in `random (noisy), seed 3`.
    pub fn describe(&self) -> String {
        let variant = match self.variant {
            Variant::Plain => "",
            Variant::Noisy => " (noisy)",
            Variant::Fixed => " (fixed)",
        };
        let seed = self.seed.map(|seed| format!(", seed {seed}")).unwrap_or_default();
        format!("{}{variant}{seed}", self.split_name)
    }
}

/// What all cases of a recording have in common.
pub struct Protocol<'a> {
    /// Name of the recording.
    pub dataset: &'a str,
    pub recipes: &'a [Recipe],
    /// One a recipe; `None` where no track is smoothed, or nothing is known of how images change.
    pub similarities: &'a [Option<Similarity>],
    /// Of the positions as they were recorded.
    pub smoother: &'a TrackSmoother,
    /// For all recipes, in place of what is usual for each.
    pub smoothing: Option<Smoothing>,
    /// Exact positions of all frames, where they are known.
    pub truth_m: Option<&'a [PositionM]>,
    /// In place of what is usual for an area of this size.
    pub grid_step_m: Option<f64>,
    pub baselines: &'a [Baseline],
}

/// What the recipes brought in a case.
#[derive(Debug, Clone, Default)]
pub struct CaseResults {
    pub entries: Vec<Entry>,
    /// One a recipe whose positions were smoothed.
    pub shifts: Vec<PositionShift>,
    /// What the fits had to say.
    pub notes: Vec<String>,
}

impl Protocol<'_> {
    pub fn smoothing(&self, recipe: &Recipe) -> Smoothing {
        self.smoothing.unwrap_or(Smoothing::usual(recipe.name))
    }

    /// Learns, selects and tests `case` on `survey`; `on_step` is told which part of the work takes a step, `on_trial` what
    /// each recipe brought.
    ///
    /// # Errors
    /// A recipe cannot be learned from these frames.
    pub fn run(
        &self,
        survey: &Survey,
        case: &Case,
        on_step: impl Fn(&str, Step) + Sync,
        mut on_trial: impl FnMut(&Trial, &Outcomes),
    ) -> Result<CaseResults, TrialError> {
        let frames = CaseFrames::new(self, survey, case);
        let noisy_smoother = (case.variant == Variant::Noisy).then(|| TrackSmoother::new(survey, &frames.recorded_m));
        let smoother = noisy_smoother.as_ref().unwrap_or(self.smoother);
        let grid_step_m = self.grid_step_m.unwrap_or_else(|| Grid::usual_step_m(&frames.recorded_m));
        let mut results = CaseResults::default();
        for (recipe, similarity) in self.recipes.iter().zip(self.similarities) {
            let part = format!("{}, {}", recipe.name.name(), case.describe());
            let (learned_m, remaining_std_m) = match self.smoothing(recipe) {
                Smoothing::None => (frames.recorded_m.clone(), vec![0.0; survey.len()]),
                Smoothing::Track => {
                    // The images of frames that are never learned from have no part in it.
                    let mut learned = case.split.learning.clone();
                    if recipe.refit {
                        learned.extend(&case.split.validation);
                        learned.sort_unstable();
                    }
                    let smoothed = smoother.smoothed(&learned, similarity.as_ref());
                    results.shifts.extend(PositionShift::of_trial(
                        (Section::of(&frames.base), case.seed),
                        recipe.name.name(),
                        &learned,
                        [&frames.recorded_m, &smoothed.positions_m],
                        &frames.indices,
                        smoothed.reports[0],
                    ));
                    (smoothed.positions_m, smoothed.remaining_std_m)
                }
            };
            let trial = Trial {
                recipe,
                split: &case.split,
                grid_step_m,
                recorded_m: &learned_m,
                remaining_std_m: &remaining_std_m,
            };
            let outcomes = run(survey, &trial, |step| on_step(&part, step))?;
            on_trial(&trial, &outcomes);
            for outcome in &outcomes.rows {
                for (warning, count) in &outcome.warnings {
                    let (features, of) = (&outcome.features, outcome.rank);
                    results.notes.push(format!("{part}: {features}: {count} of {of} fits: {}", warning.describe()));
                }
                results.entries.push(frames.entry_of(recipe, outcome, outcomes.learned_from));
            }
        }
        Ok(results)
    }

    /// What the recipes of `case` are compared with; the last row is the answer that knows nothing. `views` are those of
    /// the frames of `survey`.
    pub fn run_baselines(&self, survey: &Survey, views: &Views, case: &Case) -> BaselineRows {
        let of_case = CaseFrames::new(self, survey, case);
        let (base, frames) = (&of_case.base, of_case.frames());
        let mut rows = BaselineRows::default();
        if self.baselines.contains(&Baseline::Nearest) {
            // Those of the paper, where they are there.
            let all = survey.descriptors();
            let of_paper: Vec<Descriptor> = all.iter().copied().filter(|d| Descriptor::PAPER.contains(d)).collect();
            let descriptors = if of_paper.is_empty() { &all } else { &of_paper };
            let of = |rows: &[usize]| side_by_side(descriptors.iter().map(|&d| survey.properties(d, rows)));
            rows.add_nearest(base, &frames, of(&frames.learned_from()).as_ref(), of(frames.test).as_ref());
        }
        rows.add_views(base, &frames, views);
        rows.add_median(base, &frames);
        rows
    }
}

/// The frames of a case: what its rows have in common.
struct CaseFrames<'a> {
    case: &'a Case,
    base: Entry,
    /// Of all frames of the survey.
    recorded_m: Vec<PositionM>,
    indices: Vec<usize>,
    /// What errors are measured against.
    test_m: Vec<PositionM>,
}

impl<'a> CaseFrames<'a> {
    fn new(protocol: &Protocol, survey: &Survey, case: &'a Case) -> Self {
        let recorded_m = match case.variant {
            Variant::Noisy => noisy(&survey.positions_m(), case.seed.unwrap_or(0)),
            _ => survey.positions_m(),
        };
        // Noise on all positions is also on those that errors are measured against, unless the truth is given.
        let truth_m = protocol.truth_m.unwrap_or(&recorded_m);
        let indices: Vec<usize> = survey.frames.iter().map(|frame| frame.index).collect();
        let base = Entry {
            dataset: protocol.dataset.into(),
            estimator: "single",
            split: Some(case.split_name.clone()),
            seed: case.seed,
            noisy: case.variant == Variant::Noisy,
            fixed: case.variant == Variant::Fixed,
            n_learning: case.split.learning.len(),
            n_validation: case.split.validation.len(),
            n_test: case.split.test.len(),
            n_learned_from: case.split.learning.len() + case.split.validation.len(),
            held_out_runs: held_out_runs(case, &indices),
            ..Entry::default()
        };
        Self { case, base, test_m: case.split.test.iter().map(|&row| truth_m[row]).collect(), indices, recorded_m }
    }

    fn frames(&self) -> Frames<'_> {
        let Split { learning, validation, test } = &self.case.split;
        let (recorded_m, test_m, indices) = (&self.recorded_m, &self.test_m, &self.indices);
        Frames { learning, validation, test, recorded_m, test_m, indices }
    }

    fn entry_of(&self, recipe: &Recipe, outcome: &Outcome, learned_from: usize) -> Entry {
        let frames = self.frames();
        let rmse_m = |estimates_m: &[PositionM], truth_m: &[PositionM]| {
            ErrorFigures::of(estimates_m, truth_m, frames.know_nothing_m()).map(|f| f.rmse_m)
        };
        let selects = recipe.selection != Selection::None;
        let entry = Entry {
            recipe: Some(recipe.name.name()),
            features: outcome.features.clone(),
            n_learned_from: learned_from,
            m: Some(outcome.m),
            rank: Some(outcome.rank),
            kept: Some(outcome.kept),
            compression: compression(outcome.m, outcome.kept),
            rmse_all_test_m: rmse_m(&outcome.all_test_m, &self.test_m),
            rmse_be_validation_m: rmse_m(&outcome.kept_validation_m, &frames.positions_m(frames.validation)),
            rmse_be_test_m: selects.then(|| rmse_m(&outcome.kept_test_m, &self.test_m)).flatten(),
            bic_all: outcome.bic_all,
            bic_kept: outcome.bic_kept.filter(|_| selects),
            chosen_on: chosen_on(recipe.selection),
            ..self.base.clone()
        };
        // The estimates that the recipe stands for: with the features it keeps.
        let estimates_m = if selects { &outcome.kept_test_m } else { &outcome.all_test_m };
        frames.with_answers(entry, estimates_m)
    }
}

/// First and last index of every run of test frames, unless single frames were drawn.
fn held_out_runs(case: &Case, indices: &[usize]) -> Option<Vec<[usize; 2]>> {
    /// Runs this many times as long as chance makes them are meant.
    const MEANT: f64 = 2.0;
    let test = &case.split.test;
    let runs: Vec<&[usize]> = test.chunk_by(|before, next| next - before == 1).collect();
    let left_share = 1.0 - test.len() as f64 / indices.len() as f64;
    let in_runs = match case.split_name.as_str() {
        "random" => false,
        "blocked" => true,
        _ => test.len() as f64 * left_share > MEANT * runs.len() as f64,
    };
    in_runs.then(|| runs.iter().map(|run| [indices[run[0]], indices[run[run.len() - 1]]]).collect())
}

/// Which frames features were chosen on.
pub(super) fn chosen_on(selection: Selection) -> Option<&'static str> {
    match selection {
        Selection::None => None,
        Selection::Backward => Some("validation"),
    }
}

/// Properties a kept feature.
pub(super) fn compression(m: usize, kept: usize) -> Option<f64> {
    (kept > 0).then(|| m as f64 / kept as f64)
}

/// Matrices of as many rows, side by side.
pub(super) fn side_by_side(parts: impl Iterator<Item = Mat<f64>>) -> Mat<f64> {
    let parts: Vec<Mat<f64>> = parts.collect();
    let places: Vec<(usize, usize)> =
        parts.iter().enumerate().flat_map(|(part, matrix)| (0..matrix.ncols()).map(move |k| (part, k))).collect();
    Mat::from_fn(parts.first().map_or(0, Mat::nrows), places.len(), |i, k| {
        let (part, column) = places[k];
        parts[part][(i, column)]
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn runs_are_told_from_single_frames() {
        let indices: Vec<usize> = (0..60).map(|i| 2 * i).collect();
        let runs = |name: &str, test: &[usize]| {
            let split = Split { test: test.to_vec(), ..Split::default() };
            let case = Case { split_name: name.into(), split, seed: None, variant: Variant::Plain };
            held_out_runs(&case, &indices)
        };
        let (scattered, held_out) = ([0, 1, 5, 9, 10, 20], [3, 4, 5, 6, 7, 30, 31, 32, 33, 34]);
        assert_eq!(runs("random", &held_out), None);
        assert_eq!(runs("mine.csv", &scattered), None);
        let expected = Some(vec![[6, 14], [60, 68]]);
        assert_eq!((runs("mine.csv", &held_out), runs("blocked", &held_out)), (expected.clone(), expected));
    }
}
