//! Which stamps and sequence numbers of the driver are to be believed.
//!
//! `uvcvideo` stamps the start of the exposure on the monotonic clock, from the camera's own clock where the camera
//! sends it; cameras exist whose clock makes stamps jump back or ahead. A stamp that cannot be right is replaced by the
//! time of arrival, less the least delay that good stamps have shown: exposure, readout and transfer. If there was no
//! good one, nothing is known of the delay and nothing is subtracted.

use tracing::{info, warn};

/// What the driver says of a buffer's stamp.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct DriverStamp {
    pub ns: u64,
    /// On the clock that we use.
    pub monotonic: bool,
    /// Of the start of the exposure; otherwise of the end of the frame.
    pub start_of_exposure: bool,
}

/// No exposure and transfer takes longer; what is older was only fetched late, or is wrong \[ns\].
const MAX_AGE_NS: u64 = 1_000_000_000;

/// Chooses between the driver's stamp and the time of arrival.
#[derive(Debug)]
pub struct StampJudge {
    /// Frames the driver can hold while nobody fetches them.
    buffers: u32,
    last_ns: u64,
    /// The last one of the driver that was believed.
    last_driver_ns: u64,
    last_arrival_ns: Option<u64>,
    /// Least delay from a believed stamp to the arrival.
    delay_ns: Option<u64>,
    /// After we came late, so many buffers may be as much older.
    late_ns: u64,
    late_buffers: u32,
    rejected: u64,
    source_told: bool,
}

impl StampJudge {
    pub fn new(buffers: u32) -> Self {
        Self {
            buffers,
            last_ns: 0,
            last_driver_ns: 0,
            last_arrival_ns: None,
            delay_ns: None,
            late_ns: 0,
            late_buffers: 0,
            rejected: 0,
            source_told: false,
        }
    }

    /// Stamps that were replaced so far.
    pub fn rejected(&self) -> u64 {
        self.rejected
    }

    /// The stamp of a frame that was fetched at `arrival_ns`. Stamps rise strictly.
    pub fn stamp_ns(&mut self, stamp: DriverStamp, arrival_ns: u64) -> u64 {
        let waited_ns = arrival_ns.saturating_sub(self.last_arrival_ns.unwrap_or(arrival_ns));
        self.last_arrival_ns = Some(arrival_ns);
        if waited_ns > MAX_AGE_NS {
            (self.late_ns, self.late_buffers) = (waited_ns, self.buffers);
        }
        let max_age_ns = MAX_AGE_NS + if self.late_buffers > 0 { self.late_ns } else { 0 };
        self.late_buffers = self.late_buffers.saturating_sub(1);

        let plausible = stamp.monotonic
            && stamp.ns > self.last_driver_ns
            && stamp.ns <= arrival_ns
            && arrival_ns - stamp.ns <= max_age_ns;
        self.tell(stamp, plausible, arrival_ns);
        let best_ns = if plausible {
            let age_ns = arrival_ns - stamp.ns;
            self.last_driver_ns = stamp.ns;
            self.delay_ns = Some(self.delay_ns.map_or(age_ns, |least_ns| least_ns.min(age_ns)));
            stamp.ns
        } else {
            arrival_ns.saturating_sub(self.delay_ns.unwrap_or(0))
        };
        self.last_ns = best_ns.max(self.last_ns + 1);
        self.last_ns
    }

    fn tell(&mut self, stamp: DriverStamp, plausible: bool, arrival_ns: u64) {
        if !plausible {
            self.rejected += 1;
            if self.rejected == 1 {
                warn!(
                    stamp_ns = stamp.ns,
                    arrival_ns,
                    last_stamp_ns = self.last_driver_ns,
                    monotonic = stamp.monotonic,
                    "the camera driver's stamps cannot be right; such frames are stamped by their arrival"
                );
            }
        } else if !self.source_told {
            self.source_told = true;
            if !stamp.start_of_exposure {
                info!("the camera driver stamps the end of a frame: exposures began earlier, by how much is not known");
            }
        }
    }
}

/// Counts frames over gaps, restarts and the wrap of the driver's 32-bit sequence number.
#[derive(Debug, Default)]
pub struct SequenceJudge {
    driver: Option<u32>,
    ours: u32,
}

/// A larger step is a restart, not a loss: at 30 frames a second this is an hour and longer than any time-out.
const MAX_GAP: u32 = 100_000;

/// The frame's number, and how many are missing before it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Numbered {
    pub sequence: u32,
    pub missing: u32,
}

impl SequenceJudge {
    pub fn number(&mut self, driver: u32) -> Numbered {
        let Some(last) = self.driver.replace(driver) else {
            self.ours = driver;
            return Numbered { sequence: driver, missing: 0 };
        };
        let step = match driver.wrapping_sub(last) {
            step @ 1..=MAX_GAP => step,
            _ => {
                info!(last, sequence = driver, "the camera's sequence numbers started again");
                1
            }
        };
        self.ours = self.ours.wrapping_add(step);
        Numbered { sequence: self.ours, missing: step - 1 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: u64 = 1_000_000;

    fn monotonic(ns: u64) -> DriverStamp {
        DriverStamp { ns, monotonic: true, start_of_exposure: true }
    }

    #[test]
    fn sound_stamps_are_taken() {
        let mut judge = StampJudge::new(6);
        for frame in 1..100 {
            let stamp_ns = frame * 33 * MS;
            assert_eq!(judge.stamp_ns(monotonic(stamp_ns), stamp_ns + 45 * MS), stamp_ns);
        }
        assert_eq!(judge.rejected(), 0);
    }

    #[test]
    fn stamps_that_cannot_be_right_become_the_arrival_less_the_delay() {
        let delay_ns = 45 * MS;
        let arrival_ns = 10_000 * MS;
        let earlier = monotonic(arrival_ns - 33 * MS - delay_ns);
        let realtime = DriverStamp { ns: 1_700_000_000_000 * MS, monotonic: false, start_of_exposure: true };
        for (name, wrong) in [
            ("another clock", realtime),
            ("another clock that looks right", DriverStamp { monotonic: false, ..monotonic(arrival_ns - MS) }),
            ("the same again", earlier),
            ("earlier", monotonic(earlier.ns - MS)),
            ("zero", monotonic(0)),
            ("the future", monotonic(arrival_ns + MS)),
            ("the far future", monotonic(u64::MAX)),
        ] {
            let mut judge = StampJudge::new(6);
            judge.stamp_ns(earlier, arrival_ns - 33 * MS);
            assert_eq!(judge.stamp_ns(wrong, arrival_ns), arrival_ns - delay_ns, "{name}");
            assert_eq!(judge.rejected(), 1, "{name}");
            let next = monotonic(arrival_ns + 33 * MS - delay_ns);
            assert_eq!(judge.stamp_ns(next, arrival_ns + 33 * MS), next.ns, "{name}: the next is believed again");
        }
        let mut judge = StampJudge::new(6);
        let old = monotonic(arrival_ns - 3000 * MS);
        assert_eq!(judge.stamp_ns(old, arrival_ns), arrival_ns, "of the delay nothing is known yet");
    }

    #[test]
    fn a_replaced_stamp_that_is_late_holds_up_no_good_ones() {
        let mut judge = StampJudge::new(6);
        // Nothing is known of the delay, so that the first one is 45 ms late: more than the period.
        assert_eq!(judge.stamp_ns(monotonic(0), 1045 * MS), 1045 * MS);
        for frame in 1..10 {
            let stamp_ns = (1000 + frame * 16) * MS;
            let found_ns = judge.stamp_ns(monotonic(stamp_ns), stamp_ns + 45 * MS);
            assert!(found_ns == stamp_ns || found_ns <= 1045 * MS + frame, "{frame}: {found_ns}");
        }
        assert_eq!(judge.rejected(), 1);
    }

    #[test]
    fn frames_that_we_fetched_late_keep_their_stamps() {
        let mut judge = StampJudge::new(6);
        judge.stamp_ns(monotonic(1000 * MS), 1040 * MS);
        // Seven seconds later: the six buffers that were filled first.
        for frame in 1..=6 {
            let stamp_ns = (1000 + frame * 33) * MS;
            assert_eq!(judge.stamp_ns(monotonic(stamp_ns), 8040 * MS + frame), stamp_ns);
        }
        let old_ns = 1300 * MS;
        assert_eq!(judge.stamp_ns(monotonic(old_ns), 8050 * MS), 8010 * MS, "more than the driver can hold");
    }

    #[test]
    fn stamps_rise_although_arrivals_stand_still() {
        let mut judge = StampJudge::new(6);
        let mut last_ns = 0;
        for _ in 0..5 {
            let stamp_ns = judge.stamp_ns(DriverStamp { monotonic: false, ..monotonic(7) }, 1000);
            assert!(stamp_ns > last_ns);
            last_ns = stamp_ns;
        }
    }

    #[test]
    fn gaps_restarts_and_the_wrap_are_told_apart() {
        let mut judge = SequenceJudge::default();
        for (driver, sequence, missing) in [
            (u32::MAX - 2, u32::MAX - 2, 0),
            (u32::MAX - 1, u32::MAX - 1, 0),
            // Two are lost across the wrap.
            (1, 1, 2),
            (2, 2, 0),
            // Started again, and once more; the same number twice.
            (0, 3, 0),
            (1, 4, 0),
            (1, 5, 0),
            (2, 6, 0),
            (7, 11, 4),
            (4_000_000_000, 12, 0),
        ] {
            assert_eq!(judge.number(driver), Numbered { sequence, missing }, "driver says {driver}");
        }
    }
}
