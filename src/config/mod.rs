//! One TOML file becomes the settings that the modules own.
//!
//! Every table has a `driver` where there is a choice of devices, and keys whose names end with their unit. Whatever is
//! not known, has the wrong type or cannot be is refused with file, line and what is expected, before any device is
//! opened.

mod localize;
mod record;
mod tables;

use std::{
    fs,
    path::{Path, PathBuf},
};

use serde::{Deserialize, Serialize};

use self::tables::{Nothing, Table};
pub use self::{
    localize::LocalizeConfig,
    record::{Gnss, RecordConfig},
    tables::Fault,
};
use crate::devices::{camera_v4l2, simulated};

/// Larger files are no configurations \[bytes\].
const MAX_CONFIG_BYTES: u64 = 1 << 20;

#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    #[error("{}: cannot be read", path.display())]
    CannotRead { path: PathBuf, source: std::io::Error },
    #[error("{}:{line}: {what}", path.display())]
    Bad { path: PathBuf, line: usize, what: String },
}

/// What is driven.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Vehicle {
    /// Goes into every recording.
    pub name: String,
    /// `donut.json` of the lens, attached to every recording; without it, `calibrate` finds the donut later.
    pub calibration: Option<PathBuf>,
}

/// Where frames come from.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(tag = "driver", rename_all = "lowercase")]
pub enum Camera {
    V4l2(camera_v4l2::Settings),
    Simulated,
    Replay(Replay),
    None,
}

/// A recording that is played.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Replay {
    pub recording: PathBuf,
}

impl Camera {
    /// Refuses a driver that this build does not have.
    pub fn check_driver(&self) -> Result<(), String> {
        match self {
            Self::V4l2(_) if !cfg!(feature = "vehicle") => Err("[camera]: driver is \"v4l2\", but this program was \
                built without the camera driver: cargo build --release --features vehicle"
                .into()),
            _ => Ok(()),
        }
    }
}

impl Vehicle {
    fn check(&self) -> Result<(), String> {
        let length = self.name.chars().count();
        if (1..=64).contains(&length) && !self.name.chars().any(char::is_control) {
            return Ok(());
        }
        Err(format!("name has {length} characters, expected 1 to 64 that can be printed"))
    }
}

/// Reads and checks a file with `parse`.
fn load<T>(path: &Path, parse: impl FnOnce(&str) -> Result<T, Fault>) -> Result<T, ConfigError> {
    let cannot_read = |source| ConfigError::CannotRead { path: path.into(), source };
    let facts = fs::metadata(path).map_err(cannot_read)?;
    if !facts.is_file() || facts.len() > MAX_CONFIG_BYTES {
        let what = format!("not a regular file of at most {MAX_CONFIG_BYTES} bytes");
        return Err(cannot_read(std::io::Error::other(what)));
    }
    let text = fs::read_to_string(path).map_err(cannot_read)?;
    parse(&text).map_err(|Fault { offset, what }| ConfigError::Bad {
        path: path.into(),
        line: 1 + text.as_bytes()[..offset.min(text.len())].iter().filter(|&&byte| byte == b'\n').count(),
        what,
    })
}

fn read_camera(mut table: Table<'_>) -> Result<Camera, Fault> {
    let driver = table.driver(&["v4l2", "simulated", "replay", "none"])?;
    Ok(match driver.as_str() {
        "v4l2" => Camera::V4l2(table.read(camera_v4l2::Settings::check)?),
        "replay" => Camera::Replay(table.read(|_| Ok(()))?),
        "simulated" => table.read(|Nothing {}| Ok(())).map(|Nothing {}| Camera::Simulated)?,
        _ => table.read(|Nothing {}| Ok(())).map(|Nothing {}| Camera::None)?,
    })
}

/// The table [simulation], which is there exactly if something is `simulated`.
fn read_simulation(table: Option<Table<'_>>, is_simulated: bool) -> Result<Option<simulated::Settings>, Fault> {
    match table.map(|table| table.read(simulated::Settings::check)).transpose()? {
        None if is_simulated => Err(Fault::new(usize::MAX, "a simulated driver needs the table [simulation]")),
        Some(_) if !is_simulated => Err(Fault::new(0, "[simulation] is given, but no driver is `simulated`")),
        simulation => Ok(simulation),
    }
}

#[cfg(test)]
mod tests {
    use std::path::{Path, PathBuf};

    /// A file of the folder `config/`.
    pub fn shipped(name: &str) -> PathBuf {
        Path::new(env!("CARGO_MANIFEST_DIR")).join("config").join(name)
    }

    /// The text of a shipped file with the defaults that it states as comments, but for keys without one.
    pub fn with_defaults(text: &str, without_default: &[&str]) -> String {
        let is_setting = |line: &str| {
            let key = line.split_once(" = ").map_or("", |(key, _)| key);
            !key.is_empty()
                && key.chars().all(|c| c.is_ascii_lowercase() || c == '_' || c.is_ascii_digit())
                && !without_default.contains(&key)
        };
        let uncommented = |line: &str| match line.strip_prefix("# ") {
            Some(setting) if is_setting(setting) => format!("{setting}\n"),
            _ => format!("{line}\n"),
        };
        let all: String = text.lines().map(uncommented).collect();
        assert_ne!(all, text, "it explains something");
        all
    }
}
