//! What images say about the errors of a track: a street seen twice looks the same at the same place.
//!
//! The place of a frame along another pass of the same street – another lap, the other direction, another day – is found
//! by its image. Across the street the image says little where there is only one line of images to compare with, and
//! nothing is made of it; across the street, the points that both see tie them together ([`across`](super::across)).
//!
//! Images are compared without regard to any position: in features learned from positions, images fit the positions they
//! were learned from, and every match would confirm the error it was to find.

use faer::linalg::triangular_solve::solve_lower_triangular_in_place;
use faer::{Mat, MatRef, Par, Side};

use super::adjust::{Equation, Linear};
use crate::gp::{Hyperparameters, LearningPositions, Posterior};
use crate::train::axes::{Axes, add_ridge};
use crate::types::{PositionM, distance_m};

/// Inner products of images.
#[derive(Debug, Clone)]
pub struct Similarity {
    /// n × n, of properties about their mean, in units of what perturbations change.
    products: Mat<f64>,
}

/// Added to the covariance of the changes, as a share of its mean eigenvalue.
const RIDGE: f64 = 0.05;

impl Similarity {
    /// Of images with `properties`, n × d, that perturbations change by `changes`, p × d: the Mahalanobis inner product
    /// with the covariance of the changes. `None` where nothing varies or no perturbations were made.
    pub fn learn(properties: MatRef<f64>, changes: MatRef<f64>) -> Option<Self> {
        if changes.nrows() == 0 || properties.nrows() < 2 {
            return None;
        }
        let axes = Axes::of(properties)?;
        let mut noise = axes.covariance_of(changes);
        add_ridge(&mut noise, RIDGE);
        let factor = noise.llt(Side::Lower).ok()?;
        let mut white = axes.z.transpose().to_owned();
        solve_lower_triangular_in_place(factor.L(), white.as_mut(), Par::Seq);
        Some(Self { products: white.transpose() * &white })
    }
}

/// A frame's place along another pass.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct View {
    pub frame: usize,
    /// Frames of the other pass it lies between, and how much of the second: 0..1.
    pub between: [usize; 2],
    pub share: f64,
    /// Unit vector along the other pass.
    pub along: [f64; 2],
    std_m: f64,
}

/// Where frames are and which recording they belong to: what is needed to find passes.
pub struct Passes<'a> {
    pub positions_m: &'a [PositionM],
    pub recording: &'a [usize],
    /// Frames that may be compared, in rising order.
    pub rows: &'a [usize],
    /// How far off another pass may lie, and how far along it is searched \[m\].
    pub reach_m: f64,
    /// Median distance of neighbouring frames of a recording \[m\].
    pub spacing_m: f64,
}

/// Another part of the same recording counts as another pass after so many reaches of way.
const APART_REACHES: f64 = 3.0;
/// Steps of the search, fractions of the spacing.
const STEP_SPACINGS: f64 = 0.1;
/// Length scale and noise-to-signal ratio of the Gaussian process along a pass.
const LENGTH_SPACINGS: f64 = 1.75;
const NOISE_RATIO: f64 = 0.1;
const MIN_FRAMES: usize = 4;
/// Number of independent directions that an image is worth, however many its properties vary in: they are correlated.
const WITNESSES: f64 = 30.0;
/// Deviation of a match: what the posterior says times the factor that makes it true on simulated towns, where also
/// neighbouring frames err alike; and at least this share of the spacing.
const STD_FACTOR: f64 = 2.0;
const MIN_STD_SPACINGS: f64 = 0.1;

impl Passes<'_> {
    /// Every frame with the nearest one of every other pass.
    pub fn pairs(&self) -> Vec<(usize, usize)> {
        let way_m = self.way_m();
        let of_frame =
            |&frame: &usize| self.others(frame, &way_m).into_iter().map(move |nearest| (frame, self.rows[nearest]));
        self.rows.iter().flat_map(of_frame).collect()
    }

    /// All matches of frames with other passes.
    pub fn views(&self, similarity: &Similarity) -> Vec<View> {
        let way_m = self.way_m();
        self.rows
            .iter()
            .flat_map(|&frame| {
                self.others(frame, &way_m)
                    .into_iter()
                    .filter_map(|nearest| self.view(frame, nearest, &way_m, similarity))
                    .collect::<Vec<_>>()
            })
            .collect()
    }

    /// Way driven up to each frame of `rows` \[m\]; a new recording begins infinitely far away.
    fn way_m(&self) -> Vec<f64> {
        let mut way_m = vec![0.0; self.rows.len()];
        for (k, pair) in self.rows.windows(2).enumerate() {
            let same = self.recording[pair[0]] == self.recording[pair[1]];
            way_m[k + 1] = match same {
                true => way_m[k] + distance_m(self.positions_m[pair[0]], self.positions_m[pair[1]]),
                false => way_m[k] + NEW_RECORDING_M,
            };
        }
        way_m
    }

    /// The nearest frame (as a place in `rows`) of every other pass within reach.
    fn others(&self, frame: usize, way_m: &[f64]) -> Vec<usize> {
        let here = self.rows.partition_point(|&row| row < frame);
        let to_frame_m = |k: usize| distance_m(self.positions_m[self.rows[k]], self.positions_m[frame]);
        let mut nearest: Vec<usize> = Vec::new();
        let mut last: Option<usize> = None;
        for k in 0..self.rows.len() {
            if to_frame_m(k) > self.reach_m || (way_m[k] - way_m[here]).abs() < APART_REACHES * self.reach_m {
                continue;
            }
            let goes_on = last.is_some_and(|last| way_m[k] - way_m[last] < 2.0 * self.reach_m);
            match nearest.last_mut() {
                Some(best) if goes_on => {
                    if to_frame_m(k) < to_frame_m(*best) {
                        *best = k;
                    }
                }
                _ => nearest.push(k),
            }
            last = Some(k);
        }
        nearest
    }

    /// Where along the pass around the frame at `nearest` the image of `frame` fits best: the greatest
    /// −½ k log |f − μ(s)|² over the way s, μ the Gaussian process of the pass' own images.
    fn view(&self, frame: usize, nearest: usize, way_m: &[f64], similarity: &Similarity) -> Option<View> {
        let length_m = LENGTH_SPACINGS * self.spacing_m;
        let around_m = self.reach_m + 3.0 * length_m;
        let pass: Vec<usize> = (0..self.rows.len()).filter(|&k| (way_m[k] - way_m[nearest]).abs() < around_m).collect();
        if pass.len() < MIN_FRAMES {
            return None;
        }
        let at_m: Vec<f64> = pass.iter().map(|&k| way_m[k] - way_m[nearest]).collect();
        let step_m = STEP_SPACINGS * self.spacing_m;
        let (from_m, to_m) = (at_m[0].max(-self.reach_m), at_m[pass.len() - 1].min(self.reach_m));
        let steps = ((to_m - from_m) / step_m) as usize;
        if steps < 4 {
            return None;
        }
        let places: Vec<PositionM> = (0..=steps).map(|i| [from_m + step_m * i as f64, 0.0]).collect();
        let learning = LearningPositions::new(at_m.iter().map(|&s| [s, 0.0]).collect());
        let prior = Hyperparameters { signal_std: 1.0, noise_std: NOISE_RATIO.sqrt(), length_scale_m: [length_m; 2] };
        // With the identity as observations, the means are the weights of the images.
        let identity = Mat::<f64>::identity(pass.len(), pass.len());
        let weights = Posterior::new(&learning, identity.as_ref(), prior).ok()?.predict(&places).mean;

        let product = |a: usize, b: usize| similarity.products[(a, b)];
        let among = Mat::from_fn(pass.len(), pass.len(), |a, b| product(self.rows[pass[a]], self.rows[pass[b]]));
        let to_frame: Vec<f64> = pass.iter().map(|&k| product(self.rows[k], frame)).collect();
        let mixed = &weights * &among;
        let squared = |i: usize| {
            let of_pass = (0..pass.len()).map(|a| weights[(i, a)] * (mixed[(i, a)] - 2.0 * to_frame[a])).sum::<f64>();
            (of_pass + product(frame, frame)).max(f64::MIN_POSITIVE)
        };
        let log_likelihood: Vec<f64> = (0..=steps).map(|i| -0.5 * WITNESSES * squared(i).ln()).collect();
        let best = (0..=steps).max_by(|&a, &b| log_likelihood[a].total_cmp(&log_likelihood[b]))?;
        // A summit at the edge is none.
        if best == 0 || best == steps {
            return None;
        }
        let [left, top, right] = [best - 1, best, best + 1].map(|i| log_likelihood[i]);
        let curvature = left - 2.0 * top + right;
        let shift = if curvature < 0.0 { (0.5 * (left - right) / curvature).clamp(-0.5, 0.5) } else { 0.0 };
        let place_m = places[best][0] + step_m * shift;

        let mass: Vec<f64> = log_likelihood.iter().map(|value| (value - top).exp()).collect();
        let total: f64 = mass.iter().sum();
        let mean_m = mass.iter().zip(&places).map(|(mass, place)| mass * place[0]).sum::<f64>() / total;
        let variance_m2 =
            mass.iter().zip(&places).map(|(mass, place)| mass * (place[0] - mean_m).powi(2)).sum::<f64>() / total;

        let after = at_m.partition_point(|&s| s < place_m).clamp(1, pass.len() - 1);
        let between = [self.rows[pass[after - 1]], self.rows[pass[after]]];
        let apart_m = at_m[after] - at_m[after - 1];
        let way = [0, 1].map(|axis| self.positions_m[between[1]][axis] - self.positions_m[between[0]][axis]);
        // The vehicle stands: it has no direction.
        if apart_m < MIN_STEP_SPACINGS * self.spacing_m {
            return None;
        }
        Some(View {
            frame,
            between,
            share: (place_m - at_m[after - 1]) / apart_m,
            along: way.map(|component| component / apart_m),
            std_m: (STD_FACTOR * variance_m2.sqrt()).hypot(MIN_STD_SPACINGS * self.spacing_m),
        })
    }
}

/// Way between recordings \[m\]: more than any reach.
const NEW_RECORDING_M: f64 = 1e9;
/// Frames closer than this do not say where the vehicle was headed.
const MIN_STEP_SPACINGS: f64 = 0.2;

impl View {
    /// a·(p_frame − p_between) = 0 along the pass, in terms of the errors b = z − p; frame i has the unknowns
    /// `first_unknown[i]` and the one after it. Off by a share of what the two frames are apart.
    pub fn equation(&self, positions_m: &[PositionM], first_unknown: &[Option<usize>]) -> Equation {
        // Σ factor · a·p
        let along = |frames: &[(usize, f64)]| {
            let mut sum = Linear { terms: Vec::with_capacity(2 * frames.len()), constant: 0.0 };
            for &(frame, factor) in frames {
                for (axis, (along, received_m)) in self.along.iter().zip(positions_m[frame]).enumerate() {
                    sum.terms.extend(first_unknown[frame].map(|first| (first + axis, -factor * along)));
                    sum.constant += factor * along * received_m;
                }
            }
            sum
        };
        let [before, after] = self.between;
        let missed = along(&[(self.frame, 1.0), (before, self.share - 1.0), (after, -self.share)]);
        Equation::share_of(along(&[(before, -1.0), (after, 1.0)]), missed, self.std_m.powi(2))
    }
}
