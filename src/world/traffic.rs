//! Cars and people: where they are at any instant of a day.

use std::sync::Arc;

use rand::Rng;
use rand_chacha::ChaCha8Rng;

use super::{
    Day, World, WorldKind,
    corridor::DRIVEN_WIDTH_M,
    hall,
    paint::{PERSON_M, bright, car_body, car_cabin, car_end, person, pick},
    path::{Corner, Path, Smoothing},
    random::{Stream, stream},
    scene::{Block, Upright},
    texture::{Color, Texture, rgb, tinted},
    town::{LANE_M, WALK_M},
};

/// Cars and people nearer than this gave way \[m\].
const CAR_GIVES_WAY_M: f32 = 5.5;
const PERSON_GIVES_WAY_M: f32 = 0.7;
/// Different looks of cars and of people.
const CAR_LOOKS: usize = 16;
const PERSON_LOOKS: usize = 10;

/// How a car looks.
#[derive(Debug, Clone, Copy)]
struct CarLook {
    half_m: [f32; 2],
    body_top_m: f32,
    /// Absent on a van.
    cabin: Option<Cabin>,
    sides: [u16; 4],
    paint: Color,
}

#[derive(Debug, Clone, Copy)]
struct Cabin {
    half_m: [f32; 2],
    top_m: f32,
    side: u16,
}

/// Textures that are shared, and those of the day beside them.
pub(super) type Textures = Vec<Arc<Texture>>;

fn add(textures: &mut Textures, texture: Texture) -> u16 {
    textures.push(Arc::new(texture));
    u16::try_from(textures.len() - 1).expect("a scene has far fewer than 65536 textures")
}

impl CarLook {
    fn random(textures: &mut Textures, random: &mut ChaCha8Rng) -> Self {
        let gray = tinted(rgb(160, 162, 166), random.random_range(0.2..1.4));
        let paint = if random.random_bool(0.6) { gray } else { bright(random) };
        let half_m = [random.random_range(1.9..2.35), random.random_range(0.84..0.93)];
        let van = random.random_bool(0.15);
        let body_top_m = if van { random.random_range(1.9..2.5) } else { random.random_range(0.78..0.95) };
        let side = add(textures, car_body(paint, 2.0 * half_m[0], body_top_m));
        let front = add(textures, car_end(paint, 2.0 * half_m[1], body_top_m, rgb(250, 248, 230)));
        let back = add(textures, car_end(paint, 2.0 * half_m[1], body_top_m, rgb(190, 30, 26)));
        let cabin = (!van).then(|| {
            let cabin_m = [half_m[0] * random.random_range(0.48..0.62), half_m[1] - 0.09];
            let top_m = body_top_m + random.random_range(0.5..0.68);
            Cabin {
                half_m: cabin_m,
                top_m,
                side: add(textures, car_cabin(paint, 2.0 * cabin_m[0], top_m - body_top_m)),
            }
        });
        Self { half_m, body_top_m, cabin, sides: [front, side, back, side], paint }
    }

    /// Body and cabin of a car at this place, heading this way.
    fn placed(&self, center_m: [f32; 2], direction: [f32; 2]) -> impl Iterator<Item = Block> {
        let body = Block {
            direction,
            ..Block::upright(center_m, self.half_m, [0.0, self.body_top_m], self.sides, tinted(self.paint, 0.9))
        };
        let cabin = self.cabin.map(|cabin| {
            let back_m = 0.12 * self.half_m[0];
            let center_m = [center_m[0] - back_m * direction[0], center_m[1] - back_m * direction[1]];
            let heights_m = [self.body_top_m, cabin.top_m];
            Block { direction, ..Block::upright(center_m, cabin.half_m, heights_m, [cabin.side; 4], self.paint) }
        });
        std::iter::once(body).chain(cabin)
    }
}

/// Something that goes along a path for ever.
#[derive(Debug, Clone, Copy)]
struct Goer {
    path: usize,
    look: usize,
    start_m: f64,
    /// Negative: against the direction of the path.
    speed_mps: f64,
    aside_m: f64,
}

/// All that moves on one day.
#[derive(Debug, Clone)]
pub(super) struct Traffic {
    looks: Vec<CarLook>,
    people: Vec<u16>,
    paths: Vec<Path>,
    cars: Vec<Goer>,
    walkers: Vec<Goer>,
}

impl Traffic {
    /// Adds the textures of the day's cars and people to `textures`.
    pub fn new(world: &World, day: &Day, textures: &mut Textures) -> Self {
        let mut random = stream(day.seed, Stream::Traffic);
        let looks: Vec<CarLook> = match world.kind {
            WorldKind::Town(_) => (0..CAR_LOOKS).map(|_| CarLook::random(textures, &mut random)).collect(),
            WorldKind::Corridor { .. } | WorldKind::Hall => Vec::new(),
        };
        let paths: Vec<Path> = match &world.kind {
            WorldKind::Town(streets) => [(LANE_M, 9.0), (-LANE_M, 6.0), (WALK_M, 2.0), (-WALK_M, 2.0)]
                .map(|(outwards_m, radius_m)| path(&streets.ring(outwards_m), radius_m))
                .into(),
            WorldKind::Corridor { length_m } => {
                let (near_m, far_m) = (0.0, DRIVEN_WIDTH_M);
                vec![path(&[[0.0, near_m], [*length_m, near_m], [*length_m, far_m], [0.0, far_m]], 0.5)]
            }
            WorldKind::Hall => vec![through(&hall::route(0.0))],
        };
        let mut cars = Vec::new();
        if world.is_outdoors() {
            for lane in [0, 1] {
                // Counter-clockwise outside, clockwise inside.
                let (length_m, speed_mps) = (paths[lane].length_m(), random.random_range(5.0..8.5));
                cars.extend((0..day.moving_cars).map(|_| Goer {
                    path: lane,
                    look: random.random_range(0..looks.len()),
                    start_m: random.random_range(0.0..length_m),
                    speed_mps: if lane == 0 { speed_mps } else { -speed_mps },
                    aside_m: 0.0,
                }));
            }
        }

        let mut random = stream(day.seed, Stream::People);
        let people: Vec<u16> = (0..PERSON_LOOKS).map(|_| add(textures, person(&mut random))).collect();
        let walks = if world.is_outdoors() { 2..4 } else { 0..1 };
        let count = match world.kind {
            WorldKind::Town(_) | WorldKind::Hall => day.people,
            // Four people in a short corridor are a crowd.
            WorldKind::Corridor { .. } => day.people.div_ceil(8),
        };
        let walkers = (0..count)
            .map(|_| {
                let path = random.random_range(walks.clone());
                Goer {
                    path,
                    look: random.random_range(0..people.len()),
                    start_m: random.random_range(0.0..paths[path].length_m()),
                    speed_mps: random.random_range(0.7..1.6) * pick(&mut random, &[-1.0, 1.0]),
                    aside_m: random.random_range(-0.6..0.6),
                }
            })
            .collect();
        Self { looks, people, paths, cars, walkers }
    }

    /// The cars that stand at the kerbs today.
    pub fn parked(&self, world: &World, day: &Day) -> Vec<Block> {
        let mut random = stream(day.seed, Stream::Parked);
        let mut blocks = Vec::new();
        for place in &world.parking {
            let (taken, turned) = (random.random::<f64>() < day.parked_share, random.random_bool(0.2));
            let (look, on_m) = (random.random_range(0..self.looks.len()), random.random_range(-0.4..0.4));
            if taken {
                let [x, y] = place.direction;
                let center_m = [place.center_m[0] + on_m * x, place.center_m[1] + on_m * y];
                let sign = if turned { -1.0 } else { 1.0 };
                blocks.extend(self.looks[look].placed(center_m, [sign * x, sign * y]));
            }
        }
        blocks
    }

    /// Adds what moves, as it is at `time_s` around a camera at `eye_m`.
    pub fn at(&self, time_s: f64, eye_m: [f32; 2], blocks: &mut Vec<Block>, uprights: &mut Vec<Upright>) {
        for car in &self.cars {
            let (center_m, direction) = self.place(car, time_s);
            if far(center_m, eye_m, CAR_GIVES_WAY_M) {
                blocks.extend(self.looks[car.look].placed(center_m, direction));
            }
        }
        for walker in &self.walkers {
            let (center_m, _) = self.place(walker, time_s);
            if far(center_m, eye_m, PERSON_GIVES_WAY_M) {
                let [width_m, top_m] = PERSON_M;
                let texture = self.people[walker.look];
                uprights.push(Upright { center_m, half_width_m: 0.5 * width_m, top_m, texture });
            }
        }
    }

    fn place(&self, goer: &Goer, time_s: f64) -> ([f32; 2], [f32; 2]) {
        let point = self.paths[goer.path].at(goer.start_m + goer.speed_mps * time_s);
        let (sin, cos) = point.yaw_rad.sin_cos();
        let [x, y] = point.position_m;
        let center_m = [(x - goer.aside_m * sin) as f32, (y + goer.aside_m * cos) as f32];
        let sign = goer.speed_mps.signum();
        (center_m, [(sign * cos) as f32, (sign * sin) as f32])
    }
}

fn far(a: [f32; 2], b: [f32; 2], than_m: f32) -> bool {
    (a[0] - b[0]).hypot(a[1] - b[1]) > than_m
}

fn path(corners: &[[f64; 2]], radius_m: f64) -> Path {
    let corners: Vec<Corner> = corners.iter().map(|&at_m| Corner { at_m, radius_m }).collect();
    through(&corners)
}

fn through(corners: &[Corner]) -> Path {
    let smoothing =
        Smoothing { spacing_m: 0.1, reach_m: 0.3, wander_m: 0.0, wander_length_m: 1.0, wander_phase_rad: 0.0 };
    Path::closed(corners, smoothing)
}
