use proptest::prelude::*;

use super::*;
use crate::{
    devices::SerialChunk,
    gnss::{DecoderSettings, GnssDecoder},
    types::{Fix, GnssSample, Heading, LocalFrame, TimeScale, wrap_angle_rad},
};

fn decode(bytes: &[u8]) -> Vec<GnssSample> {
    let mut decoder = GnssDecoder::new(&DecoderSettings::default());
    let mut out = Vec::new();
    decoder.push(&SerialChunk { arrival_ns: 1_000_000_000, baud: 115_200, bytes: bytes.to_vec() }, &mut out);
    let framing = decoder.counters().framing;
    assert_eq!(framing.framed_bytes, bytes.len() as u64, "all of it is sound: {framing:?}");
    out
}

fn first_fix(samples: &[GnssSample]) -> Option<&Fix> {
    samples.iter().find_map(|sample| if let GnssSample::Fix(fix) = sample { Some(fix) } else { None })
}

fn first_heading(samples: &[GnssSample]) -> Option<&Heading> {
    samples.iter().find_map(|sample| if let GnssSample::Heading(heading) = sample { Some(heading) } else { None })
}

prop_compose! {
    fn measurement()(
        // 2020 to 2079, to the millisecond that lines carry.
        utc_ms in 1_577_836_800_000_i64..3_471_292_800_000,
        latitude_deg in -89.9..89.9_f64,
        longitude_deg in -180.0..180.0_f64,
        altitude_m in -400.0..2000.0_f64,
        std_m in proptest::array::uniform3(0.01..90.0_f64),
        velocity_mps in proptest::array::uniform3(-30.0..30.0_f64),
        roll_rad in -3.1..3.1_f64,
        pitch_rad in -1.5..1.5_f64,
        yaw_rad in -3.15..3.15_f64,
        yaw_std_rad in 0.001..1.0_f64,
        satellites in 4..40_u8,
    ) -> Measurement {
        Measurement {
            utc_ns: utc_ms * NS_PER_MS,
            position: Some(Geodetic { latitude_deg, longitude_deg, altitude_m }),
            position_std_m: std_m,
            velocity_mps,
            roll_rad,
            pitch_rad,
            yaw_rad,
            yaw_std_rad,
            satellites,
            horizontal_dilution: 0.9,
        }
    }
}

fn distance_m(a: Geodetic, b: Geodetic) -> f64 {
    LocalFrame::new(a).to_enu_m(b).iter().map(|d| d * d).sum::<f64>().sqrt()
}

proptest! {
    #[test]
    fn arduino_lines_come_back_as_they_were(measured in measurement()) {
        let mut bytes = Vec::new();
        write_arduino_tick(0, &measured, &mut bytes);
        let found = decode(&bytes);
        let (fix, heading) = (first_fix(&found).unwrap(), first_heading(&found).unwrap());
        // Half a step of the minutes is 1 mm, of the height 5 mm; f32 in the NMEA crate carries 2000 m to 0.1 mm.
        prop_assert!(distance_m(fix.position, measured.position.unwrap()) < 0.006);
        for (found_m, std_m) in fix.position_std_m.unwrap().iter().zip(measured.position_std_m) {
            prop_assert!((found_m - std_m).abs() < 0.000_51);
        }
        let utc = fix.sample_time.unwrap();
        prop_assert_eq!((utc.ns, utc.scale), (measured.utc_ns, TimeScale::Utc));
        prop_assert_eq!(heading.sample_time, fix.sample_time);
        // Half of a thousandth of a degree.
        prop_assert!(wrap_angle_rad(heading.yaw_rad - measured.yaw_rad).abs() < 0.000_51_f64.to_radians());
        prop_assert!((heading.yaw_std_rad.unwrap() - measured.yaw_std_rad).abs() < 0.000_51_f64.to_radians());
        prop_assert_eq!(fix.satellites, Some(measured.satellites));
    }

    #[test]
    fn xbus_packets_come_back_as_they_were(
        measured in measurement(),
        attitude in proptest::sample::select(&Precision::ALL),
        position in proptest::sample::select(&Precision::ALL[1..]),
        axes in proptest::sample::select(&AxesSense::ALL),
        on_for_s in 0..1_000_000_i64,
    ) {
        let format = XbusFormat { attitude, position, axes };
        let mut bytes = Vec::new();
        XbusSensor { format, counter: 0 }.write(&measured, on_for_s * SECONDS_TO_NS, true, &mut bytes);
        let found = decode(&bytes);
        let (fix, heading) = (first_fix(&found).unwrap(), first_heading(&found).unwrap());
        // Half a step of fixed point 12.20 is 5e-7 degrees: 5 cm along each of two axes.
        let step_m = if position == Precision::Fp1220 { 0.08 } else { 1e-4 };
        prop_assert!(distance_m(fix.position, measured.position.unwrap()) < step_m);
        prop_assert_eq!(fix.sample_time.unwrap().ns, measured.utc_ns);
        // f32 carries 180 degrees to 1e-5.
        prop_assert!(wrap_angle_rad(heading.yaw_rad - measured.yaw_rad).abs() < 1e-5_f64.to_radians());
        let [east_mps, north_mps, _] = measured.velocity_mps;
        prop_assert!((fix.speed_mps.unwrap() - east_mps.hypot(north_mps)).abs() < 1e-5);
        let course_error_rad = fix.course_rad.unwrap() - north_mps.atan2(east_mps);
        prop_assert!(wrap_angle_rad(course_error_rad).abs() * east_mps.hypot(north_mps) < 1e-5);
        let [east_m, north_m, _] = fix.position_std_m.unwrap();
        let horizontal_m = measured.position_std_m[0].hypot(measured.position_std_m[1]);
        prop_assert!((east_m.hypot(north_m) - horizontal_m).abs() < 0.001);
    }
}

/// The longest lines there are.
fn widest() -> Measurement {
    Measurement {
        utc_ns: 1_795_348_800_000_000_000,
        position: Some(Geodetic { latitude_deg: -47.5, longitude_deg: -128.5, altitude_m: 4321.1 }),
        position_std_m: [99.999; 3],
        velocity_mps: [60.0; 3],
        roll_rad: -3.1,
        pitch_rad: -1.5,
        yaw_rad: -1.0,
        yaw_std_rad: 3.0,
        satellites: 40,
        horizontal_dilution: 99.9,
    }
}

#[test]
fn a_second_of_lines_fits_the_arduinos_line() {
    let mut bytes = Vec::new();
    (0..ARDUINO_ATTITUDE_HZ).for_each(|tick| write_arduino_tick(tick, &widest(), &mut bytes));
    let found = bytes.len() as u64;
    assert_eq!(found, ARDUINO_MAX_BYTES_PER_S, "as docs/arduino-lines.md says");
    assert!(found * 10 < 115_200 * 8 / 10, "{found} bytes a second leave no margin");
    // 20 fixes a second fit as well.
    (0..10).for_each(|_| write_arduino_fix(&widest(), &mut bytes));
    assert!(bytes.len() < 11_520 * 95 / 100, "{} bytes", bytes.len());
}

#[test]
fn lines_are_no_longer_than_nmea_0183_allows() {
    let mut bytes = Vec::new();
    write_arduino_tick(0, &widest(), &mut bytes);
    for line in bytes.split_inclusive(|&byte| byte == b'\n') {
        assert!(line.len() <= 82, "{}: {} bytes", String::from_utf8_lossy(line), line.len());
    }
}

#[test]
fn hundred_packets_a_second_fit_115200_baud() {
    let mut bytes = Vec::new();
    let mut sensor = XbusSensor::default();
    (0..100).for_each(|tick| sensor.write(&widest(), tick * 10_000_000, tick % 25 == 0, &mut bytes));
    assert_eq!(bytes.len(), 100 * 99 + 4 * 97);
    assert!(bytes.len() * 10 < 115_200 * 9 / 10);
}

#[test]
fn without_satellites_there_is_no_position() {
    let measured = Measurement { position: None, ..widest() };
    let mut lines = Vec::new();
    write_arduino_tick(0, &measured, &mut lines);
    let mut packet = Vec::new();
    XbusSensor::default().write(&measured, 0, true, &mut packet);
    for bytes in [lines, packet] {
        let found = decode(&bytes);
        assert!(first_fix(&found).is_none() && first_heading(&found).is_some(), "{found:?}");
        assert!(found.iter().any(|sample| matches!(sample, GnssSample::NoFix { .. })), "{found:?}");
    }
}

/// The README's lines for whoever writes the sketch.
#[test]
fn documented_lines_decode() {
    let text = include_str!("../../docs/arduino-lines.md");
    let lines: Vec<u8> = text
        .lines()
        .filter(|line| line.starts_with('$'))
        .flat_map(|line| [line.as_bytes(), b"\r\n"].concat())
        .collect();
    let found = decode(&lines);
    let (fix, heading) = (first_fix(&found).expect("a fix"), first_heading(&found).expect("a heading"));
    assert!((fix.position.latitude_deg - 47.376_886).abs() < 1e-6, "{fix:?}");
    assert!((heading.yaw_rad.to_degrees() - 47.25).abs() < 1e-9, "{heading:?}");
    assert_eq!(fix.sample_time.map(|time| time.scale), Some(TimeScale::Utc));
    assert!(!found.iter().any(|sample| matches!(sample, GnssSample::Rejected { .. })), "{found:?}");
    assert!(found.iter().any(|sample| matches!(sample, GnssSample::NoFix { .. })));
}
