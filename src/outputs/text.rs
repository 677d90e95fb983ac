//! Numbers and times as text, written into a buffer that is used again: no allocation, and the same bytes on every
//! architecture, because nothing but a product, a rounding and whole numbers is computed.

use crate::gnss::{NS_PER_DAY, date_of_day};

/// Appends a number with so many decimals, rounded to the nearest, halves away from zero; never `-0`. Numbers of more
/// than 15 digits, infinities and NaN are not written: `false`.
pub(super) fn push_decimal(out: &mut Vec<u8>, value: f64, decimals: u32) -> bool {
    let Some(units) = rounded_units(value, decimals) else { return false };
    if units < 0 {
        out.push(b'-');
    }
    push_units(out, units.unsigned_abs(), decimals, 1);
    true
}

/// `value` counted in units of 10^−decimals.
pub(super) fn rounded_units(value: f64, decimals: u32) -> Option<i64> {
    // Up to here an f64 holds every whole number.
    const LIMIT: f64 = 1e15;
    let units = (value * 10_u64.pow(decimals) as f64).round();
    (units.abs() < LIMIT).then_some(units as i64)
}

/// Appends `units` · 10^−decimals with at least so many digits before the point.
pub(super) fn push_units(out: &mut Vec<u8>, units: u64, decimals: u32, whole_digits: usize) {
    let one = 10_u64.pow(decimals);
    push_whole(out, units / one, whole_digits);
    if decimals > 0 {
        out.push(b'.');
        push_whole(out, units % one, decimals as usize);
    }
}

/// Appends a whole number with at least so many digits.
pub(super) fn push_whole(out: &mut Vec<u8>, mut number: u64, min_digits: usize) {
    let start = out.len();
    while number > 0 || out.len() - start < min_digits {
        out.push(b'0' + (number % 10) as u8);
        number /= 10;
    }
    out[start..].reverse();
}

/// UTC, taken apart.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Utc {
    pub year: u64,
    pub month: u64,
    pub day: u64,
    pub hours: u64,
    pub minutes: u64,
    pub seconds: u64,
    /// Counted in the unit that was rounded to.
    pub fraction: u64,
}

impl Utc {
    /// Of a time since 1970, rounded to the nearest of `per_second` parts of a second.
    pub fn rounded(utc_ns: i64, per_second: i64) -> Self {
        const NS_PER_S: i64 = 1_000_000_000;
        let unit_ns = NS_PER_S / per_second;
        let units = utc_ns.saturating_add(unit_ns / 2).div_euclid(unit_ns);
        let units_per_day = NS_PER_DAY / unit_ns;
        let (year, month, day) = date_of_day(units.div_euclid(units_per_day));
        let since_midnight = units.rem_euclid(units_per_day);
        let seconds = since_midnight / per_second;
        // Nanoseconds of an i64 reach from 1677 to 2262: none of these is negative.
        let field = |value: i64| value as u64;
        Self {
            year: field(year),
            month: field(month),
            day: field(day),
            hours: field(seconds / 3600),
            minutes: field(seconds / 60 % 60),
            seconds: field(seconds % 60),
            fraction: field(since_midnight % per_second),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn decimal(value: f64, decimals: u32) -> String {
        let mut out = Vec::new();
        assert_eq!(push_decimal(&mut out, value, decimals), !out.is_empty());
        String::from_utf8(out).expect("ASCII")
    }

    #[test]
    fn numbers_are_rounded_and_zero_has_no_sign() {
        for (value, decimals, expected) in [
            (0.0, 3, "0.000"),
            (-0.0, 3, "0.000"),
            (-0.000_49, 3, "0.000"),
            (-0.000_51, 3, "-0.001"),
            (0.5, 0, "1"),
            (-2.5, 0, "-3"),
            (1.0005, 3, "1.001"),
            (999.9996, 3, "1000.000"),
            (-73.902_057_600_4, 9, "-73.902057600"),
            (123_456_789.25, 1, "123456789.3"),
            (0.05, 1, "0.1"),
            (f64::NAN, 3, ""),
            (f64::NEG_INFINITY, 3, ""),
            (1e12, 3, ""),
            (9.9e11, 3, "990000000000.000"),
        ] {
            assert_eq!(decimal(value, decimals), expected, "{value} with {decimals} decimals");
        }
    }

    #[test]
    fn what_is_written_is_within_half_a_unit() {
        let mut value = -1.0e4;
        while value < 1.0e4 {
            for decimals in 0..=9 {
                let back: f64 = decimal(value, decimals).parse().expect("a number");
                let half = 0.5 * 10_f64.powi(-(decimals as i32));
                assert!((back - value).abs() <= half + 1e-11, "{value}: {back} with {decimals} decimals");
            }
            value += 7.654_321;
        }
    }

    #[test]
    fn times_round_over_every_border() {
        let parts = |utc_ns, per_second| {
            let Utc { year, month, day, hours, minutes, seconds, fraction } = Utc::rounded(utc_ns, per_second);
            format!("{year}-{month}-{day} {hours}:{minutes}:{seconds} {fraction}")
        };
        for (utc_ns, per_second, expected) in [
            (0, 1000, "1970-1-1 0:0:0 0"),
            (499_999, 1000, "1970-1-1 0:0:0 0"),
            (500_000, 1000, "1970-1-1 0:0:0 1"),
            (-1, 1000, "1970-1-1 0:0:0 0"),
            (-1, 1_000_000_000, "1969-12-31 23:59:59 999999999"),
            (1_798_761_599_999_600_000, 1000, "2027-1-1 0:0:0 0"),
            (1_798_761_599_999_600_000, 1_000_000, "2026-12-31 23:59:59 999600"),
            (1_709_164_800_000_000_000, 1000, "2024-2-29 0:0:0 0"),
            (i64::MAX, 1000, "2262-4-11 23:47:16 854"),
        ] {
            assert_eq!(parts(utc_ns, per_second), expected);
        }
        assert_eq!(parts(i64::MIN, 1000), "1677-9-21 0:12:43 145");
    }
}
