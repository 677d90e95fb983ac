//! The header of a Raspberry Pi, by rppal: edges from the kernel's character device, the lamp by register.

use std::time::Duration;

use rppal::gpio::{Error, Gpio, InputPin, Trigger};
use tracing::{info, warn};

use super::{
    super::{DeviceError, GpioEvent, Stop},
    Led, Settings,
};
use crate::types::Clock;

/// Between two looks at the lamp's pattern; a stop is noticed as fast.
const LOOK_EVERY: Duration = Duration::from_millis(20);

/// Watches the pins and drives the lamp until told to stop.
pub fn run(
    settings: &Settings,
    led: &Led,
    clock: &dyn Clock,
    stop: &Stop,
    emit: &mut dyn FnMut(GpioEvent),
) -> Result<(), DeviceError> {
    let gpio = Gpio::new().map_err(|error| fault("gpio", error))?;
    let input = |key: &str, pin: Option<u8>, trigger: Trigger, debounce: Option<Duration>| {
        let open = |pin| -> Result<InputPin, Error> {
            let pin = gpio.get(pin)?;
            let mut input =
                if trigger == Trigger::FallingEdge { pin.into_input_pullup() } else { pin.into_input_pulldown() };
            input.set_interrupt(trigger, debounce)?;
            Ok(input)
        };
        pin.map(|pin| open(pin).map_err(|error| fault(&format!("{key} {pin}"), error))).transpose()
    };
    let debounce = Some(Duration::from_millis(settings.debounce_ms)).filter(|debounce| !debounce.is_zero());
    let button = input("record_button_pin", settings.record_button_pin, Trigger::FallingEdge, debounce)?;
    let pulse = input("pps_pin", settings.pps_pin, Trigger::RisingEdge, None)?;
    let lamp = settings.status_led_pin.map(|pin| {
        let lamp = gpio.get(pin).map(rppal::gpio::Pin::into_output_low);
        lamp.map_err(|error| fault(&format!("status_led_pin {pin}"), error))
    });
    let mut lamp = lamp.transpose()?;
    info!(?settings, "pins opened");

    let watched: Vec<&InputPin> = button.iter().chain(&pulse).collect();
    let mut stamps = EdgeStamps::default();
    while !stop.is_stopped() {
        if let Some(lamp) = &mut lamp {
            lamp.write(led.is_lit(clock.monotonic_ns()).into());
        }
        if watched.is_empty() {
            stop.wait(LOOK_EVERY);
            continue;
        }
        match gpio.poll_interrupts(&watched, false, Some(LOOK_EVERY)) {
            Ok(Some((pin, event))) => {
                let kernel_ns = u64::try_from(event.timestamp.as_nanos()).unwrap_or(u64::MAX);
                let stamp_ns = stamps.stamp_ns(kernel_ns, clock.monotonic_ns());
                let is_button = Some(pin.pin()) == settings.record_button_pin;
                emit(if is_button { GpioEvent::Button { stamp_ns } } else { GpioEvent::Pulse { stamp_ns } });
            }
            Ok(None) => {}
            Err(Error::Io(error)) if error.kind() == std::io::ErrorKind::Interrupted => {}
            Err(error) => return Err(fault("gpio", error)),
        }
    }
    if let Some(lamp) = &mut lamp {
        lamp.set_low();
    }
    Ok(())
}

/// An edge that is read later than this was not stamped on our clock \[ns\].
const MAX_AGE_NS: u64 = 1_000_000_000;

/// Linux stamps edges on the monotonic clock since 5.7, on realtime before.
#[derive(Debug, Default)]
struct EdgeStamps {
    told: bool,
}

impl EdgeStamps {
    fn stamp_ns(&mut self, kernel_ns: u64, now_ns: u64) -> u64 {
        if kernel_ns <= now_ns && now_ns - kernel_ns <= MAX_AGE_NS {
            return kernel_ns;
        }
        if !self.told {
            self.told = true;
            warn!(
                kernel_ns,
                now_ns, "the kernel's stamps of edges are not on the monotonic clock; reading times serve"
            );
        }
        now_ns
    }
}

fn fault(device: &str, error: Error) -> DeviceError {
    let device = device.to_owned();
    match error {
        Error::UnknownModel | Error::PinNotAvailable(_) => DeviceError::Unsupported { device, what: error.to_string() },
        Error::PinUsed(_) => DeviceError::Busy { device },
        Error::PermissionDenied(path) => DeviceError::NotPermitted {
            device,
            hint: format!(
                "{path}: add the user to the group gpio, `sudo usermod -aG gpio USER`, and log in again; in a service of your \
                 own, with [Service] and DeviceAllow={path} rw"
            ),
        },
        Error::Io(source) => match source.kind() {
            std::io::ErrorKind::NotFound => DeviceError::NotPresent { device },
            std::io::ErrorKind::ResourceBusy => DeviceError::Busy { device },
            _ => DeviceError::Io { device, source },
        },
        error => DeviceError::Io { device, source: std::io::Error::other(error) },
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn faults_are_named() {
        let io = |kind: std::io::ErrorKind| Error::Io(kind.into());
        for (error, health) in [
            (Error::UnknownModel, "unsupported"),
            (Error::PinNotAvailable(99), "unsupported"),
            (Error::PinUsed(4), "busy"),
            (Error::PermissionDenied("/dev/gpiomem".into()), "not permitted"),
            (io(std::io::ErrorKind::NotFound), "not present"),
            (io(std::io::ErrorKind::ResourceBusy), "busy"),
            (io(std::io::ErrorKind::UnexpectedEof), "failed"),
            (Error::ThreadPanic, "failed"),
        ] {
            assert_eq!(fault("gpio", error).health(), health);
        }
    }

    #[test]
    fn edges_stamped_on_another_clock_get_the_time_of_reading() {
        let mut stamps = EdgeStamps::default();
        let now_ns = 50_000_000_000;
        assert_eq!(stamps.stamp_ns(now_ns - 700_000, now_ns), now_ns - 700_000);
        for wrong_ns in [1_700_000_000_000_000_000, now_ns + 1, now_ns - 2 * MAX_AGE_NS, 0] {
            assert_eq!(stamps.stamp_ns(wrong_ns, now_ns), now_ns);
        }
    }
}
