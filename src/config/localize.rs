//! The configuration of `omniloc localize`.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::{Camera, ConfigError, Fault, Replay, Vehicle, load, read_camera, read_simulation, tables::Tables};
use crate::{
    devices::simulated,
    localize::{FIELDS_IN_MEMORY_BYTES, MotionSettings},
    outputs,
    recording::recorder,
};

/// Everything `omniloc localize` needs to know.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct LocalizeConfig {
    pub vehicle: Vehicle,
    pub camera: Camera,
    pub map: Map,
    pub motion: MotionSettings,
    pub outputs: outputs::Settings,
    /// Estimates are recorded too.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub recorder: Option<recorder::Settings>,
    /// How many times as fast as it was recorded a drive is replayed.
    #[serde(skip)]
    pub replay_speed: f64,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub simulation: Option<simulated::Settings>,
}

/// Where the vehicle may be.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Map {
    /// Made by `omniloc train`.
    pub file: PathBuf,
    /// So much of the map's fields may be in memory; a larger map is read as the vehicle needs it.
    #[serde(default = "default_memory_mib")]
    pub memory_mib: u32,
}

/// More is no limit.
const MAX_MEMORY_MIB: u32 = 1 << 20;

fn default_memory_mib() -> u32 {
    (FIELDS_IN_MEMORY_BYTES >> 20) as u32
}

impl Map {
    pub fn memory_bytes(&self) -> usize {
        (self.memory_mib as usize) << 20
    }

    fn check(&self) -> Result<(), String> {
        match self.memory_mib {
            0..=MAX_MEMORY_MIB => Ok(()),
            memory_mib => Err(format!("memory_mib = {memory_mib}: expected 0 to {MAX_MEMORY_MIB}")),
        }
    }
}

impl LocalizeConfig {
    /// Reads and checks a file. Relative paths in it are meant relative to its folder.
    pub fn load(path: &Path) -> Result<Self, ConfigError> {
        let mut config = load(path, Self::parse)?;
        config.resolve_paths(path.parent().unwrap_or(Path::new(".")));
        Ok(config)
    }

    /// Reads and checks the text of a file; paths stay as they are.
    pub fn parse(text: &str) -> Result<Self, Fault> {
        let mut tables = Tables::parse(text)?;
        let config = Self {
            vehicle: tables.required("vehicle")?.read(Vehicle::check)?,
            camera: read_camera(tables.required("camera")?)?,
            map: tables.required("map")?.read(Map::check)?,
            motion: tables.or_empty("motion").read(MotionSettings::check)?,
            outputs: tables.or_empty("outputs").read(outputs::Settings::check)?,
            recorder: tables.optional("recorder").map(|table| table.read(recorder::Settings::check)).transpose()?,
            replay_speed: 1.0,
            simulation: None,
        };
        let simulation = tables.optional("simulation");
        tables.refuse_others("[vehicle], [camera], [map], [motion], [outputs], [recorder] or [simulation]")?;
        if config.camera == Camera::None {
            return Err(Fault::new(0, "[camera]: driver is \"none\", but localizing needs a camera"));
        }
        let is_simulated = config.camera == Camera::Simulated;
        Ok(Self { simulation: read_simulation(simulation, is_simulated)?, ..config })
    }

    fn resolve_paths(&mut self, folder: &Path) {
        let resolve = |path: &mut PathBuf| *path = folder.join(&*path);
        self.vehicle.calibration.iter_mut().for_each(resolve);
        if let Camera::Replay(replay) = &mut self.camera {
            resolve(&mut replay.recording);
        }
        resolve(&mut self.map.file);
        self.recorder.iter_mut().for_each(|recorder| resolve(&mut recorder.folder));
    }

    /// The frames of a recording on a map; `given`: how the vehicle moves, how much memory there is, and where estimates go, which is stdout if
    /// nothing is given.
    pub fn for_replay(recording: &Path, name: &str, map: &Path, given: Option<&Self>) -> Self {
        let stdout = Some(outputs::StdoutSettings::default());
        Self {
            vehicle: Vehicle { name: name.into(), calibration: None },
            camera: Camera::Replay(Replay { recording: recording.into() }),
            map: Map {
                file: map.into(),
                memory_mib: given.map_or_else(default_memory_mib, |given| given.map.memory_mib),
            },
            motion: given.map(|given| given.motion).unwrap_or_default(),
            outputs: given.map_or(outputs::Settings { stdout, ..Default::default() }, |given| given.outputs.clone()),
            recorder: None,
            replay_speed: 1.0,
            simulation: None,
        }
    }

    /// The settings with all defaults filled in, as TOML that loads again.
    pub fn resolved(&self) -> String {
        toml::to_string(self).expect("settings are tables of plain values")
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;
    use crate::config::tests::{shipped, with_defaults};

    #[test]
    fn the_shipped_file_loads_and_states_the_true_defaults() {
        let text = fs::read_to_string(shipped("localize.toml")).expect("readable");
        let config = LocalizeConfig::load(&shipped("localize.toml")).unwrap_or_else(|error| panic!("{error}"));
        assert_eq!(LocalizeConfig::parse(&config.resolved()).expect("loads again"), config);
        let mut defaults =
            LocalizeConfig::parse(&with_defaults(&text, &[])).unwrap_or_else(|fault| panic!("{fault:?}"));
        defaults.resolve_paths(&shipped(""));
        assert_eq!(defaults.resolved(), config.resolved());
    }

    const LEAST: &str = "[vehicle]\nname = \"car\"\n[camera]\ndriver = \"replay\"\nrecording = \"a.mcap\"\n[map]\n\
                         file = \"area.map\"\n";

    #[test]
    fn what_is_wrong_is_refused() {
        assert!(LocalizeConfig::parse(LEAST).is_ok());
        let table = [
            ("[map]\nfile = \"area.map\"", "", "the table [map] is missing"),
            ("driver = \"replay\"\nrecording = \"a.mcap\"", "driver = \"none\"", "localizing needs a camera"),
            ("[map]", "[motion]\nspeed_limit_mps = 0.0\n[map]", "[motion]: speed_limit_mps = 0: expected 0.1 to 200"),
            (
                "file = \"area.map\"",
                "file = \"a\"\nmemory_mib = 9999999",
                "memory_mib = 9999999: expected 0 to 1048576",
            ),
            ("[map]", "[motion]\nspeed_kmh = 3\n[map]", "[motion]: unknown field `speed_kmh`"),
            ("[map]", "[gnss]\ndriver = \"none\"\n[map]", "unknown table or key `gnss`, expected [vehicle]"),
            ("[map]", "[[outputs.nmea_tcp]]\nlisten = \"here\"\n[map]", "an IP address and a port"),
            ("[map]", "[simulation]\nplace = \"town\"\n[map]", "no driver is `simulated`"),
        ];
        for (from, to, expected) in table {
            let fault = LocalizeConfig::parse(&LEAST.replacen(from, to, 1)).expect_err(expected);
            assert!(fault.what.contains(expected), "expected `{expected}`, found `{}`", fault.what);
        }
    }
}
