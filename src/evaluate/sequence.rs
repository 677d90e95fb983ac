//! A whole drive against a map: what the filter says frame by frame, and what the smoother says of all frames.

use crate::localize::{MotionSettings, Observation, Tracker, smooth};
use crate::map::FeatureMap;
use crate::types::{
    EstimatedHeading, LocalizationState, NS_PER_S, PositionCovariance, PositionM, distance_m, wrap_angle_rad,
};

/// One estimator's answers for a drive.
#[derive(Debug, Clone, PartialEq)]
pub struct Sequence {
    pub estimator: &'static str,
    /// One a frame; `None` where no position is said.
    pub poses: Vec<Option<SequencePose>>,
    /// One a frame; `None` for an estimator that has none.
    pub states: Vec<Option<LocalizationState>>,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SequencePose {
    pub position_m: PositionM,
    pub covariance: PositionCovariance,
    pub heading: Option<EstimatedHeading>,
}

/// How a drive went, for all frames that have a pose.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct SequenceFigures {
    /// Mean of the normalised estimation error squared (Bar-Shalom et al. 2001, section 5.4): 2 where the covariance is
    /// right.
    pub nees_mean: f64,
    /// Share of the frames whose true position lies in the ellipse that holds 95 %.
    pub coverage_95: f64,
    pub heading_median_deg: Option<f64>,
    /// Share of all frames that have a pose.
    pub share: f64,
    /// Of the first pose, since the first frame.
    pub first_s: f64,
    /// And the way driven up to it.
    pub first_m: f64,
}

/// Quantile of χ² with two degrees of freedom: −2 log 0.05.
const CHI_SQUARE_95: f64 = 5.991_464_547;

/// Filtered and smoothed answers for `frames`, in the order of their stamps.
pub fn sequences(map: &FeatureMap, frames: &[Observation]) -> [Sequence; 2] {
    let settings = MotionSettings::default();
    let mut tracker = Tracker::new(map, settings);
    let (poses, states) = frames
        .iter()
        .map(|frame| {
            let estimate = tracker.take(frame).estimate;
            let pose = estimate.pose.map(|pose| SequencePose {
                position_m: pose.position_m,
                covariance: pose.covariance,
                heading: pose.heading,
            });
            (pose, Some(estimate.state))
        })
        .unzip();
    let smoothed = smooth(map, settings, frames).into_iter().zip(frames).map(|(smoothed, frame)| {
        let heading = tracker.heading(smoothed.position_m, frame.compass);
        Some(SequencePose { position_m: smoothed.position_m, covariance: smoothed.covariance, heading })
    });
    [
        Sequence { estimator: "filtered", poses, states },
        Sequence { estimator: "smoothed", poses: smoothed.collect(), states: vec![None; frames.len()] },
    ]
}

impl SequenceFigures {
    /// `None` where there is no pose. `yaws_rad` where they are known.
    pub fn of(sequence: &Sequence, stamps_ns: &[u64], truth_m: &[PositionM], yaws_rad: &[Option<f64>]) -> Option<Self> {
        let first = sequence.poses.iter().position(Option::is_some)?;
        let posed = || sequence.poses.iter().enumerate().filter_map(|(i, pose)| Some((i, pose.as_ref()?)));
        let nees: Vec<f64> = posed().map(|(i, pose)| nees(&pose.covariance, pose.position_m, truth_m[i])).collect();
        let n = nees.len() as f64;
        let mut headings_deg: Vec<f64> = posed()
            .filter_map(|(i, pose)| Some(wrap_angle_rad(pose.heading?.yaw_rad - yaws_rad[i]?).to_degrees().abs()))
            .collect();
        headings_deg.sort_unstable_by(f64::total_cmp);
        Some(Self {
            nees_mean: nees.iter().sum::<f64>() / n,
            coverage_95: nees.iter().filter(|&&nees| nees <= CHI_SQUARE_95).count() as f64 / n,
            heading_median_deg: headings_deg.get(headings_deg.len() / 2).copied(),
            share: n / sequence.poses.len() as f64,
            first_s: (stamps_ns[first] - stamps_ns[0]) as f64 / NS_PER_S as f64,
            first_m: truth_m[..=first].windows(2).fold(0.0, |way_m, pair| way_m + distance_m(pair[0], pair[1])),
        })
    }
}

/// eᵀ P⁻¹ e.
pub fn nees(covariance: &PositionCovariance, estimate_m: PositionM, truth_m: PositionM) -> f64 {
    let PositionCovariance { ee_m2, en_m2, nn_m2 } = *covariance;
    let (e, n) = (estimate_m[0] - truth_m[0], estimate_m[1] - truth_m[1]);
    (nn_m2 * e * e - 2.0 * en_m2 * e * n + ee_m2 * n * n) / (ee_m2 * nn_m2 - en_m2 * en_m2)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn figures_are_of_the_frames_with_a_pose() {
        let pose = |e: f64, yaw_rad: f64| {
            let heading = Some(EstimatedHeading { yaw_rad, yaw_std_rad: 0.01 });
            let covariance = PositionCovariance { ee_m2: 4.0, en_m2: 1.0, nn_m2: 1.0 };
            Some(SequencePose { position_m: [e, 0.0], covariance, heading })
        };
        let sequence = Sequence {
            estimator: "filtered",
            poses: vec![None, None, pose(2.0, 0.1), pose(6.0, 0.3)],
            states: vec![None; 4],
        };
        let truth_m = [[0.0, 0.0], [3.0, 0.0], [1.0, 0.0], [2.0, 0.0]];
        let yaws_rad = [Some(0.0), Some(0.0), Some(0.1), Some(0.2)];
        let figures = SequenceFigures::of(&sequence, &[5, 6, 1_500_000_005, 9_000_000_000], &truth_m, &yaws_rad);
        let figures = figures.expect("two poses");
        // det = 3: 1·e²/3.
        assert!((figures.nees_mean - (1.0 + 16.0) / 6.0).abs() < 1e-12, "{figures:?}");
        assert_eq!((figures.coverage_95, figures.share, figures.first_m), (1.0, 0.5, 5.0));
        assert!((figures.first_s - 1.5).abs() < 1e-9, "{figures:?}");
        assert!((figures.heading_median_deg.expect("two headings") - 0.1_f64.to_degrees()).abs() < 1e-9);
        let nothing = Sequence { poses: vec![None; 4], ..sequence };
        assert_eq!(SequenceFigures::of(&nothing, &[0; 4], &truth_m, &yaws_rad), None);
    }
}
