//! Frames of a drive.

use std::{f64::consts::TAU, sync::Arc};

use multiversion::multiversion;

use super::{
    Camera, Day, Pose, World,
    camera::CameraError,
    column::{Above, Column, Ray, Rows, Scene},
    dress::dress,
    light::{BlockLight, Light, Shadows, Sky, ground, lamplight},
    scene::{Block, Plane, Upright},
    sensor::Sensor,
    texture::Color,
    traffic::{Textures, Traffic},
};
use crate::types::LumaImage;

/// Size of the panorama that is bent into the donut.
pub(super) const PANORAMA_COLUMNS: usize = 1024;
pub(super) const PANORAMA_ROWS: usize = 256;
/// Rays, two to a column.
const RAYS: usize = 2 * PANORAMA_COLUMNS;

/// A tree or a pole as near as this is not painted: the camera would be within it.
const NEAREST_UPRIGHT_M: f32 = 0.3;

/// The panorama column by column; the first column follows the last once more.
#[derive(Debug, Clone)]
pub(super) struct Planes {
    pub luma: Vec<u8>,
    /// Blue and red difference, half as many columns and rows.
    pub chroma: Vec<[u8; 2]>,
}

/// Makes frames. Everything that stays the same from frame to frame is made once.
#[derive(Debug)]
pub struct Renderer {
    camera: Camera,
    textures: Textures,
    /// Those that stand still first.
    blocks: Vec<Block>,
    lights: Vec<BlockLight>,
    standing_blocks: usize,
    uprights: Vec<Upright>,
    standing_uprights: usize,
    shadows: Shadows,
    light: Light,
    ground: Plane,
    ceiling: Option<Plane>,
    sky: Sky,
    traffic: Traffic,
    rows: Rows,
    /// Cosine and sine of the angle of every ray from column 0.
    directions: Vec<[f32; 2]>,
    /// The rays of this frame.
    rays: Vec<Ray>,
    columns: Vec<Column>,
    order: Vec<(f32, u16)>,
    painted: Vec<Color>,
    planes: Planes,
    unblurred: Vec<u8>,
    tone: Vec<u8>,
    sensor: Sensor,
}

impl Renderer {
    /// # Errors
    /// When the camera is impossible.
    pub fn new(world: &World, day: &Day, camera: &Camera) -> Result<Self, CameraError> {
        camera.check()?;
        let mut textures = world.textures.iter().map(Arc::clone).collect();
        dress(world, day, &mut textures);
        let traffic = Traffic::new(world, day, &mut textures);
        let mut blocks = world.blocks.clone();
        blocks.extend(traffic.parked(world, day));
        let light = Light::of(world, day);
        let (shadows, lights) = Shadows::cast(&light, &blocks);
        let (ceiling, ground) = match &world.ceiling {
            Some(_) => lamplight(world, day),
            None => (None, ground(&world.ground, &light, &blocks, &world.uprights)),
        };
        let [top_rad, bottom_rad] = camera.panorama_elevations_rad();
        let rows = Rows::new(PANORAMA_ROWS, top_rad, bottom_rad);
        let elevations_rad: Vec<f32> =
            rows.tangents[..rows.above_horizon].iter().map(|tangent| tangent.atan()).collect();
        let directions = (0..RAYS)
            .map(|ray| {
                let angle_rad = camera.sense() * TAU * (ray as f64 + 0.5) / RAYS as f64;
                [angle_rad.cos() as f32, angle_rad.sin() as f32]
            })
            .collect();
        Ok(Self {
            sky: Sky::paint(day, &elevations_rad),
            standing_blocks: blocks.len(),
            standing_uprights: world.uprights.len(),
            uprights: world.uprights.clone(),
            textures,
            blocks,
            lights,
            shadows,
            light,
            ground,
            ceiling,
            traffic,
            rows,
            directions,
            rays: Vec::with_capacity(RAYS),
            columns: vec![Column::default(); RAYS],
            order: Vec::new(),
            painted: vec![0; RAYS * PANORAMA_ROWS],
            planes: Planes {
                luma: vec![0; (PANORAMA_COLUMNS + 1) * PANORAMA_ROWS],
                chroma: vec![[128; 2]; (PANORAMA_COLUMNS / 2 + 1) * PANORAMA_ROWS / 2],
            },
            unblurred: vec![0; (PANORAMA_COLUMNS + 1) * PANORAMA_ROWS],
            tone: tone(day.exposure),
            sensor: Sensor::new(camera),
            camera: camera.clone(),
        })
    }

    pub fn camera(&self) -> &Camera {
        &self.camera
    }

    /// The frame that the camera sends for this pose at this time, in place of what `jpeg` held. The same pose and time
    /// give the same bytes.
    pub fn render_jpeg(&mut self, pose: &Pose, time_s: f64, jpeg: &mut Vec<u8>) {
        self.render(pose, time_s);
        self.encode(jpeg);
    }

    /// The first half of [`render_jpeg`](Self::render_jpeg): everything but encoding.
    pub fn render(&mut self, pose: &Pose, time_s: f64) {
        self.paint(pose, time_s);
        self.sensor.expose(&self.planes, time_s.to_bits());
    }

    /// The frame that was rendered last, as a JPEG.
    pub fn encode(&self, jpeg: &mut Vec<u8>) {
        self.sensor.encode(jpeg);
    }

    /// What a level camera sees, without its noise, before the lens bends it: 1024 × 256, the columns as in an unwrapped
    /// frame, the rows evenly over the elevations of the lens (and the tilt beyond them).
    pub fn render_panorama(&mut self, pose: &Pose, time_s: f64) -> LumaImage {
        self.paint(pose, time_s);
        LumaImage::from_fn(PANORAMA_COLUMNS, PANORAMA_ROWS, |x, y| self.planes.luma[x * PANORAMA_ROWS + y])
    }

    /// Paints the panorama, brightness and colour.
    fn paint(&mut self, pose: &Pose, time_s: f64) {
        let eye_m = pose.position_m.map(|coordinate| coordinate as f32);
        self.blocks.truncate(self.standing_blocks);
        self.lights.truncate(self.standing_blocks);
        self.uprights.truncate(self.standing_uprights);
        self.traffic.at(time_s, eye_m, &mut self.blocks, &mut self.uprights);
        let moving = &self.blocks[self.standing_blocks..];
        self.lights.extend(moving.iter().map(|block| self.light.of_block(block)));

        self.aim(pose, eye_m);
        self.cast(pose, eye_m);
        let scene = Scene {
            textures: &self.textures,
            blocks: &self.blocks,
            lights: &self.lights,
            shadows: &self.shadows,
            uprights: &self.uprights,
            upright_light: (self.light.shade() + self.light.ground()) / 2,
            ground: &self.ground,
            above: self.ceiling.as_ref().map_or(Above::Sky(&self.sky), Above::Ceiling),
        };
        let pairs = self.columns.chunks_exact_mut(2).zip(self.rays.chunks_exact(2));
        for ((columns, rays), out) in pairs.zip(self.painted.chunks_exact_mut(2 * PANORAMA_ROWS)) {
            let [left, right] = [0, 1].map(|i| columns[i].arrange(&scene, &self.rows, &rays[i]));
            let (left_out, right_out) = out.split_at_mut(PANORAMA_ROWS);
            // Planes and sky are smooth at this scale: painted once for both.
            left.with(right).paint(&scene, &self.rows, &rays[0], left_out);
            right_out.copy_from_slice(left_out);
            columns[0].paint(&scene, &self.rows, &rays[0], left_out);
            columns[1].paint(&scene, &self.rows, &rays[1], right_out);
        }
        self.develop();
    }

    /// Turns all rays with the vehicle.
    fn aim(&mut self, pose: &Pose, from_m: [f32; 2]) {
        let (sin, cos) = pose.yaw_rad.sin_cos();
        let (sin, cos) = (sin as f32, cos as f32);
        let (sense, height_m) = (self.camera.sense(), self.camera.height_m as f32);
        self.rays.clear();
        self.rays.extend(self.directions.iter().enumerate().map(|(index, [x, y])| Ray {
            from_m,
            height_m,
            direction: [cos * x - sin * y, sin * x + cos * y],
            azimuth_turns: (pose.yaw_rad / TAU + sense * (index as f64 + 0.5) / RAYS as f64) as f32,
        }));
    }

    /// Finds what every ray meets.
    fn cast(&mut self, pose: &Pose, eye_m: [f32; 2]) {
        self.columns.iter_mut().for_each(Column::clear);
        self.order.clear();
        self.order.extend(self.blocks.iter().enumerate().map(|(index, block)| {
            let [x, y] = block.local(eye_m);
            let beyond = [(x.abs() - block.half_m[0]).max(0.0), (y.abs() - block.half_m[1]).max(0.0)];
            (beyond[0] * beyond[0] + beyond[1] * beyond[1], index as u16)
        }));
        self.order.sort_unstable_by(|a, b| a.0.total_cmp(&b.0));
        let per_rad = RAYS as f64 / TAU;
        let to_ray = |x: f32, y: f32| self.camera.sense() * (f64::from(y.atan2(x)) - pose.yaw_rad) * per_rad - 0.5;
        for &(_, index) in &self.order {
            let block = &self.blocks[usize::from(index)];
            let middle = to_ray(block.center_m[0] - eye_m[0], block.center_m[1] - eye_m[1]);
            let (mut first, mut last) = (0.0_f64, 0.0_f64);
            for [x, y] in block.corners_m() {
                let half = 0.5 * RAYS as f64;
                let off = (to_ray(x - eye_m[0], y - eye_m[1]) - middle + half).rem_euclid(RAYS as f64) - half;
                (first, last) = (first.min(off), last.max(off));
            }
            let origin = block.local(eye_m);
            for ray_index in (middle + first).ceil() as i64..=(middle + last).floor() as i64 {
                let ray_index = ray_index.rem_euclid(RAYS as i64) as usize;
                let ray = &self.rays[ray_index];
                self.columns[ray_index].meet_block(usize::from(index), block, origin, ray);
            }
        }
        for (index, upright) in self.uprights.iter().enumerate() {
            let (x, y) = (upright.center_m[0] - eye_m[0], upright.center_m[1] - eye_m[1]);
            let distance_m = x.hypot(y);
            if distance_m < NEAREST_UPRIGHT_M {
                continue;
            }
            let middle = to_ray(x, y);
            let reach = f64::from((upright.half_width_m / distance_m).min(1.0).asin()) * per_rad;
            for ray_index in (middle - reach).ceil() as i64..=(middle + reach).floor() as i64 {
                let ray_index = ray_index.rem_euclid(RAYS as i64) as usize;
                let [dx, dy] = self.rays[ray_index].direction;
                // From the left as seen from the camera.
                let along_m = upright.half_width_m + y * dx - x * dy;
                self.columns[ray_index].meet_upright(index, distance_m, along_m);
            }
        }
    }

    /// Colours → brightness and colour difference at the size of the panorama, exposed and blurred.
    fn develop(&mut self) {
        let pairs = self.painted.chunks_exact(2 * PANORAMA_ROWS);
        for (column, (pair, out)) in pairs.zip(self.unblurred.chunks_exact_mut(PANORAMA_ROWS)).enumerate() {
            let (left, right) = pair.split_at(PANORAMA_ROWS);
            let mut sums = [0_u16; PANORAMA_ROWS];
            brightness(left, right, &mut sums);
            for (out, sum) in out.iter_mut().zip(sums) {
                *out = self.tone[usize::from(sum)];
            }
            if column % 2 == 0 {
                let chroma = &mut self.planes.chroma[column / 2 * (PANORAMA_ROWS / 2)..][..PANORAMA_ROWS / 2];
                differences(left, chroma);
            }
        }
        let [across, down] = self.camera.blur_cells();
        blur(&mut self.unblurred, &mut self.planes.luma, across, down);
        let (body, first_again) = self.planes.luma.split_at_mut(PANORAMA_COLUMNS * PANORAMA_ROWS);
        first_again.copy_from_slice(&body[..PANORAMA_ROWS]);
        let (body, first_again) = self.planes.chroma.split_at_mut(PANORAMA_COLUMNS * PANORAMA_ROWS / 4);
        first_again.copy_from_slice(&body[..PANORAMA_ROWS / 2]);
    }
}

/// `across` and `down`: standard deviations in columns and rows. Small steps of \[w, 1 − 2w, w\] add up to them.
fn blur(image: &mut Vec<u8>, out: &mut Vec<u8>, across: f64, down: f64) {
    const LARGEST_WEIGHT: f64 = 0.25;
    // Such a step has the variance 2 w.
    let steps = |deviation: f64| (0.5 * deviation * deviation / LARGEST_WEIGHT).ceil().max(1.0);
    let weight = |deviation: f64| (256.0 * 0.5 * deviation * deviation / steps(deviation)) as u16;
    let columns = PANORAMA_COLUMNS;
    for _ in 0..steps(across) as usize {
        for j in 0..columns {
            let column = |j: usize| &image[j * PANORAMA_ROWS..(j + 1) * PANORAMA_ROWS];
            let three = [column((j + columns - 1) % columns), column(j), column((j + 1) % columns)];
            weigh(three, weight(across), &mut out[j * PANORAMA_ROWS..(j + 1) * PANORAMA_ROWS]);
        }
        std::mem::swap(image, out);
    }
    for _ in 0..steps(down) as usize {
        let last = PANORAMA_ROWS - 1;
        for (column, out) in image.chunks_exact(PANORAMA_ROWS).zip(out.chunks_exact_mut(PANORAMA_ROWS)) {
            weigh([&column[..last - 1], &column[1..last], &column[2..]], weight(down), &mut out[1..last]);
            (out[0], out[last]) = (column[0], column[last]);
        }
        std::mem::swap(image, out);
    }
    std::mem::swap(image, out);
}

#[multiversion(targets("x86_64+avx2"))]
fn weigh([before, middle, after]: [&[u8]; 3], weight: u16, out: &mut [u8]) {
    for (((out, &before), &middle), &after) in out.iter_mut().zip(before).zip(middle).zip(after) {
        let sum = u16::from(middle) * (256 - 2 * weight) + (u16::from(before) + u16::from(after)) * weight;
        *out = ((sum + 128) >> 8) as u8;
    }
}

/// Luma of both columns together (ITU-R BT.601), 0..=1020.
#[multiversion(targets("x86_64+avx2"))]
fn brightness(left: &[Color], right: &[Color], sums: &mut [u16; PANORAMA_ROWS]) {
    for ((sum, &left), &right) in sums.iter_mut().zip(left).zip(right) {
        let both = |shift: u32| ((left >> shift) & 255) + ((right >> shift) & 255);
        *sum = ((77 * both(0) + 150 * both(8) + 29 * both(16)) >> 7) as u16;
    }
}

/// Blue and red difference (ITU-R BT.601) of two rows each.
#[multiversion(targets("x86_64+avx2"))]
fn differences(column: &[Color], chroma: &mut [[u8; 2]]) {
    for (pair, out) in column.chunks_exact(2).zip(chroma) {
        let both = |shift: u32| (((pair[0] >> shift) & 255) + ((pair[1] >> shift) & 255)) as i32;
        let (red, green, blue) = (both(0), both(8), both(16));
        let half = 128 << 9;
        *out = [
            ((half - 43 * red - 85 * green + 128 * blue) >> 9).clamp(0, 255) as u8,
            ((half + 128 * red - 107 * green - 21 * blue) >> 9).clamp(0, 255) as u8,
        ];
    }
}

/// Gray level for every brightness: times the exposure, with highlights that saturate softly.
fn tone(exposure: f64) -> Vec<u8> {
    const KNEE: f64 = 0.8;
    (0..=1020)
        .map(|sum| {
            let light = exposure.max(0.0) * f64::from(sum) / 1020.0;
            let shown = if light < KNEE { light } else { 1.0 - (1.0 - KNEE) * (-(light - KNEE) / (1.0 - KNEE)).exp() };
            (255.0 * shown).round() as u8
        })
        .collect()
}
