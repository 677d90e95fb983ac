//! One pass over a recording: everything but the images.

use std::{
    collections::{BTreeMap, BTreeSet},
    path::Path,
};

use mcap::records::{MessageHeader, Record, op};
use prost::Message;

use super::{
    error::RecordingError,
    health::DriveHealth,
    proto::omniloc,
    reader::{Recording, SurveyFrame, TopicSummary, decode_image, is_topic},
    records::{ChannelFacts, Channels, parse, visit_chunk},
    topics::{self, metadata},
};
use crate::{
    jpeg,
    types::{DonutCalibration, Geodetic},
};

/// What one pass over the file gathers.
#[derive(Default)]
pub(super) struct Scan {
    channels: Channels,
    topics: BTreeMap<String, TopicSummary>,
    metadata: BTreeMap<String, BTreeMap<String, String>>,
    calibration_json: Option<Vec<u8>>,
    image_size_px: Option<(usize, usize)>,
    /// Frame numbers in the order of the file.
    images: Vec<u32>,
    pairs: BTreeMap<u32, (SurveyFrame, Option<String>)>,
    health: DriveHealth,
}

impl Scan {
    pub fn read_top_record(&mut self, opcode: u8, body: &[u8]) -> Result<(), String> {
        match opcode {
            op::CHUNK => visit_chunk(body, |opcode, body| self.read_record(opcode, body)),
            op::METADATA => {
                if let Record::Metadata(record) = parse(opcode, body)? {
                    self.metadata.entry(record.name).or_default().extend(record.metadata);
                }
                Ok(())
            }
            op::ATTACHMENT => {
                if let Record::Attachment { header, data, .. } = parse(opcode, body)?
                    && header.name == topics::CALIBRATION_ATTACHMENT
                {
                    self.calibration_json = Some(data.into_owned());
                }
                Ok(())
            }
            _ => self.read_record(opcode, body),
        }
    }

    fn read_record(&mut self, opcode: u8, body: &[u8]) -> Result<(), String> {
        let Self { channels, topics, image_size_px, images, pairs, health, .. } = self;
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
            } else if is_topic(channel, &topics::STATUS) {
                let status = omniloc::Status::decode(data).map_err(|error| format!("{}: {error}", channel.topic))?;
                health.add_status(&status);
            } else if is_topic(channel, &topics::DROPPED) {
                let loss = omniloc::Dropped::decode(data).map_err(|error| format!("{}: {error}", channel.topic))?;
                health.add_loss(loss);
            }
            Ok(())
        })
    }

    pub fn into_recording(mut self, path: &Path) -> Recording {
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
        Recording {
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
            health: self.health,
        }
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

fn origin_from_metadata(entries: &BTreeMap<String, String>) -> Option<Geodetic> {
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
