//! What the lamp shows.

use std::sync::{
    Arc,
    atomic::{AtomicU8, Ordering},
};

#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[repr(u8)]
pub enum LedPattern {
    /// Not running.
    #[default]
    Off,
    /// Waiting for the camera or for a fix: half a second on, half a second off.
    SlowBlink,
    /// Recording.
    On,
    /// Something is wrong: five times a second.
    FastBlink,
}

const SLOW_HALF_PERIOD_NS: u64 = 500_000_000;
const FAST_HALF_PERIOD_NS: u64 = 100_000_000;

impl LedPattern {
    /// At an instant of the monotonic clock.
    pub fn is_lit(self, monotonic_ns: u64) -> bool {
        match self {
            Self::Off => false,
            Self::On => true,
            Self::SlowBlink => (monotonic_ns / SLOW_HALF_PERIOD_NS).is_multiple_of(2),
            Self::FastBlink => (monotonic_ns / FAST_HALF_PERIOD_NS).is_multiple_of(2),
        }
    }
}

/// Says what the lamp shall show; whoever drives the pin has a clone.
#[derive(Debug, Clone, Default)]
pub struct Led {
    pattern: Arc<AtomicU8>,
}

impl Led {
    pub fn show(&self, pattern: LedPattern) {
        self.pattern.store(pattern as u8, Ordering::Relaxed);
    }

    pub fn pattern(&self) -> LedPattern {
        let shown = self.pattern.load(Ordering::Relaxed);
        let patterns = [LedPattern::Off, LedPattern::SlowBlink, LedPattern::On, LedPattern::FastBlink];
        patterns.into_iter().find(|&pattern| pattern as u8 == shown).unwrap_or_default()
    }

    pub fn is_lit(&self, monotonic_ns: u64) -> bool {
        self.pattern().is_lit(monotonic_ns)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn patterns_have_their_rates() {
        const STEP_NS: u64 = 10_000_000;
        for (pattern, lit_steps, changes) in [
            (LedPattern::Off, 0, 0),
            (LedPattern::On, 1000, 0),
            (LedPattern::SlowBlink, 500, 19),
            (LedPattern::FastBlink, 500, 99),
        ] {
            let lit: Vec<bool> = (0..1000).map(|step| pattern.is_lit(step * STEP_NS)).collect();
            assert_eq!(lit.iter().filter(|&&lit| lit).count(), lit_steps, "{pattern:?}");
            assert_eq!(lit.windows(2).filter(|pair| pair[0] != pair[1]).count(), changes, "{pattern:?} in 10 s");
        }
    }

    #[test]
    fn what_is_shown_reaches_the_other_handle() {
        let led = Led::default();
        let driver = led.clone();
        for pattern in [LedPattern::On, LedPattern::FastBlink, LedPattern::SlowBlink, LedPattern::Off] {
            led.show(pattern);
            assert_eq!(driver.pattern(), pattern);
        }
    }
}
