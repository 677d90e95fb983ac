//! Patches of oriented gradients all around the horizon, and their distribution: `patches`.

use std::f32::consts::{PI, TAU};

use multiversion::multiversion;

use super::gradient::{self, BINS};

/// A cell is so many columns and bands of the gradient signature: 4 × 4 pixels of 256 × 64.
const COLUMNS_A_CELL: usize = 4;
const BANDS_A_CELL: usize = 2;
const COLUMNS: usize = gradient::COLUMNS / COLUMNS_A_CELL;
const ROWS: usize = gradient::BANDS / BANDS_A_CELL;
const CELLS: usize = ROWS * COLUMNS;
/// Cells along a side of a patch, which is 22° wide.
const SIDE: usize = 4;
/// Patches lie so many cells apart around the horizon, and one cell apart in elevation.
const STEP: usize = 2;
const PATCH_COLUMNS: usize = COLUMNS / STEP;
const PATCH_ROWS: usize = ROWS - SIDE + 1;
pub const PATCHES: usize = PATCH_ROWS * PATCH_COLUMNS;
/// Waves along the two sides of a patch and over the orientations: their orders add up to this at most.
const MAX_ORDER: usize = 3;
/// The mean over the orientations, and a cosine and a sine of every order.
const ORIENTATION_WAVES: usize = 1 + 2 * MAX_ORDER;
/// Coefficients of a patch: thirty waves and the elevation.
pub const COEFFICIENTS: usize = 31;
/// Mean weight a pixel that counts as no contrast at all: flat patches are not amplified to noise.
const CONTRAST_FLOOR: f32 = 0.3;

/// One patch: x of [`Patches`].
pub type Patch = [f32; COEFFICIENTS];

/// The patches of one panorama.
///
/// With h_b(e, a) the histograms of gradient orientations of [`GradientSignature`](super::gradient::GradientSignature),
/// 12 bins, averaged over cells of 4 × 4 pixels and with weights ¼, ½, ¼ over neighbouring columns of cells, a patch is
/// 4 × 4 cells, upright, and
///
/// ```text
/// g_(i,j,b) = √ (h_b(i, j) / (Σ_(i,j,b) h_b(i, j) + 16 · 0.3))          RootSIFT (Arandjelović & Zisserman 2012)
/// x_(u,v,w) = Σ_(i,j,b) cos_u(i) cos_v(j) wave_w(b) g_(i,j,b)           orders u + v + m(w) ≤ 3: 30 numbers
/// x_30      = elevation, −½ … ½ from the top of the panorama to the bottom
/// ```
///
/// with orthonormal cosines (DCT-II) along the rows u and columns v, and the orthonormal real Fourier basis over the
/// orientations, w = 0, 1 cos, 1 sin, 2 cos, …: what principal components of such patches look like, without learning
/// any. There are 13 × 32 patches, the top row first.
pub struct Patches {
    cosines: [[f32; SIDE]; MAX_ORDER + 1],
    orientation_waves: [[f32; BINS]; ORIENTATION_WAVES],
    /// Orders (u, v, w) of every coefficient.
    orders: Vec<[usize; 3]>,
    /// Buffers: one value a cell.
    smoothed: Vec<f32>,
    weights: Vec<f32>,
    /// Orientation wave × cell.
    waves: Vec<f32>,
    /// v × orientation wave × row × patch column.
    across: Vec<f32>,
    patches: Vec<Patch>,
}

impl Patches {
    pub fn new() -> Self {
        let cosine = |order: usize, i: usize| {
            let norm = (if order == 0 { 1.0 } else { 2.0 } / SIDE as f32).sqrt();
            norm * libm::cosf(PI * (i as f32 + 0.5) * order as f32 / SIDE as f32)
        };
        let wave = |w: usize, b: usize| {
            let angle = TAU * (w.div_ceil(2) * b) as f32 / BINS as f32;
            match w {
                0 => (1.0 / BINS as f32).sqrt(),
                _ => (2.0 / BINS as f32).sqrt() * if w % 2 == 1 { libm::cosf(angle) } else { libm::sinf(angle) },
            }
        };
        let orders: Vec<[usize; 3]> = (0..=MAX_ORDER)
            .flat_map(|u| (0..=MAX_ORDER).flat_map(move |v| (0..ORIENTATION_WAVES).map(move |w| [u, v, w])))
            .filter(|[u, v, w]| u + v + w.div_ceil(2) <= MAX_ORDER)
            .collect();
        assert_eq!(orders.len() + 1, COEFFICIENTS, "and the elevation");
        Self {
            cosines: std::array::from_fn(|order| std::array::from_fn(|i| cosine(order, i))),
            orientation_waves: std::array::from_fn(|w| std::array::from_fn(|b| wave(w, b))),
            orders,
            smoothed: vec![0.0; CELLS],
            weights: vec![0.0; CELLS],
            waves: vec![0.0; ORIENTATION_WAVES * CELLS],
            across: vec![0.0; (MAX_ORDER + 1) * ORIENTATION_WAVES * ROWS * PATCH_COLUMNS],
            patches: vec![[0.0; COEFFICIENTS]; PATCHES],
        }
    }

    /// Takes in the patches of a panorama with these `orientations`, bin × band × column.
    pub fn look(&mut self, orientations: &[f32]) {
        assert_eq!(orientations.len(), BINS * gradient::BANDS * gradient::COLUMNS, "one value a bin, band and column");
        self.weights.fill(0.0);
        self.waves.fill(0.0);
        for (b, bin) in orientations.chunks_exact(gradient::BANDS * gradient::COLUMNS).enumerate() {
            self.smooth(bin);
            self.weights.iter_mut().zip(&self.smoothed).for_each(|(weight, h)| *weight += h);
            self.smoothed.iter_mut().for_each(|h| *h = h.sqrt());
            for (wave, values) in self.waves.chunks_exact_mut(CELLS).zip(&self.orientation_waves) {
                wave.iter_mut().zip(&self.smoothed).for_each(|(sum, root)| *sum += values[b] * root);
            }
        }
        self.expand_across();
        self.expand_down();
    }

    /// Those of the panorama last looked at.
    pub fn all(&self) -> &[Patch] {
        &self.patches
    }

    /// smoothed = cells of one orientation bin.
    fn smooth(&mut self, bin: &[f32]) {
        let rows = bin.chunks_exact(BANDS_A_CELL * gradient::COLUMNS);
        for (smoothed, bands) in self.smoothed.chunks_exact_mut(COLUMNS).zip(rows) {
            let mut means = [0.0; COLUMNS];
            for band in bands.chunks_exact(gradient::COLUMNS) {
                for (mean, columns) in means.iter_mut().zip(band.chunks_exact(COLUMNS_A_CELL)) {
                    *mean += columns.iter().sum::<f32>() / (BANDS_A_CELL * COLUMNS_A_CELL) as f32;
                }
            }
            for (column, out) in smoothed.iter_mut().enumerate() {
                let (left, right) = ((column + COLUMNS - 1) % COLUMNS, (column + 1) % COLUMNS);
                *out = 0.25 * (means[left] + means[right]) + 0.5 * means[column];
            }
        }
    }

    fn expand_across(&mut self) {
        let lines = self.across.chunks_exact_mut(PATCH_COLUMNS);
        let sources = (0..=MAX_ORDER).flat_map(|v| (0..ORIENTATION_WAVES * ROWS).map(move |line| (v, line)));
        for (across, (v, line)) in lines.zip(sources) {
            let cells = &self.waves[line * COLUMNS..(line + 1) * COLUMNS];
            for (column, out) in across.iter_mut().enumerate() {
                let terms = self.cosines[v].iter().enumerate();
                *out = terms.map(|(j, cosine)| cosine * cells[(STEP * column + j) % COLUMNS]).sum();
            }
        }
    }

    fn expand_down(&mut self) {
        for (at, patch) in self.patches.iter_mut().enumerate() {
            let (row, column) = (at / PATCH_COLUMNS, at % PATCH_COLUMNS);
            let cells = (row..row + SIDE).flat_map(|i| (0..SIDE).map(move |j| (i, (STEP * column + j) % COLUMNS)));
            let weight: f32 = cells.map(|(i, j)| self.weights[i * COLUMNS + j]).sum();
            let scale = 1.0 / (weight + (SIDE * SIDE) as f32 * CONTRAST_FLOOR).sqrt();
            for (coefficient, &[u, v, w]) in patch.iter_mut().zip(&self.orders) {
                let first = ((v * ORIENTATION_WAVES + w) * ROWS + row) * PATCH_COLUMNS + column;
                let terms = self.cosines[u].iter().enumerate();
                let sum: f32 = terms.map(|(i, cosine)| cosine * self.across[first + i * PATCH_COLUMNS]).sum();
                *coefficient = scale * sum;
            }
            patch[COEFFICIENTS - 1] = row as f32 / (PATCH_ROWS - 1) as f32 - 0.5;
        }
    }
}

/// Random frequencies.
pub const DIMENSIONS: usize = 1024;
/// Length scale of the kernel that [`KernelMean`] stands for, in units of x.
const KERNEL_LENGTH: f64 = 0.35;
/// So many frequencies at a time: their sums stay in registers.
const LANES: usize = 32;

/// The mean of the patches of a panorama in the feature space of a Gaussian kernel.
///
/// ```text
/// y_j = mean over the patches of cos(ω_j · x + φ_j)          ω_j ~ N(0, 1/0.35² I), φ_j ~ U(0, 2π); j = 0 … 1023
/// ```
///
/// Random Fourier features (Rahimi & Recht 2007) of the kernel mean (Smola, Gretton, Song & Schölkopf 2007): distances
/// between two y are distances between the two distributions of patches, as a bag of visual words measures them, but
/// with no words to learn and nothing that jumps from one word to the next. A turn of the vehicle only reorders the
/// patches. The frequencies are the same in every program: maps depend on them.
pub struct KernelMean {
    /// ω / 2π, a block of [`LANES`] frequencies each.
    frequencies: Vec<[[f32; LANES]; COEFFICIENTS]>,
    /// φ / 2π, in turns.
    phases: Vec<[f32; LANES]>,
}

impl KernelMean {
    pub fn new() -> Self {
        let mut random = SplitMix(0);
        let mut frequencies = vec![[[0.0; LANES]; COEFFICIENTS]; DIMENSIONS / LANES];
        let mut phases = vec![[0.0; LANES]; DIMENSIONS / LANES];
        for j in 0..DIMENSIONS {
            let (block, lane) = (j / LANES, j % LANES);
            for coefficient in &mut frequencies[block] {
                coefficient[lane] = (random.normal() / (KERNEL_LENGTH * std::f64::consts::TAU)) as f32;
            }
            phases[block][lane] = random.uniform() as f32;
        }
        Self { frequencies, phases }
    }

    pub fn describe(&self, patches: &[Patch], properties: &mut [f32]) {
        let blocks = self.frequencies.iter().zip(&self.phases);
        for (means, (frequencies, phases)) in properties.chunks_exact_mut(LANES).zip(blocks) {
            let sums = sum_of_cosines(patches, frequencies, phases);
            means.iter_mut().zip(sums).for_each(|(mean, sum)| *mean = sum / patches.len() as f32);
        }
    }
}

#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2+fma"))]
fn sum_of_cosines(
    patches: &[Patch],
    frequencies: &[[f32; LANES]; COEFFICIENTS],
    phases: &[f32; LANES],
) -> [f32; LANES] {
    let mut sums = [0.0; LANES];
    for patch in patches {
        let mut turns = *phases;
        for (x, frequencies) in patch.iter().zip(frequencies) {
            for (turns, frequency) in turns.iter_mut().zip(frequencies) {
                *turns += x * frequency;
            }
        }
        for (sum, turns) in sums.iter_mut().zip(turns) {
            *sum += cosine_of_turns(turns);
        }
    }
    sums
}

/// cos(2π t) to 5e-5 for |t| < 2²²: a polynomial in r², r = t − round(t), by least squares at Chebyshev points.
#[inline]
fn cosine_of_turns(t: f32) -> f32 {
    // Adding 1.5 · 2²³ leaves no bits for a fraction; unlike `round`, that is one instruction everywhere.
    const ROUNDING: f32 = 12_582_912.0;
    let r = t - ((t + ROUNDING) - ROUNDING);
    let x = r * r;
    0.999_959 + x * (-19.730_942 + x * (64.671_44 + x * (-82.390_81 + x * 45.621_05)))
}

/// Sebastiano Vigna's SplitMix64, and normal numbers by Box & Muller (1958).
struct SplitMix(u64);

impl SplitMix {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let z = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    /// In \[0, 1).
    fn uniform(&mut self) -> f64 {
        (self.next() >> 11) as f64 / (1_u64 << 53) as f64
    }

    fn normal(&mut self) -> f64 {
        let radius = (-2.0 * libm::log(1.0 - self.uniform())).sqrt();
        radius * libm::cos(std::f64::consts::TAU * self.uniform())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn orientations() -> Vec<f32> {
        let mut random = SplitMix(7);
        (0..BINS * gradient::BANDS * gradient::COLUMNS).map(|_| (3.0 * random.uniform()).powi(3) as f32).collect()
    }

    /// The definition, written out: one patch at a time, all 192 numbers of it.
    #[test]
    fn coefficients_equal_those_of_the_whole_patch() {
        let orientations = orientations();
        let mut patches = Patches::new();
        patches.look(&orientations);
        let found = patches.all();
        let cell = |b: usize, row: usize, column: usize| -> f32 {
            let mean = |column: usize| -> f32 {
                let pixels =
                    (0..2).flat_map(|band| (0..4).map(move |i| (2 * row + band) * 256 + 4 * (column % 64) + i));
                pixels.map(|pixel| orientations[b * 32 * 256 + pixel]).sum::<f32>() / 8.0
            };
            0.25 * mean(column + 63) + 0.5 * mean(column) + 0.25 * mean(column + 1)
        };
        for at in [0, 31, 200, PATCHES - 1] {
            let (row, column) = (at / 32, 2 * (at % 32));
            let h = |b: usize, i: usize, j: usize| cell(b, row + i, column + j);
            let everywhere = || (0..12).flat_map(|b| (0..16).map(move |ij| (b, ij / 4, ij % 4)));
            let total: f32 = everywhere().map(|(b, i, j)| h(b, i, j)).sum();
            let norm = |order: usize, n: f32| ((if order == 0 { 1.0 } else { 2.0 }) / n).sqrt();
            let mut orders = Vec::new();
            for u in 0..4 {
                for v in 0..4 {
                    orders.extend((0..7).map(|w: usize| (u, v, w)).filter(|(u, v, w)| u + v + w.div_ceil(2) <= 3));
                }
            }
            for (k, &(u, v, w)) in orders.iter().enumerate() {
                let m = w.div_ceil(2);
                let direct: f32 = everywhere()
                    .map(|(b, i, j)| {
                        let along = |order: usize, i: usize| {
                            norm(order, 4.0) * (PI * (i as f32 + 0.5) * order as f32 / 4.0).cos()
                        };
                        let angle = TAU * (m * b) as f32 / 12.0;
                        let wave = norm(m, 12.0) * if w > 0 && w % 2 == 0 { angle.sin() } else { angle.cos() };
                        along(u, i) * along(v, j) * wave * (h(b, i, j) / (total + 16.0 * 0.3)).sqrt()
                    })
                    .sum();
                assert!((found[at][k] - direct).abs() < 1e-5, "patch {at}, {u} {v} {w}: {} {direct}", found[at][k]);
            }
        }
        assert_eq!((found[0][30], found[PATCHES - 1][30]), (-0.5, 0.5));
    }

    #[test]
    fn a_turn_reorders_the_patches() {
        let before = orientations();
        let mut after = before.clone();
        after.chunks_exact_mut(gradient::COLUMNS).for_each(|row| row.rotate_right(STEP * COLUMNS_A_CELL));
        let (mut one, mut other) = (Patches::new(), Patches::new());
        one.look(&before);
        other.look(&after);
        for (row, turned) in one.all().chunks_exact(PATCH_COLUMNS).zip(other.all().chunks_exact(PATCH_COLUMNS)) {
            for (column, patch) in row.iter().enumerate() {
                let moved = &turned[(column + 1) % PATCH_COLUMNS];
                assert!(patch.iter().zip(moved).all(|(a, b)| (a - b).abs() < 1e-5));
            }
        }
    }

    #[test]
    fn cosines_are_those_of_the_library() {
        for i in -4000..4000_i16 {
            let turns = f32::from(i) * 0.003;
            assert!((cosine_of_turns(turns) - (TAU * turns).cos()).abs() < 6e-5, "{turns}");
        }
    }

    /// What the features are for: their inner products are the kernel (Rahimi & Recht 2007, claim 1).
    #[test]
    fn inner_products_are_those_of_the_kernel() {
        let embedding = KernelMean::new();
        let mut random = SplitMix(3);
        for distance in [0.0, 0.2, 0.35, 0.6_f32] {
            let here: Patch = std::array::from_fn(|_| 0.2 * random.normal() as f32);
            let way: Patch = std::array::from_fn(|_| random.normal() as f32);
            let length = way.iter().map(|w| w * w).sum::<f32>().sqrt();
            let there: Patch = std::array::from_fn(|k| here[k] + distance * way[k] / length);
            let (mut a, mut b) = (vec![0.0; DIMENSIONS], vec![0.0; DIMENSIONS]);
            embedding.describe(&[here], &mut a);
            embedding.describe(&[there], &mut b);
            let found = 2.0 / DIMENSIONS as f32 * a.iter().zip(&b).map(|(a, b)| a * b).sum::<f32>();
            let kernel = (-0.5 * (distance / KERNEL_LENGTH as f32).powi(2)).exp();
            // Four standard deviations of a mean over so many frequencies.
            assert!((found - kernel).abs() < 4.0 / (DIMENSIONS as f32).sqrt(), "{distance}: {found}, {kernel}");
        }
    }

    /// Maps hold features of these frequencies.
    #[test]
    fn frequencies_stay_what_they_are() {
        let mut random = SplitMix(0);
        assert_eq!(random.next(), 0xe220_a839_7b1d_cdaf);
        let embedding = KernelMean::new();
        let ends = [embedding.frequencies[0][0][0], embedding.frequencies[31][30][31], embedding.phases[31][31]];
        for (found, expected) in ends.into_iter().zip([-0.856667, 0.376428, 0.324177]) {
            assert!((found - expected).abs() < 2e-6, "{found} {expected}");
        }
    }
}
