//! What points of the scene say about the errors of a track: structure from motion over its positions.
//!
//! A point that is seen from several frames pins down how these lie to each other. How large all is, and where, the points
//! do not say: the receiver does.

use std::collections::BTreeMap;

use super::adjust::{Equation, weight_of};
use super::follow::Sighting;
use crate::types::{PositionM, distance_m, wrap_angle_rad};

/// Deviation of a bearing, of what is left of a frame's yaw, and of the camera's own azimuth to the vehicle's.
const BEARING_STD_RAD: f64 = 0.0075;
const FRAME_YAW_STD_RAD: f64 = 0.014;
const CAMERA_YAW_STD_RAD: f64 = 0.1;
/// Longer tracks are cut: what is followed drifts away from the point, the further the longer.
const MOST_SIGHTINGS: usize = 10;
/// Less often seen, a point says nothing.
const FEWEST_SIGHTINGS: usize = 3;
/// The bearings of a point must differ by so much somewhere.
const LEAST_PARALLAX_RAD: f64 = 0.05;
/// Points nearer than this may be of the vehicle; those further away say too little.
const DISTANCES_M: std::ops::Range<f64> = 0.3..100.0;
/// Bearings that miss the point by more, as their root mean square, are no bearings of one point.
const MOST_MISS_STDS: f64 = 2.0;
const STEPS: usize = 5;

/// A point as some frames saw it.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct PointTrack {
    /// Row of the survey, azimuth \[rad\].
    bearings: Vec<(usize, f64)>,
    /// In which row of the panorama each saw it \[px\]; empty where it is joined of several passes.
    heights_px: Vec<f32>,
}

/// Where the unknowns of a recording's frames are, and what is known of their directions.
pub struct Frames<'a> {
    /// Of all rows: where frames are thought to be, what the receiver says, and the yaw.
    pub positions_m: &'a [PositionM],
    pub received_m: &'a [PositionM],
    pub yaw_rad: &'a [f64],
    /// What the yaw is thought to be off by, with what the camera is.
    pub yaw_error_rad: &'a [f64],
    /// East and north error of a row, and after them that of its yaw.
    pub first_unknown: &'a [Option<usize>],
    /// The azimuth of a row's camera to the yaw: it may differ from recording to recording.
    pub camera: &'a [usize],
    /// Bearings count, and are taken for those of a point, as if they erred by so many times what they do.
    pub loosening: f64,
}

impl PointTrack {
    /// The rows that see it.
    pub fn rows(&self) -> impl Iterator<Item = usize> {
        self.bearings.iter().map(|&(row, _)| row)
    }

    /// Of the sightings of rows `first`, `first` + 1, …
    pub fn gather(first: usize, sightings: &[Vec<Sighting>]) -> Vec<Self> {
        let mut of_point: BTreeMap<usize, Self> = BTreeMap::new();
        for (i, sightings) in sightings.iter().enumerate() {
            for sighting in sightings {
                let track = of_point.entry(sighting.point).or_default();
                track.bearings.push((first + i, sighting.azimuth_rad));
                track.heights_px.push(sighting.height_px);
            }
        }
        of_point.into_values().filter(|track| track.bearings.len() >= FEWEST_SIGHTINGS).collect()
    }

    /// Sightings of it, so many at most, that lie nearest to `row` in its order, of those that `is_used`.
    pub fn around(&self, row: usize, most: usize, is_used: impl Fn(usize) -> bool) -> Vec<(usize, f64)> {
        let mut used: Vec<(usize, f64)> = self.bearings.iter().copied().filter(|&(row, _)| is_used(row)).collect();
        used.sort_by_key(|&(other, _)| (other.abs_diff(row), other));
        used.truncate(most);
        used.sort_by_key(|&(row, _)| row);
        used
    }

    /// Every row that it was seen from, the azimuth and the row of the panorama.
    pub fn sightings(&self) -> impl Iterator<Item = (usize, f64, f32)> + '_ {
        let sightings = self.bearings.iter().zip(&self.heights_px);
        sightings.map(|(&(row, azimuth_rad), &height_px)| (row, azimuth_rad, height_px))
    }

    /// Of what several passes saw.
    pub fn joined(bearings: Vec<(usize, f64)>) -> Self {
        Self { bearings, heights_px: Vec::new() }
    }

    /// The parts of it that `is_used` leaves.
    fn parts(&self, is_used: impl Fn(usize) -> bool) -> Vec<Vec<(usize, f64)>> {
        let used: Vec<(usize, f64)> = self.bearings.iter().copied().filter(|&(row, _)| is_used(row)).collect();
        let parts = used.chunks(MOST_SIGHTINGS).filter(|part| part.len() >= FEWEST_SIGHTINGS);
        parts.map(<[_]>::to_vec).collect()
    }
}

/// What is known beforehand of the error of a frame's yaw, which may be worse than usual, and of the camera's azimuth.
pub fn yaw_prior(unknown: usize, std_rad: f64) -> Equation {
    prior(unknown, std_rad.max(FRAME_YAW_STD_RAD))
}

pub fn camera_prior(unknown: usize) -> Equation {
    prior(unknown, CAMERA_YAW_STD_RAD)
}

fn prior(unknown: usize, std_rad: f64) -> Equation {
    Equation { terms: vec![(unknown, 1.0)], right: 0.0, variance: std_rad.powi(2), has_outliers: false, length: None }
}

impl Frames<'_> {
    /// The bearings of all `tracks` from the rows `is_used`.
    pub fn equations(&self, tracks: &[PointTrack], is_used: impl Fn(usize) -> bool) -> Vec<Equation> {
        let parts = tracks.iter().flat_map(|track| track.parts(&is_used));
        parts.filter_map(|part| self.equations_of(&part)).flatten().collect()
    }

    /// How many of the parts of all `tracks` that `is_used` leaves meet somewhere, of those that could: while a vehicle stands,
    /// none does.
    pub fn meetings(&self, tracks: &[PointTrack], is_used: impl Fn(usize) -> bool) -> Meetings {
        let mut found = Meetings::default();
        for part in tracks.iter().flat_map(|track| track.parts(&is_used)) {
            if !self.has_parallax(&part) {
                continue;
            }
            found.parts += 1;
            if self.triangulated(&part).is_some() {
                found.met += 1;
                found.sightings += part.len();
            }
        }
        found
    }

    /// Bearing β_i of frame i, at distance d_i and direction u_i ⟂ n_i from the point, all about where they are thought to
    /// be:
    ///
    /// ```text
    /// n_i·(δL + b_i − b_i°) / d_i + ε_i + κ = β_i − atan2(L − p_i)
    /// ```
    ///
    /// with the errors b of the positions, ε of the yaw, κ of the recording's camera. Multiplied by an orthogonal matrix that
    /// makes the first two of them the only ones with the point's own δL, which are left out (Mourikis & Roumeliotis 2007,
    /// section III-D).
    fn equations_of(&self, bearings: &[(usize, f64)]) -> Option<Vec<Equation>> {
        let Triangulated { point_m, misses, weights } = self.triangulated(bearings)?;
        let m = bearings.len();
        // One a recording.
        let mut cameras: Vec<usize> = bearings.iter().map(|&(row, _)| self.camera[row]).collect();
        cameras.sort_unstable();
        cameras.dedup();
        let right = 3 * m + cameras.len();
        // Columns of δL, and of everything else: a row an equation.
        let mut of_point = vec![[0.0; 2]; m];
        let mut terms: Vec<Vec<f64>> = vec![vec![0.0; right + 1]; m];
        for (i, &(row, _)) in bearings.iter().enumerate() {
            let p = self.positions_m[row];
            let d = distance_m(p, point_m);
            let n = [-(point_m[1] - p[1]) / (d * d), (point_m[0] - p[0]) / (d * d)];
            of_point[i] = n;
            terms[i][3 * i..3 * i + 3].copy_from_slice(&[n[0], n[1], 1.0]);
            terms[i][3 * m + cameras.partition_point(|&camera| camera < self.camera[row])] = 1.0;
            let error = [0, 1].map(|axis| self.received_m[row][axis] - p[axis]);
            terms[i][right] = misses[i] + self.yaw_error_rad[row] + n[0] * error[0] + n[1] * error[1];
            let weight = weights[i].sqrt();
            of_point[i].iter_mut().chain(&mut terms[i]).for_each(|value| *value *= weight);
        }
        for axis in 0..2 {
            reflect(&mut of_point, &mut terms, axis);
        }
        let first: Vec<usize> = bearings.iter().filter_map(|&(row, _)| self.first_unknown[row]).collect();
        let unknown = |k: usize| if k >= 3 * m { cameras[k - 3 * m] } else { first[k / 3] + k % 3 };
        let equation = |row: &Vec<f64>| Equation {
            terms: row[..right].iter().enumerate().map(|(k, &value)| (unknown(k), value)).collect(),
            right: row[right],
            variance: (self.loosening * BEARING_STD_RAD).powi(2),
            has_outliers: false,
            length: None,
        };
        Some(terms[2..].iter().map(equation).collect())
    }

    /// Where the `bearings` meet.
    pub fn place_m(&self, bearings: &[(usize, f64)]) -> Option<PositionM> {
        (bearings.len() >= FEWEST_SIGHTINGS).then(|| self.triangulated(bearings)).flatten().map(|found| found.point_m)
    }

    /// The azimuth that `row` sees a point at.
    pub fn azimuth_rad(&self, row: usize, point_m: PositionM) -> f64 {
        let p = self.positions_m[row];
        (point_m[1] - p[1]).atan2(point_m[0] - p[0]) - self.yaw_rad[row] + self.yaw_error_rad[row]
    }

    /// From east, counter-clockwise.
    fn direction_rad(&self, (row, azimuth_rad): (usize, f64)) -> f64 {
        self.yaw_rad[row] + azimuth_rad - self.yaw_error_rad[row]
    }

    fn has_parallax(&self, bearings: &[(usize, f64)]) -> bool {
        let first_rad = self.direction_rad(bearings[0]);
        bearings
            .iter()
            .any(|&bearing| wrap_angle_rad(self.direction_rad(bearing) - first_rad).abs() >= LEAST_PARALLAX_RAD)
    }

    /// The point that the bearings meet at; `None` where they meet at none.
    fn triangulated(&self, bearings: &[(usize, f64)]) -> Option<Triangulated> {
        if !self.has_parallax(bearings) {
            return None;
        }
        let direction = |&bearing: &(usize, f64)| self.direction_rad(bearing);
        let mut found =
            Triangulated { point_m: [0.0; 2], misses: vec![0.0; bearings.len()], weights: vec![1.0; bearings.len()] };
        // By distances from the lines first, then by angles.
        let mut inverse_squares = vec![1.0; bearings.len()];
        for step in 0..STEPS {
            let (mut a, mut right) = ([0.0; 3], [0.0; 2]);
            for (i, bearing) in bearings.iter().enumerate() {
                let (sin, cos) = direction(bearing).sin_cos();
                let (n, p) = ([-sin, cos], self.positions_m[bearing.0]);
                let weight = found.weights[i] * inverse_squares[i];
                let along = weight * (n[0] * p[0] + n[1] * p[1]);
                a = [a[0] + weight * n[0] * n[0], a[1] + weight * n[0] * n[1], a[2] + weight * n[1] * n[1]];
                right = [right[0] + n[0] * along, right[1] + n[1] * along];
            }
            let determinant = a[0] * a[2] - a[1] * a[1];
            if determinant <= 1e-9 * (a[0] + a[2]).powi(2) {
                return None;
            }
            let [x, y] = right;
            found.point_m = [(a[2] * x - a[1] * y) / determinant, (a[0] * y - a[1] * x) / determinant];
            for (i, bearing) in bearings.iter().enumerate() {
                let p = self.positions_m[bearing.0];
                let to = [found.point_m[0] - p[0], found.point_m[1] - p[1]];
                inverse_squares[i] = 1.0 / (to[0] * to[0] + to[1] * to[1]).max(1e-6);
                found.misses[i] = wrap_angle_rad(direction(bearing) - to[1].atan2(to[0]));
                if step > 0 {
                    found.weights[i] = weight_of(found.misses[i] / (self.loosening * BEARING_STD_RAD));
                }
            }
        }
        let is_near = |inverse_square: &f64| DISTANCES_M.contains(&inverse_square.sqrt().recip());
        let mean_square = found.misses.iter().map(|miss| miss * miss).sum::<f64>() / found.misses.len() as f64;
        let meets = mean_square.sqrt() < self.loosening * MOST_MISS_STDS * BEARING_STD_RAD.hypot(FRAME_YAW_STD_RAD);
        (meets && inverse_squares.iter().all(is_near)).then_some(found)
    }
}

/// Tracks of points, or parts of them, those whose bearings meet, and the bearings of these.
#[derive(Debug, Clone, Copy, Default)]
pub struct Meetings {
    pub parts: usize,
    pub met: usize,
    pub sightings: usize,
}

/// Where bearings meet.
struct Triangulated {
    point_m: PositionM,
    /// What each bearing misses the point by \[rad\], and what that makes it count.
    misses: Vec<f64>,
    weights: Vec<f64>,
}

/// Householder reflection that leaves column `axis` of `of_point` zero below its row `axis`, of both.
fn reflect(of_point: &mut [[f64; 2]], terms: &mut [Vec<f64>], axis: usize) {
    let norm = of_point[axis..].iter().map(|row| row[axis].powi(2)).sum::<f64>().sqrt();
    let mut v: Vec<f64> = of_point[axis..].iter().map(|row| row[axis]).collect();
    v[0] += if v[0] < 0.0 { -norm } else { norm };
    let square: f64 = v.iter().map(|v| v * v).sum();
    if square <= f64::MIN_POSITIVE {
        return;
    }
    for column in axis..2 {
        let along: f64 = v.iter().zip(&of_point[axis..]).map(|(v, row)| v * row[column]).sum();
        v.iter().zip(&mut of_point[axis..]).for_each(|(v, row)| row[column] -= 2.0 * along / square * v);
    }
    for column in 0..terms[0].len() {
        let along: f64 = v.iter().zip(&terms[axis..]).map(|(v, row)| v * row[column]).sum();
        v.iter().zip(&mut terms[axis..]).for_each(|(v, row)| row[column] -= 2.0 * along / square * v);
    }
}

#[cfg(test)]
mod tests {
    use super::super::adjust::solve;
    use super::*;
    use crate::train::perturbation::standard_normal;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    /// A quarter of a circle among houses: 30 frames, what a receiver says of them, and 60 points.
    struct Street {
        truth_m: Vec<PositionM>,
        received_m: Vec<PositionM>,
        /// As measured, and what it is off by with the camera.
        yaw_rad: Vec<f64>,
        yaw_error_rad: Vec<f64>,
        tracks: Vec<PointTrack>,
    }

    impl Street {
        /// The camera is turned by `camera_rad`, from the fifteenth frame on by as much the other way, and the yaw of every
        /// other frame off by as much.
        fn new(error_m: f64, camera_rad: f64) -> Self {
            let mut random = ChaCha8Rng::seed_from_u64(4);
            let mut normal = || f64::from(standard_normal(&mut random));
            let on_circle = |i: usize| {
                let (sin, cos) = (0.05 * i as f64).sin_cos();
                [30.0 * sin, 30.0 - 30.0 * cos]
            };
            let truth_m: Vec<PositionM> = (0..30).map(on_circle).collect();
            let mut received_m: Vec<PositionM> = truth_m.iter().map(|p| p.map(|x| x + error_m * normal())).collect();
            received_m[0] = truth_m[0];
            received_m[29] = truth_m[29];
            let error_rad = |i: usize| if i.is_multiple_of(2) { camera_rad } else { 0.0 };
            let yaw_rad: Vec<f64> = (0..30).map(|i| 0.05 * i as f64 + error_rad(i)).collect();
            let yaw_error_rad: Vec<f64> =
                (0..30).map(|i| error_rad(i) + if i < 15 { camera_rad } else { -camera_rad }).collect();
            let tracks = (0..60)
                .map(|k| {
                    let first = (7 * k) % 25;
                    let point = [truth_m[first][0] + 12.0 * normal(), truth_m[first][1] + 12.0 * normal()];
                    let bearing = |row: usize| {
                        let to = [point[0] - truth_m[row][0], point[1] - truth_m[row][1]];
                        (row, to[1].atan2(to[0]) - yaw_rad[row] + yaw_error_rad[row])
                    };
                    PointTrack::joined((first..first + 6).map(bearing).collect())
                })
                .collect();
            Self { truth_m, received_m, yaw_rad, yaw_error_rad, tracks }
        }

        fn frames<'a>(
            &'a self,
            positions_m: &'a [PositionM],
            first_unknown: &'a [Option<usize>],
            loosening: f64,
        ) -> Frames<'a> {
            Frames {
                positions_m,
                received_m: &self.received_m,
                yaw_rad: &self.yaw_rad,
                yaw_error_rad: &self.yaw_error_rad,
                first_unknown,
                camera: &CAMERAS,
                loosening,
            }
        }
    }

    /// After the unknowns of the frames.
    const CAMERAS: [usize; 30] = {
        let mut cameras = [90; 30];
        let mut row = 15;
        while row < 30 {
            cameras[row] = 91;
            row += 1;
        }
        cameras
    };

    fn first_unknown() -> Vec<Option<usize>> {
        (0..30).map(|row| Some(3 * row)).collect()
    }

    #[test]
    fn the_truth_solves_the_equations() {
        let (street, first_unknown) = (Street::new(0.3, 0.02), first_unknown());
        let equations = street.frames(&street.truth_m, &first_unknown, 1.0).equations(&street.tracks, |_| true);
        assert!(equations.len() > 100, "{}", equations.len());
        let error = |at: usize| match (at / 3, at % 3) {
            (30, camera) => [0.02, -0.02][camera],
            (row, axis @ 0..2) => street.received_m[row][axis] - street.truth_m[row][axis],
            (row, _) => {
                if row % 2 == 0 {
                    0.02
                } else {
                    0.0
                }
            }
        };
        for equation in &equations {
            let left: f64 = equation.terms.iter().map(|&(at, value)| value * error(at)).sum();
            assert!((left - equation.right).abs() < 1e-9, "{left} {}", equation.right);
        }
    }

    #[test]
    fn two_ends_and_bearings_give_the_rest() {
        let (street, first_unknown) = (Street::new(0.3, 0.0), first_unknown());
        let mut positions_m = street.received_m.clone();
        for loosening in [8.0, 4.0, 2.0, 1.0, 1.0, 1.0] {
            let frames = street.frames(&positions_m, &first_unknown, loosening);
            let mut equations: Vec<Equation> = (0..30).map(|row| yaw_prior(3 * row + 2, 0.0)).collect();
            equations.extend([90, 91].map(camera_prior));
            equations.extend((0..30).flat_map(|row| {
                let std_m = if row == 0 || row == 29 { 0.001 } else { 100.0 };
                [0, 1].map(|axis| prior(3 * row + axis, std_m))
            }));
            equations.extend(frames.equations(&street.tracks, |_| true));
            let solution = solve(92, &equations).expect("determined");
            let error = |row: usize, axis: usize| solution.unknowns[3 * row + axis];
            positions_m =
                (0..30).map(|row| [0, 1].map(|axis| street.received_m[row][axis] - error(row, axis))).collect();
        }
        let off_m = positions_m.iter().zip(&street.truth_m).map(|(&a, &b)| distance_m(a, b)).fold(0.0, f64::max);
        assert!(off_m < 0.02, "{off_m}");
    }

    #[test]
    fn what_meets_nowhere_is_left_out() {
        let (mut street, first_unknown) = (Street::new(0.0, 0.0), first_unknown());
        for track in &mut street.tracks {
            // Another point from the fourth sighting on, on the other side of the street.
            track.bearings[3..].iter_mut().for_each(|(_, azimuth_rad)| *azimuth_rad += 2.0);
        }
        let frames = street.frames(&street.truth_m, &first_unknown, 1.0);
        assert!(frames.equations(&street.tracks, |_| true).is_empty());
        let unseen = Street::new(0.0, 0.0);
        assert!(
            unseen
                .frames(&unseen.truth_m, &first_unknown, 1.0)
                .equations(&unseen.tracks, |row| row % 4 == 0)
                .is_empty()
        );
    }
}
