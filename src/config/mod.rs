//! One TOML file becomes the settings that the modules own.
//!
//! Every table has a `driver` where there is a choice of devices, and keys whose names end with their unit. Whatever is
//! not known, has the wrong type or cannot be is refused with file, line and what is expected, before any device is
//! opened.

use std::{
    fs,
    path::{Path, PathBuf},
};

use serde::{Deserialize, Serialize, de::DeserializeOwned};
use toml::{
    Spanned,
    de::{DeTable, DeValue, Deserializer},
};

use crate::{
    devices::{camera_v4l2, gnss_serial, gpio, simulated},
    gnss::DecoderSettings,
    recording::recorder,
    sync,
};

/// Larger files are no configurations \[bytes\].
const MAX_CONFIG_BYTES: u64 = 1 << 20;

#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    #[error("{}: cannot be read", path.display())]
    CannotRead { path: PathBuf, source: std::io::Error },
    #[error("{}:{line}: {what}", path.display())]
    Bad { path: PathBuf, line: usize, what: String },
}

/// Everything `omniloc record` needs to know.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RecordConfig {
    pub vehicle: Vehicle,
    pub camera: Camera,
    pub gnss: Gnss,
    pub decoder: DecoderSettings,
    pub gpio: gpio::Settings,
    pub sync: sync::Settings,
    pub recorder: recorder::Settings,
    /// How many times as fast as it was recorded a drive is replayed.
    #[serde(skip)]
    pub replay_speed: f64,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub simulation: Option<simulated::Settings>,
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

/// Where bytes of the receiver come from.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(tag = "driver", rename_all = "lowercase")]
pub enum Gnss {
    Serial(gnss_serial::Settings),
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

impl RecordConfig {
    /// Reads and checks a file. Relative paths in it are meant relative to its folder.
    pub fn load(path: &Path) -> Result<Self, ConfigError> {
        let cannot_read = |source| ConfigError::CannotRead { path: path.into(), source };
        let facts = fs::metadata(path).map_err(cannot_read)?;
        if !facts.is_file() || facts.len() > MAX_CONFIG_BYTES {
            let what = format!("not a regular file of at most {MAX_CONFIG_BYTES} bytes");
            return Err(cannot_read(std::io::Error::other(what)));
        }
        let text = fs::read_to_string(path).map_err(cannot_read)?;
        let mut config = Self::parse(&text).map_err(|Fault { offset, what }| ConfigError::Bad {
            path: path.into(),
            line: 1 + text.as_bytes()[..offset.min(text.len())].iter().filter(|&&byte| byte == b'\n').count(),
            what,
        })?;
        config.resolve_paths(path.parent().unwrap_or(Path::new(".")));
        Ok(config)
    }

    /// Reads and checks the text of a file; paths stay as they are.
    pub fn parse(text: &str) -> Result<Self, Fault> {
        let mut tables = Tables { root: DeTable::parse(text).map_err(Fault::from)?.into_inner() };
        let mut gnss = tables.required("gnss")?;
        let config = Self {
            vehicle: tables.required("vehicle")?.read(Vehicle::check)?,
            camera: read_camera(tables.required("camera")?)?,
            decoder: gnss.split_off(&["protocol", "plausibility"]).read(DecoderSettings::check)?,
            gnss: read_gnss(gnss)?,
            replay_speed: 1.0,
            gpio: tables.or_empty("gpio").read(gpio::Settings::check)?,
            sync: tables.or_empty("sync").read(sync::Settings::check)?,
            recorder: tables.required("recorder")?.read(recorder::Settings::check)?,
            simulation: tables
                .optional("simulation")
                .map(|table| table.read(simulated::Settings::check))
                .transpose()?,
        };
        tables.refuse_others()?;
        let simulated = config.camera == Camera::Simulated || config.gnss == Gnss::Simulated;
        match (&config.simulation, simulated) {
            (None, true) => Err(Fault::new(text.len(), "a simulated driver needs the table [simulation]")),
            (Some(_), false) => Err(Fault::new(0, "[simulation] is given, but no driver is `simulated`")),
            _ => Ok(config),
        }
    }

    /// Everything from a recording; `given`: how its bytes are decoded and its frames paired.
    pub fn for_replay(recording: &Path, name: &str, folder: &Path, given: Option<&Self>) -> Self {
        let replay = Replay { recording: recording.into() };
        Self {
            vehicle: Vehicle { name: name.into(), calibration: None },
            camera: Camera::Replay(replay.clone()),
            decoder: given.map(|given| given.decoder.clone()).unwrap_or_default(),
            gnss: Gnss::Replay(replay),
            gpio: gpio::Settings::default(),
            sync: given.map(|given| given.sync.clone()).unwrap_or_default(),
            recorder: recorder::Settings::new(folder),
            replay_speed: 1.0,
            simulation: None,
        }
    }

    fn resolve_paths(&mut self, folder: &Path) {
        let resolve = |path: &mut PathBuf| *path = folder.join(&*path);
        self.vehicle.calibration.iter_mut().for_each(resolve);
        if let Camera::Replay(replay) = &mut self.camera {
            resolve(&mut replay.recording);
        }
        if let Gnss::Replay(replay) = &mut self.gnss {
            resolve(&mut replay.recording);
        }
        resolve(&mut self.recorder.folder);
    }

    /// The settings with all defaults filled in, as TOML that loads again: kept in every recording.
    pub fn resolved(&self) -> String {
        let mut tables = toml::Table::try_from(self).expect("settings are tables of plain values");
        // In a file, how bytes are decoded stands in the table of the receiver.
        let decoder = tables.remove("decoder");
        if let (Some(toml::Value::Table(decoder)), Some(toml::Value::Table(gnss))) = (decoder, tables.get_mut("gnss")) {
            gnss.extend(decoder);
        }
        toml::to_string(&tables).expect("settings are tables of plain values")
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

fn read_camera(mut table: Table<'_>) -> Result<Camera, Fault> {
    let driver = table.driver(&["v4l2", "simulated", "replay", "none"])?;
    Ok(match driver.as_str() {
        "v4l2" => Camera::V4l2(table.read(camera_v4l2::Settings::check)?),
        "replay" => Camera::Replay(table.read(|_| Ok(()))?),
        "simulated" => table.read(|Nothing {}| Ok(())).map(|Nothing {}| Camera::Simulated)?,
        _ => table.read(|Nothing {}| Ok(())).map(|Nothing {}| Camera::None)?,
    })
}

fn read_gnss(mut table: Table<'_>) -> Result<Gnss, Fault> {
    let driver = table.driver(&["serial", "simulated", "replay", "none"])?;
    Ok(match driver.as_str() {
        "serial" => Gnss::Serial(table.read(gnss_serial::Settings::check)?),
        "replay" => Gnss::Replay(table.read(|_| Ok(()))?),
        "simulated" => table.read(|Nothing {}| Ok(())).map(|Nothing {}| Gnss::Simulated)?,
        _ => table.read(|Nothing {}| Ok(())).map(|Nothing {}| Gnss::None)?,
    })
}

/// A driver without settings.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Nothing {}

/// What is wrong, and where in the text.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Fault {
    /// Byte of the text.
    pub offset: usize,
    pub what: String,
}

impl Fault {
    fn new(offset: usize, what: impl Into<String>) -> Self {
        Self { offset, what: what.into() }
    }
}

impl From<toml::de::Error> for Fault {
    fn from(error: toml::de::Error) -> Self {
        Self::new(error.span().map_or(0, |span| span.start), in_plain_words(error.message()))
    }
}

/// Says what a deserializer found and expected in the words of the file, not of this program.
fn in_plain_words(message: &str) -> String {
    let message = message.trim_end().replace('\n', "; ");
    let mismatch = message.strip_prefix("invalid type: ").or_else(|| message.strip_prefix("invalid value: "));
    let Some((found, expected)) = mismatch.and_then(|mismatch| mismatch.split_once(", expected ")) else {
        return message;
    };
    let found = match found.split_once(' ') {
        Some(("integer" | "boolean", value)) => value.trim_matches('`').to_owned(),
        Some(("floating", value)) => value.trim_start_matches("point ").trim_matches('`').to_owned(),
        Some(("string", value)) => value.to_owned(),
        _ if found == "map" => "a table".to_owned(),
        _ if found == "sequence" => "a list".to_owned(),
        _ => found.to_owned(),
    };
    let expected = match expected {
        "u8" => "a whole number from 0 to 255",
        "u16" | "u32" | "u64" | "usize" => "a whole number that is not negative",
        "i8" | "i16" | "i32" | "i64" => "a whole number",
        "f32" | "f64" => "a number",
        "a boolean" => "true or false",
        "a string" => "a text in quotes",
        "path string" => "a path in quotes",
        _ => expected,
    };
    format!("is {found}, expected {expected}")
}

/// The tables of a file; each is taken out when it is read.
struct Tables<'a> {
    root: DeTable<'a>,
}

impl<'a> Tables<'a> {
    fn optional(&mut self, name: &'static str) -> Option<Table<'a>> {
        let (_, value) = self.root.remove_entry(name)?;
        Some(Table { name, value })
    }

    fn or_empty(&mut self, name: &'static str) -> Table<'a> {
        let empty = || Table { name, value: Spanned::new(0..0, DeValue::Table(DeTable::new())) };
        self.optional(name).unwrap_or_else(empty)
    }

    fn required(&mut self, name: &'static str) -> Result<Table<'a>, Fault> {
        self.optional(name).ok_or_else(|| Fault::new(0, format!("the table [{name}] is missing")))
    }

    fn refuse_others(&self) -> Result<(), Fault> {
        let Some((name, _)) = self.root.iter().next() else { return Ok(()) };
        let known = "expected [vehicle], [camera], [gnss], [gpio], [sync], [recorder] or [simulation]";
        Err(Fault::new(name.span().start, format!("unknown table or key `{}`, {known}", name.get_ref())))
    }
}

struct Table<'a> {
    name: &'static str,
    value: Spanned<DeValue<'a>>,
}

impl<'a> Table<'a> {
    /// Takes the key `driver` out.
    fn driver(&mut self, known: &[&str]) -> Result<String, Fault> {
        let at = self.value.span().start;
        let expected = format!("expected one of \"{}\"", known.join("\", \""));
        let DeValue::Table(entries) = self.value.get_mut() else {
            return Err(Fault::new(at, format!("`{}` must be a table", self.name)));
        };
        let Some(driver) = entries.remove("driver") else {
            return Err(Fault::new(at, format!("[{}]: `driver` is missing, {expected}", self.name)));
        };
        let found = driver.get_ref().as_str().unwrap_or("not a text");
        if !known.contains(&found) {
            let what = format!("[{}]: driver is \"{found}\", {expected}", self.name);
            return Err(Fault::new(driver.span().start, what));
        }
        Ok(found.into())
    }

    /// A table of the same name with these keys, which this one then lacks.
    fn split_off(&mut self, keys: &[&str]) -> Self {
        let mut taken = DeTable::new();
        if let DeValue::Table(entries) = self.value.get_mut() {
            taken.extend(keys.iter().filter_map(|key| entries.remove_entry(*key)));
        }
        Self { name: self.name, value: Spanned::new(self.value.span(), DeValue::Table(taken)) }
    }

    fn read<T: DeserializeOwned>(self, check: impl FnOnce(&T) -> Result<(), String>) -> Result<T, Fault> {
        let at = self.value.span();
        let DeValue::Table(entries) = self.value.into_inner() else {
            return Err(Fault::new(at.start, format!("`{}` must be a table", self.name)));
        };
        let offsets: Vec<(String, usize)> =
            entries.iter().map(|(key, _)| (key.get_ref().to_string(), key.span().start)).collect();
        let in_table = |mut fault: Fault| {
            fault.offset = fault.offset.max(at.start);
            fault.what = format!("[{}]: {}", self.name, fault.what);
            fault
        };
        let settings = T::deserialize(Deserializer::from(Spanned::new(at.clone(), entries))).map_err(|error| {
            let mut fault = Fault::from(error);
            // A value of the wrong type: the key it belongs to is the last one before it.
            let key = offsets.iter().filter(|(_, offset)| *offset < fault.offset).max_by_key(|(_, offset)| *offset);
            if let (Some((key, _)), true) = (key, fault.what.starts_with("is ")) {
                fault.what = format!("{key} {}", fault.what);
            }
            in_table(fault)
        })?;
        check(&settings).map_err(|what| {
            // A complaint starts with the key it is about.
            let key = what.split_whitespace().next().unwrap_or_default().trim_matches('`');
            let offset = offsets.iter().find(|(name, _)| name == key).map_or(at.start, |&(_, offset)| offset);
            in_table(Fault::new(offset, what.clone()))
        })?;
        Ok(settings)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SHIPPED: [&str; 3] = ["record.toml", "simulated.toml", "replay.toml"];
    /// Keys that are commented out because there is no default.
    const WITHOUT_DEFAULT: [&str; 5] =
        ["calibration", "power_line_hz", "record_button_pin", "status_led_pin", "pps_pin"];

    fn shipped(name: &str) -> PathBuf {
        Path::new(env!("CARGO_MANIFEST_DIR")).join("config").join(name)
    }

    #[test]
    fn every_shipped_file_loads_and_states_the_true_defaults() {
        for name in SHIPPED {
            let text = fs::read_to_string(shipped(name)).expect("readable");
            let config = RecordConfig::load(&shipped(name)).unwrap_or_else(|error| panic!("{error}"));
            let again = RecordConfig::parse(&config.resolved()).unwrap_or_else(|fault| panic!("{name}: {fault:?}"));
            assert_eq!(again, config, "{name}");
            let uncommented: String = text
                .lines()
                .map(|line| match line.strip_prefix("# ") {
                    Some(setting) if is_setting(setting) => format!("{setting}\n"),
                    _ => format!("{line}\n"),
                })
                .collect();
            assert_ne!(uncommented, text, "{name} explains nothing");
            let mut with_defaults =
                RecordConfig::parse(&uncommented).unwrap_or_else(|fault| panic!("{name}: {fault:?}"));
            with_defaults.resolve_paths(&shipped(""));
            assert_eq!(with_defaults.resolved(), config.resolved(), "{name}");
        }
    }

    fn is_setting(line: &str) -> bool {
        let Some((key, _)) = line.split_once(" = ") else { return false };
        key.chars().all(|c| c.is_ascii_lowercase() || c == '_' || c.is_ascii_digit())
            && !WITHOUT_DEFAULT.contains(&key)
            && !["kind", "at_s", "lasts_s"].contains(&key)
    }

    const LEAST: &str = "[vehicle]\nname = \"car\"\n[camera]\ndriver = \"none\"\n[gnss]\ndriver = \"none\"\n[recorder]\n\
                         folder = \"out\"\n";

    fn refusal(text: &str) -> String {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let path = folder.path().join("car.toml");
        fs::write(&path, text).expect("writes");
        let message = RecordConfig::load(&path).expect_err("it is refused").to_string();
        message.split_once("car.toml:").map_or(message.clone(), |(_, rest)| rest.to_owned())
    }

    #[test]
    fn what_is_wrong_is_refused_with_its_line() {
        assert!(RecordConfig::parse(LEAST).is_ok());
        let table = [
            ("name = \"car\"", "name = \"car\"\nspeed_kmh = 3", "3: [vehicle]: unknown field `speed_kmh`"),
            ("name = \"car\"", "name = 3", "2: [vehicle]: name is 3, expected a text in quotes"),
            ("name = \"car\"", "name = \"\"", "2: [vehicle]: name has 0 characters, expected 1 to 64"),
            ("[vehicle]\nname = \"car\"\n", "", "1: the table [vehicle] is missing"),
            (
                "driver = \"none\"\n[gnss]",
                "driver = \"usb\"\n[gnss]",
                "4: [camera]: driver is \"usb\", expected one of \"v4l2\"",
            ),
            ("driver = \"none\"\n[gnss]", "[gnss]", "3: [camera]: `driver` is missing, expected one of"),
            (
                "[recorder]",
                "[sync]\nmax_gap_ms = 600\n[recorder]",
                "8: [sync]: unknown field `max_gap_ms`, expected one of `max_gap_s`",
            ),
            ("[recorder]", "[sync]\nmax_gap_s = -1.0\n[recorder]", "8: [sync]: max_gap_s is -1"),
            ("[recorder]", "[sync]\nmax_gap_s = nan\n[recorder]", "8: [sync]: max_gap_s is NaN"),
            (
                "folder = \"out\"",
                "folder = \"out\"\nqueue_mib = \"64\"",
                "9: [recorder]: queue_mib is \"64\", expected a whole number that is not negative",
            ),
            (
                "folder = \"out\"",
                "folder = \"out\"\nsegment_s = 1.5",
                "9: [recorder]: segment_s is 1.5, expected a whole number that is not negative",
            ),
            ("[recorder]", "[gps]\n[recorder]", "7: unknown table or key `gps`, expected [vehicle]"),
            (
                "folder = \"out\"",
                "folder = \"out\"\nmin_free_percent = 100.0",
                "9: [recorder]: min_free_percent is 100",
            ),
            (
                "driver = \"none\"\n[rec",
                "driver = \"simulated\"\n[rec",
                "a simulated driver needs the table [simulation]",
            ),
            ("[vehicle]", "[vehicle", "1: "),
            (
                "driver = \"none\"\n[rec",
                "driver = \"none\"\nprotocol = \"ubx\"\n[rec",
                "7: [gnss]: unknown variant `ubx`",
            ),
        ];
        for (from, to, expected) in table {
            let found = refusal(&LEAST.replacen(from, to, 1));
            assert!(found.contains(expected), "expected `{expected}`, found `{found}`");
        }
        assert!(refusal("\u{0}").contains("1: "));
    }

    #[test]
    fn relative_paths_start_at_the_file() {
        let config = RecordConfig::load(&shipped("replay.toml")).expect("loads");
        assert_eq!(config.recorder.folder, shipped("replayed"));
        assert_eq!(config.camera, Camera::Replay(Replay { recording: shipped("drive.mcap") }));
    }
}
