//! A corridor with doors, lamps, posters and furniture.

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

/// Width of the area that is driven through, and the free space to the walls beside and at the ends \[m\].
pub(super) const DRIVEN_WIDTH_M: f64 = 2.7;
const BESIDE_M: f32 = 0.95;
const BEYOND_M: f32 = 1.3;
const HEIGHT_M: f32 = 2.7;
const TEXELS_PER_M: f32 = 50.0;
/// Distance of the lines in which it is driven through.
const LINE_SPACING_M: f64 = 0.3;

pub(super) fn build(seed: u64, length_m: f64) -> World {
    let mut random = stream(seed, Stream::Layout);
    let (length, width) = (length_m as f32, DRIVEN_WIDTH_M as f32);
    let corner_m = [-BEYOND_M, -BESIDE_M];
    let size_m = [length + 2.0 * BEYOND_M, width + 2.0 * BESIDE_M];
    let mut world = World::empty(WorldKind::Corridor { length_m }, floor(corner_m, size_m, &mut random));

    let mut lamps = Vec::new();
    let mut at_m = random.random_range(0.3..1.2);
    while at_m < length {
        let center_m = [at_m, 0.5 * width + random.random_range(-0.3..0.3)];
        lamps.push(Lamp { center_m, half_m: pick(&mut random, &[[0.6, 0.15], [0.3, 0.3], [0.15, 0.6]]) });
        at_m += random.random_range(1.8..3.2);
    }
    world.ceiling = Some(ceiling(corner_m, size_m, &lamps, &mut random));
    world.lamps = lamps;

    let paint = pick(&mut random, &[rgb(196, 192, 180), rgb(186, 196, 200), rgb(204, 196, 170), rgb(190, 182, 190)]);
    let dado = random.random_bool(0.5).then(|| bright(&mut random));
    let [middle_x, middle_y] = [corner_m[0] + 0.5 * size_m[0], corner_m[1] + 0.5 * size_m[1]];
    // Four thick walls around the room; only the inner sides are seen.
    const THICK_M: f32 = 0.5;
    for (side, offset, inside) in [
        ([1.0, 0.0], size_m[0], size_m[1]),
        ([0.0, 1.0], size_m[1], size_m[0]),
        ([-1.0, 0.0], size_m[0], size_m[1]),
        ([0.0, -1.0], size_m[1], size_m[0]),
    ] {
        let texture = wall(inside, paint, dado, &mut random);
        let texture = world.add_texture(texture);
        let out_m = 0.5 * offset + THICK_M;
        let center_m = [middle_x + side[0] * out_m, middle_y + side[1] * out_m];
        let half_m = if side[0] == 0.0 { [0.5 * inside, THICK_M] } else { [THICK_M, 0.5 * inside] };
        world.blocks.push(Block::upright(center_m, half_m, [0.0, HEIGHT_M], [texture; 4], paint));
    }
    furnish(&mut world, corner_m, size_m, &mut random);
    world
}

/// Up and down in parallel lines, and back along the end.
pub(super) fn route(length_m: f64, shift_m: f64) -> Vec<Corner> {
    let lines = (DRIVEN_WIDTH_M / LINE_SPACING_M).round() as usize / 2 * 2 + 2;
    let spacing_m = DRIVEN_WIDTH_M / (lines - 1) as f64;
    let radius_m = 0.5 * spacing_m;
    let mut corners: Vec<Corner> = (0..lines)
        .flat_map(|line| {
            let y_m = line as f64 * spacing_m - shift_m;
            let ends_m = if line % 2 == 0 { [0.0, length_m] } else { [length_m, 0.0] };
            ends_m.map(|x_m| Corner { at_m: [x_m, y_m], radius_m })
        })
        .collect();
    // The first and the last line reach out to the way back.
    for corner in [0, 2 * lines - 1] {
        corners[corner] = Corner { at_m: [-0.4, corners[corner].at_m[1]], radius_m: 0.35 };
    }
    corners
}

fn floor(corner_m: [f32; 2], size_m: [f32; 2], random: &mut ChaCha8Rng) -> Plane {
    let (seed, tile_m): (u32, f32) = (random.random(), random.random_range(0.3..0.6));
    let color = pick(random, &[rgb(150, 140, 124), rgb(120, 124, 128), rgb(160, 146, 118), rgb(130, 112, 96)]);
    Plane::painted(0.0, corner_m, size_m, TEXELS_PER_M, |x, y| {
        let tile = white((x / tile_m).floor() as i32, (y / tile_m).floor() as i32, seed);
        let joint = |at: f32| (at / tile_m).rem_euclid(1.0) < 0.05;
        let dark = if joint(x) || joint(y) { 0.75 } else { 1.0 };
        tinted(color, dark * (0.8 + 0.2 * tile + 0.2 * fractal(3.0 * x, 3.0 * y, seed ^ 1)))
    })
}

fn ceiling(corner_m: [f32; 2], size_m: [f32; 2], lamps: &[Lamp], random: &mut ChaCha8Rng) -> Plane {
    let seed: u32 = random.random();
    Plane::painted(HEIGHT_M, corner_m, size_m, 25.0, |x, y| {
        let joint = |at: f32| (at / 0.6).rem_euclid(1.0) < 0.07;
        let stain = fractal(x, y, seed);
        // The ceiling is brighter around a lamp.
        let glow: f32 = lamps.iter().map(|lamp| 0.25 / (1.0 + distance_squared(lamp, x, y))).sum();
        let tile = if joint(x) || joint(y) { 0.8 } else { 0.92 + 0.12 * stain };
        tinted(rgb(150, 150, 146), tile * (0.8 + glow).min(1.2))
    })
}

/// From the lamp's edge \[m²\].
pub(super) fn distance_squared(lamp: &Lamp, x: f32, y: f32) -> f32 {
    let beyond = |at: f32, axis: usize| ((at - lamp.center_m[axis]).abs() - lamp.half_m[axis]).max(0.0);
    beyond(x, 0).powi(2) + beyond(y, 1).powi(2)
}

fn wall(width_m: f32, paint: Color, dado: Option<Color>, random: &mut ChaCha8Rng) -> Texture {
    let mut canvas = Canvas::new(width_m, HEIGHT_M, TEXELS_PER_M, tinted(paint, random.random_range(0.9..1.08)));
    canvas.weather(random.random(), 0.9, 0.07, 0.02);
    if let Some(color) = dado {
        canvas.rect([0.0, 0.0], [width_m, 0.9], tinted(color, 0.9));
        canvas.rect([0.0, 0.9], [width_m, 0.06], tinted(color, 0.6));
    }
    canvas.rect([0.0, 0.0], [width_m, 0.1], rgb(70, 64, 58));
    let mut at_m = random.random_range(0.1..0.7);
    while at_m + 0.5 < width_m {
        let left_m = width_m - at_m;
        at_m += match random.random_range(0..8) {
            0..3 if left_m > 1.2 => {
                let leaf = bright(random);
                canvas.rect([at_m, 0.0], [1.06, 2.14], tinted(paint, 0.55));
                canvas.rect([at_m + 0.08, 0.0], [0.9, 2.06], leaf);
                if random.random_bool(0.4) {
                    canvas.rect([at_m + 0.32, 1.15], [0.42, 0.7], rgb(60, 76, 84));
                }
                canvas.rect([at_m + 0.16, 1.0], [0.12, 0.05], rgb(225, 225, 225));
                canvas.rect([at_m + 1.15, 1.5], [0.16, 0.1], rgb(230, 230, 220));
                1.4
            }
            3..6 => {
                let size_m = [random.random_range(0.3_f32..1.1).min(left_m), random.random_range(0.4..0.9)];
                board(&mut canvas, [at_m, random.random_range(1.0..1.5)], size_m, 0.03, random);
                size_m[0] + 0.1
            }
            6 => {
                // A pipe or a cable duct.
                canvas.rect([at_m, 0.0], [0.08, HEIGHT_M], tinted(paint, 0.7));
                0.2
            }
            _ => 0.4,
        } + random.random_range(0.1..0.9);
    }
    canvas.into_texture()
}

/// Cupboards, benches, bins and plants along the walls.
fn furnish(world: &mut World, corner_m: [f32; 2], size_m: [f32; 2], random: &mut ChaCha8Rng) {
    for near_side in [true, false] {
        let mut at_m = corner_m[0] + 0.1;
        while at_m + 1.5 < corner_m[0] + size_m[0] {
            let (long_m, deep_m) = (random.random_range(0.4_f32..1.3), random.random_range(0.25..0.45));
            let out_m = if near_side { corner_m[1] + 0.5 * deep_m } else { corner_m[1] + size_m[1] - 0.5 * deep_m };
            let center_m = [at_m + 0.5 * long_m, out_m];
            match random.random_range(0..10) {
                0..3 => {
                    let (color, top_m) = (bright(random), pick(random, &[0.45, 0.8, 1.0, 1.8, 2.0]));
                    let front = world.add_texture(cupboard(long_m, top_m, color, random));
                    let flank = world.add_plain(tinted(color, 0.8));
                    let sides = [flank, front, flank, front];
                    world.blocks.push(Block::upright(
                        center_m,
                        [0.5 * long_m, 0.5 * deep_m],
                        [0.0, top_m],
                        sides,
                        color,
                    ));
                }
                3 => {
                    let texture = world.add_texture(plant(random));
                    world.uprights.push(Upright { center_m, half_width_m: 0.35, top_m: 1.4, texture });
                }
                4 => {
                    let color = bright(random);
                    let sides = [world.add_plain(tinted(color, 0.8)); 4];
                    world.blocks.push(Block::upright(center_m, [0.16, 0.16], [0.0, 0.6], sides, tinted(color, 0.3)));
                }
                _ => {}
            }
            at_m += long_m + random.random_range(0.2..1.2);
        }
    }
}

fn cupboard(width_m: f32, height_m: f32, color: Color, random: &mut ChaCha8Rng) -> Texture {
    let mut canvas = Canvas::new(width_m, height_m, TEXELS_PER_M, color);
    let rows = (height_m / 0.4).round().max(1.0);
    for row in 0..rows as usize {
        let (bottom_m, leaf) = (row as f32 * height_m / rows, random.random_range(0.65..1.1));
        canvas.rect([0.03, bottom_m + 0.03], [width_m - 0.06, height_m / rows - 0.05], tinted(color, leaf));
        canvas.rect([0.5 * width_m - 0.06, bottom_m + 0.5 * height_m / rows], [0.12, 0.04], rgb(210, 210, 205));
    }
    canvas.into_texture()
}

fn plant(random: &mut ChaCha8Rng) -> Texture {
    let seed: u32 = random.random();
    let mut canvas = Canvas::new(0.7, 1.4, 40.0, CLEAR);
    canvas.rect([0.2, 0.0], [0.3, 0.35], bright(random));
    canvas.fill(|x, y, before| {
        let (dx, dy) = ((x - 0.35) / 0.33, (y - 0.85) / 0.5);
        let leaf = fractal(9.0 * x, 9.0 * y, seed);
        if dx * dx + dy * dy < 1.2 * leaf + 0.2 { tinted(rgb(58, 96, 44), 0.6 + 0.8 * leaf) } else { before }
    });
    canvas.into_texture()
}
