//! What the devices of a recorded drive said, in the order it happened: for replays.

use std::{
    cmp::Reverse,
    collections::BinaryHeap,
    path::{Path, PathBuf},
};

use mcap::records::{MessageHeader, op};
use prost::Message;

use super::{
    error::RecordingError,
    proto::omniloc,
    reader::{decode_image, is_topic},
    records::{ChannelFacts, Channels, RecordFile, visit_chunk},
    topics,
};
use crate::types::{ClockReading, NS_PER_S};

/// Messages lie in a file in the order they were written; stamps differ from that by less than this. A frame is stamped
/// with its exposure and written after bytes that arrived later.
const REORDERING_NS: u64 = 2 * NS_PER_S;

/// One thing that a device said.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum DeviceRecord {
    Image {
        sequence: u32,
        jpeg: Vec<u8>,
    },
    Serial {
        baud: u32,
        bytes: Vec<u8>,
    },
    Pulse,
    /// The computer's clocks, once a second.
    Clock(ClockReading),
    /// Frames that the camera lost, or the next one is damaged: why.
    CameraLoss {
        count: u64,
        reason: String,
    },
}

/// A [`DeviceRecord`] and when it was, on the monotonic clock of its drive.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TimedRecord {
    pub stamp_ns: u64,
    pub record: DeviceRecord,
}

/// Reads a recording in the order of stamps, with memory for a few seconds.
pub struct DeviceRecords {
    path: PathBuf,
    file: RecordFile,
    channels: Channels,
    /// By stamp, then by order in the file.
    waiting: BinaryHeap<Reverse<Waiting>>,
    read: u64,
    newest_ns: u64,
    done: bool,
}

#[derive(Debug, PartialEq, Eq)]
struct Waiting {
    stamp_ns: u64,
    order: u64,
    record: DeviceRecord,
}

impl Ord for Waiting {
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        (self.stamp_ns, self.order).cmp(&(other.stamp_ns, other.order))
    }
}

impl PartialOrd for Waiting {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}

impl DeviceRecords {
    pub fn open(path: &Path) -> Result<Self, RecordingError> {
        Ok(Self {
            path: path.into(),
            file: RecordFile::open(path)?,
            channels: Channels::default(),
            waiting: BinaryHeap::new(),
            read: 0,
            newest_ns: 0,
            done: false,
        })
    }

    fn read_more(&mut self) -> Result<(), RecordingError> {
        let Self { file, channels, waiting, read, newest_ns, .. } = self;
        let Some(record) = file.next()? else {
            self.done = true;
            return Ok(());
        };
        let offset = record.offset;
        let mut take = |opcode: u8, body: &[u8]| {
            channels.read_record(opcode, body, |channel, header, data| {
                if let Some(record) = device_record(channel, header, data)? {
                    let stamp_ns = header.publish_time;
                    *newest_ns = stamp_ns.max(*newest_ns);
                    *read += 1;
                    waiting.push(Reverse(Waiting { stamp_ns, order: *read, record }));
                }
                Ok(())
            })
        };
        let outcome = match record.opcode {
            op::CHUNK => visit_chunk(record.body, take),
            opcode => take(opcode, record.body),
        };
        outcome.map_err(|what| RecordingError::Damaged { path: self.path.clone(), offset, what })
    }

    fn is_ready(&self) -> bool {
        let oldest_ns = self.waiting.peek().map(|Reverse(oldest)| oldest.stamp_ns);
        oldest_ns.is_some_and(|oldest_ns| self.newest_ns - oldest_ns > REORDERING_NS)
    }
}

impl Iterator for DeviceRecords {
    type Item = Result<TimedRecord, RecordingError>;

    fn next(&mut self) -> Option<Self::Item> {
        while !self.done && !self.is_ready() {
            if let Err(error) = self.read_more() {
                self.done = true;
                self.waiting.clear();
                return Some(Err(error));
            }
        }
        let Reverse(Waiting { stamp_ns, record, .. }) = self.waiting.pop()?;
        Some(Ok(TimedRecord { stamp_ns, record }))
    }
}

fn device_record(channel: &ChannelFacts, header: &MessageHeader, data: &[u8]) -> Result<Option<DeviceRecord>, String> {
    let record = if is_topic(channel, &topics::CAMERA_IMAGE) {
        DeviceRecord::Image { sequence: header.sequence, jpeg: decode_image(header, data)? }
    } else if is_topic(channel, &topics::GNSS_RAW) {
        let omniloc::SerialChunk { data, baud, .. } =
            omniloc::SerialChunk::decode(data).map_err(|error| format!("{}: {error}", channel.topic))?;
        DeviceRecord::Serial { baud, bytes: data }
    } else if is_topic(channel, &topics::GNSS_PULSE) {
        DeviceRecord::Pulse
    } else if is_topic(channel, &topics::CLOCK) {
        let omniloc::ClockOffset { monotonic_ns, realtime_ns, .. } =
            omniloc::ClockOffset::decode(data).map_err(|error| format!("{}: {error}", channel.topic))?;
        DeviceRecord::Clock(ClockReading { monotonic_ns, realtime_ns })
    } else if is_topic(channel, &topics::DROPPED) {
        let dropped = omniloc::Dropped::decode(data).map_err(|error| format!("{}: {error}", channel.topic))?;
        if dropped.topic != topics::CAMERA_IMAGE.name {
            return Ok(None);
        }
        DeviceRecord::CameraLoss { count: dropped.count, reason: dropped.reason }
    } else {
        return Ok(None);
    };
    Ok(Some(record))
}

#[cfg(test)]
mod tests {
    use std::{fs, io::Cursor};

    use super::*;
    use crate::recording::RecordingWriter;

    #[test]
    fn records_come_in_the_order_they_happened() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let path = folder.path().join("drive.mcap");
        let mut recording = RecordingWriter::new(Cursor::new(Vec::new())).expect("starts");
        let chunk = |baud| omniloc::SerialChunk { timestamp: None, data: vec![1, 2], baud };
        recording.write(&topics::GNSS_RAW, 0, 30, &chunk(1)).expect("writes");
        recording.write_image(5, 20, &[7]).expect("writes");
        recording.write(&topics::GNSS_PULSE, 0, 25, &omniloc::Pulse::default()).expect("writes");
        recording.write(&topics::GNSS_RAW, 0, 5 * NS_PER_S, &chunk(2)).expect("writes");
        recording.write_image(6, 4 * NS_PER_S, &[8]).expect("writes");
        fs::write(&path, recording.finish().expect("finishes").into_inner()).expect("writes");

        let records: Result<Vec<_>, _> = DeviceRecords::open(&path).expect("opens").collect();
        let records: Vec<_> = records.expect("sound").into_iter().map(|timed| (timed.stamp_ns, timed.record)).collect();
        let serial = |baud| DeviceRecord::Serial { baud, bytes: vec![1, 2] };
        let expected = [
            (20, DeviceRecord::Image { sequence: 5, jpeg: vec![7] }),
            (25, DeviceRecord::Pulse),
            (30, serial(1)),
            (4 * NS_PER_S, DeviceRecord::Image { sequence: 6, jpeg: vec![8] }),
            (5 * NS_PER_S, serial(2)),
        ];
        assert_eq!(records, expected);
    }
}
