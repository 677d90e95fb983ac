//! Time.
//!
//! Every stamp is nanoseconds on the monotonic clock, which counts from boot and never jumps. The date ("realtime") may
//! be wrong by decades on a computer without a battery clock and may be set at any moment; it is recorded beside the
//! monotonic clock and used for nothing. What depends on time takes a [`Clock`] or a stamp, so that replay and tests
//! choose it.

use std::{
    sync::atomic::{AtomicI64, AtomicU64, Ordering},
    time::Duration,
};

use rustix::time::{ClockId, Timespec, clock_gettime};

pub const NS_PER_S: u64 = 1_000_000_000;

/// The two clocks of the computer at one instant.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ClockReading {
    pub monotonic_ns: u64,
    /// Since 1970.
    pub realtime_ns: i64,
}

/// Where the time comes from: the computer, a test or a replay.
pub trait Clock: Send + Sync {
    fn read(&self) -> ClockReading;

    fn monotonic_ns(&self) -> u64 {
        self.read().monotonic_ns
    }

    /// How long to wait until this stamp; nothing if it has passed.
    fn until(&self, stamp_ns: u64) -> Duration {
        Duration::from_nanos(stamp_ns.saturating_sub(self.monotonic_ns()))
    }
}

/// The computer's clocks.
#[derive(Debug, Clone, Copy, Default)]
pub struct SystemClock;

impl Clock for SystemClock {
    /// Monotonic, realtime, monotonic: of a few such readings the one that took least time.
    fn read(&self) -> ClockReading {
        const READINGS: usize = 3;
        let reading = || {
            let before_ns = self.monotonic_ns();
            let realtime = clock_gettime(ClockId::Realtime);
            let after_ns = self.monotonic_ns();
            let realtime_ns = realtime.tv_sec * NS_PER_S as i64 + realtime.tv_nsec;
            let width_ns = after_ns - before_ns;
            (width_ns, ClockReading { monotonic_ns: before_ns + width_ns / 2, realtime_ns })
        };
        let narrowest = (0..READINGS).map(|_| reading()).min_by_key(|&(width_ns, _)| width_ns);
        narrowest.expect("there is at least one reading").1
    }

    fn monotonic_ns(&self) -> u64 {
        let Timespec { tv_sec, tv_nsec } = clock_gettime(ClockId::Monotonic);
        tv_sec as u64 * NS_PER_S + tv_nsec as u64
    }
}

/// The clocks of a simulated or replayed drive: they run `speed` times as fast as the computer's, from where the drive
/// begins.
#[derive(Debug, Clone)]
pub struct ScaledClock {
    /// What the clock read when it was made.
    start: ClockReading,
    made_ns: u64,
    speed: f64,
    /// Realtime is set: when, on the monotonic clock, and by how much \[ns\].
    steps: Vec<(u64, i64)>,
}

impl ScaledClock {
    pub fn new(start: ClockReading, speed: f64) -> Self {
        Self { start, made_ns: SystemClock.monotonic_ns(), speed, steps: Vec::new() }
    }

    /// Sets realtime by `by_ns` at the stamp `at_ns`.
    pub fn with_step(mut self, at_ns: u64, by_ns: i64) -> Self {
        self.steps.push((at_ns, by_ns));
        self
    }
}

impl Clock for ScaledClock {
    fn read(&self) -> ClockReading {
        let elapsed_ns = ((SystemClock.monotonic_ns() - self.made_ns) as f64 * self.speed) as u64;
        let monotonic_ns = self.start.monotonic_ns + elapsed_ns;
        let stepped_ns: i64 =
            self.steps.iter().filter(|(at_ns, _)| *at_ns <= monotonic_ns).map(|(_, by_ns)| by_ns).sum();
        ClockReading { monotonic_ns, realtime_ns: self.start.realtime_ns + elapsed_ns as i64 + stepped_ns }
    }

    fn until(&self, stamp_ns: u64) -> Duration {
        Duration::from_nanos((stamp_ns.saturating_sub(self.monotonic_ns()) as f64 / self.speed) as u64)
    }
}

/// A clock that stands still until it is set.
#[derive(Debug, Default)]
pub struct ManualClock {
    monotonic_ns: AtomicU64,
    realtime_ns: AtomicI64,
}

impl ManualClock {
    pub fn new(reading: ClockReading) -> Self {
        let clock = Self::default();
        clock.set(reading);
        clock
    }

    pub fn set(&self, reading: ClockReading) {
        self.monotonic_ns.store(reading.monotonic_ns, Ordering::SeqCst);
        self.realtime_ns.store(reading.realtime_ns, Ordering::SeqCst);
    }

    /// Both clocks go on by this much.
    pub fn advance_ns(&self, by_ns: u64) {
        self.monotonic_ns.fetch_add(by_ns, Ordering::SeqCst);
        self.realtime_ns.fetch_add(by_ns as i64, Ordering::SeqCst);
    }
}

impl Clock for ManualClock {
    fn read(&self) -> ClockReading {
        ClockReading {
            monotonic_ns: self.monotonic_ns.load(Ordering::SeqCst),
            realtime_ns: self.realtime_ns.load(Ordering::SeqCst),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_scaled_clock_runs_faster_and_its_date_can_be_set() {
        let start = ClockReading { monotonic_ns: 5 * NS_PER_S, realtime_ns: 0 };
        let clock = ScaledClock::new(start, 1000.0).with_step(6 * NS_PER_S, 7);
        let before_ns = SystemClock.monotonic_ns();
        let real_ns = |clock_ns: u64| before_ns + clock_ns / 1000;
        while clock.monotonic_ns() < 6 * NS_PER_S {
            assert!(clock.until(6 * NS_PER_S) <= Duration::from_millis(1));
            std::thread::yield_now();
        }
        assert!(SystemClock.monotonic_ns() >= real_ns(NS_PER_S) - 1_000_000, "a second in a millisecond, not in less");
        let ClockReading { monotonic_ns, realtime_ns } = clock.read();
        assert_eq!(realtime_ns, (monotonic_ns - start.monotonic_ns) as i64 + 7);
        assert_eq!(clock.until(0), Duration::ZERO);
    }

    #[test]
    fn the_computers_clock_does_not_go_back() {
        let readings: Vec<_> = (0..100).map(|_| SystemClock.read().monotonic_ns).collect();
        assert!(readings.is_sorted());
    }
}
