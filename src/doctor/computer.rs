//! The computer: warmth, power, date, and what this process may do.

use std::{
    fs,
    time::{SystemTime, UNIX_EPOCH},
};

use rustix::process::geteuid;

use super::Finding;
use crate::runtime::system::{SystemMonitor, knows_date};

/// Boards slow down from 80 degrees on.
const HOT_CELSIUS: f64 = 75.0;
/// What a Raspberry Pi says of its power and warmth: now, and since it was switched on (16 bits higher).
const THROTTLING: [(u32, &str, &str); 4] = [
    (0x1, "too little voltage", POWER),
    (0x2, "a lower processor clock", POWER),
    (0x4, "throttled", COOLING),
    (0x8, "close to the temperature limit", COOLING),
];
const POWER: &str = "a power supply of 5.1 V and 3 A or more, with a short thick cable";
const COOLING: &str = "a heat sink or a fan, and no sun on the case";

pub fn examine() -> Vec<Finding> {
    let status = SystemMonitor::default().look(0);
    let now_ns = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |since| since.as_nanos() as i64);
    let process = fs::read_to_string("/proc/self/status").unwrap_or_default();
    vec![
        temperature(status.temperature_celsius),
        status.throttled.map_or_else(|| Finding::ok("power", "this computer does not say"), power),
        date(knows_date(now_ns)),
        sandbox(&process, geteuid().is_root()),
    ]
}

fn temperature(celsius: Option<f64>) -> Finding {
    match celsius {
        None => Finding::ok("temperature", "this computer does not say"),
        Some(celsius) if celsius > HOT_CELSIUS => {
            Finding::warning("temperature", format!("{celsius:.0} degrees"), COOLING)
        }
        Some(celsius) => Finding::ok("temperature", format!("{celsius:.0} degrees")),
    }
}

/// The bits of the Raspberry Pi's `get_throttled`.
fn power(bits: u32) -> Finding {
    let said = |shift: u32| {
        let set = THROTTLING.iter().filter(|(bit, ..)| bits & (bit << shift) != 0);
        set.map(|(_, what, advice)| (*what, *advice)).collect::<Vec<_>>()
    };
    let (now, before) = (said(0), said(16));
    let words = |list: &[(&str, &str)]| list.iter().map(|(what, _)| *what).collect::<Vec<_>>().join(", ");
    match (now.first(), before.first()) {
        (Some((_, advice)), _) => Finding::warning("power", format!("now: {}", words(&now)), *advice),
        (None, Some((_, advice))) => {
            Finding::warning("power", format!("since it was switched on: {}", words(&before)), *advice)
        }
        (None, None) => Finding::ok("power", "enough voltage, not throttled"),
    }
}

fn date(is_known: bool) -> Finding {
    match is_known {
        false => Finding::warning(
            "clock",
            "the computer does not know the date: it has no battery clock and has not heard the time from a network",
            "recordings keep the receiver's time, so nothing is lost; localize says no time with its positions; a clock with a \
             battery or a network would set it",
        ),
        true => Finding::ok("clock", "the computer knows the date"),
    }
}

/// `status`: /proc/self/status.
fn sandbox(status: &str, is_root: bool) -> Finding {
    let value = |key: &str| status.lines().find_map(|line| line.strip_prefix(key)).map_or("", str::trim);
    let is_filtered = value("Seccomp:") == "2";
    let is_confined = value("NoNewPrivs:") == "1";
    if is_root {
        let advice = "the services run as the user omniloc: `sudo -u omniloc omniloc doctor` has their rights, but not their sandbox";
        return Finding::warning("sandbox", "this is root, who may do everything", advice);
    }
    match is_filtered && is_confined {
        true => Finding::ok("sandbox", "inside one: system calls are filtered, no new privileges"),
        false => Finding::ok("sandbox", "outside of the services' sandbox"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::doctor::Verdict;

    #[test]
    fn warmth_power_and_date_are_judged() {
        assert_eq!(temperature(Some(81.0)).verdict, Verdict::Warning);
        assert_eq!(temperature(Some(50.0)).verdict, Verdict::Ok);
        assert_eq!(power(0).verdict, Verdict::Ok);
        let now = power(0x5_0005);
        assert_eq!((now.found.as_str(), now.advice.as_str()), ("now: too little voltage, throttled", POWER));
        let before = power(0x8_0000);
        assert_eq!(before.found, "since it was switched on: close to the temperature limit");
        assert_eq!(before.advice, COOLING);
        assert_eq!((date(false).verdict, date(true).verdict), (Verdict::Warning, Verdict::Ok));
    }

    #[test]
    fn the_sandbox_is_seen() {
        let inside = "Name:\tomniloc\nNoNewPrivs:\t1\nSeccomp:\t2\n";
        assert!(sandbox(inside, false).found.starts_with("inside"));
        assert!(sandbox("NoNewPrivs:\t0\nSeccomp:\t0\n", false).found.starts_with("outside"));
        assert_eq!(sandbox(inside, true).verdict, Verdict::Warning);
    }
}
