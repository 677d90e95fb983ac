//! How well the yaws of a recording fit its pictures.

use std::path::Path;

use prost::Message;

use super::{
    camera_turns::CameraTurns,
    yaw_lag::{LagEstimate, MAX_LAG_S, PIECE_S, Piece, YawLag, YawPoint},
};
use crate::{
    recording::{Recording, RecordingError, proto::omniloc, topics},
    types::DonutCalibration,
};

/// Fewer headings a second do not show how a turn went.
const MIN_HEADING_HZ: f64 = 5.0;
/// More are thinned out: a turn takes seconds.
const MAX_HEADING_HZ: f64 = 50.0;
/// Pieces with turns that are looked at, spread over the drive.
const PIECES: usize = 8;
/// Frames looked at: one in so many seconds, every second one of 30 a second.
const FRAME_INTERVAL_S: f64 = 0.06;

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
    if !has_enough_headings(recording) {
        return Ok(None);
    }
    let headings = read_headings(&recording.path)?;
    let starts_s = starts_of_turns(&headings);
    let Some(&last_start_s) = starts_s.last() else { return Ok(None) };

    let mut camera = CameraYaw::new(calibration, starts_s);
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
    Ok(lag.estimate().map(|LagEstimate { lag_s, std_s, turns }| RecordedLag { late_s: lag_s, std_s, turns }))
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
    turns: CameraTurns,
    /// One record a piece.
    pieces: Vec<Vec<YawPoint>>,
    frames: usize,
    last_s: f64,
    /// The newest frame of a record.
    last_ns: u64,
}

impl CameraYaw {
    fn new(calibration: DonutCalibration, starts_s: Vec<f64>) -> Self {
        Self {
            pieces: vec![Vec::new(); starts_s.len()],
            starts_s,
            turns: CameraTurns::new(calibration),
            frames: 0,
            last_s: f64::NEG_INFINITY,
            last_ns: 0,
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
        let Some(index) = self.piece_at(stamp_s) else { return };
        self.last_s = stamp_s;
        if self.pieces[index].is_empty() {
            self.turns.restart();
        }
        let rotation = self.turns.push(stamp_ns, jpeg);
        let piece = &mut self.pieces[index];
        match (piece.last(), rotation) {
            (None, _) => piece.push((stamp_s, 0.0)),
            (Some(&(_, yaw_rad)), Some(rotation)) if rotation.from_ns == self.last_ns => {
                piece.push((stamp_s, yaw_rad + rotation.rotation_rad));
            }
            // The tracker gave up on frames in between: the yaw is not known from there on, and the piece begins anew
            // with the frame that it went on from.
            (Some(_), Some(rotation)) => {
                piece.clear();
                piece.push((rotation.from_ns as f64 * 1e-9, 0.0));
                piece.push((stamp_s, rotation.rotation_rad));
            }
            (Some(_), None) => return,
        }
        self.last_ns = stamp_ns;
    }

    fn finish(self) -> Vec<Vec<YawPoint>> {
        self.pieces
    }
}

#[cfg(test)]
mod tests {
    use std::{f64::consts::TAU, fs, io::Cursor};

    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;
    use crate::{
        recording::RecordingWriter,
        types::wrap_angle_rad,
        world::{Camera, Day, Drive, DriveSettings, Renderer, World},
    };

    const DONUT: &str = r#"{"kind": "donut", "cx": 79.5, "cy": 79.5, "r_in": 20.0, "r_out": 76.0, "top_is_outer": true,
        "start_angle": 0.4, "clockwise": true, "azimuth": "cw"}"#;
    const SIZE_PX: usize = 160;

    /// A right-angled turn of 4 s, one in 12 s.
    fn yaw_rad(time_s: f64) -> f64 {
        let turns = (time_s / 12.0).floor();
        let within = ((time_s - 12.0 * turns - 4.0) / 4.0).clamp(0.0, 1.0);
        TAU / 4.0 * (turns + within - (TAU * within).sin() / TAU)
    }

    /// The surroundings, at so many azimuths.
    fn surroundings() -> Vec<f64> {
        let waves = [(3.0, 0.0), (5.0, 1.0), (7.0, 4.0), (8.0, 2.5), (11.0, 0.3), (13.0, 5.0), (17.0, 1.7)];
        let shade = |azimuth_rad: f64| {
            128.0 + waves.map(|(k, phase)| 14.0 * (k * azimuth_rad + phase).cos()).iter().sum::<f64>()
        };
        (0..8192).map(|i| shade(TAU * f64::from(i) / 8192.0)).collect()
    }

    /// As a donut camera sees them at a yaw.
    fn picture(surroundings: &[f64], yaw_rad: f64) -> Vec<u8> {
        let count = surroundings.len() as f64;
        let shade = |x: usize, y: usize| {
            let (dx, dy) = (x as f64 - 79.5, y as f64 - 79.5);
            // Columns run clockwise from the start angle, and the azimuth falls with them.
            let azimuth_rad = yaw_rad - (dy.atan2(dx) - 0.4);
            surroundings[((azimuth_rad / TAU).rem_euclid(1.0) * count) as usize % surroundings.len()] as u8
        };
        let pixels: Vec<u8> = (0..SIZE_PX * SIZE_PX).map(|i| shade(i % SIZE_PX, i / SIZE_PX)).collect();
        let mut jpeg = Vec::new();
        image::codecs::jpeg::JpegEncoder::new_with_quality(&mut jpeg, 80)
            .encode(&pixels, SIZE_PX as u32, SIZE_PX as u32, image::ExtendedColorType::L8)
            .expect("encodes");
        jpeg
    }

    /// A drive of 60 s whose headings are stamped too late.
    fn record(path: &Path, heading_hz: u32, late_s: f64) {
        let mut recording = RecordingWriter::new(Cursor::new(Vec::new())).expect("starts");
        recording.attach("donut.json", "application/json", 0, DONUT.as_bytes()).expect("attaches");
        let start_ns = 1_000_000_000_000u64;
        let ns = |time_s: f64| start_ns + (time_s * 1e9) as u64;
        for i in 0..60 * heading_hz {
            let time_s = f64::from(i) / f64::from(heading_hz);
            let yaw_rad = wrap_angle_rad(yaw_rad(time_s));
            let heading = omniloc::Heading { timestamp: None, yaw_rad, source: "HDT".into(), yaw_std_rad: None };
            recording.write(&topics::GNSS_HEADING, i, ns(time_s + late_s), &heading).expect("writes");
        }
        let surroundings = surroundings();
        for frame in 0..600 {
            let time_s = f64::from(frame) / 10.0;
            recording.write_image(frame, ns(time_s), &picture(&surroundings, yaw_rad(time_s))).expect("writes");
        }
        fs::write(path, recording.finish().expect("finishes").into_inner()).expect("writes");
    }

    #[test]
    fn a_recording_shows_by_how_much_pairs_and_pictures_disagree() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let path = folder.path().join("drive.mcap");
        for late_s in [0.12, -0.035] {
            record(&path, 20, late_s);
            let recording = Recording::open_any(&path).expect("sound");
            let mut decoded = 0;
            let lag = latency_from_recording(&recording, |frame, of| {
                decoded = frame;
                assert!(of <= 1100);
            });
            let lag = lag.expect("sound").expect("turns enough");
            println!("headings {late_s} s late: {lag:?}, {decoded} frames");
            assert!((lag.late_s - late_s).abs() < 0.005 && lag.std_s < 0.01, "{lag:?}");
            assert!(lag.turns >= 4 && decoded < 600);
        }
        record(&path, 1, 0.0);
        let recording = Recording::open_any(&path).expect("sound");
        let lag = latency_from_recording(&recording, |_, _| panic!("nothing to look at"));
        assert_eq!(lag.expect("sound"), None, "a yaw a second says nothing");
    }

    /// What the camera and the receiver of a vehicle in the simulated town record, with headings of 50 Hz and 0.4°.
    fn record_town(path: &Path, drive: &Drive, world: &World, from_s: f64, to_s: f64, late_s: f64) {
        let camera = Camera::town().scaled_to(320, 180);
        let mut recording = RecordingWriter::new(Cursor::new(Vec::new())).expect("starts");
        let donut = serde_json::to_vec(&camera.donut).expect("plain numbers");
        recording.attach("donut.json", "application/json", 0, &donut).expect("attaches");
        let ns = |time_s: f64| 1_000_000_000_000 + ((time_s - from_s) * 1e9) as u64;
        let mut random = ChaCha8Rng::seed_from_u64(5);
        for i in 0..((to_s - from_s) * 50.0) as u32 {
            let time_s = from_s + f64::from(i) / 50.0;
            let noise_rad = random.random_range(-0.012..0.012);
            let yaw_rad = wrap_angle_rad(drive.pose_at(time_s).yaw_rad + noise_rad);
            let heading = omniloc::Heading { timestamp: None, yaw_rad, source: "HDT".into(), yaw_std_rad: None };
            recording.write(&topics::GNSS_HEADING, i, ns(time_s + late_s), &heading).expect("writes");
        }
        let mut renderer = Renderer::new(world, &Day::new(2), &camera).expect("sound");
        let mut jpeg = Vec::new();
        for frame in 0..((to_s - from_s) * 10.0) as u32 {
            let time_s = from_s + f64::from(frame) / 10.0;
            renderer.render_jpeg(&drive.pose_at(time_s), time_s, &mut jpeg);
            recording.write_image(frame, ns(time_s), &jpeg).expect("writes");
        }
        fs::write(path, recording.finish().expect("finishes").into_inner()).expect("writes");
    }

    #[test]
    fn turns_are_found_between_houses_that_pass_by() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let path = folder.path().join("drive.mcap");
        let world = World::town_block(3);
        let lag = |speed_factor: f64, from_s: f64, to_s: f64| {
            let drive = Drive::new(&world, &DriveSettings { seed: 3, speed_factor, ..DriveSettings::default() });
            record_town(&path, &drive, &world, from_s, to_s, 0.08);
            latency_from_recording(&Recording::open_any(&path).expect("sound"), |_, _| ()).expect("sound")
        };
        let corners = lag(1.0, 5.8, 39.8).expect("turns enough");
        println!("headings 0.08 s late: {corners:?}");
        assert!((corners.late_s - 0.08).abs() < 0.015 && corners.turns == 2, "{corners:?}");
        assert!((0.02..0.05).contains(&corners.std_s), "two turns do not tell more: {corners:?}");
        assert_eq!(lag(0.5, 6.0, 20.0), None, "straight on");
    }
}
