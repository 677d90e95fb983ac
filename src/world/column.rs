//! What one ray meets, painted into one column of the panorama.

use super::{
    light::{BlockLight, Shadows, Sky},
    scene::{Block, Plane, Upright},
    texture::{Color, Level, dim, mix},
    traffic::Textures,
};

/// All that is to be seen at one instant.
pub(super) struct Scene<'a> {
    pub textures: &'a Textures,
    pub blocks: &'a [Block],
    pub lights: &'a [BlockLight],
    pub shadows: &'a Shadows,
    pub uprights: &'a [Upright],
    pub upright_light: u32,
    pub ground: &'a Plane,
    pub above: Above<'a>,
}

/// What is above everything else.
#[derive(Clone, Copy)]
pub(super) enum Above<'a> {
    Sky(&'a Sky),
    Ceiling(&'a Plane),
}

/// The rows of the panorama.
#[derive(Debug, Clone)]
pub(super) struct Rows {
    /// Tangent of the elevation of every row's middle, from the top down.
    pub tangents: Vec<f32>,
    top_rad: f32,
    per_rad: f32,
    /// Rows whose middle lies above the horizon.
    pub above_horizon: usize,
}

impl Rows {
    pub fn new(count: usize, top_rad: f64, bottom_rad: f64) -> Self {
        let step_rad = (top_rad - bottom_rad) / count as f64;
        let elevation_rad = |row: usize| top_rad - (row as f64 + 0.5) * step_rad;
        let tangents: Vec<f32> = (0..count).map(|row| elevation_rad(row).tan() as f32).collect();
        let above_horizon = tangents.partition_point(|&tangent| tangent > 0.0);
        Self { tangents, top_rad: top_rad as f32, per_rad: (1.0 / step_rad) as f32, above_horizon }
    }

    /// Where a direction lies, in rows from the upper edge of row 0, within the panorama.
    #[inline(always)]
    fn at(&self, tangent: f32) -> f32 {
        ((self.top_rad - tangent.atan()) * self.per_rad).clamp(0.0, self.tangents.len() as f32)
    }
}

/// A ray on the plane.
#[derive(Debug, Clone, Copy)]
pub(super) struct Ray {
    pub from_m: [f32; 2],
    /// Of the camera above the ground.
    pub height_m: f32,
    pub direction: [f32; 2],
    /// Its azimuth in turns from east, counter-clockwise.
    pub azimuth_turns: f32,
}

/// Something that a ray meets.
#[derive(Debug, Clone, Copy)]
pub(super) struct Hit {
    /// What is painted first is what is farther.
    depth_m: f32,
    what: What,
    index: u16,
    entry_m: f32,
    exit_m: f32,
    /// From the left end of a side or upright picture.
    along_m: f32,
    /// Nothing of it is seen below this tangent, because of what is nearer.
    hidden_below: f32,
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum What {
    Side(u8),
    /// The upper side of a block that is looked down on, or the lower side of one that is looked up to.
    Lid,
    Upright,
}

/// What one ray met so far.
#[derive(Debug, Clone)]
pub(super) struct Column {
    hits: Vec<Hit>,
    /// The tallest of the near blocks: what is behind it and not higher is not seen.
    cover_m: f32,
    cover_tangent: f32,
}

impl Default for Column {
    fn default() -> Self {
        Self { hits: Vec::with_capacity(24), cover_m: f32::INFINITY, cover_tangent: f32::NEG_INFINITY }
    }
}

/// Angle that a texel may cover: about a row of the panorama \[rad\].
const TEXEL_RAD: f32 = 0.0046;
/// Between neighbouring columns, as a side that is seen at a low angle spreads it \[rad\].
const COLUMN_RAD: f32 = 0.0021;
/// What stands against a wall is taken to be this much nearer \[m\].
const CLEARANCE_M: f32 = 0.002;
/// Nearer than this nothing is painted \[m\].
const NEAREST_M: f32 = 0.05;

impl Column {
    pub fn clear(&mut self) {
        self.hits.clear();
        self.cover_m = f32::INFINITY;
        self.cover_tangent = f32::NEG_INFINITY;
    }

    /// Notes where the ray meets the block, unless that is hidden.
    #[inline]
    pub fn meet_block(&mut self, index: usize, block: &Block, origin: [f32; 2], ray: &Ray) {
        let direction = block.turned(ray.direction);
        let inverse = direction.map(|d| 1.0 / if d.abs() < 1e-7 { 1e-7 } else { d });
        let Some(crossing) = block.crossing(origin, inverse) else { return };
        let (entry_m, exit_m) = (crossing.entry.max(NEAREST_M), crossing.exit);
        let above_m = block.top_m - ray.height_m;
        let highest = above_m / if above_m > 0.0 { entry_m } else { exit_m };
        if entry_m >= self.cover_m && highest <= self.cover_tangent {
            return;
        }
        if block.bottom_m == 0.0 && above_m / entry_m > self.cover_tangent {
            (self.cover_m, self.cover_tangent) = (entry_m, above_m / entry_m);
        }
        let met = [origin[0] + entry_m * direction[0], origin[1] + entry_m * direction[1]];
        let along_m = block.along_side_m(crossing.side, met);
        let hit = Hit {
            depth_m: entry_m,
            what: What::Side(crossing.side as u8),
            index: index as u16,
            entry_m,
            exit_m,
            along_m,
            hidden_below: f32::NEG_INFINITY,
        };
        self.hits.push(hit);
        if above_m < 0.0 || block.bottom_m > ray.height_m {
            // Before the wall that the block may stand against.
            self.hits.push(Hit { depth_m: exit_m - CLEARANCE_M, what: What::Lid, ..hit });
        }
    }

    pub fn meet_upright(&mut self, index: usize, distance_m: f32, along_m: f32) {
        self.hits.push(Hit {
            depth_m: distance_m,
            what: What::Upright,
            index: index as u16,
            entry_m: distance_m,
            exit_m: distance_m,
            along_m,
            hidden_below: f32::NEG_INFINITY,
        });
    }

    /// Puts what the ray met in order, and says which rows show what lies behind and below all blocks.
    pub fn arrange(&mut self, scene: &Scene, rows: &Rows, ray: &Ray) -> Background {
        self.hits.sort_unstable_by(|a, b| a.depth_m.total_cmp(&b.depth_m));
        let mut hidden_below = f32::NEG_INFINITY;
        let mut base = None;
        for hit in &mut self.hits {
            hit.hidden_below = hidden_below;
            if let What::Side(_) = hit.what {
                let block = &scene.blocks[usize::from(hit.index)];
                if block.bottom_m == 0.0 {
                    let top = (block.top_m - ray.height_m) / hit.entry_m;
                    hidden_below = hidden_below.max(top);
                    if top > 0.0 && base.is_none() {
                        base = Some(-ray.height_m / hit.entry_m);
                    }
                }
            }
        }
        let above_to = if hidden_below > 0.0 { rows.at(hidden_below).ceil() as usize } else { rows.above_horizon };
        let ground_from = base.map_or(rows.above_horizon, |tangent| rows.at(tangent) as usize);
        Background { above_to: above_to.min(rows.above_horizon), ground_from: ground_from.max(rows.above_horizon) }
    }

    /// Paints all that the ray met into `out`, one colour a row, over the background.
    pub fn paint(&self, scene: &Scene, rows: &Rows, ray: &Ray, out: &mut [Color]) {
        for hit in self.hits.iter().rev() {
            match hit.what {
                What::Side(side) => paint_side(scene, rows, ray, hit, usize::from(side), out),
                What::Lid => paint_lid(scene, rows, ray, hit, out),
                What::Upright => paint_upright(scene, rows, ray, hit, out),
            }
        }
    }
}

/// Rows that show sky or ceiling, up to `above_to`, and ground, from `ground_from`.
#[derive(Debug, Clone, Copy)]
pub(super) struct Background {
    above_to: usize,
    ground_from: usize,
}

impl Background {
    /// What shows for either of two.
    pub fn with(self, other: Self) -> Self {
        Self { above_to: self.above_to.max(other.above_to), ground_from: self.ground_from.min(other.ground_from) }
    }

    pub fn paint(self, scene: &Scene, rows: &Rows, ray: &Ray, out: &mut [Color]) {
        match scene.above {
            Above::Sky(sky) => sky.column(ray.azimuth_turns, &mut out[..self.above_to]),
            Above::Ceiling(plane) => paint_plane(plane, rows, ray, 0..self.above_to, out),
        }
        paint_plane(scene.ground, rows, ray, self.ground_from..out.len(), out);
    }
}

fn paint_plane(plane: &Plane, rows: &Rows, ray: &Ray, range: std::ops::Range<usize>, out: &mut [Color]) {
    let above_m = plane.height_m - ray.height_m;
    let from = [0, 1].map(|axis| ray.from_m[axis] - plane.corner_m[axis]);
    for row in range {
        let distance_m = above_m / rows.tangents[row];
        // Seen at a low angle a row covers much more in depth than across.
        let depth_m = TEXEL_RAD * distance_m * (distance_m / above_m.abs()).max(1.0);
        let (level, per_m) = plane.texture.level((0.5 * depth_m).max(TEXEL_RAD * distance_m));
        let [u, v] = [0, 1].map(|axis| (from[axis] + distance_m * ray.direction[axis]) * per_m);
        out[row] = level.bilinear(u, v);
    }
}

/// Paints rows from `top` down to `bottom` (tangents); rows that are covered in part are mixed.
#[inline(always)]
fn paint_span(rows: &Rows, top: f32, bottom: f32, out: &mut [Color], color: impl Fn(usize, f32) -> Color) {
    let (first, last) = (rows.at(top), rows.at(bottom));
    if last <= first {
        return;
    }
    let (from, to) = (first.ceil() as usize, last.floor() as usize);
    let mut edge = |row: usize, share: f32| {
        if let Some(out) = out.get_mut(row) {
            *out = mix(*out, color(row, rows.tangents[row]), (256.0 * share) as u32);
        }
    };
    if from > to {
        // Within one row.
        edge(to, last - first);
        return;
    }
    if from as f32 > first {
        edge(from - 1, from as f32 - first);
    }
    if last > to as f32 {
        edge(to, last - to as f32);
    }
    for (row, (out, &tangent)) in out.iter_mut().zip(&rows.tangents).enumerate().take(to).skip(from) {
        *out = color(row, tangent);
    }
}

fn paint_side(scene: &Scene, rows: &Rows, ray: &Ray, hit: &Hit, side: usize, out: &mut [Color]) {
    let (block, light) = (&scene.blocks[usize::from(hit.index)], &scene.lights[usize::from(hit.index)].sides[side]);
    let distance_m = hit.entry_m;
    let top = (block.top_m - ray.height_m) / distance_m;
    if top <= hit.hidden_below {
        return;
    }
    // A row more than is seen, so that the edge of what hides it has something to mix with.
    let bottom = ((block.bottom_m - ray.height_m) / distance_m).max(hit.hidden_below - 0.02);
    let normal = block.normal(side);
    let facing = (normal[0] * ray.direction[0] + normal[1] * ray.direction[1]).abs().max(0.05);
    let texture = &scene.textures[usize::from(block.sides[side])];
    let (level, per_m) = texture.level(distance_m * TEXEL_RAD.max(COLUMN_RAD / facing));
    let strip = strip(level, hit.along_m * per_m);
    // Texels from the top of the side, counted from the middle of the first.
    let (start, slope) = ((block.top_m - ray.height_m) * per_m - 0.5, distance_m * per_m);
    let last = (strip.len() - 1) as f32;
    let color = |tangent: f32, light: u32| {
        let v = (start - slope * tangent).clamp(0.0, last);
        let j = v as usize;
        let texel = strip[j];
        let next = strip[(j + 1).min(strip.len() - 1)];
        dim(mix(texel, next, ((v - j as f32) * 256.0) as u32), light)
    };
    let in_shade_below = match light.shadow {
        Some(start) => (scene.shadows.height_m(start, hit.along_m) - ray.height_m) / distance_m,
        None => f32::NEG_INFINITY,
    };
    if in_shade_below > bottom {
        paint_span(rows, top, bottom, out, |_, tangent| color(tangent, light.shade));
    }
    if in_shade_below < top {
        paint_span(rows, top, bottom.max(in_shade_below), out, |_, tangent| color(tangent, light.lit));
    }
}

/// The texels of a level at `u`; pictures narrower than their side are repeated.
#[inline(always)]
fn strip(level: &Level, u: f32) -> &[Color] {
    let column = (u.max(0.0) as usize).min(2 * level.columns);
    level.column(if column >= level.columns { level.columns - 1 } else { column })
}

fn paint_lid(scene: &Scene, rows: &Rows, ray: &Ray, hit: &Hit, out: &mut [Color]) {
    let (block, light) = (&scene.blocks[usize::from(hit.index)], &scene.lights[usize::from(hit.index)]);
    let (top, bottom, color) = if block.top_m < ray.height_m {
        let below_m = block.top_m - ray.height_m;
        // The side below is painted over the row that both share.
        (below_m / hit.exit_m, below_m / hit.entry_m - 0.01, dim(block.lid, light.lid))
    } else {
        let above_m = block.bottom_m - ray.height_m;
        (above_m / hit.entry_m + 0.01, above_m / hit.exit_m, dim(block.lid, light.sides[0].shade / 2))
    };
    if top > hit.hidden_below {
        paint_span(rows, top, bottom.max(hit.hidden_below - 0.02), out, |_, _| color);
    }
}

fn paint_upright(scene: &Scene, rows: &Rows, ray: &Ray, hit: &Hit, out: &mut [Color]) {
    let upright = &scene.uprights[usize::from(hit.index)];
    let (top, foot) = ((upright.top_m - ray.height_m) / hit.entry_m, -ray.height_m / hit.entry_m);
    if top <= hit.hidden_below {
        return;
    }
    let texture = &scene.textures[usize::from(upright.texture)];
    let (level, per_m) = texture.level(hit.entry_m * TEXEL_RAD);
    let strip = strip(level, hit.along_m * per_m);
    let (start, slope) = ((upright.top_m - ray.height_m) * per_m, hit.entry_m * per_m);
    let from = rows.at(top) as usize;
    let to = rows.at(foot.max(hit.hidden_below)).ceil() as usize;
    for (out, tangent) in out[from..to].iter_mut().zip(&rows.tangents[from..to]) {
        let v = start - slope * tangent;
        if v >= 0.0
            && let Some(&texel) = strip.get(v as usize)
        {
            let opacity = texel >> 24;
            if opacity > 0 {
                *out = mix(*out, dim(texel, scene.upright_light), opacity + (opacity >> 7));
            }
        }
    }
}
