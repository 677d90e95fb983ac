use proptest::prelude::*;

use super::*;
use crate::{
    devices::SerialChunk,
    gnss::{DecoderSettings, GnssDecoder},
    outputs::test_estimates::{any_estimate, localized, unknown},
    types::{FixQuality, GnssSample, LocalizationState, North, TimeScale, wrap_angle_rad},
};

const ORIGIN: Geodetic = Geodetic { latitude_deg: 40.82, longitude_deg: -73.9, altitude_m: 30.0 };
const UTC_NS: i64 = 1_795_348_800_200_000_000;

fn sentences(origin: Geodetic, timed: &TimedEstimate, kinds: &[Sentence]) -> String {
    let mut out = Vec::new();
    NmeaWriter::new(origin, kinds).write(timed, &mut out);
    String::from_utf8(out).expect("ASCII")
}

/// What our own decoder makes of it.
fn decoded(text: &str) -> Vec<GnssSample> {
    let mut decoder = GnssDecoder::new(&DecoderSettings::default());
    let mut samples = Vec::new();
    decoder.push(&SerialChunk { arrival_ns: 1_000_000_000, baud: 0, bytes: text.into() }, &mut samples);
    assert_eq!(decoder.counters().lost(), 0, "{text} {:?}", decoder.counters());
    samples
}

#[test]
fn a_localized_estimate_is_a_dead_reckoning_fix_without_satellites() {
    let timed = TimedEstimate { utc_ns: Some(UTC_NS), ..localized([100.0, 200.0]) };
    // The variances along the ellipse's axes are 0.305 m² ± 0.068 m²; the sums were made by another program.
    let text = sentences(ORIGIN, &timed, &Sentence::ALL);
    assert_eq!(
        text,
        "$INGST,120000.200,,0.611,0.487,108.0,0.500,0.600,*71\r\n\
         $INGGA,120000.200,4049.308058,N,07353.928878,W,6,00,,30.0,M,0.0,M,,*7C\r\n\
         $PGRME,0.65,M,,M,,M*1D\r\n\
         $INRMC,120000.200,A,4049.308058,N,07353.928878,W,9.72,36.9,221126,,,E*64\r\n\
         $INHDT,61.35,T*24\r\n"
    );
    let documented = include_str!("../../docs/outputs.md");
    assert!(documented.contains(&text.replace("\r\n", "\n")), "as documented");
}

#[test]
fn no_position_is_sent_before_localized() {
    let mut timed = TimedEstimate { utc_ns: Some(UTC_NS), ..unknown() };
    let expected =
        "$INGGA,120000.200,,,,,0,00,,,M,,M,,*69\r\n$INRMC,120000.200,V,,,,,,,221126,,,N*58\r\n$INHDT,,T*0B\r\n";
    for state in [LocalizationState::Unknown, LocalizationState::Candidate, LocalizationState::Lost] {
        timed.estimate.state = state;
        assert_eq!(sentences(ORIGIN, &timed, &Sentence::ALL), expected);
    }
    timed.utc_ns = None;
    assert_eq!(sentences(ORIGIN, &timed, &Sentence::ALL), "$INRMC,,V,,,,,,,,,,N*43\r\n$INHDT,,T*0B\r\n");
    let nowhere = TimedEstimate { utc_ns: Some(UTC_NS), ..localized([f64::NAN, 0.0]) };
    assert_eq!(sentences(ORIGIN, &nowhere, &Sentence::ALL), expected);
}

#[test]
fn without_utc_the_position_comes_without_a_time() {
    let timed = localized([100.0, 200.0]);
    let text = sentences(ORIGIN, &timed, &Sentence::ALL);
    let headers: Vec<_> = text.lines().map(|line| &line[..7]).collect();
    assert_eq!(headers, ["$PGRME,", "$INRMC,", "$INHDT,"]);
    assert!(text.contains("$INRMC,,A,4049.308058,N,07353.928878,W,9.72,36.9,,,,E*"), "{text}");
    let alone = sentences(ORIGIN, &timed, &[Sentence::Gga]);
    assert!(alone.starts_with("$INGGA,,4049.308058,N,"), "{alone}");
}

#[test]
fn borders_of_the_coordinates_are_written_as_such() {
    let field = |degrees, digits, signs| {
        let mut out = Vec::new();
        Line { out: &mut out, start: 0 }.coordinate(degrees, digits, signs);
        String::from_utf8(out).expect("ASCII")
    };
    let (latitude, longitude) = (|degrees| field(degrees, 2, ["N", "S"]), |degrees| field(degrees, 3, ["E", "W"]));
    for (found, expected) in [
        (latitude(0.0), ",0000.000000,N"),
        (latitude(-1e-12), ",0000.000000,N"),
        (latitude(-1e-8), ",0000.000001,S"),
        (latitude(8.999_999_999_9), ",0900.000000,N"),
        (latitude(-90.0), ",9000.000000,S"),
        (longitude(179.999_999_999_9), ",18000.000000,E"),
        (longitude(-180.0), ",18000.000000,W"),
        (longitude(-9.5), ",00930.000000,W"),
        (longitude(0.016_666_666_66), ",00001.000000,E"),
    ] {
        assert_eq!(found, expected);
    }
}

#[test]
fn angles_stay_below_a_full_turn() {
    let field = |angle_deg, turn_deg| {
        let mut out = Vec::new();
        Line { out: &mut out, start: 0 }.degrees(angle_deg, turn_deg, 1);
        String::from_utf8(out).expect("ASCII")
    };
    for (angle_deg, turn_deg, expected) in [
        (359.94, 360.0, ",359.9"),
        (359.96, 360.0, ",0.0"),
        (-0.01, 360.0, ",0.0"),
        (-90.0, 360.0, ",270.0"),
        (179.97, 180.0, ",0.0"),
        (180.0, 180.0, ",0.0"),
        (f64::NAN, 360.0, ","),
    ] {
        assert_eq!(field(angle_deg, turn_deg), expected, "{angle_deg}");
    }
}

#[test]
fn half_of_all_positions_are_within_the_stated_radius() {
    // σ₂ / σ₁ → radius / σ₁, from the density integrated in Python: ∫ exp(−x²/2) erf(√(r² − x²) / (σ₂ √2)) dx.
    for (ratio, radius) in [(0.0, 0.6745), (0.1, 0.6820), (0.25, 0.7254), (0.5, 0.8704), (1.0, 1.1774)] {
        let stated = Ellipse { major_m: 1.0, minor_m: ratio, orientation_deg: 0.0 }.half_within_m();
        assert!((stated / radius - 1.0).abs() < 0.03, "{ratio}: {stated} instead of {radius}");
    }
}

#[test]
fn crate_nmea_reads_the_same() {
    use nmea::{ParseResult, parse_str, sentences::FixType};
    let timed = TimedEstimate { utc_ns: Some(UTC_NS), ..localized([100.0, 200.0]) };
    let text = sentences(ORIGIN, &timed, &[Sentence::Gst, Sentence::Gga, Sentence::Rmc, Sentence::Hdt]);
    let place = LocalFrame::new(ORIGIN).plane_to_geodetic([100.0, 200.0]);
    let is_near = |found: Option<f64>, expected: f64| found.is_some_and(|found| (found - expected).abs() < 1e-8);
    for line in text.lines() {
        match parse_str(line).expect("a sentence") {
            ParseResult::GST(gst) => {
                assert_eq!((gst.lat_sd, gst.long_sd, gst.alt_sd), (Some(0.5), Some(0.6), None));
                assert_eq!((gst.ellipse_semi_major_sd, gst.ellipse_semi_minor_sd), (Some(0.611), Some(0.487)));
            }
            ParseResult::GGA(gga) => {
                assert_eq!((gga.fix_type, gga.fix_satellites, gga.hdop), (Some(FixType::Estimated), Some(0), None));
                assert!(is_near(gga.latitude, place.latitude_deg) && is_near(gga.longitude, place.longitude_deg));
            }
            ParseResult::RMC(rmc) => {
                assert!(is_near(rmc.lat, place.latitude_deg) && is_near(rmc.lon, place.longitude_deg));
                assert_eq!((rmc.speed_over_ground, rmc.true_course), (Some(9.72), Some(36.9)));
                assert_eq!(rmc.fix_date.map(|date| date.to_string()).as_deref(), Some("2026-11-22"));
            }
            ParseResult::HDT(hdt) => assert_eq!(hdt.heading, Some(61.35)),
            other => panic!("{other:?}"),
        }
    }
}

proptest! {
    #[test]
    fn any_estimate_is_read_back_by_our_decoder(
        timed in any_estimate(),
        latitude_deg in -89.9..89.9_f64,
        longitude_deg in -180.0..=180.0_f64,
        kinds in proptest::sample::subsequence(Sentence::ALL.to_vec(), 1..=5),
    ) {
        // A position near 0°, 0° is what receivers say that do not know, and refused as such.
        prop_assume!(latitude_deg.abs() > 1.0);
        let origin = Geodetic { latitude_deg, longitude_deg, altitude_m: 412.3 };
        let text = sentences(origin, &timed, &kinds);
        for line in text.split_inclusive('\n') {
            prop_assert!(line.len() <= MAX_SENTENCE_BYTES && line.ends_with("\r\n"), "{line}");
        }
        let samples = decoded(&text);
        let fix = samples.iter().find_map(|sample| match sample {
            GnssSample::Fix(fix) => Some(fix),
            _ => None,
        });
        let says_position = kinds.contains(&Sentence::Gga) || kinds.contains(&Sentence::Rmc);
        prop_assert_eq!(fix.is_some(), timed.estimate.pose.is_some() && says_position, "{}", text);
        if let (Some(fix), Some(pose)) = (fix, timed.estimate.pose) {
            prop_assert_eq!(fix.quality, FixQuality::DeadReckoning);
            prop_assert!(fix.satellites.unwrap_or(0) == 0 && fix.horizontal_dilution.is_none());
            let place = LocalFrame::new(origin).plane_to_geodetic(pose.position_m);
            // Half a millionth of a minute, and the last digits of an f64.
            let apart_deg = |a: f64, b: f64| wrap_angle_rad((a - b).to_radians()).to_degrees().abs();
            prop_assert!((fix.position.latitude_deg - place.latitude_deg).abs() < 0.5e-6 / 60.0 + 1e-12, "{text}");
            prop_assert!(apart_deg(fix.position.longitude_deg, place.longitude_deg) < 0.5e-6 / 60.0 + 1e-12, "{text}");
            if let (Some(utc_ns), Some(time)) = (timed.utc_ns, fix.sample_time) {
                const DAY_NS: i64 = 86_400_000_000_000;
                let of_day = time.scale == TimeScale::UtcOfDay;
                let apart_ns = if of_day { (time.ns - utc_ns).rem_euclid(DAY_NS) } else { time.ns - utc_ns };
                prop_assert!(apart_ns.abs().min((apart_ns - DAY_NS).abs()) <= 500_000, "{text} {time:?}");
            }
        }
        let heading = samples.iter().find_map(|sample| match sample {
            GnssSample::Heading(heading) => Some(heading),
            _ => None,
        });
        let expected = timed.estimate.pose.and_then(|pose| pose.heading).filter(|_| kinds.contains(&Sentence::Hdt));
        prop_assert_eq!(heading.is_some(), expected.is_some());
        if let (Some(heading), Some(expected)) = (heading, expected) {
            prop_assert_eq!(heading.north, North::True);
            // Half of 0.01 degrees, read back as f32.
            prop_assert!(wrap_angle_rad(heading.yaw_rad - expected.yaw_rad).abs() < 0.005_1_f64.to_radians());
        }
    }
}
