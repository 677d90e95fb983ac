//! Patches by what they resemble, each kind counting the same: `patch-words`.

use multiversion::multiversion;

use super::patches::{COEFFICIENTS, Patch};

/// Kinds of patches.
const WORDS: usize = 128;
pub const DIMENSIONS: usize = WORDS * COEFFICIENTS;
/// So many words at a time: their distances stay in registers.
const LANES: usize = 32;
/// Word × coefficient, in units of 1/128: `benches/ablation/words.py`.
static QUANTIZED: &[u8; DIMENSIONS] = include_bytes!("words.bin");
const UNIT: f32 = 1.0 / 128.0;
/// Added to the length of a word's residual, so that a patch that is the word itself does not become noise.
const RESIDUAL_FLOOR: f32 = 1e-2;

/// How fast the share of a word falls with the squared distance of the patch.
const SHARPNESS: f32 = 60.0;

/// Vector of locally aggregated descriptors (Jégou, Douze, Schmid & Pérez 2010) of the patches, which are shared among
/// words (Arandjelović, Gronat, Torii, Pajdla & Sivic 2016, their eq. 4).
///
/// ```text
/// a_k(x) = exp(−60 |x − w_k|²) / Σ_l exp(−60 |x − w_l|²)
/// r_k = Σ over the patches x of a_k(x) (x − w_k)
/// y_k = r_k / (|r_k| + 0.01) / √128            k = 0 … 127, 31 numbers each (Arandjelović & Zisserman 2013)
/// ```
///
/// A wall of windows, hundreds of like patches, counts no more than the one sign beside it: what tells places apart where
/// images lie far apart. The words are centres of k-means, learned once and for all from simulated places; words of the
/// place itself were no better.
pub struct PatchWords {
    /// A block of [`LANES`] words each: coefficient × word.
    words: Vec<Block>,
    /// ½ |w|².
    half_squares: Vec<[f32; LANES]>,
    /// Buffers: Σ a x and Σ a of every word.
    sums: Vec<Block>,
    masses: Vec<[f32; LANES]>,
}

type Block = [[f32; LANES]; COEFFICIENTS];

impl PatchWords {
    pub fn new() -> Self {
        let coefficient = |word: usize, k: usize| UNIT * f32::from(QUANTIZED[word * COEFFICIENTS + k].cast_signed());
        let block = |first: usize| -> Block {
            std::array::from_fn(|k| std::array::from_fn(|lane| coefficient(first + lane, k)))
        };
        let words: Vec<Block> = (0..WORDS).step_by(LANES).map(block).collect();
        let half_square = |block: &Block| -> [f32; LANES] {
            std::array::from_fn(|lane| 0.5 * block.iter().map(|row| row[lane] * row[lane]).sum::<f32>())
        };
        Self {
            half_squares: words.iter().map(half_square).collect(),
            sums: vec![[[0.0; LANES]; COEFFICIENTS]; words.len()],
            masses: vec![[0.0; LANES]; words.len()],
            words,
        }
    }

    pub fn describe(&mut self, patches: &[Patch], properties: &mut [f32]) {
        self.sums.fill([[0.0; LANES]; COEFFICIENTS]);
        self.masses.fill([0.0; LANES]);
        for patch in patches {
            share(patch, &self.words, &self.half_squares, &mut self.sums, &mut self.masses);
        }
        for (word, residual) in properties.chunks_exact_mut(COEFFICIENTS).enumerate() {
            let (block, lane) = (word / LANES, word % LANES);
            for (k, r) in residual.iter_mut().enumerate() {
                *r = self.sums[block][k][lane] - self.masses[block][lane] * self.words[block][k][lane];
            }
            let length = residual.iter().map(|r| r * r).sum::<f32>().sqrt();
            let scale = 1.0 / ((length + RESIDUAL_FLOOR) * (WORDS as f32).sqrt());
            residual.iter_mut().for_each(|r| *r *= scale);
        }
    }
}

/// Adds a `patch` and its mass to the words, in shares.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2+fma"))]
fn share(
    patch: &Patch,
    words: &[Block],
    half_squares: &[[f32; LANES]],
    sums: &mut [Block],
    masses: &mut [[f32; LANES]],
) {
    // ½ |x − w|², but for the same constant.
    let mut shares = [[0.0; LANES]; WORDS / LANES];
    for ((distances, block), half_squares) in shares.iter_mut().zip(words).zip(half_squares) {
        *distances = *half_squares;
        for (x, row) in patch.iter().zip(block) {
            for (distance, w) in distances.iter_mut().zip(row) {
                *distance -= x * w;
            }
        }
    }
    let nearest = shares.as_flattened().iter().fold(f32::INFINITY, |least, &distance| least.min(distance));
    let mut total = 0.0;
    for share in shares.as_flattened_mut() {
        *share = power_of_two((nearest - *share) * (2.0 * SHARPNESS * std::f32::consts::LOG2_E));
        total += *share;
    }
    for ((shares, sums), masses) in shares.iter_mut().zip(sums).zip(masses) {
        for (share, mass) in shares.iter_mut().zip(masses) {
            *share /= total;
            *mass += *share;
        }
        for (x, row) in patch.iter().zip(sums) {
            for (sum, share) in row.iter_mut().zip(&*shares) {
                *sum += x * share;
            }
        }
    }
}

/// 2^t for t ≤ 0 to a relative error of 6e-5; 2⁻¹²⁶ below.
#[inline]
fn power_of_two(t: f32) -> f32 {
    // Leaves the whole number nearest to t, plus the exponent's bias, in the lowest bits.
    const ROUNDING: f32 = 12_582_912.0 + 127.0;
    let t = t.max(-126.0);
    let whole = t + ROUNDING;
    let r = t - (whole - ROUNDING);
    let power = 1.0 + r * (0.693_147_2 + r * (0.240_226_5 + r * (0.055_504_11 + r * 0.009_618_129)));
    f32::from_bits(whole.to_bits() << 23) * power
}

#[cfg(test)]
mod tests {
    use super::*;

    fn word(words: &PatchWords, k: usize) -> Patch {
        std::array::from_fn(|i| words.words[k / LANES][i][k % LANES])
    }

    fn of(patches: &[Patch]) -> Vec<f32> {
        let mut properties = vec![0.0; DIMENSIONS];
        PatchWords::new().describe(patches, &mut properties);
        properties
    }

    #[test]
    fn residuals_equal_those_of_the_definition() {
        let words = PatchWords::new();
        let patches: Vec<Patch> = (0..20)
            .map(|i| std::array::from_fn(|k| word(&words, 6 * i)[k] + 0.1 * ((i * 31 + k) as f32 * 12.9898).sin()))
            .collect();
        let found = of(&patches);
        let mut expected = vec![0.0_f64; DIMENSIONS];
        for patch in &patches {
            let square =
                |k: usize| -> f64 { patch.iter().zip(word(&words, k)).map(|(x, w)| f64::from(x - w).powi(2)).sum() };
            let shares: Vec<f64> = (0..WORDS).map(|k| (-f64::from(SHARPNESS) * square(k)).exp()).collect();
            let total: f64 = shares.iter().sum();
            for (k, residual) in expected.chunks_exact_mut(COEFFICIENTS).enumerate() {
                for ((r, x), w) in residual.iter_mut().zip(patch).zip(word(&words, k)) {
                    *r += shares[k] / total * f64::from(x - w);
                }
            }
        }
        for (found, residual) in found.chunks_exact(COEFFICIENTS).zip(expected.chunks_exact(COEFFICIENTS)) {
            let length = residual.iter().map(|r| r * r).sum::<f64>().sqrt();
            for (found, r) in found.iter().zip(residual) {
                let expected = r / ((length + 0.01) * 128.0_f64.sqrt());
                assert!((f64::from(*found) - expected).abs() < 2e-5, "{found} {expected}");
            }
        }
    }

    #[test]
    fn many_like_patches_count_as_one() {
        let words = PatchWords::new();
        let near = |k: usize, step: f32| {
            let mut patch = word(&words, k);
            patch[3] += step;
            patch
        };
        let few = of(&[near(5, 0.1), near(90, -0.1)]);
        let many = of(&[vec![near(5, 0.1); 200], vec![near(90, -0.1)]].concat());
        let length = |y: &[f32], k: usize| {
            y[k * COEFFICIENTS..(k + 1) * COEFFICIENTS].iter().map(|y| y * y).sum::<f32>().sqrt()
                * (WORDS as f32).sqrt()
        };
        assert!(length(&few, 5) > 0.5 && length(&many, 5) < 1.0, "{} {}", length(&few, 5), length(&many, 5));
        assert!((length(&few, 90) - length(&many, 90)).abs() < 0.3, "{} {}", length(&few, 90), length(&many, 90));
    }

    #[test]
    fn no_patch_is_no_direction() {
        assert!(of(&[]).iter().all(|&y| y == 0.0));
    }

    #[test]
    fn powers_of_two_are_close_to_the_library_s() {
        for i in 0..12_500_i16 {
            let t = -0.01 * f32::from(i);
            assert!((power_of_two(t) / t.exp2() - 1.0).abs() < 1e-4, "{t}");
        }
        assert!(power_of_two(-1e9) < 1e-37);
    }
}
