//! Where the vehicle points: the panorama is that of a learning image nearby, turned.
//!
//! A panorama's *signature* is the first harmonics of its gradient orientations round the horizon, with their phases: a
//! turn by s columns multiplies harmonic k with exp(−2πi k s / W), so that the circular correlation of two signatures has
//! its maximum at the turn between them (Menegatti, Maeda & Ishiguro 2004, phases in place of magnitudes). A signature is
//! [`COMPASS_BYTES`] long.

use std::f64::consts::TAU;

use crate::features::{COMPASS_BYTES, COMPASS_HARMONICS};
use crate::map::Compass;
use crate::types::{EstimatedHeading, PositionM, distance_m, wrap_angle_rad};

/// So many panoramas next to the position are compared with.
const NEIGHBOURS: usize = 8;
/// Correlation is first looked at in so many directions: four a period of the highest harmonic.
const DIRECTIONS: usize = 4 * COMPASS_HARMONICS;
/// Steps of Newton's method from the best of them.
const NEWTON_STEPS: usize = 3;
/// A heading is weighted with this power of its correlation: panoramas that fit badly have no say.
const CORRELATION_POWER: i32 = 4;
/// A turn that correlates less is no turn.
const LEAST_CORRELATION: f64 = 0.05;
/// Panoramas that headings are measured on: enough for a deviation.
const MEASURED: usize = 200;
/// From a median of normal deviates to their standard deviation.
const MEDIAN_TO_STD: f64 = 1.4826;
/// No compass is better \[rad\].
const LEAST_STD_RAD: f64 = 0.25 / 180.0 * std::f64::consts::PI;

impl Compass {
    /// The heading of a panorama with this `signature` at about `position_m`. `None` where there is nothing to compare
    /// with, or nothing resembles it.
    pub fn heading(&self, signature: &[i8], position_m: PositionM) -> Option<EstimatedHeading> {
        self.heading_among(signature, position_m, |_| true)
    }

    /// The deviation of headings, measured: those of the compass's own panoramas, each from all others.
    pub fn measured_std_rad(&self) -> f64 {
        let n = self.yaws_rad.len();
        let mut errors_rad: Vec<f64> = (0..n)
            .step_by(n.div_ceil(MEASURED).max(1))
            .filter_map(|i| {
                let found = self.heading_among(self.signature(i), self.positions_m[i], |other| other != i)?;
                Some(wrap_angle_rad(found.yaw_rad - self.yaws_rad[i]).abs())
            })
            .collect();
        errors_rad.sort_unstable_by(f64::total_cmp);
        let median_rad = errors_rad.get(errors_rad.len() / 2).copied().unwrap_or(TAU);
        (MEDIAN_TO_STD * median_rad).clamp(LEAST_STD_RAD, TAU)
    }

    fn heading_among(
        &self,
        signature: &[i8],
        position_m: PositionM,
        is_allowed: impl Fn(usize) -> bool,
    ) -> Option<EstimatedHeading> {
        if signature.len() != COMPASS_BYTES {
            return None;
        }
        let mut sum = [0.0_f64; 2];
        let mut weights = 0.0;
        for i in self.nearest(position_m, is_allowed).into_iter().flatten() {
            let (turn_rad, correlation) = turn(signature, self.signature(i));
            if correlation < LEAST_CORRELATION {
                continue;
            }
            let yaw_rad = self.yaws_rad[i] - self.sense * turn_rad;
            let weight = correlation.powi(CORRELATION_POWER);
            sum = [sum[0] + weight * libm::cos(yaw_rad), sum[1] + weight * libm::sin(yaw_rad)];
            weights += weight;
        }
        if weights <= 0.0 {
            return None;
        }
        // Headings that disagree have a short mean vector: the deviation of a wrapped normal.
        let length = (libm::hypot(sum[0], sum[1]) / weights).clamp(1e-9, 1.0);
        let spread_rad = (-2.0 * libm::log(length)).sqrt();
        Some(EstimatedHeading {
            yaw_rad: wrap_angle_rad(libm::atan2(sum[1], sum[0])),
            yaw_std_rad: libm::hypot(self.std_rad, spread_rad / (NEIGHBOURS as f64).sqrt()),
        })
    }

    /// The nearest positions, in no order.
    fn nearest(&self, position_m: PositionM, is_allowed: impl Fn(usize) -> bool) -> [Option<usize>; NEIGHBOURS] {
        let mut nearest = [None; NEIGHBOURS];
        let mut distances_m = [f64::INFINITY; NEIGHBOURS];
        let mut farthest = 0;
        for (i, &other_m) in self.positions_m.iter().enumerate() {
            let distance_m = distance_m(other_m, position_m);
            if distance_m < distances_m[farthest] && is_allowed(i) {
                (nearest[farthest], distances_m[farthest]) = (Some(i), distance_m);
                farthest = (0..NEIGHBOURS).fold(0, |far, k| if distances_m[k] > distances_m[far] { k } else { far });
            }
        }
        nearest
    }
}

/// The turn s \[rad\] at which `seen` is `known` shifted by s along the columns, and the correlation there, at most 1.
fn turn(seen: &[i8], known: &[i8]) -> (f64, f64) {
    // Σ over the rows of F_k conj(G_k), for every harmonic k.
    let mut cross = [[0_i64; 2]; COMPASS_HARMONICS];
    let mut norms = [0_i64; 2];
    let rows = seen.chunks_exact(2 * COMPASS_HARMONICS).zip(known.chunks_exact(2 * COMPASS_HARMONICS));
    for (f, g) in rows {
        for (k, cross) in cross.iter_mut().enumerate() {
            let [fr, fi, gr, gi] = [f[2 * k], f[2 * k + 1], g[2 * k], g[2 * k + 1]].map(i64::from);
            cross[0] += fr * gr + fi * gi;
            cross[1] += fi * gr - fr * gi;
            norms[0] += fr * fr + fi * fi;
            norms[1] += gr * gr + gi * gi;
        }
    }
    let scale = 1.0 / ((norms[0] as f64 * norms[1] as f64).sqrt()).max(1.0);
    // c(φ) = Re Σ C_k exp(ikφ), with its first two derivatives.
    let correlation = |angle_rad: f64| {
        let mut terms = [0.0; 3];
        let (sin_once, cos_once) = libm::sincos(angle_rad);
        let (mut sin, mut cos) = (0.0, 1.0);
        for (k, cross) in cross.iter().enumerate() {
            let harmonic = (k + 1) as f64;
            // exp(ikφ) = exp(i(k − 1)φ) exp(iφ).
            (sin, cos) = (sin * cos_once + cos * sin_once, cos * cos_once - sin * sin_once);
            let [re, im] = cross.map(|value| value as f64 * scale);
            terms[0] += re * cos - im * sin;
            terms[1] -= harmonic * (re * sin + im * cos);
            terms[2] -= harmonic * harmonic * (re * cos - im * sin);
        }
        terms
    };
    let step_rad = TAU / DIRECTIONS as f64;
    let directions = (0..DIRECTIONS).map(|i| i as f64 * step_rad);
    let better = |a: (f64, f64), b: (f64, f64)| if b.1 > a.1 { b } else { a };
    let (mut angle_rad, _) =
        directions.map(|angle_rad| (angle_rad, correlation(angle_rad)[0])).fold((0.0, f64::NEG_INFINITY), better);
    for _ in 0..NEWTON_STEPS {
        let [_, slope, curvature] = correlation(angle_rad);
        if curvature < 0.0 {
            angle_rad -= (slope / curvature).clamp(-0.5 * step_rad, 0.5 * step_rad);
        }
    }
    (angle_rad, correlation(angle_rad)[0])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::features::Describer;
    use crate::golden::golden_panorama;
    use crate::panorama::{Panorama, SAMPLED_COLUMNS};

    fn signature(panorama: &Panorama) -> Vec<i8> {
        let mut describer = Describer::new();
        let mut signature = vec![0; COMPASS_BYTES];
        describer.compass(&[], panorama, &mut signature);
        signature
    }

    /// A panorama of many edges, as they are outdoors.
    fn street() -> Panorama {
        let mut panorama = golden_panorama();
        let columns = panorama.wide.len() / 128;
        for (i, value) in panorama.wide.iter_mut().enumerate() {
            let (row, column) = (i / columns, i % columns);
            let house = (column * 7 / columns * 37 + 11) % 13;
            let window = (column / 9 + row / 11) % 2;
            *value = (20 * house + 25 * window) as f32 * if row > 64 { 0.5 } else { 1.0 };
        }
        panorama
    }

    #[test]
    fn a_turn_is_found_to_a_tenth_of_a_degree() {
        let known = signature(&street());
        for columns in [0, 8, 256, 512, 1000] {
            let (turn_rad, correlation) = turn(&signature(&street().rolled(columns)), &known);
            let expected_rad = columns as f64 / SAMPLED_COLUMNS as f64 * TAU;
            let error_deg = wrap_angle_rad(turn_rad - expected_rad).to_degrees();
            assert!(error_deg.abs() < 0.1 && correlation > 0.99, "{columns}: {error_deg} deg, {correlation}");
        }
    }

    #[test]
    fn headings_come_from_the_panoramas_next_to_the_position() {
        let near = street();
        let turned = |columns: usize| signature(&near.rolled(columns));
        let quarter = SAMPLED_COLUMNS / 4;
        let far = signature(&golden_panorama());
        let mut positions_m = vec![[0.0, 0.0], [1.0, 0.0]];
        positions_m.extend([[500.0, 0.0]; 20]);
        let mut signatures = [turned(0), turned(quarter)].concat();
        (0..20).for_each(|_| signatures.extend(&far));
        // Columns run counter-clockwise: a vehicle turned left by a quarter sees everything a quarter earlier.
        let mut yaws_rad = vec![0.5, 0.5 - TAU / 4.0];
        yaws_rad.extend([1.0; 20]);
        let compass = Compass { positions_m, yaws_rad, signatures, sense: 1.0, std_rad: 0.01 };
        let found = compass.heading_among(&turned(8), [0.4, 0.0], |i| i < 2).expect("resembles both");
        let expected_rad = 0.5 - 8.0 / SAMPLED_COLUMNS as f64 * TAU;
        assert!(wrap_angle_rad(found.yaw_rad - expected_rad).abs() < 0.005, "{found:?}");
        assert!(found.yaw_std_rad < 0.03, "{found:?}");
        assert_eq!(compass.heading(&[0; 3], [0.0, 0.0]), None);
        assert_eq!(compass.heading(&vec![0; COMPASS_BYTES], [0.0, 0.0]), None);
    }

    #[test]
    fn the_deviation_is_what_the_panoramas_show() {
        let quarter = SAMPLED_COLUMNS / 4;
        let signatures: Vec<i8> = (0..4).flat_map(|i| signature(&street().rolled(i * quarter))).collect();
        let yaws_rad: Vec<f64> = [0.01, -0.01, 0.01, -0.01]
            .iter()
            .enumerate()
            .map(|(i, error_rad)| wrap_angle_rad(-(i as f64) * TAU / 4.0 + error_rad))
            .collect();
        let positions_m = (0..4).map(|i| [f64::from(i), 0.0]).collect();
        let compass = Compass { positions_m, yaws_rad, signatures, sense: 1.0, std_rad: 0.0 };
        let std_rad = compass.measured_std_rad();
        assert!((0.01..0.03).contains(&std_rad), "{std_rad}");
    }
}
