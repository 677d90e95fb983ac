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
/// Words whose share is less than exp of minus this, beside the nearest word's, get none.
const NEGLIGIBLE: f32 = 11.5;

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
    /// Buffer: words and their shares of one patch.
    shares: Vec<(usize, f32)>,
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
        Self { half_squares: words.iter().map(half_square).collect(), words, shares: Vec::with_capacity(WORDS) }
    }

    pub fn describe(&mut self, patches: &[Patch], properties: &mut [f32]) {
        properties.fill(0.0);
        for patch in patches {
            let (distances, nearest) = distances(patch, &self.words, &self.half_squares);
            self.shares.clear();
            let near = |&(_, distance): &(usize, &f32)| *distance < nearest + 0.5 * NEGLIGIBLE / SHARPNESS;
            let share = |(word, distance): (usize, &f32)| (word, libm::expf(2.0 * SHARPNESS * (nearest - distance)));
            self.shares.extend(distances.as_flattened().iter().enumerate().filter(near).map(share));
            let total: f32 = self.shares.iter().map(|(_, share)| share).sum();
            for &(word, share) in &self.shares {
                let (block, lane) = (&self.words[word / LANES], word % LANES);
                let residual = &mut properties[word * COEFFICIENTS..(word + 1) * COEFFICIENTS];
                for ((r, x), row) in residual.iter_mut().zip(patch).zip(block) {
                    *r += share / total * (x - row[lane]);
                }
            }
        }
        for residual in properties.chunks_exact_mut(COEFFICIENTS) {
            let length = residual.iter().map(|r| r * r).sum::<f32>().sqrt();
            let scale = 1.0 / ((length + RESIDUAL_FLOOR) * (WORDS as f32).sqrt());
            residual.iter_mut().for_each(|r| *r *= scale);
        }
    }
}

/// ½ |w|² − w · x of all words w, and the least of them: half the squared distances, but for the same constant.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2+fma"))]
fn distances(patch: &Patch, words: &[Block], half_squares: &[[f32; LANES]]) -> ([[f32; LANES]; WORDS / LANES], f32) {
    let mut all = [[0.0; LANES]; WORDS / LANES];
    let mut least = [f32::INFINITY; LANES];
    for ((distances, block), half_squares) in all.iter_mut().zip(words).zip(half_squares) {
        *distances = *half_squares;
        for (x, row) in patch.iter().zip(block) {
            for (distance, w) in distances.iter_mut().zip(row) {
                *distance -= x * w;
            }
        }
        for (least, distance) in least.iter_mut().zip(distances) {
            *least = least.min(*distance);
        }
    }
    (all, least.into_iter().fold(f32::INFINITY, f32::min))
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
                assert!((f64::from(*found) - expected).abs() < 2e-4, "{found} {expected}");
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
}
