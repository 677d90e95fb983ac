//! Position estimates as messages.

use super::{
    proto::{
        foxglove,
        omniloc::{self, position_estimate::State},
    },
    writer::pose_message,
};
use crate::types::{LocalizationState, PositionEstimate};

impl From<LocalizationState> for State {
    fn from(state: LocalizationState) -> Self {
        match state {
            LocalizationState::Unknown => Self::Unknown,
            LocalizationState::Candidate => Self::Candidate,
            LocalizationState::Localized => Self::Localized,
            LocalizationState::Lost => Self::Lost,
        }
    }
}

impl From<&PositionEstimate> for omniloc::PositionEstimate {
    /// Without a timestamp, which depends on the recording.
    fn from(estimate: &PositionEstimate) -> Self {
        let pose = estimate.pose;
        let covariance = pose.map(|pose| pose.covariance);
        let heading = pose.and_then(|pose| pose.heading);
        let velocity_mps = pose.and_then(|pose| pose.velocity_mps);
        Self {
            timestamp: None,
            frame_sequence: estimate.sequence.into(),
            state: State::from(estimate.state).into(),
            east_m: pose.map(|pose| pose.position_m[0]),
            north_m: pose.map(|pose| pose.position_m[1]),
            cov_ee_m2: covariance.map(|covariance| covariance.ee_m2),
            cov_en_m2: covariance.map(|covariance| covariance.en_m2),
            cov_nn_m2: covariance.map(|covariance| covariance.nn_m2),
            yaw_rad: heading.map(|heading| heading.yaw_rad),
            yaw_std_rad: heading.map(|heading| heading.yaw_std_rad),
            velocity_east_mps: velocity_mps.map(|velocity_mps| velocity_mps[0]),
            velocity_north_mps: velocity_mps.map(|velocity_mps| velocity_mps[1]),
            single_frame_east_m: estimate.single_frame_m.map(|position_m| position_m[0]),
            single_frame_north_m: estimate.single_frame_m.map(|position_m| position_m[1]),
            warnings: estimate.warnings.words().map(str::to_owned).collect(),
        }
    }
}

/// An estimate as it is recorded and, if it may be relied on, as pose for viewers. The estimate is what counts.
pub(super) fn estimate_messages(
    timestamp: prost_types::Timestamp,
    estimate: &PositionEstimate,
) -> (omniloc::PositionEstimate, Option<foxglove::PoseInFrame>) {
    let message = omniloc::PositionEstimate { timestamp: Some(timestamp), ..estimate.into() };
    let pose = estimate.pose.map(|pose| {
        let yaw_rad = pose.heading.map(|heading| heading.yaw_rad);
        pose_message(timestamp, pose.position_m, yaw_rad)
    });
    (message, pose)
}

#[cfg(test)]
mod tests {
    use std::{fs, io::Cursor};

    use prost::Message;

    use super::*;
    use crate::{
        recording::{
            recorder::{Encoder, Head, Segment},
            recover::recover_bytes,
            topics, verify,
        },
        types::{ClockReading, EstimateWarnings, EstimatedHeading, EstimatedPose, PositionCovariance},
    };

    fn estimate(sequence: u32, pose: Option<EstimatedPose>) -> PositionEstimate {
        let state = if pose.is_some() { LocalizationState::Localized } else { LocalizationState::Candidate };
        let warnings = EstimateWarnings { ambiguous: true, ..Default::default() };
        let stamp_ns = 1_000_000_000 + u64::from(sequence);
        PositionEstimate { sequence, stamp_ns, state, pose, single_frame_m: Some([0.0, 2.5]), warnings }
    }

    fn pose() -> EstimatedPose {
        EstimatedPose {
            position_m: [12.5, -3.0],
            covariance: PositionCovariance { ee_m2: 0.5, en_m2: 0.0, nn_m2: 0.25 },
            velocity_mps: None,
            heading: Some(EstimatedHeading { yaw_rad: std::f64::consts::FRAC_PI_2, yaw_std_rad: 0.01 }),
        }
    }

    /// A recording of three estimates, the second of which is localized; finished or cut off.
    fn recording(is_finished: bool) -> Vec<u8> {
        let head = Head::new("", "test", "", ClockReading { monotonic_ns: 0, realtime_ns: 1_700_000_000_000_000_000 });
        let encoder = Encoder::new(head.log_offset_ns);
        let mut segment = Segment::start(Cursor::new(Vec::new()), &head, 0).expect("starts");
        for (sequence, pose) in [(4, None), (5, Some(pose())), (6, None)] {
            let (estimate, pose) = encoder.estimate(&estimate(sequence, pose));
            segment.write(&estimate).expect("writes");
            pose.iter().for_each(|pose| segment.write(pose).expect("writes"));
            segment.flush().expect("writes");
        }
        if is_finished { segment.finish().expect("finishes").into_inner() } else { segment.abandon().into_inner() }
    }

    #[test]
    fn estimates_are_recorded_with_what_is_known() {
        let bytes = recording(true);
        let messages: Vec<_> =
            mcap::MessageStream::new(&bytes).expect("sound").map(|message| message.expect("sound")).collect();
        let facts: Vec<_> = messages.iter().map(|message| (message.channel.topic.as_str(), message.sequence)).collect();
        let (estimates, poses) = (topics::POSE_ESTIMATE.name, topics::SURVEY_POSE.name);
        assert_eq!(facts, [(estimates, 4), (estimates, 5), (poses, 5), (estimates, 6)]);

        let candidate = omniloc::PositionEstimate::decode(&*messages[0].data).expect("an estimate");
        assert_eq!((candidate.state(), candidate.east_m, candidate.yaw_rad), (State::Candidate, None, None));
        assert_eq!((candidate.single_frame_east_m, candidate.single_frame_north_m), (Some(0.0), Some(2.5)));
        assert_eq!(candidate.warnings, ["ambiguous"]);
        let localized = omniloc::PositionEstimate::decode(&*messages[1].data).expect("an estimate");
        assert_eq!((localized.frame_sequence, localized.state()), (5, State::Localized));
        assert_eq!((localized.east_m, localized.north_m, localized.cov_en_m2), (Some(12.5), Some(-3.0), Some(0.0)));
        assert_eq!((localized.velocity_east_mps, localized.yaw_std_rad), (None, Some(0.01)));
        let pose = foxglove::PoseInFrame::decode(&*messages[2].data).expect("a pose");
        assert_eq!(pose.timestamp, localized.timestamp);
        let orientation = pose.pose.and_then(|pose| pose.orientation).expect("turned");
        assert!((orientation.z - 0.5_f64.sqrt()).abs() < 1e-12 && (orientation.w - orientation.z).abs() < 1e-12);
    }

    #[test]
    fn check_and_recover_know_estimates() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let path = folder.path().join("a.mcap");
        fs::write(&path, recording(true)).expect("writes");
        let verdict = verify(&path).expect("readable");
        assert!(
            verdict.is_sound() && verdict.notes.iter().all(|note| !note.contains("PositionEstimate")),
            "{verdict:?}"
        );

        // Without the first chunk, which declares the topics: what the messages are shows in their channel numbers.
        let mut bytes = recording(false);
        let first_message = bytes.windows(9).position(|window| window == b"ambiguous").expect("it is there");
        bytes[first_message] ^= 1;
        let (recovery, _) = recover_bytes(&bytes).expect("something is left");
        let estimates = &recovery.topics[topics::POSE_ESTIMATE.name];
        assert_eq!((estimates.messages, estimates.schema_name.as_str()), (2, topics::POSE_ESTIMATE.schema_name));
    }
}
