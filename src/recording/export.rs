//! Out of a recording: data-set folder, images, tables and tracks.

use std::{
    fs,
    io::{self, Write},
    path::{Path, PathBuf},
};

use serde_json::json;

use super::{
    atomic::{folder_of, sync_folder, write_file_atomically},
    dataset::{CALIBRATION_FILE, IMAGES_FOLDER, POSITIONS_FILE, RECORDING_FILE, RecordingFacts},
    error::RecordingError,
    positions::{HEADER, image_path},
    reader::{Recording, SurveyFrame},
};
use crate::types::{Geodetic, LocalFrame};

/// What to make of a recording.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    /// The folder that `import` reads.
    Dataset,
    /// One row a pair, the unusable ones too.
    Csv,
    GeoJson,
    Gpx,
    Kml,
    /// The JPEG files alone.
    Images,
}

#[derive(Debug, thiserror::Error)]
pub enum ExportError {
    #[error(
        "{path}: a {format} file needs latitude and longitude, but the recording does not say where its origin lies; \
         give it with `--origin LAT,LON[,ALT]`",
        path = path.display()
    )]
    NoOrigin { path: PathBuf, format: &'static str },
    #[error("{path}: no frame with an image and a valid position to export", path = path.display())]
    NothingToExport { path: PathBuf },
    #[error(
        "{path}: frame {index} calls its file `{file}`, expected a name inside images/ that no other frame has",
        path = path.display()
    )]
    BadFileName { path: PathBuf, index: usize, file: String },
    #[error(transparent)]
    Recording(#[from] RecordingError),
}

#[derive(Debug, PartialEq, Eq)]
pub struct ExportReport {
    pub frames: usize,
    /// Pairs that are not in the output because they must not be used.
    pub left_out: usize,
}

/// Writes `out`, a file or a folder, or leaves it as it was. An `out` that exists is replaced.
///
/// `origin` overrides that of the recording.
pub fn export(
    recording: &Recording,
    format: Format,
    out: &Path,
    origin: Option<Geodetic>,
) -> Result<ExportReport, ExportError> {
    if recording.survey.is_empty() && format != Format::Csv {
        return Err(ExportError::NothingToExport { path: recording.path.clone() });
    }
    let origin = origin.or(recording.origin);
    let needs_origin = |name| {
        let no_origin = || ExportError::NoOrigin { path: recording.path.clone(), format: name };
        origin.map(LocalFrame::new).ok_or_else(no_origin)
    };
    match format {
        Format::Dataset => write_dataset(recording, out, origin)?,
        Format::Images => write_folder_atomically(out, |folder| write_images(recording, folder))?,
        Format::Csv => write_text(out, &csv_table(recording, origin.map(LocalFrame::new).as_ref()))?,
        Format::GeoJson => write_text(out, &geojson(recording, &needs_origin("GeoJSON")?))?,
        Format::Gpx => write_text(out, &gpx(recording, &needs_origin("GPX")?))?,
        Format::Kml => write_text(out, &kml(recording, &needs_origin("KML")?))?,
    }
    let (usable, unusable) = (recording.survey.len(), recording.unusable.len());
    Ok(match format {
        Format::Csv => ExportReport { frames: usable + unusable, left_out: 0 },
        _ => ExportReport { frames: usable, left_out: unusable },
    })
}

fn write_text(out: &Path, text: &str) -> Result<(), RecordingError> {
    write_file_atomically(out, |file| {
        let failed = |cause| RecordingError::CannotWrite { path: out.into(), cause };
        file.write_all(text.as_bytes()).map_err(failed)
    })
}

/// Fills a folder under a temporary name beside `out` and renames it when it is whole.
fn write_folder_atomically(out: &Path, fill: impl FnOnce(&Path) -> Result<(), ExportError>) -> Result<(), ExportError> {
    let parent = folder_of(out);
    let failed = |cause: io::Error| RecordingError::CannotWrite { path: out.into(), cause };
    let mut builder = tempfile::Builder::new();
    builder.prefix(".omniloc-").suffix(".tmp");
    #[cfg(unix)]
    builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o777)); // the umask still applies
    let temporary = builder.tempdir_in(parent).map_err(failed)?;
    let filled = temporary.path().join("new");
    fs::create_dir(&filled).map_err(failed)?;
    fill(&filled).map_err(|error| with_final_name(error, &filled, out))?;
    sync_files(&filled).map_err(failed)?;
    if out.exists() {
        // A folder cannot be replaced in one step: move the old one aside, and back if the new one cannot take its place.
        let old = temporary.path().join("old");
        fs::rename(out, &old).map_err(failed)?;
        if let Err(cause) = fs::rename(&filled, out) {
            let _ = fs::rename(&old, out);
            return Err(failed(cause).into());
        }
    } else {
        fs::rename(&filled, out).map_err(failed)?;
    }
    sync_folder(parent);
    Ok(())
}

/// The error with the name the file was going to have.
fn with_final_name(error: ExportError, temporary: &Path, out: &Path) -> ExportError {
    match error {
        ExportError::Recording(RecordingError::CannotWrite { path, cause }) => {
            let path = path.strip_prefix(temporary).map(|inside| out.join(inside)).unwrap_or(path);
            RecordingError::CannotWrite { path, cause }.into()
        }
        other => other,
    }
}

/// Puts all files in a folder on the disk. At the end, not one by one: by then most are written, and it goes fast.
fn sync_files(folder: &Path) -> io::Result<()> {
    for entry in fs::read_dir(folder)? {
        let entry = entry?;
        if entry.file_type()?.is_dir() {
            sync_files(&entry.path())?;
        } else {
            fs::File::open(entry.path())?.sync_all()?;
        }
    }
    sync_folder(folder);
    Ok(())
}

fn write_dataset(recording: &Recording, out: &Path, origin: Option<Geodetic>) -> Result<(), ExportError> {
    write_folder_atomically(out, |folder| {
        write_images(recording, &folder.join(IMAGES_FOLDER))?;
        write_text(&folder.join(POSITIONS_FILE), &positions_csv(&recording.survey))?;
        if let Some(json) = &recording.calibration_json {
            let path = folder.join(CALIBRATION_FILE);
            write_file_atomically(&path, |file| {
                file.write_all(json).map_err(|cause| RecordingError::CannotWrite { path: path.clone(), cause })
            })?;
        }
        let facts = RecordingFacts { name: recording.name.clone(), origin: origin.map(Into::into) };
        write_text(&folder.join(RECORDING_FILE), &format!("{:#}\n", json!(facts)))?;
        Ok(())
    })
}

/// The file name of a frame in a data set: the one it came with, or its number.
fn file_name(frame: &SurveyFrame) -> String {
    if frame.source_file.is_empty() { format!("{:06}.jpg", frame.index) } else { frame.source_file.clone() }
}

fn write_images(recording: &Recording, folder: &Path) -> Result<(), ExportError> {
    let failed = |path: &Path, cause| RecordingError::CannotWrite { path: path.into(), cause };
    fs::create_dir_all(folder).map_err(|cause| failed(folder, cause))?;
    recording.for_each_jpeg(|frame, jpeg| {
        let file = file_name(frame);
        let index = frame.index;
        let bad_name = || ExportError::BadFileName { path: recording.path.clone(), index, file: file.clone() };
        let path = folder.join(image_path(&file).ok_or_else(bad_name)?);
        let parent = folder_of(&path);
        fs::create_dir_all(parent).map_err(|cause| failed(parent, cause))?;
        let mut image = fs::File::create_new(&path).map_err(|cause| match cause.kind() {
            io::ErrorKind::AlreadyExists => bad_name(),
            _ => failed(&path, cause).into(),
        })?;
        let written = image.write_all(jpeg);
        written.map_err(|cause| failed(&path, cause).into())
    })
}

/// Numbers in the shortest form that reads back as the same number.
fn shortest(number: Option<f64>) -> String {
    number.map(|number| number.to_string()).unwrap_or_default()
}

fn csv_text(header: &[&str], rows: impl Iterator<Item = Vec<String>>) -> String {
    let quoted = |field: &str| match field.contains([',', '"', '\n', '\r']) {
        true => format!("\"{}\"", field.replace('"', "\"\"")),
        false => field.to_owned(),
    };
    let mut text = header.join(",") + "\n";
    for row in rows {
        let fields: Vec<String> = row.iter().map(|field| quoted(field)).collect();
        text += &(fields.join(",") + "\n");
    }
    text
}

fn positions_csv(frames: &[SurveyFrame]) -> String {
    csv_text(
        &HEADER,
        frames.iter().map(|frame| {
            let [x_m, y_m] = frame.position_m.map(|metres| metres.to_string());
            vec![frame.index.to_string(), file_name(frame), x_m, y_m, shortest(frame.yaw_rad), shortest(frame.time_s)]
        }),
    )
}

/// Everything known of each pair; latitude and longitude are empty if the origin is unknown.
fn csv_table(recording: &Recording, local_frame: Option<&LocalFrame>) -> String {
    const HEADER: [&str; 17] = [
        "index",
        "file",
        "stamp_ns",
        "x_m",
        "y_m",
        "yaw_rad",
        "time_s",
        "latitude_deg",
        "longitude_deg",
        "position_std_m",
        "interpolation_gap_s",
        "interpolation_gap_m",
        "serial_latency_s",
        "serial_latency_m",
        "valid",
        "invalid_reason",
        "recording",
    ];
    let mut pairs: Vec<(&SurveyFrame, &str)> = recording.survey.iter().map(|frame| (frame, "")).collect();
    pairs.extend(recording.unusable.iter().map(|(frame, reason)| (frame, reason.as_str())));
    pairs.sort_by_key(|(frame, _)| frame.index);
    csv_text(
        &HEADER,
        pairs.into_iter().map(|(frame, reason)| {
            let [x_m, y_m] = frame.position_m.map(|metres| metres.to_string());
            let place = local_frame.map(|local| local.plane_to_geodetic(frame.position_m));
            vec![
                frame.index.to_string(),
                file_name(frame),
                frame.stamp_ns.to_string(),
                x_m,
                y_m,
                shortest(frame.yaw_rad),
                shortest(frame.time_s),
                place.map(|place| degrees(place.latitude_deg)).unwrap_or_default(),
                place.map(|place| degrees(place.longitude_deg)).unwrap_or_default(),
                shortest(frame.position_std_m),
                shortest(frame.interpolation_gap_s),
                shortest(frame.interpolation_gap_m),
                shortest(frame.serial_latency_s),
                shortest(frame.serial_latency_m),
                reason.is_empty().to_string(),
                reason.to_owned(),
                recording.name.clone(),
            ]
        }),
    )
}

/// Nine decimals are 0.1 mm.
fn degrees(angle_deg: f64) -> String {
    format!("{angle_deg:.9}")
}

/// GeoJSON (RFC 7946): one point a frame, and the track through them.
fn geojson(recording: &Recording, local_frame: &LocalFrame) -> String {
    let round = |angle_deg: f64| (angle_deg * 1e9).round() / 1e9;
    let coordinates = |frame: &SurveyFrame| {
        let place = local_frame.plane_to_geodetic(frame.position_m);
        json!([round(place.longitude_deg), round(place.latitude_deg)])
    };
    let mut features: Vec<serde_json::Value> = Vec::new();
    if recording.survey.len() > 1 {
        let line: Vec<_> = recording.survey.iter().map(coordinates).collect();
        features.push(json!({
            "type": "Feature",
            "geometry": {"type": "LineString", "coordinates": line},
            "properties": {"name": recording.name},
        }));
    }
    features.extend(recording.survey.iter().map(|frame| {
        let [x_m, y_m] = frame.position_m;
        json!({
            "type": "Feature",
            "geometry": {"type": "Point", "coordinates": coordinates(frame)},
            "properties": {
                "index": frame.index, "file": file_name(frame), "x_m": x_m, "y_m": y_m,
                "yaw_rad": frame.yaw_rad, "time_s": frame.time_s,
            },
        })
    }));
    format!("{:#}\n", json!({"type": "FeatureCollection", "features": features}))
}

/// GPX 1.1: one track. Without times: those of the data set start at an arbitrary zero.
fn gpx(recording: &Recording, local_frame: &LocalFrame) -> String {
    let points: String = recording
        .survey
        .iter()
        .map(|frame| {
            let place = local_frame.plane_to_geodetic(frame.position_m);
            let (latitude, longitude) = (degrees(place.latitude_deg), degrees(place.longitude_deg));
            let name = xml_escaped(&file_name(frame));
            format!("      <trkpt lat=\"{latitude}\" lon=\"{longitude}\"><name>{name}</name></trkpt>\n")
        })
        .collect();
    format!(
        "<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n\
         <gpx version=\"1.1\" creator=\"omniloc\" xmlns=\"http://www.topografix.com/GPX/1/1\">\n  \
           <trk>\n    <name>{}</name>\n    <trkseg>\n{points}    </trkseg>\n  </trk>\n</gpx>\n",
        xml_escaped(&recording.name)
    )
}

/// KML 2.2: the track as a line, and one placemark a frame.
fn kml(recording: &Recording, local_frame: &LocalFrame) -> String {
    let coordinates = |frame: &SurveyFrame| {
        let place = local_frame.plane_to_geodetic(frame.position_m);
        format!("{},{}", degrees(place.longitude_deg), degrees(place.latitude_deg))
    };
    let line: Vec<String> = recording.survey.iter().map(coordinates).collect();
    let points: String = recording
        .survey
        .iter()
        .map(|frame| {
            let (name, place) = (xml_escaped(&file_name(frame)), coordinates(frame));
            format!("    <Placemark><name>{name}</name><Point><coordinates>{place}</coordinates></Point></Placemark>\n")
        })
        .collect();
    format!(
        "<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n<kml xmlns=\"http://www.opengis.net/kml/2.2\">\n  <Document>\n    \
         <name>{name}</name>\n    <Placemark><name>{name}</name><LineString><coordinates>{line}</coordinates>\
         </LineString></Placemark>\n{points}  </Document>\n</kml>\n",
        name = xml_escaped(&recording.name),
        line = line.join(" "),
    )
}

/// Text for XML 1.0, which has no way to write control characters.
fn xml_escaped(text: &str) -> String {
    text.chars()
        .filter(|character| !character.is_control())
        .map(|character| match character {
            '&' => "&amp;".into(),
            '<' => "&lt;".into(),
            '>' => "&gt;".into(),
            '"' => "&quot;".into(),
            '\'' => "&apos;".into(),
            other => other.to_string(),
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn markup_in_names_is_escaped() {
        assert_eq!(xml_escaped("a<b>&\"c'\u{1}"), "a&lt;b&gt;&amp;&quot;c&apos;");
    }

    #[test]
    fn numbers_read_back_as_they_were() {
        for number in [0.01567, 0.1 + 0.2, -0.0, 1e-300, 123456789.12345679, 7.5] {
            let text = shortest(Some(number));
            assert_eq!(text.parse::<f64>().map(f64::to_bits), Ok(number.to_bits()), "{text}");
        }
        assert_eq!(shortest(Some(7.5)), "7.5");
    }

    #[test]
    fn fields_with_commas_and_quotes_survive() {
        let text = csv_text(&["file"], std::iter::once(vec!["a,\"b\".jpg".to_owned()]));
        let mut reader = csv::Reader::from_reader(text.as_bytes());
        let record = reader.records().next().expect("a row").expect("sound");
        assert_eq!(&record[0], "a,\"b\".jpg");
    }
}
