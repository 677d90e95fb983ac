//! Fourier magnitudes along the two axes of the panorama: `fft`, 128 properties.

use std::f64::consts::TAU;

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

/// The first harmonics of one axis: sums over a table of cosines and sines. A fast transform would take them from the C
/// library, whose last digits differ from one computer to the next, and is not needed for 64 of them.
struct Axis {
    /// cos and sin of 2π t / N for t = 0 … N − 1.
    turns: Vec<[f64; 2]>,
    signal: Vec<f64>,
    /// x(t) + x(N − t) and x(t) − x(N − t) for t = 1 … N/2 − 1: what the cosines and the sines of all harmonics have in common.
    folded: Vec<[f64; 2]>,
}

impl FftDescriptor {
    pub fn new() -> Self {
        Self { rows: Axis::new(GRAY_SIZE), columns: Axis::new(SAMPLED_COLUMNS) }
    }

    pub fn describe(&mut self, panorama: &Panorama, properties: &mut [f32]) {
        let (of_rows, of_columns) = properties.split_at_mut(HARMONICS);
        let row_sums = panorama.gray.chunks_exact(GRAY_SIZE).map(sum);
        self.rows.magnitudes(row_sums, 1.0, of_rows);
        // A mean over 256 rows and one of 1024 columns, as sums over 128 rows and 128 columns.
        let scale = (GRAY_SIZE * GRAY_SIZE) as f64 / SAMPLED_COLUMNS as f64;
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
    /// Of an even number of samples.
    fn new(length: usize) -> Self {
        let turn = |t: usize| {
            let (sin, cos) = libm::sincos(TAU * t as f64 / length as f64);
            [cos, sin]
        };
        Self {
            turns: (0..length).map(turn).collect(),
            signal: Vec::with_capacity(length),
            folded: Vec::with_capacity(length / 2),
        }
    }

    /// `scale` × the magnitudes of harmonics 1, 2, … of `signal`.
    fn magnitudes(&mut self, signal: impl Iterator<Item = f64>, scale: f64, magnitudes: &mut [f32]) {
        let Self { turns, signal: x, folded } = self;
        x.clear();
        x.extend(signal);
        let (length, half) = (turns.len(), turns.len() / 2);
        folded.clear();
        folded.extend((1..half).map(|t| [x[t] + x[length - t], x[t] - x[length - t]]));
        for (harmonic, magnitude) in (1..).zip(magnitudes) {
            let (mut re, mut im, mut at) = (x[0] + x[half] * turns[harmonic * half % length][0], 0.0, 0);
            for [even, odd] in &*folded {
                at += harmonic;
                at -= if at >= length { length } else { 0 };
                let [cos, sin] = turns[at];
                re += even * cos;
                im += odd * sin;
            }
            *magnitude = (scale * libm::hypot(re, im)) as f32;
        }
    }
}

#[cfg(test)]
mod tests {
    use realfft::num_complex::Complex;

    use super::*;
    use crate::golden::{assert_close, golden, golden_gray, golden_panorama, list};

    #[test]
    fn equals_the_reference_values() {
        // The reference is of a 128 × 128 image: its row and column sums, transformed as they are.
        let row_sums = (0..GRAY_SIZE).map(|a| (0..GRAY_SIZE).map(|b| golden_gray(a, b)).sum());
        let column_sums = (0..GRAY_SIZE).map(|b| (0..GRAY_SIZE).map(|a| golden_gray(a, b)).sum());
        let mut axis = Axis::new(GRAY_SIZE);
        let mut properties = vec![0.0; DIMENSIONS];
        axis.magnitudes(row_sums, 1.0, &mut properties[..HARMONICS]);
        axis.magnitudes(column_sums, 1.0, &mut properties[HARMONICS..]);
        assert_close("fft128", &properties, &list(&golden()["fft128"]), 1e-6);
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
                direct += Complex::from_polar(f64::from(value), -TAU * turn);
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
