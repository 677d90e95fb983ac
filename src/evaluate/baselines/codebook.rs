//! Visual words: centres of k-means, and the word nearest to a descriptor.

use multiversion::multiversion;
use rand::{Rng, SeedableRng, seq::index};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;

/// Lloyd's steps, at most.
const MAX_STEPS: usize = 25;
/// Fewer points than this share that change their word are the end of it.
const SETTLED: f64 = 1e-3;
/// Words are learned from so many descriptors each, at most.
pub const SAMPLE_A_WORD: usize = 25;
/// So many words at a time: their distances stay in registers.
const LANES: usize = 32;

/// Words of d numbers each.
#[derive(Debug, Clone, PartialEq)]
pub struct Codebook {
    d: usize,
    words: usize,
    /// Block of [`LANES`] words × coefficient × word; words beyond the last are zeros.
    blocks: Vec<[f32; LANES]>,
    /// ½ |w|²; infinite beyond the last.
    half_squares: Vec<[f32; LANES]>,
}

impl Codebook {
    /// Learns `words` words from a sample of `descriptors`, d numbers each: k-means from centres that are drawn far apart
    /// (Arthur & Vassilvitskii 2007), Lloyd's steps until nearly no descriptor changes its word; a word that loses all of its
    /// descriptors starts anew at the descriptor that is furthest from its own. Fewer words where there are fewer
    /// descriptors. The same seed gives the same words, on any number of threads.
    pub fn learn(descriptors: &[f32], d: usize, words: usize, seed: u64) -> Self {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let n = descriptors.len() / d;
        let sample = n.min(SAMPLE_A_WORD * words);
        let mut rows = index::sample(&mut random, n, sample).into_vec();
        rows.sort_unstable();
        let points: Vec<f32> = rows.iter().flat_map(|&row| &descriptors[row * d..(row + 1) * d]).copied().collect();
        let points = Points { values: &points, d };
        let mut centers = points.far_apart(words.min(sample), &mut random);
        let mut belongs = vec![usize::MAX; sample];
        for _ in 0..MAX_STEPS {
            let nearest = Self::of(&centers, d).nearest_of(points.values);
            let changed = belongs.iter().zip(&nearest).filter(|(before, (now, _))| *before != now).count();
            belongs = nearest.iter().map(|&(word, _)| word).collect();
            if (changed as f64) < SETTLED * sample as f64 {
                break;
            }
            points.move_centers(&mut centers, &mut belongs, &nearest);
        }
        Self::of(&centers, d)
    }

    /// The words whose numbers are given, word by word.
    fn of(centers: &[f32], d: usize) -> Self {
        let words = centers.len() / d;
        let padded = words.div_ceil(LANES);
        let mut blocks = vec![[0.0; LANES]; padded * d];
        let mut half_squares = vec![[f32::INFINITY; LANES]; padded];
        for (word, center) in centers.chunks_exact(d).enumerate() {
            let (block, lane) = (word / LANES, word % LANES);
            for (row, value) in blocks[block * d..(block + 1) * d].iter_mut().zip(center) {
                row[lane] = *value;
            }
            half_squares[block][lane] = 0.5 * center.iter().map(|w| w * w).sum::<f32>();
        }
        Self { d, words, blocks, half_squares }
    }

    pub fn words(&self) -> usize {
        self.words
    }

    /// How many of the `descriptors` belong to each word.
    pub fn counts(&self, descriptors: &[f32]) -> Vec<u32> {
        let mut counts = vec![0; self.words];
        for x in descriptors.chunks_exact(self.d) {
            counts[nearest(x, &self.blocks, &self.half_squares).0] += 1;
        }
        counts
    }

    /// The nearest word of every descriptor, and ½ |w|² − w · x, half the squared distance but for ½ |x|².
    fn nearest_of(&self, descriptors: &[f32]) -> Vec<(usize, f32)> {
        descriptors.par_chunks_exact(self.d).map(|x| nearest(x, &self.blocks, &self.half_squares)).collect()
    }
}

/// Points of d numbers each.
struct Points<'a> {
    values: &'a [f32],
    d: usize,
}

impl Points<'_> {
    fn len(&self) -> usize {
        self.values.len() / self.d
    }

    fn at(&self, i: usize) -> &[f32] {
        &self.values[i * self.d..(i + 1) * self.d]
    }

    /// k of the points, each drawn with a probability that grows with the squared distance to those before.
    fn far_apart(&self, k: usize, random: &mut ChaCha8Rng) -> Vec<f32> {
        let mut centers = Vec::with_capacity(k * self.d);
        let mut to_nearest = vec![f32::INFINITY; self.len()];
        for _ in 0..k {
            let total: f64 = to_nearest.iter().map(|&square| f64::from(square)).sum();
            let chosen = if total.is_finite() && total > 0.0 {
                let mut left = random.random::<f64>() * total;
                let passes = |&square: &f32| {
                    left -= f64::from(square);
                    left < 0.0
                };
                to_nearest.iter().position(passes).unwrap_or(self.len() - 1)
            } else {
                // The first; or all points are centres already.
                random.random_range(0..self.len())
            };
            let center = self.at(chosen).to_vec();
            to_nearest.par_iter_mut().zip(self.values.par_chunks_exact(self.d)).for_each(|(nearest, x)| {
                *nearest = nearest.min(squared_distance(x, &center));
            });
            centers.extend(center);
        }
        centers
    }

    /// Every centre to the mean of its points.
    fn move_centers(&self, centers: &mut [f32], belongs: &mut [usize], nearest: &[(usize, f32)]) {
        let words = centers.len() / self.d;
        let mut sums = vec![0.0_f64; centers.len()];
        let mut counts = vec![0_usize; words];
        for (i, &word) in belongs.iter().enumerate() {
            counts[word] += 1;
            let sum = &mut sums[word * self.d..(word + 1) * self.d];
            sum.iter_mut().zip(self.at(i)).for_each(|(sum, x)| *sum += f64::from(*x));
        }
        for (word, center) in centers.chunks_exact_mut(self.d).enumerate().filter(|(word, _)| counts[*word] > 0) {
            let sum = &sums[word * self.d..(word + 1) * self.d];
            center.iter_mut().zip(sum).for_each(|(c, sum)| *c = (sum / counts[word] as f64) as f32);
        }
        // Furthest from their centres first: half the squared distances are these but for the same constant.
        let half_square = |i: usize| 0.5 * self.at(i).iter().map(|x| x * x).sum::<f32>() + nearest[i].1;
        let empty: Vec<usize> = (0..words).filter(|&word| counts[word] == 0).collect();
        if empty.is_empty() {
            return;
        }
        let mut furthest: Vec<(f32, usize)> = (0..self.len()).map(|i| (half_square(i), i)).collect();
        furthest.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        let mut furthest = furthest.into_iter().map(|(_, i)| i);
        for word in empty {
            let alone = |i: &usize| counts[belongs[*i]] > 1;
            let Some(i) = furthest.find(alone) else { break };
            counts[belongs[i]] -= 1;
            counts[word] = 1;
            belongs[i] = word;
            centers[word * self.d..(word + 1) * self.d].copy_from_slice(self.at(i));
        }
    }
}

fn squared_distance(a: &[f32], b: &[f32]) -> f32 {
    a.iter().zip(b).map(|(a, b)| (a - b) * (a - b)).sum()
}

/// The word of least ½ |w|² − w · x, the first of several, and that value.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2+fma"))]
fn nearest(x: &[f32], blocks: &[[f32; LANES]], half_squares: &[[f32; LANES]]) -> (usize, f32) {
    let mut best = (0, f32::INFINITY);
    for (block, (words, half_squares)) in blocks.chunks_exact(x.len()).zip(half_squares).enumerate() {
        let mut distances = *half_squares;
        for (x, row) in x.iter().zip(words) {
            for (distance, w) in distances.iter_mut().zip(row) {
                *distance -= x * w;
            }
        }
        let least = distances.iter().copied().fold(f32::INFINITY, f32::min);
        if least < best.1 {
            let lane = distances.iter().position(|&distance| distance == least).unwrap_or(0);
            best = (block * LANES + lane, least);
        }
    }
    best
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Clouds of `each` points about the corners of a square.
    fn clouds(each: usize) -> Vec<f32> {
        let mut random = ChaCha8Rng::seed_from_u64(1);
        let corners = [[0.0, 0.0], [10.0, 0.0], [0.0, 10.0], [10.0, 10.0]];
        (0..4 * each).flat_map(|i| corners[i % 4].map(|c: f32| c + random.random_range(-1.0..1.0))).collect()
    }

    #[test]
    fn words_are_the_means_of_the_clouds() {
        let points = clouds(20);
        let codebook = Codebook::learn(&points, 2, 4, 0);
        let mut counts = codebook.counts(&points);
        counts.sort_unstable();
        assert_eq!(counts, [20; 4]);
        // A point belongs to the word of its cloud.
        let words: Vec<usize> = codebook.nearest_of(&points).iter().map(|&(word, _)| word).collect();
        assert!((4..80).all(|i| words[i] == words[i % 4]));
    }

    #[test]
    fn the_nearest_word_is_that_of_the_definition() {
        let mut random = ChaCha8Rng::seed_from_u64(2);
        let mut numbers = |n: usize| -> Vec<f32> { (0..n).map(|_| random.random_range(-1.0..1.0)).collect() };
        // 70 words fill two blocks and a part of a third.
        let (centers, points) = (numbers(70 * 31), numbers(40 * 31));
        let codebook = Codebook::of(&centers, 31);
        for (x, (word, _)) in points.chunks_exact(31).zip(codebook.nearest_of(&points)) {
            let square = |k: usize| squared_distance(x, &centers[k * 31..(k + 1) * 31]);
            let least = (0..70).map(square).fold(f32::INFINITY, f32::min);
            assert!(square(word) <= least + 1e-5);
        }
    }

    #[test]
    fn a_word_without_points_starts_anew_at_the_furthest_point() {
        let values = [0.0, 0.1, 0.2, 9.0_f32];
        let points = Points { values: &values, d: 1 };
        let mut centers = vec![0.0, 100.0];
        let nearest = Codebook::of(&centers, 1).nearest_of(&values);
        let mut belongs: Vec<usize> = nearest.iter().map(|&(word, _)| word).collect();
        points.move_centers(&mut centers, &mut belongs, &nearest);
        assert_eq!((centers[1], belongs), (9.0, vec![0, 0, 0, 1]));
    }

    #[test]
    fn few_or_equal_descriptors_make_few_words_and_a_seed_repeats() {
        assert_eq!(Codebook::learn(&[1.0, 2.0, 3.0], 1, 8, 0).words(), 3);
        let same = Codebook::learn(&[5.0; 40], 2, 4, 0);
        assert_eq!(same.counts(&[5.0; 6]).iter().sum::<u32>(), 3);
        assert_eq!(Codebook::learn(&[], 2, 4, 0).words(), 0);
        let points = clouds(30);
        assert_eq!(Codebook::learn(&points, 2, 7, 3), Codebook::learn(&points, 2, 7, 3));
    }
}
