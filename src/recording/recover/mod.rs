//! Mends recordings that were cut off or damaged.
//!
//! A power cut leaves a file without its end, with zeros where data never reached the disk, or with holes in what was
//! written last. Everything that can be proven to be whole is copied into a new recording with indexes:
//!
//! - a chunk whose CRC fits, entirely;
//! - from a chunk that is cut off or has holes, the messages that touch no hole, decode, and carry the same time in the
//!   message and in its frame;
//! - nothing of a chunk whose CRC does not fit for no visible reason: a wrong position is worse than a missing one.
//!
//! Schemas and channels stand once, at the start, and again at the end of a complete file. Where both are lost, channels
//! are taken for those that the recorder declares, if a message is exactly of such a schema.
//!
//! `walk.rs` goes through the file, `judge.rs` decides on messages, `window.rs` reads, this file writes and reports.

mod judge;
mod ledger;
mod walk;
mod window;

use std::{
    collections::BTreeMap,
    io::{self, Read, Seek, SeekFrom, Write},
    path::Path,
};

use mcap::{McapError, WriteOptions, Writer, records::MessageHeader};

use super::{
    atomic::write_file_atomically,
    error::RecordingError,
    reader::TopicSummary,
    topics::metadata,
    verify::{Verdict, verify_reader},
};

/// A part of the file that could not be used.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct LostSpan {
    pub offset: u64,
    pub bytes: u64,
    /// Log times of the last message before it and of the first one after it \[ns\].
    pub after_ns: Option<u64>,
    pub before_ns: Option<u64>,
}

/// What was found in a recording.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Recovery {
    /// The data was complete; at most the index was missing.
    pub reached_the_end: bool,
    pub topics: BTreeMap<String, TopicSummary>,
    pub messages: u64,
    /// Damaged parts; neighbours are one. Those beyond [`MAX_SPANS`](Self::MAX_SPANS) are only counted in `lost_bytes`.
    pub spans: Vec<LostSpan>,
    /// Bytes that are not in the new recording, of these zeros (never reached the disk).
    pub lost_bytes: u64,
    pub zero_bytes: u64,
    /// Messages by topic that are known to be missing: found but damaged, or skipped in the sequence numbers.
    pub lost_messages: BTreeMap<String, u64>,
    pub unreadable_bytes: u64,
}

impl Recovery {
    pub const MAX_SPANS: usize = 50;

    pub fn lost_something(&self) -> bool {
        self.lost_bytes > 0 || !self.lost_messages.is_empty()
    }

    /// Earliest and latest log time that was kept \[ns\].
    pub fn times_ns(&self) -> Option<(u64, u64)> {
        let first = self.topics.values().map(|topic| topic.first_ns).min()?;
        Some((first, self.topics.values().map(|topic| topic.last_ns).max()?))
    }
}

#[derive(Debug, thiserror::Error)]
pub enum RecoverError {
    #[error("{path}: there is nothing to recover: no message in it is whole", path = path.display())]
    NothingThere { path: std::path::PathBuf },
    #[error("{path}: the recovered recording is not as it was written: {what}", path = path.display())]
    NotVerified { path: std::path::PathBuf, what: String },
    #[error(transparent)]
    Recording(#[from] RecordingError),
}

/// Writes what is whole in the recording `path` to the recording `out`, which appears complete and verified or not at
/// all; one that exists is replaced.
pub fn recover_file(path: &Path, out: &Path) -> Result<Recovery, RecoverError> {
    let cannot_read = |source| RecordingError::CannotRead { path: path.into(), source };
    let input = std::fs::File::open(path).map_err(cannot_read)?;
    if !input.metadata().map_err(cannot_read)?.is_file() {
        return Err(cannot_read(io::Error::other("not a regular file")).into());
    }
    let mut recovery = Recovery::default();
    write_file_atomically(out, |file| {
        let cannot_write = |cause| RecordingError::CannotWrite { path: out.into(), cause };
        recovery = recover(input, &mut *file, &mut || Ok(())).map_err(|error| match error {
            StreamError::Read(source) => cannot_read(source),
            StreamError::Write(cause) => cannot_write(cause),
        })?;
        if recovery.messages == 0 {
            return Err(RecoverError::NothingThere { path: path.into() });
        }
        // Read back before it gets its name; the clone shares its position with the file.
        let mut written = file.get_ref().try_clone().map_err(cannot_write)?;
        let size = file.stream_position().map_err(cannot_write)?;
        file.flush().and_then(|()| written.rewind()).map_err(cannot_write)?;
        let verdict = verify_reader(out, written, size)?;
        file.seek(SeekFrom::End(0)).map_err(cannot_write)?;
        compare(&verdict, &recovery).map_err(|what| RecoverError::NotVerified { path: out.into(), what })
    })?;
    Ok(recovery)
}

/// What is whole in these bytes, and the new recording of it. `None` if it cannot be written.
pub fn recover_bytes(bytes: &[u8]) -> Option<(Recovery, Vec<u8>)> {
    let mut out = io::Cursor::new(Vec::new());
    let recovery = recover(io::Cursor::new(bytes), &mut out, &mut || Ok(())).ok()?;
    Some((recovery, out.into_inner()))
}

/// Whether the new recording holds what was found in the old one.
pub(super) fn compare(verdict: &Verdict, recovery: &Recovery) -> Result<(), String> {
    if verdict.messages != recovery.messages {
        return Err(format!("{} messages, expected {}", verdict.messages, recovery.messages));
    }
    if !verdict.is_complete {
        return Err(verdict.problems.first().cloned().unwrap_or_else(|| "incomplete".into()));
    }
    Ok(())
}

/// Which side of a recovery failed.
#[derive(Debug)]
pub(super) enum StreamError {
    Read(io::Error),
    Write(io::Error),
}

/// Copies all that is whole from `input` to a new recording on `out`, which is complete afterwards.
///
/// `before_read` is called about once a MiB; its error ends the recovery.
pub(super) fn recover(
    input: impl Read + Seek,
    out: impl Write + Seek,
    before_read: &mut dyn FnMut() -> io::Result<()>,
) -> Result<Recovery, StreamError> {
    let mut copy = Copy::new(out).map_err(write_error)?;
    let recovery = walk::walk(input, before_read, &mut copy)?;
    copy.finish(&recovery).map_err(write_error)?;
    Ok(recovery)
}

fn write_error(error: McapError) -> StreamError {
    match error {
        McapError::Io(cause) => StreamError::Write(cause),
        other => StreamError::Write(io::Error::other(other)),
    }
}

/// The new recording. Ids, times and sequence numbers stay as they were.
struct Copy<W: Write + Seek> {
    mcap: Writer<W>,
}

impl<W: Write + Seek> Copy<W> {
    fn new(out: W) -> Result<Self, McapError> {
        let library = format!("omniloc/{} recover {}", env!("CARGO_PKG_VERSION"), mcap::LIBRARY_IDENTIFIER);
        let options = WriteOptions::new().compression(None).disable_seeking(true).library(library);
        Ok(Self { mcap: options.create(out)? })
    }

    /// Says in the recording itself that it was mended.
    fn finish(mut self, recovery: &Recovery) -> Result<(), McapError> {
        let mut entries = BTreeMap::from([
            ("version".to_owned(), env!("CARGO_PKG_VERSION").to_owned()),
            ("lost_bytes".to_owned(), recovery.lost_bytes.to_string()),
        ]);
        entries
            .extend(recovery.lost_messages.iter().map(|(topic, count)| (format!("lost {topic}"), count.to_string())));
        self.mcap.write_metadata(&mcap::records::Metadata { name: metadata::RECOVERY.into(), metadata: entries })?;
        self.mcap.finish().map(drop)
    }
}

/// Takes what the walk finds. Only errors of the output are errors; what contradicts itself is refused with `false`.
trait Sink {
    fn schema(&mut self, id: u16, name: &str, encoding: &str, data: &[u8]) -> Result<bool, StreamError>;
    fn channel(&mut self, channel: &mcap::records::Channel) -> Result<bool, StreamError>;
    fn message(&mut self, header: &MessageHeader, data: &[u8]) -> Result<(), StreamError>;
    fn metadata(&mut self, metadata: &mcap::records::Metadata) -> Result<(), StreamError>;
    fn attachment(&mut self, attachment: &mcap::Attachment) -> Result<(), StreamError>;
}

/// `false` if the input contradicts itself.
fn accepted<T>(outcome: Result<T, McapError>) -> Result<bool, StreamError> {
    match outcome {
        Ok(_) => Ok(true),
        Err(error @ (McapError::Io(_) | McapError::AttemptedWriteAfterFailure)) => Err(write_error(error)),
        Err(_) => Ok(false),
    }
}

impl<W: Write + Seek> Sink for Copy<W> {
    fn schema(&mut self, id: u16, name: &str, encoding: &str, data: &[u8]) -> Result<bool, StreamError> {
        accepted(self.mcap.add_schema_with_id(id, name, encoding, data))
    }

    fn channel(&mut self, channel: &mcap::records::Channel) -> Result<bool, StreamError> {
        accepted(self.mcap.add_channel_with_id(
            channel.id,
            channel.schema_id,
            &channel.topic,
            &channel.message_encoding,
            &channel.metadata,
        ))
    }

    fn message(&mut self, header: &MessageHeader, data: &[u8]) -> Result<(), StreamError> {
        self.mcap.write_to_known_channel(header, data).map_err(write_error)
    }

    fn metadata(&mut self, metadata: &mcap::records::Metadata) -> Result<(), StreamError> {
        self.mcap.write_metadata(metadata).map_err(write_error)
    }

    fn attachment(&mut self, attachment: &mcap::Attachment) -> Result<(), StreamError> {
        self.mcap.attach(attachment).map_err(write_error)
    }
}
