//! Writes recordings.

use std::{
    collections::BTreeMap,
    fs::{self, File},
    io::{self, BufWriter, Seek, Write},
    path::Path,
};

use mcap::{Attachment, McapError, WriteOptions, Writer, records::MessageHeader, records::Metadata};
use prost::Message;

use super::{
    error::RecordingError,
    proto::{foxglove, omniloc},
    topics::{self, Topic},
};

/// Writes messages to MCAP: chunked, with CRCs and indexes. The bytes depend on what is written and on nothing else.
///
/// Chunks are not compressed: zstd at level 1 makes the recordings of our data sets 0.3 % smaller.
pub struct RecordingWriter<W: Write + Seek> {
    mcap: Writer<W>,
    /// Channel id by topic name; channels are made when they are first written to.
    channels: BTreeMap<&'static str, u16>,
}

impl<W: Write + Seek> RecordingWriter<W> {
    /// Starts a recording.
    pub fn new(out: W) -> Result<Self, McapError> {
        let library = format!("omniloc/{} {}", env!("CARGO_PKG_VERSION"), mcap::LIBRARY_IDENTIFIER);
        let mcap = WriteOptions::new().compression(None).library(library).create(out)?;
        Ok(Self { mcap, channels: BTreeMap::new() })
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
    pub fn write_image(&mut self, sequence: u32, stamp_ns: u64, jpeg: Vec<u8>) -> Result<(), McapError> {
        let image = foxglove::CompressedImage {
            timestamp: Some(timestamp(stamp_ns)),
            frame_id: topics::CAMERA_FRAME.into(),
            data: jpeg,
            format: "jpeg".into(),
        };
        self.write(&topics::CAMERA_IMAGE, sequence, stamp_ns, &image)
    }

    /// Where the vehicle was at frame `sequence`; as pair and, if valid, as pose for viewers.
    ///
    /// A pose message cannot leave its orientation out: without a yaw it says yaw 0. The pair is what counts.
    pub fn write_pair(&mut self, sequence: u32, stamp_ns: u64, pair: omniloc::SurveyPair) -> Result<(), McapError> {
        let pair =
            omniloc::SurveyPair { timestamp: Some(timestamp(stamp_ns)), frame_sequence: sequence.into(), ..pair };
        self.write(&topics::SURVEY_PAIR, sequence, stamp_ns, &pair)?;
        if !pair.valid {
            return Ok(());
        }
        let half_yaw_rad = pair.yaw_rad.unwrap_or(0.0) / 2.0;
        let pose = foxglove::Pose {
            position: Some(foxglove::Vector3 { x: pair.east_m, y: pair.north_m, z: 0.0 }),
            orientation: Some(foxglove::Quaternion { x: 0.0, y: 0.0, z: half_yaw_rad.sin(), w: half_yaw_rad.cos() }),
        };
        let pose = foxglove::PoseInFrame {
            timestamp: Some(timestamp(stamp_ns)),
            frame_id: topics::MAP_FRAME.into(),
            pose: Some(pose),
        };
        self.write(&topics::SURVEY_POSE, sequence, stamp_ns, &pose)
    }

    /// A message on a topic. `sequence` is the frame's number where the message belongs to one.
    pub fn write<M: Message>(
        &mut self,
        topic: &Topic,
        sequence: u32,
        stamp_ns: u64,
        message: &M,
    ) -> Result<(), McapError> {
        let channel_id = self.channel(topic)?;
        let header = MessageHeader { channel_id, sequence, log_time: stamp_ns, publish_time: stamp_ns };
        self.mcap.write_to_known_channel(&header, &message.encode_to_vec())
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
}

/// Protobuf's timestamp of a stamp \[ns\].
pub(super) fn timestamp(stamp_ns: u64) -> prost_types::Timestamp {
    prost_types::Timestamp { seconds: (stamp_ns / 1_000_000_000) as i64, nanos: (stamp_ns % 1_000_000_000) as i32 }
}

/// Writes a file under a temporary name in its own folder, and gives it its name only when it is whole and on the disk.
///
/// # Errors
/// What `write` returns, or that the folder cannot be written to. The target is then as it was before.
pub fn write_file_atomically<E: From<RecordingError>>(
    path: &Path,
    write: impl FnOnce(&mut BufWriter<File>) -> Result<(), E>,
) -> Result<(), E> {
    let folder = folder_of(path);
    let failed = |cause: io::Error| RecordingError::CannotWrite { path: path.into(), cause };

    let mut builder = tempfile::Builder::new();
    builder.prefix(".omniloc-").suffix(".tmp");
    #[cfg(unix)]
    builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666)); // the umask still applies
    let temporary = builder.tempfile_in(folder).map_err(failed)?;

    let (file, temporary_path) = temporary.into_parts();
    let mut out = BufWriter::with_capacity(1 << 20, file);
    write(&mut out)?;
    let file = out.into_inner().map_err(|error| failed(error.into_error()))?;
    file.sync_all().map_err(failed)?;
    temporary_path.persist(path).map_err(|error| failed(error.error))?;
    sync_folder(folder);
    Ok(())
}

/// [`write_file_atomically`] of bytes that are there already.
pub fn write_bytes_atomically(path: &Path, bytes: &[u8]) -> Result<(), RecordingError> {
    write_file_atomically(path, |out| {
        out.write_all(bytes).map_err(|cause| RecordingError::CannotWrite { path: path.into(), cause })
    })
}

/// The folder that holds `path`.
pub(super) fn folder_of(path: &Path) -> &Path {
    path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

/// Makes a rename last through a power cut. Some file systems cannot sync a folder; the file itself is safe already.
pub(super) fn sync_folder(folder: &Path) {
    let _ = fs::File::open(folder).and_then(|folder| folder.sync_all());
}

#[cfg(test)]
mod tests {
    use std::io::Cursor;

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
            recording.write_image(0, 0, vec![7; 5000])?;
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
    fn a_failed_write_leaves_the_old_file_and_nothing_else() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let path = folder.path().join("a.mcap");
        fs::write(&path, "old").expect("writes");
        let full = |out: &mut BufWriter<File>| {
            out.write_all(b"half a recording").expect("writes");
            let cause = io::ErrorKind::StorageFull.into();
            Err(RecordingError::CannotWrite { path: path.clone(), cause })
        };
        let message = write_file_atomically(&path, full).expect_err("it fails").to_string();
        assert!(message.contains("a.mcap: cannot write: the disk is full"), "{message}");
        assert_eq!(fs::read(&path).expect("readable"), b"old");
        assert_eq!(fs::read_dir(folder.path()).expect("readable").count(), 1);
    }
}
