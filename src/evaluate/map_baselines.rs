//! What a map is compared with, on the frames of another drive.

use super::against_map::base_entry;
use super::baselines::{BaselineRows, Frames, Views};
use super::protocol::side_by_side;
use crate::map::FeatureMap;
use crate::recording::Recording;
use crate::train::{Split, Survey};
use crate::types::PositionM;

/// The drive that is compared on, and the map.
pub struct MapComparison<'a> {
    /// Name of the drive.
    pub dataset: &'a str,
    pub survey: &'a Survey,
    pub map: &'a FeatureMap,
    /// Where the drive's frames are in truth.
    pub truth_m: &'a [PositionM],
}

impl MapComparison<'_> {
    /// Adds the row of the nearest learning image by the map's own features, each scaled to unit deviation; positions are
    /// those that the map has.
    pub fn add_nearest(&self, rows: &mut BaselineRows) {
        let everything: Vec<usize> = (0..self.survey.len()).collect();
        let groups = self.map.info.groups.iter().zip(&self.map.groups);
        let of_test = side_by_side(groups.map(|(info, group)| {
            group.scaling.apply(self.survey.properties(info.recipe.descriptor, &everything).as_ref())
        }));
        let of_learned = side_by_side(self.map.groups.iter().map(|group| group.learning.clone()));
        let base = base_entry(self.dataset, self.survey, self.map);
        self.with_frames(&self.map.positions_m, &[], |frames| {
            rows.add_nearest(&base, frames, of_learned.as_ref(), of_test.as_ref());
        });
    }

    /// Adds the rows of the baselines that compare images. `views` are those of the frames of `learned`, the recordings that
    /// the map was made of, and then of the drive's. Settings are chosen on a quarter of the learned frames, split as in
    /// training, and the rest; then all are learned from.
    pub fn add_views(&self, rows: &mut BaselineRows, learned: &[Recording], views: &Views) {
        let frames_of =
            |recording: &Recording| recording.survey.iter().map(|frame| frame.position_m).collect::<Vec<_>>();
        let learned_m: Vec<PositionM> = learned.iter().flat_map(frames_of).collect();
        let split = Split::new(self.map.info.split, learned_m.len(), self.map.info.seed);
        let mut base = base_entry(self.dataset, self.survey, self.map);
        base.n_learned_from = learned_m.len();
        self.with_frames(&learned_m, &split.validation, |frames| rows.add_views(&base, frames, views));
    }

    /// Adds the row of always answering the median of the map's positions.
    pub fn add_median(&self, rows: &mut BaselineRows) {
        let base = base_entry(self.dataset, self.survey, self.map);
        self.with_frames(&self.map.positions_m, &[], |frames| rows.add_median(&base, frames));
    }

    /// Calls `with` with the frames at `learned_m` and then those of the drive; settings are chosen on those at
    /// `validation`.
    fn with_frames(&self, learned_m: &[PositionM], validation: &[usize], with: impl FnOnce(&Frames)) {
        let learning: Vec<usize> = (0..learned_m.len()).filter(|row| !validation.contains(row)).collect();
        let test: Vec<usize> = (learned_m.len()..learned_m.len() + self.survey.len()).collect();
        let recorded_m = [learned_m, &self.survey.positions_m()].concat();
        // Frames of the map are counted; those of the drive have indices of their own.
        let indices: Vec<usize> =
            (0..learned_m.len()).chain(self.survey.frames.iter().map(|frame| frame.index)).collect();
        with(&Frames {
            learning: &learning,
            validation,
            test: &test,
            recorded_m: &recorded_m,
            test_m: self.truth_m,
            indices: &indices,
        });
    }
}
