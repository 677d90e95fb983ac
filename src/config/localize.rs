//! The configuration of `omniloc localize`.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::{Camera, ConfigError, Fault, Vehicle, load, read_camera, tables::Tables};
use crate::{devices::simulated, localize::MotionSettings, outputs};

/// Everything `omniloc localize` needs to know.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct LocalizeConfig {
    pub vehicle: Vehicle,
    pub camera: Camera,
    pub map: Map,
    pub motion: MotionSettings,
    pub outputs: outputs::Settings,
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
            map: tables.required("map")?.read(|_| Ok(()))?,
            motion: tables.or_empty("motion").read(MotionSettings::check)?,
            outputs: tables.or_empty("outputs").read(outputs::Settings::check)?,
            replay_speed: 1.0,
            simulation: tables
                .optional("simulation")
                .map(|table| table.read(simulated::Settings::check))
                .transpose()?,
        };
        tables.refuse_others("[vehicle], [camera], [map], [motion], [outputs] or [simulation]")?;
        match (&config.simulation, &config.camera) {
            (_, Camera::None) => Err(Fault::new(0, "[camera]: driver is \"none\", but localizing needs a camera")),
            (None, Camera::Simulated) => Err(Fault::new(text.len(), "a simulated driver needs the table [simulation]")),
            (Some(_), camera) if *camera != Camera::Simulated => {
                Err(Fault::new(0, "[simulation] is given, but no driver is `simulated`"))
            }
            _ => Ok(config),
        }
    }

    fn resolve_paths(&mut self, folder: &Path) {
        let resolve = |path: &mut PathBuf| *path = folder.join(&*path);
        self.vehicle.calibration.iter_mut().for_each(resolve);
        if let Camera::Replay(replay) = &mut self.camera {
            resolve(&mut replay.recording);
        }
        resolve(&mut self.map.file);
    }

    /// The settings with all defaults filled in, as TOML that loads again.
    pub fn resolved(&self) -> String {
        toml::to_string(self).expect("settings are tables of plain values")
    }
}
