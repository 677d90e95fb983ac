//! Hardware in, stamped values out.
//!
//! A device is one blocking function that runs on a thread of its own, with the same signature for the real, the
//! replayed and the simulated one:
//!
//! ```text
//! fn run(&Settings, &dyn Clock, &Stop, emit: &mut dyn FnMut(Event)) -> Result<(), DeviceError>
//! ```
//!
//! It returns `Ok` when told to stop and `Err` when the device is gone; the runtime decides what happens then. `emit`
//! never blocks. A device decides nothing about what its values mean: bytes of the serial line are decoded, checked and
//! paired elsewhere, so that a replayed drive takes the same way as a live one.

pub mod camera_v4l2;
pub mod gnss_serial;
pub mod gpio;
pub mod mjpeg;
pub mod pty;
mod rate_hunt;
pub mod replay;
pub mod simulated;
pub mod yuyv;

use std::{
    path::PathBuf,
    sync::{Arc, Condvar, Mutex, PoisonError},
    time::Duration,
};

use crate::types::{Clock, PooledBytes};

/// What a camera does.
#[derive(Debug)]
pub enum CameraEvent {
    Opened(CameraFacts),
    Frame(CameraFrame),
    /// Frames that will never come.
    Lost(Lost),
}

/// What was agreed on with the camera.
#[derive(Debug, Clone, PartialEq)]
pub struct CameraFacts {
    /// What the camera calls itself.
    pub name: String,
    pub width_px: u32,
    pub height_px: u32,
    /// 0 if the camera does not say.
    pub frame_rate_hz: f64,
    /// What it sends: `MJPG`, `YUYV`.
    pub pixel_format: String,
}

/// One image, as JPEG that opens everywhere: Huffman tables are there.
#[derive(Debug)]
pub struct CameraFrame {
    /// Counts what the camera exposed since it was opened; a gap means frames that were lost.
    pub sequence: u32,
    /// Start of the exposure, on the monotonic clock.
    pub stamp_ns: u64,
    /// When it was handed over, on the monotonic clock.
    pub arrival_ns: u64,
    pub jpeg: PooledBytes,
    /// Why it may not be used for localizing, although it is recorded.
    pub damage: Option<&'static str>,
}

/// A loss that a device noticed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Lost {
    pub count: u64,
    /// A short fixed phrase.
    pub reason: &'static str,
    /// When it was noticed, on the monotonic clock.
    pub stamp_ns: u64,
}

/// What a serial line does.
#[derive(Debug)]
pub enum SerialEvent {
    Opened { port: PathBuf, baud: u32 },
    Chunk(SerialChunk),
}

/// Bytes that arrived together.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SerialChunk {
    /// When the last of them had arrived, on the monotonic clock.
    pub arrival_ns: u64,
    /// Speed of the line; 0 if it has none.
    pub baud: u32,
    pub bytes: Vec<u8>,
}

/// What happens on a pin.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum GpioEvent {
    /// The button was pressed: mark this piece of the recording to be kept.
    Button { stamp_ns: u64 },
    /// The edge of the receiver's pulse that starts a UTC second.
    Pulse { stamp_ns: u64 },
}

/// Why there is no data.
#[derive(Debug, thiserror::Error)]
pub enum DeviceError {
    #[error("{device} is not there")]
    NotPresent { device: String },
    #[error("{device} is in use by another program")]
    Busy { device: String },
    #[error("{device} may not be opened: {hint}")]
    NotPermitted { device: String, hint: String },
    #[error("{device} has sent nothing for {silence_s:.1} s")]
    TimedOut { device: String, silence_s: f64 },
    #[error("{device} was unplugged")]
    Disconnected { device: String },
    #[error("{device} cannot do what the configuration asks for: {what}")]
    Unsupported { device: String, what: String },
    #[error("{device}: {what}")]
    BadData { device: String, what: String },
    #[error("{device} failed")]
    Io { device: String, source: std::io::Error },
}

impl DeviceError {
    /// The word for it in `/status`.
    pub fn health(&self) -> &'static str {
        match self {
            Self::NotPresent { .. } => "not present",
            Self::Busy { .. } => "busy",
            Self::NotPermitted { .. } => "not permitted",
            Self::TimedOut { .. } => "silent",
            Self::Disconnected { .. } => "disconnected",
            Self::Unsupported { .. } => "unsupported",
            Self::BadData { .. } => "bad data",
            Self::Io { .. } => "failed",
        }
    }
}

/// The rights of a file are not it: those deny with another error (EACCES) than a sandbox does (EPERM).
pub(crate) fn refused_by_sandbox(device: String) -> DeviceError {
    let hint = format!(
        "the sandbox that this runs in refuses it; for a service `sudo systemctl edit` it, with [Service] and \
         DeviceAllow={device} rw"
    );
    DeviceError::NotPermitted { device, hint }
}

/// Waits for a stamp; `true` if told to stop before.
pub fn wait_until(stamp_ns: u64, clock: &dyn Clock, stop: &Stop) -> bool {
    loop {
        match clock.until(stamp_ns) {
            Duration::ZERO => return stop.is_stopped(),
            left if stop.wait(left) => return true,
            _ => {}
        }
    }
}

/// Tells threads to stop, and wakes those that wait.
#[derive(Debug, Clone, Default)]
pub struct Stop {
    inner: Arc<(Mutex<bool>, Condvar)>,
}

impl Stop {
    pub fn stop(&self) {
        *self.inner.0.lock().unwrap_or_else(PoisonError::into_inner) = true;
        self.inner.1.notify_all();
    }

    pub fn is_stopped(&self) -> bool {
        *self.inner.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Waits; returns early, and `true`, when told to stop.
    pub fn wait(&self, at_most: Duration) -> bool {
        let guard = self.inner.0.lock().unwrap_or_else(PoisonError::into_inner);
        let waited = self.inner.1.wait_timeout_while(guard, at_most, |stopped| !*stopped);
        *waited.unwrap_or_else(PoisonError::into_inner).0
    }
}
