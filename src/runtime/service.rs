//! What systemd is told, when it is what started this program: that it is ready, how it goes, and that it gets somewhere.
//!
//! The watchdog is fed once a second as long as every device either delivers, or is in a state that starting again would not
//! mend: unplugged, or of another user. A device that is there and does not deliver although it was opened again and again
//! starves the watchdog, and so does a thread that hangs; systemd then starts everything anew.

use sd_notify::NotifyState;
use tracing::debug;

/// Health words of devices that deliver. A receiver without a fix has no sky above it.
const DELIVERING: [&str; 2] = ["ok", "no fix"];
/// Health words of devices for which a new start changes nothing.
const WAITED_FOR: [&str; 6] = ["not present", "disconnected", "busy", "not permitted", "unsupported", "stopped"];

/// Tells systemd; does nothing where nobody listens.
#[derive(Debug)]
pub struct Service {
    is_watched: bool,
}

impl Service {
    /// The program is ready: it will use its devices as soon as they are there.
    pub fn ready() -> Self {
        tell(&[NotifyState::Ready]);
        Self { is_watched: sd_notify::watchdog_enabled().is_some() }
    }

    /// A second has passed. `healths`: of the devices; `line`: how it goes, in words.
    pub fn second<'a>(&self, healths: impl IntoIterator<Item = &'a str>, line: &str) {
        tell(&[NotifyState::Status(line)]);
        if self.is_watched && healths.into_iter().all(gets_somewhere) {
            tell(&[NotifyState::Watchdog]);
        }
    }

    pub fn stopping(&self) {
        tell(&[NotifyState::Stopping]);
    }
}

/// Whether a device delivers, or cannot, whoever asks.
fn gets_somewhere(health: &str) -> bool {
    DELIVERING.contains(&health) || WAITED_FOR.contains(&health)
}

fn tell(state: &[NotifyState]) {
    if let Err(error) = sd_notify::notify(state) {
        debug!(%error, "systemd does not listen");
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::devices::DeviceError;

    #[test]
    fn only_what_a_new_start_may_mend_starves_the_watchdog() {
        let device = || "camera".to_owned();
        let table = [
            (DeviceError::NotPresent { device: device() }, true),
            (DeviceError::Disconnected { device: device() }, true),
            (DeviceError::Busy { device: device() }, true),
            (DeviceError::NotPermitted { device: device(), hint: String::new() }, true),
            (DeviceError::Unsupported { device: device(), what: String::new() }, true),
            (DeviceError::TimedOut { device: device(), silence_s: 2.0 }, false),
            (DeviceError::BadData { device: device(), what: String::new() }, false),
            (DeviceError::Io { device: device(), source: std::io::ErrorKind::Other.into() }, false),
        ];
        for (error, expected) in table {
            assert_eq!(gets_somewhere(error.health()), expected, "{error}");
        }
    }
}
