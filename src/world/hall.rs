//! A hall with columns, stands, shelves and tables, and windows high up.

use rand::Rng;
use rand_chacha::ChaCha8Rng;

use super::{
    Lamp, World, WorldKind,
    paint::{Canvas, board, bright, pick},
    path::Corner,
    random::{Stream, fractal, stream, white},
    scene::{Block, Plane, Upright},
    texture::{CLEAR, Color, Texture, rgb, tinted},
};
use crate::types::PositionM;

/// From wall to wall, east and north \[m\].
pub(super) const SIZE_M: [f64; 2] = [44.0, 38.0];
const HEIGHT_M: f32 = 5.5;
const BOARD_FRAME_M: f32 = 0.05;
/// Aisles run between squares of this many rows and columns; one thing or none stands in each.
const SQUARES: [usize; 2] = [7, 6];
/// What stands in a square is at most this long: the rest is aisle \[m\].
const LARGEST_M: f32 = 4.0;
const TEXELS_PER_M: f32 = 30.0;

/// The middle of the aisle before square `index` along an axis: 0 is the wall itself.
fn aisle_m(axis: usize, index: usize) -> f64 {
    SIZE_M[axis] * index as f64 / SQUARES[axis] as f64
}

pub(super) fn build(seed: u64) -> World {
    let mut random = stream(seed, Stream::Layout);
    let size_m = SIZE_M.map(|length_m| length_m as f32);
    let mut world = World::empty(WorldKind::Hall, floor(size_m, &mut random));
    world.lamps = lamps(size_m, &mut random);
    world.ceiling = Some(ceiling(size_m, &mut random));

    let paint = pick(&mut random, &[rgb(188, 184, 172), rgb(172, 180, 184), rgb(196, 184, 158), rgb(160, 150, 140)]);
    walls(&mut world, size_m, paint, &mut random);
    columns(&mut world, paint, &mut random);
    for i in 0..SQUARES[0] {
        for j in 0..SQUARES[1] {
            let middle_m = [(0, i), (1, j)].map(|(axis, k)| {
                (0.5 * (aisle_m(axis, k) + aisle_m(axis, k + 1))) as f32 + random.random_range(-0.3..0.3)
            });
            let along = pick(&mut random, &[[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]]);
            furnish(&mut world, Square { middle_m, along }, &mut random);
        }
    }
    world
}

/// Up and down the aisles and back along the south: a closed way, moved by `shift_m` to its right.
pub(super) fn route(shift_m: f64) -> Vec<Corner> {
    let mut stations: Vec<PositionM> = Vec::new();
    for column in 1..SQUARES[0] {
        let ends = if column % 2 == 1 { [2, SQUARES[1] - 1] } else { [SQUARES[1] - 1, 2] };
        stations.extend(ends.map(|row| [aisle_m(0, column), aisle_m(1, row)]));
    }
    // The first and the last aisle reach south to the way back.
    stations[0][1] = aisle_m(1, 1);
    let last = stations.len() - 1;
    stations[last][1] = aisle_m(1, 1);
    let direction = |from: PositionM, to: PositionM| [0, 1].map(|axis| (to[axis] - from[axis]).clamp(-1.0, 1.0));
    (0..=last)
        .map(|i| {
            let into = direction(stations[(i + last) % (last + 1)], stations[i]);
            let out = direction(stations[i], stations[(i + 1) % (last + 1)]);
            let [x_m, y_m] = stations[i];
            let at_m = [x_m + shift_m * (into[1] + out[1]), y_m - shift_m * (into[0] + out[0])];
            Corner { at_m, radius_m: 1.5 }
        })
        .collect()
}

fn floor(size_m: [f32; 2], random: &mut ChaCha8Rng) -> Plane {
    let (seed, tile_m): (u32, f32) = (random.random(), random.random_range(0.8..2.0));
    let color = pick(random, &[rgb(140, 138, 132), rgb(120, 116, 110), rgb(150, 136, 112), rgb(110, 118, 124)]);
    Plane::painted(0.0, [0.0; 2], size_m, 20.0, |x, y| {
        let tile = white((x / tile_m).floor() as i32, (y / tile_m).floor() as i32, seed);
        let joint = |at: f32| (at / tile_m).rem_euclid(1.0) * tile_m < 0.04;
        let dark = if joint(x) || joint(y) { 0.8 } else { 1.0 };
        tinted(color, dark * (0.78 + 0.1 * tile + 0.3 * fractal(0.4 * x, 0.4 * y, seed ^ 1)))
    })
}

fn ceiling(size_m: [f32; 2], random: &mut ChaCha8Rng) -> Plane {
    let (seed, beam_m): (u32, f32) = (random.random(), random.random_range(3.0..6.0));
    Plane::painted(HEIGHT_M, [0.0; 2], size_m, 12.0, |x, y| {
        let beam = (x / beam_m).rem_euclid(1.0) * beam_m < 0.4;
        // Ducts run across the beams.
        let duct = duct_shade(y, seed);
        let shade = if beam { 0.55 } else { duct };
        tinted(rgb(168, 168, 164), shade * (0.85 + 0.2 * fractal(0.5 * x, 0.5 * y, seed)))
    })
}

/// Brightness across the ducts: dark gaps beside bright metal, at places that follow from the seed.
fn duct_shade(y: f32, seed: u32) -> f32 {
    let row = (y / 3.0).floor();
    let [at, width] = [1, 2].map(|what| white(row as i32, what, seed));
    let inside = (y - 3.0 * row - 2.0 * at).abs();
    let half_m = 0.15 + 0.25 * width;
    if inside < half_m {
        1.15
    } else if inside < half_m + 0.12 {
        0.6
    } else {
        0.9
    }
}

fn lamps(size_m: [f32; 2], random: &mut ChaCha8Rng) -> Vec<Lamp> {
    let half_m = pick(random, &[[0.9, 0.12], [0.35, 0.35], [0.12, 0.9]]);
    let (columns, rows) = (random.random_range(5..9), random.random_range(4..7));
    let mut lamps = Vec::with_capacity(columns * rows);
    for i in 0..columns {
        for j in 0..rows {
            let center_m = [(i, columns, size_m[0]), (j, rows, size_m[1])].map(|(k, count, length_m)| {
                length_m * (k as f32 + 0.5) / count as f32 + random.random_range(-0.4..0.4)
            });
            lamps.push(Lamp { center_m, half_m });
        }
    }
    lamps
}

/// Four walls, and the panes of their windows just before them.
fn walls(world: &mut World, size_m: [f32; 2], paint: Color, random: &mut ChaCha8Rng) {
    const THICK_M: f32 = 0.5;
    const PANE_M: f32 = 0.02;
    for side in [[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]] {
        let (across, along) = if side[0] == 0.0 { (1, 0) } else { (0, 1) };
        let (offset_m, inside_m) = (size_m[across], size_m[along]);
        let texture = wall(inside_m, paint, random);
        let texture = world.add_texture(texture);
        let place = |along_m: f32, out_m: f32| {
            let mut at_m = [0.5 * size_m[0] + side[0] * out_m, 0.5 * size_m[1] + side[1] * out_m];
            at_m[along] += along_m;
            at_m
        };
        let half_m = |along_m: f32, out_m: f32| if along == 0 { [along_m, out_m] } else { [out_m, along_m] };
        let wall_m = place(0.0, 0.5 * offset_m + THICK_M);
        let heights_m = [0.0, HEIGHT_M];
        world.blocks.push(Block::upright(wall_m, half_m(0.5 * inside_m, THICK_M), heights_m, [texture; 4], paint));
        if random.random_bool(0.7) {
            let (width_m, gap_m) = (random.random_range(1.2..3.5_f32), random.random_range(0.5..4.0));
            let (sill_m, top_m) = (random.random_range(2.4..3.2), random.random_range(4.2..5.2));
            let glass = world.add_texture(window(width_m, top_m - sill_m, random));
            world.panes.push(glass);
            let mut at_m = 1.5 - 0.5 * inside_m;
            while at_m + width_m + 1.0 < 0.5 * inside_m {
                let center_m = place(at_m + 0.5 * width_m, 0.5 * offset_m - PANE_M);
                let half_m = half_m(0.5 * width_m, PANE_M);
                world.blocks.push(Block::upright(center_m, half_m, [sill_m, top_m], [glass; 4], rgb(90, 90, 90)));
                at_m += width_m + gap_m;
            }
        }
    }
}

fn window(width_m: f32, height_m: f32, random: &mut ChaCha8Rng) -> Texture {
    let mut canvas = Canvas::new(width_m, height_m, TEXELS_PER_M, rgb(214, 226, 238));
    let frame = pick(random, &[rgb(70, 70, 74), rgb(170, 168, 160), rgb(96, 72, 52)]);
    let bars = random.random_range(1..4);
    for bar in 0..=bars {
        let at_m = bar as f32 * (width_m - 0.08) / bars as f32;
        canvas.rect([at_m, 0.0], [0.08, height_m], frame);
    }
    for bottom_m in [0.0, 0.6 * height_m, height_m - 0.08] {
        canvas.rect([0.0, bottom_m], [width_m, 0.08], frame);
    }
    canvas.into_texture()
}

fn wall(width_m: f32, paint: Color, random: &mut ChaCha8Rng) -> Texture {
    let mut canvas = Canvas::new(width_m, HEIGHT_M, TEXELS_PER_M, tinted(paint, random.random_range(0.85..1.1)));
    canvas.weather(random.random(), 2.0, 0.12, 0.02);
    if random.random_bool(0.5) {
        let color = bright(random);
        canvas.rect([0.0, random.random_range(0.0..1.2)], [width_m, random.random_range(0.2..1.0)], tinted(color, 0.8));
    }
    canvas.rect([0.0, 0.0], [width_m, 0.15], rgb(66, 62, 58));
    let mut at_m = random.random_range(0.3..2.0);
    while at_m + 3.0 < width_m {
        at_m += match random.random_range(0..6) {
            0 => {
                // A gate of two leaves.
                let leaf = bright(random);
                canvas.rect([at_m, 0.0], [2.4, 2.6], tinted(paint, 0.5));
                for left_m in [0.1, 1.25] {
                    canvas.rect([at_m + left_m, 0.0], [1.05, 2.45], tinted(leaf, 0.8));
                }
                canvas.rect([at_m + 0.6, 2.75], [1.2, 0.35], rgb(40, 140, 80));
                2.6
            }
            1..4 => {
                let size_m = [random.random_range(0.7_f32..2.8), random.random_range(0.6..1.4)];
                board(&mut canvas, [at_m, random.random_range(0.8..1.6)], size_m, BOARD_FRAME_M, random);
                size_m[0]
            }
            4 => {
                canvas.rect([at_m, 0.0], [0.25, HEIGHT_M], tinted(paint, 0.7));
                0.3
            }
            _ => 0.8,
        } + random.random_range(0.3..2.5);
    }
    canvas.into_texture()
}

/// Beside every other crossing of the aisles.
fn columns(world: &mut World, paint: Color, random: &mut ChaCha8Rng) {
    let half_m = random.random_range(0.2..0.35);
    let aside_m = 1.3;
    let textures: [u16; 3] = [0.0, 0.5, 1.0].map(|clad| {
        let mut canvas = Canvas::new(2.0 * half_m, HEIGHT_M, TEXELS_PER_M, tinted(paint, 0.8));
        canvas.weather(random.random(), 0.8, 0.12, 0.03);
        canvas.rect([0.0, 0.0], [1.0, 1.2 * clad], bright(random));
        if clad > 0.5 {
            canvas.rect([0.05, 1.5], [2.0 * half_m - 0.1, 0.5], bright(random));
        }
        world.add_texture(canvas.into_texture())
    });
    for i in (1..SQUARES[0]).step_by(2) {
        for j in (1..SQUARES[1]).step_by(2) {
            let center_m = [aisle_m(0, i) as f32 + aside_m, aisle_m(1, j) as f32 + aside_m];
            let sides = [0; 4].map(|_| pick(random, &textures));
            world.blocks.push(Block::upright(center_m, [half_m; 2], [0.0, HEIGHT_M], sides, paint));
        }
    }
}

/// Where something may stand between the aisles, and which way it lies.
#[derive(Clone, Copy)]
struct Square {
    middle_m: [f32; 2],
    /// A unit vector along an axis of the world.
    along: [f32; 2],
}

impl Square {
    /// `along_m` and, to the left of that, `aside_m` from the middle.
    fn place(&self, along_m: f32, aside_m: f32) -> [f32; 2] {
        let [x, y] = self.along;
        [self.middle_m[0] + along_m * x - aside_m * y, self.middle_m[1] + along_m * y + aside_m * x]
    }

    /// A block of this length and depth in the square; `front` is seen from the left and the right, `flank` at the ends.
    fn block(&self, at_m: [f32; 2], size_m: [f32; 2], heights_m: [f32; 2], sides: [u16; 2], lid: Color) -> Block {
        let [flank, front] = sides;
        let half_m = size_m.map(|length_m| 0.5 * length_m);
        let block = Block::upright(self.place(at_m[0], at_m[1]), half_m, heights_m, [flank, front, flank, front], lid);
        Block { direction: self.along, ..block }
    }
}

fn furnish(world: &mut World, square: Square, random: &mut ChaCha8Rng) {
    match random.random_range(0..10) {
        0..4 => stand(world, square, random),
        4 | 5 => shelves(world, square, random),
        6 | 7 => tables(world, square, random),
        8 => {
            let (size_m, top_m) = ([random.random_range(1.2..2.4), random.random_range(1.2..2.4)], 2.6);
            let (color, name) = (bright(random), bright(random));
            let sides = size_m.map(|width_m| {
                let mut canvas = Canvas::new(width_m, top_m, TEXELS_PER_M, color);
                canvas.rect([0.15, 1.0], [width_m - 0.3, 0.9], rgb(46, 52, 58));
                canvas.rect([0.1, 2.1], [width_m - 0.2, 0.4], name);
                world.add_texture(canvas.into_texture())
            });
            let block = square.block([0.0; 2], size_m, [0.0, top_m], [sides[1], sides[0]], tinted(color, 0.7));
            world.blocks.push(block);
        }
        _ => {}
    }
}

/// A wall with boards on it, a counter before it, and sometimes a sign above.
fn stand(world: &mut World, square: Square, random: &mut ChaCha8Rng) {
    let (long_m, top_m) = (random.random_range(2.4..LARGEST_M), random.random_range(2.1..3.0));
    let color = bright(random);
    let mut canvas = Canvas::new(long_m, top_m, TEXELS_PER_M, color);
    for _ in 0..random.random_range(1..4) {
        let size_m = [random.random_range(0.5..1.2), random.random_range(0.5..1.0)];
        let at_m = [random.random_range(0.1..long_m - size_m[0] - 0.1), random.random_range(0.5..top_m - size_m[1])];
        board(&mut canvas, at_m, size_m, BOARD_FRAME_M, random);
    }
    let (front, flank) = (world.add_texture(canvas.into_texture()), world.add_plain(tinted(color, 0.7)));
    world.blocks.push(square.block([0.0, 1.2], [long_m, 0.12], [0.0, top_m], [flank, front], color));
    let counter_m = random.random_range(1.0..long_m);
    let mut canvas = Canvas::new(counter_m, 1.0, TEXELS_PER_M, tinted(color, 0.85));
    board(&mut canvas, [0.1, 0.15], [counter_m - 0.2, 0.7], BOARD_FRAME_M, random);
    let front = world.add_texture(canvas.into_texture());
    let along_m = 0.5 * (long_m - counter_m) * pick(random, &[-1.0, 0.0, 1.0]);
    let counter = square.block([along_m, -0.7], [counter_m, 0.6], [0.0, 1.0], [flank, front], rgb(200, 196, 188));
    world.blocks.push(counter);
    if random.random_bool(0.5) {
        let cloth = world.add_plain(bright(random));
        let sign = square.block([0.0, 0.2], [long_m, 0.1], [3.0, 3.6], [cloth, cloth], color);
        world.blocks.push(sign);
    }
}

/// Two rows with an aisle between them, full of goods.
fn shelves(world: &mut World, square: Square, random: &mut ChaCha8Rng) {
    let (long_m, top_m) = (random.random_range(2.5..LARGEST_M), random.random_range(1.5..2.2));
    let steel = pick(random, &[rgb(90, 100, 110), rgb(150, 60, 40), rgb(60, 80, 140), rgb(150, 150, 146)]);
    let flank = world.add_plain(tinted(steel, 0.8));
    for aside_m in [-1.1, 1.1] {
        let mut canvas = Canvas::new(long_m, top_m, TEXELS_PER_M, rgb(44, 42, 40));
        let boards = (top_m / 0.45) as usize;
        for board in 0..boards {
            let bottom_m = 0.1 + 0.45 * board as f32;
            let mut at_m = 0.08;
            while at_m + 0.2 < long_m {
                let size_m = [random.random_range(0.12..0.6), random.random_range(0.15..0.36)];
                if random.random_bool(0.85) {
                    canvas.rect([at_m, bottom_m], size_m, bright(random));
                }
                at_m += size_m[0] + 0.03;
            }
            canvas.rect([0.0, bottom_m - 0.06], [long_m, 0.06], steel);
        }
        let front = world.add_texture(canvas.into_texture());
        world.blocks.push(square.block([0.0, aside_m], [long_m, 0.5], [0.0, top_m], [flank, front], steel));
    }
}

/// Tables and plants in no order.
fn tables(world: &mut World, square: Square, random: &mut ChaCha8Rng) {
    for (along_m, aside_m) in [(-1.3, -1.1), (1.3, -1.1), (-1.3, 1.1), (1.3, 1.1)] {
        let at_m = [along_m + random.random_range(-0.3..0.3), aside_m + random.random_range(-0.3..0.3)];
        let color = bright(random);
        if random.random_bool(0.25) {
            let seed: u32 = random.random();
            let mut canvas = Canvas::new(1.0, 1.9, TEXELS_PER_M, CLEAR);
            canvas.rect([0.3, 0.0], [0.4, 0.45], color);
            canvas.fill(|x, y, before| {
                let (dx, dy) = ((x - 0.5) / 0.48, (y - 1.15) / 0.7);
                let leaf = fractal(7.0 * x, 7.0 * y, seed);
                if dx * dx + dy * dy < 1.2 * leaf + 0.2 { tinted(rgb(58, 96, 44), 0.6 + 0.8 * leaf) } else { before }
            });
            let texture = world.add_texture(canvas.into_texture());
            let center_m = square.place(at_m[0], at_m[1]);
            world.uprights.push(Upright { center_m, half_width_m: 0.5, top_m: 1.9, texture });
        } else {
            let size_m = [random.random_range(0.8..1.6), random.random_range(0.6..0.9)];
            let cloth = world.add_plain(tinted(color, 0.8));
            world.blocks.push(square.block(at_m, size_m, [0.0, 0.76], [cloth, cloth], color));
        }
    }
}
