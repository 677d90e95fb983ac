//! Recordings → map. Offline only: nothing on the vehicle uses it.
//!
//! A [`Survey`] holds positions and properties of all frames; a [`Recipe`] says how they become features and Gaussian
//! processes; [`run`] carries out the paper's protocol on a [`Split`]; [`train`] makes a map of everything.

mod axes;
mod group;
pub mod noise_whitening;
mod panoramas;
pub mod perturbation;
mod recognition;
mod split;
mod subset;
mod survey;
mod temperature;
mod track;
mod trial;
mod update;

pub use group::{LearnError, LearnedGroup};
pub use panoramas::describe_panoramas;
pub use split::{BLOCKS, Split, SplitError};
pub use subset::{Elimination, LikelihoodTable, backward_elimination};
pub use survey::{Survey, SurveyError, SurveyOptions, SurveyedFrame};
pub use temperature::{covers, credible_level};
pub use track::{Similarity, Smoothed, TrackSmoother};
pub use trial::{EliminationOnTest, Outcome, Outcomes, Step, Trial, TrialError, locate, noisy, run};
pub use update::{BeforeAndAfter, UpdateError, UpdateReport, update};

use crate::gp::LearningPositions;
use crate::map::{
    CandidateCells, Compass, FORMAT_VERSION, FeatureMap, GroupInfo, MapGroup, MapInfo, Recipe, Selection, Smoothing,
    SplitKind, TrackReport, TrainedOn, ValidationFigures,
};
use crate::metrics::{ErrorFigures, component_median};
use crate::types::{PositionM, distance_m};

/// Choices of a training run.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrainSettings {
    pub split: SplitKind,
    pub seed: u64,
    pub grid_step_m: f64,
    /// Only cells at most this far from a learning position become candidates; [`NEAR_SPACINGS`] × the spacing of the
    /// positions if not given.
    pub within_m: Option<f64>,
    pub smoothing: Smoothing,
}

/// Cells further than this many median spacings from every learning position are left out.
pub const NEAR_SPACINGS: f64 = 7.0;

/// Makes a map of all frames of `survey`: Algorithm 1 of Do et al. (2015).
///
/// A quarter of the frames is first held back to choose features and to measure on. The map itself is then of all
/// frames, at positions that `settings.smoothing` made of those recorded: a recipe without selection learns again from
/// all; after a selection, the scaling and hyperparameters that it was made with are kept and the Gaussian processes
/// conditioned on all frames. `sources` names the recordings.
pub fn train(
    survey: &Survey,
    sources: &[String],
    recipe: &Recipe,
    settings: &TrainSettings,
    on_step: impl Fn(Step) + Sync,
) -> Result<FeatureMap, TrialError> {
    let positions_m = survey.positions_m();
    let mut split = Split::new(settings.split, survey.len(), settings.seed);
    split.learning.append(&mut split.test);
    split.learning.sort_unstable();
    let tracks = match settings.smoothing {
        Smoothing::None => None,
        Smoothing::Track => Some((TrackSmoother::new(survey, &positions_m), Similarity::of(survey, recipe))),
    };
    let smoothed = |rows: &[usize]| tracks.as_ref().map(|(tracks, views)| tracks.smoothed(rows, views.as_ref()));
    let held_out = smoothed(&split.learning);
    // Measured before anything is learned from the validation frames.
    let held_out_m = held_out.as_ref().map_or(&positions_m, |smoothed| &smoothed.positions_m);
    let held_back = Recipe { refit: false, ..recipe.clone() };
    let remaining_std_m =
        held_out.as_ref().map_or_else(|| vec![0.0; survey.len()], |smoothed| smoothed.remaining_std_m.clone());
    let trial = Trial {
        recipe: &held_back,
        split: &split,
        grid_step_m: settings.grid_step_m,
        recorded_m: held_out_m,
        remaining_std_m: &remaining_std_m,
    };
    let outcomes = run(survey, &trial, &on_step)?;
    let learning_m: Vec<_> = split.learning.iter().map(|&row| positions_m[row]).collect();
    let know_nothing_m = component_median(&learning_m);
    let truth_m: Vec<_> = split.validation.iter().map(|&row| positions_m[row]).collect();
    let validation = outcomes.rows.iter().filter_map(|row| {
        let figures = ErrorFigures::of(&row.kept_validation_m, &truth_m, know_nothing_m)?;
        Some(ValidationFigures {
            features: row.features.clone(),
            frames: figures.n,
            rmse_m: figures.rmse_m,
            median_m: figures.median_m,
            p95_m: figures.p95_m,
            share_over_10m: figures.share_over_10m,
            skill: figures.skill,
        })
    });
    let validation = validation.collect();
    let (temperature, gap_ratio) = match (temperature_between_recordings(survey, &trial)?, outcomes.temperature) {
        (None, Some(temperature)) if settings.split == SplitKind::Random => (temperature, HELD_BACK_GAP_RATIO),
        (between, held_back) => (between.or(held_back).unwrap_or(1.0), 1.0),
    };
    let least_resemblance = outcomes.least_resemblance.map(|resemblance| resemblance / temperature);

    let everything: Vec<usize> = (0..survey.len()).collect();
    let smoothed = smoothed(&everything);
    let reports: Vec<Option<TrackReport>> = match &smoothed {
        Some(smoothed) => smoothed.reports.iter().copied().map(Some).collect(),
        None => vec![None; sources.len()],
    };
    let learned_m = smoothed.map_or(positions_m, |smoothed| smoothed.positions_m);
    let learning = LearningPositions::of_recordings(learned_m, &survey.recordings_of(&everything));
    let near_m = NEAR_SPACINGS * learning.spacing_m();
    let within_m = settings.within_m.unwrap_or(near_m.max(2.0 * settings.grid_step_m));
    let cells = CandidateCells::around(learning.positions(), settings.grid_step_m, Some(within_m))?;
    let centers_m = cells.centers_m();
    let (mut infos, mut groups) = (Vec::new(), Vec::new());
    for selected in outcomes.groups.into_iter().filter(|group| group.features() > 0) {
        let descriptor = selected.recipe.descriptor;
        let properties = survey.properties(descriptor, &everything);
        let group = match recipe.selection {
            Selection::Backward => selected.conditioned_on(properties.as_ref()),
            Selection::None => {
                on_step(Step::Fitting { descriptor: descriptor.name(), features: descriptor.dimensions() });
                let changes = survey.changes(descriptor, &everything);
                let fitted = || on_step(Step::FeatureFitted);
                LearnedGroup::learn(selected.recipe, &learning, properties.as_ref(), changes.as_ref(), fitted)?
            }
        };
        let (field_mean, field_variance) = group.predict(&learning, &centers_m)?;
        infos.push(GroupInfo {
            recipe: group.recipe,
            rank: group.rank,
            features: group.features(),
            hyperparameters: group.hyperparameters,
        });
        groups.push(MapGroup { scaling: group.scaling, learning: group.learning, field_mean, field_variance });
        on_step(Step::Done);
    }
    if groups.is_empty() {
        return Err(TrialError::NothingKept);
    }
    let compass = compass_of(survey, learning.positions());
    let frames_of = |recording: usize| survey.frames.iter().filter(|frame| frame.recording == recording).count();
    let info = MapInfo {
        format_version: FORMAT_VERSION,
        program: env!("CARGO_PKG_VERSION").into(),
        recordings: sources
            .iter()
            .enumerate()
            .zip(reports)
            .map(|((i, name), track)| TrainedOn { name: name.clone(), frames: frames_of(i), track })
            .collect(),
        recipe: recipe.name,
        selection: recipe.selection,
        refine: recipe.refine,
        split: settings.split,
        seed: settings.seed,
        origin: survey.origin,
        calibration: survey.calibration.clone(),
        image_size_px: survey.image_size_px.into(),
        grid: cells.grid,
        groups: infos,
        temperature,
        gap_ratio,
        least_resemblance,
        heading_std_rad: compass.as_ref().map(|compass| compass.std_rad),
        validation,
    };
    Ok(FeatureMap { info, positions_m: learning.positions().to_vec(), cells, groups, compass })
}

/// The panoramas of `survey` at the positions `learned_m`, if it has them and every frame has a yaw.
fn compass_of(survey: &Survey, learned_m: &[PositionM]) -> Option<Compass> {
    let yaws_rad: Vec<f64> = survey.frames.iter().map(|frame| frame.yaw_rad).collect::<Option<_>>()?;
    if survey.compass().is_empty() {
        return None;
    }
    let sense = Compass::sense_of(survey.calibration.azimuth);
    let (positions_m, signatures) = (learned_m.to_vec(), survey.compass().to_vec());
    let compass = Compass { positions_m, yaws_rad, signatures, sense, std_rad: 0.0 };
    let std_rad = compass.measured_std_rad();
    Some(Compass { std_rad, ..compass })
}

/// A frame that is held back leaves a gap of two spacings, where another drive's frames meet gaps of one. It errs by nearly
/// twice as much: measured on towns and corridors with exact positions, docs/ablation.md.
const HELD_BACK_GAP_RATIO: f64 = 1.8;

/// Recordings that are held back in turn to learn the temperature: each costs a training.
const MAX_HELD_BACK: usize = 3;

/// The temperature of `trial` on whole recordings that were held back: the geometric mean over them. `None` for a single
/// recording, and where recordings do not see the same places.
///
/// What another day adds to the errors no frames of the same day can show.
fn temperature_between_recordings(survey: &Survey, trial: &Trial) -> Result<Option<f64>, TrialError> {
    let everything: Vec<usize> = (0..survey.len()).collect();
    let recordings = survey.recordings_of(&everything);
    let count = recordings.last().map_or(0, |last| last + 1);
    let mut logs = Vec::new();
    for held_back in (0..count).take(if count > 1 { MAX_HELD_BACK } else { 0 }) {
        let of_others = |row: &usize| recordings[*row] != held_back;
        let learning: Vec<usize> = everything.iter().copied().filter(of_others).collect();
        let at = |row: usize| trial.recorded_m[row];
        let others_m: Vec<PositionM> = learning.iter().map(|&row| at(row)).collect();
        let near_m = LearningPositions::new(others_m.clone()).spacing_m().max(trial.grid_step_m);
        let seen = |&row: &usize| !of_others(&row) && others_m.iter().any(|&p| distance_m(p, at(row)) <= near_m);
        let validation: Vec<usize> = everything.iter().copied().filter(seen).collect();
        if validation.is_empty() {
            continue;
        }
        let split = Split { learning, validation, test: Vec::new() };
        let outcomes = run(survey, &Trial { split: &split, ..trial.clone() }, |_| {})?;
        logs.extend(outcomes.temperature.map(f64::ln));
    }
    Ok((!logs.is_empty()).then(|| (logs.iter().sum::<f64>() / logs.len() as f64).exp()))
}
