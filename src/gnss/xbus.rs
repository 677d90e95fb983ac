//! One MTData2 packet → what it says.
//!
//! The data of an MTData2 packet are items: identifier (u16), size in bytes (u8), content, all big-endian (Xsens, “MT Low
//! Level Communication Protocol”). The identifier's low four bits say how numbers are written and in which frame:
//!
//! ```text
//! bits 1-0: 0 f32, 1 fixed point 12.20, 2 fixed point 16.32, 3 f64
//! bits 3-2: 0 east-north-up, 1 north-east-down, 2 north-west-up      orientation and velocity only
//! ```
//!
//! | identifier | content |
//! |---|---|
//! | 0x1010 | UTC: ns, year, month, day, hour, minute, second, flags (bit 2: valid) |
//! | 0x1020 | packet counter, u16, wraps |
//! | 0x1060 | sample time fine: u32, 10 kHz, wraps after five days |
//! | 0x201x | quaternion w, x, y, z |
//! | 0x203x | roll, pitch, yaw \[degrees] |
//! | 0x502x | height above the ellipsoid \[m] |
//! | 0x504x | latitude, longitude \[degrees] |
//! | 0x7010 | what the satellite receiver said by itself (u-blox NAV-PVT, big-endian) |
//! | 0xD01x | velocity x, y, z \[m/s] |
//! | 0xE020 | status word |
//!
//! All others are passed over, also those of the old MTi-G-700 firmware (0x88xx).

use std::f64::consts::FRAC_PI_2;

use crate::types::wrap_angle_rad;

use super::time::{NS_PER_DAY, days_since_1970};

/// The message that carries measurements.
pub(super) const MTDATA2: u8 = 0x36;

pub(super) const SECONDS_TO_NS: i64 = 1_000_000_000;

const BAD_ITEM: &str = "MTData2 packet with an item that does not fit its size";
const COARSE_POSITION: &str = "latitude and longitude come as 32-bit floats, in steps of up to 1 m: set item 0x5043 (64-bit \
                               floats) or 0x5042 (fp16.32) in place of 0x5040 in the sensor's output configuration";

/// How a number is written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Precision {
    F32,
    Fp1220,
    Fp1632,
    F64,
}

impl Precision {
    pub const ALL: [Self; 4] = [Self::F32, Self::Fp1220, Self::Fp1632, Self::F64];

    fn of(identifier: u16) -> Self {
        Self::ALL[usize::from(identifier & 3)]
    }

    pub(super) fn bits(self) -> u16 {
        self as u16
    }

    /// Appends a number.
    pub(super) fn write(self, number: f64, out: &mut Vec<u8>) {
        match self {
            Self::F32 => out.extend((number as f32).to_be_bytes()),
            Self::Fp1220 => out.extend(((number * f64::from(1 << 20)).round() as i32).to_be_bytes()),
            Self::Fp1632 => {
                let fixed = (number * 4_294_967_296.0).round() as i64;
                out.extend((fixed as u32).to_be_bytes());
                out.extend(((fixed >> 32) as i16).to_be_bytes());
            }
            Self::F64 => out.extend(number.to_be_bytes()),
        }
    }
}

/// Which way the axes of a vector or of an orientation point.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum AxesSense {
    EastNorthUp,
    NorthEastDown,
    NorthWestUp,
}

impl AxesSense {
    pub const ALL: [Self; 3] = [Self::EastNorthUp, Self::NorthEastDown, Self::NorthWestUp];

    fn of(identifier: u16) -> Option<Self> {
        Self::ALL.get(usize::from((identifier >> 2) & 3)).copied()
    }

    pub(super) fn bits(self) -> u16 {
        (self as u16) << 2
    }

    /// From east, counter-clockwise, in (−π, π]; `yaw_rad` is about this frame's own third axis.
    fn yaw_rad_from_east(self, yaw_rad: f64) -> f64 {
        wrap_angle_rad(match self {
            Self::EastNorthUp => yaw_rad,
            Self::NorthEastDown => FRAC_PI_2 - yaw_rad,
            Self::NorthWestUp => FRAC_PI_2 + yaw_rad,
        })
    }

    /// The yaw in this frame \[rad] of one from east, counter-clockwise.
    pub(super) fn yaw_rad_in_frame(self, yaw_rad: f64) -> f64 {
        wrap_angle_rad(match self {
            Self::EastNorthUp => yaw_rad,
            Self::NorthEastDown => FRAC_PI_2 - yaw_rad,
            Self::NorthWestUp => yaw_rad - FRAC_PI_2,
        })
    }

    /// A vector in east, north, up in this frame.
    pub(super) fn of_enu(self, [east, north, up]: [f64; 3]) -> [f64; 3] {
        match self {
            Self::EastNorthUp => [east, north, up],
            Self::NorthEastDown => [north, east, -up],
            Self::NorthWestUp => [north, -east, up],
        }
    }

    fn east_north(self, [x, y, _]: [f64; 3]) -> [f64; 2] {
        match self {
            Self::EastNorthUp => [x, y],
            Self::NorthEastDown => [y, x],
            Self::NorthWestUp => [-y, x],
        }
    }
}

/// What one packet says; what it does not say is None.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct PacketSaid {
    /// Since 1970 \[ns], and whether the sensor holds it for valid.
    pub utc: Option<(i64, bool)>,
    pub counter: Option<u16>,
    pub sample_time_fine: Option<u32>,
    /// From east, counter-clockwise.
    pub yaw_rad: Option<f64>,
    /// Latitude, longitude \[degrees].
    pub coordinates: Option<(f64, f64)>,
    pub altitude_m: Option<f64>,
    pub velocity_east_north_mps: Option<[f64; 2]>,
    pub status: Option<Status>,
    pub receiver: Option<ReceiverSaid>,
    /// An item that was refused although the others are sound.
    pub refused: Option<&'static str>,
}

/// The status word.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Status(pub u32);

impl Status {
    pub const FILTER_VALID: u32 = 1 << 1;
    pub const GNSS_FIX: u32 = 1 << 2;
    pub const FILTER_MODE_SHIFT: u32 = 23;
    /// Filter modes: without satellites for up to 45 s, and with them. 0 is without them for longer.
    pub const COASTING: u32 = 1;
    pub const WITH_GNSS: u32 = 3;

    pub fn filter_is_valid(self) -> bool {
        self.0 & Self::FILTER_VALID != 0
    }

    pub fn has_gnss_fix(self) -> bool {
        self.0 & Self::GNSS_FIX != 0
    }

    pub fn filter_mode(self) -> u32 {
        (self.0 >> Self::FILTER_MODE_SHIFT) & 7
    }
}

/// What the satellite receiver in the sensor said: item 0x7010.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct ReceiverSaid {
    /// 0 none, 1 dead reckoning, 2 flat, 3 full, 4 with dead reckoning, 5 time only.
    pub fix_type: u8,
    /// Bit 0: the fix is good. Bit 1: differential. Bits 7-6: carrier phase, 1 float, 2 fixed.
    pub flags: u8,
    pub satellites: u8,
    pub coordinates: (f64, f64),
    pub altitude_m: f64,
    pub horizontal_std_m: f64,
    pub vertical_std_m: f64,
    pub velocity_east_north_mps: [f64; 2],
}

/// Reads a big-endian buffer from the front.
struct Reader<'a> {
    rest: &'a [u8],
}

impl<'a> Reader<'a> {
    fn take(&mut self, count: usize) -> Result<&'a [u8], &'static str> {
        let (taken, rest) = self.rest.split_at_checked(count).ok_or(BAD_ITEM)?;
        self.rest = rest;
        Ok(taken)
    }

    fn array<const N: usize>(&mut self) -> Result<[u8; N], &'static str> {
        self.take(N)?.try_into().map_err(|_| BAD_ITEM)
    }

    fn u8(&mut self) -> Result<u8, &'static str> {
        self.array().map(u8::from_be_bytes)
    }

    fn u16(&mut self) -> Result<u16, &'static str> {
        self.array().map(u16::from_be_bytes)
    }

    fn u32(&mut self) -> Result<u32, &'static str> {
        self.array().map(u32::from_be_bytes)
    }

    fn i32(&mut self) -> Result<i32, &'static str> {
        self.array().map(i32::from_be_bytes)
    }

    fn number(&mut self, precision: Precision) -> Result<f64, &'static str> {
        Ok(match precision {
            Precision::F32 => f64::from(f32::from_be_bytes(self.array()?)),
            Precision::Fp1220 => f64::from(self.i32()?) / f64::from(1 << 20),
            // The fraction comes before the integer part.
            Precision::Fp1632 => {
                let fraction = f64::from(self.u32()?) / 4_294_967_296.0;
                f64::from(i16::from_be_bytes(self.array()?)) + fraction
            }
            Precision::F64 => f64::from_be_bytes(self.array()?),
        })
    }

    fn numbers<const N: usize>(&mut self, precision: Precision) -> Result<[f64; N], &'static str> {
        let mut numbers = [0.0; N];
        for number in &mut numbers {
            *number = self.number(precision)?;
        }
        Ok(numbers)
    }
}

/// `data`: that of an MTData2 packet.
pub(super) fn parse(data: &[u8]) -> Result<PacketSaid, &'static str> {
    let mut said = PacketSaid::default();
    let mut yaw_of_quaternion_rad = None;
    let mut packet = Reader { rest: data };
    while !packet.rest.is_empty() {
        let identifier = packet.u16()?;
        let size = packet.u8()?;
        let mut item = Reader { rest: packet.take(size.into())? };
        let precision = Precision::of(identifier);
        match identifier & 0xFFF0 {
            0x1010 => said.utc = utc(&mut item)?,
            0x1020 => said.counter = Some(item.u16()?),
            0x1060 => said.sample_time_fine = Some(item.u32()?),
            0x2010 => {
                let sense = AxesSense::of(identifier).ok_or(BAD_ITEM)?;
                let quaternion = item.numbers(precision)?;
                match yaw_of_quaternion(quaternion) {
                    Some(yaw_rad) => yaw_of_quaternion_rad = Some(sense.yaw_rad_from_east(yaw_rad)),
                    None => said.refused = Some("orientation quaternion is not of length 1"),
                }
            }
            0x2030 => {
                let sense = AxesSense::of(identifier).ok_or(BAD_ITEM)?;
                let [_, _, yaw_deg] = item.numbers(precision)?;
                if yaw_deg.abs() <= 360.0 {
                    said.yaw_rad = Some(sense.yaw_rad_from_east(yaw_deg.to_radians()));
                } else {
                    said.refused = Some("yaw is not a number or outside -360 to 360 degrees");
                }
            }
            0x5020 => said.altitude_m = Some(item.number(precision)?),
            0x5040 => {
                let [latitude_deg, longitude_deg] = item.numbers(precision)?;
                if precision == Precision::F32 {
                    said.refused = Some(COARSE_POSITION);
                } else {
                    said.coordinates = Some((latitude_deg, longitude_deg));
                }
            }
            0x7010 => said.receiver = Some(receiver(&mut item)?),
            0xD010 => {
                let sense = AxesSense::of(identifier).ok_or(BAD_ITEM)?;
                let velocity = sense.east_north(item.numbers(precision)?);
                said.velocity_east_north_mps = Some(velocity).filter(|v| v.iter().all(|v| v.is_finite()));
            }
            0xE020 => said.status = Some(Status(item.u32()?)),
            _ => continue,
        }
        if !item.rest.is_empty() {
            return Err(BAD_ITEM);
        }
    }
    said.yaw_rad = said.yaw_rad.or(yaw_of_quaternion_rad);
    Ok(said)
}

/// None if the fields are no date and time.
fn utc(item: &mut Reader) -> Result<Option<(i64, bool)>, &'static str> {
    let ns = i64::from(item.u32()?);
    let year = i64::from(item.u16()?);
    let [month, day, hour, minute, second, flags] = item.array()?.map(i64::from);
    let is_time = ns < SECONDS_TO_NS && hour < 24 && minute < 60 && second <= 60;
    let days = days_since_1970(year, month, day).filter(|_| is_time && (1970..2200).contains(&year));
    let since_midnight_ns = ((hour * 60 + minute) * 60 + second) * SECONDS_TO_NS + ns;
    Ok(days.map(|days| (days * NS_PER_DAY + since_midnight_ns, flags & 4 != 0)))
}

/// About the third axis \[rad]; Diebel, “Representing attitude” (2006), eq. 290, last component.
fn yaw_of_quaternion([w, x, y, z]: [f64; 4]) -> Option<f64> {
    let length_squared = w * w + x * x + y * y + z * z;
    let is_unit = (0.98..=1.02).contains(&length_squared);
    is_unit.then(|| libm::atan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z))
}

/// `!IHBBBBBBIiBBBBiiiiIIiiiiiIIiHHHHHHH` in the words of Python's `struct`.
fn receiver(item: &mut Reader) -> Result<ReceiverSaid, &'static str> {
    let millimetres = |value: i32| f64::from(value) * 1e-3;
    // Time of week, date, time, what of it is valid, its accuracy, nanoseconds.
    item.take(4 + 2 + 6 + 4 + 4)?;
    let [fix_type, flags, satellites, _] = item.array()?;
    let longitude_deg = f64::from(item.i32()?) * 1e-7;
    let latitude_deg = f64::from(item.i32()?) * 1e-7;
    let altitude_m = millimetres(item.i32()?);
    item.i32()?; // above sea level
    let horizontal_std_m = f64::from(item.u32()?) * 1e-3;
    let vertical_std_m = f64::from(item.u32()?) * 1e-3;
    let (north_mps, east_mps) = (millimetres(item.i32()?), millimetres(item.i32()?));
    // Velocity down, speed, its direction; accuracies of speed and heading, heading of the vehicle; dilutions.
    item.take(3 * 4 + 3 * 4 + 7 * 2)?;
    Ok(ReceiverSaid {
        fix_type,
        flags,
        satellites,
        coordinates: (latitude_deg, longitude_deg),
        altitude_m,
        horizontal_std_m,
        vertical_std_m,
        velocity_east_north_mps: [east_mps, north_mps],
    })
}
