//! The baselines' rows of a table.

use faer::MatRef;

use super::bag_of_words::{BagOfWords, WordAnswers, WordAssignment};
use super::{Views, aligned, nearest};
use crate::evaluate::entry::Entry;
use crate::evaluate::statistics::Section;
use crate::metrics::{ErrorFigures, component_median};
use crate::types::PositionM;

/// The frames of a case, as rows of the [`Views`]; all in rising order.
#[derive(Debug, Clone, Copy)]
pub struct Frames<'a> {
    pub learning: &'a [usize],
    pub validation: &'a [usize],
    pub test: &'a [usize],
    /// Positions of all rows, to learn from and to choose on \[m\].
    pub recorded_m: &'a [PositionM],
    /// What errors of the test frames are measured against, in the order of `test` \[m\].
    pub test_m: &'a [PositionM],
    /// The frames' own indices, of all rows.
    pub indices: &'a [usize],
}

impl Frames<'_> {
    /// All frames that may be learned from once nothing is left to choose.
    pub fn learned_from(&self) -> Vec<usize> {
        let mut rows = [self.learning, self.validation].concat();
        rows.sort_unstable();
        rows
    }

    pub fn positions_m(&self, rows: &[usize]) -> Vec<PositionM> {
        rows.iter().map(|&row| self.recorded_m[row]).collect()
    }

    /// The median of the learning positions.
    pub fn know_nothing_m(&self) -> PositionM {
        component_median(&self.positions_m(self.learning))
    }

    /// The row of `entry`, which answers `estimates_m` for the test frames.
    pub fn with_answers(&self, entry: Entry, estimates_m: &[PositionM]) -> Entry {
        let indices: Vec<usize> = self.test.iter().map(|&row| self.indices[row]).collect();
        let figures = ErrorFigures::of(estimates_m, self.test_m, self.know_nothing_m());
        entry.with_figures(figures).with_frames(&indices, self.test_m, estimates_m)
    }
}

/// What the baselines bring to a table.
#[derive(Debug, Clone, Default)]
pub struct BaselineRows {
    pub entries: Vec<Entry>,
    /// One a kind of words.
    pub assignments: Vec<WordAssignment>,
    /// Why a row is missing.
    pub notes: Vec<String>,
}

impl BaselineRows {
    /// The row of the image with the nearest properties, n × d, of the frames learned from and of those tested. `base` is
    /// what all rows have in common.
    pub fn add_nearest(&mut self, base: &Entry, frames: &Frames, of_learned: MatRef<f64>, of_test: MatRef<f64>) {
        let learned = frames.learned_from();
        match nearest::nearest(of_learned, of_test) {
            Ok(found) => {
                let estimates_m: Vec<PositionM> = found.iter().map(|&i| frames.recorded_m[learned[i]]).collect();
                let entry = Entry { features: "nearest".into(), m: Some(of_learned.ncols()), ..base.clone() };
                self.entries.push(frames.with_answers(entry, &estimates_m));
            }
            Err(error) => self.notes.push(format!("nearest: {error}")),
        }
    }

    /// The rows of all baselines that `views` is for.
    pub fn add_views(&mut self, base: &Entry, frames: &Frames, views: &Views) {
        if let Some(signatures) = &views.aligned {
            let found = aligned::nearest(signatures, frames.test, &frames.learned_from());
            let entry = Entry { features: "aligned".into(), ..base.clone() };
            self.entries.push(frames.with_answers(entry, &frames.positions_m(&found)));
        }
        for (name, words) in [("bow", &views.bow), ("bow-surf", &views.bow_surf)] {
            if let Some(words) = words {
                self.add_words(base, frames, name, words);
            }
        }
    }

    /// The row of always answering the median of the learning positions.
    pub fn add_median(&mut self, base: &Entry, frames: &Frames) {
        let answers = vec![frames.know_nothing_m(); frames.test.len()];
        let entry = Entry { features: "median".into(), n_learned_from: frames.learning.len(), ..base.clone() };
        self.entries.push(frames.with_answers(entry, &answers));
    }

    fn add_words(&mut self, base: &Entry, frames: &Frames, name: &str, words: &BagOfWords) {
        let entry = |features: String, answers: &WordAnswers| Entry {
            features,
            m: Some(answers.words),
            neighbours: Some(answers.neighbours),
            chosen_on: Some("validation"),
            ..base.clone()
        };
        match words.paper(frames) {
            Some((answers, votes)) => {
                let classified_share = Some(votes.classified_share());
                let entry = Entry { classified_share, ..entry(name.into(), &answers) };
                self.entries.push(frames.with_answers(entry, &answers.estimates_m));
                self.assignments.push(votes.assignment(frames, &answers, name, &Section::of(base), base.seed));
            }
            None => self.notes.push(format!("{name}: no learning image lies within 5 m of a test position")),
        }
        let answers = words.nearest(frames);
        let entry = entry(format!("{name}-nearest"), &answers);
        self.entries.push(frames.with_answers(entry, &answers.estimates_m));
    }
}
