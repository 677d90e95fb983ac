//! A drive added to a map: a new appearance of places that it knows, and streets that it does not.
//!
//! Scaling and hyperparameters stay those of the map; its Gaussian processes are conditioned on the frames of both. What
//! that brings is measured before anything is decided, on frames of the map and of the drive that are held back: the map
//! must not become worse unnoticed.

use faer::Mat;
use rayon::prelude::*;

use super::group::{LearnError, LearnedGroup};
use super::survey::Survey;
use super::temperature::fit_temperature;
use super::track::TrackSmoother;
use super::trial::locate;
use super::{NEAR_SPACINGS, compass_of};
use crate::gp::{GpError, LearningPositions};
use crate::localize::MapFields;
use crate::map::{
    CandidateCells, CellsError, Compass, FeatureMap, GroupField, GroupInfo, MapGroup, MapInfo, Smoothing, TrackReport,
    TrainedOn,
};
use crate::metrics::{ErrorFigures, component_median};
use crate::types::PositionM;

/// Every so many frames of the drive, and of the map, are held back to measure on.
const HELD_BACK_OF_DRIVE: usize = 4;
const HELD_BACK_OF_MAP: usize = 8;
/// Fewer frames than this are no drive.
const MIN_FRAMES: usize = 16;
/// Positions that err more than this, on either axis, as far as smoothing can tell, are not learned from \[m\].
const MAX_POSITION_STD_M: f64 = 1.5;
/// Errors may grow by this share, and by so much, before a map counts as worse: figures of so few frames vary.
const TOLERATED_SHARE: f64 = 0.05;
const TOLERATED_M: f64 = 0.05;

/// What adding a drive did.
#[derive(Debug, Clone)]
pub struct UpdateReport {
    pub frames: usize,
    /// What was made of the drive's positions.
    pub track: Option<TrackReport>,
    /// Candidate cells before and after.
    pub cells: [usize; 2],
    /// On frames of the map that were held back.
    pub old: Option<BeforeAndAfter>,
    /// On frames of the drive that were held back.
    pub new: BeforeAndAfter,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BeforeAndAfter {
    pub before: ErrorFigures,
    pub after: ErrorFigures,
}

#[derive(Debug, thiserror::Error)]
pub enum UpdateError {
    #[error(transparent)]
    Learn(#[from] LearnError),
    #[error(transparent)]
    Gp(#[from] GpError),
    #[error(transparent)]
    Cells(#[from] CellsError),
    #[error("{frames} frames are too few to add: at least {MIN_FRAMES}")]
    TooFewFrames { frames: usize },
    #[error(
        "its positions err by about {std_m:.1} m an axis, more than {MAX_POSITION_STD_M} m: the map would learn the errors"
    )]
    PoorPositions { std_m: f64 },
    #[error("the map was trained on {name} already")]
    KnownAlready { name: String },
}

impl BeforeAndAfter {
    fn is_worse(&self) -> bool {
        let grown = |before: f64, after: f64| after > before * (1.0 + TOLERATED_SHARE) + TOLERATED_M;
        grown(self.before.rmse_m, self.after.rmse_m) || grown(self.before.median_m, self.after.median_m)
    }
}

impl UpdateReport {
    /// Whether frames of the map or of the drive are localized worse than before.
    pub fn is_worse(&self) -> bool {
        self.new.is_worse() || self.old.as_ref().is_some_and(BeforeAndAfter::is_worse)
    }
}

/// `map` with the frames of `survey`, a drive called `name`, and what that did.
pub fn update(
    map: &FeatureMap,
    survey: &Survey,
    name: &str,
    smoothing: Smoothing,
) -> Result<(FeatureMap, UpdateReport), UpdateError> {
    if map.info.recordings.iter().any(|recording| recording.name == name) {
        return Err(UpdateError::KnownAlready { name: name.into() });
    }
    if survey.len() < MIN_FRAMES {
        return Err(UpdateError::TooFewFrames { frames: survey.len() });
    }
    let (positions_m, track) = smoothed(survey, smoothing)?;
    let joined = Joined::new(map, survey, &positions_m);
    let cells = joined.cells(&map.info)?;

    let is_held_back = |row: usize| match row.checked_sub(joined.of_map) {
        None => row.is_multiple_of(HELD_BACK_OF_MAP),
        Some(of_drive) => of_drive.is_multiple_of(HELD_BACK_OF_DRIVE),
    };
    let (tests, rest): (Vec<usize>, Vec<usize>) = (0..joined.positions_m.len()).partition(|&row| is_held_back(row));
    let known: Vec<usize> = rest.iter().copied().filter(|&row| row < joined.of_map).collect();
    let before = joined.log_likelihoods(&map.info.groups, &known, &tests, &cells)?;
    let after = joined.log_likelihoods(&map.info.groups, &rest, &tests, &cells)?;
    let compare = |is_wanted: &dyn Fn(usize) -> bool| {
        let wanted: Vec<usize> = (0..tests.len()).filter(|&i| is_wanted(tests[i])).collect();
        let truth_m: Vec<PositionM> = wanted.iter().map(|&i| joined.positions_m[tests[i]]).collect();
        let know_nothing_m = component_median(&joined.positions_m);
        let figures = |rows: &[Vec<f32>]| {
            let found: Vec<PositionM> = wanted.iter().map(|&i| locate(&cells, &rows[i], map.info.refine)).collect();
            ErrorFigures::of(&found, &truth_m, know_nothing_m)
        };
        Some(BeforeAndAfter { before: figures(&before)?, after: figures(&after)? })
    };
    let report = UpdateReport {
        frames: survey.len(),
        track,
        cells: [map.cells.len(), cells.len()],
        old: compare(&|row| row < joined.of_map),
        new: compare(&|row| row >= joined.of_map).expect("frames of the drive are held back"),
    };

    // What another day changes, the drive shows the map as it was.
    let of_drive: Vec<usize> = (0..tests.len()).filter(|&i| tests[i] >= joined.of_map).collect();
    let rows: Vec<&[f32]> = of_drive.iter().map(|&i| before[i].as_slice()).collect();
    let truth_m: Vec<PositionM> = of_drive.iter().map(|&i| joined.positions_m[tests[i]]).collect();
    let remaining_std_m = track.and_then(|track| track.remaining_std_m()).unwrap_or(0.0);
    let std_m = vec![remaining_std_m; of_drive.len()];
    let (temperature, gap_ratio) = match fit_temperature(&cells, &rows, &truth_m, &std_m) {
        Some(found) => more_cautious(&map.info, found),
        None => (map.info.temperature, map.info.gap_ratio),
    };
    let compass = joined.compass(map, survey, &positions_m);
    let info = MapInfo {
        grid: cells.grid,
        temperature,
        gap_ratio,
        least_resemblance: map.info.least_resemblance.map(|least| least * map.info.temperature / temperature),
        heading_std_rad: compass.as_ref().map(|compass| compass.std_rad),
        recordings: [map.info.recordings.clone(), vec![TrainedOn { name: name.into(), frames: survey.len(), track }]]
            .concat(),
        groups: map.info.groups.iter().map(GroupInfo::clone).collect(),
        ..map.info.clone()
    };
    let groups = joined.groups_on(&cells)?;
    Ok((FeatureMap { info, positions_m: joined.positions_m, cells, groups, compass }, report))
}

/// Temperature and ratio of gaps of a map on which those frames of another drive showed the temperature `found`, in its own
/// gaps: neither likelihoods nor sightings become sharper than the map had them.
fn more_cautious(map: &MapInfo, found: f64) -> (f64, f64) {
    let temperature = found.max(map.temperature);
    let of_sightings = found.max(map.temperature / map.gap_ratio.powi(2));
    (temperature, (temperature / of_sightings).sqrt())
}

/// The positions to learn from: as recorded, unless they are to be smoothed; refused where they err too much.
fn smoothed(survey: &Survey, smoothing: Smoothing) -> Result<(Vec<PositionM>, Option<TrackReport>), UpdateError> {
    let recorded_m = survey.positions_m();
    let smoothed = TrackSmoother::new(survey, &recorded_m).smoothed(&[], None);
    let track = smoothed.reports.first().copied();
    match (track, smoothing) {
        (Some(TrackReport::Smoothed { remaining_std_m, .. }), _) if remaining_std_m > MAX_POSITION_STD_M => {
            Err(UpdateError::PoorPositions { std_m: remaining_std_m })
        }
        (_, Smoothing::None) => Ok((recorded_m, None)),
        (track, Smoothing::Track) => Ok((smoothed.positions_m, track)),
    }
}

/// Frames of the map, and behind them those of the drive.
struct Joined {
    /// Number of frames of the map.
    of_map: usize,
    positions_m: Vec<PositionM>,
    /// A new number for each.
    recordings: Vec<usize>,
    groups: Vec<LearnedGroup>,
}

impl Joined {
    fn new(map: &FeatureMap, survey: &Survey, positions_m: &[PositionM]) -> Self {
        let of_map = map.positions_m.len();
        let rows: Vec<usize> = (0..survey.len()).collect();
        let groups = map
            .info
            .groups
            .iter()
            .zip(&map.groups)
            .map(|(info, group)| {
                let features = group.scaling.apply(survey.properties(info.recipe.descriptor, &rows).as_ref());
                let learning =
                    Mat::from_fn(of_map + rows.len(), features.ncols(), |i, r| match i.checked_sub(of_map) {
                        None => group.learning[(i, r)],
                        Some(i) => features[(i, r)],
                    });
                LearnedGroup {
                    recipe: info.recipe,
                    scaling: group.scaling.clone(),
                    hyperparameters: info.hyperparameters.clone(),
                    learning,
                    rank: info.rank,
                }
            })
            .collect();
        let counts = map.info.recordings.iter().map(|recording| recording.frames).chain([survey.len()]);
        let recordings = counts.enumerate().flat_map(|(number, frames)| vec![number; frames]).collect();
        Self { of_map, positions_m: [&map.positions_m, positions_m].concat(), recordings, groups }
    }

    fn learning(&self, rows: &[usize]) -> LearningPositions {
        let recordings: Vec<usize> = rows.iter().map(|&row| self.recordings[row]).collect();
        LearningPositions::of_recordings(rows.iter().map(|&row| self.positions_m[row]).collect(), &recordings)
    }

    fn all_rows(&self) -> Vec<usize> {
        (0..self.positions_m.len()).collect()
    }

    /// Cells as near to the frames as training has them.
    fn cells(&self, info: &MapInfo) -> Result<CandidateCells, CellsError> {
        let step_m = info.grid.step_m;
        let near_m = NEAR_SPACINGS * self.learning(&self.all_rows()).spacing_m();
        CandidateCells::around(&self.positions_m, step_m, Some(near_m.max(2.0 * step_m)))
    }

    /// Summed log-likelihoods of the frames `queries` at every cell, learned from `rows`: query by query.
    fn log_likelihoods(
        &self,
        infos: &[GroupInfo],
        rows: &[usize],
        queries: &[usize],
        cells: &CandidateCells,
    ) -> Result<Vec<Vec<f32>>, UpdateError> {
        let (learning, centers_m) = (self.learning(rows), cells.centers_m());
        let fields: Vec<GroupField> = self
            .groups
            .iter()
            .map(|group| {
                let (mean, variance) = group.of_rows(rows).predict(&learning, &centers_m)?;
                Ok(GroupField { mean, variance })
            })
            .collect::<Result<_, UpdateError>>()?;
        let fields = MapFields::new(infos, cells.len(), fields);
        let features_of = |query: usize| self.groups.iter().flat_map(move |group| group.learning.row(query).iter());
        Ok(queries
            .par_iter()
            .map_init(Vec::new, |scratch, &query| {
                let features: Vec<f32> = features_of(query).map(|&z| z as f32).collect();
                let mut log_likelihood = vec![0.0; cells.len()];
                fields.add_log_likelihood(&features, scratch, &mut log_likelihood);
                log_likelihood
            })
            .collect())
    }

    fn groups_on(&self, cells: &CandidateCells) -> Result<Vec<MapGroup>, UpdateError> {
        let (learning, centers_m) = (self.learning(&self.all_rows()), cells.centers_m());
        let of_group = |group: &LearnedGroup| {
            let (field_mean, field_variance) = group.predict(&learning, &centers_m)?;
            let (scaling, learning) = (group.scaling.clone(), group.learning.clone());
            Ok(MapGroup { scaling, learning, field_mean, field_variance })
        };
        self.groups.iter().map(of_group).collect()
    }

    /// The panoramas of both, where both have headings.
    fn compass(&self, map: &FeatureMap, survey: &Survey, positions_m: &[PositionM]) -> Option<Compass> {
        let (old, new) = (map.compass.as_ref()?, compass_of(survey, positions_m)?);
        let joined = Compass {
            positions_m: self.positions_m.clone(),
            yaws_rad: [&old.yaws_rad[..], &new.yaws_rad].concat(),
            signatures: [&old.signatures[..], &new.signatures].concat(),
            sense: old.sense,
            std_rad: 0.0,
        };
        let std_rad = joined.measured_std_rad();
        Some(Compass { std_rad, ..joined })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::map::tests::small_map;

    #[test]
    fn another_drive_makes_neither_likelihoods_nor_sightings_sharper() {
        // Learned from frames held back: 16 in gaps twice as wide, so that sightings are as at 4.
        let map = MapInfo { temperature: 16.0, gap_ratio: 2.0, ..small_map().info };
        for (found, expected) in [(20.0, (20.0, 1.0)), (8.0, (16.0, 2.0_f64.sqrt())), (2.0, (16.0, 2.0))] {
            assert_eq!(more_cautious(&map, found), expected, "{found}");
        }
    }
}
