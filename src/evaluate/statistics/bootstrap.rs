//! Moving blocks along the drive, crossed with the seeds.

use std::borrow::Cow;
use std::collections::{BTreeMap, BTreeSet, HashSet};

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::{DRAWS, RECALL_M, STRETCHES};
use crate::evaluate::entry::Entry;
use crate::metrics::{quantile, root_mean_square};
use crate::types::distance_m;

/// Where on the drive frames lie: by their indices, which count along it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Drive {
    first: usize,
    /// Number of indices from the first to the last.
    indices: usize,
}

/// A drive is told apart into so many places at most: indices may be anything.
const MAX_PLACES: usize = 4096;

impl Drive {
    /// The part of the drive that the frames of `rows` are from; `None` without frames.
    pub fn of(rows: &[&Entry]) -> Option<Self> {
        let indices = || rows.iter().flat_map(|entry| entry.frames.iter().flatten().map(|frame| frame.index));
        let (first, last) = (indices().min()?, indices().max()?);
        Some(Self { first, indices: (last - first).saturating_add(1) })
    }

    fn places(&self) -> usize {
        self.indices.min(MAX_PLACES)
    }

    fn place_of(&self, index: usize) -> usize {
        let along = (index - self.first) as f64 / self.indices as f64;
        ((along * self.places() as f64) as usize).min(self.places() - 1)
    }

    /// Which of the [`STRETCHES`] a frame lies in.
    pub fn stretch_of(&self, index: usize) -> usize {
        self.place_of(index) * STRETCHES / self.places()
    }
}

/// What is drawn, and given a sign, as a whole.
#[derive(Debug, Clone, PartialEq)]
pub enum Units {
    /// Stretches of the drive: the frames lie all over it.
    Stretches(Drive),
    /// Runs of frames that were held out as wholes: first and last index, in order. Runs of several seeds that have frames
    /// in common are one.
    Runs(Vec<[usize; 2]>),
}

impl Units {
    /// Of the frames of `rows`; `None` without frames.
    pub fn of(rows: &[&Entry]) -> Option<Self> {
        let drive = Drive::of(rows)?;
        let mut runs: Vec<[usize; 2]> =
            rows.iter().flat_map(|entry| entry.held_out_runs.iter().flatten().copied()).collect();
        if runs.is_empty() {
            return Some(Self::Stretches(drive));
        }
        runs.sort_unstable();
        let mut united: Vec<[usize; 2]> = Vec::new();
        for [first, last] in runs {
            match united.last_mut() {
                Some(before) if first <= before[1] => before[1] = before[1].max(last),
                _ => united.push([first, last]),
            }
        }
        Some(Self::Runs(united))
    }

    /// How many there may be.
    pub fn most(&self) -> usize {
        match self {
            Self::Stretches(_) => STRETCHES,
            Self::Runs(runs) => runs.len(),
        }
    }

    /// The one that a frame is part of.
    pub fn unit_of(&self, index: usize) -> usize {
        match self {
            Self::Stretches(drive) => drive.stretch_of(index),
            Self::Runs(runs) => runs.partition_point(|run| run[1] < index).min(runs.len() - 1),
        }
    }

    /// Where the frame's count is in a draw.
    fn place_of(&self, index: usize) -> usize {
        match self {
            Self::Stretches(drive) => drive.place_of(index),
            Self::Runs(_) => self.unit_of(index),
        }
    }
}

/// How often every frame and every seed counts.
#[derive(Debug, Clone, PartialEq)]
pub struct Draw<'a> {
    /// Seeds, as often as they were drawn.
    seeds: Vec<usize>,
    /// Of the places; `None` where each counts once.
    times: Option<(&'a Units, Vec<u8>)>,
}

impl<'a> Draw<'a> {
    /// Everything once.
    pub fn everything(seeds: usize) -> Self {
        Self { seeds: (0..seeds).collect(), times: None }
    }

    /// All frames of one seed.
    pub fn only(seed: usize) -> Self {
        Self { seeds: vec![seed], times: None }
    }

    pub fn seeds(&self) -> &[usize] {
        &self.seeds
    }

    pub fn times(&self, index: usize) -> usize {
        self.times.as_ref().map_or(1, |(units, times)| usize::from(times[units.place_of(index)]))
    }
}

/// [`DRAWS`] draws of as many units and seeds as there are. Stretches begin anywhere, and the first one of the drive comes
/// after the last, so that every frame is drawn equally often.
pub fn draws(units: &Units, seeds: usize, seed: u64) -> Vec<Draw<'_>> {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let (places, length) = match units {
        Units::Stretches(drive) => (drive.places(), drive.places().div_ceil(STRETCHES)),
        Units::Runs(runs) => (runs.len(), 1),
    };
    (0..DRAWS)
        .map(|_| {
            let mut times = vec![0_u8; places];
            for _ in 0..units.most() {
                let start = random.random_range(0..places);
                for i in start..start + length {
                    let times = &mut times[i % places];
                    *times = times.saturating_add(1);
                }
            }
            let seeds = (0..seeds).map(|_| random.random_range(0..seeds)).collect();
            Draw { seeds, times: Some((units, times)) }
        })
        .collect()
}

/// A method's errors, seed by seed.
#[derive(Debug, Clone, PartialEq)]
pub struct Errors {
    seeds: Vec<ErrorsOfSeed>,
}

#[derive(Debug, Clone, PartialEq)]
struct ErrorsOfSeed {
    seed: Option<u64>,
    /// Index of the frame and error \[m\], the smallest first.
    said: Vec<(usize, f64)>,
    /// Frames without an estimate.
    unsaid: Vec<usize>,
}

/// Figures of one draw, mean over its seeds.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Figures {
    pub rmse_m: f64,
    pub mean_m: f64,
    pub median_m: f64,
    pub p95_m: f64,
    pub recall: [f64; 4],
}

impl Errors {
    /// Of the rows of one method, one a seed.
    pub fn of(rows: &[&Entry]) -> Self {
        let of_seed = |entry: &&Entry| {
            let (mut said, mut unsaid) = (Vec::new(), Vec::new());
            for frame in entry.frames.iter().flatten() {
                match (frame.est_e_m, frame.est_n_m) {
                    (Some(e), Some(n)) => {
                        said.push((frame.index, distance_m([e, n], [frame.truth_e_m, frame.truth_n_m])));
                    }
                    _ => unsaid.push(frame.index),
                }
            }
            said.sort_by(|a, b| a.1.total_cmp(&b.1).then(a.0.cmp(&b.0)));
            ErrorsOfSeed { seed: entry.seed, said, unsaid }
        };
        Self { seeds: rows.iter().map(of_seed).collect() }
    }

    /// The largest of all.
    pub fn largest_m(&self) -> f64 {
        self.seeds.iter().filter_map(|of| Some(of.said.last()?.1)).fold(0.0, f64::max)
    }

    pub fn seeds(&self) -> usize {
        self.seeds.len()
    }

    /// Frames with an estimate, all seeds together.
    pub fn frames(&self) -> usize {
        self.seeds.iter().map(|of_seed| of_seed.said.len()).sum()
    }

    /// Units that these frames are of.
    pub fn units(&self, units: &Units) -> usize {
        let said = self.seeds.iter().flat_map(|of_seed| &of_seed.said);
        said.map(|&(index, _)| units.unit_of(index)).collect::<BTreeSet<usize>>().len()
    }

    /// `None` where the draw has no frame with an estimate.
    pub fn figures(&self, draw: &Draw) -> Option<Figures> {
        let of_seeds: Vec<Figures> =
            draw.seeds().iter().filter_map(|&seed| self.seeds.get(seed)?.figures(draw)).collect();
        let mean = |of: &dyn Fn(&Figures) -> f64| of_seeds.iter().map(of).sum::<f64>() / of_seeds.len() as f64;
        (!of_seeds.is_empty()).then(|| Figures {
            rmse_m: mean(&|f| f.rmse_m),
            mean_m: mean(&|f| f.mean_m),
            median_m: mean(&|f| f.median_m),
            p95_m: mean(&|f| f.p95_m),
            recall: std::array::from_fn(|i| mean(&|f| f.recall[i])),
        })
    }

    /// 1 − RMSE / RMSE of `of_median` on the same frames, mean over the seeds.
    pub fn skill(&self, of_median: &Self, draw: &Draw) -> Option<f64> {
        let of_seed = |&seed: &usize| {
            let own = self.seeds.get(seed)?;
            let other = of_median.seeds.iter().find(|other| other.seed == own.seed)?;
            Some(1.0 - own.rmse_m(draw)? / other.on_frames_of(own).rmse_m(draw)?)
        };
        let skills: Vec<f64> = draw.seeds().iter().filter_map(of_seed).collect();
        (!skills.is_empty()).then(|| skills.iter().sum::<f64>() / skills.len() as f64)
    }

    /// The errors of both on the frames that both have an estimate for.
    pub fn paired(&self, other: &Self) -> (Self, Self) {
        let of_seed = |own: &ErrorsOfSeed| {
            let other = other.seeds.iter().find(|other| other.seed == own.seed)?;
            Some((own.on_frames_of(other).into_owned(), other.on_frames_of(own).into_owned()))
        };
        let (own, other) = self.seeds.iter().filter_map(of_seed).unzip();
        (Self { seeds: own }, Self { seeds: other })
    }

    /// Of every seed, the frames by index, with their errors.
    pub fn by_frame(&self) -> impl Iterator<Item = BTreeMap<usize, f64>> {
        self.seeds.iter().map(|of_seed| of_seed.said.iter().copied().collect())
    }
}

impl ErrorsOfSeed {
    /// The errors of the frames that count, each as often as it was drawn, the smallest first.
    fn drawn(&self, draw: &Draw) -> Vec<f64> {
        let times = |&(index, error_m): &(usize, f64)| std::iter::repeat_n(error_m, draw.times(index));
        self.said.iter().flat_map(times).collect()
    }

    fn figures(&self, draw: &Draw) -> Option<Figures> {
        let errors_m = self.drawn(draw);
        if errors_m.is_empty() {
            return None;
        }
        let all = errors_m.len() + self.unsaid.iter().map(|&index| draw.times(index)).sum::<usize>();
        Some(Figures {
            rmse_m: root_mean_square(&errors_m),
            mean_m: errors_m.iter().sum::<f64>() / errors_m.len() as f64,
            median_m: quantile(&errors_m, 0.5),
            p95_m: quantile(&errors_m, 0.95),
            recall: RECALL_M.map(|within_m| errors_m.partition_point(|&e| e <= within_m) as f64 / all as f64),
        })
    }

    fn rmse_m(&self, draw: &Draw) -> Option<f64> {
        let errors_m = self.drawn(draw);
        (!errors_m.is_empty()).then(|| root_mean_square(&errors_m))
    }

    /// Only the frames that `other` has an estimate for too.
    fn on_frames_of(&self, other: &Self) -> Cow<'_, Self> {
        if self.unsaid.is_empty() && other.unsaid.is_empty() {
            return Cow::Borrowed(self);
        }
        let of_other: HashSet<usize> = other.said.iter().map(|&(index, _)| index).collect();
        let said = self.said.iter().copied().filter(|(index, _)| of_other.contains(index)).collect();
        Cow::Owned(Self { seed: self.seed, said, unsaid: Vec::new() })
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::entry;
    use super::*;

    #[test]
    fn figures_without_a_draw_are_those_of_the_errors() {
        let entries = [entry(0, &[(3, Some(1.0)), (4, Some(3.0)), (9, None)]), entry(1, &[(5, Some(4.0))])];
        let errors = Errors::of(&entries.iter().collect::<Vec<_>>());
        let figures = errors.figures(&Draw::everything(2)).expect("there are frames");
        assert!((figures.rmse_m - (5.0_f64.sqrt() + 4.0) / 2.0).abs() < 1e-12, "{figures:?}");
        assert_eq!((figures.mean_m, figures.median_m, errors.frames()), (3.0, 3.0, 3));
        // Of the frames without an estimate too: 1/3, 1/3, 2/3, 2/3 and 0, 0, 1, 1.
        let expected = [1.0 / 6.0, 1.0 / 6.0, 5.0 / 6.0, 5.0 / 6.0];
        assert!(figures.recall.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-12), "{figures:?}");
    }

    #[test]
    fn a_draw_counts_every_frame_equally_often_on_average_and_neighbours_together() {
        let units = Units::Stretches(Drive { first: 100, indices: 400 });
        let draws = draws(&units, 3, 1);
        for index in [100, 255, 499] {
            let mean = draws.iter().map(|draw| draw.times(index)).sum::<usize>() as f64 / draws.len() as f64;
            // Four standard deviations of a mean of 2000 Poisson counts.
            assert!((mean - 1.0).abs() < 0.09, "{index}: {mean}");
        }
        let together = |apart: usize| {
            let product = |draw: &Draw| (draw.times(200) as f64 - 1.0) * (draw.times(200 + apart) as f64 - 1.0);
            draws.iter().map(product).sum::<f64>() / draws.len() as f64
        };
        assert!(together(1) > 0.8 && together(10) > 0.3 && together(40).abs() < 0.15);
        assert!(draws.iter().all(|draw| draw.seeds().len() == 3));
    }

    #[test]
    fn a_run_that_was_held_out_is_drawn_as_a_whole_whatever_the_seed() {
        let row = |runs: &[[usize; 2]]| Entry {
            held_out_runs: Some(runs.to_vec()),
            ..entry(0, &[(5, Some(1.0)), (70, Some(1.0)), (320, Some(1.0))])
        };
        let rows = [row(&[[0, 17], [56, 74]]), row(&[[0, 17], [75, 93], [302, 320]])];
        let units = Units::of(&rows.iter().collect::<Vec<_>>()).expect("there are frames");
        assert_eq!(units, Units::Runs(vec![[0, 17], [56, 74], [75, 93], [302, 320]]));
        assert_eq!([0, 17, 56, 74, 75, 320].map(|index| units.unit_of(index)), [0, 0, 1, 1, 2, 3]);
        assert!(draws(&units, 2, 0).iter().all(|draw| (0..17).all(|i| draw.times(i) == draw.times(i + 1))));
        // Two stretches next to each other in one seed are one run of it.
        let rows = [row(&[[0, 35]]), row(&[[18, 55]]), row(&[[56, 74]])];
        let units = Units::of(&rows.iter().collect::<Vec<_>>()).expect("there are frames");
        assert_eq!(units, Units::Runs(vec![[0, 55], [56, 74]]));
    }

    #[test]
    fn any_indices_are_places() {
        let drive = Drive { first: 7, indices: u32::MAX as usize };
        assert_eq!((drive.place_of(7), drive.stretch_of(7)), (0, 0));
        let last = 7 + drive.indices - 1;
        assert_eq!((drive.place_of(last), drive.stretch_of(last)), (MAX_PLACES - 1, STRETCHES - 1));
    }

    #[test]
    fn pairs_are_of_frames_with_both_estimates() {
        let (a, b) = (
            entry(0, &[(0, Some(1.0)), (1, None), (2, Some(2.0))]),
            entry(0, &[(0, Some(3.0)), (1, Some(1.0)), (2, None)]),
        );
        let (a, b) = Errors::of(&[&a]).paired(&Errors::of(&[&b]));
        assert_eq!((a.frames(), b.frames()), (1, 1));
        assert_eq!(b.by_frame().next(), Some(BTreeMap::from([(0, 3.0)])));
    }
}
