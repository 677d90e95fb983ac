//! Coarse to fine: which concentric pair of circles separates lively content from a flat surround and a flat hub.
//!
//! For a centre, `edge share` E(r) is the share of directions with an edge across the circle of radius r, each edge
//! weighted g/(g + g₀) so that a few strong ones cannot stand for many:
//!
//! ```text
//! E(r) = mean over visible directions u of  g/(g + g₀),    g² = (a ∂ᵤ mean)² + (∂ᵤ deviation)²
//! ```
//!
//! Textured content has a middling E everywhere, so what counts is how far a rim rises above what lies on its flat
//! side: beyond the outer rim, within the inner one. And all between the rims is livelier than all beyond them.

use std::f32::consts::TAU;

use super::evidence::Maps;

/// Two circles about one centre \[px of the map they were found in\].
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Circles {
    pub center_px: [f64; 2],
    pub inner_radius_px: f64,
    pub outer_radius_px: f64,
}

/// The circles and how far their rims rise above the flat sides: 1 for a perfect rim.
#[derive(Debug, Clone, Copy)]
pub(super) struct Candidate {
    pub circles: Circles,
    pub inner_rise: f32,
    pub outer_rise: f32,
    /// How much livelier it is between the rims than inside and around them, as a difference of mean edge shares.
    pub contrast: f32,
}

impl Candidate {
    fn score(&self) -> f32 {
        self.inner_rise + self.outer_rise + self.contrast
    }
}

/// Directions a circle is looked at in: on the coarsest level the outer rim has about 200 px of circumference, and
/// neighbouring pixels of it are correlated.
const DIRECTIONS: usize = 64;
/// The shorter image side on the coarsest level \[px\]: the rim is then about one pixel wide even when defocused.
const COARSEST_SIDE_PX: usize = 60;
/// The outer rim may be cut by the frame, up to a little more than a third of the circumference.
const MIN_VISIBLE_SHARE: f32 = 0.6;
/// Rings of the flat side that a rim is compared with, in px of the level beyond the rim. The edge itself smears over
/// the first two.
const FLAT_SIDE_PX: [usize; 2] = [3, 7];
/// The donut's width has to leave something between its rims \[px of a level\].
const MIN_WIDTH_PX: usize = 2 * FLAT_SIDE_PX[0];
/// Smallest outer radius as a part of the shorter image side: a smaller donut has too few pixels to localize with.
const MIN_OUTER_SHARE: f32 = 0.2;
/// No lens has a hub of more than this part of the outer radius: the panorama would be too low to be of use.
const MAX_RADIUS_RATIO: f32 = 0.8;
/// Nor of less than this part: a dot, not a hub.
const MIN_RADIUS_RATIO: f32 = 0.12;
/// Smallest inner radius on a level \[px\]: below, a circle is not told from a dot.
const MIN_INNER_RADIUS_PX: usize = 3;
/// Gradient below which an edge counts for little even without any noise \[grey levels a px\]: JPEG's own artefacts.
const MIN_GRADIENT: f32 = 1.5;
/// Weight of the mean map's edges where content moved: the mean then also shows static clutter (lens housing,
/// reflections on the hub), the deviation does not.
pub(super) const MEAN_WEIGHT_WITH_MOTION: f32 = 0.1;

/// The best pair of circles \[px of `maps`\], to about a pixel of the second coarsest level. `None` when the image is too
/// small for any.
pub(super) fn search(maps: &Maps, mean_weight: f32) -> Option<Candidate> {
    let factor = (maps.width_px.min(maps.height_px) / COARSEST_SIDE_PX).max(1);
    let level = Level::new(maps, factor, mean_weight);
    let mut starts: Vec<Candidate> = Vec::new();
    for y in (0..level.height).step_by(2) {
        for x in (0..level.width).step_by(2) {
            starts.extend(level.best_circles([x as f32, y as f32]));
        }
    }
    starts.sort_by(|a, b| b.score().total_cmp(&a.score()));
    starts.truncate(STARTS);

    let finer_factor = factor.div_ceil(3);
    let finer = Level::new(maps, finer_factor, mean_weight);
    starts
        .into_iter()
        .map(|start| level.climb(start, 1.0))
        .filter_map(|coarse| {
            let center = coarse.circles.center_px.map(|c| original_px(c, factor));
            let start = center.map(|c| level_px(c, finer_factor) as f32);
            finer.best_circles(start).map(|candidate| finer.climb(candidate, factor as f32 / finer_factor as f32))
        })
        .max_by(|a, b| a.score().total_cmp(&b.score()))
        .map(|found| Candidate {
            circles: Circles {
                center_px: found.circles.center_px.map(|c| original_px(c, finer_factor)),
                inner_radius_px: found.circles.inner_radius_px * finer_factor as f64,
                outer_radius_px: found.circles.outer_radius_px * finer_factor as f64,
            },
            ..found
        })
}

/// How far the search may be from the truth \[px of the original\]: two pixels of the finer level.
pub(super) fn search_error_px(maps: &Maps) -> f64 {
    let factor = (maps.width_px.min(maps.height_px) / COARSEST_SIDE_PX).max(1);
    2.0 * factor.div_ceil(3) as f64
}

/// Best centres of the coarsest level that are followed to the next.
const STARTS: usize = 6;

fn original_px(level_px: f64, factor: usize) -> f64 {
    level_px * factor as f64 + (factor - 1) as f64 / 2.0
}

fn level_px(original_px: f64, factor: usize) -> f64 {
    (original_px - (factor - 1) as f64 / 2.0) / factor as f64
}

/// Cumulative over the rings r = 0, 1, ... px: edge weights, and directions inside the image.
struct Rings {
    sums: Vec<[f32; 2]>,
}

impl Rings {
    fn last(&self) -> usize {
        self.sums.len() - 2
    }

    /// Share of the directions in which this ring lies inside the image.
    fn visible(&self, ring: usize) -> f32 {
        (self.sums[ring + 1][1] - self.sums[ring][1]) / DIRECTIONS as f32
    }

    /// Mean edge share of the visible part of some rings, both included; 0 when hardly anything of them is visible.
    fn mean(&self, first: usize, last: usize) -> f32 {
        let (before, after) = (self.sums[first.min(last)], self.sums[last + 1]);
        let weight = after[1] - before[1];
        if weight > 0.1 * DIRECTIONS as f32 { (after[0] - before[0]) / weight } else { 0.0 }
    }
}

/// Gradients of both maps at one resolution.
struct Level {
    width: usize,
    height: usize,
    /// `[∂x mean, ∂y mean, ∂x deviation, ∂y deviation]` \[grey levels a px\], the mean's times its weight.
    gradients: Vec<[f32; 4]>,
    /// g₀ of the module's formula, squared.
    gradient_scale: f32,
    directions: Vec<[f32; 2]>,
    min_outer_radius: usize,
    max_radius: usize,
}

impl Level {
    fn new(maps: &Maps, factor: usize, mean_weight: f32) -> Self {
        let reduced = maps.reduced(factor);
        let (width, height) = (reduced.width_px, reduced.height_px);
        let mut gradients = vec![[0.0; 4]; width * height];
        for y in 1..height.saturating_sub(1) {
            for x in 1..width - 1 {
                let at = y * width + x;
                let [right, left] = [reduced.values[at + 1], reduced.values[at - 1]];
                let [below, above] = [reduced.values[at + width], reduced.values[at - width]];
                let half = [0.5 * mean_weight, 0.5];
                gradients[at] = [
                    half[0] * (right[0] - left[0]),
                    half[0] * (below[0] - above[0]),
                    half[1] * (right[1] - left[1]),
                    half[1] * (below[1] - above[1]),
                ];
            }
        }
        let directions = (0..DIRECTIONS)
            .map(|i| (i as f32 + 0.5) / DIRECTIONS as f32 * TAU)
            .map(|a| [libm::cosf(a), libm::sinf(a)])
            .collect();
        let gradient_scale = (3.0 * mean_weight * reduced.noise()).max(MIN_GRADIENT * mean_weight.max(0.5));
        // A circle of this radius about the centre of a square image shows MIN_VISIBLE_SHARE of itself.
        let max_radius = (0.65 * width.min(height) as f32) as usize;
        let min_outer_radius = (MIN_OUTER_SHARE * width.min(height) as f32) as usize;
        Self { width, height, gradients, gradient_scale, directions, min_outer_radius, max_radius }
    }

    /// Best pair of radii about a centre \[px of this level\].
    fn best_circles(&self, center: [f32; 2]) -> Option<Candidate> {
        let rings = self.edge_shares(center);
        let seen = |radius: &usize| rings.visible(*radius) >= MIN_VISIBLE_SHARE;
        let inner_rises: Vec<(usize, f32)> = (MIN_INNER_RADIUS_PX..self.max_radius)
            .filter(seen)
            .map(|r| (r, rings.mean(r, r) - rings.mean(r.saturating_sub(FLAT_SIDE_PX[1]), r - FLAT_SIDE_PX[0])))
            .collect();
        let mut best: Option<Candidate> = None;
        for outer in (self.min_outer_radius..=self.max_radius).filter(seen) {
            let outer_rise = rings.mean(outer, outer) - rings.mean(outer + FLAT_SIDE_PX[0], outer + FLAT_SIDE_PX[1]);
            let still_outside = rings.mean(outer + FLAT_SIDE_PX[0], rings.last());
            for &(inner, inner_rise) in &inner_rises {
                if inner as f32 > MAX_RADIUS_RATIO * outer as f32 || inner + MIN_WIDTH_PX > outer {
                    break;
                }
                if (inner as f32) < MIN_RADIUS_RATIO * outer as f32 {
                    continue;
                }
                let still_inside = rings.mean(0, inner - FLAT_SIDE_PX[0]);
                let lively = rings.mean(inner + FLAT_SIDE_PX[0], outer - FLAT_SIDE_PX[0]);
                let contrast = lively - 0.5 * (still_outside + still_inside);
                if best.is_none_or(|best| inner_rise + outer_rise + contrast > best.score()) {
                    best = Some(Candidate {
                        circles: Circles {
                            center_px: center.map(f64::from),
                            inner_radius_px: inner as f64,
                            outer_radius_px: outer as f64,
                        },
                        inner_rise,
                        outer_rise,
                        contrast,
                    });
                }
            }
        }
        best
    }

    /// E(r) of the module's formula for r = 0, 1, ... px, and the share of directions inside the image.
    fn edge_shares(&self, [center_x, center_y]: [f32; 2]) -> Rings {
        // One entry more than there are rings: sums up to but without the ring.
        let mut sums = vec![[0.0; 2]; self.max_radius + FLAT_SIDE_PX[1] + 2];
        let radii = sums.len() - 1;
        let (right, bottom) = (self.width as f32 - 1.5, self.height as f32 - 1.5);
        for &[ux, uy] in &self.directions {
            for (r, sum) in sums[1..=radii].iter_mut().enumerate() {
                let (x, y) = (center_x + r as f32 * ux, center_y + r as f32 * uy);
                // The outermost pixels have no gradient.
                if !(x >= 0.5 && y >= 0.5 && x < right && y < bottom) {
                    break;
                }
                let g = &self.gradients[(y + 0.5) as usize * self.width + (x + 0.5) as usize];
                let (mean, deviation) = (ux * g[0] + uy * g[1], ux * g[2] + uy * g[3]);
                // Not `hypot`: it is many times slower, and grey levels do not overflow.
                let gradient = (mean * mean + deviation * deviation).sqrt();
                sum[0] += gradient / (gradient + self.gradient_scale);
                sum[1] += 1.0;
            }
        }
        for ring in 1..=radii {
            let before = sums[ring - 1];
            sums[ring] = [sums[ring][0] + before[0], sums[ring][1] + before[1]];
        }
        Rings { sums }
    }

    /// Moves the centre to the best of its eight neighbours until none is better, with steps halved down to ½ px.
    fn climb(&self, start: Candidate, first_step: f32) -> Candidate {
        let mut best = start;
        let mut step = first_step;
        while step >= 0.5 {
            let [x, y] = best.circles.center_px.map(|c| c as f32);
            let neighbours = (-1..=1).flat_map(|j| {
                (-1..=1).filter(move |&i| (i, j) != (0, 0)).map(move |i| [x + i as f32 * step, y + j as f32 * step])
            });
            let better = neighbours
                .filter_map(|center| self.best_circles(center))
                .max_by(|a, b| a.score().total_cmp(&b.score()))
                .filter(|neighbour| neighbour.score() > best.score());
            match better {
                Some(neighbour) => best = neighbour,
                None => step /= 2.0,
            }
        }
        best
    }
}
