//! A data-set folder becomes a recording.

use std::{
    collections::BTreeMap,
    fs::{self, File},
    io::{Seek, Write},
    path::{Path, PathBuf},
};

use super::{
    atomic::write_file_atomically,
    dataset::{CALIBRATION_FILE, Dataset, DatasetError, IMAGES_FOLDER},
    error::RecordingError,
    positions::Row,
    proto::{foxglove, omniloc},
    topics::{self, metadata},
    writer::{RecordingWriter, timestamp},
};
use crate::{
    jpeg::{self, JpegInfo},
    types::{DonutCalibration, Geodetic, LocalFrame},
};

/// Larger files are no camera images \[bytes\].
const MAX_IMAGE_FILE_BYTES: u64 = 64 << 20;
/// A calibration is a few hundred bytes.
const MAX_CALIBRATION_BYTES: u64 = 64 << 10;

/// Where the calibration comes from.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum CalibrationSource {
    /// `donut.json` in the folder, which must be there.
    Dataset,
    File(PathBuf),
    /// The recording is made to calibrate on.
    None,
}

#[derive(Debug, Clone)]
pub struct ImportSettings {
    pub dataset: PathBuf,
    pub calibration: CalibrationSource,
    /// Where x = y = 0 lies on the Earth; `None`: what `recording.json` says, or unknown.
    pub origin: Option<Geodetic>,
}

#[derive(Debug)]
pub struct ImportReport {
    pub name: String,
    pub frames: usize,
    pub image_size_px: (usize, usize),
    /// Frames that came without Huffman tables and were completed.
    pub completed_frames: usize,
    pub warnings: Vec<String>,
}

/// Writes the recording `out`, or leaves `out` as it was.
///
/// The same folder gives the same bytes every time: no clock, path or random number goes into them.
pub fn import(settings: &ImportSettings, out: &Path) -> Result<ImportReport, DatasetError> {
    let dataset = Dataset::open(&settings.dataset)?;
    let first = dataset.rows.first().ok_or_else(|| DatasetError::NoRows { path: settings.dataset.clone() })?;
    let (_, first_image) = read_image(&dataset, first)?;
    let image_size_px = (first_image.width_px, first_image.height_px);
    let calibration_json = read_calibration(settings, image_size_px)?;
    let origin = settings.origin.or(dataset.origin);

    let mut completed_frames = 0;
    write_file_atomically(out, |file| {
        let failed = |error| DatasetError::from(RecordingError::cannot_write(out, error));
        let mut recording = RecordingWriter::new(file).map_err(failed)?;
        write_head(&mut recording, &dataset, image_size_px, calibration_json.as_deref(), origin).map_err(failed)?;
        let local_frame = origin.map(LocalFrame::new);
        for (count, row) in dataset.rows.iter().enumerate() {
            let (bytes, info) = read_image(&dataset, row)?;
            check_size(&dataset, row, info, image_size_px)?;
            let complete = jpeg::with_huffman_tables(&bytes).map_err(|source| bad_image(&dataset, row, source))?;
            completed_frames += usize::from(!info.has_huffman_tables);
            let stamp_ns = stamp_ns(row, count);
            recording.write_image(row.index, stamp_ns, &complete).map_err(failed)?;
            write_position(&mut recording, row, stamp_ns, local_frame.as_ref()).map_err(failed)?;
        }
        recording.finish().map_err(failed)?;
        Ok::<(), DatasetError>(())
    })?;

    let frames = dataset.rows.len();
    Ok(ImportReport { name: dataset.name, frames, image_size_px, completed_frames, warnings: dataset.warnings })
}

/// The stamp of a frame \[ns\]: its time, or, in a data set without times, one second a frame.
fn stamp_ns(row: &Row, count: usize) -> u64 {
    match row.time_s {
        Some(time_s) => (time_s * 1e9).round() as u64,
        None => count as u64 * 1_000_000_000,
    }
}

fn write_head<W: Write + Seek>(
    recording: &mut RecordingWriter<W>,
    dataset: &Dataset,
    (width_px, height_px): (usize, usize),
    calibration_json: Option<&[u8]>,
    origin: Option<Geodetic>,
) -> Result<(), mcap::McapError> {
    let has_times = dataset.rows.iter().any(|row| row.time_s.is_some());
    let text = |entries: &[(&str, &str)]| -> BTreeMap<String, String> {
        entries.iter().map(|&(key, value)| (key.into(), value.into())).collect()
    };
    recording.write_metadata(
        metadata::PROGRAM,
        text(&[("name", env!("CARGO_PKG_NAME")), ("version", env!("CARGO_PKG_VERSION")), ("command", "import")]),
    )?;
    recording.write_metadata(
        metadata::SOURCE,
        text(&[("kind", "dataset"), ("name", &dataset.name), ("frames", &dataset.rows.len().to_string())]),
    )?;
    recording.write_metadata(
        metadata::SETTINGS,
        text(&[
            ("calibration", if calibration_json.is_some() { topics::CALIBRATION_ATTACHMENT } else { "none" }),
            ("origin", if origin.is_some() { "given" } else { "unknown" }),
            ("stamps", if has_times { "time_s of the data set" } else { "none in the data set: one second a frame" }),
        ]),
    )?;
    recording.write_metadata(
        metadata::CONVENTIONS,
        text(&[
            ("map_frame", "ENU from the origin: x east, y north, z up [m]"),
            ("yaw", "from east, counter-clockwise [rad]"),
            ("stamps", "start of the exposure [ns]"),
            ("pixels", "the centre of the top left pixel is (0, 0)"),
        ]),
    )?;
    recording.write_metadata(
        metadata::CAMERA,
        text(&[("width_px", &width_px.to_string()), ("height_px", &height_px.to_string()), ("encoding", "jpeg")]),
    )?;
    if let Some(Geodetic { latitude_deg, longitude_deg, altitude_m }) = origin {
        recording.write_metadata(
            metadata::ORIGIN,
            text(&[
                ("latitude_deg", &latitude_deg.to_string()),
                ("longitude_deg", &longitude_deg.to_string()),
                ("altitude_m", &altitude_m.to_string()),
            ]),
        )?;
    }
    if let Some(json) = calibration_json {
        let first_stamp_ns = dataset.rows.first().map_or(0, |row| stamp_ns(row, 0));
        recording.attach(topics::CALIBRATION_ATTACHMENT, "application/json", first_stamp_ns, json)?;
    }
    Ok(())
}

/// All that the row says about where the vehicle was.
fn write_position<W: Write + Seek>(
    recording: &mut RecordingWriter<W>,
    row: &Row,
    stamp_ns: u64,
    local_frame: Option<&LocalFrame>,
) -> Result<(), mcap::McapError> {
    if let Some(local_frame) = local_frame {
        let position = local_frame.plane_to_geodetic([row.x_m, row.y_m]);
        let fix = foxglove::LocationFix {
            timestamp: Some(timestamp(stamp_ns)),
            frame_id: topics::GNSS_FRAME.into(),
            latitude: position.latitude_deg,
            longitude: position.longitude_deg,
            altitude: position.altitude_m,
            position_covariance: vec![0.0; 9],
            position_covariance_type: foxglove::location_fix::PositionCovarianceType::Unknown.into(),
        };
        recording.write(&topics::GNSS_FIX, row.index, stamp_ns, &fix)?;
    }
    if let Some(yaw_rad) = row.yaw_rad {
        let timestamp = Some(timestamp(stamp_ns));
        let heading = omniloc::Heading { timestamp, yaw_rad, source: "dataset".into(), yaw_std_rad: None };
        recording.write(&topics::GNSS_HEADING, row.index, stamp_ns, &heading)?;
    }
    let pair = omniloc::SurveyPair {
        east_m: row.x_m,
        north_m: row.y_m,
        yaw_rad: row.yaw_rad,
        valid: true,
        source_file: row.file.clone(),
        dataset_time_s: row.time_s,
        ..Default::default()
    };
    recording.write_pair(row.index, stamp_ns, pair)
}

fn read_calibration(
    settings: &ImportSettings,
    (width_px, height_px): (usize, usize),
) -> Result<Option<Vec<u8>>, DatasetError> {
    let path = match &settings.calibration {
        CalibrationSource::None => return Ok(None),
        CalibrationSource::File(path) => path.clone(),
        CalibrationSource::Dataset => settings.dataset.join(CALIBRATION_FILE),
    };
    if !path.exists() {
        return Err(DatasetError::NoCalibration { path });
    }
    let bad = |what: String| DatasetError::Json { path: path.clone(), what };
    let facts = fs::metadata(&path).map_err(|error| bad(error.to_string()))?;
    if !facts.is_file() || facts.len() > MAX_CALIBRATION_BYTES {
        return Err(bad(format!("expected a JSON file of at most {MAX_CALIBRATION_BYTES} bytes")));
    }
    let json = fs::read(&path).map_err(|error| bad(error.to_string()))?;
    let calibration: DonutCalibration =
        serde_json::from_slice(&json).map_err(|error| bad(format!("not a donut calibration: {error}")))?;
    let bad_calibration = |source| DatasetError::BadCalibration { path: path.clone(), source };
    calibration.check_in_image(width_px, height_px).map_err(bad_calibration)?;
    Ok(Some(json))
}

fn image_file(dataset: &Dataset, row: &Row) -> PathBuf {
    dataset.folder.join(IMAGES_FOLDER).join(&row.image)
}

fn bad_image(dataset: &Dataset, row: &Row, source: jpeg::MarkerError) -> DatasetError {
    DatasetError::BadImage { path: image_file(dataset, row), line: row.line, source }
}

fn read_image(dataset: &Dataset, row: &Row) -> Result<(Vec<u8>, JpegInfo), DatasetError> {
    let path = image_file(dataset, row);
    let bad = |what: String| DatasetError::Image { path: path.clone(), line: row.line, what };
    let unreadable = |error: std::io::Error| match error.kind() {
        std::io::ErrorKind::NotFound => bad("no such file".into()),
        _ => bad(format!("cannot be read: {error}")),
    };
    let facts = fs::metadata(&path).map_err(unreadable)?;
    if !facts.is_file() {
        return Err(bad("not a regular file".into()));
    }
    if facts.len() > MAX_IMAGE_FILE_BYTES {
        return Err(bad(format!("{} bytes, expected at most {MAX_IMAGE_FILE_BYTES}", facts.len())));
    }
    let mut bytes = Vec::with_capacity(facts.len() as usize);
    let mut file = std::io::Read::take(File::open(&path).map_err(unreadable)?, MAX_IMAGE_FILE_BYTES);
    std::io::Read::read_to_end(&mut file, &mut bytes).map_err(unreadable)?;
    let info = jpeg::scan(&bytes).map_err(|source| bad_image(dataset, row, source))?;
    Ok((bytes, info))
}

fn check_size(dataset: &Dataset, row: &Row, info: JpegInfo, expected: (usize, usize)) -> Result<(), DatasetError> {
    if (info.width_px, info.height_px) == expected {
        return Ok(());
    }
    let size = |(width_px, height_px)| format!("{width_px} x {height_px} px");
    Err(DatasetError::MixedSizes {
        path: image_file(dataset, row),
        found: size((info.width_px, info.height_px)),
        expected: size(expected),
    })
}
