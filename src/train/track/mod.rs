//! Better positions for learning: what a survey's receiver says, corrected by how a vehicle moves and by what it sees.
//!
//! A receiver errs by half a metre or more, but slowly; images tell places apart to a decimetre or two. So the error of the
//! learning positions is the floor of what a map can do. Here the errors b of all frames are estimated in one batch, robust
//! least squares over four kinds of equations:
//!
//! - the *receiver's* error is a stationary process about zero ([`motion`]), so that the whole never drifts away from what
//!   the receivers say on average – and keeps the part of the error that is the same everywhere;
//! - *points* of the scene, [followed](follow) from frame to frame, are where their [`bearings`] meet: how the frames of a
//!   stretch lie to each other, to a few centimetres a step;
//! - the *vehicle* moves where it is headed and changes its speed slowly ([`motion`]);
//! - a place seen on another *pass* – lap, direction, recording – looks as it did ([`views`]), and shows the same points
//!   ([`across`]): across recordings too, each of which has its own receiver error, its own time and its own noise.
//!
//! How large the errors are is estimated from each recording by itself. A recording that is no track – without yaw or time,
//! photographs at random headings, a lattice – is left as it is.
//!
//! What is honest: motion equations use what the receiver said of all frames of a recording, which a survey has whatever
//! images are learned from; images are compared, and bearings taken, only from the frames that are learned from. Points
//! are followed through all frames, but what lies between two frames says nothing of a frame's own position.

mod across;
mod adjust;
mod bearings;
mod follow;
mod motion;
mod receiver;
mod skyline;
mod views;

use std::collections::BTreeSet;
use std::ops::Range;

use across::Across;
use adjust::{Equation, Solution};
pub use bearings::PointTrack;
use bearings::{Frames, Meetings};
pub use follow::{KeptImage, PointFollower, Sighting};
use motion::{Track, TrackPoint, Unknowns};
use receiver::Receiver;
pub use views::Similarity;

use super::survey::Survey;
use crate::features::Descriptor;
use crate::gp::fit::median_neighbour_spacing_m;
use crate::map::{NotATrack, Recipe, TrackReport};
use crate::types::{PositionM, distance_m};
use views::{Passes, View};

/// How far another pass may lie: in spacings of frames, and in deviations of the receiver on top.
const REACH_SPACINGS: f64 = 3.0;
const REACH_DEVIATIONS: f64 = 4.0;
/// A recording sees points if its frames see so many each, on average, that are where their bearings meet, and if so large a
/// share of all points is. Then its speed counts for less: bearings know better how long a step was.
const ENOUGH_POINTS: usize = 10;
const LEAST_MET: f64 = 0.5;
const SPEED_STDS_BESIDE_BEARINGS: f64 = 3.0;
/// Equations are weighed, and bearings taken, about the positions so far, again and again: loosely at first, when the bearings
/// of a point meet only roughly, and as they deserve in the end.
const LOOSENINGS: [f64; 7] = [8.0, 4.0, 2.0, 1.0, 1.0, 1.0, 1.0];
/// The remaining deviation is the mean over so many frames of a recording, apart for those that were learned from.
const REPORTED_FRAMES: usize = 64;

/// The tracks of a survey, with all that does not depend on which frames are learned from.
#[derive(Debug, Clone)]
pub struct TrackSmoother {
    positions_m: Vec<PositionM>,
    recording: Vec<usize>,
    tracks: Vec<RecordingTrack>,
    spacing_m: f64,
    yaw_rad: Vec<f64>,
    points: Vec<PointTrack>,
    /// Of every row, where points were followed.
    images: Vec<Option<KeptImage>>,
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
    /// What these may still be off by on either axis, one a frame; 0 where they were left alone.
    pub remaining_std_m: Vec<f64>,
    /// One a recording.
    pub reports: Vec<TrackReport>,
}

struct Adjusted {
    solution: Solution,
    /// The tracks with the noise that their receivers may have, and what is known with that; `None` where nothing shows it.
    doubted: Option<(Vec<RecordingTrack>, Solution)>,
    views: Vec<View>,
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
        let (seen, images) = (survey.points().to_vec(), survey.images().to_vec());
        Self { points: seen, images, ..Self::of_points(&points, &recording) }
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
        let yaw_rad = points.iter().map(|point| point.yaw_rad.unwrap_or(0.0)).collect();
        let images = vec![None; points.len()];
        Self { positions_m, recording: recording.to_vec(), tracks, spacing_m, yaw_rad, points: Vec::new(), images }
    }

    /// The most likely positions when images may be compared among the frames `learned`, in rising order.
    pub fn smoothed(&self, learned: &[usize], similarity: Option<&Similarity>) -> Smoothed {
        let layout = Layout::new(&self.tracks, self.positions_m.len());
        let adjusted = if layout.found.is_empty() { None } else { self.adjusted(&layout, learned, similarity) };
        let Some(Adjusted { solution, doubted, views }) = adjusted else { return self.left_alone() };
        let (tracks, known) = match &doubted {
            Some((tracks, doubted)) => (tracks, doubted),
            None => (&self.tracks, &solution),
        };

        let positions_m = self.corrected(&layout, &solution.unknowns);
        let remaining_std_m = self.remaining_std_m(&layout, learned, known);
        let report = |of: &RecordingTrack| match &of.track {
            Err(why) => TrackReport::LeftAlone(*why),
            Ok(track) => {
                let rms = |value: &dyn Fn(usize) -> f64| {
                    (of.rows.clone().map(|row| value(row).powi(2)).sum::<f64>() / of.rows.len() as f64).sqrt()
                };
                TrackReport::Smoothed {
                    receiver_std_m: track.noise.receiver_std_m,
                    receiver_time_s: track.noise.receiver_time_s,
                    moved_m: rms(&|row| distance_m(positions_m[row], self.positions_m[row])),
                    remaining_std_m: rms(&|row| remaining_std_m[row]),
                    views: views.iter().filter(|view| of.rows.contains(&view.frame)).count(),
                }
            }
        };
        Smoothed { reports: tracks.iter().map(report).collect(), remaining_std_m, positions_m }
    }

    fn left_alone(&self) -> Smoothed {
        let why = |of: &RecordingTrack| of.track.as_ref().err().copied().unwrap_or(NotATrack::Undetermined);
        Smoothed {
            positions_m: self.positions_m.clone(),
            remaining_std_m: vec![0.0; self.positions_m.len()],
            reports: self.tracks.iter().map(|of| TrackReport::LeftAlone(why(of))).collect(),
        }
    }

    /// By motion alone first, which shows whether points are where bearings meet; with these; then with other passes, which
    /// are looked for where the bearings say; and with the points that passes share, which are looked for where all of that says.
    /// Then it is known, but for the mean, how the receivers err. How far off the mean may be follows from that; the positions
    /// stay, which stiffer receivers suit better.
    fn adjusted(&self, layout: &Layout, learned: &[usize], similarity: Option<&Similarity>) -> Option<Adjusted> {
        let by_motion = adjust::solve(layout.count, &self.equations(layout, &[]))?;
        let seeing = self.seeing(layout, learned, &by_motion);
        let used: Vec<usize> = learned.iter().copied().filter(|&row| seeing.contains(&self.recording[row])).collect();
        let mut equations = self.equations(layout, &seeing);
        let mut solution = self.refined(layout, &equations, &used, &[], by_motion)?;
        let mut views = Vec::new();
        if let Some(similarity) = similarity {
            let rows: Vec<usize> = learned.iter().copied().filter(|&row| layout.first[row].is_some()).collect();
            views = self.passes(layout, &self.corrected(layout, &solution.unknowns), &rows).views(similarity);
            equations.extend(views.iter().map(|view| view.equation(&self.positions_m, &layout.first)));
            solution = self.refined(layout, &equations, &used, &[], solution)?;
        }
        let joined = self.joined(layout, &used, &solution);
        if joined.is_empty() {
            return Some(Adjusted { solution, doubted: None, views });
        }
        let solution = self.refined(layout, &equations, &used, &joined, solution)?;
        let tracks = self.with_receivers(layout, &joined, &solution);
        let layout = &Layout::new(&tracks, self.positions_m.len());
        let mut equations = self.equations(layout, &seeing);
        equations.extend(views.iter().map(|view| view.equation(&self.positions_m, &layout.first)));
        let doubted = self.refined(layout, &equations, &used, &joined, solution.clone());
        Some(Adjusted { solution, doubted: doubted.map(|doubted| (tracks, doubted)), views })
    }

    /// The tracks, with receivers as the errors of the recordings that `joined` ties show them. A single pass bends as its
    /// receiver does: of that nothing can be learned.
    fn with_receivers(&self, layout: &Layout, joined: &[PointTrack], solution: &Solution) -> Vec<RecordingTrack> {
        let tied: BTreeSet<usize> = joined.iter().flat_map(PointTrack::rows).map(|row| self.recording[row]).collect();
        let mut tracks = self.tracks.clone();
        for RecordingTrack { rows, track } in &mut tracks {
            let Ok(track) = track else { continue };
            if !tied.contains(&self.recording[rows.start]) {
                continue;
            }
            let of_row = |first: &Option<usize>| first.map(|first| [0, 1].map(|axis| solution.unknowns[first + axis]));
            let error_m: Vec<[f64; 2]> = layout.first[rows.clone()].iter().filter_map(of_row).collect();
            if let Some(receiver) = Receiver::of_errors(&track.time_s, &error_m) {
                (track.noise.receiver_std_m, track.noise.receiver_time_s) = (receiver.std_m, receiver.time_s);
            }
        }
        tracks
    }

    fn passes<'a>(&'a self, layout: &Layout, positions_m: &'a [PositionM], rows: &'a [usize]) -> Passes<'a> {
        let receiver_std_m = layout.found.iter().map(|(_, track)| track.noise.receiver_std_m).fold(0.0, f64::max);
        Passes {
            positions_m,
            recording: &self.recording,
            rows,
            reach_m: REACH_SPACINGS * self.spacing_m + REACH_DEVIATIONS * receiver_std_m,
            spacing_m: self.spacing_m,
        }
    }

    /// The points that different passes among the frames `used` share.
    fn joined(&self, layout: &Layout, used: &[usize], solution: &Solution) -> Vec<PointTrack> {
        let positions_m = self.corrected(layout, &solution.unknowns);
        let yaw_errors_rad = layout.yaw_errors_rad(&solution.unknowns);
        let frames = &self.frames(layout, &positions_m, &yaw_errors_rad, 1.0);
        let across = Across { frames, points: &self.points, images: &self.images, rows: used };
        across.joined(&self.passes(layout, &positions_m, used).pairs())
    }

    /// Of every row: the mean over a recording's frames that are `learned`, or over its others.
    fn remaining_std_m(&self, layout: &Layout, learned: &[usize], solution: &Solution) -> Vec<f64> {
        let mut std_m = vec![0.0; self.positions_m.len()];
        for (of, _) in &layout.found {
            let is_learned = |row: &usize| learned.binary_search(row).is_ok();
            let (learned, others): (Vec<usize>, Vec<usize>) = of.rows.clone().partition(is_learned);
            for rows in [learned, others] {
                let mean_m = layout.mean_std_m(solution, &rows);
                rows.into_iter().for_each(|row| std_m[row] = mean_m);
            }
        }
        std_m
    }

    /// What is known without any image; the speed of the recordings `seeing` counts for less.
    fn equations(&self, layout: &Layout, seeing: &[usize]) -> Vec<Equation> {
        let mut equations = layout.priors();
        for (k, (of, track)) in layout.found.iter().enumerate() {
            let unknowns = layout.of_track(of, k);
            let is_seeing = seeing.contains(&self.recording[of.rows.start]);
            let speed_stds = if is_seeing { SPEED_STDS_BESIDE_BEARINGS } else { 1.0 };
            equations.extend(track.receiver_equations(unknowns));
            equations.extend(track.vehicle_equations(unknowns, speed_stds));
        }
        equations
    }

    /// The recordings whose frames `learned` see enough points, most of which are where their bearings meet: neither where
    /// it is dark nor where the camera looks elsewhere than the yaw says.
    fn seeing(&self, layout: &Layout, learned: &[usize], by_motion: &Solution) -> Vec<usize> {
        let positions_m = self.corrected(layout, &by_motion.unknowns);
        let yaw_errors_rad = layout.yaw_errors_rad(&by_motion.unknowns);
        let frames = self.frames(layout, &positions_m, &yaw_errors_rad, LOOSENINGS[1]);
        let is_seeing = |of: &RecordingTrack| {
            let is_used = |row: usize| of.rows.contains(&row) && learned.binary_search(&row).is_ok();
            let rows = of.rows.clone().filter(|&row| is_used(row)).count();
            let Meetings { parts, met, sightings } = frames.meetings(&self.points, is_used);
            rows > 0 && sightings >= ENOUGH_POINTS * rows && met as f64 >= LEAST_MET * parts as f64
        };
        layout.found.iter().filter(|(of, _)| is_seeing(of)).map(|(of, _)| self.recording[of.rows.start]).collect()
    }

    fn frames<'a>(
        &'a self,
        layout: &'a Layout,
        positions_m: &'a [PositionM],
        yaw_error_rad: &'a [f64],
        loosening: f64,
    ) -> Frames<'a> {
        Frames {
            positions_m,
            received_m: &self.positions_m,
            yaw_rad: &self.yaw_rad,
            yaw_error_rad,
            first_unknown: &layout.first,
            camera: &layout.camera,
            loosening,
        }
    }

    /// Weighs `equations`, and takes bearings from the frames `learned`, those of points that passes share too, about the
    /// positions so far, a round for each of [`LOOSENINGS`].
    fn refined(
        &self,
        layout: &Layout,
        equations: &[Equation],
        learned: &[usize],
        joined: &[PointTrack],
        mut solution: Solution,
    ) -> Option<Solution> {
        let is_used = |row: usize| layout.first[row].is_some() && learned.binary_search(&row).is_ok();
        for loosening in LOOSENINGS {
            let positions_m = self.corrected(layout, &solution.unknowns);
            let yaw_errors_rad = layout.yaw_errors_rad(&solution.unknowns);
            let frames = self.frames(layout, &positions_m, &yaw_errors_rad, loosening);
            let bearings = [&self.points, joined].map(|tracks| frames.equations(tracks, is_used));
            let mut all: Vec<Equation> = equations.iter().map(|e| e.about(&solution.unknowns)).collect();
            all.extend(bearings.into_iter().flatten());
            solution = adjust::solve_about(&solution.unknowns, &all)?;
        }
        Some(solution)
    }

    /// The recorded positions less their errors.
    fn corrected(&self, layout: &Layout, unknowns: &[f64]) -> Vec<PositionM> {
        let of_row = |(position_m, first): (&PositionM, &Option<usize>)| match *first {
            None => *position_m,
            Some(first) => [position_m[0] - unknowns[first], position_m[1] - unknowns[first + 1]],
        };
        self.positions_m.iter().zip(&layout.first).map(of_row).collect()
    }
}

/// Where the unknowns are: the tracks one after the other, east error, north error and yaw's error of each frame; the errors
/// of the courses and of the camera's azimuths last, where they make no row long but their own.
struct Layout<'a> {
    /// The recordings that are tracks.
    found: Vec<(&'a RecordingTrack, &'a Track)>,
    /// Of every row of the survey; `None` where it is of no track.
    first: Vec<Option<usize>>,
    /// Of every row, that of its track; of no use where it is of none.
    camera: Vec<usize>,
    courses: usize,
    count: usize,
}

const UNKNOWNS_A_FRAME: usize = 3;

impl<'a> Layout<'a> {
    fn new(tracks: &'a [RecordingTrack], rows: usize) -> Self {
        let found: Vec<_> = tracks.iter().filter_map(|of| Some((of, of.track.as_ref().ok()?))).collect();
        let mut first = vec![None; rows];
        let mut courses = 0;
        for row in found.iter().flat_map(|(of, _)| of.rows.clone()) {
            first[row] = Some(courses);
            courses += UNKNOWNS_A_FRAME;
        }
        let mut camera = vec![0; rows];
        for (k, (of, _)) in found.iter().enumerate() {
            camera[of.rows.clone()].fill(courses + found.len() + k);
        }
        Self { first, camera, courses, count: courses + 2 * found.len(), found }
    }

    /// Those of the track number `k`.
    fn of_track(&self, of: &RecordingTrack, k: usize) -> Unknowns {
        let first = self.first[of.rows.start].expect("a track's rows have unknowns");
        Unknowns { first, a_frame: UNKNOWNS_A_FRAME, has_yaw: true, course: self.courses + k }
    }

    fn priors(&self) -> Vec<Equation> {
        let of_track = |(of, track): &(&RecordingTrack, &Track)| {
            let std_rad = track.noise.frame_yaw_std_rad();
            let unknowns = of.rows.clone().filter_map(|row| self.first[row]);
            unknowns.map(|first| bearings::yaw_prior(first + 2, std_rad)).collect::<Vec<_>>()
        };
        let cameras = self.courses + self.found.len()..self.count;
        self.found.iter().flat_map(of_track).chain(cameras.map(bearings::camera_prior)).collect()
    }

    /// Mean deviation of the positions of `rows`, on either axis.
    fn mean_std_m(&self, solution: &Solution, rows: &[usize]) -> f64 {
        let every = rows.len().div_ceil(REPORTED_FRAMES).max(1);
        let variances_m2: Vec<f64> = (rows.iter().step_by(every))
            .filter_map(|&row| self.first[row])
            .flat_map(|first| [0, 1].map(|axis| solution.factor.inverse_diagonal(first + axis)))
            .collect();
        (variances_m2.iter().sum::<f64>() / variances_m2.len().max(1) as f64).sqrt()
    }

    /// Of every row.
    fn yaw_errors_rad(&self, unknowns: &[f64]) -> Vec<f64> {
        let of_row = |(first, &camera): (&Option<usize>, &usize)| {
            first.map_or(0.0, |first| unknowns[first + 2] + unknowns[camera])
        };
        self.first.iter().zip(&self.camera).map(of_row).collect()
    }
}

#[cfg(test)]
mod tests;
