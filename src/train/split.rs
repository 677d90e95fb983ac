//! Learning, validation and test sets.

use std::collections::HashMap;
use std::io::Read;

use crate::map::SplitKind;
use rand::SeedableRng;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;

/// Positions in the list of frames, each set in rising order.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Split {
    /// Scaling and Gaussian processes are learned from these.
    pub learning: Vec<usize>,
    /// Features and settings are chosen with these.
    pub validation: Vec<usize>,
    /// Only measured on.
    pub test: Vec<usize>,
}

#[derive(Debug, thiserror::Error)]
pub enum SplitError {
    #[error("line {line}: {problem}")]
    BadLine { line: u64, problem: String },
    #[error("no frame is in the {set} set")]
    EmptySet { set: &'static str },
    #[error("cannot read the split")]
    Csv(#[from] csv::Error),
}

/// Shares of learning and validation; the rest is test (Do et al. 2015, section 5.1).
const LEARNING_SHARE: f64 = 0.5;
const VALIDATION_SHARE: f64 = 0.25;
/// Stretches that a blocked split cuts the drive into.
pub const BLOCKS: usize = 20;

impl Split {
    /// A seeded split of `n` frames into 50 % learning, 25 % validation and 25 % test.
    pub fn new(kind: SplitKind, n: usize, seed: u64) -> Self {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let blocks = match kind {
            SplitKind::Random => n,
            SplitKind::Blocked => BLOCKS.min(n),
        };
        let mut order: Vec<usize> = (0..blocks).collect();
        order.shuffle(&mut random);
        let learning = (LEARNING_SHARE * blocks as f64).round() as usize;
        let validation = learning + (VALIDATION_SHARE * blocks as f64).round() as usize;
        let frames = |blocks_of_set: &[usize]| {
            let mut frames: Vec<usize> =
                blocks_of_set.iter().flat_map(|block| block * n / blocks..(block + 1) * n / blocks).collect();
            frames.sort_unstable();
            frames
        };
        Self {
            learning: frames(&order[..learning]),
            validation: frames(&order[learning..validation]),
            test: frames(&order[validation..]),
        }
    }

    /// Reads `index,set` lines. `indices` are the frames' own indices, in order; frames that are not named belong to no
    /// set.
    ///
    /// # Errors
    /// Names the line for an unknown set, an index that no frame has or that was named before, and a set left empty.
    pub fn from_csv(reader: impl Read, indices: &[usize]) -> Result<Self, SplitError> {
        let positions: HashMap<usize, usize> = indices.iter().enumerate().map(|(i, &index)| (index, i)).collect();
        let mut csv = csv::ReaderBuilder::new().trim(csv::Trim::All).from_reader(reader);
        let bad = |line: u64, problem: String| SplitError::BadLine { line, problem };
        let header = csv.headers()?;
        if header != vec!["index", "set"] {
            let found = header.iter().collect::<Vec<_>>().join(",");
            return Err(bad(1, format!("header is `{found}`, expected `index,set`")));
        }
        let mut split = Self::default();
        let mut seen = HashMap::new();
        for record in csv.records() {
            let record = record?;
            let line = record.position().map_or(0, |position| position.line());
            let (index, set) = (&record[0], &record[1]);
            let frame = index.parse().ok().and_then(|index: usize| positions.get(&index));
            let &frame = frame.ok_or_else(|| bad(line, format!("no frame has the index `{index}`")))?;
            if let Some(before) = seen.insert(frame, line) {
                return Err(bad(line, format!("index {index} was named before, in line {before}")));
            }
            match set {
                "learning" => split.learning.push(frame),
                "validation" => split.validation.push(frame),
                "test" => split.test.push(frame),
                other => return Err(bad(line, format!("set is `{other}`, expected learning, validation or test"))),
            }
        }
        for (set, frames) in
            [("learning", &mut split.learning), ("validation", &mut split.validation), ("test", &mut split.test)]
        {
            if frames.is_empty() {
                return Err(SplitError::EmptySet { set });
            }
            frames.sort_unstable();
        }
        Ok(split)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_frame_is_in_one_set_and_a_seed_repeats() {
        for kind in [SplitKind::Random, SplitKind::Blocked] {
            for n in [7, 75, 378] {
                let split = Split::new(kind, n, 3);
                let mut all = [&split.learning[..], &split.validation, &split.test].concat();
                all.sort_unstable();
                assert_eq!(all, (0..n).collect::<Vec<_>>());
                assert_eq!(split, Split::new(kind, n, 3));
                assert_ne!(split, Split::new(kind, n, 4));
                assert!(split.learning.len().abs_diff(n / 2) <= n / 10 + 1);
            }
        }
    }

    #[test]
    fn blocked_sets_are_contiguous_stretches() {
        let split = Split::new(SplitKind::Blocked, 400, 0);
        let jumps = split.test.windows(2).filter(|pair| pair[1] != pair[0] + 1).count();
        assert!(jumps < 5 && split.test.len() == 100, "{jumps} jumps");
    }

    #[test]
    fn csv_is_read_and_its_faults_are_named() {
        let indices = [10, 11, 12];
        let read = |text: &str| Split::from_csv(text.as_bytes(), &indices);
        let split = read("index,set\n12,test\n10,learning\n11,validation\n").expect("sound");
        assert_eq!(split, Split { learning: vec![0], validation: vec![1], test: vec![2] });
        for (text, expected) in [
            ("index,kind\n10,test\n", "header"),
            ("index,set\n13,test\n", "line 2: no frame has the index `13`"),
            ("index,set\n10,test\n10,test\n", "line 3: index 10 was named before, in line 2"),
            ("index,set\n10,training\n", "line 2: set is `training`"),
            ("index,set\n10,test\n11,test\n", "no frame is in the learning set"),
            ("index,set\n10\n", "cannot read"),
        ] {
            let error = read(text).expect_err("faulty");
            assert!(error.to_string().contains(expected), "{text:?}: {error}");
        }
    }
}
