//! Keeps a device running: a thread for it, and a new start, later each time, when it fails.

use std::{
    any::Any,
    panic::{AssertUnwindSafe, catch_unwind},
    thread::{self, JoinHandle},
    time::Duration,
};

use tracing::{error, info, warn};

use crate::{
    devices::{DeviceError, Stop},
    types::{Clock, NS_PER_S},
};

/// The first delay before a device is tried again; it doubles with each failure in a row.
const FIRST_DELAY: Duration = Duration::from_millis(250);
/// A plugged-in device is found at the latest after this.
const LONGEST_DELAY: Duration = Duration::from_secs(4);
/// A run that lasted this long was a healthy one: the delay starts over.
const HEALTHY_RUN_NS: u64 = 10 * NS_PER_S;

/// What became of a device's run.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Outcome {
    /// It failed; the word says why, and it is tried again.
    Failed { health: &'static str },
    /// It ended by itself, as a replay does, or because it was told to.
    Ended,
}

/// Delays between attempts.
#[derive(Debug, Default)]
struct Backoff {
    failures: u32,
}

impl Backoff {
    fn after_run(&mut self, lasted_ns: u64) -> Duration {
        if lasted_ns >= HEALTHY_RUN_NS {
            self.failures = 0;
        }
        let delay = FIRST_DELAY.saturating_mul(1 << self.failures.min(16)).min(LONGEST_DELAY);
        self.failures += 1;
        delay
    }
}

/// Runs a device on a thread of its own until it ends or `stop` is given. Each end of a run is told to `report`.
pub fn supervise(
    device: &'static str,
    clock: std::sync::Arc<dyn Clock>,
    stop: Stop,
    mut run: impl FnMut(&dyn Clock, &Stop) -> Result<(), DeviceError> + Send + 'static,
    mut report: impl FnMut(Outcome) + Send + 'static,
) -> std::io::Result<JoinHandle<()>> {
    thread::Builder::new().name(device.into()).spawn(move || {
        let mut backoff = Backoff::default();
        let mut last_health = "";
        while !stop.is_stopped() {
            let started_ns = clock.monotonic_ns();
            // A run's values are all made inside it: what a panic left half-done goes with it.
            let outcome = catch_unwind(AssertUnwindSafe(|| run(&*clock, &stop)));
            let error = match outcome {
                Ok(Ok(())) => break,
                Ok(Err(error)) => error,
                Err(panic) => DeviceError::BadData { device: device.into(), what: panic_text(&*panic) },
            };
            let health = error.health();
            let delay = backoff.after_run(clock.monotonic_ns().saturating_sub(started_ns));
            let restart_in_ms = delay.as_millis() as u64;
            // The same fault again and again is one line, not one every few seconds.
            if health == last_health {
                tracing::debug!(device, error = %chain(&error), restart_in_ms, "device still fails");
            } else if matches!(error, DeviceError::BadData { .. }) {
                error!(device, error = %chain(&error), restart_in_ms, "device failed");
            } else {
                warn!(device, error = %chain(&error), restart_in_ms, "device failed");
            }
            last_health = health;
            report(Outcome::Failed { health });
            if stop.wait(delay) {
                break;
            }
        }
        info!(device, "device stopped");
        report(Outcome::Ended);
    })
}

/// Waits for threads; one that hangs in a driver is left behind, and said so.
pub async fn join_within(threads: &[JoinHandle<()>], limit: Duration) {
    const POLL: Duration = Duration::from_millis(5);
    let deadline = tokio::time::Instant::now() + limit;
    while threads.iter().any(|thread| !thread.is_finished()) && tokio::time::Instant::now() < deadline {
        tokio::time::sleep(POLL).await;
    }
    for thread in threads.iter().filter(|thread| !thread.is_finished()) {
        warn!(thread = thread.thread().name().unwrap_or("?"), "does not stop; leaving it behind");
    }
}

/// An error and its causes on one line.
fn chain(error: &DeviceError) -> String {
    let mut text = error.to_string();
    let mut cause = std::error::Error::source(error);
    while let Some(error) = cause {
        text += &format!(": {error}");
        cause = error.source();
    }
    text
}

fn panic_text(panic: &(dyn Any + Send)) -> String {
    let text = panic.downcast_ref::<&str>().copied().or_else(|| panic.downcast_ref::<String>().map(String::as_str));
    format!("a defect in this program: {}", text.unwrap_or("unknown"))
}

#[cfg(test)]
mod tests {
    use std::sync::{Arc, mpsc};

    use super::*;
    use crate::types::{ClockReading, ManualClock};

    #[test]
    fn delays_double_up_to_the_bound_and_start_over_after_a_healthy_run() {
        let mut backoff = Backoff::default();
        let delays: Vec<_> = (0..6).map(|_| backoff.after_run(0).as_millis()).collect();
        assert_eq!(delays, [250, 500, 1000, 2000, 4000, 4000]);
        assert_eq!(backoff.after_run(HEALTHY_RUN_NS).as_millis(), 250);
        assert_eq!(backoff.after_run(0).as_millis(), 500);
        backoff.failures = u32::MAX - 1;
        assert_eq!(backoff.after_run(0), LONGEST_DELAY);
    }

    #[test]
    fn errors_and_panics_are_reported_and_the_device_is_tried_again() {
        let clock = Arc::new(ManualClock::new(ClockReading { monotonic_ns: 0, realtime_ns: 0 }));
        let (sender, outcomes) = mpsc::channel();
        let mut runs = 0;
        let run = move |_: &dyn Clock, _: &Stop| {
            runs += 1;
            match runs {
                1 => Err(DeviceError::NotPresent { device: "camera".into() }),
                2 => panic!("index out of bounds"),
                _ => Ok(()),
            }
        };
        let thread = supervise("camera", clock, Stop::default(), run, move |outcome| {
            sender.send(outcome).expect("the test listens");
        });
        thread.expect("starts").join().expect("the panic stays inside");
        let outcomes: Vec<_> = outcomes.iter().collect();
        let failed = |health| Outcome::Failed { health };
        assert_eq!(outcomes, [failed("not present"), failed("bad data"), Outcome::Ended]);
    }

    #[test]
    fn stopping_cuts_a_delay_short() {
        let stop = Stop::default();
        let (sender, outcomes) = mpsc::channel();
        let run = |_: &dyn Clock, _: &Stop| Err(DeviceError::NotPresent { device: "camera".into() });
        let clock = Arc::new(ManualClock::default());
        let thread = supervise("camera", clock, stop.clone(), run, move |outcome| {
            let _ = sender.send(outcome);
        })
        .expect("starts");
        for _ in 0..3 {
            outcomes.recv().expect("fails at once, then after 250 and 500 ms");
        }
        stop.stop();
        thread.join().expect("ends");
        assert_eq!(outcomes.iter().last(), Some(Outcome::Ended));
    }
}
