//! Is a recording sound? Reads all of it and reports everything that is wrong, not only the first fault.

use std::{
    collections::{BTreeMap, BTreeSet},
    io::Read,
    path::Path,
};

use mcap::records::{MessageHeader, Record, Statistics, op};
use prost::Message;

use super::{
    error::RecordingError,
    proto::{foxglove, omniloc},
    reader::{TopicSummary, is_topic},
    records::{ChannelFacts, Channels, RecordFile, parse, visit_chunk},
    scan::{count, parse_calibration},
    topics::{self, metadata},
};
use crate::jpeg;

/// What was found. A recording is sound if there are no problems; notes are facts worth knowing.
#[derive(Debug, Default, Clone, PartialEq, Eq)]
pub struct Verdict {
    pub problems: Vec<String>,
    /// Problems beyond [`MAX_LISTED`](Self::MAX_LISTED) are only counted.
    pub unlisted_problems: u64,
    pub notes: Vec<String>,
    pub chunks: u64,
    pub messages: u64,
    pub images: u64,
    pub pairs: u64,
    /// No byte is missing or damaged, and the indexes agree with what is there. Contents may still have problems.
    pub is_complete: bool,
}

impl Verdict {
    pub const MAX_LISTED: usize = 50;

    pub fn is_sound(&self) -> bool {
        self.problems.is_empty()
    }

    fn problem(&mut self, text: String) {
        if self.problems.len() < Self::MAX_LISTED {
            self.problems.push(text);
        } else {
            self.unlisted_problems += 1;
        }
    }
}

/// Checks CRCs, indexes against contents, every message, every image's outline, pairs against images, calibration.
///
/// # Errors
/// Only if the file cannot be read; damage is in the verdict.
pub fn verify(path: &Path) -> Result<Verdict, RecordingError> {
    verify_opened(path, RecordFile::open(path))
}

/// [`verify`] of a recording of `size` bytes from anywhere; `path` is what it is called in messages.
pub(super) fn verify_reader(
    path: &Path,
    reader: impl Read + Send + 'static,
    size: u64,
) -> Result<Verdict, RecordingError> {
    verify_opened(path, RecordFile::from_reader(path, Box::new(reader), size))
}

fn verify_opened(path: &Path, file: Result<RecordFile, RecordingError>) -> Result<Verdict, RecordingError> {
    let mut check = Check::default();
    let mut file = match file {
        Err(error @ RecordingError::NotMcap { .. }) => {
            check.verdict.problem(error.to_string());
            return Ok(check.verdict);
        }
        outcome => outcome?,
    };
    loop {
        match file.next() {
            Ok(Some(record)) => check.read_top_record(record.opcode, record.offset, record.body, record.section_fault),
            Ok(None) => break,
            Err(error @ RecordingError::CannotRead { .. }) => return Err(error),
            Err(error) => {
                check.verdict.problem(error.to_string());
                check.was_cut = true;
                break;
            }
        }
    }
    Ok(check.finish(path))
}

#[derive(Default)]
struct Check {
    verdict: Verdict,
    was_cut: bool,
    /// A CRC does not fit, or a record cannot be parsed.
    is_damaged: bool,
    channels: Channels,
    topics: BTreeMap<String, TopicSummary>,
    unknown_schemas: BTreeSet<String>,
    /// Offset of each chunk → earliest and latest log time in it.
    chunks: BTreeMap<u64, Option<(u64, u64)>>,
    indexed_chunks: BTreeSet<u64>,
    /// Offsets of the records that the summary has an index for, as found and as indexed.
    attachments: BTreeSet<u64>,
    metadata: BTreeSet<u64>,
    indexed_attachments: BTreeSet<u64>,
    indexed_metadata: BTreeSet<u64>,
    indexed_messages: u64,
    statistics: Option<Statistics>,
    calibration_json: Option<Vec<u8>>,
    image_size_px: Option<(usize, usize)>,
    last_image: Option<(u32, u64)>,
    images: BTreeSet<u32>,
    pairs: BTreeSet<u32>,
    invalid_pairs: u64,
    /// Without Huffman tables.
    incomplete_images: u64,
    /// The next image was damaged when it was recorded: a loss with its stamp says so.
    known_damage_ns: Option<u64>,
    damaged_images: u64,
    /// The recording itself says that something is missing from it.
    states_losses: bool,
}

impl Check {
    fn read_top_record(&mut self, opcode: u8, offset: u64, body: &[u8], section_fault: Option<String>) {
        if let Some(fault) = section_fault {
            self.is_damaged = true;
            self.verdict.problem(format!("byte {offset}: {fault}"));
        }
        if opcode == op::CHUNK {
            self.read_chunk(offset, body);
            return;
        }
        match parse(opcode, body) {
            Err(fault) => {
                self.is_damaged = true;
                self.verdict.problem(format!("byte {offset}: {fault}"));
            }
            Ok(Record::Attachment { header, data, .. }) => {
                self.attachments.insert(offset);
                if header.name == topics::CALIBRATION_ATTACHMENT {
                    self.calibration_json = Some(data.into_owned());
                }
            }
            Ok(Record::Metadata(record)) => {
                self.metadata.insert(offset);
                self.states_losses |= record.name == metadata::RECOVERY;
            }
            Ok(Record::AttachmentIndex(index)) => drop(self.indexed_attachments.insert(index.offset)),
            Ok(Record::MetadataIndex(index)) => drop(self.indexed_metadata.insert(index.offset)),
            Ok(Record::MessageIndex(index)) => self.indexed_messages += index.records.len() as u64,
            Ok(Record::Statistics(statistics)) => self.statistics = Some(statistics),
            Ok(Record::ChunkIndex(index)) => {
                self.indexed_chunks.insert(index.chunk_start_offset);
                match self.chunks.get(&index.chunk_start_offset) {
                    None => self.verdict.problem(format!(
                        "summary: a chunk is said to be at byte {}, but none starts there",
                        index.chunk_start_offset
                    )),
                    Some(Some(times)) if *times != (index.message_start_time, index.message_end_time) => {
                        self.verdict.problem(format!(
                            "summary: times of the chunk at byte {} differ from its messages",
                            index.chunk_start_offset
                        ));
                    }
                    Some(_) => {}
                }
            }
            Ok(_) => {
                if let Err(fault) = self.read_record(opcode, body, &mut None) {
                    self.verdict.problem(format!("byte {offset}: {fault}"));
                }
            }
        }
    }

    fn read_chunk(&mut self, offset: u64, body: &[u8]) {
        self.verdict.chunks += 1;
        let mut times = None;
        let outcome = visit_chunk(body, |opcode, body| {
            // A bad message must not hide the rest of its chunk.
            if let Err(fault) = self.read_record(opcode, body, &mut times) {
                self.verdict.problem(format!("chunk at byte {offset}: {fault}"));
            }
            Ok(())
        });
        if let Err(fault) = outcome {
            self.is_damaged = true;
            self.verdict.problem(format!("chunk at byte {offset}: {fault}"));
        }
        self.chunks.insert(offset, times);
    }

    fn read_record(&mut self, opcode: u8, body: &[u8], times: &mut Option<(u64, u64)>) -> Result<(), String> {
        let mut channels = std::mem::take(&mut self.channels);
        let outcome = channels.read_record(opcode, body, |channel, header, data| {
            let (first, last) = times.unwrap_or((header.log_time, header.log_time));
            *times = Some((first.min(header.log_time), last.max(header.log_time)));
            self.verdict.messages += 1;
            count(&mut self.topics, channel, header);
            self.read_message(channel, header, data)
        });
        self.channels = channels;
        outcome
    }

    fn read_message(&mut self, channel: &ChannelFacts, header: &MessageHeader, data: &[u8]) -> Result<(), String> {
        let wrong = |error: prost::DecodeError| {
            format!("message {} on {} is no {}: {error}", header.sequence, channel.topic, channel.schema_name)
        };
        match channel.schema_name.as_str() {
            "foxglove.CompressedImage" => {
                let image = foxglove::CompressedImage::decode(data).map_err(wrong)?;
                self.read_image(channel, header, &image)?;
            }
            "omniloc.SurveyPair" => {
                let pair = omniloc::SurveyPair::decode(data).map_err(wrong)?;
                self.read_pair(&pair)?;
            }
            "foxglove.LocationFix" => drop(foxglove::LocationFix::decode(data).map_err(wrong)?),
            "foxglove.PoseInFrame" => drop(foxglove::PoseInFrame::decode(data).map_err(wrong)?),
            "omniloc.Heading" => drop(omniloc::Heading::decode(data).map_err(wrong)?),
            "omniloc.SerialChunk" => drop(omniloc::SerialChunk::decode(data).map_err(wrong)?),
            "omniloc.ClockOffset" => drop(omniloc::ClockOffset::decode(data).map_err(wrong)?),
            "omniloc.Pulse" => drop(omniloc::Pulse::decode(data).map_err(wrong)?),
            "omniloc.PositionEstimate" => {
                let estimate = omniloc::PositionEstimate::decode(data).map_err(wrong)?;
                check_estimate(&estimate)?;
            }
            "omniloc.Status" => drop(omniloc::Status::decode(data).map_err(wrong)?),
            "omniloc.Dropped" => {
                let dropped = omniloc::Dropped::decode(data).map_err(wrong)?;
                self.states_losses = true;
                if dropped.topic == topics::CAMERA_IMAGE.name {
                    self.known_damage_ns = Some(header.publish_time);
                }
            }
            other => drop(self.unknown_schemas.insert(format!("{} ({other})", channel.topic))),
        }
        Ok(())
    }

    fn read_image(
        &mut self,
        channel: &ChannelFacts,
        header: &MessageHeader,
        image: &foxglove::CompressedImage,
    ) -> Result<(), String> {
        if !is_topic(channel, &topics::CAMERA_IMAGE) {
            return Ok(());
        }
        let sequence = header.sequence;
        self.verdict.images += 1;
        if !self.images.insert(sequence) {
            return Err(format!("image {sequence} is there twice"));
        }
        if let Some((last, last_ns)) = self.last_image.replace((sequence, header.publish_time))
            && (sequence < last || header.publish_time < last_ns)
        {
            return Err(format!("image {sequence} is before image {last} in number or time, but after it in the file"));
        }
        if self.known_damage_ns.take() == Some(header.publish_time) {
            self.damaged_images += 1;
            return Ok(());
        }
        let info = jpeg::scan(&image.data).map_err(|fault| format!("image {sequence}: {fault}"))?;
        let size_px = (info.width_px, info.height_px);
        let expected = *self.image_size_px.get_or_insert(size_px);
        if size_px != expected {
            return Err(format!("image {sequence} is {size_px:?} px, expected {expected:?} like the first"));
        }
        if !info.has_huffman_tables {
            self.incomplete_images += 1;
        }
        Ok(())
    }

    fn read_pair(&mut self, pair: &omniloc::SurveyPair) -> Result<(), String> {
        let frame = pair.frame_sequence;
        self.verdict.pairs += 1;
        let sequence = u32::try_from(frame).map_err(|_| format!("pair of frame {frame}, expected below 2^32"))?;
        if !self.pairs.insert(sequence) {
            return Err(format!("frame {frame} has two pairs"));
        }
        self.invalid_pairs += u64::from(!pair.valid);
        if pair.valid && !(pair.east_m.is_finite() && pair.north_m.is_finite()) {
            return Err(format!("pair of frame {frame} is valid, but its position is not a number"));
        }
        Ok(())
    }

    fn finish(mut self, path: &Path) -> Verdict {
        if !self.was_cut {
            let problems = self.verdict.problems.len() as u64 + self.verdict.unlisted_problems;
            self.compare_with_statistics();
            self.compare_with_indexes();
            let agrees = self.verdict.problems.len() as u64 + self.verdict.unlisted_problems == problems;
            self.verdict.is_complete = agrees && !self.is_damaged;
        }
        let imageless = self.pairs.difference(&self.images).count();
        if imageless > 0 {
            let text = format!("{imageless} pairs belong to images that are not in the recording");
            if self.states_losses {
                self.verdict.notes.push(format!("{text}, which says that it lost some"));
            } else {
                self.verdict.problem(text);
            }
        }
        let pairless = self.images.difference(&self.pairs).count();
        let mut note = |count: u64, text: &str| {
            if count > 0 {
                self.verdict.notes.push(format!("{count} {text}"));
            }
        };
        note(pairless as u64, "images have no survey pair and are not used for training");
        note(self.damaged_images, "images were damaged when they were recorded, as /dropped says");
        note(self.incomplete_images, "images have no Huffman tables; some programs cannot show them");
        note(self.invalid_pairs, "survey pairs are marked invalid and are not used for training");
        if !self.unknown_schemas.is_empty() {
            let topics: Vec<&str> = self.unknown_schemas.iter().map(String::as_str).collect();
            self.verdict.notes.push(format!("not checked, schema unknown: {}", topics.join(", ")));
        }
        match &self.calibration_json {
            None => self.verdict.notes.push("no calibration; training needs one".into()),
            Some(json) => {
                if let Err(error) = parse_calibration(path, json, self.image_size_px) {
                    let cause = std::error::Error::source(&error).map(|cause| format!(": {cause}")).unwrap_or_default();
                    self.verdict.problem(format!("{error}{cause}"));
                }
            }
        }
        self.verdict
    }

    fn compare_with_statistics(&mut self) {
        let Some(statistics) = self.statistics.take() else {
            self.verdict.problem("summary: no statistics record".into());
            return;
        };
        let counts = [
            ("messages", statistics.message_count, self.verdict.messages),
            ("chunks", statistics.chunk_count.into(), self.verdict.chunks),
            ("attachments", statistics.attachment_count.into(), self.attachments.len() as u64),
            ("metadata records", statistics.metadata_count.into(), self.metadata.len() as u64),
        ];
        for (what, stated, found) in counts {
            if stated != found {
                self.verdict.problem(format!("summary: {stated} {what} stated, {found} found"));
            }
        }
        let mut stated_by_topic: BTreeMap<&str, u64> = BTreeMap::new();
        for (&id, &stated) in &statistics.channel_message_counts {
            let sum = stated_by_topic.entry(self.channels.topic(id).unwrap_or("an unknown channel")).or_default();
            *sum = sum.saturating_add(stated);
        }
        for (topic, stated) in stated_by_topic {
            let found = self.topics.get(topic).map_or(0, |summary| summary.messages);
            if stated != found {
                self.verdict.problem(format!("summary: {stated} messages stated on {topic}, {found} found"));
            }
        }
    }

    /// Other programs may leave an index out; one that is there must be right.
    fn compare_with_indexes(&mut self) {
        let unindexed = self.chunks.keys().filter(|offset| !self.indexed_chunks.contains(offset)).count();
        if unindexed > 0 {
            self.verdict.problem(format!("summary: {unindexed} chunks are missing from the index"));
        }
        for (what, found, indexed) in [
            ("attachments", &self.attachments, &self.indexed_attachments),
            ("metadata records", &self.metadata, &self.indexed_metadata),
        ] {
            if !indexed.is_empty() && indexed != found {
                self.verdict.problem(format!("summary: the index of {what} does not say where they are"));
            }
        }
        let (indexed, messages) = (self.indexed_messages, self.verdict.messages);
        if indexed != 0 && indexed != messages {
            self.verdict.problem(format!("{indexed} messages are in the chunks' indexes, {messages} in the chunks"));
        }
    }
}

/// A position is there exactly when the vehicle is localized.
fn check_estimate(estimate: &omniloc::PositionEstimate) -> Result<(), String> {
    let is_localized = estimate.state() == omniloc::position_estimate::State::Localized;
    let position_m = [estimate.east_m, estimate.north_m];
    let is_sound = if is_localized {
        position_m.iter().all(|coordinate| coordinate.is_some_and(f64::is_finite))
    } else {
        position_m == [None; 2]
    };
    let frame = estimate.frame_sequence;
    let state = estimate.state().as_str_name();
    let what = || format!("estimate of frame {frame} is {state}, but its position is {position_m:?}");
    is_sound.then_some(()).ok_or_else(what)
}

#[cfg(test)]
mod tests {
    use std::{fs, io::Cursor};

    use super::*;
    use crate::recording::RecordingWriter;

    fn picture(width_px: u32) -> Vec<u8> {
        let mut jpeg = Vec::new();
        image::codecs::jpeg::JpegEncoder::new(&mut jpeg)
            .encode(&vec![90; width_px as usize * 16], width_px, 16, image::ExtendedColorType::L8)
            .expect("encodes");
        jpeg
    }

    fn pair(east_m: f64) -> omniloc::SurveyPair {
        omniloc::SurveyPair { east_m, valid: true, ..Default::default() }
    }

    #[test]
    fn each_inconsistency_is_reported() {
        type Fill = fn(&mut RecordingWriter<Cursor<Vec<u8>>>) -> mcap::McapResult<()>;
        let lost_with_a_place = |rec: &mut RecordingWriter<Cursor<Vec<u8>>>| {
            let lost = omniloc::position_estimate::State::Lost.into();
            let estimate = omniloc::PositionEstimate { state: lost, east_m: Some(1.0), ..Default::default() };
            rec.write(&topics::POSE_ESTIMATE, 1, 0, &estimate)
        };
        let table: [(&str, Fill, &str); 7] = [
            ("no image", |rec| rec.write_pair(1, 0, pair(0.0)), "1 pairs belong to images that are not"),
            ("two pairs", |rec| rec.write_pair(1, 0, pair(0.0)).and(rec.write_pair(1, 0, pair(0.0))), "two pairs"),
            ("NaN", |rec| rec.write_pair(1, 0, pair(f64::NAN)), "not a number"),
            ("damaged", |rec| rec.write_image(1, 0, &picture(16)[..100]), "image 1: truncated"),
            (
                "sizes",
                |rec| rec.write_image(1, 0, &picture(16)).and(rec.write_image(2, 0, &picture(24))),
                "like the first",
            ),
            (
                "order",
                |rec| rec.write_image(2, 5, &picture(16)).and(rec.write_image(1, 4, &picture(16))),
                "before image 2",
            ),
            ("estimate", lost_with_a_place, "estimate of frame 0 is LOST, but its position is [Some(1.0), None]"),
        ];
        let folder = tempfile::tempdir().expect("a temporary folder");
        for (name, fill, expected) in table {
            let mut recording = RecordingWriter::new(Cursor::new(Vec::new())).expect("starts");
            fill(&mut recording).expect("writes");
            let path = folder.path().join("a.mcap");
            fs::write(&path, recording.finish().expect("finishes").into_inner()).expect("writes");
            let problems = verify(&path).expect("readable").problems;
            assert!(problems.iter().any(|problem| problem.contains(expected)), "{name}: {problems:?}");
        }
    }
}
