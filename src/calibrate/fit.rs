//! Sub-pixel rims: where each ray from the centre crosses them, and the concentric circles through these points.

use std::f64::consts::TAU;

use libm::hypot;
use nalgebra::{Matrix3, Matrix4, Vector3, Vector4};

use super::evidence::Maps;
use super::search::Circles;

/// Rays from the centre; on an outer rim of 335 px they are 6 px apart.
const RAYS: usize = 360;
/// Spacing of the samples along a ray \[px\].
const SAMPLE_PX: f64 = 0.5;
/// The gradient at a sample is taken between the samples this many before and after: over 2 px, about the width of a
/// sharp rim.
const GRADIENT_SAMPLES: usize = 2;
/// Samples between the edge in both maps and the edge in the mean: 1.5 px.
const NEAR_SAMPLES: usize = 3;
/// An edge weaker than this is no edge, whatever the noise \[grey levels a px\]: JPEG's own artefacts.
const MIN_GRADIENT: f32 = 0.75;
/// Edges are searched within this many standard deviations of their Gaussian prior about the present circle.
const PRIOR_DEVIATIONS: f64 = 2.0;
/// The last searches, when the circle is known to a fraction of a pixel. Four times the tolerance, so that unrelated
/// edges agree with the circle in at most about a quarter of the directions.
const LAST_WINDOW_TOLERANCES: f64 = 4.0;
/// Searches for edges; the window shrinks geometrically from the first to the last but one.
const ROUNDS: usize = 7;
/// What pixel grid, JPEG and the rim's own width leave uncertain however many rays agree \[px\].
const SYSTEMATIC_PX: f64 = 0.1;
/// Turning point of Tukey's biweight in robust standard deviations (Huber & Ronchetti 2009: 95 % efficiency).
const TUKEY: f64 = 4.685;
/// Below this the robust deviation of the residuals is not believed \[px\].
const MIN_DEVIATION_PX: f64 = 0.15;

/// How far from its circle a rim point may be and still support it \[px\]: half a percent of the radius, at least 1 px.
pub(super) fn tolerance_px(radius_px: f64) -> f64 {
    (0.005 * radius_px).max(1.0)
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Rim {
    Inner,
    Outer,
}

/// One crossing of a ray with a rim.
#[derive(Debug, Clone, Copy)]
struct RimPoint {
    ray: usize,
    rim: Rim,
    at_px: [f64; 2],
}

/// The fitted circles and what supports them.
#[derive(Debug, Clone)]
pub(super) struct Fit {
    pub circles: Circles,
    /// Standard deviations of centre x, centre y, inner and outer radius \[px\].
    pub deviations_px: [f64; 4],
    pub inner: RimSupport,
    pub outer: RimSupport,
    /// Distance between the centres of the two circles when each is fitted alone \[px\].
    pub center_disagreement_px: f64,
}

#[derive(Debug, Clone, Copy)]
pub(super) struct RimSupport {
    /// Share of the circumference inside the image.
    pub visible: f64,
    /// Share of the visible directions with an edge within the tolerance of the circle.
    pub supported: f64,
}

/// Fits the circles to the rims, starting no more than `start_error_px` from them. `None` when too few edges are found.
pub(super) fn fit(maps: &Maps, mean_weight: f32, start: Circles, start_error_px: f64) -> Option<Fit> {
    // Four times the noise of a gradient over 2 px from profiles averaged over three pixels: σ √2 / (2 √3) each.
    let threshold = (4.0 * 0.41 * mean_weight * maps.noise()).max(MIN_GRADIENT * mean_weight.max(0.5));
    let finder = EdgeFinder { maps, mean_weight, threshold };
    let mut circles = start;
    let last_window = LAST_WINDOW_TOLERANCES * tolerance_px(start.outer_radius_px);
    let first_window = (2.0 * start_error_px).max(last_window);
    let mut found = finder.rim_points(&circles, first_window);
    for round in 1..ROUNDS {
        circles = robust_fit(&found, circles)?.circles;
        let progress = (round as f64 / (ROUNDS - 2) as f64).min(1.0);
        found = finder.rim_points(&circles, first_window * libm::pow(last_window / first_window, progress));
    }
    let solution = robust_fit(&found, circles)?;
    let circles = solution.circles;
    let support = |rim, radius_px| {
        let supported = found
            .points
            .iter()
            .filter(|point| point.rim == rim && residual_px(point, &circles).abs() <= tolerance_px(radius_px))
            .count() as f64;
        let visible = found.visible[rim as usize] as f64;
        RimSupport { visible: visible / RAYS as f64, supported: supported / visible.max(1.0) }
    };
    Some(Fit {
        inner: support(Rim::Inner, circles.inner_radius_px),
        outer: support(Rim::Outer, circles.outer_radius_px),
        deviations_px: solution.deviations_px,
        center_disagreement_px: center_disagreement_px(&found.points, &circles)?,
        circles,
    })
}

struct RimPoints {
    points: Vec<RimPoint>,
    /// Rays along which the whole window lies in the image: inner, outer.
    visible: [usize; 2],
}

struct EdgeFinder<'a> {
    maps: &'a Maps,
    mean_weight: f32,
    threshold: f32,
}

impl EdgeFinder<'_> {
    fn rim_points(&self, circles: &Circles, window_px: f64) -> RimPoints {
        let mut found = RimPoints { points: Vec::new(), visible: [0; 2] };
        let gap_px = circles.outer_radius_px - circles.inner_radius_px;
        for (rim, radius_px) in [(Rim::Inner, circles.inner_radius_px), (Rim::Outer, circles.outer_radius_px)] {
            let window_px = window_px.min(0.5 * radius_px).min(0.4 * gap_px);
            for ray in 0..RAYS {
                let (sin, cos) = libm::sincos(ray as f64 / RAYS as f64 * TAU);
                let Some(profile) = self.profile(circles.center_px, [cos, sin], radius_px, window_px) else {
                    continue;
                };
                found.visible[rim as usize] += 1;
                if let Some(offset_px) = self.strongest_edge(&profile) {
                    let r = radius_px + offset_px;
                    let at_px = [circles.center_px[0] + r * cos, circles.center_px[1] + r * sin];
                    found.points.push(RimPoint { ray, rim, at_px });
                }
            }
        }
        found
    }

    /// Samples along a ray about the radius, averaged over three pixels across it. `None` where the rim lies outside
    /// the image; samples beyond the frame repeat the last one inside, so that they make no edge.
    fn profile(&self, center: [f64; 2], [ux, uy]: [f64; 2], radius_px: f64, window_px: f64) -> Option<Vec<[f32; 2]>> {
        let half = (window_px / SAMPLE_PX).ceil() as i32 + GRADIENT_SAMPLES as i32;
        let mut profile = Vec::with_capacity(2 * half as usize + 1);
        for i in -half..=half {
            let r = radius_px + f64::from(i) * SAMPLE_PX;
            let mut sum = [0.0; 2];
            let mut inside = 0.0;
            for across_px in [-1.0, 0.0, 1.0] {
                let (x, y) = (center[0] + r * ux - across_px * uy, center[1] + r * uy + across_px * ux);
                if let Some(value) = self.maps.at(x, y) {
                    sum = [sum[0] + value[0], sum[1] + value[1]];
                    inside += 1.0;
                }
            }
            // The edge's own two pixels have to be visible.
            if inside == 0.0 && f64::from(i) * SAMPLE_PX <= 2.0 {
                return None;
            }
            let last = profile.last().copied().unwrap_or_default();
            profile.push(if inside > 0.0 { sum.map(|s| s / inside) } else { last });
        }
        Some(profile)
    }

    /// Offset of the strongest edge from the middle of the profile \[px\], weighted by a Gaussian prior. `None` when
    /// nothing exceeds the threshold.
    ///
    /// The edge is found in both maps together but measured in the mean where that shows it: when the camera shakes the
    /// deviation is high on both sides of the rim, and its own edge lies on the flat side by about the shaking's
    /// standard deviation, whereas the mean is blurred evenly. Sub-pixel from the centroid of the gradient above half its
    /// peak, which also suits a defocused rim, where the gradient has a flat top.
    fn strongest_edge(&self, profile: &[[f32; 2]]) -> Option<f64> {
        let scale = 1.0 / (2.0 * GRADIENT_SAMPLES as f32 * SAMPLE_PX as f32);
        let gradients: Vec<[f32; 2]> = profile
            .windows(2 * GRADIENT_SAMPLES + 1)
            .map(|window| {
                let (first, last) = (window[0], window[2 * GRADIENT_SAMPLES]);
                [0, 1].map(|map| ((last[map] - first[map]) * scale).abs())
            })
            .collect();
        let middle = (gradients.len() / 2) as f64;
        let prior = |i: usize| libm::exp(-0.5 * ((i as f64 - middle) / middle * PRIOR_DEVIATIONS).powi(2)) as f32;
        let both = |i: usize| libm::hypotf(self.mean_weight * gradients[i][0], gradients[i][1]);
        let inside = 1..gradients.len().saturating_sub(1);
        let peak = inside
            .clone()
            .filter(|&i| both(i) > self.threshold)
            .max_by(|&a, &b| (both(a) * prior(a)).total_cmp(&(both(b) * prior(b))))?;
        let near = peak.saturating_sub(NEAR_SAMPLES).max(inside.start)..(peak + NEAR_SAMPLES + 1).min(inside.end);
        let of_mean = near.max_by(|&a, &b| gradients[a][0].total_cmp(&gradients[b][0]))?;
        let map = if gradients[of_mean][0] > gradients[peak][1] { 0 } else { 1 };
        let peak = if map == 0 { of_mean } else { peak };
        let half_height = 0.5 * gradients[peak][map];
        let above = |&i: &usize| gradients[i][map] > half_height;
        let (mut moment, mut weight) = (0.0, 0.0);
        for i in (0..peak).rev().take_while(above).chain((peak..gradients.len()).take_while(above)) {
            moment += f64::from(gradients[i][map]) * i as f64;
            weight += f64::from(gradients[i][map]);
        }
        Some((moment / weight - middle) * SAMPLE_PX)
    }
}

/// Distance from the point's circle, positive outside \[px\].
fn residual_px(point: &RimPoint, circles: &Circles) -> f64 {
    let distance = hypot(point.at_px[0] - circles.center_px[0], point.at_px[1] - circles.center_px[1]);
    distance - if point.rim == Rim::Inner { circles.inner_radius_px } else { circles.outer_radius_px }
}

fn biweight(residual_px: f64, deviation_px: f64) -> f64 {
    let u = residual_px / (TUKEY * deviation_px);
    if u.abs() < 1.0 { (1.0 - u * u).powi(2) } else { 0.0 }
}

/// 1.4826 times the median magnitude: the standard deviation if the majority is Gaussian.
fn robust_deviation_px(residuals_px: &[f64]) -> f64 {
    let mut magnitudes: Vec<f64> = residuals_px.iter().map(|r| r.abs()).collect();
    let middle = magnitudes.len() / 2;
    if magnitudes.is_empty() {
        return MIN_DEVIATION_PX;
    }
    let (_, median, _) = magnitudes.select_nth_unstable_by(middle, f64::total_cmp);
    (1.4826 * *median).max(MIN_DEVIATION_PX)
}

struct Solution {
    circles: Circles,
    deviations_px: [f64; 4],
}

/// Gauss-Newton on the geometric distances with Tukey's biweight, both rims sharing the centre.
///
/// ```text
/// min over (x, y, r_in, r_out) of  Σ ρ(|pᵢ − c| − rₖ₍ᵢ₎),    row of J: (−cos φᵢ, −sin φᵢ, −[k = in], −[k = out])
/// covariance = s² (JᵀWJ)⁻¹ (1 + ρ₁)/(1 − ρ₁),    s² = Σ w e² / (Σ w − 4)
/// ```
///
/// ρ₁ is the correlation of the residuals of neighbouring rays: rays closer than the content's own detail do not bring
/// new evidence (variance of the mean of a first-order autoregressive sequence).
fn robust_fit(found: &RimPoints, start: Circles) -> Option<Solution> {
    let points = &found.points;
    let mut circles = start;
    let mut solution = None;
    for _ in 0..10 {
        let residuals: Vec<f64> = points.iter().map(|point| residual_px(point, &circles)).collect();
        let deviation = robust_deviation_px(&residuals);
        let (mut normal, mut right, mut squares, mut weights) = (Matrix4::zeros(), Vector4::zeros(), 0.0, 0.0);
        for (point, &e) in points.iter().zip(&residuals) {
            let w = biweight(e, deviation);
            let (dx, dy) = (point.at_px[0] - circles.center_px[0], point.at_px[1] - circles.center_px[1]);
            let distance = hypot(dx, dy).max(1e-9);
            let is_inner = if point.rim == Rim::Inner { 1.0 } else { 0.0 };
            let row = Vector4::new(-dx / distance, -dy / distance, -is_inner, is_inner - 1.0);
            normal += w * row * row.transpose();
            right -= w * e * row;
            squares += w * e * e;
            weights += w;
        }
        if weights < 16.0 {
            return None;
        }
        let cholesky = normal.cholesky()?;
        let step = cholesky.solve(&right);
        circles.center_px[0] += step[0];
        circles.center_px[1] += step[1];
        circles.inner_radius_px += step[2];
        circles.outer_radius_px += step[3];
        let plausible = circles.inner_radius_px > 1.0 && circles.outer_radius_px > circles.inner_radius_px + 1.0;
        if !plausible || !step.iter().all(|s| s.is_finite()) {
            return None;
        }
        let inflation = neighbour_inflation(points, &residuals, deviation);
        let covariance = cholesky.inverse() * (squares / (weights - 4.0) * inflation);
        let deviations_px = [0, 1, 2, 3].map(|i| (covariance[(i, i)] + SYSTEMATIC_PX.powi(2)).sqrt());
        solution = Some(Solution { circles, deviations_px });
        if step.norm() < 1e-4 {
            break;
        }
    }
    solution
}

/// (1 + ρ₁)/(1 − ρ₁) of the residuals that count, at least 1.
fn neighbour_inflation(points: &[RimPoint], residuals: &[f64], deviation: f64) -> f64 {
    let (mut products, mut squares) = (0.0, 1e-12);
    for (pair, e) in points.windows(2).zip(residuals.windows(2)) {
        let counts = e.iter().all(|&e| biweight(e, deviation) > 0.0);
        if counts && pair[0].rim == pair[1].rim && pair[0].ray + 1 == pair[1].ray {
            products += e[0] * e[1];
            squares += 0.5 * (e[0] * e[0] + e[1] * e[1]);
        }
    }
    let correlation: f64 = products / squares;
    let correlation = correlation.clamp(0.0, 0.95);
    (1.0 + correlation) / (1.0 - correlation)
}

/// Distance between the centres of the rims, each fitted alone: linear least squares on the residuals of the joint fit,
/// e ≈ δx cos φ + δy sin φ + δr.
fn center_disagreement_px(points: &[RimPoint], circles: &Circles) -> Option<f64> {
    let [inner, outer] = [Rim::Inner, Rim::Outer].map(|rim| {
        let of_rim: Vec<(&RimPoint, f64)> =
            points.iter().filter(|point| point.rim == rim).map(|point| (point, residual_px(point, circles))).collect();
        let residuals: Vec<f64> = of_rim.iter().map(|&(_, e)| e).collect();
        let deviation = robust_deviation_px(&residuals);
        let (mut normal, mut right) = (Matrix3::zeros(), Vector3::zeros());
        for (point, e) in of_rim {
            let w = biweight(e, deviation);
            let (dx, dy) = (point.at_px[0] - circles.center_px[0], point.at_px[1] - circles.center_px[1]);
            let distance = hypot(dx, dy).max(1e-9);
            let row = Vector3::new(dx / distance, dy / distance, 1.0);
            normal += w * row * row.transpose();
            right += w * e * row;
        }
        normal.cholesky().map(|cholesky| cholesky.solve(&right))
    });
    let (inner, outer) = (inner?, outer?);
    Some(hypot(inner[0] - outer[0], inner[1] - outer[1]))
}
