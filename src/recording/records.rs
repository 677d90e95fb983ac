//! The records of an MCAP file, one after the other, from an untrusted file.
//!
//! The framing (opcode, length, body) is read here and not by `mcap::sans_io::LinearReader`: that of mcap 0.26 overflows
//! on a record that is longer than its chunk, and stops at the first bad chunk, while `check` must report them all.
//! Bodies are parsed, and compressed chunks unpacked, by the crate.

use std::{
    collections::BTreeMap,
    fs::File,
    io::{self, BufReader, Read},
    path::{Path, PathBuf},
};

use mcap::{
    MAGIC, McapError,
    records::{MessageHeader, Record, op},
    sans_io::linear_reader::{LinearReadEvent, LinearReader, LinearReaderOptions},
};

use super::error::RecordingError;

/// No record of ours comes near; a forged length must not make us take all memory.
pub(super) const MAX_RECORD_BYTES: u64 = 192 << 20;
/// Opcode (1 byte) and length (8 bytes) in front of each record.
pub(super) const FRAMING_BYTES: usize = 9;
/// Part of the footer that its own CRC covers: the two offsets.
const FOOTER_CRC_COVERS: usize = 16;

/// A file being read record by record.
pub(super) struct RecordFile {
    path: PathBuf,
    reader: BufReader<Box<dyn Read + Send>>,
    size: u64,
    /// Of the next record.
    offset: u64,
    body: Vec<u8>,
    section_crc: crc32fast::Hasher,
    at_end: bool,
}

/// A record outside any chunk.
pub(super) struct TopRecord<'a> {
    pub opcode: u8,
    /// Where the record starts in the file.
    pub offset: u64,
    pub body: &'a [u8],
    /// The CRC of the data or summary section, which this record closes, does not fit.
    pub section_fault: Option<String>,
}

impl RecordFile {
    /// Opens the file and checks the magic bytes at its start.
    pub fn open(path: &Path) -> Result<Self, RecordingError> {
        let failed = |source| RecordingError::CannotRead { path: path.into(), source };
        let file = File::open(path).map_err(failed)?;
        let facts = file.metadata().map_err(failed)?;
        if !facts.is_file() {
            return Err(failed(io::Error::other("not a regular file")));
        }
        Self::from_reader(path, Box::new(file), facts.len())
    }

    /// A recording of `size` bytes, which messages call `path`.
    pub fn from_reader(path: &Path, reader: Box<dyn Read + Send>, size: u64) -> Result<Self, RecordingError> {
        let failed = |source| RecordingError::CannotRead { path: path.into(), source };
        let mut reader = BufReader::with_capacity(1 << 20, reader);
        let mut start = Vec::new();
        reader.by_ref().take(MAGIC.len() as u64).read_to_end(&mut start).map_err(failed)?;
        if start != MAGIC {
            let found = if start.is_empty() { "nothing (an empty file)".into() } else { hex(&start) };
            return Err(RecordingError::NotMcap { path: path.into(), found });
        }
        let mut section_crc = crc32fast::Hasher::new();
        section_crc.update(MAGIC);
        let offset = MAGIC.len() as u64;
        Ok(Self { path: path.into(), reader, size, offset, body: Vec::new(), section_crc, at_end: false })
    }

    /// The next record outside chunks (a chunk counts as one), or `None` after the closing magic bytes.
    pub fn next(&mut self) -> Result<Option<TopRecord<'_>>, RecordingError> {
        if self.at_end {
            return Ok(None);
        }
        let offset = self.offset;
        let truncated = |what| RecordingError::Truncated { path: self.path.clone(), offset, what };
        let remaining = self.size.saturating_sub(offset);
        let framing = match read_array::<FRAMING_BYTES>(&mut self.reader) {
            Ok(framing) => framing,
            Err(error) if error.kind() == io::ErrorKind::UnexpectedEof => {
                return Err(truncated("the end of the file is missing"));
            }
            Err(source) => return Err(RecordingError::CannotRead { path: self.path.clone(), source }),
        };
        let [opcode, length @ ..] = framing;
        let length = u64::from_le_bytes(length);
        if opcode == 0 {
            return Err(truncated("zeros in place of a record"));
        }
        if length > remaining.saturating_sub(FRAMING_BYTES as u64) {
            return Err(truncated("a record is longer than the rest of the file"));
        }
        if length > MAX_RECORD_BYTES {
            let what = format!("a record of {length} bytes, expected at most {MAX_RECORD_BYTES}");
            return Err(RecordingError::Damaged { path: self.path.clone(), offset, what });
        }
        self.body.resize(length as usize, 0);
        if let Err(source) = self.reader.read_exact(&mut self.body) {
            return Err(RecordingError::CannotRead { path: self.path.clone(), source });
        }
        self.offset += FRAMING_BYTES as u64 + length;

        let section_fault = self.check_section(opcode, &framing);
        if opcode == op::FOOTER {
            self.read_end_magic()?;
        }
        Ok(Some(TopRecord { opcode, offset, body: &self.body, section_fault }))
    }

    /// Updates the CRC of the section, and compares it where the section ends.
    fn check_section(&mut self, opcode: u8, framing: &[u8]) -> Option<String> {
        let stored_at = match opcode {
            op::DATA_END => 0,
            op::FOOTER => FOOTER_CRC_COVERS,
            _ => {
                self.section_crc.update(framing);
                self.section_crc.update(&self.body);
                return None;
            }
        };
        let mut crc = std::mem::take(&mut self.section_crc);
        if opcode == op::FOOTER {
            crc.update(framing);
            crc.update(self.body.get(..FOOTER_CRC_COVERS)?);
        }
        let section = if opcode == op::FOOTER { "summary" } else { "data" };
        let Some(&[a, b, c, d]) = self.body.get(stored_at..stored_at + 4) else {
            return Some(format!("the record that closes the {section} section is too short"));
        };
        let (stored, found) = (u32::from_le_bytes([a, b, c, d]), crc.finalize());
        // 0 means that the writer did not compute it.
        (stored != 0 && stored != found)
            .then(|| format!("CRC of the {section} section is {found:08X}, expected {stored:08X}"))
    }

    fn read_end_magic(&mut self) -> Result<(), RecordingError> {
        let mut end = Vec::new();
        let read = self.reader.by_ref().take(MAGIC.len() as u64 + 1).read_to_end(&mut end);
        read.map_err(|source| RecordingError::CannotRead { path: self.path.clone(), source })?;
        self.at_end = true;
        if end == MAGIC {
            return Ok(());
        }
        let (path, offset) = (self.path.clone(), self.offset);
        if MAGIC.starts_with(&end) {
            return Err(RecordingError::Truncated { path, offset, what: "the closing magic bytes are missing" });
        }
        let what = format!("the file ends with {}, expected the closing magic bytes and nothing after them", hex(&end));
        Err(RecordingError::Damaged { path, offset, what })
    }
}

fn read_array<const N: usize>(reader: &mut impl Read) -> io::Result<[u8; N]> {
    let mut array = [0; N];
    reader.read_exact(&mut array)?;
    Ok(array)
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02X}")).collect::<Vec<_>>().join(" ")
}

/// The parsed body of a record. Unlike `mcap::parse_record` it does not panic on a short attachment.
pub(super) fn parse(opcode: u8, body: &[u8]) -> Result<Record<'_>, String> {
    if opcode == op::ATTACHMENT && !attachment_fits(body) {
        return Err("an attachment shorter than its own header".into());
    }
    mcap::parse_record(opcode, body).map_err(|error| describe(&error))
}

/// log time 8, create time 8, name 4 + n, media type 4 + n, length 8, data, CRC 4.
fn attachment_fits(body: &[u8]) -> bool {
    let text_end = |start: usize| -> Option<usize> {
        let &[a, b, c, d] = body.get(start..start.checked_add(4)?)? else { return None };
        start.checked_add(4)?.checked_add(u32::from_le_bytes([a, b, c, d]) as usize)
    };
    let data_start = text_end(16).and_then(text_end).and_then(|end| end.checked_add(8));
    data_start.and_then(|start| start.checked_add(4)).is_some_and(|needed| needed <= body.len())
}

/// The error of the crate with its cause, on one line.
pub(super) fn describe(error: &McapError) -> String {
    match error {
        McapError::Parse(cause) => {
            format!("record cannot be parsed: {}", cause.to_string().lines().next().unwrap_or_default())
        }
        McapError::Io(cause) => format!("cannot be unpacked: {cause}"),
        other => other.to_string(),
    }
}

/// Visits the records of a chunk after its CRC and sizes are known to be right.
///
/// `body` is that of the chunk record. The visitor's error ends the visit and is returned.
pub(super) fn visit_chunk(body: &[u8], mut visit: impl FnMut(u8, &[u8]) -> Result<(), String>) -> Result<(), String> {
    let Record::Chunk { header, data } = parse(op::CHUNK, body)? else { return Err("not a chunk".into()) };
    if header.uncompressed_size > MAX_RECORD_BYTES {
        return Err(format!("chunk of {} bytes, expected at most {MAX_RECORD_BYTES}", header.uncompressed_size));
    }
    if !header.compression.is_empty() {
        return visit_compressed_chunk(body, visit);
    }
    if data.len() as u64 != header.uncompressed_size {
        return Err(format!("chunk holds {} bytes, expected {}", data.len(), header.uncompressed_size));
    }
    let crc = crc32fast::hash(&data);
    if header.uncompressed_crc != 0 && header.uncompressed_crc != crc {
        return Err(format!("CRC of the chunk is {crc:08X}, expected {:08X}", header.uncompressed_crc));
    }
    let mut rest: &[u8] = &data;
    while let Some((framing, after)) = rest.split_first_chunk::<FRAMING_BYTES>() {
        let [opcode, length @ ..] = *framing;
        let length = usize::try_from(u64::from_le_bytes(length)).map_err(|_| "a record longer than its chunk")?;
        let (record, after) = after.split_at_checked(length).ok_or("a record longer than its chunk")?;
        visit(opcode, record)?;
        rest = after;
    }
    if rest.is_empty() { Ok(()) } else { Err("bytes left over at the end of a chunk".into()) }
}

fn visit_compressed_chunk(body: &[u8], mut visit: impl FnMut(u8, &[u8]) -> Result<(), String>) -> Result<(), String> {
    let options = LinearReaderOptions::default()
        .with_skip_start_magic(true)
        .with_skip_end_magic(true)
        .with_prevalidate_chunk_crcs(true)
        .with_record_length_limit(MAX_RECORD_BYTES as usize);
    let mut reader = LinearReader::new_with_options(options);
    let mut input = io::Cursor::new([&[op::CHUNK], (body.len() as u64).to_le_bytes().as_slice(), body].concat());
    while let Some(event) = reader.next_event() {
        match event.map_err(|error| describe(&error))? {
            LinearReadEvent::ReadRequest(need) => {
                let read = input.read(reader.insert(need)).map_err(|error| error.to_string())?;
                reader.notify_read(read);
            }
            LinearReadEvent::Record { data, opcode } => visit(opcode, data)?,
        }
    }
    Ok(())
}

/// A channel as messages refer to it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct ChannelFacts {
    pub topic: String,
    pub schema_name: String,
    pub encoding: String,
}

/// Schemas and channels seen so far.
#[derive(Debug, Default)]
pub(super) struct Channels {
    schemas: BTreeMap<u16, String>,
    channels: BTreeMap<u16, ChannelFacts>,
}

impl Channels {
    /// Takes in a record that may stand in a chunk. A message is handed to `on_message`.
    pub fn read_record(
        &mut self,
        opcode: u8,
        body: &[u8],
        on_message: impl FnOnce(&ChannelFacts, &MessageHeader, &[u8]) -> Result<(), String>,
    ) -> Result<(), String> {
        match opcode {
            op::SCHEMA | op::CHANNEL | op::MESSAGE => {}
            _ => return Ok(()),
        }
        match parse(opcode, body)? {
            Record::Schema { header, .. } => {
                let name = self.schemas.entry(header.id).or_insert_with(|| header.name.clone());
                if *name != header.name {
                    return Err(format!("schema {} is `{name}` and `{}`", header.id, header.name));
                }
            }
            Record::Channel(channel) => {
                let schema_name = match channel.schema_id {
                    0 => String::new(),
                    id => self.schemas.get(&id).cloned().ok_or_else(|| format!("unknown schema {id}"))?,
                };
                let facts = ChannelFacts { topic: channel.topic, schema_name, encoding: channel.message_encoding };
                let known = self.channels.entry(channel.id).or_insert_with(|| facts.clone());
                if *known != facts {
                    return Err(format!("channel {} is `{}` and `{}`", channel.id, known.topic, facts.topic));
                }
            }
            Record::Message { header, data } => {
                let id = header.channel_id;
                let channel = self.channels.get(&id).ok_or_else(|| format!("message on unknown channel {id}"))?;
                on_message(channel, &header, &data)?;
            }
            _ => {}
        }
        Ok(())
    }

    /// The topic of a channel id, as the statistics record refers to it.
    pub fn topic(&self, id: u16) -> Option<&str> {
        self.channels.get(&id).map(|channel| channel.topic.as_str())
    }
}
