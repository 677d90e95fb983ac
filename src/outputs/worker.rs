//! The thread of one output: takes estimates, delivers them, opens the output again when it has failed.

use std::{
    fmt::Display,
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
    time::{Duration, Instant},
};

use tracing::{info, warn};

use super::{
    TimedEstimate,
    inbox::{Found, Inbox},
};

/// Between two attempts to open an output.
const REOPEN_INTERVAL: Duration = Duration::from_secs(1);
/// Without estimates an output looks after its clients this often.
const LOOK_AFTER: Duration = Duration::from_millis(100);

/// Why an output does not work.
#[derive(Debug, thiserror::Error)]
pub(super) enum LinkError {
    /// It is opened again.
    #[error("{0}")]
    Failed(String),
    /// Whoever listened has gone for good.
    #[error("{0}")]
    Ended(String),
}

/// An output that is open.
pub(super) trait Link {
    fn deliver(&mut self, timed: &TimedEstimate, counters: &Counters) -> Result<(), LinkError>;

    /// Is called after each estimate and when there has been none for [`LOOK_AFTER`].
    fn look_after(&mut self, _counters: &Counters) -> Result<(), LinkError> {
        Ok(())
    }
}

/// What became of the estimates of one output.
#[derive(Debug, Default)]
pub(super) struct Counters {
    pub delivered: AtomicU64,
    /// Estimates that it could not take: it was not open, or busy.
    pub lost: AtomicU64,
    pub clients: AtomicU64,
    pub disconnected: AtomicU64,
    /// Sentences that a slow client missed.
    pub skipped: AtomicU64,
}

pub(super) fn count(counter: &AtomicU64, by: u64) {
    counter.fetch_add(by, Ordering::Relaxed);
}

/// Logs a failure once, and that it is over.
#[derive(Debug)]
pub(super) struct Trouble {
    output: Arc<str>,
    is_failing: bool,
}

impl Trouble {
    pub fn new(output: Arc<str>) -> Self {
        Self { output, is_failing: false }
    }

    pub fn failed(&mut self, error: &dyn Display) {
        if !std::mem::replace(&mut self.is_failing, true) {
            warn!(output = &*self.output, %error, "output failed, is tried again");
        }
    }

    pub fn mended(&mut self) {
        if std::mem::take(&mut self.is_failing) {
            info!(output = &*self.output, "output works again");
        }
    }
}

/// Delivers until the inbox is closed and empty, or the output has ended for good.
pub(super) fn run<L: Link>(
    name: Arc<str>,
    mut open: impl FnMut() -> Result<L, LinkError>,
    inbox: &Inbox,
    counters: &Counters,
) {
    let mut trouble = Trouble::new(name.clone());
    let mut link: Option<L> = None;
    let mut last_attempt: Option<Instant> = None;
    loop {
        let mut outcome = Ok(());
        if link.is_none() && last_attempt.is_none_or(|last| last.elapsed() >= REOPEN_INTERVAL) {
            last_attempt = Some(Instant::now());
            outcome = open().map(|opened| link = Some(opened));
        }
        let found = inbox.take(LOOK_AFTER);
        match (&found, &mut link) {
            (Found::Estimate(timed), Some(link)) => {
                outcome = link.deliver(timed, counters);
                match outcome {
                    Ok(()) => {
                        count(&counters.delivered, 1);
                        trouble.mended();
                        outcome = link.look_after(counters);
                    }
                    Err(_) => count(&counters.lost, 1),
                }
            }
            (Found::Estimate(_), None) => count(&counters.lost, 1),
            (Found::Nothing, Some(link)) => outcome = link.look_after(counters),
            (Found::Closed, _) => return,
            (Found::Nothing, None) => {}
        }
        match outcome {
            Ok(()) => {}
            Err(error @ LinkError::Failed(_)) => {
                link = None;
                trouble.failed(&error);
            }
            Err(error @ LinkError::Ended(_)) => {
                warn!(output = &*name, %error, "output ended, is not tried again");
                return;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::outputs::{rate::RateLimit, test_estimates::unknown};

    /// Ends at an estimate.
    struct Fickle<'a> {
        delivered: &'a mut Vec<u32>,
        ends_at: u32,
    }

    impl Link for Fickle<'_> {
        fn deliver(&mut self, timed: &TimedEstimate, _counters: &Counters) -> Result<(), LinkError> {
            let sequence = timed.estimate.sequence;
            if sequence == self.ends_at {
                return Err(LinkError::Ended("gone".into()));
            }
            self.delivered.push(sequence);
            Ok(())
        }
    }

    /// Numbers delivered of 10 estimates, and how many were counted as delivered and lost.
    fn run_with(ends_at: u32, is_there: bool) -> (usize, u64, u64) {
        let inbox = Inbox::new(RateLimit::new(None));
        for sequence in 0..10 {
            let mut timed = unknown();
            timed.estimate.sequence = sequence;
            inbox.push(&timed);
        }
        inbox.close();
        let (mut delivered, counters) = (Vec::new(), Counters::default());
        let mut link = is_there.then_some(Fickle { delivered: &mut delivered, ends_at });
        run("fickle".into(), || link.take().ok_or_else(|| LinkError::Failed("not there".into())), &inbox, &counters);
        let of = |counter: &AtomicU64| counter.load(Ordering::Relaxed);
        (delivered.len(), of(&counters.delivered), of(&counters.lost))
    }

    #[test]
    fn all_that_waits_is_delivered_before_the_end() {
        assert_eq!(run_with(u32::MAX, true), (10, 10, 0));
    }

    #[test]
    fn an_output_that_ended_is_left_alone() {
        assert_eq!(run_with(3, true), (3, 3, 1));
    }

    #[test]
    fn what_an_absent_output_misses_is_counted() {
        assert_eq!(run_with(u32::MAX, false), (0, 0, 10));
    }
}
