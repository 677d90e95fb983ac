//! Steerable pyramid: `sp`, 72 properties.

use std::f64::consts::{FRAC_PI_2, PI};
use std::ops::Range;
use std::sync::Arc;

use rustfft::num_complex::Complex;
use rustfft::{Fft, FftNum, FftPlanner};

use crate::panorama::{GRAY_SIZE, Panorama};

const SCALES: usize = 4;
const ORIENTATIONS: usize = 6;
/// Thirds of a band's height: top, middle, bottom.
const ZONES: usize = 3;
pub const DIMENSIONS: usize = SCALES * ORIENTATIONS * ZONES;
/// Numbers added, or rows transposed, at a time: a divisor of every band's size.
const LANES: usize = 8;

/// Mean filter responses of the steerable pyramid of Simoncelli & Freeman (1995), 4 scales × 6 orientations, over the
/// top, middle and bottom third of each band, in the order scale, orientation, zone: the means of |real response|. The
/// signed mean of a band-pass band is zero but for noise, so this is how we read the paper's “average filter responses”.
///
/// The pyramid is built in the frequency domain, as in `buildSFpyr` of matlabPyrTools and `SteerablePyramidFreq` of
/// pyrtools. With ω normalized to 1 at the Nyquist frequency of the full image, r = |ω|, θ = arg ω, and
///
/// ```text
/// H(ρ) = cos(π/2 · clamp(−log2 ρ, 0, 1))        raised cosine over one octave: 0 below ½, 1 above 1
/// L(ρ) = √(1 − H(ρ)²)
/// G_k(θ) = c (cos(θ − πk/6))⁵                   c² = 2^10 (5!)² / (6 · 10!)
/// band (s, k) = IFFT[ F · L(r) · L(2r) ⋯ L(2^s r) · H(2^(s+1) r) · (−i)⁵ G_k(θ) ]
/// ```
///
/// where scale s keeps only the central 128/2^s frequencies of each axis: its bands are that much smaller, and larger in
/// amplitude by 4^s. Since L(2^s r) vanishes at the Nyquist frequency of scale s, every real band is the inverse of a
/// Hermitian spectrum, so that two bands are had from one complex transform.
pub struct SteerablePyramid<T: FftNum> {
    forward: Plane<T>,
    scales: Vec<Scale<T>>,
    spectrum: Vec<Complex<T>>,
}

/// One scale: its size, inverse transform and filters.
struct Scale<T: FftNum> {
    size: usize,
    plane: Plane<T>,
    /// `size` × `size` real factors an orientation, without (−i)⁵: frequency (u, v) at `v * size + u`, in FFT order.
    filters: Vec<Vec<T>>,
    band: Vec<Complex<T>>,
}

/// 2-D FFT of a square, rows then columns, the result transposed.
struct Plane<T: FftNum> {
    size: usize,
    fft: Arc<dyn Fft<T>>,
    scratch: Vec<Complex<T>>,
    transposed: Vec<Complex<T>>,
}

impl<T: FftNum + Into<f64>> SteerablePyramid<T> {
    pub fn new() -> Self {
        let mut planner = FftPlanner::new();
        let scales = (0..SCALES)
            .map(|s| {
                let size = GRAY_SIZE >> s;
                Scale {
                    size,
                    plane: Plane::new(planner.plan_fft_inverse(size)),
                    filters: (0..ORIENTATIONS).map(|k| band_filter(s, k, size)).collect(),
                    band: vec![zero(); size * size],
                }
            })
            .collect();
        Self {
            forward: Plane::new(planner.plan_fft_forward(GRAY_SIZE)),
            scales,
            spectrum: vec![zero(); GRAY_SIZE * GRAY_SIZE],
        }
    }

    pub fn describe(&mut self, panorama: &Panorama, properties: &mut [f32]) {
        for (sample, &value) in self.spectrum.iter_mut().zip(&panorama.gray) {
            // Around mid-gray: no band sees the mean, and small numbers keep their digits.
            *sample = Complex::new(convert(f64::from(value) - 128.0), T::zero());
        }
        // The spectrum stays transposed: (u, v) at u * 128 + v. Filters and bands below are transposed likewise.
        let spectrum = &*self.forward.transform(&mut self.spectrum);
        let of_scales = properties.chunks_exact_mut(ORIENTATIONS * ZONES);
        for (scale, properties) in self.scales.iter_mut().zip(of_scales) {
            scale.describe(spectrum, properties);
        }
    }
}

impl<T: FftNum + Into<f64>> Default for SteerablePyramid<T> {
    fn default() -> Self {
        Self::new()
    }
}

impl<T: FftNum + Into<f64>> Scale<T> {
    /// Zone means of |real band|, two orientations a transform: band k in the real part, k + 1 in the imaginary part.
    fn describe(&mut self, spectrum: &[Complex<T>], properties: &mut [f32]) {
        for (pair, properties) in properties.chunks_exact_mut(2 * ZONES).enumerate() {
            let (first, second) = (&self.filters[2 * pair], &self.filters[2 * pair + 1]);
            for (here, full) in halves_of_rows(self.size) {
                let filters = first[here.clone()].iter().zip(&second[here.clone()]);
                for ((band, f), (&a, &b)) in self.band[here].iter_mut().zip(&spectrum[full]).zip(filters) {
                    // (a + i b) · F · (−i)⁵ with (−i)⁵ = −i.
                    *band = Complex::new(a * f.im + b * f.re, b * f.im - a * f.re);
                }
            }
            let band = self.plane.transform(&mut self.band);
            let means = zone_means(band, self.size);
            for (zone, (real, imaginary)) in means.into_iter().enumerate() {
                properties[zone] = real as f32;
                properties[ZONES + zone] = imaginary as f32;
            }
        }
    }
}

/// The halves of each row of a band of `size`, of frequencies from 0 up and below 0, and where the same frequencies lie
/// in the full spectrum.
fn halves_of_rows(size: usize) -> impl Iterator<Item = (Range<usize>, Range<usize>)> {
    let half = size / 2;
    let wrap = move |index: usize| if index < half { index } else { index + GRAY_SIZE - size };
    (0..size).flat_map(move |row| {
        [0, half].map(|column| {
            let (here, full) = (row * size + column, wrap(row) * GRAY_SIZE + wrap(column));
            (here..here + half, full..full + half)
        })
    })
}

/// Means of |real part| and |imaginary part| over the three zones of a band. The mean is over rows
/// \[⌊tH/3⌋, ⌊(t+1)H/3⌋), t = 0, 1, 2, divided by the number of values and by H² for the inverse transform.
fn zone_means<T: FftNum + Into<f64>>(band: &[Complex<T>], size: usize) -> [(f64, f64); ZONES] {
    std::array::from_fn(|t| {
        let (top, bottom) = (t * size / ZONES, (t + 1) * size / ZONES);
        let mut sums = (0.0, 0.0);
        for row in band[top * size..bottom * size].chunks_exact(size) {
            // One sum a lane: sums in order could not be taken several at once.
            let mut lanes = [(T::zero(), T::zero()); LANES];
            for values in row.as_chunks::<LANES>().0 {
                for ((first, second), value) in lanes.iter_mut().zip(values) {
                    *first = *first + value.re.abs();
                    *second = *second + value.im.abs();
                }
            }
            for (first, second) in lanes {
                sums.0 += Into::<f64>::into(first);
                sums.1 += Into::<f64>::into(second);
            }
        }
        let count = ((bottom - top) * size * size * size) as f64;
        (sums.0 / count, sums.1 / count)
    })
}

impl<T: FftNum> Plane<T> {
    fn new(fft: Arc<dyn Fft<T>>) -> Self {
        let size = fft.len();
        Self { size, scratch: vec![zero(); fft.get_inplace_scratch_len()], transposed: vec![zero(); size * size], fft }
    }

    /// The transform of `data`, transposed; `data` is overwritten.
    fn transform(&mut self, data: &mut [Complex<T>]) -> &mut [Complex<T>] {
        self.fft.process_with_scratch(data, &mut self.scratch);
        transpose(data, &mut self.transposed, self.size);
        self.fft.process_with_scratch(&mut self.transposed, &mut self.scratch);
        &mut self.transposed
    }
}

fn transpose<T: Copy>(from: &[T], to: &mut [T], size: usize) {
    for (band, rows) in from.chunks_exact(LANES * size).enumerate() {
        for (column, to) in to.chunks_exact_mut(size).enumerate() {
            for (i, to) in to[band * LANES..(band + 1) * LANES].iter_mut().enumerate() {
                *to = rows[i * size + column];
            }
        }
    }
}

fn zero<T: FftNum>() -> Complex<T> {
    Complex::new(T::zero(), T::zero())
}

fn convert<T: FftNum>(value: f64) -> T {
    T::from_f64(value).expect("a finite f64 converts to a float")
}

/// H of the type's documentation.
fn high_pass(r: f64) -> f64 {
    libm::cos(FRAC_PI_2 * (-libm::log2(r)).clamp(0.0, 1.0))
}

fn low_pass(r: f64) -> f64 {
    (1.0 - high_pass(r).powi(2)).max(0.0).sqrt()
}

/// The real factor of band (`scale`, `orientation`), transposed: horizontal frequency u, vertical frequency v at
/// `u * size + v`.
fn band_filter<T: FftNum>(scale: usize, orientation: usize, size: usize) -> Vec<T> {
    let signed = |index: usize| if index < size / 2 { index as f64 } else { index as f64 - size as f64 };
    let order = (ORIENTATIONS - 1) as i32;
    let gain = (2.0_f64.powi(10) * 120.0 * 120.0 / (ORIENTATIONS as f64 * 3_628_800.0)).sqrt();
    let nyquist = (GRAY_SIZE / 2) as f64;
    let mut filter = Vec::with_capacity(size * size);
    for u in 0..size {
        for v in 0..size {
            let (x, y) = (signed(u) / nyquist, signed(v) / nyquist);
            let r = libm::hypot(x, y);
            let radial = if r == 0.0 {
                0.0
            } else {
                (0..=scale).map(|s| low_pass(r * f64::from(1 << s))).product::<f64>()
                    * high_pass(r * f64::from(1 << (scale + 1)))
            };
            let angle = libm::atan2(y, x) - PI * orientation as f64 / ORIENTATIONS as f64;
            filter.push(convert(radial * gain * libm::cos(angle).powi(order)));
        }
    }
    filter
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::golden::{assert_close, golden, golden_panorama, list};

    fn describe<T: FftNum + Into<f64>>(panorama: &Panorama) -> Vec<f32> {
        let mut properties = vec![0.0; DIMENSIONS];
        SteerablePyramid::<T>::new().describe(panorama, &mut properties);
        properties
    }

    #[test]
    fn equals_the_reference_values() {
        let (golden, panorama) = (golden(), golden_panorama());
        let exact = describe::<f64>(&panorama);
        assert_close("sp72_absreal", &exact, &list(&golden["sp72_absreal"]), 1e-6);
        assert_close("pyrtools", &exact, &list(&golden["sp72_pyrtools_absreal"]), 1e-4);
        assert_close("in single precision", &describe::<f32>(&panorama), &list(&golden["sp72_absreal"]), 1e-5);
    }

    /// Σ_k G_k² = 1 and L0² (L² H² …) telescopes: the energies of all bands of a scale add up to the ring it covers.
    #[test]
    fn the_orientations_of_a_scale_cover_its_ring_evenly() {
        let filters: Vec<Vec<f64>> = (0..ORIENTATIONS).map(|k| band_filter(0, k, GRAY_SIZE)).collect();
        for (u, v) in [(20, 0), (0, 30), (14, 14), (31, 7), (100, 12)] {
            let sum: f64 = filters.iter().map(|filter| filter[u * GRAY_SIZE + v].powi(2)).sum();
            let signed = |i: usize| if i < 64 { i as f64 } else { i as f64 - 128.0 };
            let r = signed(u).hypot(signed(v)) / 64.0;
            let ring = (low_pass(r) * high_pass(2.0 * r)).powi(2);
            assert!((sum - ring).abs() < 1e-12, "({u}, {v}): {sum} instead of {ring}");
        }
    }

    #[test]
    fn brightness_does_not_matter_and_a_turn_by_whole_columns_neither() {
        let panorama = golden_panorama();
        // Three columns of the coarsest band, which are 8 of the panorama's each.
        let mut brighter = panorama.rolled(8 * 8 * 3);
        brighter.gray.iter_mut().for_each(|value| *value += 5.0);
        for (a, b) in describe::<f32>(&panorama).iter().zip(describe::<f32>(&brighter)) {
            assert!((a - b).abs() < 1e-4 * a, "{a} became {b}");
        }
    }
}
