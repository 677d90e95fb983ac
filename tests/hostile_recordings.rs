//! No bytes may make the reader panic, and no damage may go unnoticed.

mod common;

use std::{fs, io::Cursor, path::Path, sync::OnceLock};

use common::{TinyDataset, jpeg};
use mcap::{Compression, WriteOptions, records::MessageHeader};
use omniloc::recording::{Recording, RecordingError, recover::recover_bytes, verify};
use proptest::prelude::*;

fn sound_recording() -> &'static [u8] {
    static BYTES: OnceLock<Vec<u8>> = OnceLock::new();
    BYTES.get_or_init(|| fs::read(TinyDataset::new().import("a.mcap")).expect("readable"))
}

/// Reads all that there is; only a panic can fail this.
fn read_everything(path: &Path) -> (bool, Option<usize>) {
    let sound = verify(path).is_ok_and(|verdict| verdict.is_sound() || verdict.is_complete);
    let frames = Recording::open_any(path).ok().and_then(|recording| {
        let frames: Result<Vec<_>, _> = recording.frames().ok()?.collect();
        Some(frames.ok()?.len())
    });
    (sound, frames)
}

fn read_bytes(bytes: &[u8]) -> (bool, Option<usize>) {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let path = folder.path().join("hostile.mcap");
    fs::write(&path, bytes).expect("writes");
    let (recovery, recovered) = recover_bytes(bytes).expect("memory can be written to");
    let recovered_path = folder.path().join("recovered.mcap");
    fs::write(&recovered_path, recovered).expect("writes");
    let verdict = verify(&recovered_path).expect("readable");
    assert!(verdict.is_complete, "{:?}", verdict.problems);
    assert_eq!(verdict.messages, recovery.messages);
    read_everything(&path)
}

#[test]
fn every_cut_is_noticed() {
    let bytes = sound_recording();
    assert_eq!(read_bytes(bytes), (true, Some(5)));
    for length in (0..bytes.len()).step_by(37).chain(bytes.len() - 40..bytes.len()) {
        assert_eq!(read_bytes(&bytes[..length]), (false, None), "cut to {length} bytes");
    }
}

#[test]
fn a_cut_recording_says_how_to_mend_it() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let path = folder.path().join("cut.mcap");
    fs::write(&path, &sound_recording()[..9000]).expect("writes");
    let error = Recording::open(&path).expect_err("it is cut");
    assert!(matches!(error, RecordingError::Truncated { .. }), "{error:?}");
    assert!(error.to_string().contains("omniloc recover"), "{error}");
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 400, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn flipped_bits_never_panic_and_are_never_sound(at in 8usize.., bit in 0u8..8) {
        let mut bytes = sound_recording().to_vec();
        let at = at % bytes.len();
        bytes[at] ^= 1 << bit;
        let (sound, _) = read_bytes(&bytes);
        prop_assert!(!sound, "bit {bit} of byte {at} went unnoticed");
    }

    /// The bytes behind a CRC of zero ("not computed") are parsed as they are.
    #[test]
    fn damage_that_no_crc_covers_never_panics(
        changes in prop::collection::vec((0usize.., any::<u8>()), 1..6),
        compression in 0usize..3,
    ) {
        let mut bytes = without_crcs(compression);
        for (at, value) in changes {
            let at = 8 + at % (bytes.len() - 8);
            bytes[at] = value;
        }
        read_bytes(&bytes);
    }

    #[test]
    fn random_records_never_panic(
        records in prop::collection::vec((0u8..0x12, prop::collection::vec(any::<u8>(), 0..80)), 0..12),
    ) {
        let mut bytes = mcap::MAGIC.to_vec();
        for (opcode, body) in records {
            bytes.push(opcode);
            bytes.extend((body.len() as u64).to_le_bytes());
            bytes.extend(body);
        }
        bytes.extend(mcap::MAGIC);
        read_bytes(&bytes);
    }
}

/// A small recording of another program: no CRCs, any compression.
fn without_crcs(compression: usize) -> Vec<u8> {
    let options = WriteOptions::new()
        .compression([None, Some(Compression::Zstd), Some(Compression::Lz4)][compression])
        .compression_threads(0)
        .calculate_chunk_crcs(false)
        .calculate_data_section_crc(false)
        .calculate_summary_section_crc(false)
        .calculate_attachment_crcs(false);
    let mut writer = options.create(Cursor::new(Vec::new())).expect("starts");
    let schema = writer.add_schema("foxglove.CompressedImage", "protobuf", b"").expect("adds");
    let channel = writer.add_channel(schema, "/camera/image", "protobuf", &Default::default()).expect("adds");
    for sequence in 0..3 {
        let header = MessageHeader { channel_id: channel, sequence, log_time: 5, publish_time: 5 };
        // Field 2 (data), length-delimited.
        let image = jpeg(16, 16, sequence);
        let length = image.len();
        let varint = [0x12, (length & 0x7F) as u8 | 0x80, (length >> 7) as u8];
        writer.write_to_known_channel(&header, &[varint.as_slice(), &image].concat()).expect("writes");
    }
    let attachment = mcap::Attachment {
        log_time: 0,
        create_time: 0,
        name: "donut.json".into(),
        media_type: String::new(),
        data: common::DONUT.replace("47.5", "7.5").replace("40.0", "9.0").replace("10.0", "1.0").into_bytes().into(),
    };
    writer.attach(&attachment).expect("attaches");
    writer.finish().expect("finishes");
    writer.into_inner().into_inner()
}

#[test]
fn compressed_recordings_of_other_programs_are_read() {
    for compression in 0..3 {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let path = folder.path().join("other.mcap");
        fs::write(&path, without_crcs(compression)).expect("writes");
        let verdict = verify(&path).expect("readable");
        assert!(verdict.is_sound() && verdict.images == 3, "{verdict:?}");
        let recording = Recording::open_any(&path).expect("readable");
        assert_eq!((recording.image_size_px, recording.images_without_pair), (Some((16, 16)), 3));
    }
}
