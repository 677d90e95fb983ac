//! Fourier magnitudes along the two axes of the panorama: `fft`, 128 properties.

use std::sync::Arc;

use realfft::num_complex::Complex;
use realfft::{RealFftPlanner, RealToComplex};

use crate::panorama::{GRAY_SIZE, Panorama, SAMPLED_COLUMNS};

/// Magnitudes an axis.
const HARMONICS: usize = 64;
pub const DIMENSIONS: usize = 2 * HARMONICS;

/// |F(1,0)| … |F(64,0)|, |F(0,1)| … |F(0,64)| of
///
/// ```text
/// F(p, l) = Σ_a Σ_b f[a, b] exp(−2πi (p a + l b) / N)      N = 128, a row, b column
/// ```
///
/// (Do et al. 2015, section 2.) F(p, 0) is the 1-D transform of the row sums and F(0, l) that of the column sums, so no
/// 2-D transform is needed. The column sums are those of the 1024-wide panorama, scaled to 128 columns: a turn by a
/// fraction of a 128-wide column leaves their magnitudes as they are, which averaging to 128 columns first would not.
pub struct FftDescriptor {
    rows: Axis,
    columns: Axis,
}

/// The 1-D transform of one axis, with its buffers. In f32, whose twiddle factors are the same on every computer.
struct Axis {
    transform: Arc<dyn RealToComplex<f32>>,
    input: Vec<f32>,
    spectrum: Vec<Complex<f32>>,
    scratch: Vec<Complex<f32>>,
}

impl FftDescriptor {
    pub fn new() -> Self {
        let mut planner = RealFftPlanner::new();
        Self { rows: Axis::new(&mut planner, GRAY_SIZE), columns: Axis::new(&mut planner, SAMPLED_COLUMNS) }
    }

    pub fn describe(&mut self, panorama: &Panorama, properties: &mut [f32]) {
        let (of_rows, of_columns) = properties.split_at_mut(HARMONICS);
        let row_sums = panorama.gray.chunks_exact(GRAY_SIZE).map(sum);
        self.rows.magnitudes(row_sums, 1.0, of_rows);
        // A mean over 256 rows and one of 1024 columns, as sums over 128 rows and 128 columns.
        let scale = (GRAY_SIZE * GRAY_SIZE) as f32 / SAMPLED_COLUMNS as f32;
        self.columns.magnitudes(panorama.column_means.iter().map(|&mean| f64::from(mean)), scale, of_columns);
    }
}

impl Default for FftDescriptor {
    fn default() -> Self {
        Self::new()
    }
}

fn sum(row: &[f32]) -> f64 {
    row.iter().map(|&value| f64::from(value)).sum()
}

impl Axis {
    fn new(planner: &mut RealFftPlanner<f32>, length: usize) -> Self {
        let transform = planner.plan_fft_forward(length);
        Self {
            input: transform.make_input_vec(),
            spectrum: transform.make_output_vec(),
            scratch: transform.make_scratch_vec(),
            transform,
        }
    }

    /// `scale` × the magnitudes of harmonics 1, 2, … of `signal`.
    fn magnitudes(&mut self, signal: impl Iterator<Item = f64> + Clone, scale: f32, magnitudes: &mut [f32]) {
        // No harmonic sees the mean, and small numbers keep their digits.
        let mean = signal.clone().sum::<f64>() / self.input.len() as f64;
        self.input.iter_mut().zip(signal).for_each(|(input, value)| *input = (value - mean) as f32);
        self.transform
            .process_with_scratch(&mut self.input, &mut self.spectrum, &mut self.scratch)
            .expect("the buffers come from the plan");
        for (magnitude, harmonic) in magnitudes.iter_mut().zip(&self.spectrum[1..]) {
            *magnitude = scale * harmonic.norm_sqr().sqrt();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::golden::{assert_close, golden, golden_gray, golden_panorama, list};

    #[test]
    fn equals_the_reference_values() {
        // The reference is of a 128 × 128 image: its row and column sums, transformed as they are.
        let row_sums = (0..GRAY_SIZE).map(|a| (0..GRAY_SIZE).map(|b| golden_gray(a, b)).sum());
        let column_sums = (0..GRAY_SIZE).map(|b| (0..GRAY_SIZE).map(|a| golden_gray(a, b)).sum());
        let mut axis = Axis::new(&mut RealFftPlanner::new(), GRAY_SIZE);
        let mut properties = vec![0.0; DIMENSIONS];
        axis.magnitudes(row_sums, 1.0, &mut properties[..HARMONICS]);
        axis.magnitudes(column_sums, 1.0, &mut properties[HARMONICS..]);
        // Numbers up to 10 000 are transformed in f32; the least magnitude is 300.
        assert_close("fft128", &properties, &list(&golden()["fft128"]), 4e-6);
    }

    #[test]
    fn equals_the_full_2d_transform() {
        let panorama = golden_panorama();
        let mut properties = vec![0.0; DIMENSIONS];
        FftDescriptor::new().describe(&panorama, &mut properties);
        for harmonic in [1, 5, 17, 64] {
            let mut direct = Complex::new(0.0, 0.0);
            for (i, &value) in panorama.gray.iter().enumerate() {
                let turn = (harmonic * (i / GRAY_SIZE)) as f64 / GRAY_SIZE as f64;
                direct += Complex::from_polar(f64::from(value), -std::f64::consts::TAU * turn);
            }
            let found = f64::from(properties[harmonic - 1]);
            assert!((found / direct.norm() - 1.0).abs() < 1e-6, "{harmonic}: {found} instead of {}", direct.norm());
        }
    }

    #[test]
    fn a_turn_leaves_the_properties_as_they_are() {
        let panorama = golden_panorama();
        let (mut before, mut after) = (vec![0.0; DIMENSIONS], vec![0.0; DIMENSIONS]);
        let mut fft = FftDescriptor::new();
        fft.describe(&panorama, &mut before);
        let mut turned = panorama.clone();
        turned.column_means.rotate_right(5); // 1.8°, not a whole column of 128
        fft.describe(&turned, &mut after);
        assert_eq!(before[..HARMONICS], after[..HARMONICS]);
        for (a, b) in before.iter().zip(&after) {
            assert!((a - b).abs() <= 1e-4 * a.abs().max(1.0), "{a} became {b}");
        }
    }
}
