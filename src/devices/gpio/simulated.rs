//! Pins without hardware.

use std::{
    collections::VecDeque,
    fmt,
    iter::Peekable,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    time::Duration,
};

use super::{
    super::{DeviceError, GpioEvent, Stop},
    Led,
};
use crate::types::Clock;

type Stamps = Peekable<Box<dyn Iterator<Item = u64> + Send>>;

/// Pulses at given instants, a button that anyone with a clone can press, and a lamp to look at.
#[derive(Clone)]
pub struct SimulatedPins {
    inner: Arc<Mutex<Inner>>,
}

struct Inner {
    pulses: Stamps,
    presses: VecDeque<u64>,
    lamp_is_lit: bool,
}

/// In real time, not on the simulated clock.
const LOOK_EVERY: Duration = Duration::from_millis(5);

impl Default for SimulatedPins {
    fn default() -> Self {
        Self::new(std::iter::empty())
    }
}

impl fmt::Debug for SimulatedPins {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("SimulatedPins").finish_non_exhaustive()
    }
}

impl SimulatedPins {
    /// With pulses at these rising instants on the monotonic clock \[ns\]; there may be no end of them.
    pub fn new(pulses: impl Iterator<Item = u64> + Send + 'static) -> Self {
        let pulses: Box<dyn Iterator<Item = u64> + Send> = Box::new(pulses);
        let inner = Inner { pulses: pulses.peekable(), presses: VecDeque::new(), lamp_is_lit: false };
        Self { inner: Arc::new(Mutex::new(inner)) }
    }

    /// Presses the button at this instant, which may lie in the future; presses are made in the order of time.
    pub fn press(&self, stamp_ns: u64) {
        self.lock().presses.push_back(stamp_ns);
    }

    pub fn lamp_is_lit(&self) -> bool {
        self.lock().lamp_is_lit
    }

    /// Emits what is due on `clock` until told to stop.
    pub fn run(
        &self,
        led: &Led,
        clock: &dyn Clock,
        stop: &Stop,
        emit: &mut dyn FnMut(GpioEvent),
    ) -> Result<(), DeviceError> {
        while !stop.is_stopped() {
            let now_ns = clock.monotonic_ns();
            self.lock().lamp_is_lit = led.is_lit(now_ns);
            while let Some(event) = self.take_due(now_ns) {
                emit(event);
            }
            stop.wait(LOOK_EVERY);
        }
        self.lock().lamp_is_lit = false;
        Ok(())
    }

    fn take_due(&self, now_ns: u64) -> Option<GpioEvent> {
        let mut inner = self.lock();
        let press_ns = inner.presses.front().copied().filter(|&stamp_ns| stamp_ns <= now_ns);
        let pulse_ns = inner.pulses.peek().copied().filter(|&stamp_ns| stamp_ns <= now_ns);
        match (press_ns, pulse_ns) {
            (Some(press_ns), pulse_ns) if pulse_ns.is_none_or(|pulse_ns| press_ns <= pulse_ns) => {
                inner.presses.pop_front();
                Some(GpioEvent::Button { stamp_ns: press_ns })
            }
            (_, Some(stamp_ns)) => {
                inner.pulses.next();
                Some(GpioEvent::Pulse { stamp_ns })
            }
            _ => None,
        }
    }

    /// Nobody panics while holding it but an iterator of pulses, which may then be asked again.
    fn lock(&self) -> MutexGuard<'_, Inner> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::{super::LedPattern, *};
    use crate::types::{ManualClock, NS_PER_S};

    #[test]
    fn events_come_when_they_are_due_in_the_order_of_time() {
        let pins = SimulatedPins::new((1..).map(|second| second * NS_PER_S));
        let (clock, led, stop) = (ManualClock::default(), Led::default(), Stop::default());
        pins.press(1_500_000_000);
        pins.press(9 * NS_PER_S);
        led.show(LedPattern::On);
        clock.advance_ns(3 * NS_PER_S + 1);
        let mut events = Vec::new();
        let ended = pins.run(&led, &clock, &stop, &mut |event| {
            assert!(pins.lamp_is_lit());
            events.push(event);
            if events.len() == 4 {
                stop.stop();
            }
        });
        assert!(ended.is_ok() && !pins.lamp_is_lit(), "the lamp is off at the end");
        let expected = [
            GpioEvent::Pulse { stamp_ns: NS_PER_S },
            GpioEvent::Button { stamp_ns: 1_500_000_000 },
            GpioEvent::Pulse { stamp_ns: 2 * NS_PER_S },
            GpioEvent::Pulse { stamp_ns: 3 * NS_PER_S },
        ];
        assert_eq!(events, expected, "nothing of what lies in the future");
    }
}
