//! Writes recordings.

use std::{
    collections::BTreeMap,
    io::{Seek, Write},
};

use mcap::{Attachment, McapError, WriteOptions, Writer, records::MessageHeader, records::Metadata};
use prost::Message;

use super::{
    proto::{foxglove, omniloc},
    topics::{self, Topic},
};
use crate::types::PositionM;

/// Writes messages to MCAP: chunked, with CRCs and indexes. The bytes depend on what is written and on nothing else.
///
/// Chunks are not compressed: zstd at level 1 makes the recordings of our data sets 0.3 % smaller.
///
/// A message's *stamp* counts on the monotonic clock and becomes the publish time; log time and the protobuf timestamp
/// are the stamp plus the recording's constant offset, so that viewers show a date.
pub struct RecordingWriter<W: Write + Seek> {
    mcap: Writer<W>,
    /// Channel id by topic name; channels are made when they are first written to.
    channels: BTreeMap<&'static str, u16>,
    log_offset_ns: u64,
    /// The message being written; kept for its capacity.
    encoded: Vec<u8>,
}

impl<W: Write + Seek> RecordingWriter<W> {
    /// Starts a recording whose log times are its stamps.
    pub fn new(out: W) -> Result<Self, McapError> {
        Self::with_options(out, options(), 0)
    }

    /// Starts a recording that is only ever appended to: a chunk is written when it is complete, in one piece, and no
    /// byte is written twice. What has been synced is therefore not touched by later writes.
    ///
    /// `log_offset_ns`: log time minus stamp.
    pub fn appending(out: W, log_offset_ns: u64) -> Result<Self, McapError> {
        Self::with_options(out, options().disable_seeking(true), log_offset_ns)
    }

    fn with_options(out: W, options: WriteOptions, log_offset_ns: u64) -> Result<Self, McapError> {
        Ok(Self { mcap: options.create(out)?, channels: BTreeMap::new(), log_offset_ns, encoded: Vec::new() })
    }

    /// A metadata record: facts as text.
    pub fn write_metadata(&mut self, name: &str, entries: BTreeMap<String, String>) -> Result<(), McapError> {
        self.mcap.write_metadata(&Metadata { name: name.into(), metadata: entries })
    }

    /// A whole file kept inside the recording. `stamp_ns` is the recording's first stamp.
    pub fn attach(&mut self, name: &str, media_type: &str, stamp_ns: u64, data: &[u8]) -> Result<(), McapError> {
        self.mcap.attach(&Attachment {
            log_time: stamp_ns,
            create_time: stamp_ns,
            name: name.into(),
            media_type: media_type.into(),
            data: data.into(),
        })
    }

    /// The frame with this number, stamped with the start of its exposure.
    pub fn write_image(&mut self, sequence: u32, stamp_ns: u64, jpeg: &[u8]) -> Result<(), McapError> {
        let mut encoded = std::mem::take(&mut self.encoded);
        encode_image(&mut encoded, self.timestamp(stamp_ns), jpeg);
        let outcome = self.write_encoded(&topics::CAMERA_IMAGE, sequence, stamp_ns, &encoded);
        self.encoded = encoded;
        outcome
    }

    /// Where the vehicle was at frame `sequence`; as pair and, if valid, as pose for viewers.
    pub fn write_pair(&mut self, sequence: u32, stamp_ns: u64, pair: omniloc::SurveyPair) -> Result<(), McapError> {
        let (pair, pose) = survey_messages(self.timestamp(stamp_ns), sequence, pair);
        self.write(&topics::SURVEY_PAIR, sequence, stamp_ns, &pair)?;
        match pose {
            Some(pose) => self.write(&topics::SURVEY_POSE, sequence, stamp_ns, &pose),
            None => Ok(()),
        }
    }

    /// A message on a topic. `sequence` is the frame's number where the message belongs to one.
    pub fn write<M: Message>(
        &mut self,
        topic: &Topic,
        sequence: u32,
        stamp_ns: u64,
        message: &M,
    ) -> Result<(), McapError> {
        let mut encoded = std::mem::take(&mut self.encoded);
        encoded.clear();
        message.encode(&mut encoded).expect("a vector grows as needed");
        let outcome = self.write_encoded(topic, sequence, stamp_ns, &encoded);
        self.encoded = encoded;
        outcome
    }

    /// A message that is encoded already; its timestamp must be [`timestamp`](Self::timestamp) of the stamp.
    pub fn write_encoded(
        &mut self,
        topic: &Topic,
        sequence: u32,
        stamp_ns: u64,
        message: &[u8],
    ) -> Result<(), McapError> {
        let channel_id = self.channel(topic)?;
        let log_time = stamp_ns.saturating_add(self.log_offset_ns);
        self.mcap
            .write_to_known_channel(&MessageHeader { channel_id, sequence, log_time, publish_time: stamp_ns }, message)
    }

    /// The timestamp that a message with this stamp carries.
    pub fn timestamp(&self, stamp_ns: u64) -> prost_types::Timestamp {
        timestamp(stamp_ns.saturating_add(self.log_offset_ns))
    }

    /// Writes down a topic's schema before there is a message: messages cannot be read without it.
    pub fn declare(&mut self, topic: &Topic) -> Result<(), McapError> {
        self.channel(topic).map(drop)
    }

    fn channel(&mut self, topic: &Topic) -> Result<u16, McapError> {
        if let Some(&id) = self.channels.get(topic.name) {
            return Ok(id);
        }
        let schema_id = self.mcap.add_schema(topic.schema_name, "protobuf", topic.schema)?;
        let id = self.mcap.add_channel(schema_id, topic.name, "protobuf", &BTreeMap::new())?;
        self.channels.insert(topic.name, id);
        Ok(id)
    }

    /// Closes the chunk and hands everything to the operating system; a cut after this loses nothing from before.
    pub fn flush(&mut self) -> Result<(), McapError> {
        self.mcap.flush()
    }

    /// Writes the indexes and the end of the file. A recording that was not finished must be recovered.
    pub fn finish(mut self) -> Result<W, McapError> {
        self.mcap.finish()?;
        Ok(self.mcap.into_inner())
    }

    /// The file as it is, without the chunk that is not complete and without indexes.
    pub fn abandon(self) -> W {
        self.mcap.into_inner()
    }
}

fn options() -> WriteOptions {
    let library = format!("omniloc/{} {}", env!("CARGO_PKG_VERSION"), mcap::LIBRARY_IDENTIFIER);
    WriteOptions::new().compression(None).library(library)
}

/// Encodes a `foxglove.CompressedImage` as prost does, but copies the JPEG once and allocates nothing: the timestamp
/// (field 1), the image (2), its format (3) and the frame of reference (4).
fn encode_image(encoded: &mut Vec<u8>, timestamp: prost_types::Timestamp, jpeg: &[u8]) {
    use prost::encoding::{WireType, encode_key, encode_varint, message};
    encoded.clear();
    encoded.reserve(jpeg.len() + 64);
    message::encode(1, &timestamp, encoded);
    if !jpeg.is_empty() {
        encode_key(2, WireType::LengthDelimited, encoded);
        encode_varint(jpeg.len() as u64, encoded);
        encoded.extend_from_slice(jpeg);
    }
    for (field, text) in [(3, "jpeg"), (4, topics::CAMERA_FRAME)] {
        encode_key(field, WireType::LengthDelimited, encoded);
        encode_varint(text.len() as u64, encoded);
        encoded.extend_from_slice(text.as_bytes());
    }
}

/// A pair as it is recorded, and, if it is valid, as pose for viewers. The pair is what counts.
pub(super) fn survey_messages(
    timestamp: prost_types::Timestamp,
    sequence: u32,
    pair: omniloc::SurveyPair,
) -> (omniloc::SurveyPair, Option<foxglove::PoseInFrame>) {
    let pair = omniloc::SurveyPair { timestamp: Some(timestamp), frame_sequence: sequence.into(), ..pair };
    let pose = pair.valid.then(|| pose_message(timestamp, [pair.east_m, pair.north_m], pair.yaw_rad));
    (pair, pose)
}

/// A pose in the map frame, for viewers.
///
/// The message cannot leave its orientation out: without a yaw it says yaw 0.
pub(super) fn pose_message(
    timestamp: prost_types::Timestamp,
    [east_m, north_m]: PositionM,
    yaw_rad: Option<f64>,
) -> foxglove::PoseInFrame {
    let (z, w) = libm::sincos(yaw_rad.unwrap_or(0.0) / 2.0);
    foxglove::PoseInFrame {
        timestamp: Some(timestamp),
        frame_id: topics::MAP_FRAME.into(),
        pose: Some(foxglove::Pose {
            position: Some(foxglove::Vector3 { x: east_m, y: north_m, z: 0.0 }),
            orientation: Some(foxglove::Quaternion { x: 0.0, y: 0.0, z, w }),
        }),
    }
}

/// Protobuf's timestamp of a time \[ns\].
pub(super) fn timestamp(stamp_ns: u64) -> prost_types::Timestamp {
    prost_types::Timestamp { seconds: (stamp_ns / 1_000_000_000) as i64, nanos: (stamp_ns % 1_000_000_000) as i32 }
}

#[cfg(test)]
mod tests {
    use std::io::{self, Cursor};

    use super::*;

    /// A disk with room for so many bytes.
    struct FullDisk {
        room_bytes: u64,
        content: Cursor<Vec<u8>>,
    }

    impl Write for FullDisk {
        fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
            if self.content.position() + bytes.len() as u64 > self.room_bytes {
                return Err(io::ErrorKind::StorageFull.into());
            }
            self.content.write(bytes)
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    impl Seek for FullDisk {
        fn seek(&mut self, to: io::SeekFrom) -> io::Result<u64> {
            self.content.seek(to)
        }
    }

    #[test]
    fn a_full_disk_is_an_error_wherever_it_happens() {
        let write = |room_bytes| -> Result<(), McapError> {
            let mut recording = RecordingWriter::new(FullDisk { room_bytes, content: Cursor::default() })?;
            recording.write_metadata("source", BTreeMap::from([("name".into(), "test".into())]))?;
            recording.write_image(0, 0, &[7; 5000])?;
            recording.write_pair(0, 0, omniloc::SurveyPair { valid: true, ..Default::default() })?;
            recording.finish().map(drop)
        };
        write(1 << 20).expect("there is room");
        for room_bytes in (0..9000).step_by(100) {
            let error = write(room_bytes).expect_err("there is no room");
            assert!(matches!(error, McapError::Io(_)), "{room_bytes}: {error}");
        }
    }

    #[test]
    fn an_image_is_encoded_as_prost_does_it() {
        let mut encoded = vec![1, 2, 3];
        for (stamp_ns, length) in [(0, 0), (1, 1), (1_700_000_000_123_456_789, 127), (5, 128), (1_000_000_000, 200_000)]
        {
            let image = foxglove::CompressedImage {
                timestamp: Some(timestamp(stamp_ns)),
                data: (0..length).map(|i| i as u8).collect(),
                format: "jpeg".into(),
                frame_id: topics::CAMERA_FRAME.into(),
            };
            encode_image(&mut encoded, timestamp(stamp_ns), &image.data);
            assert!(encoded == image.encode_to_vec(), "{stamp_ns} {length}");
        }
    }

    /// Log time of the first message, its publish time, its timestamp \[ns\].
    fn times(bytes: &[u8]) -> (u64, u64, i64) {
        let message = mcap::MessageStream::new(bytes).expect("sound").next().expect("one").expect("sound");
        let pair = omniloc::SurveyPair::decode(&*message.data).expect("a pair");
        let timestamp = pair.timestamp.expect("stamped");
        (message.log_time, message.publish_time, timestamp.seconds * 1_000_000_000 + i64::from(timestamp.nanos))
    }

    #[test]
    fn log_time_is_the_stamp_plus_the_offset() {
        let mut recording =
            RecordingWriter::appending(Cursor::new(Vec::new()), 1_700_000_000_000_000_001).expect("starts");
        recording.write_pair(3, 5_000_000_000, omniloc::SurveyPair::default()).expect("writes");
        let bytes = recording.finish().expect("finishes").into_inner();
        assert_eq!(times(&bytes), (1_700_000_005_000_000_001, 5_000_000_000, 1_700_000_005_000_000_001));
    }
}
