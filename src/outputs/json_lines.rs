//! Estimates as JSON lines: one object a frame, its keys always in this order.
//!
//! | key | what | rounded to |
//! |---|---|---|
//! | `sequence` | number of the frame | |
//! | `time` | UTC of its exposure, RFC 3339; null while UTC is not known | 1 µs |
//! | `stamp_s` | start of its exposure on the monotonic clock | exact: ns |
//! | `state` | `unknown`, `candidate`, `localized`, `lost` | |
//! | `e_m`, `n_m` | position, east and north from the map's origin | 1 mm |
//! | `cov_ee_m2`, `cov_en_m2`, `cov_nn_m2` | its covariance | 1e-6 m² |
//! | `std_m` | √((cov_ee + cov_nn) / 2): one standard deviation of an axis | 1 mm |
//! | `lat_deg`, `lon_deg` | the same position on WGS84; null if the map has no origin | 1e-9 ° |
//! | `heading_rad` | from north, clockwise, from 0 to 2π; null if not known | 1e-4 rad |
//! | `heading_std_rad` | one standard deviation of it | 1e-4 rad |
//! | `speed_mps` | over ground; null if not known | 1 mm/s |
//! | `single_e_m`, `single_n_m` | what this frame alone says: for diagnosis; null if it says nothing | 1 mm |
//! | `warnings` | what is unusual about the frame, in words | |
//!
//! From `e_m` to `speed_mps` everything is null unless the state is `localized`. Numbers always have all their decimals,
//! and equal estimates give equal bytes on every architecture.

use super::{
    TimedEstimate,
    text::{Utc, push_decimal, push_units, push_whole, rounded_units},
};
use crate::types::{EstimatedPose, LocalFrame};

const LENGTH_DECIMALS: u32 = 3;
const COVARIANCE_DECIMALS: u32 = 6;
const DEGREE_DECIMALS: u32 = 9;
const ANGLE_DECIMALS: u32 = 4;
const STAMP_DECIMALS: u32 = 9;
/// 2π in units of [`ANGLE_DECIMALS`], rounded up.
const FULL_TURN_UNITS: u64 = 62_832;

/// No line is longer \[bytes\].
pub const MAX_LINE_BYTES: usize = 768;

/// Appends one line. `map_frame`: where on Earth the map is.
pub fn write_line(timed: &TimedEstimate, map_frame: Option<&LocalFrame>, out: &mut Vec<u8>) {
    let estimate = &timed.estimate;
    let pose = estimate.pose.as_ref();
    out.extend(b"{\"sequence\":");
    push_whole(out, estimate.sequence.into(), 1);

    key(out, "time");
    match timed.utc_ns {
        Some(utc_ns) => push_time(out, utc_ns),
        None => out.extend(b"null"),
    }
    key(out, "stamp_s");
    push_units(out, estimate.stamp_ns, STAMP_DECIMALS, 1);
    key(out, "state");
    push_word(out, estimate.state.name());

    let covariance = pose.map(|pose| pose.covariance);
    number(out, "e_m", pose.map(|pose| pose.position_m[0]), LENGTH_DECIMALS);
    number(out, "n_m", pose.map(|pose| pose.position_m[1]), LENGTH_DECIMALS);
    number(out, "cov_ee_m2", covariance.map(|covariance| covariance.ee_m2), COVARIANCE_DECIMALS);
    number(out, "cov_en_m2", covariance.map(|covariance| covariance.en_m2), COVARIANCE_DECIMALS);
    number(out, "cov_nn_m2", covariance.map(|covariance| covariance.nn_m2), COVARIANCE_DECIMALS);
    let variance_m2 = covariance.map(|covariance| 0.5 * (covariance.ee_m2 + covariance.nn_m2));
    number(out, "std_m", variance_m2.map(f64::sqrt), LENGTH_DECIMALS);

    let place = pose.zip(map_frame).map(|(pose, frame)| frame.plane_to_geodetic(pose.position_m));
    number(out, "lat_deg", place.map(|place| place.latitude_deg), DEGREE_DECIMALS);
    number(out, "lon_deg", place.map(|place| place.longitude_deg), DEGREE_DECIMALS);

    let heading = pose.and_then(|pose| pose.heading);
    key(out, "heading_rad");
    match heading.and_then(|heading| heading_units(heading.yaw_rad)) {
        Some(units) => push_units(out, units, ANGLE_DECIMALS, 1),
        None => out.extend(b"null"),
    }
    number(out, "heading_std_rad", heading.map(|heading| heading.yaw_std_rad), ANGLE_DECIMALS);
    number(out, "speed_mps", pose.and_then(speed_mps), LENGTH_DECIMALS);
    number(out, "single_e_m", estimate.single_frame_m.map(|position| position[0]), LENGTH_DECIMALS);
    number(out, "single_n_m", estimate.single_frame_m.map(|position| position[1]), LENGTH_DECIMALS);

    key(out, "warnings");
    out.push(b'[');
    for (i, word) in estimate.warnings.words().enumerate() {
        if i > 0 {
            out.push(b',');
        }
        push_word(out, word);
    }
    out.extend(b"]}\n");
}

/// Not `hypot`, whose last digit differs from computer to computer.
pub(super) fn speed_mps(pose: &EstimatedPose) -> Option<f64> {
    pose.velocity_mps.map(|[east_mps, north_mps]| (east_mps * east_mps + north_mps * north_mps).sqrt())
}

/// From east, counter-clockwise → from north, clockwise.
fn heading_units(yaw_rad: f64) -> Option<u64> {
    use std::f64::consts::{FRAC_PI_2, TAU};
    let units = rounded_units((FRAC_PI_2 - yaw_rad).rem_euclid(TAU), ANGLE_DECIMALS)?;
    Some(units.unsigned_abs() % FULL_TURN_UNITS)
}

fn key(out: &mut Vec<u8>, name: &str) {
    out.extend(b",\"");
    out.extend(name.as_bytes());
    out.extend(b"\":");
}

fn number(out: &mut Vec<u8>, name: &str, value: Option<f64>, decimals: u32) {
    key(out, name);
    if !value.is_some_and(|value| push_decimal(out, value, decimals)) {
        out.extend(b"null");
    }
}

/// A word of ours, in which nothing has to be escaped.
fn push_word(out: &mut Vec<u8>, word: &str) {
    out.push(b'"');
    out.extend(word.as_bytes());
    out.push(b'"');
}

fn push_time(out: &mut Vec<u8>, utc_ns: i64) {
    let Utc { year, month, day, hours, minutes, seconds, fraction } = Utc::rounded(utc_ns, 1_000_000);
    out.push(b'"');
    for (value, digits, end) in [
        (year, 4, b'-'),
        (month, 2, b'-'),
        (day, 2, b'T'),
        (hours, 2, b':'),
        (minutes, 2, b':'),
        (seconds, 2, b'.'),
        (fraction, 6, b'Z'),
    ] {
        push_whole(out, value, digits);
        out.push(end);
    }
    out.push(b'"');
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::{
        outputs::test_estimates::{any_estimate, localized, unknown},
        types::{EstimateWarnings, Geodetic, LocalizationState},
    };

    fn line(timed: &TimedEstimate, origin: Option<Geodetic>) -> String {
        let mut out = Vec::new();
        write_line(timed, origin.map(LocalFrame::new).as_ref(), &mut out);
        String::from_utf8(out).expect("ASCII")
    }

    const ORIGIN: Geodetic = Geodetic { latitude_deg: 40.82, longitude_deg: -73.9, altitude_m: 30.0 };

    #[test]
    fn a_position_is_written_with_its_documented_decimals() {
        let timed = TimedEstimate { utc_ns: Some(1_795_348_799_999_999_600), ..localized([100.0, 200.0]) };
        assert_eq!(
            line(&timed, Some(ORIGIN)),
            "{\"sequence\":7,\"time\":\"2026-11-22T12:00:00.000000Z\",\"stamp_s\":12.345678901,\
             \"state\":\"localized\",\"e_m\":100.000,\"n_m\":200.000,\"cov_ee_m2\":0.360000,\"cov_en_m2\":-0.040000,\
             \"cov_nn_m2\":0.250000,\"std_m\":0.552,\"lat_deg\":40.821800969,\"lon_deg\":-73.898814629,\
             \"heading_rad\":1.0708,\"heading_std_rad\":0.0200,\"speed_mps\":5.000,\"single_e_m\":103.200,\
             \"single_n_m\":199.100,\"warnings\":[]}\n"
        );
    }

    #[test]
    fn what_is_not_known_is_null() {
        let mut timed = unknown();
        timed.estimate.state = LocalizationState::Lost;
        timed.estimate.warnings = EstimateWarnings { bad_frame: true, ambiguous: true, ..Default::default() };
        assert_eq!(
            line(&timed, Some(ORIGIN)),
            "{\"sequence\":0,\"time\":null,\"stamp_s\":0.000000000,\"state\":\"lost\",\"e_m\":null,\"n_m\":null,\
             \"cov_ee_m2\":null,\"cov_en_m2\":null,\"cov_nn_m2\":null,\"std_m\":null,\"lat_deg\":null,\
             \"lon_deg\":null,\"heading_rad\":null,\"heading_std_rad\":null,\"speed_mps\":null,\"single_e_m\":null,\
             \"single_n_m\":null,\"warnings\":[\"bad frame\",\"ambiguous\"]}\n"
        );
        assert!(line(&localized([1.0, 2.0]), None).contains("\"lat_deg\":null,\"lon_deg\":null,\"heading_rad\":1.0"));
    }

    #[test]
    fn headings_stay_below_a_full_turn() {
        use std::f64::consts::{FRAC_PI_2, PI};
        for (yaw_rad, expected) in
            [(FRAC_PI_2, 0), (0.0, 15_708), (PI, 47_124), (-FRAC_PI_2, 31_416), (FRAC_PI_2 + 1e-5, 0)]
        {
            assert_eq!(heading_units(yaw_rad), Some(expected), "{yaw_rad}");
        }
        assert_eq!(heading_units(FRAC_PI_2 + 6e-5), Some(62_831));
    }

    proptest! {
        #[test]
        fn any_estimate_is_one_line_of_json(timed in any_estimate()) {
            let text = line(&timed, Some(ORIGIN));
            let is_one_line = text.ends_with('\n') && text.lines().count() == 1 && text.len() <= MAX_LINE_BYTES;
            prop_assert!(is_one_line, "{}", text);
            prop_assert!(!text.contains("-0.000,") && !text.contains("-0.0000,") && !text.contains("-0.000000,"));
            let object: serde_json::Value = serde_json::from_str(&text).expect("JSON");
            let pose = timed.estimate.pose;
            prop_assert_eq!(object["e_m"].as_f64().is_some(), pose.is_some());
            if let Some(pose) = pose {
                let written_m = object["e_m"].as_f64().expect("a number");
                prop_assert!((written_m - pose.position_m[0]).abs() <= 0.000_500_001);
            }
            prop_assert_eq!(object.as_object().map(serde_json::Map::len), Some(18));
        }
    }
}
