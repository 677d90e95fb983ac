//! Pins: may they be used, and does the receiver's pulse come?

use std::{sync::Arc, time::Duration};

use super::{Finding, advice, fault, look_at};
use crate::{
    devices::{DeviceError, GpioEvent, gpio::Settings},
    runtime::live::DeviceRun,
    types::Clock,
};

/// A pulse comes each second, once the receiver has a fix.
const LIMIT: Duration = Duration::from_millis(2500);

/// What was seen of the pins.
#[derive(Debug, Default)]
pub struct Look {
    pub presses: usize,
    pub pulses: usize,
    pub error: Option<DeviceError>,
}

impl Look {
    pub fn at(pins: DeviceRun<GpioEvent>, clock: &Arc<dyn Clock>) -> Self {
        let mut look = Self::default();
        let outcome = look_at(pins, clock, LIMIT, |event, _| {
            match event {
                GpioEvent::Button { .. } => look.presses += 1,
                GpioEvent::Pulse { .. } => look.pulses += 1,
            }
            true
        });
        look.error = outcome.err();
        look
    }
}

pub fn findings(look: &Look, settings: &Settings) -> Vec<Finding> {
    if let Some(error) = &look.error {
        let advice = match error {
            DeviceError::NotPresent { .. } => "this computer has no pins: driver = \"none\" in [gpio]".into(),
            error => advice(error, "gpio", "/dev".as_ref()),
        };
        return vec![Finding::problem("pins", fault(error), advice)];
    }
    let named = settings.pins().into_iter().filter_map(|(key, pin)| Some(format!("{key} {}", pin?)));
    let mut found = named.collect::<Vec<_>>().join(", ");
    if look.presses > 0 {
        found += ", the button was pressed";
    }
    let mut findings = vec![Finding::ok("pins", found)];
    if settings.pps_pin.is_some() {
        let found = format!("{} in {} s", look.pulses, LIMIT.as_secs_f64());
        let what = "wires and divider; the MTi's output must be set to 1PPS, and pulses only with a fix";
        findings.push(match look.pulses {
            0 => Finding::warning("pulse", found, what),
            _ => Finding::ok("pulse", found),
        });
    }
    findings
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::doctor::Verdict;

    fn settings() -> Settings {
        toml::from_str("driver = 'rppal'\nrecord_button_pin = 17\npps_pin = 18").expect("settings")
    }

    fn found(look: &Look) -> Vec<(&'static str, Verdict, String)> {
        let findings = findings(look, &settings());
        findings.into_iter().map(|finding| (finding.check, finding.verdict, finding.found)).collect()
    }

    #[test]
    fn pins_and_pulse_are_judged() {
        let both = "record_button_pin 17, pps_pin 18".to_owned();
        let pulsing = found(&Look { pulses: 2, ..Look::default() });
        assert_eq!(pulsing[0], ("pins", Verdict::Ok, both.clone()));
        assert_eq!(pulsing[1], ("pulse", Verdict::Ok, "2 in 2.5 s".into()));
        let silent = found(&Look { presses: 1, ..Look::default() });
        assert_eq!(silent[0].2, both + ", the button was pressed");
        assert_eq!(silent[1].1, Verdict::Warning);
    }

    #[test]
    fn pins_that_cannot_be_used_are_a_problem_with_advice() {
        let hint = || "add the user to the group gpio".to_owned();
        for (error, word) in [
            (DeviceError::NotPresent { device: "gpio".into() }, "driver = \"none\""),
            (DeviceError::NotPermitted { device: "gpio".into(), hint: hint() }, "group gpio"),
            (DeviceError::Unsupported { device: "gpio".into(), what: "not a Raspberry Pi".into() }, "configuration"),
        ] {
            let found = findings(&Look { error: Some(error), ..Look::default() }, &settings());
            assert_eq!((found.len(), found[0].verdict), (1, Verdict::Problem), "{found:?}");
            assert!(found[0].advice.contains(word) && !found[0].found.contains(&hint()), "{found:?}");
        }
    }
}
