//! Luma images from a data-set folder or image files, decoded one at a time.

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

/// Opens what the user named: one recording, one data-set folder, or image files. At most `limit` frames, spread evenly.
pub fn open(inputs: &[PathBuf], limit: usize) -> anyhow::Result<FrameSource> {
    match inputs {
        [recording] if has_extension(recording, &["mcap"]) => open_recording(recording, limit),
        [folder] if folder.is_dir() => open_folder(folder, limit),
        files => Ok(FrameSource { frames: decode_all(spread_evenly(files.to_vec(), limit)), calibration: None }),
    }
}

/// Frames of `/camera/image`, whether a position belongs to them or not, and the calibration attached to the recording.
fn open_recording(path: &Path, limit: usize) -> anyhow::Result<FrameSource> {
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
    if jpegs.is_empty() {
        bail!("{}: no images on {}", path.display(), CAMERA_IMAGE.name);
    }
    let mut decoder = LumaDecoder::new();
    let frames = jpegs.into_iter().map(move |jpeg| Ok(decoder.decode(&jpeg)?.clone()));
    Ok(FrameSource { frames: Box::new(frames), calibration: recording.calibration().ok() })
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
