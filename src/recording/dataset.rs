//! Data-set folders: `images/`, `positions.csv`, `donut.json`, and, from our own export, `recording.json`.
//!
//! `positions.rs` reads the positions, `import.rs` turns the folder into a recording.

use std::{
    collections::HashSet,
    fs::{self, File},
    io,
    path::{Path, PathBuf},
};

use serde::{Deserialize, Serialize};

use super::{
    error::RecordingError,
    positions::{HEADER, Row, check_times, duplicate_positions, read_rows, yaw_in_degrees},
};
use crate::{jpeg::MarkerError, types::CalibrationError, types::Geodetic};

pub const IMAGES_FOLDER: &str = "images";
pub const POSITIONS_FILE: &str = "positions.csv";
pub const CALIBRATION_FILE: &str = "donut.json";
/// What the other files have no place for; only our own export writes it.
pub const RECORDING_FILE: &str = "recording.json";

/// Why a data set cannot be imported: file, line or field, expected and found.
#[derive(Debug, thiserror::Error)]
pub enum DatasetError {
    #[error("{path}: {what}", path = path.display())]
    NoSuchDataset { path: PathBuf, what: &'static str },
    #[error("{path}: cannot read", path = path.display())]
    CannotRead { path: PathBuf, source: io::Error },
    #[error("{path}, line 1: expected the header `{}`, found `{found}`: {difference}", HEADER.join(","), path = path.display())]
    Header { path: PathBuf, found: String, difference: String },
    #[error("{path}, line {line}: expected {} fields ({}), found {found}", HEADER.len(), HEADER.join(","), path = path.display())]
    FieldCount { path: PathBuf, line: u64, found: usize },
    #[error("{path}, line {line}, field `{field}`: expected {expected}, found `{found}`", path = path.display())]
    Field { path: PathBuf, line: u64, field: &'static str, expected: String, found: String },
    #[error("{path}: not a sound CSV file", path = path.display())]
    Csv { path: PathBuf, source: csv::Error },
    #[error("{path}: no rows below the header, expected one a frame", path = path.display())]
    NoRows { path: PathBuf },
    #[error("{path}: image of {csv}, line {line}: {what}", path = path.display(), csv = POSITIONS_FILE)]
    Image { path: PathBuf, line: u64, what: String },
    #[error("{path}: image of {csv}, line {line}", path = path.display(), csv = POSITIONS_FILE)]
    BadImage { path: PathBuf, line: u64, source: MarkerError },
    #[error(
        "{path}: image is {found}, expected {expected} like the images before it: mixed calibrations; one data set is one \
         camera with one setting, import the others as data sets of their own",
        path = path.display()
    )]
    MixedSizes { path: PathBuf, found: String, expected: String },
    #[error(
        "{path}: no calibration; run `omniloc calibrate` on the recording made with `--without-calibration`, or name a \
         file with `--calibration FILE`",
        path = path.display()
    )]
    NoCalibration { path: PathBuf },
    #[error("{path}: {what}", path = path.display())]
    Json { path: PathBuf, what: String },
    #[error("{path}: bad calibration", path = path.display())]
    BadCalibration { path: PathBuf, source: CalibrationError },
    #[error(transparent)]
    Recording(#[from] RecordingError),
}

impl DatasetError {
    /// Whether the caller named something that is not there, rather than data being bad.
    pub fn is_bad_argument(&self) -> bool {
        matches!(self, Self::NoSuchDataset { .. })
    }
}

/// `recording.json`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RecordingFacts {
    pub name: String,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub origin: Option<Origin>,
}

/// [`Geodetic`] in a file.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Origin {
    pub latitude_deg: f64,
    pub longitude_deg: f64,
    pub altitude_m: f64,
}

impl From<Origin> for Geodetic {
    fn from(Origin { latitude_deg, longitude_deg, altitude_m }: Origin) -> Self {
        Self { latitude_deg, longitude_deg, altitude_m }
    }
}

impl From<Geodetic> for Origin {
    fn from(Geodetic { latitude_deg, longitude_deg, altitude_m }: Geodetic) -> Self {
        Self { latitude_deg, longitude_deg, altitude_m }
    }
}

/// A data-set folder whose positions have been read and checked; images are only named.
#[derive(Debug)]
pub struct Dataset {
    pub folder: PathBuf,
    pub name: String,
    pub origin: Option<Geodetic>,
    /// Sorted by index.
    pub rows: Vec<Row>,
    /// What is odd but usable.
    pub warnings: Vec<String>,
}

impl Dataset {
    pub fn open(folder: &Path) -> Result<Self, DatasetError> {
        let missing = |what| DatasetError::NoSuchDataset { path: folder.into(), what };
        if !folder.exists() {
            return Err(missing("no such folder; expected a data set with images/ and positions.csv"));
        }
        if !folder.is_dir() {
            return Err(missing("not a folder; expected a data set with images/ and positions.csv"));
        }
        if !folder.join(IMAGES_FOLDER).is_dir() {
            return Err(missing("not a data set: expected a folder images/ in it"));
        }
        let positions = folder.join(POSITIONS_FILE);
        if !positions.is_file() {
            return Err(missing("not a data set: expected a file positions.csv in it"));
        }
        let facts = read_facts(&folder.join(RECORDING_FILE))?;
        let file =
            File::open(&positions).map_err(|source| DatasetError::CannotRead { path: positions.clone(), source })?;
        let mut rows = read_rows(&positions, file)?;
        let mut warnings = duplicate_positions(&rows);
        warnings.extend(yaw_in_degrees(&rows));
        warnings.extend(unlisted_images(&folder.join(IMAGES_FOLDER), &rows));
        rows.sort_by_key(|row| row.index);
        check_times(&positions, &rows)?;
        let (name, origin) = match facts {
            Some(facts) => (facts.name, facts.origin.map(Geodetic::from)),
            None => (folder_name(folder), None),
        };
        Ok(Self { folder: folder.into(), name, origin, rows, warnings })
    }
}

fn folder_name(folder: &Path) -> String {
    let full = fs::canonicalize(folder).unwrap_or_else(|_| folder.into());
    full.file_name().unwrap_or_default().to_string_lossy().into_owned()
}

fn read_facts(path: &Path) -> Result<Option<RecordingFacts>, DatasetError> {
    if !path.exists() {
        return Ok(None);
    }
    let bad = |what: String| DatasetError::Json { path: path.into(), what };
    let text = fs::read_to_string(path).map_err(|error| bad(error.to_string()))?;
    let facts: RecordingFacts = serde_json::from_str(&text).map_err(|error| bad(error.to_string()))?;
    if facts.origin.is_some_and(|origin| !Geodetic::from(origin).is_plausible()) {
        return Err(bad("origin: expected latitude within ±90, longitude within ±180 degrees, altitude in m".into()));
    }
    Ok(Some(facts))
}

/// Images in the folder that no row names.
fn unlisted_images(images: &Path, rows: &[Row]) -> Option<String> {
    let listed: HashSet<&Path> = rows.iter().map(|row| row.image.as_path()).collect();
    let is_image = |name: &Path| name.extension().is_some_and(|end| end.eq_ignore_ascii_case("jpg") || end == "jpeg");
    let mut unlisted: Vec<PathBuf> = fs::read_dir(images)
        .ok()?
        .filter_map(|entry| Some(PathBuf::from(entry.ok()?.file_name())))
        .filter(|name| is_image(name) && !listed.contains(name.as_path()))
        .collect();
    unlisted.sort();
    let first = unlisted.first()?;
    let count = unlisted.len();
    Some(format!(
        "{count} images in {IMAGES_FOLDER}/ have no row in {POSITIONS_FILE}, the first is {}",
        first.display()
    ))
}
