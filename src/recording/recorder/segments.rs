//! Segments: the files that one drive becomes.
//!
//! A segment is called after the boot and a number: `1f0c2a9b-000042.mcap`. The number counts on over all segments in
//! the folder, so that their order is known without a date. While a segment is being written its name ends with
//! `.part`. Every segment is a recording of its own, with settings, calibration and schemas at its start.

use std::{
    collections::BTreeMap,
    io::{self, Seek, SeekFrom, Write},
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
};

use mcap::McapError;

use super::{entry::Entry, storage::SegmentFile};
use crate::{
    recording::{
        topics::{self, metadata},
        writer::RecordingWriter,
    },
    types::ClockReading,
};

/// Boot and number of a segment. Ordered by age.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct SegmentName {
    pub number: u64,
    /// First 8 hexadecimal digits of the kernel's boot id.
    pub boot: String,
}

/// What a file of a segment is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Part {
    Finished,
    /// Being written, or cut off.
    Open,
    /// The mended copy of a cut one while it is being written.
    Mending,
    /// Nothing in it could be read.
    Damaged,
    /// An empty file that marks the segment: it is never deleted to make room.
    Keep,
}

impl Part {
    const ALL: [(Self, &str); 5] = [
        (Self::Finished, ".mcap"),
        (Self::Open, ".mcap.part"),
        (Self::Mending, ".mcap.mending"),
        (Self::Damaged, ".mcap.damaged"),
        (Self::Keep, ".keep"),
    ];
}

impl SegmentName {
    const BOOT_DIGITS: usize = 8;

    /// `boot_id`: `/proc/sys/kernel/random/boot_id`.
    pub fn new(boot_id: &str, number: u64) -> Self {
        let digits = boot_id.chars().filter(char::is_ascii_hexdigit).take(Self::BOOT_DIGITS);
        let boot: String = digits.map(|digit| digit.to_ascii_lowercase()).collect();
        Self { number, boot: format!("{boot:0<8}") }
    }

    pub fn file(&self, part: Part) -> String {
        let (_, ending) = Part::ALL[part as usize];
        format!("{}-{:06}{ending}", self.boot, self.number)
    }

    /// `None`: not a file of ours.
    pub fn parse(file: &str) -> Option<(Self, Part)> {
        let (boot, rest) = file.split_once('-')?;
        let digits = rest.find('.')?;
        let (number, ending) = rest.split_at(digits);
        let &(part, _) = Part::ALL.iter().find(|(_, known)| *known == ending)?;
        let name = Self { number: number.parse().ok()?, boot: boot.into() };
        (name.file(part) == file && boot.len() == Self::BOOT_DIGITS).then_some((name, part))
    }
}

/// What stands at the start of every segment.
#[derive(Debug, Clone, PartialEq)]
pub struct Head {
    /// Metadata records by name.
    pub metadata: BTreeMap<String, BTreeMap<String, String>>,
    pub calibration_json: Option<Vec<u8>>,
    /// Log time minus stamp, constant over the drive: realtime minus monotonic clock at its start.
    pub log_offset_ns: u64,
}

impl Head {
    /// `settings`: the resolved configuration as text. `vehicle`: its name. `start`: the clocks when the drive starts.
    pub fn new(settings: &str, vehicle: &str, boot_id: &str, start: ClockReading) -> Self {
        let log_offset_ns = u64::try_from(start.realtime_ns).unwrap_or(0).saturating_sub(start.monotonic_ns);
        let mut head = Self { metadata: BTreeMap::new(), calibration_json: None, log_offset_ns };
        let program = [("name", env!("CARGO_PKG_NAME")), ("version", env!("CARGO_PKG_VERSION")), ("command", "record")];
        head.set(metadata::PROGRAM, &program);
        head.set(metadata::SETTINGS, &[("toml", settings)]);
        head.set(metadata::SOURCE, &[("kind", "drive"), ("vehicle", vehicle), ("boot_id", boot_id.trim())]);
        head.set(metadata::CLOCK, &[("log_offset_ns", &log_offset_ns.to_string())]);
        let conventions = [
            ("map_frame", "ENU from the origin: x east, y north, z up [m]"),
            ("yaw", "from east, counter-clockwise [rad]"),
            (
                "stamps",
                "publish time: start of the exposure or arrival, monotonic clock [ns]; log time: the same as a date",
            ),
            ("pixels", "the centre of the top left pixel is (0, 0)"),
        ];
        head.set(metadata::CONVENTIONS, &conventions);
        head
    }

    /// What the drive is called where several are listed.
    pub fn name_source(&mut self, name: &str) {
        self.metadata.entry(metadata::SOURCE.into()).or_default().insert("name".into(), name.into());
    }

    /// The command that writes the recording, if it is not `record`.
    pub fn name_command(&mut self, command: &str) {
        self.metadata.entry(metadata::PROGRAM.into()).or_default().insert("command".into(), command.into());
    }

    /// Sets a metadata record.
    pub fn set(&mut self, name: &str, entries: &[(&str, &str)]) {
        let entries = entries.iter().map(|&(key, value)| (key.into(), value.into())).collect();
        self.metadata.insert(name.into(), entries);
    }
}

/// One recording being written, entry by entry, on a thread of its own or not: a replay that writes a single file uses
/// it without the rest of the recorder.
pub struct Segment<W: Write + Seek> {
    writer: RecordingWriter<W>,
    /// Of the next message on `/dropped`.
    losses: u32,
}

impl<W: Write + Seek> Segment<W> {
    /// Writes and flushes the head and all schemas: what comes later cannot be read without them.
    pub fn start(out: W, head: &Head, stamp_ns: u64) -> Result<Self, McapError> {
        let mut writer = RecordingWriter::appending(out, head.log_offset_ns)?;
        for (name, entries) in &head.metadata {
            writer.write_metadata(name, entries.clone())?;
        }
        if let Some(json) = &head.calibration_json {
            writer.attach(topics::CALIBRATION_ATTACHMENT, "application/json", stamp_ns, json)?;
        }
        for topic in topics::ALL {
            writer.declare(topic)?;
        }
        writer.flush()?;
        Ok(Self { writer, losses: 0 })
    }

    pub fn write(&mut self, entry: &Entry) -> Result<(), McapError> {
        match entry {
            Entry::Image { sequence, stamp_ns, jpeg } => self.writer.write_image(*sequence, *stamp_ns, jpeg),
            Entry::Message { topic, sequence, stamp_ns, payload } => {
                self.writer.write_encoded(topic, *sequence, *stamp_ns, payload)
            }
            Entry::Facts { name, entries } => self.writer.write_metadata(name, entries.clone()),
            Entry::Lost(loss) => {
                let message = loss.message(self.writer.timestamp(loss.last_ns));
                self.losses += 1;
                self.writer.write(&topics::DROPPED, self.losses - 1, loss.last_ns, &message)
            }
        }
    }

    /// Closes the chunk and flushes the output.
    pub fn flush(&mut self) -> Result<(), McapError> {
        self.writer.flush()
    }

    /// Writes the indexes and flushes the output.
    pub fn finish(self) -> Result<W, McapError> {
        self.writer.finish()
    }

    /// The output as it is.
    pub fn abandon(self) -> W {
        self.writer.abandon()
    }
}

/// Appends to a segment's file. To flush is to sync: the bytes are on the disk then.
pub(super) struct Appender {
    file: Box<dyn SegmentFile>,
    buffer: Vec<u8>,
    position: Arc<AtomicU64>,
}

impl Appender {
    /// Small writes are put together up to this size.
    const BUFFER_BYTES: usize = 64 << 10;

    /// Also returns how many bytes were written, for as long as that is of interest.
    pub fn new(file: Box<dyn SegmentFile>) -> (Self, Arc<AtomicU64>) {
        let position = Arc::new(AtomicU64::new(0));
        (Self { file, buffer: Vec::with_capacity(Self::BUFFER_BYTES), position: position.clone() }, position)
    }

    /// Gives up what was not synced, as far as the disk still listens.
    pub fn cut(&mut self, synced_bytes: u64) -> io::Result<()> {
        self.buffer.clear();
        self.file.set_len(synced_bytes)
    }

    fn write_buffer(&mut self) -> io::Result<()> {
        // After a failure the segment is abandoned: what is left in the buffer does not matter.
        let outcome = self.file.write_all(&self.buffer);
        self.buffer.clear();
        outcome
    }
}

impl Write for Appender {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        if self.buffer.len() + bytes.len() > Self::BUFFER_BYTES {
            self.write_buffer()?;
        }
        if bytes.len() >= Self::BUFFER_BYTES {
            self.file.write_all(bytes)?;
        } else {
            self.buffer.extend_from_slice(bytes);
        }
        self.position.fetch_add(bytes.len() as u64, Ordering::Relaxed);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        self.write_buffer()?;
        self.file.sync_data()
    }
}

impl Seek for Appender {
    /// Only says where it is.
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        let here = self.position.load(Ordering::Relaxed);
        match to {
            SeekFrom::Current(0) | SeekFrom::End(0) => Ok(here),
            SeekFrom::Start(offset) if offset == here => Ok(here),
            _ => Err(io::Error::new(io::ErrorKind::Unsupported, "a segment is only appended to")),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_read_back_and_others_are_not_ours() {
        let name = SegmentName::new("1F0C2A9B-5d1e-4c1b-9d0a-1234567890ab\n", 42);
        for (part, file) in [
            (Part::Finished, "1f0c2a9b-000042.mcap"),
            (Part::Open, "1f0c2a9b-000042.mcap.part"),
            (Part::Mending, "1f0c2a9b-000042.mcap.mending"),
            (Part::Damaged, "1f0c2a9b-000042.mcap.damaged"),
            (Part::Keep, "1f0c2a9b-000042.keep"),
        ] {
            assert_eq!(name.file(part), file);
            assert_eq!(SegmentName::parse(file), Some((name.clone(), part)));
        }
        assert_eq!(SegmentName::new("", 1_000_000).file(Part::Finished), "00000000-1000000.mcap");
        for stray in
            ["a.mcap", "1f0c2a9b-42.mcap", "1f0c2a9b-000042.mcap.old", "1f0c2a9b000042", "-.mcap", "drive-1.mcap"]
        {
            assert_eq!(SegmentName::parse(stray), None, "{stray}");
        }
    }

    #[test]
    fn the_offset_of_log_times_is_never_negative() {
        let offset = |realtime_ns| Head::new("", "", "", ClockReading { monotonic_ns: 50, realtime_ns }).log_offset_ns;
        assert_eq!([offset(-7), offset(20), offset(1_700)], [0, 0, 1_650]);
    }
}
