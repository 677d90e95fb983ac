//! Between the producer, which never waits, and the thread of one output.
//!
//! Bounded: the oldest estimate gives way to the newest. An output that is late says what is true now, not what was.

use std::{
    collections::VecDeque,
    sync::{Condvar, Mutex, MutexGuard, PoisonError},
    time::Duration,
};

use super::{TimedEstimate, rate::RateLimit};

/// Two seconds of a camera at 30 Hz.
pub(super) const CAPACITY: usize = 64;

/// What an output's thread finds.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Found {
    Estimate(TimedEstimate),
    /// Nothing came in time.
    Nothing,
    /// Nothing is there and nothing more will come.
    Closed,
}

#[derive(Debug)]
pub(super) struct Inbox {
    state: Mutex<State>,
    filled: Condvar,
}

#[derive(Debug)]
struct State {
    waiting: VecDeque<TimedEstimate>,
    rate: RateLimit,
    dropped: u64,
    is_closed: bool,
}

impl Inbox {
    pub fn new(rate: RateLimit) -> Self {
        let waiting = VecDeque::with_capacity(CAPACITY);
        Self { state: Mutex::new(State { waiting, rate, dropped: 0, is_closed: false }), filled: Condvar::new() }
    }

    /// Never waits for the output and allocates nothing: the state is only ever locked to copy one estimate.
    pub fn push(&self, timed: &TimedEstimate) {
        let mut state = self.lock();
        if state.is_closed || !state.rate.admits(&timed.estimate) {
            return;
        }
        if state.waiting.len() == CAPACITY {
            state.waiting.pop_front();
            state.dropped += 1;
        }
        state.waiting.push_back(*timed);
        drop(state);
        self.filled.notify_one();
    }

    /// Waits for an estimate and takes the oldest.
    pub fn take(&self, at_most: Duration) -> Found {
        let idle = |state: &mut State| state.waiting.is_empty() && !state.is_closed;
        let waited = self.filled.wait_timeout_while(self.lock(), at_most, idle);
        let mut state = waited.unwrap_or_else(PoisonError::into_inner).0;
        match state.waiting.pop_front() {
            Some(timed) => Found::Estimate(timed),
            None if state.is_closed => Found::Closed,
            None => Found::Nothing,
        }
    }

    /// Nothing more comes in; what is there can still be taken.
    pub fn close(&self) {
        self.lock().is_closed = true;
        self.filled.notify_all();
    }

    /// Estimates that gave way to newer ones so far.
    pub fn dropped(&self) -> u64 {
        self.lock().dropped
    }

    /// Whoever panicked while holding the state left it whole.
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::outputs::test_estimates::unknown;

    fn numbered(sequence: u32) -> TimedEstimate {
        let mut timed = unknown();
        timed.estimate.sequence = sequence;
        timed
    }

    fn next(inbox: &Inbox) -> Option<u32> {
        match inbox.take(Duration::ZERO) {
            Found::Estimate(timed) => Some(timed.estimate.sequence),
            Found::Nothing | Found::Closed => None,
        }
    }

    #[test]
    fn the_oldest_give_way_and_are_counted() {
        let inbox = Inbox::new(RateLimit::new(None));
        (0..1000).for_each(|sequence| inbox.push(&numbered(sequence)));
        assert_eq!(inbox.dropped(), 1000 - CAPACITY as u64);
        assert_eq!(inbox.lock().waiting.capacity(), CAPACITY, "no more memory than at the start");
        let left: Vec<u32> = std::iter::from_fn(|| next(&inbox)).collect();
        assert_eq!(left, (1000 - CAPACITY as u32..1000).collect::<Vec<_>>());
    }

    #[test]
    fn a_closed_inbox_hands_out_what_it_has_and_takes_nothing_more() {
        let inbox = Inbox::new(RateLimit::new(None));
        inbox.push(&numbered(1));
        inbox.close();
        inbox.push(&numbered(2));
        assert_eq!(next(&inbox), Some(1));
        assert_eq!(inbox.take(Duration::from_secs(1000)), Found::Closed, "returns at once");
    }
}
