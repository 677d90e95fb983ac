//! Time.
//!
//! Every stamp is nanoseconds on the monotonic clock, which counts from boot and never jumps. The date ("realtime") may
//! be wrong by decades on a computer without a battery clock and may be set at any moment; it is recorded beside the
//! monotonic clock and used for nothing. What depends on time takes a [`Clock`] or a stamp, so that replay and tests
//! choose it.

use std::sync::atomic::{AtomicI64, AtomicU64, Ordering};

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
