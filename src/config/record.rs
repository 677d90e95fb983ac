//! The configuration of `omniloc record`.

use std::path::{Path, PathBuf};

use serde::Serialize;

use super::{
    Camera, ConfigError, Fault, Replay, Vehicle, load, read_camera, read_simulation,
    tables::{Nothing, Table, Tables},
};
use crate::{
    devices::{gnss_serial, gpio, simulated},
    gnss::DecoderSettings,
    recording::recorder,
    sync,
};

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

/// Where bytes of the receiver come from.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(tag = "driver", rename_all = "lowercase")]
pub enum Gnss {
    Serial(gnss_serial::Settings),
    Simulated,
    Replay(Replay),
    None,
}

impl RecordConfig {
    /// Reads and checks a file. Relative paths in it are meant relative to its folder.
    pub fn load(path: &Path) -> Result<Self, ConfigError> {
        let mut config = load(path, Self::parse)?;
        config.resolve_paths(path.parent().unwrap_or(Path::new(".")));
        Ok(config)
    }

    /// Reads and checks the text of a file; paths stay as they are.
    pub fn parse(text: &str) -> Result<Self, Fault> {
        let mut tables = Tables::parse(text)?;
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
            simulation: None,
        };
        let simulation = tables.optional("simulation");
        tables.refuse_others("[vehicle], [camera], [gnss], [gpio], [sync], [recorder] or [simulation]")?;
        let is_simulated = config.camera == Camera::Simulated || config.gnss == Gnss::Simulated;
        Ok(Self { simulation: read_simulation(simulation, is_simulated)?, ..config })
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

fn read_gnss(mut table: Table<'_>) -> Result<Gnss, Fault> {
    let driver = table.driver(&["serial", "simulated", "replay", "none"])?;
    Ok(match driver.as_str() {
        "serial" => Gnss::Serial(table.read(gnss_serial::Settings::check)?),
        "replay" => Gnss::Replay(table.read(|_| Ok(()))?),
        "simulated" => table.read(|Nothing {}| Ok(())).map(|Nothing {}| Gnss::Simulated)?,
        _ => table.read(|Nothing {}| Ok(())).map(|Nothing {}| Gnss::None)?,
    })
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;
    use crate::config::tests::{shipped, with_defaults};

    const SHIPPED: [&str; 3] = ["record.toml", "simulated.toml", "replay.toml"];
    /// Keys that are commented out because there is no default.
    const WITHOUT_DEFAULT: [&str; 8] =
        ["calibration", "power_line_hz", "record_button_pin", "status_led_pin", "pps_pin", "kind", "at_s", "lasts_s"];

    #[test]
    fn every_shipped_file_loads_and_states_the_true_defaults() {
        for name in SHIPPED {
            let text = fs::read_to_string(shipped(name)).expect("readable");
            let config = RecordConfig::load(&shipped(name)).unwrap_or_else(|error| panic!("{error}"));
            let again = RecordConfig::parse(&config.resolved()).unwrap_or_else(|fault| panic!("{name}: {fault:?}"));
            assert_eq!(again, config, "{name}");
            let mut defaults = RecordConfig::parse(&with_defaults(&text, &WITHOUT_DEFAULT))
                .unwrap_or_else(|fault| panic!("{name}: {fault:?}"));
            defaults.resolve_paths(&shipped(""));
            assert_eq!(defaults.resolved(), config.resolved(), "{name}");
        }
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
