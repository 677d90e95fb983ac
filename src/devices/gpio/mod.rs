//! Pins: a button that marks the recording, a lamp that shows its state, the receiver's pulse.
//!
//! | driver | what |
//! |---|---|
//! | `none` | nothing is connected |
//! | `simulated` | [`SimulatedPins`]: a test or the simulated world presses and pulses |
//! | `rppal` | the header of a Raspberry Pi; with the feature `vehicle` |
//!
//! Pins have their BCM numbers. The button connects its pin to ground, and the pin is pulled up; a press is its falling
//! edge. The pulse (PPS) is a rising edge. The lamp lights when its pin is high.
//!
//! | fault | emitted | error: health |
//! |---|---|---|
//! | not a Raspberry Pi, or one that rppal does not know | | `Unsupported`: unsupported |
//! | no permission for /dev/gpiomem or /dev/gpiochip0 | | `NotPermitted`, names the group: not permitted |
//! | no such device | | `NotPresent`: not present |
//! | another program uses the pin | | `Busy`: busy |
//! | contact bounce | one `Button` a press | |
//! | the kernel's stamp of an edge is not on the monotonic clock | the event, stamped when it was read | |
//! | anything else | | `Io`: failed |

mod led;
#[cfg(feature = "vehicle")]
mod raspberry_pi;
mod simulated;

pub use led::{Led, LedPattern};
use serde::{Deserialize, Serialize};
pub use simulated::SimulatedPins;

use super::{DeviceError, GpioEvent, Stop};
use crate::types::Clock;

#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Driver {
    #[default]
    None,
    Simulated,
    Rppal,
}

#[derive(Debug, Clone, PartialEq, Eq, Default, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct Settings {
    #[serde(default)]
    pub driver: Driver,
    /// BCM numbers, 0..=27; what is not connected has no key.
    #[serde(default)]
    pub record_button_pin: Option<u8>,
    #[serde(default)]
    pub status_led_pin: Option<u8>,
    #[serde(default)]
    pub pps_pin: Option<u8>,
    /// The button must rest so long to count as pressed.
    #[serde(default = "default_debounce_ms")]
    pub debounce_ms: u64,
}

fn default_debounce_ms() -> u64 {
    30
}

/// The header of a Raspberry Pi has GPIO 0 to 27.
const LAST_PIN: u8 = 27;
const MAX_DEBOUNCE_MS: u64 = 1000;

impl Settings {
    /// The keys of the three pins, and which they are.
    pub fn pins(&self) -> [(&'static str, Option<u8>); 3] {
        [
            ("record_button_pin", self.record_button_pin),
            ("status_led_pin", self.status_led_pin),
            ("pps_pin", self.pps_pin),
        ]
    }

    pub fn check(&self) -> Result<(), String> {
        let pins = self.pins();
        for (place, (key, pin)) in pins.iter().enumerate() {
            let Some(pin) = pin else { continue };
            if *pin > LAST_PIN {
                return Err(format!("{key} is {pin}, expected a BCM number 0..={LAST_PIN}"));
            }
            if let Some((other, _)) = pins[..place].iter().find(|(_, taken)| *taken == Some(*pin)) {
                return Err(format!("{key} is {pin}, which is {other} already"));
            }
        }
        if self.debounce_ms > MAX_DEBOUNCE_MS {
            return Err(format!("debounce_ms is {}, expected 0..={MAX_DEBOUNCE_MS}", self.debounce_ms));
        }
        if self.driver == Driver::Rppal && pins.iter().all(|(_, pin)| pin.is_none()) {
            return Err("driver is rppal and no pin is given; expected one, or driver = \"none\"".into());
        }
        Ok(())
    }
}

/// Watches the pins and drives the lamp until told to stop.
///
/// With the driver `simulated` the pins are `simulated`; a caller that has nothing to simulate passes the default.
pub fn run(
    settings: &Settings,
    led: &Led,
    simulated: &SimulatedPins,
    clock: &dyn Clock,
    stop: &Stop,
    emit: &mut dyn FnMut(GpioEvent),
) -> Result<(), DeviceError> {
    match settings.driver {
        Driver::None => {
            while !stop.wait(std::time::Duration::from_secs(1)) {}
            Ok(())
        }
        Driver::Simulated => simulated.run(led, clock, stop, emit),
        #[cfg(feature = "vehicle")]
        Driver::Rppal => raspberry_pi::run(settings, led, clock, stop, emit),
        #[cfg(not(feature = "vehicle"))]
        Driver::Rppal => Err(DeviceError::Unsupported {
            device: "gpio".into(),
            what: "this omniloc was built without the feature `vehicle`: `cargo build --release --features vehicle`"
                .into(),
        }),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::types::SystemClock;

    fn settings(toml: &str) -> Settings {
        toml::from_str(toml).expect("parses")
    }

    #[test]
    fn nothing_connected_needs_no_keys() {
        let settings = settings("");
        assert_eq!((settings.driver, settings.debounce_ms, settings.check()), (Driver::None, 30, Ok(())));
        assert!(toml::from_str::<Settings>("led_pin = 3").is_err(), "unknown keys are refused");
    }

    #[test]
    fn impossible_pins_are_refused() {
        for (toml, expected) in [
            ("record_button_pin = 28", "record_button_pin is 28, expected a BCM number 0..=27"),
            ("record_button_pin = 4\npps_pin = 4", "pps_pin is 4, which is record_button_pin already"),
            ("status_led_pin = 4\npps_pin = 4", "pps_pin is 4, which is status_led_pin already"),
            ("debounce_ms = 1001", "debounce_ms is 1001, expected 0..=1000"),
            ("driver = 'rppal'", "no pin is given"),
        ] {
            assert!(settings(toml).check().expect_err(toml).contains(expected), "{toml}");
        }
        assert_eq!(settings("driver = 'rppal'\nrecord_button_pin = 0\npps_pin = 27").check(), Ok(()));
    }

    #[test]
    fn without_pins_it_only_waits_to_be_stopped() {
        let stop = Stop::default();
        stop.stop();
        let ended = run(&settings(""), &Led::default(), &SimulatedPins::default(), &SystemClock, &stop, &mut |_| {
            panic!("no pins")
        });
        assert!(ended.is_ok());
    }

    #[test]
    fn off_a_raspberry_pi_the_reason_is_told() {
        if std::path::Path::new("/proc/device-tree/model").exists() {
            return;
        }
        let settings = settings("driver = 'rppal'\nstatus_led_pin = 17");
        let (clock, stop) = (SystemClock, Stop::default());
        let error = run(&settings, &Led::default(), &SimulatedPins::default(), &clock, &stop, &mut |_| {})
            .expect_err("no Raspberry Pi");
        assert_eq!(error.health(), "unsupported");
        let expected = if cfg!(feature = "vehicle") { "Unknown Raspberry Pi model" } else { "feature `vehicle`" };
        assert!(error.to_string().contains(expected), "{error}");
    }
}
