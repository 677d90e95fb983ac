//! What the Arduino and an Xsens sensor send, for the simulator and the tests.
//!
//! The Arduino's lines are standard NMEA 0183 sentences; `docs/arduino-lines.md` describes them to whoever writes the
//! sketch, and a test decodes its examples.
//!
//! | line | rate | fields |
//! |---|---|---|
//! | `$GNGST` | 10 Hz, before its GGA | time, –, –, –, –, std north, std east, std up \[m] |
//! | `$GNGGA` | 10 Hz | time, latitude, N\|S, longitude, E\|W, quality, satellites, dilution, height, M, separation, M, –, – |
//! | `$PASHR` | 100 Hz | time, true heading, T, roll, pitch, –, std roll, std pitch, std heading, quality |
//! | `$GNZDA` | 1 Hz | time, day, month, year, 00, 00 |
//!
//! Times are those of the measurement in UTC, to the millisecond, not of the sending. Heights are above the ellipsoid, so
//! the separation is 0. 100 lines PASHR, 10 GST with GGA and one ZDA are at most [`ARDUINO_MAX_BYTES_PER_S`].

use std::io::Write;

pub use super::xbus::{AxesSense, Precision};
use super::{
    framing::{packet_sum, xor},
    sensor::NS_PER_TICK,
    time::{NS_PER_DAY, date_of_day},
    xbus::{self, SECONDS_TO_NS, Status},
};
use crate::types::Geodetic;

/// Lines a second of the Arduino.
pub const ARDUINO_ATTITUDE_HZ: u64 = 100;
pub const ARDUINO_FIX_HZ: u64 = 10;
pub const ARDUINO_DATE_HZ: u64 = 1;

/// Of the 11 520 that 115 200 baud carry; a test counts them.
pub const ARDUINO_MAX_BYTES_PER_S: u64 = 8_900;

/// What a vehicle's receiver and sensor measured at one instant, noise included.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Measurement {
    /// Since 1970; after 1970.
    pub utc_ns: i64,
    /// None: no satellites in sight.
    pub position: Option<Geodetic>,
    /// East, north, up.
    pub position_std_m: [f64; 3],
    /// East, north, up.
    pub velocity_mps: [f64; 3],
    pub roll_rad: f64,
    pub pitch_rad: f64,
    /// From east, counter-clockwise.
    pub yaw_rad: f64,
    pub yaw_std_rad: f64,
    pub satellites: u8,
    pub horizontal_dilution: f64,
}

/// Appends `$content*hh` CR LF.
pub fn write_sentence(content: &str, out: &mut Vec<u8>) {
    out.push(b'$');
    out.extend(content.bytes());
    write!(out, "*{:02X}\r\n", xor(content.as_bytes())).expect("writing to memory does not fail");
}

/// Appends `FA FF message_id len data sum`. At most 2048 bytes of data.
pub fn write_packet(message_id: u8, data: &[u8], out: &mut Vec<u8>) {
    let start = out.len();
    out.extend([0xFA, 0xFF, message_id]);
    match u8::try_from(data.len()) {
        Ok(length) if length < 0xFF => out.push(length),
        _ => {
            out.push(0xFF);
            out.extend((data.len() as u16).to_be_bytes());
        }
    }
    out.extend(data);
    out.push(packet_sum(&out[start + 1..]));
}

/// Appends the Arduino's lines of tick `tick`, counted at [`ARDUINO_ATTITUDE_HZ`].
pub fn write_arduino_tick(tick: u64, measured: &Measurement, out: &mut Vec<u8>) {
    if tick.is_multiple_of(ARDUINO_ATTITUDE_HZ / ARDUINO_DATE_HZ) {
        write_arduino_date(measured, out);
    }
    if tick.is_multiple_of(ARDUINO_ATTITUDE_HZ / ARDUINO_FIX_HZ) {
        write_arduino_fix(measured, out);
    }
    write_arduino_attitude(measured, out);
}

/// `$GNGST` and `$GNGGA`.
pub fn write_arduino_fix(measured: &Measurement, out: &mut Vec<u8>) {
    let time = time_of_day(measured.utc_ns);
    let Some(position) = measured.position else {
        write_sentence(&format!("GNGGA,{time},,,,,0,00,99.9,,M,,M,,"), out);
        return;
    };
    let [east_m, north_m, up_m] = measured.position_std_m;
    write_sentence(&format!("GNGST,{time},,,,,{north_m:.3},{east_m:.3},{up_m:.3}"), out);
    let latitude = degrees_minutes(position.latitude_deg, 2, ['N', 'S']);
    let longitude = degrees_minutes(position.longitude_deg, 3, ['E', 'W']);
    let Measurement { satellites, horizontal_dilution, .. } = measured;
    let height_m = position.altitude_m;
    write_sentence(
        &format!(
            "GNGGA,{time},{latitude},{longitude},1,{satellites:02},{horizontal_dilution:.1},{height_m:.2},M,0.0,M,,"
        ),
        out,
    );
}

/// `$PASHR`.
pub fn write_arduino_attitude(measured: &Measurement, out: &mut Vec<u8>) {
    // Thousandths, so that 359.9996 becomes 0.000 and not 360.000.
    let heading_mdeg = ((90.0 - measured.yaw_rad.to_degrees()) * 1000.0).round().rem_euclid(360_000.0);
    let content = format!(
        "PASHR,{},{:.3},T,{:.2},{:.2},,0.50,0.50,{:.3},{}",
        time_of_day(measured.utc_ns),
        heading_mdeg / 1000.0,
        measured.roll_rad.to_degrees(),
        measured.pitch_rad.to_degrees(),
        measured.yaw_std_rad.to_degrees(),
        u8::from(measured.position.is_some()),
    );
    write_sentence(&content, out);
}

/// `$GNZDA`.
pub fn write_arduino_date(measured: &Measurement, out: &mut Vec<u8>) {
    let (year, month, day) = date_of_day(rounded_ms(measured.utc_ns).div_euclid(MS_PER_DAY));
    write_sentence(&format!("GNZDA,{},{day:02},{month:02},{year:04},00,00", time_of_day(measured.utc_ns)), out);
}

const NS_PER_MS: i64 = 1_000_000;
const MS_PER_DAY: i64 = NS_PER_DAY / NS_PER_MS;

fn rounded_ms(ns: i64) -> i64 {
    ns.saturating_add(NS_PER_MS / 2).div_euclid(NS_PER_MS)
}

/// hhmmss.sss
pub fn time_of_day(utc_ns: i64) -> String {
    let ms = rounded_ms(utc_ns).rem_euclid(MS_PER_DAY);
    let (seconds, ms) = (ms / 1000, ms % 1000);
    format!("{:02}{:02}{:02}.{ms:03}", seconds / 3600, seconds / 60 % 60, seconds % 60)
}

/// ddmm.mmmmmm,N: a step is 2 mm. Counted in millionths of a minute, so that 59.9999999 minutes make a degree.
pub fn degrees_minutes(degrees: f64, degree_digits: usize, [positive, negative]: [char; 2]) -> String {
    const PER_MINUTE: u64 = 1_000_000;
    let millionths = (degrees.abs() * 60.0 * PER_MINUTE as f64).round() as u64;
    let (minutes, fraction) = (millionths / PER_MINUTE, millionths % PER_MINUTE);
    let hemisphere = if degrees < 0.0 { negative } else { positive };
    format!("{:0degree_digits$}{:02}.{fraction:06},{hemisphere}", minutes / 60, minutes % 60)
}

/// How an Xsens sensor is set up.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct XbusFormat {
    /// Of orientation and velocity.
    pub attitude: Precision,
    /// Of latitude, longitude and height.
    pub position: Precision,
    pub axes: AxesSense,
}

impl Default for XbusFormat {
    /// What we ask for in the README.
    fn default() -> Self {
        Self { attitude: Precision::F32, position: Precision::F64, axes: AxesSense::EastNorthUp }
    }
}

/// Sends MTData2 packets: 99 bytes each in the default format, 9 900 bytes a second at 100 Hz.
#[derive(Debug, Clone, Default)]
pub struct XbusSensor {
    pub format: XbusFormat,
    /// Of the next packet.
    pub counter: u16,
}

impl XbusSensor {
    /// Appends one packet. `on_for_ns` is the time since the sensor was switched on. `with_receiver` adds what its satellite
    /// receiver says, four times a second in a real one.
    pub fn write(&mut self, measured: &Measurement, on_for_ns: i64, with_receiver: bool, out: &mut Vec<u8>) {
        let XbusFormat { attitude, position, axes } = self.format;
        let mut data = Vec::with_capacity(256);
        let has_fix = measured.position.is_some();

        item(0x1010, &mut data, |data| {
            let (year, month, day) = date_of_day(measured.utc_ns.div_euclid(NS_PER_DAY));
            let since_midnight_ns = measured.utc_ns.rem_euclid(NS_PER_DAY);
            let seconds = since_midnight_ns / SECONDS_TO_NS;
            data.extend(((since_midnight_ns % SECONDS_TO_NS) as u32).to_be_bytes());
            data.extend((year as u16).to_be_bytes());
            data.extend([month, day, seconds / 3600, seconds / 60 % 60, seconds % 60, 7].map(|field| field as u8));
        });
        item(0x1020, &mut data, |data| data.extend(self.counter.to_be_bytes()));
        // The counter wraps.
        item(0x1060, &mut data, |data| data.extend(((on_for_ns / NS_PER_TICK) as u32).to_be_bytes()));
        item(0x2030 | attitude.bits() | axes.bits(), &mut data, |data| {
            let yaw_rad = axes.yaw_rad_in_frame(measured.yaw_rad);
            for angle_rad in [measured.roll_rad, measured.pitch_rad, yaw_rad] {
                attitude.write(angle_rad.to_degrees(), data);
            }
        });
        if let Some(place) = measured.position {
            item(0x5020 | position.bits(), &mut data, |data| position.write(place.altitude_m, data));
            item(0x5040 | position.bits(), &mut data, |data| {
                position.write(place.latitude_deg, data);
                position.write(place.longitude_deg, data);
            });
        }
        if with_receiver {
            item(0x7010, &mut data, |data| receiver(measured, data));
        }
        item(0xD010 | attitude.bits() | axes.bits(), &mut data, |data| {
            axes.from_enu(measured.velocity_mps).iter().for_each(|&speed_mps| attitude.write(speed_mps, data));
        });
        item(0xE020, &mut data, |data| {
            const SELF_TEST: u32 = 1;
            let (fix, mode) = if has_fix { (Status::GNSS_FIX, Status::WITH_GNSS) } else { (0, Status::COASTING) };
            let mode = mode << Status::FILTER_MODE_SHIFT;
            data.extend((SELF_TEST | Status::FILTER_VALID | fix | mode).to_be_bytes());
        });
        write_packet(xbus::MTDATA2, &data, out);
        self.counter = self.counter.wrapping_add(1);
    }
}

/// Appends identifier, size and content.
fn item(identifier: u16, data: &mut Vec<u8>, content: impl FnOnce(&mut Vec<u8>)) {
    data.extend(identifier.to_be_bytes());
    data.push(0);
    let start = data.len();
    content(data);
    data[start - 1] = (data.len() - start) as u8;
}

/// The content of item 0x7010; see [`xbus`] for its fields. What is not read is 0.
fn receiver(measured: &Measurement, data: &mut Vec<u8>) {
    let place = measured.position.unwrap_or(Geodetic { latitude_deg: 0.0, longitude_deg: 0.0, altitude_m: 0.0 });
    let [east_m, north_m, up_m] = measured.position_std_m;
    let [east_mps, north_mps, up_mps] = measured.velocity_mps;
    let (fix_type, flags) = if measured.position.is_some() { (3, 1) } else { (0, 0) };
    let thousandths = |value: f64| ((value * 1e3).round() as i32).to_be_bytes();
    data.extend([0; 20]);
    data.extend([fix_type, flags, measured.satellites, 0]);
    data.extend(((place.longitude_deg * 1e7).round() as i32).to_be_bytes());
    data.extend(((place.latitude_deg * 1e7).round() as i32).to_be_bytes());
    data.extend(thousandths(place.altitude_m));
    data.extend(thousandths(place.altitude_m));
    data.extend(thousandths(east_m.hypot(north_m)));
    data.extend(thousandths(up_m));
    for speed_mps in [north_mps, east_mps, -up_mps] {
        data.extend(thousandths(speed_mps));
    }
    data.extend([0; 2 * 4 + 3 * 4 + 7 * 2]);
}

#[cfg(test)]
mod tests {
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
        assert!(found <= ARDUINO_MAX_BYTES_PER_S, "{found} bytes");
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
}
