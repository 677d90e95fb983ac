//! What a receiver and a vehicle say about the errors of a track: equations, and how large their errors are.
//!
//! The position of frame i is p_i = z_i − b_i: what the receiver says minus its error b_i, the unknown. The error of a
//! receiver changes slowly; a vehicle moves where it is headed and changes its speed slowly. Neither alone tells error
//! from motion; together they do, the better the straighter the error is compared with the way.

use super::adjust::{Equation, Linear, solve, solve_weighted};
use crate::map::NotATrack;
use crate::types::{PositionM, wrap_angle_rad};

/// One frame of a track.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrackPoint {
    pub position_m: PositionM,
    pub yaw_rad: Option<f64>,
    /// Since any instant, the same for all frames of a recording.
    pub time_s: Option<f64>,
}

/// A recording that is known to be a track.
#[derive(Debug, Clone)]
pub struct Track {
    pub positions_m: Vec<PositionM>,
    /// Direction of travel, from east, counter-clockwise: yaw plus what it is off by.
    pub course_rad: Vec<f64>,
    pub time_s: Vec<f64>,
    pub noise: TrackNoise,
}

/// Where the unknowns of a track are: `first` + `a_frame` i is the east error of frame i, the one after it the north
/// error, and `course` that of the course.
#[derive(Debug, Clone, Copy)]
pub struct Unknowns {
    pub first: usize,
    pub a_frame: usize,
    /// Whether a frame's third unknown is the error of its yaw.
    pub has_yaw: bool,
    pub course: usize,
}

impl Unknowns {
    fn error(&self, frame: usize, axis: usize) -> usize {
        self.first + self.a_frame * frame + axis
    }

    fn yaw(&self, frame: usize) -> Option<usize> {
        self.has_yaw.then(|| self.error(frame, 2))
    }
}

/// How wrong receiver and motion model are.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrackNoise {
    /// The receiver's error, on either axis: a first-order Gauss-Markov process of this deviation and correlation time.
    pub receiver_std_m: f64,
    pub receiver_time_s: f64,
    /// Change of speed in a second, one standard deviation; grows with the root of the time.
    pub speed_change_std_mps: f64,
    /// Error of the yaw of a step.
    pub yaw_std_rad: f64,
}

/// Fewer frames than this show nothing of a receiver.
const MIN_FRAMES: usize = 30;
/// Mean resultant length of the direction of motion about the yaw, weighted by the way: 1 where the vehicle always moves
/// along one direction of its own, 0 at random headings. Drives measure 0.97 and more, lattices of photographs below 0.5.
const MIN_ALONG_YAW: f64 = 0.8;
/// Frames further apart than this \[s\] say nothing about the motion between them.
const MAX_STEP_S: f64 = 30.0;
/// Frames at one instant are taken to be this far apart \[s\].
const MIN_STEP_S: f64 = 1e-3;
/// The yaw may be off by a constant; what is left after the mean direction was taken off \[rad\].
const YAW_OFFSET_STD_RAD: f64 = 0.03;
/// Sideways slip of a step that has no length, and per length and turn: the chord of a turn that is no circle.
const SLIP_STD_M: f64 = 0.02;
const SLIP_PER_TURN: f64 = 0.1;

impl Track {
    /// # Errors
    /// Why the frames are not one.
    pub fn recognise(points: &[TrackPoint]) -> Result<Self, NotATrack> {
        let time_s: Option<Vec<f64>> = points.iter().map(|point| point.time_s).collect();
        let yaw_rad: Option<Vec<f64>> = points.iter().map(|point| point.yaw_rad).collect();
        let time_s = time_s.ok_or(NotATrack::NoTime)?;
        let yaw_rad = yaw_rad.ok_or(NotATrack::NoYaw)?;
        if points.len() < MIN_FRAMES {
            return Err(NotATrack::TooFewFrames);
        }
        let positions_m: Vec<PositionM> = points.iter().map(|point| point.position_m).collect();
        let (mut sum, mut length_m) = ([0.0; 2], 0.0);
        for (pair, yaw) in positions_m.windows(2).zip(yaw_rad.windows(2)) {
            let way = step(pair[0], pair[1]);
            let along = rotated(way, -mean_direction_rad(yaw[0], yaw[1]));
            (sum[0], sum[1]) = (sum[0] + along[0], sum[1] + along[1]);
            length_m += way[0].hypot(way[1]);
        }
        if sum[0].hypot(sum[1]) < MIN_ALONG_YAW * length_m || length_m <= 0.0 {
            return Err(NotATrack::NotAlongYaw);
        }
        let offset_rad = sum[1].atan2(sum[0]);
        let course_rad = yaw_rad.iter().map(|yaw| wrap_angle_rad(yaw + offset_rad)).collect();
        let mut track = Self { positions_m, course_rad, time_s, noise: START };
        track.noise = track.most_likely_noise().ok_or(NotATrack::Undetermined)?;
        Ok(track)
    }

    /// What receiver and vehicle say.
    fn equations(&self, unknowns: Unknowns) -> Vec<Equation> {
        [self.receiver_equations(unknowns), self.vehicle_equations(unknowns, 1.0)].concat()
    }

    /// The receiver's error changes slowly about zero:
    ///
    /// ```text
    /// b_0 = 0 ± σ                 b_(i+1) − φ b_i = 0 ± σ √(1 − φ²)          φ = exp(−Δt / τ)
    /// ```
    pub fn receiver_equations(&self, unknowns: Unknowns) -> Vec<Equation> {
        let variance = self.noise.receiver_std_m.powi(2);
        let b = |frame: usize, axis: usize| unknowns.error(frame, axis);
        let mut equations: Vec<Equation> = [0, 1].map(|axis| prior(b(0, axis), variance)).into();
        for i in 0..self.positions_m.len() - 1 {
            let kept = (-self.step_s(i) / self.noise.receiver_time_s).exp();
            equations.extend([0, 1].map(|axis| Equation {
                terms: vec![(b(i + 1, axis), 1.0), (b(i, axis), -kept)],
                right: 0.0,
                variance: variance * (1.0 - kept * kept),
                has_outliers: true,
                length: None,
            }));
        }
        equations
    }

    /// The vehicle moves where it is headed, and changes its speed slowly:
    ///
    /// ```text
    /// n·(b_(i+1) − b_i) + d (δ − ε_i/2 − ε_(i+1)/2) = n·(z_(i+1) − z_i) ± σ_slip     n ⟂ u, the mean course of the step
    /// u·Δp / Δt − u'·Δp' / Δt' = 0 ± σ_a √Δt                                         of one step and the one before
    /// δ = 0 ± 0.03 rad
    /// ```
    ///
    /// with the length d = u·Δp of the step and, where they are unknowns, the errors ε of the yaws. The speed is off by
    /// `speed_stds` times what it is of a track by itself.
    pub fn vehicle_equations(&self, unknowns: Unknowns, speed_stds: f64) -> Vec<Equation> {
        let (z, noise, course) = (&self.positions_m, &self.noise, unknowns.course);
        // `by` times what b changes in a `direction` from frame `i` to the next.
        let change = |i: usize, direction: [f64; 2], by: f64| {
            let of_axis = |axis: usize| {
                let coefficient = by * direction[axis];
                [(unknowns.error(i + 1, axis), coefficient), (unknowns.error(i, axis), -coefficient)]
            };
            [of_axis(0), of_axis(1)].concat()
        };
        let mut equations = vec![prior(course, YAW_OFFSET_STD_RAD.powi(2))];
        // Of the step before: direction, length, duration.
        let mut before: Option<([f64; 2], f64, f64)> = None;
        for i in 0..z.len() - 1 {
            let step_s = self.step_s(i);
            if step_s > MAX_STEP_S {
                before = None;
                continue;
            }
            let way = step(z[i], z[i + 1]);
            let (sin, cos) = mean_direction_rad(self.course_rad[i], self.course_rad[i + 1]).sin_cos();
            let (u, n) = ([cos, sin], [-sin, cos]);
            let along_m = dot(u, way);
            let turn_rad = wrap_angle_rad(self.course_rad[i + 1] - self.course_rad[i]).abs();
            let mut slip = change(i, n, 1.0);
            slip.push((course, along_m));
            let mut variance = SLIP_STD_M.powi(2) + (SLIP_PER_TURN * along_m * turn_rad).powi(2);
            match unknowns.yaw(i).zip(unknowns.yaw(i + 1)) {
                Some((here, there)) => slip.extend([here, there].map(|yaw| (yaw, -0.5 * along_m))),
                None => variance += (along_m * noise.yaw_std_rad).powi(2),
            }
            let length = Linear { terms: change(i, u, -1.0), constant: along_m };
            let slipped = Linear { terms: slip, constant: -dot(n, way) };
            equations.push(Equation::share_of(length, slipped, variance));
            if let Some((u_before, before_m, before_s)) = before {
                // `by` times the speed and `by_before` times that of the step before.
                let speeds = |by: f64, by_before: f64| Linear {
                    terms: [change(i, u, -by / step_s), change(i - 1, u_before, -by_before / before_s)].concat(),
                    constant: by * along_m / step_s + by_before * before_m / before_s,
                };
                let variance = (speed_stds * noise.speed_change_std_mps).powi(2) * 0.5 * (step_s + before_s);
                equations.push(Equation::share_of(speeds(0.5, 0.5), speeds(1.0, -1.0), variance));
            }
            before = Some((u, along_m, step_s));
        }
        equations
    }

    /// From frame `i` to the next.
    fn step_s(&self, i: usize) -> f64 {
        (self.time_s[i + 1] - self.time_s[i]).max(MIN_STEP_S)
    }

    /// Nothing but this track.
    fn alone(&self) -> Unknowns {
        Unknowns { first: 0, a_frame: 2, has_yaw: false, course: 2 * self.positions_m.len() }
    }

    /// The noise that makes this track most likely, positions and course integrated out; `None` when no noise makes it
    /// likely at all.
    ///
    /// With A the equations scaled to unit variance, −2 log L = |A b − y|² + Σ log σ² + log |AᵀA| + const (restricted
    /// maximum likelihood; the positions have a flat prior). Outliers of the solution so far count with the variance that
    /// they have as such, so that one jump of the receiver does not make it a bad one.
    fn most_likely_noise(&self) -> Option<TrackNoise> {
        let mut track = self.clone();
        let alone = self.alone();
        let mut inflations = vec![1.0; track.equations(alone).len()];
        for _ in 0..OUTLIER_ROUNDS {
            track.search(&inflations)?;
            let solution = solve(alone.course + 1, &track.equations(alone))?;
            let of_outliers = |&weight: &f64| if weight < OUTLIER_WEIGHT { 1.0 / weight.max(1e-9) } else { 1.0 };
            inflations = solution.weights.iter().map(of_outliers).collect();
        }
        track.search(&inflations)?;
        Some(track.noise)
    }

    /// Compass search (Kolda, Lewis & Torczon 2003) over the logarithms of the noise.
    fn search(&mut self, inflations: &[f64]) -> Option<()> {
        let mut best = self.misfit(inflations)?;
        let mut factor = 2.0;
        while factor > SMALLEST_FACTOR {
            let mut improved = false;
            for parameter in 0..4 {
                for factor in [factor, 1.0 / factor] {
                    let mut there = self.clone();
                    let (value, range) = there.noise.parameter(parameter);
                    *value = (*value * factor).clamp(range[0], range[1]);
                    if let Some(misfit) = there.misfit(inflations)
                        && misfit < best
                    {
                        (best, self.noise, improved) = (misfit, there.noise, true);
                    }
                }
            }
            if !improved {
                factor = factor.sqrt();
            }
        }
        Some(())
    }

    /// −2 log of the likelihood and of a weak prior on the noise, but for a constant.
    fn misfit(&self, inflations: &[f64]) -> Option<f64> {
        let alone = self.alone();
        let equations = self.equations(alone);
        let weights = inflations.iter().map(|inflation| 1.0 / inflation).collect();
        let solution = solve_weighted(alone.course + 1, &equations, weights)?;
        let log_variances: f64 = equations.iter().map(|equation| equation.variance.ln()).sum();
        let (noise, usual) = (&self.noise, &START);
        let unusual = (noise.receiver_std_m / usual.receiver_std_m).ln().powi(2) / USUAL_LOG_STD_OF_STD.powi(2)
            + (noise.receiver_time_s / usual.receiver_time_s).ln().powi(2) / USUAL_LOG_STD_OF_TIME.powi(2);
        Some(solution.cost + log_variances + solution.factor.log_determinant() + unusual)
    }
}

/// Where the search begins. A drive lasts a few correlation times only, which leaves the receiver's deviation and
/// correlation time uncertain to a factor; their logarithms have a normal prior about these values.
const START: TrackNoise =
    TrackNoise { receiver_std_m: 0.6, receiver_time_s: 40.0, speed_change_std_mps: 0.5, yaw_std_rad: 0.01 };
const USUAL_LOG_STD_OF_STD: f64 = 1.5;
const USUAL_LOG_STD_OF_TIME: f64 = 0.7;
const SMALLEST_FACTOR: f64 = 1.1;
const OUTLIER_ROUNDS: usize = 2;
/// Beyond 4.6 standard deviations.
const OUTLIER_WEIGHT: f64 = 0.2;

impl TrackNoise {
    /// Error of a frame's yaw, if that of a step is the mean of two.
    pub fn frame_yaw_std_rad(&self) -> f64 {
        std::f64::consts::SQRT_2 * self.yaw_std_rad
    }

    /// A parameter, and the range that is searched.
    fn parameter(&mut self, number: usize) -> (&mut f64, [f64; 2]) {
        match number {
            0 => (&mut self.receiver_std_m, [0.01, 30.0]),
            1 => (&mut self.receiver_time_s, [2.0, 1000.0]),
            2 => (&mut self.speed_change_std_mps, [0.02, 5.0]),
            _ => (&mut self.yaw_std_rad, [0.003, 0.1]),
        }
    }
}

fn prior(at: usize, variance: f64) -> Equation {
    Equation { terms: vec![(at, 1.0)], right: 0.0, variance, has_outliers: false, length: None }
}

fn step(from: PositionM, to: PositionM) -> [f64; 2] {
    [to[0] - from[0], to[1] - from[1]]
}

fn dot(a: [f64; 2], b: [f64; 2]) -> f64 {
    a[0] * b[0] + a[1] * b[1]
}

fn rotated([x, y]: [f64; 2], by_rad: f64) -> [f64; 2] {
    let (sin, cos) = by_rad.sin_cos();
    [cos * x - sin * y, sin * x + cos * y]
}

/// Halfway from one direction to the other, the shorter way round.
pub fn mean_direction_rad(from_rad: f64, to_rad: f64) -> f64 {
    from_rad + 0.5 * wrap_angle_rad(to_rad - from_rad)
}
