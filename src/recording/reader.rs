//! Reads recordings, one chunk at a time: a drive may be larger than the memory.

use std::{
    collections::{BTreeMap, VecDeque},
    path::{Path, PathBuf},
};

use mcap::records::{MessageHeader, op};
use prost::Message;

use super::{
    error::RecordingError,
    health::DriveHealth,
    proto::foxglove,
    records::{ChannelFacts, Channels, RecordFile, visit_chunk},
    scan::{Scan, parse_calibration},
    topics,
};
use crate::types::{DonutCalibration, Geodetic, LocalFrame, NS_PER_S, PositionM, distance_m};

/// What is known of the place one frame was taken at.
#[derive(Debug, Clone, PartialEq)]
pub struct SurveyFrame {
    /// Number of the frame: the data set's `index`, or the camera's count.
    pub index: usize,
    /// `file` of the data set; empty if the frame came from a camera.
    pub source_file: String,
    /// Start of the exposure.
    pub stamp_ns: u64,
    pub position_m: PositionM,
    pub yaw_rad: Option<f64>,
    /// One standard deviation, each axis.
    pub position_std_m: Option<f64>,
    /// Time between the fixes the position was interpolated from, and the way driven in it.
    pub interpolation_gap_s: Option<f64>,
    pub interpolation_gap_m: Option<f64>,
    /// Estimated delay of the serial line that was taken off, and the way driven in it.
    pub serial_latency_s: Option<f64>,
    pub serial_latency_m: Option<f64>,
    /// `time_s` as the data set wrote it. `None`: from a camera, or the data set has no times and `stamp_ns` only counts.
    pub time_s: Option<f64>,
}

impl SurveyFrame {
    /// When the frame was taken, on the recording's own clock; `None` where its stamp only counts.
    pub fn known_time_s(&self) -> Option<f64> {
        let from_camera = self.source_file.is_empty();
        (from_camera || self.time_s.is_some()).then_some(self.stamp_ns as f64 / NS_PER_S as f64)
    }
}

/// How often a topic was written to, and when.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TopicSummary {
    pub schema_name: String,
    pub messages: u64,
    /// Earliest and latest log time.
    pub first_ns: u64,
    pub last_ns: u64,
}

/// An opened recording: everything but the images, which [`frames`](Self::frames) reads from the file.
#[derive(Debug, Clone)]
pub struct Recording {
    pub path: PathBuf,
    /// Name of the data set or drive; the file's name if the recording states none.
    pub name: String,
    /// Where east = north = 0 lies, if known.
    pub origin: Option<Geodetic>,
    /// Metadata records by name.
    pub metadata: BTreeMap<String, BTreeMap<String, String>>,
    /// Frames with an image and a valid position, in the order [`frames`](Self::frames) yields them.
    pub survey: Vec<SurveyFrame>,
    /// Pairs that must not be used, and why.
    pub unusable: Vec<(SurveyFrame, String)>,
    /// Images that no pair belongs to.
    pub images_without_pair: u64,
    pub topics: BTreeMap<String, TopicSummary>,
    /// Width, height \[px\] of the first image.
    pub image_size_px: Option<(usize, usize)>,
    /// The attachment `donut.json` as it was written.
    pub(super) calibration_json: Option<Vec<u8>>,
    /// How it was recorded, if it says so.
    pub health: DriveHealth,
}

impl Recording {
    /// Opens a recording to train on or to evaluate: it must have a calibration and at least one usable frame.
    ///
    /// The whole file is read once, chunk by chunk, and all CRCs are checked.
    pub fn open(path: &Path) -> Result<Self, RecordingError> {
        let recording = Self::open_any(path)?;
        if recording.survey.is_empty() {
            let messages =
                |topic: topics::Topic| recording.topics.get(topic.name).map_or(0, |summary| summary.messages);
            return Err(RecordingError::NoUsablePair {
                path: path.into(),
                images: messages(topics::CAMERA_IMAGE),
                pairs: recording.survey.len() + recording.unusable.len(),
                usable: 0,
            });
        }
        recording.calibration()?;
        Ok(recording)
    }

    /// Opens a recording whose calibration or positions may be missing or wrong, to look at it or to calibrate on it.
    pub fn open_any(path: &Path) -> Result<Self, RecordingError> {
        let mut scan = Scan::default();
        let mut file = RecordFile::open(path)?;
        while let Some(record) = file.next()? {
            let outcome = match record.section_fault {
                Some(fault) => Err(fault),
                None => scan.read_top_record(record.opcode, record.body),
            };
            let offset = record.offset;
            outcome.map_err(|what| RecordingError::Damaged { path: path.into(), offset, what })?;
        }
        Ok(scan.into_recording(path))
    }

    /// Where the donut lies in the images.
    pub fn calibration(&self) -> Result<DonutCalibration, RecordingError> {
        let missing = || RecordingError::NoCalibration { path: self.path.clone() };
        parse_calibration(&self.path, self.calibration_json.as_ref().ok_or_else(missing)?, self.image_size_px)
    }

    /// Way from usable frame to usable frame \[m\].
    pub fn length_m(&self) -> f64 {
        self.survey.windows(2).map(|pair| distance_m(pair[0].position_m, pair[1].position_m)).sum()
    }

    /// Counts positions from another origin. `false`, and nothing is changed, if this recording's own is not known.
    pub fn move_origin(&mut self, to: Geodetic) -> bool {
        let Some(from) = self.origin else { return false };
        if from != to {
            let (from, target) = (LocalFrame::new(from), LocalFrame::new(to));
            for frame in &mut self.survey {
                let [east_m, north_m, _] = target.to_enu_m(from.plane_to_geodetic(frame.position_m));
                frame.position_m = [east_m, north_m];
            }
            self.origin = Some(to);
        }
        true
    }

    /// Keeps the first frame, and then each one that is at least this far from the last kept one.
    pub fn keep_spaced(&mut self, spacing_m: f64) {
        let mut last_m: Option<PositionM> = None;
        self.survey.retain(|frame| {
            let keep = last_m.is_none_or(|last_m| distance_m(last_m, frame.position_m) >= spacing_m);
            if keep {
                last_m = Some(frame.position_m);
            }
            keep
        });
    }

    /// Keeps the first frame, and then each one that is the first to get past a multiple of `spacing_m` along the way: as many
    /// as the way has spacings, if there are so many.
    pub fn thin(&mut self, spacing_m: f64) {
        let (mut way_m, mut next_m, mut last_m) = (0.0, 0.0, None);
        self.survey.retain(|frame| {
            way_m += last_m.replace(frame.position_m).map_or(0.0, |last_m| distance_m(last_m, frame.position_m));
            let keep = way_m >= next_m;
            if keep {
                next_m = ((way_m / spacing_m).floor() + 1.0) * spacing_m;
            }
            keep
        });
    }

    /// The attachment `donut.json` as it was written.
    pub fn calibration_json(&self) -> Option<&[u8]> {
        self.calibration_json.as_deref()
    }

    /// The usable frames with their images, in the order of [`survey`](Self::survey); reads the file again.
    pub fn frames(&self) -> Result<Frames, RecordingError> {
        Ok(Frames {
            path: self.path.clone(),
            file: RecordFile::open(&self.path)?,
            channels: Channels::default(),
            waiting: self.survey.iter().map(|frame| (frame.index as u32, frame.clone())).collect(),
            ready: VecDeque::new(),
            done: false,
        })
    }

    /// Calls `visit` with each usable frame and its JPEG, in order.
    pub fn for_each_jpeg<E: From<RecordingError>>(
        &self,
        mut visit: impl FnMut(&SurveyFrame, &[u8]) -> Result<(), E>,
    ) -> Result<(), E> {
        for frame in self.frames()? {
            let (frame, jpeg) = frame?;
            visit(&frame, &jpeg)?;
        }
        Ok(())
    }

    /// Every image in file order, whether a position is known or not, with its frame number and stamp \[ns\]: to
    /// calibrate on a recording. `visit` returns `false` to stop.
    pub fn for_each_image(path: &Path, mut visit: impl FnMut(u32, u64, &[u8]) -> bool) -> Result<(), RecordingError> {
        Self::for_each_message(path, &topics::CAMERA_IMAGE, |header, data| {
            Ok(visit(header.sequence, header.publish_time, &decode_image(header, data)?))
        })
    }

    /// Every message of a topic in file order. `visit` returns `false` to stop, or what is wrong with the message.
    pub fn for_each_message(
        path: &Path,
        topic: &topics::Topic,
        mut visit: impl FnMut(&MessageHeader, &[u8]) -> Result<bool, String>,
    ) -> Result<(), RecordingError> {
        let mut file = RecordFile::open(path)?;
        let mut channels = Channels::default();
        let mut going = true;
        while let Some(record) = file.next()? {
            let offset = record.offset;
            let mut read = |opcode: u8, body: &[u8]| {
                channels.read_record(opcode, body, |channel, header, data| {
                    if going && is_topic(channel, topic) {
                        going = visit(header, data)?;
                    }
                    Ok(())
                })
            };
            let outcome = match record.opcode {
                op::CHUNK => visit_chunk(record.body, read),
                opcode => read(opcode, record.body),
            };
            outcome.map_err(|what| RecordingError::Damaged { path: path.into(), offset, what })?;
            if !going {
                return Ok(());
            }
        }
        Ok(())
    }
}

/// Reads the usable frames of a recording from its file.
pub struct Frames {
    path: PathBuf,
    file: RecordFile,
    channels: Channels,
    /// By frame number: usable frames whose image has not been seen.
    waiting: BTreeMap<u32, SurveyFrame>,
    /// Images of the current chunk.
    ready: VecDeque<(SurveyFrame, Vec<u8>)>,
    done: bool,
}

impl Frames {
    fn read_more(&mut self) -> Result<(), RecordingError> {
        let Self { file, channels, waiting, ready, .. } = self;
        let Some(record) = file.next()? else {
            self.done = true;
            return Ok(());
        };
        let offset = record.offset;
        let mut read = |opcode: u8, body: &[u8]| {
            channels.read_record(opcode, body, |channel, header, data| {
                if is_topic(channel, &topics::CAMERA_IMAGE)
                    && let Some(frame) = waiting.remove(&header.sequence)
                {
                    ready.push_back((frame, decode_image(header, data)?));
                }
                Ok(())
            })
        };
        let outcome = match record.opcode {
            op::CHUNK => visit_chunk(record.body, read),
            opcode => read(opcode, record.body),
        };
        outcome.map_err(|what| RecordingError::Damaged { path: self.path.clone(), offset, what })
    }
}

impl Iterator for Frames {
    type Item = Result<(SurveyFrame, Vec<u8>), RecordingError>;

    fn next(&mut self) -> Option<Self::Item> {
        loop {
            if let Some(frame) = self.ready.pop_front() {
                return Some(Ok(frame));
            }
            if self.done || self.waiting.is_empty() {
                return None;
            }
            if let Err(error) = self.read_more() {
                self.done = true;
                return Some(Err(error));
            }
        }
    }
}

pub(super) fn is_topic(channel: &ChannelFacts, topic: &topics::Topic) -> bool {
    channel.topic == topic.name && channel.schema_name == topic.schema_name && channel.encoding == "protobuf"
}

pub(super) fn decode_image(header: &MessageHeader, data: &[u8]) -> Result<Vec<u8>, String> {
    let image = foxglove::CompressedImage::decode(data)
        .map_err(|error| format!("image {} cannot be decoded: {error}", header.sequence))?;
    Ok(image.data)
}

#[cfg(test)]
mod tests {
    use std::{fs, io::Cursor};

    use super::*;
    use crate::recording::{RecordingWriter, proto::omniloc};

    const DONUT: &str = r#"{"kind": "donut", "cx": 15.5, "cy": 15.5, "r_in": 3.0, "r_out": 15.0, "top_is_outer": true,
        "start_angle": 0.0, "clockwise": true, "azimuth": "ccw"}"#;

    /// Frame, east \[m\], valid.
    type Pair = (u32, f64, bool);

    fn picture(value: u8) -> Vec<u8> {
        let mut jpeg = Vec::new();
        image::codecs::jpeg::JpegEncoder::new(&mut jpeg)
            .encode(&[value; 32 * 32], 32, 32, image::ExtendedColorType::L8)
            .expect("encodes");
        jpeg
    }

    fn pair(east_m: f64, valid: bool) -> omniloc::SurveyPair {
        let invalid_reason = if valid { "" } else { "no fix for 3 s" };
        omniloc::SurveyPair { east_m, valid, invalid_reason: invalid_reason.into(), ..Default::default() }
    }

    /// A recording as a drive makes it: some frames without a position, pairs later than their images.
    fn write_drive(path: &Path, calibration: Option<&str>, pairs: &[Pair]) {
        let mut recording = RecordingWriter::new(Cursor::new(Vec::new())).expect("starts");
        if let Some(json) = calibration {
            recording.attach("donut.json", "application/json", 0, json.as_bytes()).expect("attaches");
        }
        for frame in 1..=4 {
            recording.write_image(frame, frame.into(), &picture(frame as u8)).expect("writes");
            recording.flush().expect("flushes");
        }
        for &(frame, east_m, valid) in pairs {
            recording.write_pair(frame, frame.into(), pair(east_m, valid)).expect("writes");
        }
        fs::write(path, recording.finish().expect("finishes").into_inner()).expect("writes");
    }

    #[test]
    fn only_frames_with_image_and_valid_pair_are_usable() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let path = folder.path().join("drive.mcap");
        write_drive(&path, Some(DONUT), &[(4, 40.0, true), (1, 10.0, true), (2, 20.0, false), (9, f64::NAN, true)]);
        let recording = Recording::open(&path).expect("sound");
        assert_eq!(recording.name, "drive");
        assert_eq!(recording.survey.iter().map(|frame| frame.index).collect::<Vec<_>>(), [1, 4]);
        let reasons: Vec<_> = recording.unusable.iter().map(|(frame, why)| (frame.index, why.as_str())).collect();
        assert_eq!(reasons, [(2, "no fix for 3 s"), (9, "position or yaw is not a number")]);
        assert_eq!(recording.images_without_pair, 1, "frame 3");

        let frames: Vec<_> = recording.frames().expect("opens").collect::<Result<_, _>>().expect("sound");
        assert_eq!(
            frames.iter().map(|(frame, _)| frame).collect::<Vec<_>>(),
            recording.survey.iter().collect::<Vec<_>>()
        );
        assert_eq!(frames[1], (recording.survey[1].clone(), picture(4)));
        let mut images = Vec::new();
        let every_image = |sequence, stamp_ns, _: &[u8]| {
            images.push((sequence, stamp_ns));
            sequence < 3
        };
        Recording::for_each_image(&path, every_image).expect("sound");
        assert_eq!(images, [(1, 1), (2, 2), (3, 3)], "stops when told to");
    }

    #[test]
    fn spacing_counts_from_the_last_frame_kept_and_origins_can_be_moved() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let path = folder.path().join("drive.mcap");
        write_drive(&path, Some(DONUT), &[(1, 10.0, true), (2, 10.6, true), (3, 11.2, true), (4, 11.9, true)]);
        let mut recording = Recording::open(&path).expect("sound");
        let old = Geodetic { latitude_deg: 48.0, longitude_deg: 11.0, altitude_m: 500.0 };
        let new = Geodetic { longitude_deg: 11.001, ..old };
        assert!(!recording.move_origin(new), "it does not know its own");
        recording.origin = Some(old);
        assert!(recording.move_origin(new));
        // A thousandth of a degree at 48 degrees north: a cos φ / sqrt(1 - e² sin² φ) plus the altitude.
        let [east_m, north_m] = recording.survey[0].position_m;
        assert!((east_m - (10.0 - 74.634)).abs() < 0.01 && north_m.abs() < 0.001, "{east_m} {north_m}");

        // Half a metre a frame, and a spacing a little larger: hardly more than one in five goes.
        let mut thinned = recording.clone();
        let first = thinned.survey[0].clone();
        let frame = |i: usize| SurveyFrame { position_m: [0.5 * i as f64, 0.0], index: i, ..first.clone() };
        thinned.survey = (0..1000).map(frame).collect();
        thinned.thin(0.5 * 999.0 / 800.0);
        assert!((799..=801).contains(&thinned.survey.len()), "{}", thinned.survey.len());

        recording.keep_spaced(1.0);
        assert_eq!(recording.survey.iter().map(|frame| frame.index).collect::<Vec<_>>(), [1, 3]);
        let frames: Vec<_> = recording.frames().expect("opens").collect::<Result<_, _>>().expect("sound");
        assert_eq!(frames.iter().map(|(frame, _)| frame.index).collect::<Vec<_>>(), [1, 3]);
    }

    #[test]
    fn what_training_cannot_do_without_is_demanded() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let path = folder.path().join("drive.mcap");
        let outside = DONUT.replace("15.0", "25.0");
        let good: &[Pair] = &[(1, 10.0, true)];
        let table: [(Option<&str>, &[Pair], &str); 4] = [
            (None, good, "no calibration"),
            (Some(&outside), good, "bad calibration"),
            (Some("{}"), good, "bad calibration"),
            (Some(DONUT), &[(1, 0.0, false)], "4 images and 1 survey pairs of which 0"),
        ];
        for (calibration, pairs, expected) in table {
            write_drive(&path, calibration, pairs);
            let message = Recording::open(&path).expect_err(expected).to_string();
            assert!(message.contains(expected) && message.contains("drive.mcap"), "{message}");
            assert!(Recording::open_any(&path).is_ok(), "it can still be looked at");
        }
    }
}
