//! How well the yaws of a recording fit its pictures.

use std::path::Path;

use prost::Message;

use super::{
    visual_rotation::RotationTracker,
    yaw_lag::{LagEstimate, MAX_LAG_S, PIECE_S, Piece, YawLag, YawPoint},
};
use crate::{
    jpeg::LumaDecoder,
    panorama::{Panorama, UnwrapTable},
    recording::{Recording, RecordingError, proto::omniloc, topics},
    types::DonutCalibration,
};

/// Fewer headings a second do not show how a turn went.
const MIN_HEADING_HZ: f64 = 5.0;
/// More are thinned out: a turn takes seconds.
const MAX_HEADING_HZ: f64 = 50.0;
/// Pieces with turns that are looked at, spread over the drive.
const PIECES: usize = 8;
/// Frames looked at: one in so many seconds, 12 a second.
const FRAME_INTERVAL_S: f64 = 0.08;

/// By how much pairs and pictures disagree.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RecordedLag {
    /// Positive: pairs say where the vehicle was this much before the exposure, because too little latency was taken off.
    pub late_s: f64,
    /// One standard deviation.
    pub std_s: f64,
    pub turns: usize,
}

/// Compares the yaws on `/gnss/heading`, at the times they are stamped with, with the turns that the pictures show.
///
/// `on_frame` is called for each of `of` frames that are decoded. `None`: no calibration, no yaws, too few of them, or no
/// turns to compare.
///
/// # Errors
/// When the recording cannot be read.
pub fn latency_from_recording(
    recording: &Recording,
    mut on_frame: impl FnMut(usize, usize),
) -> Result<Option<RecordedLag>, RecordingError> {
    let Ok(calibration) = recording.calibration() else { return Ok(None) };
    let Some(image_size_px) = recording.image_size_px else { return Ok(None) };
    if !has_enough_headings(recording) {
        return Ok(None);
    }
    let headings = read_headings(&recording.path)?;
    let starts_s = starts_of_turns(&headings);
    let Some(&last_start_s) = starts_s.last() else { return Ok(None) };

    let mut camera = CameraYaw::new(&calibration, image_size_px, starts_s);
    let of = (camera.starts_s.len() as f64 * PIECE_S / FRAME_INTERVAL_S) as usize;
    Recording::for_each_image(&recording.path, |_, stamp_ns, jpeg| {
        let stamp_s = stamp_ns as f64 * 1e-9;
        if camera.wants(stamp_s) {
            camera.push(stamp_ns, jpeg);
            on_frame(camera.frames, of);
        }
        stamp_s <= last_start_s + PIECE_S
    })?;

    let mut lag = YawLag::default();
    for piece in camera.finish() {
        let Some(&(first_s, _)) = piece.first() else { continue };
        let from = headings.partition_point(|point| point.0 < first_s - 2.0 * MAX_LAG_S);
        let to = headings.partition_point(|point| point.0 < first_s + PIECE_S + 2.0 * MAX_LAG_S);
        if let Some(piece) = Piece::compare(&piece, &headings[from..to]) {
            lag.push(piece);
        }
    }
    let found = |LagEstimate { lag_s, std_s, turns }| RecordedLag { late_s: lag_s, std_s, turns };
    Ok(lag.estimate().map(found))
}

fn has_enough_headings(recording: &Recording) -> bool {
    let Some(topic) = recording.topics.get(topics::GNSS_HEADING.name) else { return false };
    let span_s = topic.last_ns.saturating_sub(topic.first_ns) as f64 * 1e-9;
    topic.messages as f64 >= MIN_HEADING_HZ * span_s && span_s > PIECE_S
}

/// Stamps \[s\] and yaws, in order.
fn read_headings(path: &Path) -> Result<Vec<YawPoint>, RecordingError> {
    let mut headings: Vec<YawPoint> = Vec::new();
    Recording::for_each_message(path, &topics::GNSS_HEADING, |header, data| {
        let heading = omniloc::Heading::decode(data)
            .map_err(|error| format!("heading {} cannot be decoded: {error}", header.sequence))?;
        let stamp_s = header.publish_time as f64 * 1e-9;
        let thin = headings.last().is_some_and(|last| (stamp_s - last.0).abs() < 0.9 / MAX_HEADING_HZ);
        if heading.yaw_rad.is_finite() && !thin {
            headings.push((stamp_s, heading.yaw_rad));
        }
        Ok(true)
    })?;
    headings.sort_by(|a, b| a.0.total_cmp(&b.0));
    Ok(headings)
}

/// Where pieces with turns begin: the strongest turn of each part of the drive, in order.
fn starts_of_turns(headings: &[YawPoint]) -> Vec<f64> {
    let (Some(first), Some(last)) = (headings.first(), headings.last()) else { return Vec::new() };
    let begin_s = first.0 + MAX_LAG_S;
    let end_s = last.0 - MAX_LAG_S - PIECE_S;
    let part_s = ((end_s - begin_s) / PIECES as f64).max(PIECE_S);
    let mut starts_s: Vec<f64> = Vec::new();
    let mut best: Option<(f64, f64)> = None;
    let mut part = 0.0;
    let mut start_s = begin_s;
    while start_s <= end_s {
        let from = headings.partition_point(|point| point.0 < start_s);
        let to = headings.partition_point(|point| point.0 < start_s + PIECE_S);
        let free = starts_s.last().is_none_or(|last_s| start_s >= last_s + PIECE_S);
        if free && let Some(rms_rad) = Piece::turn_rms_rad(&headings[from..to]) {
            best = best.filter(|(_, known_rad)| *known_rad >= rms_rad).or(Some((start_s, rms_rad)));
        }
        start_s += MAX_LAG_S;
        if start_s >= begin_s + (part + 1.0) * part_s || start_s > end_s {
            starts_s.extend(best.take().map(|(start_s, _)| start_s));
            part = ((start_s - begin_s) / part_s).floor();
        }
    }
    starts_s
}

/// The camera's yaw in the pieces that are asked for.
struct CameraYaw {
    starts_s: Vec<f64>,
    decoder: LumaDecoder,
    table: Option<UnwrapTable>,
    panorama: Panorama,
    tracker: RotationTracker,
    /// One record a piece.
    pieces: Vec<Vec<YawPoint>>,
    frames: usize,
    last_s: f64,
}

impl CameraYaw {
    fn new(calibration: &DonutCalibration, (width_px, height_px): (usize, usize), starts_s: Vec<f64>) -> Self {
        Self {
            pieces: vec![Vec::new(); starts_s.len()],
            starts_s,
            decoder: LumaDecoder::new(),
            table: UnwrapTable::build(calibration, width_px, height_px).ok(),
            panorama: Panorama::zeros(),
            tracker: RotationTracker::new(calibration.azimuth),
            frames: 0,
            last_s: f64::NEG_INFINITY,
        }
    }

    fn piece_at(&self, stamp_s: f64) -> Option<usize> {
        let index = self.starts_s.partition_point(|start_s| *start_s <= stamp_s).checked_sub(1)?;
        (stamp_s < self.starts_s[index] + PIECE_S).then_some(index)
    }

    fn wants(&self, stamp_s: f64) -> bool {
        self.piece_at(stamp_s).is_some() && stamp_s >= self.last_s + FRAME_INTERVAL_S
    }

    /// A damaged frame is passed over; the next one is compared with the one before.
    fn push(&mut self, stamp_ns: u64, jpeg: &[u8]) {
        let stamp_s = stamp_ns as f64 * 1e-9;
        self.frames += 1;
        let (Some(index), Some(table)) = (self.piece_at(stamp_s), &self.table) else { return };
        let Ok(image) = self.decoder.decode(jpeg) else { return };
        if (image.width_px, image.height_px) != table.image_size_px() {
            return;
        }
        table.unwrap_into(image, 0, &mut self.panorama);
        self.last_s = stamp_s;
        if self.pieces[index].is_empty() {
            self.tracker.restart();
        }
        let rotation = self.tracker.push(stamp_ns, &self.panorama);
        let piece = &mut self.pieces[index];
        match (piece.last(), rotation) {
            (Some(&(_, yaw_rad)), Some(rotation)) => piece.push((stamp_s, yaw_rad + rotation.rotation_rad)),
            // Where a rotation is missing, the yaw is not known from there on: the piece begins anew.
            _ => {
                piece.clear();
                piece.push((stamp_s, 0.0));
            }
        }
    }

    fn finish(self) -> Vec<Vec<YawPoint>> {
        self.pieces
    }
}
