//! A block of houses with streets around it, and what can be seen from them.

use rand::Rng;
use rand_chacha::ChaCha8Rng;

use super::{
    Parking, World, WorldKind,
    paint::{HouseStyle, bright, pick, pole, tree},
    path::Corner,
    random::{Stream, fractal, smooth, stream, white},
    scene::{Block, Plane, Upright},
    texture::{Color, rgb, tinted},
};
use crate::types::PositionM;

/// From the middle of a street to the kerb and to the line of the facades \[m\].
const KERB_M: f32 = 5.5;
const FACADES_M: f32 = 8.2;
/// From the middle of a street to the middle of a lane.
pub(super) const LANE_M: f64 = 1.75;
/// From the middle of a street to the middle of the parked cars and of the walkers.
const PARKING_M: f32 = 4.45;
pub(super) const WALK_M: f64 = 7.1;
/// How far the side streets go on beyond the facade line.
const SIDE_STREET_M: f32 = 42.0;
/// Where the vehicle turns in a side street, from the middle of the crossing.
const TURNING_M: f64 = 40.0;
const HOUSE_DEPTH_M: f32 = 10.0;
const GROUND_TEXELS_PER_M: f32 = 6.0;

/// The middle lines of the two streets each way.
#[derive(Debug, Clone, Copy)]
pub(super) struct Streets {
    pub x_m: [f32; 2],
    pub y_m: [f32; 2],
}

impl Streets {
    /// The crossings, counter-clockwise from the south-west, moved by `outwards_m` from the middle of the block.
    pub fn ring(&self, outwards_m: f64) -> [PositionM; 4] {
        let [west, east] = self.x_m.map(f64::from);
        let [south, north] = self.y_m.map(f64::from);
        let o = outwards_m;
        [[west - o, south - o], [east + o, south - o], [east + o, north + o], [west - o, north + o]]
    }

    /// Round the block counter-clockwise, south and back, round it clockwise, west and back: keeping to the right by
    /// `lane_m`.
    pub fn route(&self, laps: u32, lane_m: f64) -> Vec<Corner> {
        let [south_west, south_east, north_east, north_west] = self.ring(0.0);
        let south_end = [south_west[0], south_west[1] - TURNING_M];
        let west_end = [south_west[0] - TURNING_M, south_west[1]];
        let mut stations = Vec::new();
        (0..laps).for_each(|_| stations.extend([south_east, north_east, north_west, south_west]));
        stations.push(south_end);
        (0..laps).for_each(|lap| {
            stations.extend(if lap == 0 { None } else { Some(south_west) });
            stations.extend([north_west, north_east, south_east]);
        });
        stations.push(west_end);
        // The south-west crossing lies on the way from the south end to the north, and from the west end to the east.
        keeping_right(&stations, lane_m)
    }

    fn extent_m(&self) -> ([f32; 2], [f32; 2]) {
        let beyond_m = FACADES_M + SIDE_STREET_M + 8.0;
        let corner_m = [self.x_m[0] - beyond_m, self.y_m[0] - beyond_m];
        (corner_m, [self.x_m[1] + beyond_m - corner_m[0], self.y_m[1] + beyond_m - corner_m[1]])
    }
}

/// The lane to the right of a closed way along street middles. Where the way goes back on itself, it turns in a wide
/// loop.
fn keeping_right(stations: &[PositionM], lane_m: f64) -> Vec<Corner> {
    const RIGHT_TURN_M: f64 = 6.0;
    const LEFT_TURN_M: f64 = 9.0;
    const TURNING_LOOP_M: f64 = 4.0;
    let n = stations.len();
    let mut corners = Vec::new();
    for i in 0..n {
        let (before, at, after) = (stations[(i + n - 1) % n], stations[i], stations[(i + 1) % n]);
        let direction = |a: PositionM, b: PositionM| {
            let length = (b[0] - a[0]).hypot(b[1] - a[1]);
            [(b[0] - a[0]) / length, (b[1] - a[1]) / length]
        };
        let (into, out) = (direction(before, at), direction(at, after));
        let (turn, along) = (into[0] * out[1] - into[1] * out[0], into[0] * out[0] + into[1] * out[1]);
        // Along the way in, to its right.
        let place = |on_m: f64, right_m: f64| {
            [at[0] + on_m * into[0] + right_m * into[1], at[1] + on_m * into[1] - right_m * into[0]]
        };
        if along < -0.5 {
            let wide_m = TURNING_LOOP_M;
            corners.extend(
                [(-14.0, lane_m), (-7.0, wide_m), (0.0, wide_m), (0.0, -wide_m), (-7.0, -wide_m), (-14.0, -lane_m)]
                    .map(|(on_m, right_m)| Corner { at_m: place(on_m, right_m), radius_m: TURNING_LOOP_M }),
            );
        } else if turn.abs() > 0.5 {
            let radius_m = if turn > 0.0 { LEFT_TURN_M } else { RIGHT_TURN_M };
            corners.push(Corner { at_m: place(turn.signum() * lane_m, lane_m), radius_m });
        }
    }
    corners
}

/// A side of a sector along a street: houses stand on it.
struct Frontage {
    start_m: [f32; 2],
    /// Unit vectors along the street and away from it.
    along: [f32; 2],
    inwards: [f32; 2],
    length_m: f32,
}

pub(super) fn build(seed: u64) -> World {
    let mut random = stream(seed, Stream::Layout);
    let streets = Streets { x_m: [0.0, random.random_range(58.0..66.0)], y_m: [0.0, random.random_range(84.0..94.0)] };
    let ground = ground(&streets, seed);
    let mut world = World::empty(WorldKind::Town(streets), ground);
    for frontage in frontages(&streets) {
        line_with_houses(&mut world, &frontage, &mut random);
    }
    close_side_streets(&mut world, &streets, &mut random);
    let trees: Vec<(u16, f32)> = (0..7)
        .map(|_| {
            let size_m = random.random_range(4.5..7.5);
            (world.add_texture(tree(&mut random, size_m)), size_m)
        })
        .collect();
    world.trees = trees.iter().map(|&(texture, _)| texture).collect();
    for row in kerbs(&streets) {
        furnish(&mut world, &row, &trees, &mut random);
    }
    world
}

fn frontages(streets: &Streets) -> Vec<Frontage> {
    let sectors = |[low, high]: [f32; 2]| {
        [
            [low - FACADES_M - SIDE_STREET_M, low - FACADES_M],
            [low + FACADES_M, high - FACADES_M],
            [high + FACADES_M, high + FACADES_M + SIDE_STREET_M],
        ]
    };
    let mut frontages = Vec::new();
    for (column, [west, east]) in sectors(streets.x_m).into_iter().enumerate() {
        for (row, [south, north]) in sectors(streets.y_m).into_iter().enumerate() {
            // The first sector has no street before it, the last none behind it.
            let [in_west, in_south] = [column > 0, row > 0];
            let [in_east, in_north] = [column < 2, row < 2];
            let mut add = |there: bool, start_m: [f32; 2], along: [f32; 2], length_m: f32| {
                if there {
                    frontages.push(Frontage { start_m, along, inwards: [-along[1], along[0]], length_m });
                }
            };
            add(in_south, [west, south], [1.0, 0.0], east - west);
            add(in_north, [east, north], [-1.0, 0.0], east - west);
            // Houses at the ends of the other two stand in the way.
            let (trim_south, trim_north) =
                (if in_south { HOUSE_DEPTH_M } else { 0.0 }, if in_north { HOUSE_DEPTH_M } else { 0.0 });
            let length_m = north - south - trim_south - trim_north;
            add(in_east, [east, south + trim_south], [0.0, 1.0], length_m);
            add(in_west, [west, north - trim_north], [0.0, -1.0], length_m);
        }
    }
    frontages
}

fn line_with_houses(world: &mut World, frontage: &Frontage, random: &mut ChaCha8Rng) {
    const NARROWEST_M: f32 = 6.5;
    let mut from_m = 0.0;
    while frontage.length_m - from_m > 2.0 {
        let left_m = frontage.length_m - from_m;
        if from_m > 0.0 && left_m > 20.0 && random.random_bool(0.14) {
            from_m += random.random_range(2.0..6.0);
            continue;
        }
        let mut width_m = random.random_range(8.0_f32..19.0);
        if left_m - width_m < NARROWEST_M {
            width_m = left_m;
        }
        house(world, frontage, from_m, width_m, random);
        from_m += width_m;
    }
}

fn house(world: &mut World, frontage: &Frontage, from_m: f32, width_m: f32, random: &mut ChaCha8Rng) {
    let Frontage { start_m, along, inwards, .. } = frontage;
    let setback_m = if random.random_bool(0.6) { 0.0 } else { random.random_range(0.4..2.6) };
    let depth_m = HOUSE_DEPTH_M - setback_m;
    let height_m = random.random_range(4.0_f32..13.0);
    let place = |on_m: f32, in_m: f32| [0, 1].map(|axis| start_m[axis] + on_m * along[axis] + in_m * inwards[axis]);
    let style = HouseStyle::random(random);
    let front = world.add_texture(style.front(width_m, height_m, random));
    let flank = world.add_texture(style.flank(depth_m, height_m, random));
    let half_m =
        |along_m: f32, in_m: f32| [0, 1].map(|axis| 0.5 * (along_m * along[axis] + in_m * inwards[axis]).abs());
    let mut sides = [flank; 4];
    sides[facing([-inwards[0], -inwards[1]])] = front;
    world.blocks.push(Block::upright(
        place(from_m + 0.5 * width_m, setback_m + 0.5 * depth_m),
        half_m(width_m, depth_m),
        [0.0, height_m],
        sides,
        style.roof(),
    ));
    if random.random_bool(0.25) && height_m > 4.5 && width_m > 7.0 {
        // An awning over the pavement.
        let (long_m, color) = (random.random_range(3.0..(width_m - 2.0)), bright(random));
        let cloth = world.add_plain(color);
        let at_m = from_m + 0.5 * long_m + random.random_range(1.0..(width_m - long_m - 0.5));
        world.blocks.push(Block::upright(
            place(at_m, setback_m - 0.6),
            half_m(long_m, 1.2),
            [2.75, 3.15],
            [cloth; 4],
            tinted(color, 0.6),
        ));
    }
}

/// The side that faces this way, which is along an axis.
fn facing([x, y]: [f32; 2]) -> usize {
    match (x > 0.5, y > 0.5, x < -0.5) {
        (true, _, _) => 0,
        (_, true, _) => 1,
        (_, _, true) => 2,
        _ => 3,
    }
}

/// A house across the end of every side street.
fn close_side_streets(world: &mut World, streets: &Streets, random: &mut ChaCha8Rng) {
    let end_m = FACADES_M + SIDE_STREET_M;
    let [west, east] = streets.x_m;
    let [south, north] = streets.y_m;
    let across = 2.0 * FACADES_M;
    let mut close = |start_m: [f32; 2], along: [f32; 2]| {
        let frontage = Frontage { start_m, along, inwards: [-along[1], along[0]], length_m: across };
        house(world, &frontage, 0.0, across, random);
    };
    for x in streets.x_m {
        close([x + FACADES_M, south - end_m], [-1.0, 0.0]);
        close([x - FACADES_M, north + end_m], [1.0, 0.0]);
    }
    for y in streets.y_m {
        close([west - end_m, y - FACADES_M], [0.0, 1.0]);
        close([east + end_m, y + FACADES_M], [0.0, -1.0]);
    }
}

/// One side of one street between two crossings, or of a side street.
struct Kerb {
    /// On the middle line.
    start_m: [f32; 2],
    along: [f32; 2],
    /// From the middle line to this kerb.
    outwards: [f32; 2],
    length_m: f32,
    side_street: bool,
}

fn kerbs(streets: &Streets) -> Vec<Kerb> {
    let mut kerbs = Vec::new();
    let mut add = |start_m: [f32; 2], along: [f32; 2], length_m: f32, side_street: bool| {
        for sign in [-1.0, 1.0] {
            let outwards = [-sign * along[1], sign * along[0]];
            kerbs.push(Kerb { start_m, along, outwards, length_m, side_street });
        }
    };
    let [west, east] = streets.x_m;
    let [south, north] = streets.y_m;
    let side_m = SIDE_STREET_M + FACADES_M;
    for x in streets.x_m {
        add([x, south], [0.0, 1.0], north - south, false);
        add([x, south], [0.0, -1.0], side_m, true);
        add([x, north], [0.0, 1.0], side_m, true);
    }
    for y in streets.y_m {
        add([west, y], [1.0, 0.0], east - west, false);
        add([west, y], [-1.0, 0.0], side_m, true);
        add([east, y], [1.0, 0.0], side_m, true);
    }
    kerbs
}

/// Trees, lamps, signs and boxes on the pavement, and places to park.
fn furnish(world: &mut World, kerb: &Kerb, trees: &[(u16, f32)], random: &mut ChaCha8Rng) {
    let place = |on_m: f32, out_m: f32| {
        [0, 1].map(|axis| kerb.start_m[axis] + on_m * kerb.along[axis] + out_m * kerb.outwards[axis])
    };
    let end_m = kerb.length_m - if kerb.side_street { 3.0 } else { 10.0 };
    let mut at_m = 10.0 + random.random_range(0.0..6.0);
    let leafy = random.random_bool(0.6);
    while at_m < end_m {
        let center_m = place(at_m, KERB_M + 0.7);
        match random.random_range(0..10) {
            0..5 if leafy => {
                let (texture, size_m) = pick(random, trees);
                world.uprights.push(Upright { center_m, half_width_m: 0.5 * size_m, top_m: size_m, texture });
            }
            5 | 6 => {
                let (width_m, height_m) = (0.9, random.random_range(5.0..7.0));
                let texture = world.add_texture(pole(random, width_m, height_m));
                world.uprights.push(Upright { center_m, half_width_m: 0.5 * width_m, top_m: height_m, texture });
            }
            7 => {
                let (width_m, height_m) = (0.8, random.random_range(2.3..3.2));
                let texture = world.add_texture(pole(random, width_m, height_m));
                world.uprights.push(Upright { center_m, half_width_m: 0.5 * width_m, top_m: height_m, texture });
            }
            8 => {
                let color = bright(random);
                let (half_m, top_m) = (random.random_range(0.25..0.8), random.random_range(0.9..2.4));
                let sides = [world.add_plain(tinted(color, 0.8)); 4];
                world.blocks.push(Block::upright(center_m, [half_m, half_m], [0.0, top_m], sides, color));
            }
            _ => {}
        }
        at_m += random.random_range(5.0..11.0);
    }
    // The turning places at the ends of the side streets stay free.
    let last_m = kerb.length_m - if kerb.side_street { 26.0 } else { 15.0 };
    let mut at_m = 15.0;
    while at_m < last_m {
        let center_m = place(at_m, PARKING_M);
        world.parking.push(Parking { center_m, direction: kerb.along });
        at_m += 5.8;
    }
}

/// Asphalt with markings, pavement of slabs, and yards behind the facade line.
fn ground(streets: &Streets, seed: u64) -> Plane {
    let noise: u32 = stream(seed, Stream::Ground).random();
    let (corner_m, size_m) = streets.extent_m();
    Plane::painted(0.0, corner_m, size_m, GROUND_TEXELS_PER_M, |x, y| ground_color(streets, noise, x, y))
}

fn ground_color(streets: &Streets, noise: u32, x: f32, y: f32) -> Color {
    let nearest =
        |at: f32, [low, high]: [f32; 2]| if (at - low).abs() < (at - high).abs() { at - low } else { at - high };
    let (dx, dy) = (nearest(x, streets.x_m), nearest(y, streets.y_m));
    let (across, along) = if dx.abs() < dy.abs() { (dx, dy.abs()) } else { (dy, dx.abs()) };
    let grain = 0.94 + 0.12 * white((x * GROUND_TEXELS_PER_M) as i32, (y * GROUND_TEXELS_PER_M) as i32, noise);
    if across.abs() >= FACADES_M {
        let grass = fractal(0.7 * x, 0.7 * y, noise ^ 11);
        return tinted(rgb(74, 96, 50), grain * (0.7 + 0.6 * grass));
    }
    if across.abs() >= KERB_M {
        if across.abs() < KERB_M + 0.2 {
            return tinted(rgb(168, 166, 160), grain);
        }
        let slab = white((x / 0.75).floor() as i32, (y / 0.75).floor() as i32, noise ^ 5);
        let joint = if (x / 0.75).fract().abs() < 0.2 || (y / 0.75).fract().abs() < 0.2 { 0.8 } else { 1.0 };
        let stain = fractal(0.25 * x, 0.25 * y, noise ^ 6);
        return tinted(rgb(146, 138, 128), grain * joint * (0.75 + 0.2 * slab + 0.3 * stain));
    }
    let crossing = along < KERB_M;
    let marked = if crossing {
        false
    } else if (8.5..11.5).contains(&along) {
        // A zebra crossing.
        (across / 1.0).rem_euclid(1.0) < 0.5 && across.abs() < 5.0
    } else {
        (across.abs() < 0.09 && along > 12.5 && (along / 7.0).fract() < 0.45)
            || ((3.35..3.5).contains(&across.abs()) && along > 13.0)
    };
    if marked {
        return tinted(rgb(208, 206, 198), grain * (0.75 + 0.3 * fractal(x, y, noise ^ 8)));
    }
    // Patches that were mended stand out.
    let patch = if smooth(0.13 * x, 0.21 * y, noise ^ 2) > 0.72 { 0.8 } else { 1.0 };
    tinted(rgb(92, 92, 94), grain * patch * (0.75 + 0.5 * fractal(0.35 * x, 0.35 * y, noise ^ 1)))
}
