//! All clocks a receiver may count on, against the monotonic clock.

use super::clock_map::{ClockMap, Verdict};
use crate::types::{SampleTime, TimeScale};

const DAY_NS: i64 = 86_400 * 1_000_000_000;
/// Jitter of samples without a time when none with a time has shown it \[s\].
const UNKNOWN_JITTER_STD_S: f64 = 0.02;

/// What an instant is counted on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ClockKind {
    /// UTC, dated or not.
    Utc,
    /// Since the receiver was switched on.
    Device,
    /// None of the receiver's: zero-latency time taken from the arrival.
    Arrival,
}

/// When a sample was taken, such that a better knowledge of the clock moves all samples alike.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Instant {
    pub clock: ClockKind,
    /// Of that clock: it is another clock after it was set.
    epoch: u32,
    pub ns: i64,
}

impl Instant {
    /// Whether both count on the same clock, which was not set in between.
    pub fn is_on_clock_of(&self, other: &Self) -> bool {
        (self.clock, self.epoch) == (other.clock, other.epoch)
    }
}

/// The maps of both clocks. UTC and UTC of a day whose date is not known are one clock, whole days apart.
#[derive(Debug, Clone, Default)]
pub struct ReceiverClocks {
    utc: ClockMap,
    device: ClockMap,
    /// The UTC map counts from 1970, not from some midnight.
    dated: bool,
}

impl ReceiverClocks {
    /// Takes in a sample; returns on which clock it counts, and its time there.
    pub fn push(&mut self, time: SampleTime, arrival_ns: u64) -> (ClockKind, i64, Verdict) {
        let (kind, ns) = match time.scale {
            TimeScale::Device => (ClockKind::Device, time.ns),
            TimeScale::Utc => {
                if !self.dated {
                    // All that came before gets its date.
                    self.utc.recount(self.days_from_expected_ns(time.ns, arrival_ns));
                    self.dated = true;
                }
                (ClockKind::Utc, time.ns)
            }
            // Of which day, what came before shows; the midnight it counts from may change when the receiver restarts.
            TimeScale::UtcOfDay => {
                (ClockKind::Utc, time.ns.saturating_sub(self.days_from_expected_ns(time.ns, arrival_ns)))
            }
        };
        let verdict = match kind {
            ClockKind::Device => self.device.push(ns, arrival_ns),
            _ => self.utc.push(ns, arrival_ns),
        };
        (kind, ns, verdict)
    }

    /// Where a sample that was taken in lies; `None` if its clock has no map yet.
    pub fn peek(&self, time: SampleTime, arrival_ns: u64) -> Option<Instant> {
        let (clock, ns) = match time.scale {
            TimeScale::Device => (ClockKind::Device, time.ns),
            TimeScale::Utc if self.dated => (ClockKind::Utc, time.ns),
            TimeScale::Utc | TimeScale::UtcOfDay => {
                (ClockKind::Utc, time.ns.saturating_sub(self.days_from_expected_ns(time.ns, arrival_ns)))
            }
        };
        self.map(clock)?.offset_ns().map(|_| self.instant(clock, ns))
    }

    /// By how many whole days \[ns\] a UTC time differs from what is expected at this arrival; 0 before there is a map.
    fn days_from_expected_ns(&self, utc_ns: i64, arrival_ns: u64) -> i64 {
        let Some(offset_ns) = self.utc.offset_ns() else { return 0 };
        let expected_ns = (arrival_ns as i64).saturating_sub(offset_ns);
        let apart_ns = utc_ns.saturating_sub(expected_ns);
        ((apart_ns as f64 / DAY_NS as f64).round() as i64).saturating_mul(DAY_NS)
    }

    fn map(&self, kind: ClockKind) -> Option<&ClockMap> {
        match kind {
            ClockKind::Utc => Some(&self.utc),
            ClockKind::Device => Some(&self.device),
            ClockKind::Arrival => None,
        }
    }

    /// A sample that the current epoch of its clock placed.
    pub fn instant(&self, clock: ClockKind, ns: i64) -> Instant {
        Instant { clock, epoch: self.map(clock).map_or(0, ClockMap::epoch), ns }
    }

    /// A sample without a time of its own: it arrived, and is assumed to have come as late as samples do on average.
    pub fn instant_of_arrival(&self, arrival_ns: u64) -> Instant {
        let mean_excess_ns = (self.mean_excess_s() * 1e9) as i64;
        Instant { clock: ClockKind::Arrival, epoch: 0, ns: (arrival_ns as i64).saturating_sub(mean_excess_ns) }
    }

    /// Zero-latency time of an instant. `None`: too many epochs ago.
    pub fn zero_latency_ns(&self, instant: Instant) -> Option<i64> {
        match self.map(instant.clock) {
            Some(map) => Some(instant.ns.saturating_add(map.offset_in_epoch_ns(instant.epoch)?)),
            None => Some(instant.ns),
        }
    }

    /// One standard deviation of [`zero_latency_ns`](Self::zero_latency_ns).
    pub fn std_s(&self, kind: ClockKind) -> f64 {
        match self.map(kind) {
            Some(map) => map.std_s(),
            // Exponential jitter has its mean for its standard deviation.
            None => self.mean_excess_s().max(UNKNOWN_JITTER_STD_S),
        }
    }

    /// Mean lateness of samples after the earliest possible.
    pub fn mean_excess_s(&self) -> f64 {
        self.utc.mean_excess_s().max(self.device.mean_excess_s())
    }

    /// The offset of UTC, dated or not: `zero-latency time − UTC`.
    pub fn utc_offset_ns(&self, monotonic_ns: u64) -> Option<i64> {
        self.utc.offset_at_ns(monotonic_ns)
    }

    /// Whether the date of UTC is known.
    pub fn is_dated(&self) -> bool {
        self.dated
    }

    /// How often a clock of the receiver was set.
    pub fn steps(&self) -> u64 {
        self.utc.steps() + self.device.steps()
    }

    /// Counts what ends the validity of a latency that was found out.
    pub fn jumps(&self) -> u64 {
        self.utc.jumps() + self.device.jumps()
    }
}
