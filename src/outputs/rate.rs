//! At most so many estimates a second.

use crate::types::{LocalizationState, NS_PER_S, PositionEstimate};

/// Counts on the frames' stamps, so that a replay passes the same ones at any speed. A change of state always passes:
/// nobody should be left with a position that no longer holds.
#[derive(Debug, Clone)]
pub(super) struct RateLimit {
    interval_ns: u64,
    /// Of the next estimate that passes.
    due_ns: Option<u64>,
    state: Option<LocalizationState>,
}

impl RateLimit {
    /// `None`: all pass.
    pub fn new(max_rate_hz: Option<f64>) -> Self {
        let interval_ns = max_rate_hz.map_or(0, |rate_hz| (NS_PER_S as f64 / rate_hz).round() as u64);
        Self { interval_ns, due_ns: None, state: None }
    }

    pub fn admits(&mut self, estimate: &PositionEstimate) -> bool {
        let stamp_ns = estimate.stamp_ns;
        let is_change = self.state.replace(estimate.state) != Some(estimate.state);
        // A stamp further back than this is of another drive.
        let due_ns = self.due_ns.filter(|due_ns| due_ns.saturating_sub(stamp_ns) <= self.interval_ns);
        let is_due = due_ns.is_none_or(|due_ns| stamp_ns >= due_ns);
        if is_due {
            // Counted from when it was due, not from when it came, or frames that do not fit the rate would lower it.
            let start_ns = due_ns.filter(|due_ns| stamp_ns - due_ns < self.interval_ns).unwrap_or(stamp_ns);
            self.due_ns = Some(start_ns.saturating_add(self.interval_ns));
        }
        is_due || is_change
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::outputs::test_estimates::unknown;

    fn at(ms: u64) -> PositionEstimate {
        PositionEstimate { stamp_ns: ms * 1_000_000, ..unknown().estimate }
    }

    #[test]
    fn frames_pass_at_the_rate_whatever_their_own() {
        for (frame_ms, rate_hz, expected) in [
            (33, Some(10.0), 100),
            (33, Some(20.0), 200),
            (100, Some(10.0), 100),
            (50, None, 200),
            (500, Some(10.0), 20),
        ] {
            let mut limit = RateLimit::new(rate_hz);
            let passed = (0..10_000 / frame_ms).filter(|frame| limit.admits(&at(frame * frame_ms))).count();
            assert!(passed.abs_diff(expected) <= 1, "{frame_ms} ms at {rate_hz:?}: {passed}");
        }
    }

    #[test]
    fn a_change_of_state_passes_at_once() {
        let mut limit = RateLimit::new(Some(1.0));
        let in_state = |ms, state| PositionEstimate { state, ..at(ms) };
        let passed = [
            (0, LocalizationState::Localized),
            (100, LocalizationState::Localized),
            (200, LocalizationState::Lost),
            (300, LocalizationState::Lost),
            (1000, LocalizationState::Lost),
        ]
        .map(|(ms, state)| limit.admits(&in_state(ms, state)));
        assert_eq!(passed, [true, false, true, false, true]);
    }

    #[test]
    fn after_a_silence_or_another_start_it_goes_on() {
        let mut limit = RateLimit::new(Some(10.0));
        let passed = [0, 50, 5000, 5010, 5100, 20, 60, 121].map(|ms| limit.admits(&at(ms)));
        assert_eq!(passed, [true, false, true, false, true, true, false, true]);
    }
}
