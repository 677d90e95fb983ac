//! What a frame of no place in the map looks like to the map: learned from frames that were held back, by leaving out the
//! places around them.

use crate::localize::most_likely_cell;
use crate::map::CandidateCells;
use crate::types::{PositionM, distance_m};

/// Cells within so many spacings of a frame are left out: it looks like none of the rest.
const FAR_SPACINGS: f64 = 8.0;
/// With fewer frames or fewer cells left nothing is learned.
const MIN_FRAMES: usize = 8;
const MIN_FAR_SHARE: f64 = 0.2;
/// So many of the frames resemble a place that is not theirs less than the limit of what is strange.
const QUANTILE: f64 = 0.99;
/// From there to what a frame resembles its own place on the same day, the line is drawn so far up: other days look less
/// like the map than frames that were held back, and other towns more than the rest of this one. Fixed on simulated towns.
const UP_TO_ITS_OWN: f64 = 0.2;

/// Frames that were held back, as the map sees them.
pub struct HeldBack<'a> {
    pub cells: &'a CandidateCells,
    /// One row of cells a frame.
    pub log_likelihoods: &'a [&'a [f32]],
    /// Log-likelihood of no place, one a frame.
    pub nowhere: &'a [f32],
    pub truth_m: &'a [PositionM],
}

/// The resemblance below which frames are of no place in the map: how much larger the greatest log-likelihood is than that
/// of no place. `None` with too few frames, or where no place lies far from another.
pub fn least_resemblance(held_back: &HeldBack, spacing_m: f64) -> Option<f64> {
    let HeldBack { cells, log_likelihoods, nowhere, truth_m } = held_back;
    let centers_m = cells.centers_m();
    // Of a place that is not its own, and of any.
    let (mut strange, mut own): (Vec<f64>, Vec<f64>) = log_likelihoods
        .iter()
        .zip(*nowhere)
        .zip(*truth_m)
        .filter_map(|((row, nowhere), &truth_m)| {
            let is_far = |cell: &usize| distance_m(centers_m[*cell], truth_m) > FAR_SPACINGS * spacing_m;
            let far: Vec<f32> = (0..row.len()).filter(is_far).map(|cell| row[cell]).collect();
            let enough = far.len() as f64 >= MIN_FAR_SHARE * row.len() as f64;
            let strange = far.into_iter().reduce(f32::max).filter(|_| enough)?;
            let own = row[most_likely_cell(row)];
            Some((f64::from(strange - nowhere), f64::from(own - nowhere)))
        })
        .unzip();
    if strange.len() < MIN_FRAMES {
        return None;
    }
    strange.sort_unstable_by(f64::total_cmp);
    own.sort_unstable_by(f64::total_cmp);
    let limit = strange[(QUANTILE * (strange.len() - 1) as f64).round() as usize];
    let usual = own[own.len() / 2];
    Some(limit + UP_TO_ITS_OWN * (usual - limit).max(0.0))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_lies_around_a_frame_does_not_count() {
        let cells = CandidateCells::around(&[[0.0, 0.0], [99.0, 0.0]], 1.0, None).expect("a row of cells");
        let truth_m: Vec<PositionM> = (0..50).map(|i| [2.0 * f64::from(i), 0.0]).collect();
        // The right place stands out by 90; elsewhere every frame finds something of its own number.
        let rows: Vec<Vec<f32>> = (0..50)
            .map(|i| {
                let at = |center: &PositionM| if distance_m(*center, truth_m[i]) < 3.0 { 90.0 } else { i as f32 };
                cells.centers_m().iter().map(at).collect()
            })
            .collect();
        let log_likelihoods: Vec<&[f32]> = rows.iter().map(Vec::as_slice).collect();
        let nowhere = vec![10.0; 50];
        let held_back =
            HeldBack { cells: &cells, log_likelihoods: &log_likelihoods, nowhere: &nowhere, truth_m: &truth_m };
        assert_eq!(least_resemblance(&held_back, 1.0), Some(39.0 + UP_TO_ITS_OWN * (80.0 - 39.0)));
        // A place as small as this has no elsewhere.
        assert_eq!(least_resemblance(&held_back, 30.0), None);
    }
}
