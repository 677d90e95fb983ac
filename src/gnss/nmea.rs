//! One NMEA 0183 sentence → what it says. Combining sentences is [`super::epoch`]'s.
//!
//! | sentence | says |
//! |---|---|
//! | GGA, GNS, RMC | time, position, quality; RMC also date, speed and course |
//! | GST | standard deviations of the position |
//! | VTG | speed and course |
//! | ZDA | time and date |
//! | HDT | true heading |
//! | HDG, HDM | magnetic heading; HDG with a variation is true |
//! | PASHR | time, true heading and its standard deviation, roll, pitch |
//! | PHTRO, PRDID, PSONCMS, HEROT, … | nothing that is used |
//!
//! The first two letters (who is talking: `GP`, `GN`, `HE`, `IN`, …) make no difference. An empty field is not known.
//! Crate `nmea` reads GGA, RMC, GST, VTG, ZDA and HDT. Ours are the time (exact, and with second 60), the coordinates
//! (the crate takes 99° and 75′ for good), GNS (the crate refuses more than two mode letters), and what it does not know.

use nmea::{
    NmeaSentence, SentenceType,
    sentences::{FixType, parse_gga, parse_gst, parse_hdt, parse_rmc, parse_vtg, parse_zda, rmc::RmcStatusOfFix},
};

use crate::types::{FixQuality, Geodetic, North, wrap_angle_rad};

use super::time::TimeOfDayNs;

const MPS_PER_KNOT: f64 = 1852.0 / 3600.0;

/// What a sentence says. Times are of day \[ns], dates days since 1970.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Said {
    Position(PositionSaid),
    Deviation {
        time_ns: Option<TimeOfDayNs>,
        /// East, north, up.
        std_m: Option<[f64; 3]>,
    },
    Motion(Motion),
    Date {
        time_ns: Option<TimeOfDayNs>,
        days: Option<i64>,
    },
    Heading(HeadingSaid),
    /// Of no use here, or not known.
    Nothing,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct PositionSaid {
    pub source: &'static str,
    pub time_ns: Option<TimeOfDayNs>,
    pub days: Option<i64>,
    /// None: the receiver has no position.
    pub place: Option<(Geodetic, FixQuality)>,
    pub satellites: Option<u8>,
    pub horizontal_dilution: Option<f64>,
    pub motion: Motion,
}

#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct Motion {
    pub speed_mps: Option<f64>,
    /// From east, counter-clockwise.
    pub course_rad: Option<f64>,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct HeadingSaid {
    pub source: &'static str,
    pub time_ns: Option<TimeOfDayNs>,
    /// From east, counter-clockwise. None: not known.
    pub yaw_rad: Option<f64>,
    pub yaw_std_rad: Option<f64>,
    pub north: North,
}

const MALFORMED: &str = "sentence with a right checksum but a malformed field";
const OUT_OF_RANGE: &str = "sentence with a value out of range";

/// `content` is what stands between `$` and `*`.
pub(super) fn parse(content: &str) -> Result<Said, &'static str> {
    let Some((header, body)) = content.split_once(',') else { return Ok(Said::Nothing) };
    let fields = Fields::of(body);
    // Proprietary sentences have no talker.
    match header {
        "PASHR" => return pashr(&fields),
        _ if header.starts_with('P') || header.len() != 5 || !header.is_ascii() => return Ok(Said::Nothing),
        _ => {}
    }
    match &header[2..] {
        "GGA" => gga(body, &fields),
        "GNS" => gns(&fields),
        "RMC" => rmc(body, &fields),
        "GST" => gst(body, &fields),
        "VTG" => vtg(body),
        "ZDA" => zda(body, &fields),
        "HDT" => hdt(body),
        "HDM" => hdm(&fields),
        "HDG" => hdg(&fields),
        _ => Ok(Said::Nothing),
    }
}

/// The fields after the first comma.
struct Fields<'a> {
    items: [&'a str; MAX_FIELDS],
}

/// No sentence that is read has more.
const MAX_FIELDS: usize = 16;

impl<'a> Fields<'a> {
    fn of(body: &'a str) -> Self {
        let mut items = [""; MAX_FIELDS];
        for (item, field) in items.iter_mut().zip(body.split(',')) {
            *item = field;
        }
        Self { items }
    }

    /// Counted from 0. One that is not there is empty.
    fn get(&self, i: usize) -> &'a str {
        self.items[i]
    }

    fn number(&self, i: usize) -> Result<Option<f64>, &'static str> {
        number(self.get(i))
    }

    /// hhmmss or hhmmss.sss.
    fn time_ns(&self, i: usize) -> Result<Option<TimeOfDayNs>, &'static str> {
        let field = self.get(i);
        if field.is_empty() {
            return Ok(None);
        }
        let (whole, fraction) = field.split_once('.').unwrap_or((field, ""));
        let (true, true) = (whole.len() == 6, is_digits(whole) && is_digits(fraction)) else { return Err(MALFORMED) };
        let two = |at: usize| whole[at..at + 2].parse::<i64>().map_err(|_| MALFORMED);
        let (hours, minutes, seconds) = (two(0)?, two(2)?, two(4)?);
        // A leap second is 23:59:60; it counts like the first second of the next day, as in POSIX time.
        if hours > 23 || minutes > 59 || seconds > 60 || (seconds == 60 && (hours, minutes) != (23, 59)) {
            return Err(OUT_OF_RANGE);
        }
        let fraction_ns = fraction.bytes().chain(std::iter::repeat(b'0')).take(9);
        let fraction_ns = fraction_ns.fold(0, |ns, digit| ns * 10 + i64::from(digit - b'0'));
        Ok(Some(((hours * 60 + minutes) * 60 + seconds) * 1_000_000_000 + fraction_ns))
    }

    /// ddmm.mm,N,dddmm.mm,E from field `i` on → latitude, longitude \[degrees].
    fn coordinates(&self, i: usize) -> Result<Option<(f64, f64)>, &'static str> {
        let latitude = coordinate(self.get(i), self.get(i + 1), 2, ["N", "S"])?;
        let longitude = coordinate(self.get(i + 2), self.get(i + 3), 3, ["E", "W"])?;
        match (latitude, longitude) {
            (Some(latitude), Some(longitude)) if latitude.abs() <= 90.0 && longitude.abs() <= 180.0 => {
                Ok(Some((latitude, longitude)))
            }
            (Some(_), Some(_)) => Err(OUT_OF_RANGE),
            (None, None) => Ok(None),
            _ => Err(MALFORMED),
        }
    }
}

fn is_digits(text: &str) -> bool {
    text.bytes().all(|byte| byte.is_ascii_digit())
}

/// A plain decimal number: no exponent, `inf` or `nan`.
fn number(field: &str) -> Result<Option<f64>, &'static str> {
    if field.is_empty() {
        return Ok(None);
    }
    let magnitude = field.strip_prefix(['-', '+']).unwrap_or(field);
    if !magnitude.bytes().all(|byte| byte.is_ascii_digit() || byte == b'.') {
        return Err(MALFORMED);
    }
    field.parse().map(Some).map_err(|_| MALFORMED)
}

/// One of latitude and longitude \[degrees]; `degree_digits` come before the two digits of the minutes.
fn coordinate(
    value: &str,
    hemisphere: &str,
    degree_digits: usize,
    [positive, negative]: [&str; 2],
) -> Result<Option<f64>, &'static str> {
    if value.is_empty() {
        return Ok(None);
    }
    let whole_digits = value.split('.').next().map_or(0, str::len);
    if whole_digits != degree_digits + 2 || !value.bytes().all(|byte| byte.is_ascii_digit() || byte == b'.') {
        return Err(MALFORMED);
    }
    let (degrees, minutes) = value.split_at(degree_digits);
    let degrees: f64 = degrees.parse().map_err(|_| MALFORMED)?;
    let minutes: f64 = minutes.parse().map_err(|_| MALFORMED)?;
    if minutes >= 60.0 {
        return Err(OUT_OF_RANGE);
    }
    let magnitude = degrees + minutes / 60.0;
    match hemisphere {
        _ if hemisphere == positive => Ok(Some(magnitude)),
        _ if hemisphere == negative => Ok(Some(-magnitude)),
        _ => Err(MALFORMED),
    }
}

/// For crate `nmea`. With `without_time` the time, which is ours, is left out: the body then begins with its comma.
fn for_crate(message_id: SentenceType, body: &str, without_time: bool) -> NmeaSentence<'_> {
    let start = if without_time { body.find(',').unwrap_or(body.len()) } else { 0 };
    NmeaSentence { talker_id: "", message_id, data: &body[start..], checksum: 0 }
}

fn in_range(value: Option<f64>, range: std::ops::RangeInclusive<f64>) -> Result<Option<f64>, &'static str> {
    match value {
        Some(value) if !range.contains(&value) => Err(OUT_OF_RANGE),
        _ => Ok(value),
    }
}

fn gga(body: &str, fields: &Fields) -> Result<Said, &'static str> {
    let no_fix = PositionSaid {
        source: "GGA",
        time_ns: fields.time_ns(0)?,
        days: None,
        place: None,
        satellites: None,
        horizontal_dilution: None,
        motion: Motion::default(),
    };
    // Some receivers leave half of the fields out while they have no fix.
    if matches!(fields.get(5), "0" | "") {
        return Ok(Said::Position(no_fix));
    }
    let data = parse_gga(for_crate(SentenceType::GGA, body, true)).map_err(|_| MALFORMED)?;
    let quality = match data.fix_type.unwrap_or(FixType::Invalid) {
        FixType::Invalid => return Ok(Said::Position(no_fix)),
        FixType::Gps | FixType::Pps => FixQuality::Autonomous,
        FixType::DGps => FixQuality::Differential,
        FixType::Rtk => FixQuality::RtkFixed,
        FixType::FloatRtk => FixQuality::RtkFloat,
        FixType::Estimated => FixQuality::DeadReckoning,
        FixType::Manual | FixType::Simulation => FixQuality::Simulated,
    };
    let altitude_m = altitude_m(data.altitude.map(f64::from), data.geoid_separation.map(f64::from))?;
    let satellites = data.fix_satellites.and_then(|count| u8::try_from(count).ok());
    let horizontal_dilution = in_range(data.hdop.map(f64::from), 0.0..=1000.0)?;
    let place = place(fields.coordinates(1)?, altitude_m, quality);
    Ok(Said::Position(PositionSaid { place, satellites, horizontal_dilution, ..no_fix }))
}

/// Above the ellipsoid. Without the geoid's separation the height above sea level has to do, and without both 0: that
/// moves a position by less than 2 cm a kilometre.
fn altitude_m(above_sea_m: Option<f64>, separation_m: Option<f64>) -> Result<f64, &'static str> {
    let altitude_m = above_sea_m.unwrap_or(0.0) + separation_m.unwrap_or(0.0);
    in_range(Some(altitude_m), -1000.0..=100_000.0).map(|_| altitude_m)
}

fn place(coordinates: Option<(f64, f64)>, altitude_m: f64, quality: FixQuality) -> Option<(Geodetic, FixQuality)> {
    coordinates.map(|(latitude_deg, longitude_deg)| (Geodetic { latitude_deg, longitude_deg, altitude_m }, quality))
}

/// time, lat, N, lon, E, modes, satellites, dilution, altitude, separation, …: one mode letter a constellation.
fn gns(fields: &Fields) -> Result<Said, &'static str> {
    // Best first: of mixed modes the best is what made the position.
    const MODES: [(char, FixQuality); 8] = [
        ('R', FixQuality::RtkFixed),
        ('F', FixQuality::RtkFloat),
        ('D', FixQuality::Differential),
        ('P', FixQuality::Autonomous),
        ('A', FixQuality::Autonomous),
        ('E', FixQuality::DeadReckoning),
        ('M', FixQuality::Simulated),
        ('S', FixQuality::Simulated),
    ];
    let modes = fields.get(5);
    let quality = MODES.iter().find(|&&(letter, _)| modes.contains(letter)).map(|&(_, quality)| quality);
    let altitude_m = altitude_m(fields.number(8)?, fields.number(9)?)?;
    let coordinates = if quality.is_some() { fields.coordinates(1)? } else { None };
    Ok(Said::Position(PositionSaid {
        source: "GNS",
        time_ns: fields.time_ns(0)?,
        days: None,
        place: quality.and_then(|quality| place(coordinates, altitude_m, quality)),
        satellites: fields.get(6).parse().ok(),
        horizontal_dilution: in_range(fields.number(7)?, 0.0..=1000.0)?,
        motion: Motion::default(),
    }))
}

fn rmc(body: &str, fields: &Fields) -> Result<Said, &'static str> {
    let time_ns = fields.time_ns(0)?;
    let said = |days, place, motion| {
        let (satellites, horizontal_dilution) = (None, None);
        Said::Position(PositionSaid { source: "RMC", time_ns, days, place, satellites, horizontal_dilution, motion })
    };
    if fields.get(1) == "V" {
        return Ok(said(None, None, Motion::default()));
    }
    let data = parse_rmc(for_crate(SentenceType::RMC, body, true)).map_err(|_| MALFORMED)?;
    let quality = match (data.status_of_fix, fields.get(11)) {
        (_, "N") | (RmcStatusOfFix::Invalid, _) => return Ok(said(None, None, Motion::default())),
        (_, "R") => FixQuality::RtkFixed,
        (_, "F") => FixQuality::RtkFloat,
        (_, "E") => FixQuality::DeadReckoning,
        (_, "M" | "S") => FixQuality::Simulated,
        (RmcStatusOfFix::Differential, _) | (_, "D") => FixQuality::Differential,
        (RmcStatusOfFix::Autonomous, _) => FixQuality::Autonomous,
    };
    let days = data.fix_date.map(|date| date.signed_duration_since(Default::default()).num_days());
    let motion = motion(data.speed_over_ground.map(f64::from), data.true_course.map(f64::from))?;
    Ok(said(days, place(fields.coordinates(2)?, 0.0, quality), motion))
}

fn motion(speed_knots: Option<f64>, course_deg: Option<f64>) -> Result<Motion, &'static str> {
    let speed_mps = in_range(speed_knots.map(|knots| knots * MPS_PER_KNOT), 0.0..=1000.0)?;
    let course_rad = in_range(course_deg, 0.0..=360.0)?.map(yaw_rad_from_heading_deg);
    Ok(Motion { speed_mps, course_rad })
}

fn gst(body: &str, fields: &Fields) -> Result<Said, &'static str> {
    let data = parse_gst(for_crate(SentenceType::GST, body, true)).map_err(|_| MALFORMED)?;
    // Zero or less is what receivers send that do not know.
    let known = |std_m: Option<f32>| std_m.map(f64::from).filter(|std_m| (1e-4..=1e5).contains(std_m));
    let std_m = match (known(data.long_sd), known(data.lat_sd), known(data.alt_sd)) {
        (Some(east_m), Some(north_m), Some(up_m)) => Some([east_m, north_m, up_m]),
        _ => None,
    };
    Ok(Said::Deviation { time_ns: fields.time_ns(0)?, std_m })
}

fn vtg(body: &str) -> Result<Said, &'static str> {
    let data = parse_vtg(for_crate(SentenceType::VTG, body, false)).map_err(|_| MALFORMED)?;
    motion(data.speed_over_ground.map(f64::from), data.true_course.map(f64::from)).map(Said::Motion)
}

fn zda(body: &str, fields: &Fields) -> Result<Said, &'static str> {
    let data = parse_zda(for_crate(SentenceType::ZDA, body, true)).map_err(|_| MALFORMED)?;
    let is_stated = data.day.is_some() && data.month.is_some() && data.year.is_some();
    let days = data.utc_date().map(|date| date.signed_duration_since(Default::default()).num_days());
    if is_stated && days.is_none() {
        return Err(OUT_OF_RANGE);
    }
    Ok(Said::Date { time_ns: fields.time_ns(0)?, days })
}

/// From north, clockwise → from east, counter-clockwise, in (−π, π].
pub(super) fn yaw_rad_from_heading_deg(heading_deg: f64) -> f64 {
    wrap_angle_rad((90.0 - heading_deg).to_radians())
}

fn heading(source: &'static str, heading_deg: Option<f64>, north: North) -> Result<Said, &'static str> {
    let yaw_rad = heading_deg.map(yaw_rad_from_heading_deg);
    Ok(Said::Heading(HeadingSaid { source, time_ns: None, yaw_rad, yaw_std_rad: None, north }))
}

fn hdt(body: &str) -> Result<Said, &'static str> {
    let data = parse_hdt(for_crate(SentenceType::HDT, body, false)).map_err(|_| MALFORMED)?;
    heading("HDT", in_range(data.heading.map(f64::from), 0.0..=360.0)?, North::True)
}

/// heading, M
fn hdm(fields: &Fields) -> Result<Said, &'static str> {
    heading("HDM", in_range(fields.number(0)?, 0.0..=360.0)?, North::Magnetic)
}

/// heading, deviation, E or W, variation, E or W: true = sensor + deviation + variation, east positive.
fn hdg(fields: &Fields) -> Result<Said, &'static str> {
    let eastward = |i: usize| match (in_range(fields.number(i)?, 0.0..=180.0)?, fields.get(i + 1)) {
        (None, _) => Ok(None),
        (Some(degrees), "E") => Ok(Some(degrees)),
        (Some(degrees), "W") => Ok(Some(-degrees)),
        _ => Err(MALFORMED),
    };
    let (deviation_deg, variation_deg) = (eastward(1)?, eastward(3)?);
    let north = if variation_deg.is_some() { North::True } else { North::Magnetic };
    let correction_deg = deviation_deg.unwrap_or(0.0) + variation_deg.unwrap_or(0.0);
    let sensor_deg = in_range(fields.number(0)?, 0.0..=360.0)?;
    heading("HDG", sensor_deg.map(|sensor_deg| sensor_deg + correction_deg), north)
}

/// time, heading, T, roll, pitch, heave, roll std, pitch std, heading std, quality \[, IMU state]. Angles in degrees. The
/// quality is that of the position and says nothing about the heading.
fn pashr(fields: &Fields) -> Result<Said, &'static str> {
    // The same header carries other sentences, with a name in place of the time.
    if !fields.get(0).is_empty()
        && fields.time_ns(0).is_err()
        && !fields.get(0).starts_with(|c: char| c.is_ascii_digit())
    {
        return Ok(Said::Nothing);
    }
    let time_ns = fields.time_ns(0)?;
    let heading_deg = in_range(fields.number(1)?, 0.0..=360.0)?;
    if heading_deg.is_some() && fields.get(2) != "T" {
        return Err(MALFORMED);
    }
    in_range(fields.number(3)?, -180.0..=180.0)?;
    in_range(fields.number(4)?, -90.0..=90.0)?;
    let std_deg = in_range(fields.number(8)?, 0.0..=360.0)?.filter(|&std_deg| std_deg > 0.0);
    if !matches!(fields.get(9), "" | "0" | "1" | "2" | "3" | "4" | "5") {
        return Err(MALFORMED);
    }
    Ok(Said::Heading(HeadingSaid {
        source: "PASHR",
        time_ns,
        yaw_rad: heading_deg.map(yaw_rad_from_heading_deg),
        yaw_std_rad: std_deg.map(f64::to_radians),
        north: North::True,
    }))
}

#[cfg(test)]
#[path = "nmea_tests.rs"]
mod tests;
