//! Better positions for learning: what a survey's receiver says, corrected by how a vehicle moves and by what it sees.
//!
//! A receiver errs by half a metre or more, but slowly; images tell places apart to a decimetre or two. So the error of the
//! learning positions is the floor of what a map can do. Here the errors b of all frames are estimated in one batch, robust
//! least squares over three kinds of equations:
//!
//! - the *receiver's* error is a stationary process about zero ([`motion`]), so that the whole never drifts away from what
//!   the receivers say on average – and keeps the part of the error that is the same everywhere;
//! - the *vehicle* moves where it is headed and changes its speed slowly ([`motion`]);
//! - a place seen on another *pass* – lap, direction, recording – looks as it did ([`views`]), across recordings too, each
//!   of which has its own receiver error, its own time and its own noise.
//!
//! How large the errors are is estimated from each recording by itself. A recording that is no track – without yaw or time,
//! photographs at random headings, a lattice – is left as it is.
//!
//! What is honest: motion equations use what the receiver said of all frames of a recording, which a survey has whatever
//! images are learned from; images are compared only among the frames that are learned from.

mod adjust;
mod motion;
mod skyline;
mod views;

use std::ops::Range;

use motion::{Track, TrackPoint};
pub use views::Similarity;

use super::survey::Survey;
use crate::features::Descriptor;
use crate::gp::fit::median_neighbour_spacing_m;
use crate::map::{NotATrack, Recipe, TrackReport};
use crate::types::{PositionM, distance_m};
use views::Passes;

/// How far another pass may lie: in spacings of frames, and in deviations of the receiver on top.
const REACH_SPACINGS: f64 = 3.0;
const REACH_DEVIATIONS: f64 = 4.0;
/// The remaining deviation is the mean over so many frames of a recording.
const REPORTED_FRAMES: usize = 64;

/// The tracks of a survey, with all that does not depend on which frames are learned from.
#[derive(Debug, Clone)]
pub struct TrackSmoother {
    positions_m: Vec<PositionM>,
    recording: Vec<usize>,
    tracks: Vec<RecordingTrack>,
    spacing_m: f64,
}

/// One recording: its frames, and the track they are if they are one.
#[derive(Debug, Clone)]
struct RecordingTrack {
    rows: Range<usize>,
    track: Result<Track, NotATrack>,
}

/// What smoothing made of the positions.
#[derive(Debug, Clone, PartialEq)]
pub struct Smoothed {
    /// One a frame of the survey.
    pub positions_m: Vec<PositionM>,
    /// One a recording.
    pub reports: Vec<TrackReport>,
}

impl Smoothed {
    /// What positions may still be off by, one a frame of `survey`; 0 where they were left alone.
    pub fn remaining_std_m(&self, survey: &Survey) -> Vec<f64> {
        let of = |recording: usize| self.reports[recording].remaining_std_m().unwrap_or(0.0);
        survey.frames.iter().map(|frame| of(frame.recording)).collect()
    }
}

impl Similarity {
    /// Of all frames of `survey`, by the shortest descriptor whose reaction to perturbations `recipe` has. `None` where it
    /// has none.
    pub fn of(survey: &Survey, recipe: &Recipe) -> Option<Self> {
        let descriptor =
            recipe.perturbed().into_iter().min_by_key(|descriptor: &Descriptor| descriptor.dimensions())?;
        let rows: Vec<usize> = (0..survey.len()).collect();
        Self::learn(survey.properties(descriptor, &rows).as_ref(), survey.changes(descriptor, &rows).as_ref())
    }
}

impl TrackSmoother {
    /// Looks at the frames of `survey`, whose positions are `positions_m`.
    pub fn new(survey: &Survey, positions_m: &[PositionM]) -> Self {
        let points: Vec<TrackPoint> = survey
            .frames
            .iter()
            .zip(positions_m)
            .map(|(frame, &position_m)| TrackPoint { position_m, yaw_rad: frame.yaw_rad, time_s: frame.time_s })
            .collect();
        let recording: Vec<usize> = survey.frames.iter().map(|frame| frame.recording).collect();
        Self::of_points(&points, &recording)
    }

    /// `recording` rises.
    fn of_points(points: &[TrackPoint], recording: &[usize]) -> Self {
        let mut tracks = Vec::new();
        for number in 0..recording.last().map_or(0, |last| last + 1) {
            let rows = recording.partition_point(|&of| of < number)..recording.partition_point(|&of| of <= number);
            let track = Track::recognise(&points[rows.clone()]);
            tracks.push(RecordingTrack { rows, track });
        }
        let positions_m: Vec<PositionM> = points.iter().map(|point| point.position_m).collect();
        let spacing_m = median_neighbour_spacing_m(&positions_m, recording);
        Self { positions_m, recording: recording.to_vec(), tracks, spacing_m }
    }

    /// The most likely positions when images may be compared among the frames `learned`, in rising order.
    pub fn smoothed(&self, learned: &[usize], similarity: Option<&Similarity>) -> Smoothed {
        // Unknowns: the tracks one after the other, the errors of their courses last, where they make no row long but
        // their own.
        let mut first_unknown = vec![usize::MAX; self.positions_m.len()];
        let mut count = 0;
        let found: Vec<(&RecordingTrack, &Track)> =
            self.tracks.iter().filter_map(|of| Some((of, of.track.as_ref().ok()?))).collect();
        for (of, _) in &found {
            for row in of.rows.clone() {
                first_unknown[row] = count;
                count += 2;
            }
        }
        let courses = count;
        count += found.len();
        let mut equations = Vec::new();
        for (k, (of, track)) in found.iter().enumerate() {
            equations.extend(track.equations(first_unknown[of.rows.start], courses + k));
        }
        let left_alone = |why: NotATrack| Smoothed {
            positions_m: self.positions_m.clone(),
            reports: self
                .tracks
                .iter()
                .map(|of| TrackReport::LeftAlone(of.track.as_ref().err().copied().unwrap_or(why)))
                .collect(),
        };
        let corrected = |unknowns: &[f64]| -> Vec<PositionM> {
            let of_row = |(position_m, &first): (&PositionM, &usize)| match first {
                usize::MAX => *position_m,
                first => [position_m[0] - unknowns[first], position_m[1] - unknowns[first + 1]],
            };
            self.positions_m.iter().zip(&first_unknown).map(of_row).collect()
        };
        if found.is_empty() {
            return left_alone(NotATrack::Undetermined);
        }
        let Some(mut solution) = adjust::solve(count, &equations) else { return left_alone(NotATrack::Undetermined) };
        let mut views = Vec::new();
        if let Some(similarity) = similarity {
            let rows: Vec<usize> = learned.iter().copied().filter(|&row| first_unknown[row] != usize::MAX).collect();
            let receiver_std_m = found.iter().map(|(_, track)| track.noise.receiver_std_m).fold(0.0, f64::max);
            let reach_m = REACH_SPACINGS * self.spacing_m + REACH_DEVIATIONS * receiver_std_m;
            let by_motion_m = corrected(&solution.unknowns);
            let passes = Passes {
                positions_m: &by_motion_m,
                recording: &self.recording,
                rows: &rows,
                reach_m,
                spacing_m: self.spacing_m,
            };
            views = passes.views(similarity);
            equations.extend(views.iter().map(|view| view.equation(&self.positions_m, &first_unknown)));
            match adjust::solve(count, &equations) {
                Some(with_views) => solution = with_views,
                None => return left_alone(NotATrack::Undetermined),
            }
        }

        let positions_m = corrected(&solution.unknowns);
        let report = |of: &RecordingTrack| match &of.track {
            Err(why) => TrackReport::LeftAlone(*why),
            Ok(track) => {
                let n = of.rows.len() as f64;
                let moved_m2: f64 =
                    of.rows.clone().map(|row| distance_m(positions_m[row], self.positions_m[row]).powi(2)).sum();
                let every = of.rows.len().div_ceil(REPORTED_FRAMES);
                let variances_m2: Vec<f64> = (of.rows.clone().step_by(every))
                    .flat_map(|row| [0, 1].map(|axis| solution.factor.inverse_diagonal(first_unknown[row] + axis)))
                    .collect();
                TrackReport::Smoothed {
                    receiver_std_m: track.noise.receiver_std_m,
                    receiver_time_s: track.noise.receiver_time_s,
                    moved_m: (moved_m2 / n).sqrt(),
                    remaining_std_m: (variances_m2.iter().sum::<f64>() / variances_m2.len() as f64).sqrt(),
                    views: views.iter().filter(|view| of.rows.contains(&view.frame)).count(),
                }
            }
        };
        Smoothed { reports: self.tracks.iter().map(report).collect(), positions_m }
    }
}

#[cfg(test)]
mod tests;
