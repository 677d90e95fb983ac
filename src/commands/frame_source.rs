//! Luma images from recordings, a data-set folder or image files, decoded one at a time.

use std::path::{Path, PathBuf};

use anyhow::{Context, bail};

use crate::jpeg::LumaDecoder;
use crate::recording::Recording;
use crate::recording::topics::CAMERA_IMAGE;
use crate::types::{DonutCalibration, LumaImage};

/// Images of one camera, and the calibration that came with them.
pub struct FrameSource {
    /// Decoded when asked for. A damaged image is an error, the next may be sound.
    pub frames: Box<dyn Iterator<Item = anyhow::Result<LumaImage>>>,
    pub calibration: Option<DonutCalibration>,
}

/// Opens what the user named: recordings, one data-set folder, or image files. About `limit` frames at most, spread evenly.
pub fn open(inputs: &[PathBuf], limit: usize) -> anyhow::Result<FrameSource> {
    match inputs {
        recordings if recordings.iter().all(|path| has_extension(path, &["mcap"])) => {
            open_recordings(recordings, limit)
        }
        [folder] if folder.is_dir() => open_folder(folder, limit),
        files => Ok(FrameSource { frames: decode_all(spread_evenly(files.to_vec(), limit)), calibration: None }),
    }
}

/// Frames of all recordings, as many of each, and the first calibration that is attached to one. Some may have no images: what
/// a start of the vehicle leaves at which the camera never came.
fn open_recordings(paths: &[PathBuf], limit: usize) -> anyhow::Result<FrameSource> {
    let (mut jpegs, mut calibration, mut useless) = (Vec::new(), None, None);
    for path in paths {
        let (of_recording, known) = jpegs_of(path, limit.div_ceil(paths.len()))?;
        if of_recording.is_empty() {
            let what = format!("{}: no images on {}", path.display(), CAMERA_IMAGE.name);
            if paths.len() > 1 {
                eprintln!("note: left out: {what}");
            }
            useless = Some(what);
        }
        jpegs.extend(of_recording);
        calibration = calibration.or(known);
    }
    if let (true, Some(what)) = (jpegs.is_empty(), useless) {
        bail!(what);
    }
    let mut decoder = LumaDecoder::new();
    let frames = jpegs.into_iter().map(move |jpeg| Ok(decoder.decode(&jpeg)?.clone()));
    Ok(FrameSource { frames: Box::new(frames), calibration })
}

/// Frames of `/camera/image`, whether a position belongs to them or not, and the calibration attached to the recording.
fn jpegs_of(path: &Path, limit: usize) -> anyhow::Result<(Vec<Vec<u8>>, Option<DonutCalibration>)> {
    let recording = Recording::open_any(path)?;
    let images = recording.topics.get(CAMERA_IMAGE.name).map_or(0, |topic| topic.messages as usize);
    let wanted = spread_evenly((0..images).collect(), limit);
    let mut jpegs = Vec::with_capacity(wanted.len());
    let mut number = 0;
    Recording::for_each_image(path, |_, _, jpeg| {
        if wanted.get(jpegs.len()) == Some(&number) {
            jpegs.push(jpeg.to_vec());
        }
        number += 1;
        jpegs.len() < wanted.len()
    })?;
    Ok((jpegs, recording.calibration().ok()))
}

/// `images/` of a data set, or the folder itself when it has none; `donut.json` beside them if there is one.
fn open_folder(folder: &Path, limit: usize) -> anyhow::Result<FrameSource> {
    let images = folder.join("images");
    let images = if images.is_dir() { images } else { folder.to_owned() };
    let listed = std::fs::read_dir(&images).with_context(|| format!("listing {}", images.display()))?;
    let mut files = Vec::new();
    for entry in listed {
        let path = entry.with_context(|| format!("listing {}", images.display()))?.path();
        if has_extension(&path, &["jpg", "jpeg", "png"]) {
            files.push(path);
        }
    }
    if files.is_empty() {
        bail!("no .jpg or .png images in {}", images.display());
    }
    files.sort();
    let calibration = read_calibration(&folder.join("donut.json"))?;
    Ok(FrameSource { frames: decode_all(spread_evenly(files, limit)), calibration })
}

fn read_calibration(path: &Path) -> anyhow::Result<Option<DonutCalibration>> {
    let text = match std::fs::read_to_string(path) {
        Ok(text) => text,
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(None),
        Err(error) => return Err(error).with_context(|| format!("reading {}", path.display())),
    };
    let known = serde_json::from_str(&text)
        .with_context(|| format!("reading the existing calibration {} (mend or remove it)", path.display()))?;
    Ok(Some(known))
}

/// The first of each of `limit` equal parts.
fn spread_evenly<T: Clone>(files: Vec<T>, limit: usize) -> Vec<T> {
    if files.len() <= limit {
        return files;
    }
    (0..limit).map(|i| files[i * files.len() / limit].clone()).collect()
}

fn decode_all(files: Vec<PathBuf>) -> Box<dyn Iterator<Item = anyhow::Result<LumaImage>>> {
    let mut decoder = LumaDecoder::new();
    Box::new(
        files
            .into_iter()
            .map(move |path| decode(&path, &mut decoder).with_context(|| format!("reading {}", path.display()))),
    )
}

fn decode(path: &Path, decoder: &mut LumaDecoder) -> anyhow::Result<LumaImage> {
    let bytes = std::fs::read(path)?;
    if has_extension(path, &["jpg", "jpeg"]) {
        return Ok(decoder.decode(&bytes)?.clone());
    }
    let luma = image::load_from_memory(&bytes)?.into_luma8();
    let (width_px, height_px) = (luma.width() as usize, luma.height() as usize);
    Ok(LumaImage { width_px, height_px, pixels: luma.into_raw() })
}

fn has_extension(path: &Path, extensions: &[&str]) -> bool {
    let extension = path.extension().and_then(|e| e.to_str()).unwrap_or_default();
    extensions.iter().any(|known| known.eq_ignore_ascii_case(extension))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_are_spread_over_the_whole_set() {
        let files: Vec<PathBuf> = (0..10).map(|i| PathBuf::from(i.to_string())).collect();
        let names =
            |limit| spread_evenly(files.clone(), limit).iter().map(|p| p.display().to_string()).collect::<String>();
        assert_eq!(names(5), "02468");
        assert_eq!(names(3), "036");
        assert_eq!(names(20), "0123456789");
    }
}
