//! Fourier signature of gradient orientations: `gradient`.

use std::f32::consts::TAU;
use std::sync::Arc;

use realfft::num_complex::Complex;
use realfft::{RealFftPlanner, RealToComplex};

use crate::panorama::{Panorama, WIDE_COLUMNS, WIDE_ROWS};

/// Orientation bins over the full circle: a dark-to-bright edge is not a bright-to-dark one.
pub const BINS: usize = 12;
/// Azimuthal harmonics kept, from 0.
const HARMONICS: usize = 5;

/// What a [compass signature](GradientSignature::compass) is of: unsigned orientation bins, elevation bands and harmonics
/// from 1.
const COMPASS_BINS: usize = UNSIGNED_BINS;
const COMPASS_BANDS: usize = 8;
pub const COMPASS_HARMONICS: usize = 16;
/// Length of a compass signature: a real and an imaginary part a bin, band and harmonic.
pub const COMPASS_BYTES: usize = COMPASS_BINS * COMPASS_BANDS * COMPASS_HARMONICS * 2;
/// Numbers of a signature are at most this.
const COMPASS_GREATEST: f32 = 127.0;

/// The wide panorama is reduced by this factor on both axes, to 256 × 64 pixels; all that follows is counted in these.
const REDUCTION: usize = 2;
pub const COLUMNS: usize = WIDE_COLUMNS / REDUCTION;
const ROWS: usize = WIDE_ROWS / REDUCTION;
/// Elevation bands.
pub const BANDS: usize = 32;
const ROWS_A_BAND: usize = ROWS / BANDS;
/// Deviation of the Gaussian blur before the gradient.
const BLUR_PX: f32 = 1.0;
/// Deviation of the neighbourhood whose mean gradient divides the gradient.
const CONTRAST_PX: f32 = 8.0;
/// An edge and its opposite are not told apart.
const UNSIGNED_BINS: usize = BINS / 2;
pub const DIMENSIONS: usize = UNSIGNED_BINS * BANDS * HARMONICS;

/// Gray values are counted from this, so that the logarithm of a dark, noisy pixel stays calm.
const DARK_LEVEL: f32 = 16.0;
/// Mean log-gradient a pixel that counts as no contrast at all: flat parts are not amplified to noise.
const CONTRAST_FLOOR: f32 = 0.05;

/// Magnitudes of the azimuthal Fourier transform of gradient orientations, band by band.
///
/// The Fourier signature of panorama rows (Menegatti, Maeda & Ishiguro 2004) taken of oriented gradients (Dalal & Triggs
/// 2005) in place of gray values. With L = log(gray + 16), blurred, ∇L its gradient by central differences, θ its
/// direction and ḡ the local mean of |∇L|,
///
/// ```text
/// w = |∇L| / (ḡ + 0.05)                          local contrast: illumination cancels
/// h_b(e, a) = mean over band e of w at azimuth a, shared linearly between the two bins b next to θ
/// y_(b,e,k) = √ |Σ_a (h_b + h_(b+6))(e, a) exp(−2πi k a / W)| / W     b = 0 … 5, k = 0 … 4; divided by the norm of all
/// ```
///
/// (b, e, k in that order.) Opposite bins are added: where sun and shadow swap sides, edges keep their direction but not
/// their sign. A turn of the vehicle shifts the azimuth and leaves the magnitudes as they are. Columns wrap round; rows
/// are repeated at the rims.
pub struct GradientSignature {
    blur: Vec<f32>,
    contrast: Vec<f32>,
    transform: Arc<dyn RealToComplex<f32>>,
    /// Buffers: the reduced panorama and planes of its size.
    plane: Vec<f32>,
    scratch: Vec<f32>,
    east: Vec<f32>,
    north: Vec<f32>,
    local_mean: Vec<f32>,
    bins: Vec<f32>,
    row: Vec<f32>,
    /// The first harmonics of every row of `bins`: bin × band × harmonic.
    harmonics: Vec<Complex<f32>>,
    /// The harmonics that a compass needs: bin × band × harmonic.
    compass: Vec<Complex<f32>>,
    spectrum: Vec<Complex<f32>>,
    fft_scratch: Vec<Complex<f32>>,
}

impl GradientSignature {
    pub fn new() -> Self {
        let transform = RealFftPlanner::new().plan_fft_forward(COLUMNS);
        let plane = || vec![0.0; COLUMNS * ROWS];
        Self {
            blur: gaussian_kernel(BLUR_PX),
            contrast: gaussian_kernel(CONTRAST_PX),
            plane: plane(),
            scratch: plane(),
            east: plane(),
            north: plane(),
            local_mean: plane(),
            bins: vec![0.0; BINS * BANDS * COLUMNS],
            harmonics: vec![Complex::default(); BINS * BANDS * HARMONICS],
            compass: vec![Complex::default(); COMPASS_BINS * COMPASS_BANDS * COMPASS_HARMONICS],
            row: vec![0.0; COLUMNS],
            spectrum: transform.make_output_vec(),
            fft_scratch: transform.make_scratch_vec(),
            transform,
        }
    }

    /// Takes the orientations of `panorama` in, for [`describe`](Self::describe).
    pub fn look(&mut self, panorama: &Panorama) {
        self.reduce_to_log(panorama);
        blur(&mut self.plane, &mut self.scratch, COLUMNS, &self.blur);
        self.differentiate();
        blur(&mut self.local_mean, &mut self.scratch, COLUMNS, &self.contrast);
        self.gather_orientations();
        self.transform_bands();
    }

    /// h_b(e, a) of the panorama last looked at, bin × band × azimuth.
    pub fn orientations(&self) -> &[f32] {
        &self.bins
    }

    /// The signature of the panorama last looked at.
    pub fn describe(&self, properties: &mut [f32]) {
        let scale = 1.0 / COLUMNS as f32;
        // The transform is linear: that of the sum of two bins is the sum of theirs.
        let (first, opposite) = self.harmonics.split_at(self.harmonics.len() / 2);
        for (property, (harmonic, opposite)) in properties.iter_mut().zip(first.iter().zip(opposite)) {
            *property = (scale * (harmonic + opposite).norm_sqr().sqrt()).sqrt();
        }
        let norm = properties.iter().map(|y| y * y).sum::<f32>().sqrt().max(f32::MIN_POSITIVE);
        properties.iter_mut().for_each(|y| *y /= norm);
    }

    /// The compass signature of the panorama last looked at: bin × band × harmonic × (real, imaginary part). Magnitudes are
    /// their square roots, which makes the peak of a correlation sharp, and scaled to ±127.
    pub fn compass(&self, signature: &mut [i8]) {
        let greatest = self.compass.iter().map(|harmonic| harmonic.norm_sqr().sqrt()).fold(f32::MIN_POSITIVE, f32::max);
        for (parts, harmonic) in signature.chunks_exact_mut(2).zip(&self.compass) {
            let scale = COMPASS_GREATEST / (harmonic.norm_sqr().sqrt() * greatest).sqrt().max(f32::MIN_POSITIVE);
            parts[0] = (harmonic.re * scale).round() as i8;
            parts[1] = (harmonic.im * scale).round() as i8;
        }
    }

    /// plane = log of the reduced panorama.
    fn reduce_to_log(&mut self, panorama: &Panorama) {
        let area = (REDUCTION * REDUCTION) as f32;
        for (row, reduced) in self.plane.chunks_exact_mut(COLUMNS).enumerate() {
            reduced.fill(0.0);
            for wide in panorama.wide[row * REDUCTION * WIDE_COLUMNS..].chunks_exact(WIDE_COLUMNS).take(REDUCTION) {
                for (sum, group) in reduced.iter_mut().zip(wide.chunks_exact(REDUCTION)) {
                    *sum += group.iter().sum::<f32>();
                }
            }
            reduced.iter_mut().for_each(|sum| *sum = libm::logf(*sum / area + DARK_LEVEL));
        }
    }

    /// east, north = ∇ plane (north: down the rows); local_mean = |∇ plane|.
    fn differentiate(&mut self) {
        for row in 0..ROWS {
            let at = row * COLUMNS;
            let above = row.saturating_sub(1) * COLUMNS;
            let below = (row + 1).min(ROWS - 1) * COLUMNS;
            let here = &self.plane[at..at + COLUMNS];
            let east = &mut self.east[at..at + COLUMNS];
            for (slope, ends) in east[1..COLUMNS - 1].iter_mut().zip(here.windows(3)) {
                *slope = 0.5 * (ends[2] - ends[0]);
            }
            east[0] = 0.5 * (here[1] - here[COLUMNS - 1]);
            east[COLUMNS - 1] = 0.5 * (here[0] - here[COLUMNS - 2]);
            let vertical = self.plane[above..above + COLUMNS].iter().zip(&self.plane[below..below + COLUMNS]);
            for (slope, (above, below)) in self.north[at..at + COLUMNS].iter_mut().zip(vertical) {
                *slope = 0.5 * (below - above);
            }
        }
        for (norm, (east, north)) in self.local_mean.iter_mut().zip(self.east.iter().zip(&self.north)) {
            *norm = (east * east + north * north).sqrt();
        }
    }

    /// bins = h_b(e, a), bin × band × azimuth.
    fn gather_orientations(&mut self) {
        let plane = BANDS * COLUMNS;
        self.bins.fill(0.0);
        for i in 0..ROWS * COLUMNS {
            let (east, north) = (self.east[i], self.north[i]);
            let weight = (east * east + north * north).sqrt() / (self.local_mean[i] + CONTRAST_FLOOR);
            let turn = atan2(north, east) * (BINS as f32 / TAU);
            let position = if turn < 0.0 { turn + BINS as f32 } else { turn };
            let bin = position as usize;
            let share = position - bin as f32;
            let at = i / COLUMNS / ROWS_A_BAND * COLUMNS + i % COLUMNS;
            self.bins[bin % BINS * plane + at] += weight * (1.0 - share);
            self.bins[(bin + 1) % BINS * plane + at] += weight * share;
        }
        let mean = 1.0 / ROWS_A_BAND as f32;
        self.bins.iter_mut().for_each(|sum| *sum *= mean);
    }

    fn transform_bands(&mut self) {
        self.compass.fill(Complex::default());
        let rows = self.bins.chunks_exact(COLUMNS);
        for (i, (row, harmonics)) in rows.zip(self.harmonics.chunks_exact_mut(HARMONICS)).enumerate() {
            // The transform overwrites what it reads.
            self.row.copy_from_slice(row);
            self.transform
                .process_with_scratch(&mut self.row, &mut self.spectrum, &mut self.fft_scratch)
                .expect("the buffers come from the plan");
            harmonics.copy_from_slice(&self.spectrum[..HARMONICS]);
            let (bin, band) = (i / BANDS % COMPASS_BINS, i % BANDS * COMPASS_BANDS / BANDS);
            let compass = &mut self.compass[(bin * COMPASS_BANDS + band) * COMPASS_HARMONICS..][..COMPASS_HARMONICS];
            compass.iter_mut().zip(&self.spectrum[1..]).for_each(|(sum, harmonic)| *sum += harmonic);
        }
    }
}

/// Half of a symmetric Gaussian kernel, centre first, cut off at 3 σ; its sum over both halves is 1.
fn gaussian_kernel(sigma: f32) -> Vec<f32> {
    let radius = (3.0 * sigma).ceil() as i32;
    let mut half: Vec<f32> = (0..=radius).map(|i| libm::expf(-0.5 * (i as f32 / sigma).powi(2))).collect();
    let sum = 2.0 * half.iter().sum::<f32>() - half[0];
    half.iter_mut().for_each(|weight| *weight /= sum);
    half
}

/// Blurs `plane` (rows of `columns`) in place with a separable kernel given by its half.
fn blur(plane: &mut [f32], scratch: &mut [f32], columns: usize, half: &[f32]) {
    let rows = plane.len() / columns;
    // Down the columns, rows repeated at the rims.
    for (row, blurred) in scratch.chunks_exact_mut(columns).enumerate() {
        let center = &plane[row * columns..(row + 1) * columns];
        blurred.iter_mut().zip(center).for_each(|(sum, value)| *sum = half[0] * value);
        for (offset, &weight) in half.iter().enumerate().skip(1) {
            let above = &plane[row.saturating_sub(offset) * columns..][..columns];
            let below = &plane[(row + offset).min(rows - 1) * columns..][..columns];
            for (sum, (above, below)) in blurred.iter_mut().zip(above.iter().zip(below)) {
                *sum += weight * (above + below);
            }
        }
    }
    // Along the rows, which wrap round.
    let mut wrapped = [0.0_f32; WIDE_COLUMNS + 2 * MAX_RADIUS];
    let radius = half.len() - 1;
    for (row, blurred) in scratch.chunks_exact(columns).zip(plane.chunks_exact_mut(columns)) {
        let wrapped = &mut wrapped[..columns + 2 * radius];
        wrapped[..radius].copy_from_slice(&row[columns - radius..]);
        wrapped[radius..radius + columns].copy_from_slice(row);
        wrapped[radius + columns..].copy_from_slice(&row[..radius]);
        blurred.iter_mut().zip(row).for_each(|(sum, value)| *sum = half[0] * value);
        for (offset, &weight) in half.iter().enumerate().skip(1) {
            let left = &wrapped[radius - offset..];
            let right = &wrapped[radius + offset..];
            for (sum, (left, right)) in blurred.iter_mut().zip(left.iter().zip(right)) {
                *sum += weight * (left + right);
            }
        }
    }
}

/// Widest half kernel of the sizes above.
const MAX_RADIUS: usize = 24;

/// Direction of (x, y) in (−π, π], to 1e-5 rad: minimax polynomial of the arctangent on \[0, 1\] (Abramowitz & Stegun
/// 4.4.49), extended by symmetry. Exact zero for the zero vector.
fn atan2(y: f32, x: f32) -> f32 {
    use std::f32::consts::{FRAC_PI_2, PI};
    let (ax, ay) = (x.abs(), y.abs());
    let ratio = ax.min(ay) / ax.max(ay).max(f32::MIN_POSITIVE);
    let square = ratio * ratio;
    let polynomial =
        0.999_866 + square * (-0.330_299_5 + square * (0.180_141 + square * (-0.085_133 + square * 0.020_835_1)));
    let first_octant = ratio * polynomial;
    let first_quadrant = if ay > ax { FRAC_PI_2 - first_octant } else { first_octant };
    let upper_half = if x < 0.0 { PI - first_quadrant } else { first_quadrant };
    if y < 0.0 { -upper_half } else { upper_half }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::golden::golden_panorama;

    fn textured() -> Panorama {
        let mut panorama = golden_panorama();
        for (i, value) in panorama.wide.iter_mut().enumerate() {
            let (row, column) = ((i / WIDE_COLUMNS) as f32, (i % WIDE_COLUMNS) as f32);
            let turn = TAU * column / WIDE_COLUMNS as f32;
            *value = 120.0 + 60.0 * (3.0 * turn + row / 9.0).sin() + 30.0 * (17.0 * turn).cos() * (row / 5.0).sin();
        }
        panorama
    }

    fn describe(panorama: &Panorama) -> Vec<f32> {
        let mut properties = vec![0.0; DIMENSIONS];
        let mut signature = GradientSignature::new();
        signature.look(panorama);
        signature.describe(&mut properties);
        properties
    }

    fn distance(a: &[f32], b: &[f32]) -> f32 {
        a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum::<f32>().sqrt()
    }

    #[test]
    fn opposite_bins_are_added() {
        let mut signature = GradientSignature::new();
        signature.look(&textured());
        let mut properties = vec![0.0; DIMENSIONS];
        signature.describe(&mut properties);
        // The other route: add the histograms, then transform.
        signature.differentiate();
        blur(&mut signature.local_mean, &mut signature.scratch, COLUMNS, &signature.contrast);
        signature.gather_orientations();
        let (first, opposite) = signature.bins.split_at_mut(BINS / 2 * BANDS * COLUMNS);
        first.iter_mut().zip(&*opposite).for_each(|(sum, opposite)| *sum += opposite);
        signature.transform_bands();
        let scale = 1.0 / COLUMNS as f32;
        let mut direct: Vec<f32> =
            signature.harmonics[..DIMENSIONS].iter().map(|harmonic| (scale * harmonic.norm()).sqrt()).collect();
        let norm = direct.iter().map(|y| y * y).sum::<f32>().sqrt();
        direct.iter_mut().for_each(|y| *y /= norm);
        assert!(distance(&properties, &direct) < 1e-5, "{}", distance(&properties, &direct));
    }

    #[test]
    fn a_turn_leaves_the_properties_as_they_are() {
        let before = describe(&textured());
        let after = describe(&textured().rolled(8 * 29));
        assert!(distance(&before, &after) < 2e-2, "{}", distance(&before, &after));
    }

    #[test]
    fn light_hardly_matters_and_the_scene_does() {
        let mut brighter = textured();
        brighter.wide.iter_mut().for_each(|value| *value = 1.25 * *value + 3.0);
        let mut other = textured();
        for (i, value) in other.wide.iter_mut().enumerate() {
            *value += 30.0 * ((i / WIDE_COLUMNS) as f32 / 3.0).sin();
        }
        let here = describe(&textured());
        assert!((here.iter().map(|y| y * y).sum::<f32>() - 1.0).abs() < 1e-5, "unit norm");
        let (light, scene) = (distance(&here, &describe(&brighter)), distance(&here, &describe(&other)));
        assert!(light < 0.05 && scene > 5.0 * light, "light {light}, scene {scene}");
    }

    #[test]
    fn a_blank_panorama_has_a_descriptor() {
        assert!(describe(&Panorama::zeros()).iter().all(|y| y.is_finite()));
    }

    #[test]
    fn arctangent_is_close_to_the_library_s() {
        for i in 0..1000 {
            let angle = (i as f32 / 1000.0 - 0.5) * TAU * 0.9999;
            assert!((atan2(3.0 * angle.sin(), 3.0 * angle.cos()) - angle).abs() < 2e-5, "{angle}");
        }
        assert_eq!(atan2(0.0, 0.0), 0.0);
    }

    #[test]
    fn blurring_keeps_a_constant_and_wraps_round() {
        let half = gaussian_kernel(2.0);
        let (mut plane, mut scratch) = (vec![3.0; 32 * 8], vec![0.0; 32 * 8]);
        blur(&mut plane, &mut scratch, 32, &half);
        assert!(plane.iter().all(|value| (value - 3.0).abs() < 1e-5));
        let mut spot = vec![0.0; 32 * 8];
        spot[4 * 32] = 1.0;
        blur(&mut spot, &mut scratch, 32, &half);
        assert_eq!(spot[4 * 32 + 1], spot[4 * 32 + 31]);
    }
}
