//! A camera behind Video4Linux2, such as the Logitech C310.
//!
//! | file | what |
//! |---|---|
//! | `mod.rs` | settings |
//! | [`capture`] | the loop from buffers to frames, and what each fault becomes: no system call |
//! | [`stamps`] | which stamps and sequence numbers of the driver are to be believed |
//! | `device.rs` | opens the camera and agrees on size, rate and controls; with the feature `vehicle` |
//! | `stream.rs` | the driver's queue of mapped buffers; with the feature `vehicle` |
//!
//! What goes wrong, what is emitted, and the error that `run` returns with its word in `/status`:
//!
//! | fault | emitted | error: health |
//! |---|---|---|
//! | no such device | | `NotPresent`: not present |
//! | no permission | | `NotPermitted`, names the group: not permitted |
//! | refused by a sandbox (EPERM) | | `NotPermitted`, names DeviceAllow: not permitted |
//! | another program has it (S_FMT, REQBUFS, STREAMON say EBUSY) | | `Busy`: busy |
//! | no camera, or without streaming, the format, the size | | `Unsupported`, names what there is: unsupported |
//! | not enough USB bandwidth (ENOSPC) | | `Unsupported`: unsupported |
//! | another rate than asked for | `Opened` with the rate it granted | |
//! | buffer marked damaged, or damaged JPEG | `Frame` with `damage` | |
//! | buffer without bytes | `Lost` "empty frame" | |
//! | gap in the sequence numbers | `Lost` "skipped by the camera" | |
//! | EIO when dequeuing | `Lost` "read error", goes on | |
//! | sequence numbers start again | nothing is lost; ours go on | |
//! | stamp of another clock, not rising, or far off | `Frame` stamped by its arrival; said once | |
//! | nothing usable for `frame_timeout_ms` | | `TimedOut`: silent |
//! | unplugged (ENODEV, POLLERR, POLLHUP) | | `Disconnected`: disconnected |
//! | anything else the driver says | | `Io`: failed |
//!
//! Whatever the way out, streaming is switched off and every buffer is unmapped, so that the next `run` starts afresh.

pub mod capture;
#[cfg(feature = "vehicle")]
mod device;
pub mod stamps;
#[cfg(feature = "vehicle")]
mod stream;

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

/// What the camera shall send.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum PixelFormat {
    /// JPEG, made by the camera: the only way to get high rates through USB 2.
    Mjpg,
    /// Raw 4:2:2; is encoded here, at the cost of processor time.
    Yuyv,
    /// MJPG, or YUYV from a camera that has no MJPG.
    #[default]
    Auto,
}

#[derive(Debug, Clone, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct Settings {
    /// Best a path that stays the same: `/dev/v4l/by-id/...-video-index0`.
    pub device: PathBuf,
    pub width_px: u32,
    pub height_px: u32,
    /// The camera may grant another one.
    pub frame_rate_hz: f64,
    #[serde(default)]
    pub pixel_format: PixelFormat,
    /// Take the size that the camera offers instead of refusing it. A map fits one size only.
    #[serde(default)]
    pub accept_other_size: bool,
    /// A longer silence counts as a camera fault.
    #[serde(default = "default_frame_timeout_ms")]
    pub frame_timeout_ms: u64,
    /// Of the lamps: 50 or 60 against flicker, 0 switches the filter off; left as it is when absent.
    #[serde(default)]
    pub power_line_hz: Option<u32>,
    /// Lets the camera lower the rate in low light. Off, it takes darker images at the full rate.
    #[serde(default)]
    pub exposure_auto_priority: bool,
    /// How many frames the driver can hold while we are busy.
    #[serde(default = "default_buffers")]
    pub buffers: u32,
    /// Of the JPEG made from YUYV, 1..=100.
    #[serde(default = "default_jpeg_quality")]
    pub jpeg_quality: u8,
}

fn default_frame_timeout_ms() -> u64 {
    2000
}

fn default_buffers() -> u32 {
    6
}

fn default_jpeg_quality() -> u8 {
    90
}

impl Settings {
    pub fn check(&self) -> Result<(), String> {
        let device = self.device.as_os_str().as_encoded_bytes();
        if device.is_empty() || device.contains(&0) {
            return Err(format!("device is {:?}, expected a path such as /dev/video0", self.device));
        }
        let within = |key: &str, found: u64, least: u64, most: u64| {
            let fits = (least..=most).contains(&found);
            if fits { Ok(()) } else { Err(format!("{key} is {found}, expected {least}..={most}")) }
        };
        within("width_px", self.width_px.into(), 16, 8192)?;
        within("height_px", self.height_px.into(), 16, 8192)?;
        within("frame_timeout_ms", self.frame_timeout_ms, 100, 60_000)?;
        within("buffers", self.buffers.into(), 2, 32)?;
        within("jpeg_quality", self.jpeg_quality.into(), 1, 100)?;
        if !(0.1..=1000.0).contains(&self.frame_rate_hz) {
            return Err(format!("frame_rate_hz is {}, expected 0.1..=1000", self.frame_rate_hz));
        }
        if self.frame_timeout_ms as f64 * self.frame_rate_hz < 2000.0 {
            return Err(format!(
                "frame_timeout_ms is {}, expected at least two frames at frame_rate_hz = {}",
                self.frame_timeout_ms, self.frame_rate_hz
            ));
        }
        match self.power_line_hz {
            None | Some(0 | 50 | 60) => Ok(()),
            Some(found) => Err(format!("power_line_hz is {found}, expected 50, 60, 0 (no filter), or no such key")),
        }
    }
}

#[cfg(feature = "vehicle")]
pub use device::run;
#[cfg(not(feature = "vehicle"))]
pub use missing::run;

/// What a build without the feature `vehicle` has instead.
#[cfg(not(feature = "vehicle"))]
mod missing {
    use super::Settings;
    use crate::{
        devices::{CameraEvent, DeviceError, Stop},
        types::Clock,
    };

    /// Says that this build has no camera driver.
    pub fn run(
        settings: &Settings,
        _: &dyn Clock,
        _: &Stop,
        _: &mut dyn FnMut(CameraEvent),
    ) -> Result<(), DeviceError> {
        Err(DeviceError::Unsupported {
            device: settings.device.display().to_string(),
            what: "this omniloc was built without the feature `vehicle`: `cargo build --release --features vehicle`"
                .into(),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn settings(toml: &str) -> Result<Settings, String> {
        toml::from_str(toml).map_err(|error| error.to_string())
    }

    const LEAST: &str = "device = '/dev/video0'\nwidth_px = 1280\nheight_px = 720\nframe_rate_hz = 30\n";

    #[test]
    fn four_keys_suffice() {
        let settings = settings(LEAST).expect("parses");
        assert_eq!(settings.check(), Ok(()));
        assert_eq!(settings.pixel_format, PixelFormat::Auto);
        assert_eq!((settings.frame_timeout_ms, settings.buffers, settings.jpeg_quality), (2000, 6, 90));
    }

    #[test]
    fn wrong_values_are_refused_with_key_and_expectation() {
        for (line, expected) in [
            ("power_line_hz = 55", "power_line_hz is 55, expected 50, 60"),
            ("buffers = 1", "buffers is 1, expected 2..=32"),
            ("jpeg_quality = 0", "jpeg_quality is 0, expected 1..=100"),
            ("frame_timeout_ms = 50", "frame_timeout_ms is 50, expected 100..=60000"),
        ] {
            let error = settings(&format!("{LEAST}{line}")).expect("parses").check().expect_err(line);
            assert!(error.contains(expected), "{error}");
        }
        for (from, to, expected) in [
            ("'/dev/video0'", "''", "device is \"\""),
            ("'/dev/video0'", "\"/dev/video\\u0000\"", "expected a path"),
            ("1280", "0", "width_px is 0"),
            ("= 30", "= 0.5", "at least two frames"),
            ("= 30", "= nan", "frame_rate_hz is NaN"),
        ] {
            let error = settings(&LEAST.replace(from, to)).expect("parses").check().expect_err(to);
            assert!(error.contains(expected), "{error}");
        }
        let error = settings(&format!("{LEAST}pixel_format = 'h264'")).expect_err("not a format of ours");
        assert!(error.contains("mjpg"), "{error}");
        assert!(settings(&format!("{LEAST}fps = 30")).is_err(), "unknown keys are refused");
    }

    #[cfg(not(feature = "vehicle"))]
    #[test]
    fn a_build_without_the_driver_says_so() {
        let settings = settings(LEAST).expect("parses");
        let (clock, stop) = (crate::types::SystemClock, crate::devices::Stop::default());
        let error = run(&settings, &clock, &stop, &mut |_| {}).expect_err("no driver");
        assert_eq!(error.health(), "unsupported");
        assert!(error.to_string().contains("without the feature `vehicle`"), "{error}");
    }
}
