//! Samples of the last seconds, in the order in which they were taken.

use std::collections::VecDeque;

use super::receiver_clocks::{Instant, ReceiverClocks};

/// Samples kept: 20 s, or fewer of a receiver that sends more than 400 a second.
const KEPT_NS: i64 = 20_000_000_000;
const KEPT: usize = 8192;
/// Sentences of one measurement state its time to the millisecond.
const SAME_NS: i64 = 999_999;

#[derive(Debug, Clone)]
pub struct Timeline<T> {
    samples: VecDeque<(Instant, T)>,
}

/// A sample and its zero-latency time.
pub type Placed<'a, T> = (i64, &'a T);

impl<T> Default for Timeline<T> {
    fn default() -> Self {
        Self { samples: VecDeque::new() }
    }
}

impl<T> Timeline<T> {
    /// Puts a sample where it belongs. One of the same instant is merged into the one that is there. Returns whether it
    /// was new; one that is older than all that is kept is left out.
    pub fn insert(
        &mut self,
        clocks: &ReceiverClocks,
        instant: Instant,
        sample: T,
        merge: impl FnOnce(&mut T, T),
    ) -> bool {
        let when_ns = |instant: Instant| clocks.zero_latency_ns(instant).unwrap_or(i64::MIN);
        let new_ns = when_ns(instant);
        let place = self.samples.iter().rposition(|(known, _)| when_ns(*known) <= new_ns).map_or(0, |i| i + 1);
        let same = |known: &Instant| {
            known.is_on_clock_of(&instant) && known.ns.saturating_sub(instant.ns).saturating_abs() <= SAME_NS
        };
        // Times that were rounded differently lie on either side.
        for index in [place.wrapping_sub(1), place] {
            if let Some((known, there)) = self.samples.get_mut(index)
                && same(known)
            {
                merge(there, sample);
                return false;
            }
        }
        if place == 0 && self.samples.len() >= KEPT {
            return false;
        }
        self.samples.insert(place, (instant, sample));
        let newest_ns = self.samples.back().map_or(new_ns, |(newest, _)| when_ns(*newest));
        while self.samples.len() > KEPT
            || self.samples.front().is_some_and(|(oldest, _)| when_ns(*oldest) < newest_ns.saturating_sub(KEPT_NS))
        {
            self.samples.pop_front();
        }
        true
    }

    /// The last sample up to an instant of zero-latency time, and the first after it.
    pub fn around<'a>(
        &'a self,
        clocks: &'a ReceiverClocks,
        zero_latency_ns: i64,
    ) -> (Option<Placed<'a, T>>, Option<Placed<'a, T>>) {
        let mut after = None;
        for (ns, sample) in self.placed(clocks).rev() {
            if ns <= zero_latency_ns {
                return (Some((ns, sample)), after);
            }
            after = Some((ns, sample));
        }
        (None, after)
    }

    /// All samples with their zero-latency times.
    pub fn placed<'a>(&'a self, clocks: &'a ReceiverClocks) -> impl DoubleEndedIterator<Item = Placed<'a, T>> {
        let place = |(instant, sample): &'a (Instant, T)| Some((clocks.zero_latency_ns(*instant)?, sample));
        self.samples.iter().filter_map(place)
    }

    /// The newest sample's zero-latency time.
    pub fn newest_ns(&self, clocks: &ReceiverClocks) -> Option<i64> {
        self.placed(clocks).next_back().map(|(ns, _)| ns)
    }

    pub fn len(&self) -> usize {
        self.samples.len()
    }
}
