//! Every usable frame of a recording, unwrapped and described in parallel.

use rayon::prelude::*;

use super::survey::SurveyError;
use crate::jpeg::LumaDecoder;
use crate::panorama::{Panorama, UnwrapTable};
use crate::recording::{Recording, SurveyFrame};

/// Frames decoded and described at a time: bounds the memory.
const BATCH: usize = 64;

/// Describes the panoramas of all usable frames of `recording`, in order; `fixed`: each turned by its yaw so that column 0
/// looks east. `describe` gets a thread's own state and the number of the frame, counted from 0; `take` gets what it made of
/// the frames, one after the other; `on_frames` is told how many more are done. Returns width and height of the images \[px\],
/// if there are any.
///
/// # Errors
/// Names the recording and the frame.
pub fn describe_panoramas<S, V: Send>(
    recording: &Recording,
    fixed: bool,
    state: impl Fn() -> S + Sync,
    describe: impl Fn(&mut S, usize, &Panorama) -> V + Sync,
    mut take: impl FnMut(SurveyFrame, V),
    on_frames: impl Fn(usize),
) -> Result<Option<(usize, usize)>, SurveyError> {
    let mut done = 0;
    let mut batch: Vec<(SurveyFrame, Vec<u8>)> = Vec::with_capacity(BATCH);
    let mut frames = recording.frames()?;
    let mut table = None;
    loop {
        batch.clear();
        for frame in frames.by_ref().take(BATCH) {
            batch.push(frame?);
        }
        if batch.is_empty() {
            return Ok(table.map(|table: UnwrapTable| table.image_size_px()));
        }
        let table = match &mut table {
            Some(table) => table,
            none => none.insert(table_of(recording, &batch[0])?),
        };
        let describe = |state: &mut S, i: usize, panorama: &Panorama| describe(state, done + i, panorama);
        let described = describe_batch(recording, fixed, table, &batch, &state, &describe)?;
        done += batch.len();
        on_frames(batch.len());
        batch.drain(..).zip(described).for_each(|((frame, _), described)| take(frame, described));
    }
}

/// For images of the size of this one.
fn table_of(recording: &Recording, (frame, jpeg): &(SurveyFrame, Vec<u8>)) -> Result<UnwrapTable, SurveyError> {
    let mut decoder = LumaDecoder::new();
    let image = decoder.decode(jpeg).map_err(|source| in_frame(recording, frame, source))?;
    UnwrapTable::build(&recording.calibration()?, image.width_px, image.height_px)
        .map_err(|source| SurveyError::Calibration { recording: name(recording), source })
}

fn in_frame(recording: &Recording, frame: &SurveyFrame, source: crate::jpeg::JpegError) -> SurveyError {
    SurveyError::Frame { recording: name(recording), index: frame.index, source }
}

fn name(recording: &Recording) -> String {
    recording.path.display().to_string()
}

fn describe_batch<S, V: Send>(
    recording: &Recording,
    fixed: bool,
    table: &UnwrapTable,
    batch: &[(SurveyFrame, Vec<u8>)],
    state: &(impl Fn() -> S + Sync),
    describe: &(impl Fn(&mut S, usize, &Panorama) -> V + Sync),
) -> Result<Vec<V>, SurveyError> {
    let expected = table.image_size_px();
    batch
        .par_iter()
        .enumerate()
        .map_init(
            || (LumaDecoder::new(), state(), Panorama::zeros()),
            |(decoder, state, panorama), (i, (frame, jpeg))| {
                let image =
                    decoder.decode_needed(jpeg, table.needed()).map_err(|source| in_frame(recording, frame, source))?;
                let found = (image.width_px, image.height_px);
                if found != expected {
                    let (recording, index) = (name(recording), frame.index);
                    return Err(SurveyError::SizeChanged { recording, index, found, expected });
                }
                let turned = match (fixed, frame.yaw_rad) {
                    (false, _) => 0,
                    (true, Some(yaw_rad)) => table.columns_to_east(yaw_rad),
                    (true, None) => {
                        return Err(SurveyError::NoYaw { recording: name(recording), index: frame.index });
                    }
                };
                table.unwrap_into(image, turned, panorama);
                Ok(describe(state, i, panorama))
            },
        )
        .collect()
}
