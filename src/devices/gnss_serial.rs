//! The serial line of the satellite receiver: raw bytes with the time of their arrival.
//!
//! Nothing is decoded here but what finds the speed of the line: with `baud = "auto"` the rates are tried in turn until
//! sentences or packets with right sums come.
//!
//! An Arduino starts over when its port is opened: up to two seconds of silence or of its boot loader's noise are no fault.
//! The port is left so that closing it does not start the Arduino over once more.

use std::{
    io,
    os::{
        fd::{AsRawFd, BorrowedFd},
        unix::fs::{FileTypeExt, MetadataExt},
    },
    path::{Path, PathBuf},
    time::Duration,
};

use rustix::{
    event::{PollFd, PollFlags, Timespec, poll},
    fs::{Mode, OFlags},
    io::Errno,
    termios::{ControlModes, OptionalActions, isatty, tcgetattr, tcsetattr},
};
use serde::{Deserialize, Deserializer, Serialize, Serializer, de};
use serialport::{SerialPort, TTYPort};

use super::{DeviceError, SerialChunk, SerialEvent, Stop, rate_hunt::RateHunt, refused_by_sandbox};
use crate::types::{Clock, NS_PER_S};

#[derive(Debug, Clone, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct Settings {
    /// A name that does not change when it is plugged in again, such as one in `/dev/serial/by-id`.
    pub port: PathBuf,
    #[serde(default)]
    pub baud: Baud,
    /// A longer silence is a fault.
    #[serde(default = "default_silence_timeout_s")]
    pub silence_timeout_s: f64,
}

fn default_silence_timeout_s() -> f64 {
    3.0
}

/// Speed of the line: `"auto"` or a number in the configuration.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Baud {
    #[default]
    Auto,
    Fixed(u32),
}

impl Settings {
    pub fn check(&self) -> Result<(), String> {
        if !self.port.is_absolute() {
            return Err(format!("port is {:?}, expected a path such as \"/dev/ttyACM0\"", self.port));
        }
        if let Baud::Fixed(baud) = self.baud
            && !(1200..=4_000_000).contains(&baud)
        {
            return Err(format!("baud is {baud}, expected \"auto\" or 1200 to 4000000"));
        }
        if !(0.2..=600.0).contains(&self.silence_timeout_s) {
            return Err(format!("silence_timeout_s is {}, expected 0.2 to 600 s", self.silence_timeout_s));
        }
        Ok(())
    }
}

impl<'de> Deserialize<'de> for Baud {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Visitor;
        impl de::Visitor<'_> for Visitor {
            type Value = Baud;

            fn expecting(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
                f.write_str("\"auto\" or a number of baud")
            }

            fn visit_str<E: de::Error>(self, word: &str) -> Result<Baud, E> {
                match word {
                    "auto" => Ok(Baud::Auto),
                    _ => Err(E::invalid_value(de::Unexpected::Str(word), &self)),
                }
            }

            fn visit_u64<E: de::Error>(self, baud: u64) -> Result<Baud, E> {
                let unexpected = || E::invalid_value(de::Unexpected::Unsigned(baud), &self);
                u32::try_from(baud).map(Baud::Fixed).map_err(|_| unexpected())
            }

            fn visit_i64<E: de::Error>(self, baud: i64) -> Result<Baud, E> {
                let unexpected = || E::invalid_value(de::Unexpected::Signed(baud), &self);
                u32::try_from(baud).map(Baud::Fixed).map_err(|_| unexpected())
            }
        }
        deserializer.deserialize_any(Visitor)
    }
}

impl Serialize for Baud {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        match self {
            Self::Auto => serializer.serialize_str("auto"),
            Self::Fixed(baud) => serializer.serialize_u32(*baud),
        }
    }
}

/// How long one wait for bytes takes at most; `stop` is looked at in between.
const READ_TIMEOUT: Duration = Duration::from_millis(50);

/// More than the line's driver buffers.
const READ_BYTES: usize = 4096;

/// The first byte may be this late: an Arduino's boot loader takes up to two seconds.
const START_SILENCE_NS: u64 = 3 * NS_PER_S;

/// Delivers what arrives until told to stop. `Opened` comes when the port is open, and again when another speed than the
/// one it was opened with has been found to be the right one.
pub fn run(
    settings: &Settings,
    clock: &dyn Clock,
    stop: &Stop,
    emit: &mut dyn FnMut(SerialEvent),
) -> Result<(), DeviceError> {
    let mut hunt = RateHunt::new(settings.baud, clock.monotonic_ns());
    let mut line = Tty::open(&settings.port, hunt.baud())?;
    read_line(&mut line, settings, &mut hunt, clock, stop, emit)
}

/// A serial line that is open.
pub(super) trait Line {
    /// What has arrived; waits for it, but not for long. None: nothing yet. 0: the device is gone.
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<Option<usize>>;

    fn set_baud(&mut self, baud: u32) -> io::Result<()>;
}

pub(super) fn read_line(
    line: &mut dyn Line,
    settings: &Settings,
    hunt: &mut RateHunt,
    clock: &dyn Clock,
    stop: &Stop,
    emit: &mut dyn FnMut(SerialEvent),
) -> Result<(), DeviceError> {
    let device = || settings.port.display().to_string();
    let silence_timeout_ns = (settings.silence_timeout_s * NS_PER_S as f64) as u64;
    let mut buffer = [0; READ_BYTES];
    let mut announced_baud = hunt.baud();
    let mut last_byte_ns = clock.monotonic_ns();
    let mut silence_limit_ns = silence_timeout_ns.max(START_SILENCE_NS);
    emit(SerialEvent::Opened { port: settings.port.clone(), baud: announced_baud });

    while !stop.is_stopped() {
        let read = line.read(&mut buffer).map_err(|source| line_error(device(), source))?;
        let now_ns = clock.monotonic_ns();
        match read {
            Some(0) => return Err(DeviceError::Disconnected { device: device() }),
            Some(count) => {
                let bytes = &buffer[..count];
                emit(SerialEvent::Chunk(SerialChunk { arrival_ns: now_ns, baud: hunt.baud(), bytes: bytes.to_vec() }));
                hunt.heard(bytes, now_ns);
                last_byte_ns = now_ns;
                silence_limit_ns = silence_timeout_ns;
            }
            None => {}
        }
        if hunt.has_found() && hunt.baud() != announced_baud {
            announced_baud = hunt.baud();
            emit(SerialEvent::Opened { port: settings.port.clone(), baud: announced_baud });
        }
        let silence_ns = now_ns.saturating_sub(last_byte_ns);
        // At a wrong rate a driver may drop every byte, so silence means something only when all have been tried.
        if silence_ns > silence_limit_ns && !hunt.is_hunting() {
            return Err(DeviceError::TimedOut { device: device(), silence_s: silence_ns as f64 / NS_PER_S as f64 });
        }
        let before = hunt.baud();
        let next = hunt.next(now_ns).map_err(|what| match what.heard_bytes {
            0 => DeviceError::TimedOut { device: device(), silence_s: silence_ns as f64 / NS_PER_S as f64 },
            _ => DeviceError::BadData { device: device(), what: what.to_string() },
        })?;
        if next != before {
            line.set_baud(next).map_err(|source| line_error(device(), source))?;
        }
    }
    Ok(())
}

/// An unplugged device answers with one of several errors.
pub(crate) fn line_error(device: String, source: io::Error) -> DeviceError {
    use rustix::io::Errno;
    let is_gone = source
        .raw_os_error()
        .map(Errno::from_raw_os_error)
        .is_some_and(|errno| [Errno::IO, Errno::NXIO, Errno::NODEV, Errno::PIPE].contains(&errno));
    if is_gone || source.kind() == io::ErrorKind::BrokenPipe {
        DeviceError::Disconnected { device }
    } else {
        DeviceError::Io { device, source }
    }
}

/// A serial port of this computer.
pub(crate) struct Tty {
    port: TTYPort,
}

impl Tty {
    pub fn open(path: &Path, baud: u32) -> Result<Self, DeviceError> {
        let device = path.display().to_string();
        match std::fs::metadata(path) {
            Ok(metadata) if metadata.file_type().is_char_device() => {}
            Ok(_) => return Err(DeviceError::Unsupported { device, what: "it is no serial port".to_owned() }),
            Err(error) if error.kind() == io::ErrorKind::PermissionDenied => {
                return Err(not_permitted(path, device));
            }
            Err(_) => return Err(DeviceError::NotPresent { device }),
        }
        let port = serialport::new(path.to_string_lossy(), baud).exclusive(true).open_native();
        let mut tty = match port {
            Ok(port) => Self { port },
            Err(error) => return Err(open_error(path, device, error)),
        };
        tty.keep_running_when_closed().map_err(|source| DeviceError::Io { device, source })?;
        Ok(tty)
    }

    pub fn fd(&self) -> BorrowedFd<'_> {
        // SAFETY: the port owns the descriptor, is not closed while it is borrowed, and does not lend it otherwise.
        unsafe { BorrowedFd::borrow_raw(self.port.as_raw_fd()) }
    }

    /// Keeps the control line DTR as it is at the next close: when it is raised again an Arduino starts over.
    fn keep_running_when_closed(&mut self) -> io::Result<()> {
        let mut attributes = tcgetattr(self.fd())?;
        attributes.control_modes.remove(ControlModes::HUPCL);
        Ok(tcsetattr(self.fd(), OptionalActions::Now, &attributes)?)
    }
}

impl Line for Tty {
    /// Not with the port's own `read`: that reports a hang-up before it hands over the last bytes.
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<Option<usize>> {
        let fd = self.fd();
        let timeout = Timespec::try_from(READ_TIMEOUT).map_err(io::Error::other)?;
        let mut fds = [PollFd::new(&fd, PollFlags::IN)];
        match poll(&mut fds, Some(&timeout)) {
            Ok(0) | Err(rustix::io::Errno::INTR) => return Ok(None),
            Ok(_) => {}
            Err(error) => return Err(error.into()),
        }
        // Without IN it is a hang-up or an error, which `read` puts into words.
        match rustix::io::read(fd, buffer) {
            Ok(count) => Ok(Some(count)),
            Err(Errno::INTR | Errno::AGAIN) => Ok(None),
            Err(error) => Err(error.into()),
        }
    }

    fn set_baud(&mut self, baud: u32) -> io::Result<()> {
        self.port.set_baud_rate(baud).map_err(io::Error::from)
    }
}

fn open_error(path: &Path, device: String, error: serialport::Error) -> DeviceError {
    use serialport::ErrorKind;
    match error.kind() {
        ErrorKind::NoDevice => DeviceError::Busy { device },
        ErrorKind::Io(io::ErrorKind::PermissionDenied) => not_permitted(path, device),
        ErrorKind::Io(io::ErrorKind::NotFound) => DeviceError::NotPresent { device },
        ErrorKind::InvalidInput => DeviceError::Unsupported { device, what: error.description },
        // Unplugged between a look at the path and its opening.
        _ if !path.exists() => DeviceError::NotPresent { device },
        _ => match is_terminal(path) {
            // serialport has no word for it.
            Err(Errno::PERM) => refused_by_sandbox(device),
            Ok(true) => DeviceError::Io { device, source: io::Error::other(error.description) },
            Ok(false) | Err(_) => DeviceError::Unsupported { device, what: "it is no serial port".to_owned() },
        },
    }
}

/// Only for the words of an error: opening an Arduino's port once more starts it over.
fn is_terminal(path: &Path) -> Result<bool, Errno> {
    let flags = OFlags::RDONLY | OFlags::NOCTTY | OFlags::NONBLOCK | OFlags::CLOEXEC;
    rustix::fs::open(path, flags, Mode::empty()).map(isatty)
}

fn not_permitted(path: &Path, device: String) -> DeviceError {
    let owner = std::fs::metadata(path).map_or(String::new(), |metadata| format!(" (group {})", metadata.gid()));
    let hint = format!(
        "add the user to the group that owns it{owner}, on Debian `sudo usermod -aG dialout USER`, and log in again"
    );
    DeviceError::NotPermitted { device, hint }
}

#[cfg(test)]
#[path = "gnss_serial_tests.rs"]
mod tests;
