//! Points of the scene that different passes see: what ties these together, also across the street.
//!
//! What is followed from frame to frame ends with its pass. Where another pass comes by, the points of its nearest frame are
//! looked for in the image where their bearings say that they must be, and those that are found join the bearings of two
//! passes: a lane beside another is then three metres from it, whatever two receivers or one at two times say.

use std::collections::BTreeMap;

use rayon::prelude::*;

use super::bearings::{Frames, PointTrack};
use super::follow::{KeptImage, Wanted};
use crate::types::distance_m;

/// A point is where so many sightings around the frame meet.
const PLACED_BY: usize = 10;
/// Sightings that are joined at most of the point's own pass, and of others: what is followed drifts. Others must see it more
/// than once, as one sighting can always meet the rest somewhere near.
const MOST_OF_A_PASS: usize = 5;
const FEWEST_OF_OTHER: usize = 2;

/// What is looked for, and where.
pub struct Across<'a> {
    pub frames: &'a Frames<'a>,
    pub points: &'a [PointTrack],
    /// Of every row, where points were followed.
    pub images: &'a [Option<KeptImage>],
    /// Frames that may be compared, in rising order.
    pub rows: &'a [usize],
}

/// A point of the frame `of` as the frame `row` of another pass sees it.
struct Shared {
    point: usize,
    of: usize,
    row: usize,
    azimuth_rad: f64,
}

impl Across<'_> {
    /// The points that are found in the first frame of one of `pairs`, as seen from its pass and from that of the second.
    pub fn joined(&self, pairs: &[(usize, usize)]) -> Vec<PointTrack> {
        let seen = self.seen();
        let shared: Vec<Vec<Shared>> = pairs.par_iter().map(|&(row, of)| self.shared(row, of, &seen[of])).collect();
        let mut of_point: BTreeMap<usize, Vec<Shared>> = BTreeMap::new();
        for shared in shared.into_iter().flatten() {
            of_point.entry(shared.point).or_default().push(shared);
        }
        let parts = of_point.values().flat_map(|shared| shared.chunks(MOST_OF_A_PASS));
        parts.filter(|part| part.len() >= FEWEST_OF_OTHER).map(|part| self.track(part)).collect()
    }

    /// Of every row, its points: number, azimuth and row of the panorama.
    fn seen(&self) -> Vec<Vec<(usize, f64, f32)>> {
        let mut seen = vec![Vec::new(); self.images.len()];
        for (number, point) in self.points.iter().enumerate() {
            for (row, azimuth_rad, height_px) in point.sightings() {
                seen[row].push((number, azimuth_rad, height_px));
            }
        }
        seen
    }

    /// Those of the points `seen` from the frame `of` that the frame `row` shows.
    fn shared(&self, row: usize, of: usize, seen: &[(usize, f64, f32)]) -> Vec<Shared> {
        let (Some(image), Some(other)) = (&self.images[row], &self.images[of]) else { return Vec::new() };
        let wanted = |&(point, azimuth_rad, height_px): &(usize, f64, f32)| {
            let place_m = self.frames.place_m(&self.points[point].around(of, PLACED_BY, |row| self.is_used(row)))?;
            let [from_there_m, from_here_m] = [of, row].map(|row| distance_m(self.frames.positions_m[row], place_m));
            let thought_rad = self.frames.azimuth_rad(row, place_m);
            Some((point, Wanted { azimuth_rad, height_px, thought_rad, farther: from_here_m / from_there_m }))
        };
        let (points, wanted): (Vec<usize>, Vec<Wanted>) = seen.iter().filter_map(wanted).unzip();
        let found = points.into_iter().zip(image.find(other, &wanted));
        found.filter_map(|(point, azimuth_rad)| Some(Shared { point, of, row, azimuth_rad: azimuth_rad? })).collect()
    }

    /// Of one point, seen from another pass, with the sightings of its own that are nearest to there.
    fn track(&self, shared: &[Shared]) -> PointTrack {
        let Shared { point, of, .. } = shared[shared.len() / 2];
        let mut bearings = self.points[point].around(of, MOST_OF_A_PASS, |row| self.is_used(row));
        bearings.extend(shared.iter().map(|shared| (shared.row, shared.azimuth_rad)));
        bearings.sort_by_key(|&(row, _)| row);
        PointTrack::joined(bearings)
    }

    fn is_used(&self, row: usize) -> bool {
        self.rows.binary_search(&row).is_ok()
    }
}
