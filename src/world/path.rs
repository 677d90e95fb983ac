//! Closed paths over the plane: lanes with rounded corners.

use std::f64::consts::TAU;

use crate::types::{PositionM, distance_m, wrap_angle_rad};

/// A corner of a path, and the radius it is taken with.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Corner {
    pub at_m: PositionM,
    pub radius_m: f64,
}

/// What a path does at one place.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct PathPoint {
    pub position_m: PositionM,
    /// Direction of travel.
    pub yaw_rad: f64,
    /// Change of the yaw along the way \[rad/m\].
    pub curvature_per_m: f64,
}

/// A closed path, sampled evenly.
#[derive(Debug, Clone)]
pub(super) struct Path {
    spacing_m: f64,
    /// The last point is the first again; yaw runs on beyond π.
    points: Vec<PathPoint>,
}

/// How a path is drawn through its corners.
#[derive(Debug, Clone, Copy)]
pub(super) struct Smoothing {
    /// Distance of neighbouring points.
    pub spacing_m: f64,
    /// Positions are averaged over this much of the path before and behind, twice, so that the curvature is continuous.
    pub reach_m: f64,
    /// How far a driver strays to either side.
    pub wander_m: f64,
    /// Length of the longer of the two waves in which he does it.
    pub wander_length_m: f64,
    /// Where in these waves the path begins \[rad\].
    pub wander_phase_rad: f64,
}

impl Path {
    /// The closed path through `corners`; a corner that has no room for its radius is taken with a smaller one.
    pub fn closed(corners: &[Corner], smoothing: Smoothing) -> Self {
        let outline = rounded(corners, smoothing.spacing_m);
        let mut positions = resampled(&outline, smoothing.spacing_m);
        let reach = (smoothing.reach_m / smoothing.spacing_m).round() as usize;
        for _ in 0..2 {
            positions = averaged(&positions, reach);
        }
        if smoothing.wander_m > 0.0 {
            positions = strayed(&positions, smoothing);
        }
        Self::through(resampled(&positions, smoothing.spacing_m))
    }

    /// `positions` are evenly spaced, first and last differ.
    fn through(positions: Vec<PositionM>) -> Self {
        let n = positions.len();
        let length_m: f64 = (0..n).map(|i| distance_m(positions[i], positions[(i + 1) % n])).sum();
        let spacing_m = length_m / n as f64;
        let directions: Vec<f64> = (0..n)
            .map(|i| {
                let (before, after) = (positions[(i + n - 1) % n], positions[(i + 1) % n]);
                (after[1] - before[1]).atan2(after[0] - before[0])
            })
            .collect();
        let turn = |i: usize| wrap_angle_rad(directions[(i + 1) % n] - directions[i % n]);
        let mut yaw_rad = directions[0];
        let points = (0..=n)
            .map(|i| {
                let curvature_per_m = 0.5 * (turn(i + n - 1) + turn(i)) / spacing_m;
                let point = PathPoint { position_m: positions[i % n], yaw_rad, curvature_per_m };
                yaw_rad += turn(i);
                point
            })
            .collect();
        Self { spacing_m, points }
    }

    pub fn length_m(&self) -> f64 {
        self.spacing_m * (self.points.len() - 1) as f64
    }

    /// The point `distance_m` from the start; the path is run through again and again.
    pub fn at(&self, distance_m: f64) -> PathPoint {
        let steps = (distance_m / self.spacing_m).rem_euclid((self.points.len() - 1) as f64);
        let i = (steps as usize).min(self.points.len() - 2);
        let (a, b, t) = (&self.points[i], &self.points[i + 1], steps - i as f64);
        let between = |a: f64, b: f64| a + t * (b - a);
        PathPoint {
            position_m: [0, 1].map(|axis| between(a.position_m[axis], b.position_m[axis])),
            yaw_rad: wrap_angle_rad(between(a.yaw_rad, b.yaw_rad)),
            curvature_per_m: between(a.curvature_per_m, b.curvature_per_m),
        }
    }
}

/// Straight lines and arcs through `corners`, as a dense polygon.
fn rounded(corners: &[Corner], spacing_m: f64) -> Vec<PositionM> {
    let n = corners.len();
    let mut outline = Vec::new();
    for i in 0..n {
        let Corner { at_m, radius_m } = corners[i];
        let (before, after) = (corners[(i + n - 1) % n].at_m, corners[(i + 1) % n].at_m);
        let (reach_in, reach_out) = (distance_m(before, at_m), distance_m(at_m, after));
        let inwards = [(at_m[0] - before[0]) / reach_in, (at_m[1] - before[1]) / reach_in];
        let outwards = [(after[0] - at_m[0]) / reach_out, (after[1] - at_m[1]) / reach_out];
        let turn_rad = (inwards[0] * outwards[1] - inwards[1] * outwards[0])
            .atan2(inwards[0] * outwards[0] + inwards[1] * outwards[1]);
        let half_tangent = (0.5 * turn_rad.abs()).tan();
        if half_tangent < 1e-9 {
            outline.push(at_m);
            continue;
        }
        let tangent_m = (radius_m * half_tangent).min(0.5 * reach_in.min(reach_out));
        let radius_m = tangent_m / half_tangent;
        let side = turn_rad.signum();
        let start = [at_m[0] - tangent_m * inwards[0], at_m[1] - tangent_m * inwards[1]];
        let center = [start[0] - side * radius_m * inwards[1], start[1] + side * radius_m * inwards[0]];
        let first_rad = (start[1] - center[1]).atan2(start[0] - center[0]);
        let steps = (radius_m * turn_rad.abs() / spacing_m).ceil().max(1.0);
        outline.extend((0..=steps as usize).map(|step| {
            let angle_rad = first_rad + turn_rad * step as f64 / steps;
            [center[0] + radius_m * angle_rad.cos(), center[1] + radius_m * angle_rad.sin()]
        }));
    }
    outline
}

/// Points every `spacing_m` or a little less along the closed polygon `outline`.
fn resampled(outline: &[PositionM], spacing_m: f64) -> Vec<PositionM> {
    let n = outline.len();
    let mut ends_m = Vec::with_capacity(n);
    let mut length_m = 0.0;
    for i in 0..n {
        length_m += distance_m(outline[i], outline[(i + 1) % n]);
        ends_m.push(length_m);
    }
    let count = (length_m / spacing_m).ceil();
    (0..count as usize)
        .map(|step| {
            let at_m = length_m * step as f64 / count;
            let i = ends_m.partition_point(|&end_m| end_m <= at_m).min(n - 1);
            let (a, b) = (outline[i], outline[(i + 1) % n]);
            let edge_m = distance_m(a, b);
            let t = if edge_m > 0.0 { 1.0 - (ends_m[i] - at_m) / edge_m } else { 0.0 };
            [a[0] + t * (b[0] - a[0]), a[1] + t * (b[1] - a[1])]
        })
        .collect()
}

/// Every position as the mean of itself and `reach` neighbours on either side.
fn averaged(positions: &[PositionM], reach: usize) -> Vec<PositionM> {
    let (n, width) = (positions.len(), (2 * reach + 1) as f64);
    let mut sum = [0.0; 2];
    let mut add = |index: usize, sign: f64| {
        sum[0] += sign * positions[index % n][0];
        sum[1] += sign * positions[index % n][1];
        sum
    };
    (n - reach..n + reach).for_each(|index| {
        add(index, 1.0);
    });
    (n..2 * n)
        .map(|i| {
            let [x, y] = add(i + reach, 1.0);
            add(i - reach, -1.0);
            [x / width, y / width]
        })
        .collect()
}

/// Two waves to the side; whole numbers of them fit, so that the path stays closed.
fn strayed(positions: &[PositionM], smoothing: Smoothing) -> Vec<PositionM> {
    let n = positions.len();
    let length_m = n as f64 * smoothing.spacing_m;
    let waves = (length_m / smoothing.wander_length_m).round().max(1.0);
    (0..n)
        .map(|i| {
            let (before, after) = (positions[(i + n - 1) % n], positions[(i + 1) % n]);
            let step_m = distance_m(before, after).max(1e-9);
            let angle_rad = TAU * waves * i as f64 / n as f64 + smoothing.wander_phase_rad;
            let second_rad = TAU * (1.7 * waves).round() * i as f64 / n as f64 + 2.0 * smoothing.wander_phase_rad;
            let aside_m = smoothing.wander_m * (0.6 * angle_rad.sin() + 0.4 * second_rad.sin());
            [
                positions[i][0] - aside_m * (after[1] - before[1]) / step_m,
                positions[i][1] + aside_m * (after[0] - before[0]) / step_m,
            ]
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn square() -> Path {
        let corners = [[0.0, 0.0], [40.0, 0.0], [40.0, 40.0], [0.0, 40.0]].map(|at_m| Corner { at_m, radius_m: 8.0 });
        let smoothing =
            Smoothing { spacing_m: 0.1, reach_m: 1.0, wander_m: 0.0, wander_length_m: 40.0, wander_phase_rad: 0.0 };
        Path::closed(&corners, smoothing)
    }

    #[test]
    fn a_rounded_square_has_its_length_and_its_curvature() {
        let path = square();
        let expected_m = 4.0 * (40.0 - 16.0) + TAU * 8.0;
        assert!((path.length_m() - expected_m).abs() < 0.5, "{} instead of {expected_m}", path.length_m());
        let sharpest = (0..1500).map(|i| path.at(0.1 * f64::from(i)).curvature_per_m).fold(0.0, f64::max);
        assert!((sharpest - 1.0 / 8.0).abs() < 0.01, "{sharpest}");
    }

    #[test]
    fn the_path_closes_smoothly() {
        let path = square();
        for step in 0..3000 {
            let (a, b) = (path.at(0.05 * f64::from(step)), path.at(0.05 * f64::from(step + 1)));
            assert!(distance_m(a.position_m, b.position_m) < 0.06, "{a:?} {b:?}");
            assert!(wrap_angle_rad(b.yaw_rad - a.yaw_rad).abs() < 0.02, "{a:?} {b:?}");
        }
        assert_eq!(path.at(0.0).position_m, path.at(path.length_m()).position_m);
    }

    #[test]
    fn yaw_is_the_direction_of_travel() {
        let path = square();
        for step in 0..140 {
            let (a, b) = (path.at(f64::from(step)), path.at(f64::from(step) + 0.01));
            let direction_rad = (b.position_m[1] - a.position_m[1]).atan2(b.position_m[0] - a.position_m[0]);
            assert!(wrap_angle_rad(direction_rad - a.yaw_rad).abs() < 0.02, "{direction_rad} {a:?}");
        }
    }
}
