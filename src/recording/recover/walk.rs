//! Goes through a damaged recording and hands on what is whole.

use std::{
    collections::BTreeMap,
    io::{self, Read, Seek},
};

use mcap::{
    MAGIC,
    records::{MessageHeader, Record, op},
};

use super::{
    Recovery, Sink, StreamError,
    judge::{Trust, is_exactly, is_whole},
    ledger::Ledger,
    window::Window,
};
use crate::recording::{
    records::{FRAMING_BYTES, MAX_RECORD_BYTES, parse, visit_chunk},
    topics::{self, Topic},
};

const FRAMING: u64 = FRAMING_BYTES as u64;
/// Fixed part of a chunk's header: times, sizes, CRC, and the length of the compression's name.
const CHUNK_HEADER_BYTES: u64 = 8 + 8 + 8 + 4 + 4 + 8;
/// No compression has a longer name.
const MAX_COMPRESSION_NAME_BYTES: u64 = 16;

/// What the bytes at an offset are.
enum Step {
    /// Dealt with; go on there.
    Next(u64),
    /// No record.
    Lost,
    /// Only indexes follow.
    End,
}

/// Copies all that is whole from `input` to `sink`.
pub(super) fn walk<R: Read + Seek>(
    input: R,
    before_read: &mut dyn FnMut() -> io::Result<()>,
    sink: &mut impl Sink,
) -> Result<Recovery, StreamError> {
    let window = Window::new(input, before_read).map_err(StreamError::Read)?;
    // Enough for any real damage; forged records that each claim the rest of the file must not take forever.
    let budget_bytes = window.size.saturating_mul(16).saturating_add(64 << 20);
    let mut walk = Walk {
        window,
        sink,
        ledger: Ledger::default(),
        trust: Trust::Plain,
        schemas: BTreeMap::new(),
        budget_bytes,
        body: Vec::new(),
    };
    walk.run()?;
    Ok(walk.ledger.close(walk.window.unreadable_bytes))
}

struct Walk<'a, R: Read + Seek, S: Sink> {
    window: Window<'a, R>,
    sink: &'a mut S,
    ledger: Ledger,
    trust: Trust,
    /// Names.
    schemas: BTreeMap<u16, String>,
    /// Bytes that may still be looked at in vain.
    budget_bytes: u64,
    body: Vec<u8>,
}

impl<R: Read + Seek, S: Sink> Walk<'_, R, S> {
    fn run(&mut self) -> Result<(), StreamError> {
        let size = self.window.size;
        let mut offset = 0;
        if self.get(0, MAGIC.len() as u64)? == MAGIC {
            offset = MAGIC.len() as u64;
            self.read_summary()?;
        } else {
            self.trust = Trust::Damaged;
        }
        while offset < size {
            match self.step(offset)? {
                Step::Next(next) => offset = next,
                Step::End => return Ok(()),
                Step::Lost => {
                    let next = if self.budget_bytes == 0 { size } else { self.find_record(offset + 1)? };
                    self.lose(offset, next)?;
                    self.trust = Trust::Damaged;
                    offset = next;
                }
            }
        }
        Ok(())
    }

    fn get(&mut self, offset: u64, length: u64) -> Result<&[u8], StreamError> {
        self.window.get(offset, length).map_err(StreamError::Read)
    }

    /// Opcode and length of a body that may or may not be there.
    fn framing(&mut self, offset: u64) -> Result<Option<(u8, u64)>, StreamError> {
        let bytes = self.get(offset, FRAMING)?;
        Ok(bytes.first_chunk::<FRAMING_BYTES>().map(|&[opcode, length @ ..]| (opcode, u64::from_le_bytes(length))))
    }

    /// Whether a record may start here: the one before it then had the right length.
    fn may_start_record(&mut self, offset: u64) -> Result<bool, StreamError> {
        let rest = self.window.size.saturating_sub(offset);
        if rest == 0 {
            return Ok(true);
        }
        if rest < FRAMING {
            return Ok(MAGIC.starts_with(self.get(offset, rest)?) || op_is_known(self.get(offset, 1)?[0]));
        }
        Ok(match self.framing(offset)? {
            Some((op::CHUNK, _)) => true,
            Some((opcode, length)) => op_is_known(opcode) && length <= rest - FRAMING,
            None => false,
        })
    }

    fn step(&mut self, offset: u64) -> Result<Step, StreamError> {
        let Some((opcode, length)) = self.framing(offset)? else {
            let rest = self.window.size - offset;
            // The closing magic bytes without the footer before them cannot be; a few bytes of a record can.
            return Ok(if MAGIC.starts_with(self.get(offset, rest)?) { Step::End } else { Step::Lost });
        };
        if opcode == op::CHUNK {
            return self.chunk(offset, length);
        }
        let rest = self.window.size - offset - FRAMING;
        if length > rest.min(MAX_RECORD_BYTES) {
            // An index that was cut off holds no data.
            let cut_index = opcode == op::MESSAGE_INDEX && self.trust == Trust::Proven && length <= MAX_RECORD_BYTES;
            return Ok(if cut_index { Step::End } else { Step::Lost });
        }
        let next = offset + FRAMING + length;
        match opcode {
            op::SCHEMA | op::CHANNEL | op::MESSAGE | op::METADATA | op::ATTACHMENT => {}
            op::DATA_END if length != 4 => return Ok(Step::Lost),
            op::FOOTER if length != 20 => return Ok(Step::Lost),
            _ if !op_is_known(opcode) || !self.may_start_record(next)? => return Ok(Step::Lost),
            op::DATA_END | op::FOOTER => {
                self.ledger.note_end();
                return Ok(Step::End);
            }
            _ => return Ok(Step::Next(next)),
        }
        let mut body = std::mem::take(&mut self.body);
        body.clear();
        body.extend_from_slice(self.get(offset + FRAMING, length)?);
        let holed = self.window.touches_zero_sector(offset, next - offset).map_err(StreamError::Read)?;
        // Attachments have a CRC of their own.
        let whole = (!holed || opcode == op::ATTACHMENT) && self.record(opcode, &body, self.trust)?;
        if !whole && opcode == op::MESSAGE {
            self.ledger.note_damaged(&body);
        }
        self.body = body;
        if whole {
            return Ok(Step::Next(next));
        }
        self.budget_bytes = self.budget_bytes.saturating_sub(length);
        if self.budget_bytes == 0 || !self.may_start_record(next)? {
            return Ok(Step::Lost);
        }
        self.lose(offset, next)?;
        Ok(Step::Next(next))
    }

    fn chunk(&mut self, offset: u64, length: u64) -> Result<Step, StreamError> {
        let Some(header) = self.chunk_header(offset, length)? else { return Ok(Step::Lost) };
        let inside = offset + FRAMING + header.bytes;
        let size = self.window.size;
        let Some(end) = (offset + FRAMING).checked_add(length).filter(|&end| end <= size) else {
            if header.is_compressed {
                self.lose(offset, size)?;
                return Ok(Step::Next(size));
            }
            self.trust = self.trust.min(Trust::Plain);
            return Ok(Step::Next(inside));
        };
        if length > MAX_RECORD_BYTES {
            return Ok(Step::Lost);
        }
        let mut body = std::mem::take(&mut self.body);
        body.clear();
        body.extend_from_slice(self.get(offset + FRAMING, length)?);
        let trust = if header.has_crc { Trust::Proven } else { self.trust.min(Trust::Plain) };
        let mut visited = 0;
        let mut failed = None;
        let mut refused = false;
        let outcome = visit_chunk(&body, |opcode, body| {
            visited += 1;
            match self.record(opcode, body, trust) {
                Ok(whole) => refused |= !whole,
                Err(error) => failed = Some(error),
            }
            if failed.is_some() { Err(String::new()) } else { Ok(()) }
        });
        self.body = body;
        if let Some(error) = failed {
            return Err(error);
        }
        if refused || (outcome.is_err() && visited > 0) {
            // A chunk with a fitting CRC that contradicts itself was written so.
            self.lose(offset, end)?;
            return Ok(Step::Next(end));
        }
        if outcome.is_ok() {
            self.trust = trust;
            return Ok(Step::Next(end));
        }
        self.budget_bytes = self.budget_bytes.saturating_sub(length);
        if self.budget_bytes == 0 {
            return Ok(Step::Lost);
        }
        if !header.is_compressed && self.window.touches_zero_sector(inside, end - inside).map_err(StreamError::Read)? {
            self.trust = Trust::Plain.min(self.trust);
            return Ok(Step::Next(inside));
        }
        self.lose(offset, end)?;
        self.count_messages(inside, end)?;
        Ok(Step::Next(end))
    }

    /// `None`: no chunk starts here.
    fn chunk_header(&mut self, offset: u64, length: u64) -> Result<Option<ChunkHeader>, StreamError> {
        let bytes = self.get(offset + FRAMING, CHUNK_HEADER_BYTES + MAX_COMPRESSION_NAME_BYTES)?;
        let number =
            |at: usize| bytes.get(at..at + 8).map(|bytes| u64::from_le_bytes(bytes.try_into().expect("8 bytes")));
        let header = || {
            let name_bytes = number(24)? >> 32; // behind the CRC
            let name_end = 32 + usize::try_from(name_bytes).ok().filter(|&n| n as u64 <= MAX_COMPRESSION_NAME_BYTES)?;
            let (first_ns, last_ns, data_bytes) = (number(0)?, number(8)?, number(name_end)?);
            let bytes = CHUNK_HEADER_BYTES + name_bytes;
            // A chunk that was being written in place has its sizes filled in last.
            let unfinished = length == u64::MAX && data_bytes == u64::MAX;
            let consistent = bytes.checked_add(data_bytes) == Some(length) && first_ns <= last_ns;
            let is_compressed = name_bytes > 0;
            let has_crc = number(24)? as u32 != 0;
            (unfinished || consistent).then_some(ChunkHeader { bytes, is_compressed, has_crc })
        };
        Ok(header())
    }

    /// Takes a record; `false` if it is not whole or contradicts what came before.
    fn record(&mut self, opcode: u8, body: &[u8], trust: Trust) -> Result<bool, StreamError> {
        let Ok(record) = parse(opcode, body) else { return Ok(false) };
        match record {
            Record::Schema { header, data } => self.record_schema(header.id, &header.name, &header.encoding, &data),
            Record::Channel(record) => self.record_channel(record),
            Record::Message { header, data } => {
                self.presume_channel(&header, &data)?;
                let Some(schema_name) = self.ledger.schema_name(header.channel_id) else { return Ok(false) };
                if !is_whole(schema_name, &header, &data, trust) {
                    return Ok(false);
                }
                self.sink.message(&header, &data)?;
                self.ledger.note_message(&header);
                Ok(true)
            }
            Record::Metadata(record) => self.sink.metadata(&record).map(|()| true),
            Record::Attachment { header, data, .. } => {
                let (name, media_type) = (header.name, header.media_type);
                let (log_time, create_time) = (header.log_time, header.create_time);
                self.sink.attachment(&mcap::Attachment { log_time, create_time, name, media_type, data })?;
                Ok(true)
            }
            _ => Ok(true),
        }
    }

    /// Takes a message whose channel was never declared for one of ours, if it can be no other: the declarations stand
    /// once, at the start, and may be what was lost.
    fn presume_channel(&mut self, header: &MessageHeader, data: &[u8]) -> Result<(), StreamError> {
        let id = header.channel_id;
        if !self.ledger.has_losses() || self.ledger.schema_name(id).is_some() {
            return Ok(());
        }
        let Some(topic) = presumed_topic(id).filter(|topic| is_exactly(topic.schema_name, header, data)) else {
            return Ok(());
        };
        // Every topic has a schema of its own, so both count alike.
        let schema_id = id;
        self.record_schema(schema_id, topic.schema_name, "protobuf", topic.schema)?;
        self.record_channel(mcap::records::Channel {
            id,
            schema_id,
            topic: topic.name.into(),
            message_encoding: "protobuf".into(),
            metadata: BTreeMap::new(),
        })?;
        Ok(())
    }

    fn record_schema(&mut self, id: u16, name: &str, encoding: &str, data: &[u8]) -> Result<bool, StreamError> {
        let accepted = self.sink.schema(id, name, encoding, data)?;
        if accepted {
            self.schemas.insert(id, name.to_owned());
        }
        Ok(accepted)
    }

    fn record_channel(&mut self, record: mcap::records::Channel) -> Result<bool, StreamError> {
        let accepted = self.sink.channel(&record)?;
        if accepted {
            let schema_name = self.schemas.get(&record.schema_id).cloned().unwrap_or_default();
            self.ledger.declare(record.id, record.topic, schema_name);
        }
        Ok(accepted)
    }

    /// Counts the messages of a chunk that is not used, as far as it can be followed.
    fn count_messages(&mut self, mut offset: u64, end: u64) -> Result<(), StreamError> {
        while let Some((opcode, length)) = self.framing(offset)? {
            let Some(next) = offset.checked_add(FRAMING + length.min(end)).filter(|&next| next <= end) else { break };
            if opcode == op::MESSAGE {
                let body = self.get(offset + FRAMING, length.min(MESSAGE_HEADER_BYTES))?.to_vec();
                self.ledger.note_damaged(&body);
            }
            offset = next;
        }
        Ok(())
    }

    fn lose(&mut self, from: u64, to: u64) -> Result<(), StreamError> {
        let mut zero_bytes = 0;
        let mut at = from;
        while at < to {
            let piece = self.window.piece(at).map_err(StreamError::Read)?;
            let piece = &piece[..piece.len().min((to - at) as usize)];
            zero_bytes += piece.iter().filter(|&&byte| byte == 0).count() as u64;
            at += piece.len() as u64;
        }
        self.ledger.note_lost(from..to, zero_bytes);
        Ok(())
    }

    /// The next place that can only be a record: a chunk, or a message of ours with its time in it twice.
    fn find_record(&mut self, from: u64) -> Result<u64, StreamError> {
        let size = self.window.size;
        let mut offset = from;
        while offset < size {
            let piece = self.window.piece(offset).map_err(StreamError::Read)?;
            let (searched, found) = match find_candidate(piece) {
                Some(at) => (at as u64, true),
                None => ((piece.len() - (FRAMING_BYTES - 1).min(piece.len() - 1)) as u64, false),
            };
            offset += searched;
            if found {
                if self.is_record(offset)? {
                    return Ok(offset);
                }
                if self.budget_bytes == 0 {
                    return Ok(size);
                }
                offset += 1;
            } else if size - offset < FRAMING {
                return Ok(size);
            }
        }
        Ok(size)
    }

    fn is_record(&mut self, offset: u64) -> Result<bool, StreamError> {
        let Some((opcode, length)) = self.framing(offset)? else { return Ok(false) };
        if opcode == op::CHUNK {
            return Ok(self.chunk_header(offset, length)?.is_some());
        }
        if length > self.window.size - offset - FRAMING {
            return Ok(false);
        }
        let header = self.get(offset + FRAMING, MESSAGE_HEADER_BYTES)?;
        let id = header.first_chunk::<2>().map(|&id| u16::from_le_bytes(id));
        let is_channel = |id| self.ledger.schema_name(id).is_some() || presumed_topic(id).is_some();
        if length < MESSAGE_HEADER_BYTES || !id.is_some_and(is_channel) {
            return Ok(false);
        }
        self.budget_bytes = self.budget_bytes.saturating_sub(length);
        if self.budget_bytes == 0 {
            return Ok(false);
        }
        let body = self.window.get(offset + FRAMING, length).map_err(StreamError::Read)?;
        let Ok(Record::Message { header, data }) = parse(opcode, body) else { return Ok(false) };
        Ok(match self.ledger.schema_name(header.channel_id) {
            Some(schema_name) => is_whole(schema_name, &header, &data, Trust::Damaged),
            None => {
                presumed_topic(header.channel_id).is_some_and(|topic| is_exactly(topic.schema_name, &header, &data))
            }
        })
    }

    /// Schemas and channels from the end of the file, in case the chunk that has them at the start is lost.
    fn read_summary(&mut self) -> Result<(), StreamError> {
        const FOOTER_BODY_BYTES: u64 = 20;
        let size = self.window.size;
        let tail_bytes = FRAMING + FOOTER_BODY_BYTES + MAGIC.len() as u64;
        let Some(footer_at) = size.checked_sub(tail_bytes) else { return Ok(()) };
        let tail = self.get(footer_at, tail_bytes)?;
        if tail[0] != op::FOOTER || !tail.ends_with(MAGIC) {
            return Ok(());
        }
        let start = u64::from_le_bytes(tail[9..17].try_into().expect("8 bytes"));
        let crc = u32::from_le_bytes(tail[25..29].try_into().expect("4 bytes"));
        if start < MAGIC.len() as u64 || start > footer_at || footer_at - start > MAX_RECORD_BYTES {
            return Ok(());
        }
        let covered = self.get(start, footer_at + 25 - start)?;
        if crc == 0 || crc32fast::hash(covered) != crc {
            return Ok(());
        }
        let summary = covered[..(footer_at - start) as usize].to_vec();
        let mut rest = summary.as_slice();
        while let Some((&[opcode, length @ ..], after)) = rest.split_first_chunk::<FRAMING_BYTES>() {
            let length = usize::try_from(u64::from_le_bytes(length)).ok();
            let Some((body, after)) = length.and_then(|length| after.split_at_checked(length)) else { break };
            if matches!(opcode, op::SCHEMA | op::CHANNEL) {
                self.record(opcode, body, Trust::Proven)?;
            }
            rest = after;
        }
        Ok(())
    }
}

struct ChunkHeader {
    bytes: u64,
    is_compressed: bool,
    has_crc: bool,
}

/// Channel, sequence number, log time, publish time.
const MESSAGE_HEADER_BYTES: u64 = 2 + 4 + 8 + 8;

/// The topic that our recorder gives this channel: it declares all of them first, in their order, counting from 1.
fn presumed_topic(channel_id: u16) -> Option<&'static Topic> {
    topics::ALL.get(usize::from(channel_id.checked_sub(1)?)).copied()
}

fn op_is_known(opcode: u8) -> bool {
    (op::HEADER..=op::DATA_END).contains(&opcode) || opcode >= 0x80
}

/// Where a chunk or message of less than 4 GiB may start.
fn find_candidate(bytes: &[u8]) -> Option<usize> {
    bytes.windows(FRAMING_BYTES).position(|framing| {
        matches!(framing[0], op::CHUNK | op::MESSAGE) && framing[5..] == [0; 4] && framing[1..5] != [0; 4]
    })
}
