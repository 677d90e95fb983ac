//! Donuts with known truth, for tests: a street scene of sky, houses and ground, another one in every frame.

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::types::LumaImage;

#[derive(Debug, Clone)]
pub(super) struct SyntheticDonut {
    pub size_px: [usize; 2],
    pub center_px: [f64; 2],
    pub inner_radius_px: f64,
    pub outer_radius_px: f64,
    /// Grey level around the donut and inside its hub.
    pub surround: f64,
    pub hub: f64,
    /// Grey levels of ground and houses (between the two) and of the sky.
    pub content: [f64; 2],
    pub sky: f64,
    /// Width of the rims from 0 to 1 \[px\].
    pub rim_width_px: f64,
    /// Standard deviation of the pixel noise \[grey levels\].
    pub noise: f64,
    /// Standing clutter: a bright ring inside the hub, a stripe across the surround.
    pub clutter: bool,
    /// Radians of the vehicle's own dark body at the inner rim, up to a third of the way out.
    pub vehicle_rad: f64,
    pub seed: u64,
}

impl SyntheticDonut {
    /// By day, in focus, well inside a 640 x 480 image.
    pub fn day(seed: u64) -> Self {
        Self {
            size_px: [640, 480],
            center_px: [331.4, 236.8],
            inner_radius_px: 71.3,
            outer_radius_px: 212.6,
            surround: 12.0,
            hub: 16.0,
            content: [50.0, 170.0],
            sky: 200.0,
            rim_width_px: 2.0,
            noise: 2.0,
            clutter: false,
            vehicle_rad: 0.0,
            seed,
        }
    }

    pub fn frames(&self, count: u64) -> Vec<LumaImage> {
        (0..count).map(|index| self.frame(index)).collect()
    }

    fn frame(&self, index: u64) -> LumaImage {
        let mut rng = ChaCha8Rng::seed_from_u64(self.seed * 1000 + index);
        let [dark, bright] = self.content;
        let mut house = || [rng.random_range(0.1..0.5), rng.random_range(0.5..1.15), rng.random_range(dark..bright)];
        let houses: Vec<[f64; 3]> = (0..24).map(|_| house()).collect();
        let ground = rng.random_range(dark..bright);
        let sky_slope = rng.random_range(-0.2..0.2) * self.sky;
        let turn = rng.random_range(0.0..1.0);
        let [width, height] = self.size_px;
        let mut noise = move || -> f64 {
            // Sum of four uniform numbers: variance 1/3, near enough to Gaussian.
            (0..4).map(|_| rng.random_range(-0.5..0.5)).sum::<f64>() * 3.0f64.sqrt()
        };
        let mut frame = LumaImage { width_px: width, height_px: height, pixels: Vec::with_capacity(width * height) };
        for y in 0..height {
            for x in 0..width {
                let (dx, dy) = (x as f64 - self.center_px[0], y as f64 - self.center_px[1]);
                let (r, angle) = (dx.hypot(dy), dy.atan2(dx));
                let elevation = (r - self.inner_radius_px) / (self.outer_radius_px - self.inner_radius_px);
                let sector = (angle / std::f64::consts::TAU + 1.0 + turn).fract() * houses.len() as f64;
                let [foot, top, facade] = houses[sector as usize % houses.len()];
                let content = if angle.abs() < 0.5 * self.vehicle_rad && elevation < 0.33 {
                    self.hub + 3.0
                } else if elevation < foot {
                    ground
                } else if elevation < top {
                    facade * if (sector * 5.0).fract() < 0.4 && (elevation * 12.0).fract() < 0.5 { 0.6 } else { 1.0 }
                } else {
                    self.sky + sky_slope * angle.sin()
                };
                let inside = |radius: f64| ((radius - r) / self.rim_width_px + 0.5).clamp(0.0, 1.0);
                let (in_hub, in_outer) = (inside(self.inner_radius_px), inside(self.outer_radius_px));
                let mut hub = self.hub;
                let mut surround = self.surround;
                if self.clutter {
                    hub += if (r / self.inner_radius_px - 0.6).abs() < 0.05 { 60.0 } else { 0.0 };
                    surround += if (x + y) % 97 < 9 { 50.0 } else { 0.0 };
                }
                let luma = in_hub * hub + (in_outer - in_hub) * content + (1.0 - in_outer) * surround;
                frame.pixels.push((luma + self.noise * noise()).round().clamp(0.0, 255.0) as u8);
            }
        }
        frame
    }
}
