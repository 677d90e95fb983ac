//! What many frames say about where the donut lies, in a fixed amount of memory: the temporal mean and the temporal
//! standard deviation of every pixel.
//!
//! The rim stays where it is while the content moves. So averaging blurs content edges away and leaves the rim, and
//! the standard deviation is high on the donut and only noise on the surround and on the hub, even where surround and
//! content are equally bright.

use crate::types::LumaImage;

/// The sums behind the two maps. 12 bytes a pixel, however many frames.
#[derive(Debug, Clone)]
pub(super) struct Accumulator {
    pub width_px: usize,
    pub height_px: usize,
    pub frames: u32,
    sum: Vec<u32>,
    sum_of_squares: Vec<u64>,
}

impl Accumulator {
    pub fn new(width_px: usize, height_px: usize) -> Self {
        let size = width_px * height_px;
        Self { width_px, height_px, frames: 0, sum: vec![0; size], sum_of_squares: vec![0; size] }
    }

    /// Adds a frame of the same size. Past [`MAX_FRAMES`](Self::MAX_FRAMES) frames nothing changes any more.
    pub fn add(&mut self, frame: &LumaImage) {
        if self.frames == Self::MAX_FRAMES {
            return;
        }
        for ((sum, squares), &luma) in self.sum.iter_mut().zip(&mut self.sum_of_squares).zip(&frame.pixels) {
            let luma = u32::from(luma);
            *sum += luma;
            *squares += u64::from(luma * luma);
        }
        self.frames += 1;
    }

    /// As many white frames as a 32-bit sum holds: six days at 30 Hz.
    pub const MAX_FRAMES: u32 = u32::MAX / 255;

    pub fn maps(&self) -> Maps {
        let n = f64::from(self.frames.max(1));
        let values = self
            .sum
            .iter()
            .zip(&self.sum_of_squares)
            .map(|(&sum, &squares)| {
                let mean = f64::from(sum) / n;
                let variance = (squares as f64 / n - mean * mean).max(0.0);
                [mean as f32, variance.sqrt() as f32]
            })
            .collect();
        Maps { width_px: self.width_px, height_px: self.height_px, values }
    }
}

/// Temporal mean and standard deviation \[grey levels\] of each pixel: `values[y * width_px + x] = [mean, deviation]`.
#[derive(Debug, Clone)]
pub(super) struct Maps {
    pub width_px: usize,
    pub height_px: usize,
    pub values: Vec<[f32; 2]>,
}

impl Maps {
    /// Averages over blocks of `factor` x `factor` pixels; what does not fill a block on the right and at the bottom
    /// is left out. Coarse pixel (x, y) is centred at `factor·x + (factor − 1)/2` of the original.
    pub fn reduced(&self, factor: usize) -> Self {
        let (width_px, height_px) = (self.width_px / factor, self.height_px / factor);
        let mut values = vec![[0.0; 2]; width_px * height_px];
        for y in 0..height_px * factor {
            let row = &self.values[y * self.width_px..][..width_px * factor];
            let coarse = &mut values[y / factor * width_px..][..width_px];
            for (block, sum) in row.chunks_exact(factor).zip(coarse) {
                for value in block {
                    sum[0] += value[0];
                    sum[1] += value[1];
                }
            }
        }
        let area = (factor * factor) as f32;
        values.iter_mut().for_each(|value| *value = [value[0] / area, value[1] / area]);
        Self { width_px, height_px, values }
    }

    /// Bilinear value; `None` outside the pixel centres.
    pub fn at(&self, x_px: f64, y_px: f64) -> Option<[f32; 2]> {
        let (right, bottom) = ((self.width_px - 1) as f64, (self.height_px - 1) as f64);
        if !(x_px >= 0.0 && y_px >= 0.0 && x_px < right && y_px < bottom) {
            return None;
        }
        let (x, y) = (x_px as usize, y_px as usize);
        let (u, v) = ((x_px - x as f64) as f32, (y_px - y as f64) as f32);
        let above = &self.values[y * self.width_px + x..][..2];
        let below = &self.values[(y + 1) * self.width_px + x..][..2];
        Some([0, 1].map(|i| {
            (1.0 - v) * ((1.0 - u) * above[0][i] + u * above[1][i]) + v * ((1.0 - u) * below[0][i] + u * below[1][i])
        }))
    }

    /// Standard deviation of the noise of the mean map \[grey levels\], from differences of horizontal neighbours.
    ///
    /// The lower quartile of |x| is 0.3186 σ for Gaussian x, and a difference has √2 the noise of a pixel; the quartile
    /// rather than the median, because up to half of the image may be textured. Zero on a noise-free surround.
    pub fn noise(&self) -> f32 {
        let mut differences: Vec<f32> = self
            .values
            .chunks_exact(self.width_px)
            .step_by(2)
            .flat_map(|row| row.windows(2).step_by(2).map(|pair| (pair[1][0] - pair[0][0]).abs()))
            .collect();
        if differences.is_empty() {
            return 0.0;
        }
        let quartile = differences.len() / 4;
        let (_, value, _) = differences.select_nth_unstable_by(quartile, f32::total_cmp);
        *value / (0.3186 * std::f32::consts::SQRT_2)
    }

    /// Whether content moved between the frames enough for the deviation map to show the donut by itself: it is a
    /// few grey levels above the noise on at least a tenth of the image and not everywhere.
    pub fn show_motion(&self) -> bool {
        let mut deviations: Vec<f32> = self.values.iter().step_by(7).map(|value| value[1]).collect();
        if deviations.len() < 10 {
            return false;
        }
        deviations.sort_unstable_by(f32::total_cmp);
        let (quiet, lively) = (deviations[deviations.len() / 10], deviations[deviations.len() * 9 / 10]);
        lively > 3.0 * quiet + 4.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn maps_hold_mean_and_deviation_of_each_pixel() {
        let mut accumulator = Accumulator::new(4, 2);
        for luma in [10, 20, 30] {
            accumulator.add(&LumaImage::from_fn(4, 2, |x, _| if x == 0 { 255 } else { luma }));
        }
        let maps = accumulator.maps();
        assert_eq!(maps.values[0], [255.0, 0.0]);
        assert_eq!(maps.values[1][0], 20.0);
        // Population deviation of 10, 20, 30.
        assert!((maps.values[1][1] - (200.0f32 / 3.0).sqrt()).abs() < 1e-4);
    }

    #[test]
    fn reducing_averages_blocks_and_keeps_positions() {
        let mut accumulator = Accumulator::new(7, 4);
        accumulator.add(&LumaImage::from_fn(7, 4, |x, y| (10 * x + y) as u8));
        let maps = accumulator.maps();
        let coarse = maps.reduced(2);
        assert_eq!((coarse.width_px, coarse.height_px), (3, 2));
        // A ramp: the block's mean is the ramp's value at the block's centre.
        let center = |i: usize| 2.0 * i as f64 + 0.5;
        assert_eq!(Some(coarse.values[3 + 2]), maps.at(center(2), center(1)));
        assert_eq!(maps.at(6.5, 0.0), None);
        assert_eq!(maps.at(f64::NAN, 0.0), None);
    }
}
