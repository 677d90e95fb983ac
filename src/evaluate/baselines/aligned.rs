//! Nearest learning image whatever the heading: circular correlation of small panoramas, as in visual-compass and
//! route-following work (Zeil, Hofmann & Chahl 2003; Milford & Wyeth 2012 even out patches the same way).

use std::sync::Arc;

use rayon::prelude::*;
use realfft::num_complex::Complex32;
use realfft::{ComplexToReal, RealFftPlanner, RealToComplex};

use crate::panorama::{Panorama, WIDE_COLUMNS, WIDE_ROWS};

/// Columns and rows of the small panorama.
const COLUMNS: usize = 128;
const ROWS: usize = 32;
/// Harmonics of a row.
const HARMONICS: usize = COLUMNS / 2 + 1;
/// Deviation of the Gaussian window in which mean and contrast are evened out \[px\].
const WINDOW_PX: f32 = 4.0;
/// The window reaches this far \[px\].
const REACH: usize = 16;
/// Added to a window's deviation, in gray levels: what is flat stays flat.
const CONTRAST_FLOOR: f32 = 4.0;

/// The small panorama f of one frame, by its Fourier transform along the rows.
///
/// With w the 512 × 128 panorama averaged to 128 × 32, and the mean m and deviation s of a Gaussian window of 4 px,
///
/// ```text
/// g = (w − m) / (s + 4)        f = (g − mean g) / |g − mean g|        F(a, l) = Σ_b f(a, b) exp(−2πi l b / 128)
/// ```
pub type Signature = Vec<Complex32>;

/// Makes signatures.
pub struct Signatures {
    forward: Arc<dyn RealToComplex<f32>>,
    window: Vec<f32>,
}

impl Signatures {
    pub fn new() -> Self {
        let weight = |i: usize| {
            let away = i as f32 - REACH as f32;
            (-0.5 * away * away / (WINDOW_PX * WINDOW_PX)).exp()
        };
        let weights: Vec<f32> = (0..=2 * REACH).map(weight).collect();
        let total: f32 = weights.iter().sum();
        let window = weights.iter().map(|weight| weight / total).collect();
        Self { forward: RealFftPlanner::new().plan_fft_forward(COLUMNS), window }
    }

    pub fn of(&self, panorama: &Panorama) -> Signature {
        let small = small(panorama);
        let squares: Vec<f32> = small.iter().map(|w| w * w).collect();
        let (means, mean_squares) = (self.smoothed(&small), self.smoothed(&squares));
        let mut evened: Vec<f32> = small
            .iter()
            .zip(means.iter().zip(&mean_squares))
            .map(|(w, (mean, square))| (w - mean) / ((square - mean * mean).max(0.0).sqrt() + CONTRAST_FLOOR))
            .collect();
        let mean = evened.iter().sum::<f32>() / evened.len() as f32;
        evened.iter_mut().for_each(|g| *g -= mean);
        let length = evened.iter().map(|g| g * g).sum::<f32>().sqrt();
        let scale = if length > 0.0 { 1.0 / length } else { 0.0 };
        let mut signature = vec![Complex32::default(); ROWS * HARMONICS];
        for (row, harmonics) in evened.chunks_exact_mut(COLUMNS).zip(signature.chunks_exact_mut(HARMONICS)) {
            row.iter_mut().for_each(|g| *g *= scale);
            self.forward.process(row, harmonics).expect("the buffers are of the plan's lengths");
        }
        signature
    }

    /// In the window about every pixel: round the horizon; the first and last row are repeated above and below.
    fn smoothed(&self, image: &[f32]) -> Vec<f32> {
        let at = |row: usize, column: usize| image[row * COLUMNS + column % COLUMNS];
        let across: Vec<f32> = (0..ROWS * COLUMNS)
            .map(|pixel| {
                let (row, column) = (pixel / COLUMNS, pixel % COLUMNS);
                let terms = self.window.iter().enumerate();
                terms.map(|(i, weight)| weight * at(row, column + COLUMNS + i - REACH)).sum()
            })
            .collect();
        (0..ROWS * COLUMNS)
            .map(|pixel| {
                let (row, column) = (pixel / COLUMNS, pixel % COLUMNS);
                let clamped = |i: usize| (row + i).saturating_sub(REACH).min(ROWS - 1);
                let terms = self.window.iter().enumerate();
                terms.map(|(i, weight)| weight * across[clamped(i) * COLUMNS + column]).sum()
            })
            .collect()
    }
}

impl Default for Signatures {
    fn default() -> Self {
        Self::new()
    }
}

/// The panorama, area-averaged.
fn small(panorama: &Panorama) -> Vec<f32> {
    let (per_column, per_row) = (WIDE_COLUMNS / COLUMNS, WIDE_ROWS / ROWS);
    let mut small = vec![0.0; ROWS * COLUMNS];
    for (row, wide) in panorama.wide.chunks_exact(WIDE_COLUMNS).enumerate() {
        let small = &mut small[row / per_row * COLUMNS..][..COLUMNS];
        for (mean, group) in small.iter_mut().zip(wide.chunks_exact(per_column)) {
            *mean += group.iter().sum::<f32>() / (per_column * per_row) as f32;
        }
    }
    small
}

/// For each of `queries`, which of `rows` has the greatest correlation over all turns t:
/// max_t Σ_(a,b) f_row(a, b) f_query(a, b + t), by way of Σ_a conj(F_row(a, l)) F_query(a, l).
pub fn nearest(signatures: &[Signature], queries: &[usize], rows: &[usize]) -> Vec<usize> {
    let backward = RealFftPlanner::new().plan_fft_inverse(COLUMNS);
    let of_query = |&query: &usize| {
        let correlation = |row: usize| greatest_correlation(&backward, &signatures[row], &signatures[query]);
        let scored = rows.iter().map(|&row| (row, correlation(row)));
        // Of the same correlation, the first.
        scored.reduce(|best, next| if next.1 > best.1 { next } else { best }).map_or(query, |(row, _)| row)
    };
    queries.par_iter().map(of_query).collect()
}

fn greatest_correlation(backward: &Arc<dyn ComplexToReal<f32>>, row: &Signature, query: &Signature) -> f32 {
    let mut products = [Complex32::default(); HARMONICS];
    for (row, query) in row.chunks_exact(HARMONICS).zip(query.chunks_exact(HARMONICS)) {
        for (product, (a, b)) in products.iter_mut().zip(row.iter().zip(query)) {
            *product += a.conj() * b;
        }
    }
    // Of a real signal; rounding leaves a little.
    products[0].im = 0.0;
    products[HARMONICS - 1].im = 0.0;
    let mut correlations = [0.0; COLUMNS];
    backward.process(&mut products, &mut correlations).expect("the buffers are of the plan's lengths");
    correlations.iter().copied().fold(f32::NEG_INFINITY, f32::max) / COLUMNS as f32
}

#[cfg(test)]
mod tests {
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    fn panorama(seed: u64) -> Panorama {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        // Blocks of 16 × 16 pixels, so that something is left after averaging.
        let blocks: Vec<f32> = (0..8 * 32).map(|_| random.random_range(0.0..255.0)).collect();
        let pixel = |i: usize| blocks[i / WIDE_COLUMNS / 16 * 32 + i % WIDE_COLUMNS / 16];
        Panorama::from_wide((0..WIDE_ROWS * WIDE_COLUMNS).map(pixel).collect())
    }

    #[test]
    fn a_turned_panorama_is_found_among_others() {
        let signatures = Signatures::new();
        let mut all: Vec<Signature> = (0..5).map(|seed| signatures.of(&panorama(seed))).collect();
        all.push(signatures.of(&panorama(3).rolled(8 * 29)));
        assert_eq!(nearest(&all, &[5], &[0, 1, 2, 3, 4]), [3]);
        let backward = RealFftPlanner::new().plan_fft_inverse(COLUMNS);
        // Whole columns of the small panorama: the correlation with itself is 1.
        let found = greatest_correlation(&backward, &all[3], &all[5]);
        assert!((found - 1.0).abs() < 1e-4, "{found}");
        assert!(greatest_correlation(&backward, &all[2], &all[5]) < 0.5);
    }

    #[test]
    fn light_that_changes_slowly_over_the_image_matters_little() {
        let signatures = Signatures::new();
        let plain = panorama(1);
        let lit = Panorama::from_wide(
            plain.wide.iter().enumerate().map(|(i, w)| 0.6 * w + 0.1 * (i / WIDE_COLUMNS) as f32 + 20.0).collect(),
        );
        let backward = RealFftPlanner::new().plan_fft_inverse(COLUMNS);
        let found = greatest_correlation(&backward, &signatures.of(&plain), &signatures.of(&lit));
        assert!(found > 0.98, "{found}");
    }

    #[test]
    fn an_image_without_contrast_is_like_nothing() {
        let signatures = Signatures::new();
        let flat = signatures.of(&Panorama::from_wide(vec![255.0; WIDE_ROWS * WIDE_COLUMNS]));
        assert!(flat.iter().all(|f| f.norm() < 1e-3 && f.re.is_finite()));
    }
}
