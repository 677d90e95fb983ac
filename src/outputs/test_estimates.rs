//! Estimates for the tests.

use proptest::prelude::*;

use super::TimedEstimate;
use crate::types::{
    EstimateWarnings, EstimatedHeading, EstimatedPose, LocalizationState, PositionCovariance, PositionEstimate,
    PositionM,
};

pub fn unknown() -> TimedEstimate {
    TimedEstimate {
        estimate: PositionEstimate {
            sequence: 0,
            stamp_ns: 0,
            state: LocalizationState::Unknown,
            pose: None,
            single_frame_m: None,
            warnings: EstimateWarnings::default(),
        },
        utc_ns: None,
    }
}

/// Driving 5 m/s to the north-east, UTC not known.
pub fn localized(position_m: PositionM) -> TimedEstimate {
    let pose = EstimatedPose {
        position_m,
        covariance: PositionCovariance { ee_m2: 0.36, en_m2: -0.04, nn_m2: 0.25 },
        velocity_mps: Some([3.0, 4.0]),
        heading: Some(EstimatedHeading { yaw_rad: 0.5, yaw_std_rad: 0.02 }),
    };
    let estimate = PositionEstimate {
        sequence: 7,
        stamp_ns: 12_345_678_901,
        state: LocalizationState::Localized,
        pose: Some(pose),
        single_frame_m: Some([103.2, 199.1]),
        ..unknown().estimate
    };
    TimedEstimate { estimate, utc_ns: None }
}

/// Whatever a localizer may say: within 20 km of the origin, at any time from 2020 on.
pub fn any_estimate() -> impl Strategy<Value = TimedEstimate> {
    let heading = (-3.15..3.15_f64, 0.0..4.0_f64);
    let heading = heading.prop_map(|(yaw_rad, yaw_std_rad)| EstimatedHeading { yaw_rad, yaw_std_rad });
    let covariance = (0.0..1e4_f64, -1.0..1.0_f64, 0.0..1e4_f64).prop_map(|(ee_m2, correlation, nn_m2)| {
        PositionCovariance { ee_m2, en_m2: correlation * (ee_m2 * nn_m2).sqrt(), nn_m2 }
    });
    let position = || prop::array::uniform2(prop_oneof![-2e4..2e4_f64, -1e-3..1e-3_f64]);
    let velocity = prop::option::of(prop::array::uniform2(-40.0..40.0_f64));
    let pose = (position(), covariance, velocity, prop::option::of(heading)).prop_map(
        |(position_m, covariance, velocity_mps, heading)| EstimatedPose {
            position_m,
            covariance,
            velocity_mps,
            heading,
        },
    );
    let state = prop_oneof![
        Just(LocalizationState::Unknown),
        Just(LocalizationState::Candidate),
        Just(LocalizationState::Lost)
    ];
    let warnings = prop::array::uniform4(any::<bool>());
    let warnings = warnings.prop_map(|[bad_frame, unlike_the_map, contradiction, ambiguous]| EstimateWarnings {
        bad_frame,
        unlike_the_map,
        contradiction,
        ambiguous,
    });
    let utc_ns = prop::option::of(1_577_836_800_000_000_000..3_400_000_000_000_000_000_i64);
    let parts =
        (any::<u32>(), any::<u64>(), state, prop::option::of(pose), prop::option::of(position()), warnings, utc_ns);
    parts.prop_map(|(sequence, stamp_ns, state, pose, single_frame_m, warnings, utc_ns)| {
        let state = if pose.is_some() { LocalizationState::Localized } else { state };
        let estimate = PositionEstimate { sequence, stamp_ns, state, pose, single_frame_m, warnings };
        TimedEstimate { estimate, utc_ns }
    })
}
