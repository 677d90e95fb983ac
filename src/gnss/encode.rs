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
pub const ARDUINO_MAX_BYTES_PER_S: u64 = 8_099;

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

/// Sends MTData2 packets: 99 bytes each in the default format, 9900 bytes a second at 100 Hz.
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
            axes.of_enu(measured.velocity_mps).iter().for_each(|&speed_mps| attitude.write(speed_mps, data));
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
    data.extend(thousandths(libm::hypot(east_m, north_m)));
    data.extend(thousandths(up_m));
    for speed_mps in [north_mps, east_mps, -up_mps] {
        data.extend(thousandths(speed_mps));
    }
    data.extend([0; 2 * 4 + 3 * 4 + 7 * 2]);
}

#[cfg(test)]
#[path = "encode_tests.rs"]
mod tests;
