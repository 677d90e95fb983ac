//! Reads recordings, one chunk at a time: a drive may be larger than the memory.

use std::{
    collections::{BTreeMap, BTreeSet, VecDeque},
    path::{Path, PathBuf},
};

use mcap::records::{MessageHeader, Record, op};
use prost::Message;

use super::{
    error::RecordingError,
    proto::{foxglove, omniloc},
    records::{ChannelFacts, Channels, RecordFile, parse, visit_chunk},
    topics::{self, metadata},
};
use crate::{
    jpeg,
    types::{DonutCalibration, Geodetic, PositionM},
};

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
#[derive(Debug)]
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
    calibration: Option<DonutCalibration>,
}

impl Recording {
    /// Opens a recording to train on or to evaluate: it must have a calibration and at least one usable frame.
    ///
    /// The whole file is read once, chunk by chunk, and all CRCs are checked.
    pub fn open(path: &Path) -> Result<Self, RecordingError> {
        let recording = Self::open_any(path)?;
        recording.calibration()?;
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
        Ok(recording)
    }

    /// Opens a recording that may lack its calibration or its positions, to look at it or to calibrate on it.
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
        scan.into_recording(path)
    }

    /// Where the donut lies in the images.
    pub fn calibration(&self) -> Result<&DonutCalibration, RecordingError> {
        self.calibration.as_ref().ok_or_else(|| RecordingError::NoCalibration { path: self.path.clone() })
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
        let mut file = RecordFile::open(path)?;
        let mut channels = Channels::default();
        let mut going = true;
        while let Some(record) = file.next()? {
            let offset = record.offset;
            let mut read = |opcode: u8, body: &[u8]| {
                channels.read_record(opcode, body, |channel, header, data| {
                    if going && is_topic(channel, &topics::CAMERA_IMAGE) {
                        going = visit(header.sequence, header.publish_time, &decode_image(header, data)?);
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
                if is_topic(channel, &topics::CAMERA_IMAGE) {
                    if let Some(frame) = waiting.remove(&header.sequence) {
                        ready.push_back((frame, decode_image(header, data)?));
                    }
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

fn decode_image(header: &MessageHeader, data: &[u8]) -> Result<Vec<u8>, String> {
    let image = foxglove::CompressedImage::decode(data)
        .map_err(|error| format!("image {} cannot be decoded: {error}", header.sequence))?;
    Ok(image.data)
}

/// What one pass over the file gathers.
#[derive(Default)]
struct Scan {
    channels: Channels,
    topics: BTreeMap<String, TopicSummary>,
    metadata: BTreeMap<String, BTreeMap<String, String>>,
    calibration_json: Option<Vec<u8>>,
    image_size_px: Option<(usize, usize)>,
    /// Frame numbers in the order of the file.
    images: Vec<u32>,
    pairs: BTreeMap<u32, (SurveyFrame, Option<String>)>,
}

impl Scan {
    fn read_top_record(&mut self, opcode: u8, body: &[u8]) -> Result<(), String> {
        match opcode {
            op::CHUNK => visit_chunk(body, |opcode, body| self.read_record(opcode, body)),
            op::METADATA => {
                if let Record::Metadata(record) = parse(opcode, body)? {
                    self.metadata.entry(record.name).or_default().extend(record.metadata);
                }
                Ok(())
            }
            op::ATTACHMENT => {
                if let Record::Attachment { header, data, .. } = parse(opcode, body)? {
                    if header.name == topics::CALIBRATION_ATTACHMENT {
                        self.calibration_json = Some(data.into_owned());
                    }
                }
                Ok(())
            }
            _ => self.read_record(opcode, body),
        }
    }

    fn read_record(&mut self, opcode: u8, body: &[u8]) -> Result<(), String> {
        let Self { channels, topics, image_size_px, images, pairs, .. } = self;
        channels.read_record(opcode, body, |channel, header, data| {
            count(topics, channel, header);
            if is_topic(channel, &topics::CAMERA_IMAGE) {
                images.push(header.sequence);
                if image_size_px.is_none() {
                    let info = jpeg::scan(&decode_image(header, data)?);
                    *image_size_px = info.ok().map(|info| (info.width_px, info.height_px));
                }
            } else if is_topic(channel, &topics::SURVEY_PAIR) {
                let pair = omniloc::SurveyPair::decode(data)
                    .map_err(|error| format!("survey pair cannot be decoded: {error}"))?;
                let sequence = u32::try_from(pair.frame_sequence)
                    .map_err(|_| format!("survey pair of frame {}, expected below 2^32", pair.frame_sequence))?;
                pairs.entry(sequence).or_insert_with(|| survey_frame(sequence, header.publish_time, pair));
            }
            Ok(())
        })
    }

    fn into_recording(mut self, path: &Path) -> Result<Recording, RecordingError> {
        let calibration = match &self.calibration_json {
            None => None,
            Some(json) => Some(parse_calibration(path, json, self.image_size_px)?),
        };
        let mut survey = Vec::new();
        let mut unusable = Vec::new();
        let mut images_without_pair = 0;
        let mut seen = BTreeSet::new();
        for image in &self.images {
            if !seen.insert(*image) {
                continue;
            }
            match self.pairs.remove(image) {
                Some((frame, None)) => survey.push(frame),
                Some((frame, Some(reason))) => unusable.push((frame, reason)),
                None => images_without_pair += 1,
            }
        }
        let imageless =
            |(frame, reason): (SurveyFrame, Option<String>)| (frame, reason.unwrap_or_else(|| "no image".into()));
        unusable.extend(std::mem::take(&mut self.pairs).into_values().map(imageless));
        unusable.sort_by_key(|(frame, _)| frame.index);

        let stated_name = self.metadata.get(metadata::SOURCE).and_then(|source| source.get("name")).cloned();
        let file_name = || path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        Ok(Recording {
            path: path.into(),
            name: stated_name.unwrap_or_else(file_name),
            origin: self.metadata.get(metadata::ORIGIN).and_then(origin_from_metadata),
            metadata: self.metadata,
            survey,
            unusable,
            images_without_pair,
            topics: self.topics,
            image_size_px: self.image_size_px,
            calibration_json: self.calibration_json,
            calibration,
        })
    }
}

pub(super) fn count(topics: &mut BTreeMap<String, TopicSummary>, channel: &ChannelFacts, header: &MessageHeader) {
    let stamp_ns = header.log_time;
    let new = || TopicSummary {
        schema_name: channel.schema_name.clone(),
        messages: 0,
        first_ns: stamp_ns,
        last_ns: stamp_ns,
    };
    let summary = topics.entry(channel.topic.clone()).or_insert_with(new);
    summary.messages += 1;
    summary.first_ns = summary.first_ns.min(stamp_ns);
    summary.last_ns = summary.last_ns.max(stamp_ns);
}

/// The calibration in an attachment, checked against the size of the images if that is known.
pub(super) fn parse_calibration(
    path: &Path,
    json: &[u8],
    image_size_px: Option<(usize, usize)>,
) -> Result<DonutCalibration, RecordingError> {
    let calibration: DonutCalibration = serde_json::from_slice(json)
        .map_err(|error| RecordingError::UnreadableCalibration { path: path.into(), what: error.to_string() })?;
    let checked = match image_size_px {
        Some((width_px, height_px)) => calibration.check_in_image(width_px, height_px),
        None => calibration.check(),
    };
    checked.map_err(|source| RecordingError::BadCalibration { path: path.into(), source })?;
    Ok(calibration)
}

pub(super) fn origin_from_metadata(entries: &BTreeMap<String, String>) -> Option<Geodetic> {
    let number = |key: &str| entries.get(key)?.parse::<f64>().ok();
    let origin = Geodetic {
        latitude_deg: number("latitude_deg")?,
        longitude_deg: number("longitude_deg")?,
        altitude_m: number("altitude_m")?,
    };
    origin.is_plausible().then_some(origin)
}

/// The frame of a pair, and why it must not be used.
fn survey_frame(sequence: u32, stamp_ns: u64, pair: omniloc::SurveyPair) -> (SurveyFrame, Option<String>) {
    let finite = pair.east_m.is_finite() && pair.north_m.is_finite() && pair.yaw_rad.is_none_or(f64::is_finite);
    let reason = match (pair.valid, finite) {
        (true, true) => None,
        (true, false) => Some("position or yaw is not a number".into()),
        (false, _) if pair.invalid_reason.is_empty() => Some("marked invalid without a reason".into()),
        (false, _) => Some(pair.invalid_reason),
    };
    let frame = SurveyFrame {
        index: sequence as usize,
        source_file: pair.source_file,
        stamp_ns,
        position_m: [pair.east_m, pair.north_m],
        yaw_rad: pair.yaw_rad,
        position_std_m: pair.position_std_m,
        interpolation_gap_s: pair.interpolation_gap_s,
        interpolation_gap_m: pair.interpolation_gap_m,
        serial_latency_s: pair.serial_latency_s,
        serial_latency_m: pair.serial_latency_m,
        time_s: pair.dataset_time_s,
    };
    (frame, reason)
}
