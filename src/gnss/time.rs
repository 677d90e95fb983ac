//! Times of day → times that run on past midnight, with a date once it is known.

use crate::types::{NS_PER_S, SampleTime, TimeScale};

/// Since midnight \[ns]. Up to a second more than a day in a leap second.
pub(super) type TimeOfDayNs = i64;

pub(crate) const NS_PER_DAY: i64 = 86_400 * NS_PER_S as i64;

/// After a silence of this many days nothing is concluded from the last time of day.
const MAX_SILENCE_DAYS: i64 = 3650;

/// What the receiver's clock said last. Sentences state the time of day, a few also the date; the day of the others is
/// the one that brings them closest to the time that must have come since.
#[derive(Debug, Clone, Default)]
pub(super) struct DayCount {
    last: Option<Last>,
}

#[derive(Debug, Clone, Copy)]
struct Last {
    ns: i64,
    arrival_ns: u64,
    scale: TimeScale,
}

impl DayCount {
    /// The sample time of a sentence. `days`: its date, since 1970, if it states one.
    pub fn sample_time(&mut self, time_ns: TimeOfDayNs, days: Option<i64>, arrival_ns: u64) -> SampleTime {
        let (ns, scale) = match (days, self.last) {
            (Some(days), _) => (days * NS_PER_DAY + time_ns, TimeScale::Utc),
            (None, Some(last)) => match last.expected_ns(arrival_ns) {
                Some(expected_ns) => (nearest_day_ns(time_ns, expected_ns), last.scale),
                None => (time_ns, TimeScale::UtcOfDay),
            },
            (None, None) => (time_ns, TimeScale::UtcOfDay),
        };
        self.last = Some(Last { ns, arrival_ns, scale });
        SampleTime { ns, scale }
    }
}

impl Last {
    fn expected_ns(&self, arrival_ns: u64) -> Option<i64> {
        let silence_ns = i64::try_from(arrival_ns.saturating_sub(self.arrival_ns)).ok()?;
        (silence_ns < MAX_SILENCE_DAYS * NS_PER_DAY).then(|| self.ns.saturating_add(silence_ns))
    }
}

/// `time_ns` plus the whole days that bring it closest to `expected_ns`.
fn nearest_day_ns(time_ns: TimeOfDayNs, expected_ns: i64) -> i64 {
    let days = (expected_ns - time_ns + NS_PER_DAY / 2).div_euclid(NS_PER_DAY);
    days * NS_PER_DAY + time_ns
}

/// Days since 1970 of a date of the Gregorian calendar; None if there is no such date.
///
/// Howard Hinnant, “chrono-Compatible Low-Level Date Algorithms”, `days_from_civil`: years are counted from March, so
/// that the leap day is the last of its year.
pub(super) fn days_since_1970(year: i64, month: i64, day: i64) -> Option<i64> {
    const DAYS: [i64; 12] = [31, 28, 31, 30, 31, 30, 31, 31, 30, 31, 30, 31];
    let is_leap = year % 4 == 0 && (year % 100 != 0 || year % 400 == 0);
    let in_month = *DAYS.get(usize::try_from(month - 1).ok()?)? + i64::from(is_leap && month == 2);
    if !(1..=in_month).contains(&day) {
        return None;
    }
    let march_year = if month <= 2 { year - 1 } else { year };
    let era = march_year.div_euclid(400);
    let year_of_era = march_year.rem_euclid(400);
    let day_of_year = (153 * ((month + 9) % 12) + 2) / 5 + day - 1;
    let day_of_era = year_of_era * 365 + year_of_era / 4 - year_of_era / 100 + day_of_year;
    Some(era * 146_097 + day_of_era - 719_468)
}

/// Year, month, day of a day since 1970: the inverse of [`days_since_1970`], from the same source.
pub(crate) fn date_of_day(days: i64) -> (i64, i64, i64) {
    let shifted = days + 719_468;
    let era = shifted.div_euclid(146_097);
    let day_of_era = shifted.rem_euclid(146_097);
    let year_of_era = (day_of_era - day_of_era / 1460 + day_of_era / 36_524 - day_of_era / 146_096) / 365;
    let day_of_year = day_of_era - (365 * year_of_era + year_of_era / 4 - year_of_era / 100);
    let march_month = (5 * day_of_year + 2) / 153;
    let day = day_of_year - (153 * march_month + 2) / 5 + 1;
    let month = if march_month < 10 { march_month + 3 } else { march_month - 9 };
    (era * 400 + year_of_era + i64::from(month <= 2), month, day)
}

#[cfg(test)]
mod tests {
    use super::*;

    const S: i64 = 1_000_000_000;

    #[test]
    fn time_of_day_runs_on_past_midnight() {
        let mut days = DayCount::default();
        let of = |days: &mut DayCount, time_s: i64, arrival_s: u64| {
            let time = days.sample_time(time_s * S, None, arrival_s * NS_PER_S);
            assert_eq!(time.scale, TimeScale::UtcOfDay);
            time.ns / S
        };
        assert_eq!(of(&mut days, 86_399, 100), 86_399);
        assert_eq!(of(&mut days, 0, 101), 86_400);
        // A sentence that was late, then two days of silence.
        assert_eq!(of(&mut days, 86_399, 101), 86_399);
        assert_eq!(of(&mut days, 1, 102), 86_401);
        assert_eq!(of(&mut days, 1, 102 + 2 * 86_400), 3 * 86_400 + 1);
    }

    #[test]
    fn a_date_makes_it_utc_from_then_on() {
        let mut days = DayCount::default();
        assert_eq!(days.sample_time(86_399 * S, Some(20_779), 0).scale, TimeScale::Utc);
        let next = days.sample_time(S, None, 2 * NS_PER_S);
        assert_eq!(next, SampleTime { ns: 20_780 * NS_PER_DAY + S, scale: TimeScale::Utc });
    }

    #[test]
    fn leap_second_counts_like_the_second_after() {
        let mut days = DayCount::default();
        let leap = days.sample_time(86_400 * S, Some(17_166), 0);
        let after = days.sample_time(0, None, NS_PER_S);
        assert_eq!(leap.ns, after.ns);
    }

    #[test]
    fn any_arrival_is_survived() {
        let mut days = DayCount::default();
        for arrival_ns in [u64::MAX, 0, u64::MAX / 2, 1, u64::MAX] {
            days.sample_time(0, Some(20_779), arrival_ns);
            days.sample_time(86_400 * S, None, u64::MAX - arrival_ns);
        }
    }

    #[test]
    fn dates_convert_to_days_and_back() {
        // Known days: the epoch, a leap day, the day before a century that is none.
        for ((year, month, day), expected) in
            [((1970, 1, 1), 0), ((2024, 2, 29), 19_782), ((2100, 2, 28), 47_540), ((1969, 12, 31), -1)]
        {
            assert_eq!(days_since_1970(year, month, day), Some(expected));
        }
        for (year, month, day) in [(2100, 2, 29), (2026, 13, 1), (2026, 0, 1), (2026, 4, 31), (2026, 4, 0)] {
            assert_eq!(days_since_1970(year, month, day), None);
        }
        for days in -1000..60_000 {
            let (year, month, day) = date_of_day(days);
            assert_eq!(days_since_1970(year, month, day), Some(days));
        }
    }
}
