//! What a receiver can say although it cannot be.
//!
//! A receiver that loses sight of the sky does not always say so: it reports positions streets away, the middle of the
//! Gulf of Guinea, or the year 1999, all with right checksums. A position that could only be reached faster than the
//! vehicle drives is refused. When positions stay there, consistent with each other, the earlier ones were wrong or the
//! way to here was not seen (a ferry, a tunnel), and the new place is taken.

use serde::{Deserialize, Serialize};

use crate::types::{Fix, LocalFrame, NS_PER_S, SampleTime};

/// This much of a distance is noise, whatever the time between two positions \[m\]: a receiver among houses wanders by
/// several metres from one second to the next.
const NOISE_ALLOWANCE_M: f64 = 10.0;

/// A new place is believed after this many positions in a row that agree with each other …
const CONSISTENT_FIXES: u32 = 5;
/// … over at least this time: at 100 Hz five positions are one outlier.
const CONSISTENT_NS: u64 = NS_PER_S;

/// Sample times count as the time between two positions unless they run ahead of the arrival times by more than this:
/// then the receiver's clock was set.
const CLOCK_SET_NS: u64 = 5 * NS_PER_S;

/// Closer to 0°, 0° than this \[degrees\] there is only open sea: it means “not known” in many receivers.
const NULL_ISLAND_DEG: f64 = 1e-4;

/// Days since 1970 of 2020-01-01 and of 2080-01-01. A receiver that has lost its week count is 1024 weeks behind, and
/// one that has just been switched on may say 1980 or 2000.
const FIRST_DAY: i64 = 18_262;
const LAST_DAY: i64 = 40_177;

#[derive(Debug, Clone, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct Settings {
    /// Faster than this the vehicle never goes.
    #[serde(default = "default_max_speed_mps")]
    pub max_speed_mps: f64,
}

impl Default for Settings {
    fn default() -> Self {
        Self { max_speed_mps: default_max_speed_mps() }
    }
}

fn default_max_speed_mps() -> f64 {
    60.0
}

impl Settings {
    pub fn check(&self) -> Result<(), String> {
        if (1.0..=1000.0).contains(&self.max_speed_mps) {
            return Ok(());
        }
        Err(format!("max_speed_mps is {}, expected 1 to 1000 m/s", self.max_speed_mps))
    }
}

/// `days` since 1970 may be the date of a drive.
pub(super) fn date_is_plausible(days: i64) -> bool {
    (FIRST_DAY..LAST_DAY).contains(&days)
}

#[derive(Debug, Clone, Copy)]
struct Place {
    arrival_ns: u64,
    sample_time: Option<SampleTime>,
    position: crate::types::Geodetic,
}

/// Positions that disagree with the last good one, but agree with each other.
#[derive(Debug, Clone, Copy)]
struct Elsewhere {
    latest: Place,
    first_arrival_ns: u64,
    fixes: u32,
}

/// Remembers where the vehicle was.
#[derive(Debug, Clone)]
pub(super) struct Plausibility {
    max_speed_mps: f64,
    last_good: Option<Place>,
    elsewhere: Option<Elsewhere>,
}

impl Plausibility {
    pub fn new(settings: &Settings) -> Self {
        Self { max_speed_mps: settings.max_speed_mps, last_good: None, elsewhere: None }
    }

    /// The reason why a position cannot be believed.
    pub fn check(&mut self, fix: &Fix) -> Result<(), &'static str> {
        let position = fix.position;
        if !position.is_plausible() {
            return Err("position is outside the range of coordinates");
        }
        if position.latitude_deg.abs() < NULL_ISLAND_DEG && position.longitude_deg.abs() < NULL_ISLAND_DEG {
            return Err("position is 0 degrees north, 0 degrees east");
        }
        if fix.speed_mps.is_some_and(|speed_mps| speed_mps > self.max_speed_mps) {
            return Err("stated speed is above max_speed_mps");
        }
        let here = Place { arrival_ns: fix.arrival_ns, sample_time: fix.sample_time, position };
        let is_reachable = self.last_good.is_none_or(|last_good| self.is_reachable(&last_good, &here));
        if is_reachable || self.is_settled(here) {
            self.last_good = Some(here);
            self.elsewhere = None;
            return Ok(());
        }
        Err("position jumped: reaching it needs more than max_speed_mps")
    }

    fn is_reachable(&self, from: &Place, to: &Place) -> bool {
        let [east_m, north_m, _] = LocalFrame::new(from.position).to_enu_m(to.position);
        let elapsed_s = elapsed_ns(from, to) as f64 / NS_PER_S as f64;
        libm::hypot(east_m, north_m) <= NOISE_ALLOWANCE_M + self.max_speed_mps * elapsed_s
    }

    /// Counts positions at a new place; `true` once there are enough.
    fn is_settled(&mut self, here: Place) -> bool {
        let (fixes, first_arrival_ns) = match self.elsewhere {
            Some(elsewhere) if self.is_reachable(&elsewhere.latest, &here) => {
                (elsewhere.fixes + 1, elsewhere.first_arrival_ns)
            }
            _ => (1, here.arrival_ns),
        };
        self.elsewhere = Some(Elsewhere { latest: here, first_arrival_ns, fixes });
        fixes >= CONSISTENT_FIXES && here.arrival_ns.saturating_sub(first_arrival_ns) >= CONSISTENT_NS
    }
}

fn elapsed_ns(from: &Place, to: &Place) -> u64 {
    let by_arrival = to.arrival_ns.saturating_sub(from.arrival_ns);
    let by_receiver = match (from.sample_time, to.sample_time) {
        (Some(a), Some(b)) if a.scale == b.scale => b.ns.checked_sub(a.ns).and_then(|ns| u64::try_from(ns).ok()),
        _ => None,
    };
    by_receiver.filter(|&ns| ns <= by_arrival.saturating_add(CLOCK_SET_NS)).unwrap_or(by_arrival)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::types::{FixQuality, Geodetic, TimeScale};

    const ORIGIN: Geodetic = Geodetic { latitude_deg: 47.0, longitude_deg: 8.0, altitude_m: 400.0 };

    fn fix(east_m: f64, at_s: f64) -> Fix {
        let ns = (at_s * 1e9) as u64;
        Fix {
            arrival_ns: ns,
            sample_time: Some(SampleTime { ns: ns as i64, scale: TimeScale::Utc }),
            position: LocalFrame::new(ORIGIN).to_geodetic([east_m, 0.0, 0.0]),
            position_std_m: None,
            quality: FixQuality::Autonomous,
            satellites: None,
            horizontal_dilution: None,
            speed_mps: None,
            course_rad: None,
            source: "GGA",
        }
    }

    fn accepted(fixes: &[(f64, f64)]) -> Vec<bool> {
        let mut plausibility = Plausibility::new(&Settings::default());
        fixes.iter().map(|&(east_m, at_s)| plausibility.check(&fix(east_m, at_s)).is_ok()).collect()
    }

    #[test]
    fn one_outlier_is_refused_and_what_follows_is_not() {
        assert_eq!(accepted(&[(0.0, 0.0), (10.0, 1.0), (500.0, 2.0), (30.0, 3.0)]), [true, true, false, true]);
    }

    #[test]
    fn a_new_place_is_believed_after_five_positions() {
        let drive: Vec<_> = (0..8).map(|i| (if i == 0 { 0.0 } else { 5000.0 + f64::from(i) }, f64::from(i))).collect();
        assert_eq!(accepted(&drive), [true, false, false, false, false, true, true, true]);
    }

    #[test]
    fn five_positions_within_a_second_are_one_outlier() {
        let drive: Vec<_> = (0..9).map(|i| (if i == 0 { 0.0 } else { 5000.0 }, f64::from(i) * 0.01)).collect();
        assert_eq!(accepted(&drive).iter().filter(|&&accepted| accepted).count(), 1);
    }

    #[test]
    fn positions_that_disagree_with_each_other_are_never_believed() {
        let drive: Vec<_> = (0..20).map(|i| (f64::from(i % 2) * 1e5 + f64::from(i % 3) * 1e4, f64::from(i))).collect();
        assert!(accepted(&drive).iter().skip(1).filter(|&&accepted| accepted).count() == 3);
    }

    #[test]
    fn after_a_tunnel_the_way_driven_in_it_is_allowed() {
        assert_eq!(accepted(&[(0.0, 0.0), (1700.0, 30.0)]), [true, true]);
    }

    #[test]
    fn a_receiver_clock_that_was_set_does_not_excuse_a_jump() {
        let mut plausibility = Plausibility::new(&Settings::default());
        assert!(plausibility.check(&fix(0.0, 0.0)).is_ok());
        let mut jumped = fix(9000.0, 1.0);
        jumped.sample_time = Some(SampleTime { ns: 4_000_000_000_000, scale: TimeScale::Utc });
        assert!(plausibility.check(&jumped).is_err());
    }

    #[test]
    fn impossible_coordinates_and_speeds_are_refused() {
        let with = |change: fn(&mut Fix)| {
            let mut changed = fix(0.0, 0.0);
            change(&mut changed);
            Plausibility::new(&Settings::default()).check(&changed)
        };
        assert!(with(|_| {}).is_ok());
        assert!(with(|fix| fix.position.latitude_deg = f64::NAN).is_err());
        assert!(with(|fix| fix.position.latitude_deg = 90.1).is_err());
        assert!(with(|fix| fix.speed_mps = Some(61.0)).is_err());
        let null_island = Geodetic { latitude_deg: 0.0, longitude_deg: -0.0, altitude_m: 0.0 };
        assert!(
            Plausibility::new(&Settings::default()).check(&Fix { position: null_island, ..fix(0.0, 0.0) }).is_err()
        );
    }

    #[test]
    fn dates_of_lost_week_counts_are_refused() {
        // 2020-01-01, 2026-11-22, 2079-12-31; 2019-12-31, 2007-04-08 (1024 weeks before 2026-11-22), 1980-01-06.
        for (days, expected) in
            [(18_262, true), (20_779, true), (40_176, true), (18_261, false), (13_611, false), (3_657, false)]
        {
            assert_eq!(date_is_plausible(days), expected, "{days}");
        }
    }
}
