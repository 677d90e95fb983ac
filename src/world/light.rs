//! What the light of a day does to a place: bright and dark sides, shadows, lamps and the sky.

use std::f64::consts::TAU;

use rand::Rng;

use super::{
    Day, World,
    corridor::distance_squared,
    random::{Stream, fractal, stream},
    scene::{Block, Plane, Upright},
    texture::{Color, dim, mix, rgb, tinted},
};

/// Distance of the places on a side where the height of the shadow on it is known \[m\].
const SHADOW_STEP_M: f32 = 0.5;
/// Shadows reach no further than this \[m\].
const LONGEST_SHADOW_M: f32 = 60.0;
/// Full light; a share of it multiplies every colour.
const FULL: f32 = 256.0;

/// How the sides of one block are lit.
#[derive(Debug, Clone, Copy)]
pub(super) struct BlockLight {
    pub sides: [SideLight; 4],
    pub lid: u32,
}

#[derive(Debug, Clone, Copy)]
pub(super) struct SideLight {
    /// In the sun and in the shade, of 256.
    pub lit: u32,
    pub shade: u32,
    /// Where this side's shadow heights begin in [`Shadows::heights_m`]; `None`: it has none.
    pub shadow: Option<u32>,
}

/// The sun and what is left where it does not shine.
#[derive(Debug, Clone, Copy)]
pub(super) struct Light {
    to_sun: [f32; 3],
    sun: f32,
    ambient: f32,
}

impl Light {
    pub fn of(world: &World, day: &Day) -> Self {
        let overcast = day.overcast.clamp(0.0, 1.0) as f32;
        if world.is_outdoors() {
            Self { to_sun: day.to_sun(), sun: 0.72 * (1.0 - overcast), ambient: 0.42 + 0.36 * overcast }
        } else {
            // Indoors the sun is a faint light from the end of the corridor.
            let [x, y, _] = day.to_sun();
            Self { to_sun: [x, y, 0.0], sun: 0.16 * (1.0 - overcast), ambient: 0.8 }
        }
    }

    pub fn shade(&self) -> u32 {
        (FULL * self.ambient).min(FULL) as u32
    }

    fn towards(&self, normal: [f32; 3]) -> u32 {
        let facing: f32 = normal.iter().zip(self.to_sun).map(|(n, s)| n * s).sum();
        (FULL * (self.ambient + self.sun * facing.max(0.0))).min(FULL) as u32
    }

    pub fn ground(&self) -> u32 {
        self.towards([0.0, 0.0, 1.0])
    }

    /// Of a block without shadows on it.
    pub fn of_block(&self, block: &Block) -> BlockLight {
        let sides = [0, 1, 2, 3].map(|side| {
            let [x, y] = block.normal(side);
            SideLight { lit: self.towards([x, y, 0.0]), shade: self.shade(), shadow: None }
        });
        BlockLight { sides, lid: self.ground() }
    }
}

/// How high the shadows on the sides of all blocks reach.
#[derive(Debug, Clone, Default)]
pub(super) struct Shadows {
    heights_m: Vec<f32>,
}

impl Shadows {
    /// The light of `blocks` with the shadows that they throw on each other.
    pub fn cast(light: &Light, blocks: &[Block]) -> (Self, Vec<BlockLight>) {
        let mut shadows = Self::default();
        let lights = blocks
            .iter()
            .map(|block| {
                let mut block_light = light.of_block(block);
                for (side, side_light) in block_light.sides.iter_mut().enumerate() {
                    if side_light.lit > side_light.shade + 4 {
                        side_light.shadow = Some(shadows.heights_m.len() as u32);
                        shadows.add_side(light, blocks, block, side);
                    }
                }
                block_light
            })
            .collect();
        (shadows, lights)
    }

    fn add_side(&mut self, light: &Light, blocks: &[Block], block: &Block, side: usize) {
        let [x, y, up] = light.to_sun;
        let level = x.hypot(y).max(1e-6);
        let (to_sun, rise) = ([x / level, y / level], up / level);
        let (normal, corners) = (block.normal(side), block.corners_m());
        // From the left as seen from outside.
        let (left, right) = (corners[[3, 0, 1, 2][side]], corners[[0, 1, 2, 3][side]]);
        let width_m = (right[0] - left[0]).hypot(right[1] - left[1]);
        let count = (width_m / SHADOW_STEP_M).ceil() as usize + 1;
        for i in 0..count {
            let share = (i as f32 * SHADOW_STEP_M / width_m).min(1.0);
            let from = [0, 1].map(|axis| left[axis] + share * (right[axis] - left[axis]) + 0.05 * normal[axis]);
            let height_m = blocks.iter().map(|other| shadow_height_m(other, from, to_sun, rise)).fold(0.0, f32::max);
            self.heights_m.push(height_m);
        }
    }

    /// Up to where the side is in the shade, `along_m` from its left end.
    #[inline]
    pub fn height_m(&self, start: u32, along_m: f32) -> f32 {
        let steps = (along_m / SHADOW_STEP_M).max(0.0);
        let (i, last) = (start as usize + steps as usize, self.heights_m.len() - 1);
        let (a, b) = (self.heights_m[i.min(last)], self.heights_m[(i + 1).min(last)]);
        a + steps.fract() * (b - a)
    }
}

/// How high above `from` the shadow of `block` reaches when the sun rises by `rise` a metre.
fn shadow_height_m(block: &Block, from: [f32; 2], to_sun: [f32; 2], rise: f32) -> f32 {
    let inverse = block.turned(to_sun).map(|d| 1.0 / if d.abs() < 1e-6 { 1e-6 } else { d });
    match block.crossing(block.local(from), inverse) {
        Some(crossing) if block.bottom_m == 0.0 => block.top_m - rise * crossing.entry,
        _ => 0.0,
    }
}

/// The ground with all shadows on it.
pub(super) fn ground(plane: &Plane, light: &Light, blocks: &[Block], uprights: &[Upright]) -> Plane {
    let mut plane = plane.clone();
    let (corner_m, per_m) = (plane.corner_m, plane.texture.texels_per_m);
    let level = plane.texture.finest_mut();
    let mut shaded = vec![false; level.texels.len()];
    let mut shade =
        |outline_m: &[[f32; 2]]| fill_convex(&mut shaded, [level.columns, level.rows], outline_m, corner_m, per_m);
    let [x, y, up] = light.to_sun;
    if light.sun > 0.02 && up > 0.05 {
        let shift = |[from_x, from_y]: [f32; 2], height_m: f32| {
            let length = height_m.min(LONGEST_SHADOW_M * up) / up;
            [from_x - length * x, from_y - length * y]
        };
        for block in blocks {
            let ends =
                [block.bottom_m, block.top_m].map(|height_m| block.corners_m().map(|corner| shift(corner, height_m)));
            shade(&hull(ends.concat()));
        }
        for upright in uprights {
            let crown = shift(upright.center_m, 0.62 * upright.top_m);
            let radius_m = 0.8 * upright.half_width_m;
            let outline: Vec<[f32; 2]> = (0..10)
                .map(|i| {
                    let (sin, cos) = (i as f32 * 0.628).sin_cos();
                    [crown[0] + radius_m * cos, crown[1] + radius_m * sin]
                })
                .collect();
            shade(&outline);
        }
    }
    let (lit, dark) = (light.ground(), light.shade());
    for (texel, shaded) in level.texels.iter_mut().zip(shaded) {
        *texel = dim(*texel, if shaded { dark } else { lit });
    }
    Plane { texture: plane.texture.refilter(), ..plane }
}

/// The convex hull, counter-clockwise (Andrew 1979).
fn hull(mut points: Vec<[f32; 2]>) -> Vec<[f32; 2]> {
    points.sort_by(|a, b| a[0].total_cmp(&b[0]).then(a[1].total_cmp(&b[1])));
    let mut hull: Vec<[f32; 2]> = Vec::new();
    let right_turn =
        |a: [f32; 2], b: [f32; 2], c: [f32; 2]| (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]) <= 0.0;
    for pass in [points.clone(), points.into_iter().rev().collect()] {
        let start = hull.len();
        for point in pass {
            while hull.len() >= start + 2 && right_turn(hull[hull.len() - 2], hull[hull.len() - 1], point) {
                hull.pop();
            }
            hull.push(point);
        }
        hull.pop();
    }
    hull
}

/// Marks the texels whose centres lie in a convex outline.
fn fill_convex(
    marks: &mut [bool],
    [columns, rows]: [usize; 2],
    outline_m: &[[f32; 2]],
    corner_m: [f32; 2],
    texels_per_m: f32,
) {
    let outline: Vec<[f32; 2]> =
        outline_m.iter().map(|p| [0, 1].map(|axis| (p[axis] - corner_m[axis]) * texels_per_m - 0.5)).collect();
    let (mut first, mut last) = (f32::INFINITY, f32::NEG_INFINITY);
    for [x, _] in &outline {
        (first, last) = (first.min(*x), last.max(*x));
    }
    let columns_in = first.ceil().max(0.0) as usize..((last.floor() + 1.0).max(0.0) as usize).min(columns);
    for column in columns_in {
        let x = column as f32;
        let (mut low, mut high) = (f32::INFINITY, f32::NEG_INFINITY);
        for (i, &a) in outline.iter().enumerate() {
            let b = outline[(i + 1) % outline.len()];
            if (a[0] <= x) != (b[0] <= x) {
                let y = a[1] + (x - a[0]) / (b[0] - a[0]) * (b[1] - a[1]);
                (low, high) = (low.min(y), high.max(y));
            }
        }
        if low <= high {
            let from = (low.ceil().max(0.0) as usize).min(rows);
            let to = ((high.floor() + 1.0).max(0.0) as usize).clamp(from, rows);
            marks[column * rows + from..column * rows + to].fill(true);
        }
    }
}

/// Ceiling and floor of a corridor in which some of the lamps burn.
pub(super) fn lamplight(world: &World, day: &Day) -> (Option<Plane>, Plane) {
    let mut random = stream(day.seed, Stream::Lamps);
    let burns: Vec<bool> = world.lamps.iter().map(|_| random.random_bool(0.85)).collect();
    let lit = |plane: &Plane, spread_m2: f32, dark: f32| {
        let mut plane = plane.clone();
        let (corner_m, per_m) = (plane.corner_m, plane.texture.texels_per_m);
        let level = plane.texture.finest_mut();
        for (i, column) in level.texels.chunks_exact_mut(level.rows).enumerate() {
            let x = corner_m[0] + (i as f32 + 0.5) / per_m;
            for (j, texel) in column.iter_mut().enumerate() {
                let y = corner_m[1] + (j as f32 + 0.5) / per_m;
                let burning = world.lamps.iter().zip(&burns).filter(|&(_, burns)| *burns);
                let glow: f32 = burning.map(|(lamp, _)| 1.0 / (1.0 + distance_squared(lamp, x, y) / spread_m2)).sum();
                *texel = dim(*texel, (FULL * (dark + (1.0 - dark) * glow.min(1.0))) as u32);
            }
        }
        plane
    };
    let ceiling = world.ceiling.as_ref().map(|plane| {
        let mut plane = lit(plane, 0.6, 0.72);
        let (corner_m, per_m) = (plane.corner_m, plane.texture.texels_per_m);
        let level = plane.texture.finest_mut();
        for (lamp, burns) in world.lamps.iter().zip(&burns) {
            let texel =
                |m: f32, axis: usize, end: usize| ((m - corner_m[axis]) * per_m).clamp(0.0, end as f32) as usize;
            let [left, right] = [-1.0, 1.0].map(|s| texel(lamp.center_m[0] + s * lamp.half_m[0], 0, level.columns));
            let [low, high] = [-1.0, 1.0].map(|s| texel(lamp.center_m[1] + s * lamp.half_m[1], 1, level.rows));
            for column in left..right {
                let shine = if *burns { rgb(255, 254, 246) } else { rgb(112, 112, 110) };
                level.texels[column * level.rows..][low..high].fill(shine);
            }
        }
        Plane { texture: plane.texture.refilter(), ..plane }
    });
    let floor = lit(&world.ground, 2.5, 0.66);
    (ceiling, Plane { texture: floor.texture.refilter(), ..floor })
}

/// The sky all round: columns by azimuth from east counter-clockwise, one row for each given elevation.
#[derive(Debug, Clone)]
pub(super) struct Sky {
    rows: usize,
    texels: Vec<Color>,
}

impl Sky {
    const COLUMNS: usize = 1024;

    pub fn paint(day: &Day, elevations_rad: &[f32]) -> Self {
        let mut random = stream(day.seed, Stream::Sky);
        let (seed, cover): (u32, f32) = (random.random(), random.random_range(0.25..0.6));
        let overcast = day.overcast.clamp(0.0, 1.0) as f32;
        let cover = cover + (1.0 - cover) * overcast;
        let to_sun = day.to_sun();
        let mut texels = Vec::with_capacity(Self::COLUMNS * elevations_rad.len());
        for column in 0..Self::COLUMNS {
            let azimuth_rad = (TAU * column as f64 / Self::COLUMNS as f64) as f32;
            for &elevation_rad in elevations_rad {
                let (sin, cos) = elevation_rad.max(0.0).sin_cos();
                let direction = [cos * azimuth_rad.cos(), cos * azimuth_rad.sin(), sin];
                // Clouds lie on a plane above; near the horizon they would shrink to nothing.
                let reach = 1.6 / (sin + 0.25);
                let cloud = fractal(reach * direction[0], reach * direction[1], seed);
                let cloud = ((cloud - 0.75 + 0.5 * cover) * 5.0).clamp(0.0, 1.0);
                let clear = mix(rgb(206, 220, 236), rgb(92, 140, 206), (FULL * sin.min(1.0)) as u32);
                let shaded = fractal(2.0 * reach * direction[0], 2.0 * reach * direction[1], seed ^ 9);
                let white = tinted(rgb(238, 238, 240), (0.8 + 0.25 * shaded) * (1.0 - 0.25 * overcast));
                let sky = mix(clear, white, (FULL * cloud) as u32);
                let towards: f32 = direction.iter().zip(to_sun).map(|(d, s)| d * s).sum();
                let glare = (1.0 - 0.9 * overcast) * (0.35 * towards.max(0.0).powi(12) + towards.max(0.0).powi(400));
                texels.push(mix(sky, rgb(255, 253, 244), (FULL * glare.min(1.0)) as u32));
            }
        }
        Self { rows: elevations_rad.len(), texels }
    }

    /// The sky in the direction `azimuth` (in turns, any number of them), into the first of `rows`.
    #[inline]
    pub fn column(&self, azimuth_turns: f32, out: &mut [Color]) {
        let at = azimuth_turns.rem_euclid(1.0) * Self::COLUMNS as f32;
        let left = (at as usize).min(Self::COLUMNS - 1);
        let weight = ((at - left as f32) * FULL) as u32;
        let [left, right] =
            [left, (left + 1) % Self::COLUMNS].map(|column| &self.texels[column * self.rows..][..out.len()]);
        for ((out, &left), &right) in out.iter_mut().zip(left).zip(right) {
            *out = mix(left, right, weight);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_hull_is_filled() {
        let outline = hull(vec![[1.0, 1.0], [5.0, 1.0], [3.0, 2.0], [5.0, 4.0], [1.0, 4.0], [2.0, 2.0]]);
        assert_eq!(outline.len(), 4);
        let mut marks = vec![false; 100];
        fill_convex(&mut marks, [10, 10], &outline, [0.0, 0.0], 1.0);
        // Centres at 1.5, 2.5, ...: four columns of three.
        assert_eq!(marks.iter().filter(|&&mark| mark).count(), 12);
        assert!(marks[10 + 1] && marks[43] && !marks[44] && !marks[51]);
    }

    #[test]
    fn a_house_shades_its_neighbour_as_high_as_the_sun_says() {
        let house = Block::upright([0.0, 0.0], [5.0, 5.0], [0.0, 10.0], [0; 4], 0);
        let wall = Block::upright([25.0, 0.0], [5.0, 5.0], [0.0, 10.0], [0; 4], 0);
        let elevation_rad = 20.0_f32.to_radians();
        let light = Light { to_sun: [-elevation_rad.cos(), 0.0, elevation_rad.sin()], sun: 0.5, ambient: 0.4 };
        let (shadows, lights) = Shadows::cast(&light, &[house, wall]);
        let west = lights[1].sides[2];
        let height_m = shadows.height_m(west.shadow.expect("the west side is lit"), 5.0);
        // 15 m of street (the shadow is measured 5 cm before the wall).
        assert!((height_m - (10.0 - 14.95 * elevation_rad.tan())).abs() < 0.01, "{height_m}");
        assert!(lights[1].sides[0].shadow.is_none(), "the east side is turned away");
        assert!(west.lit > west.shade);
    }
}
