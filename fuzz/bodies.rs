//! What must hold for any bytes from outside: the bodies of the fuzz targets, which `tests/fuzz_inputs.rs` runs on all kept
//! inputs as well.

use omniloc::{
    config::RecordConfig,
    devices::{SerialChunk, mjpeg::MjpegMender},
    gnss::{DecoderCounters, DecoderSettings, GnssDecoder},
    jpeg::{LumaDecoder, scan, with_huffman_tables},
    map::file,
    recording::{recover::recover_bytes, verify},
    types::GnssSample,
};

pub type Target = fn(&[u8]);

/// All targets by name.
#[allow(dead_code, reason = "each fuzz target uses one")]
pub const ALL: [(&str, Target); 5] =
    [("serial", serial), ("jpeg", jpeg), ("recover", recover), ("map", map), ("config", config)];

/// 100 µs a byte, without a remainder.
const BAUD: u32 = 100_000;

fn decode(bytes: &[u8], ends: impl Iterator<Item = usize>) -> (Vec<GnssSample>, DecoderCounters) {
    let mut decoder = GnssDecoder::new(&DecoderSettings::default());
    let (mut samples, mut start) = (Vec::new(), 0);
    for end in ends.chain([bytes.len()]) {
        let arrival_ns = 1_000_000_000 + end as u64 * 100_000;
        let chunk = SerialChunk { arrival_ns, baud: BAUD, bytes: bytes[start..end].to_vec() };
        decoder.push(&chunk, &mut samples);
        start = end;
    }
    (samples, decoder.counters())
}

/// Any bytes on the serial line: no panic, and what is decoded does not depend on how they were cut.
pub fn serial(bytes: &[u8]) {
    let whole = decode(bytes, std::iter::empty());
    // Cut where the bytes themselves say, so that the fuzzer can choose.
    let mut end = 0;
    let lengths = bytes.iter().map(|&byte| usize::from(byte % 64) + 1);
    let ends = lengths.map_while(|length| {
        end += length;
        (end < bytes.len()).then_some(end)
    });
    assert_eq!(whole, decode(bytes, ends));
    assert_eq!(whole, decode(bytes, 1..bytes.len()));
}

/// Frames as a broken camera sends them: mended, scanned and decoded without a panic.
pub fn jpeg(bytes: &[u8]) {
    let is_sound = scan(bytes).is_ok();
    let _ = with_huffman_tables(bytes);
    let mut mended = bytes.to_vec();
    let damage = MjpegMender::new(64, 64).mend(&mut mended, false);
    if damage.is_none() {
        assert!(scan(&mended).is_ok(), "a frame without damage has sound headers");
        // Mending what is mended changes nothing.
        let once = mended.clone();
        assert_eq!(MjpegMender::new(64, 64).mend(&mut mended, false), None);
        assert_eq!(mended, once);
    }
    // Large images only cost time here.
    if is_sound && scan(bytes).is_ok_and(|info| info.width_px * info.height_px <= 1 << 16) {
        let _ = LumaDecoder::new().decode(bytes);
    }
}

/// Recovery of any bytes: no panic, bounded memory, and what it writes is a whole recording.
pub fn recover(bytes: &[u8]) {
    let Some((recovery, out)) = recover_bytes(bytes) else { return };
    let file = tempfile::NamedTempFile::new().expect("a temporary file");
    std::fs::write(file.path(), &out).expect("writes");
    let verdict = verify(file.path()).expect("readable");
    assert_eq!((verdict.is_complete, verdict.messages), (true, recovery.messages), "{:?}", verdict.problems);
}

/// Map files: refused or sound, never a panic; what is sound survives being written again.
pub fn map(bytes: &[u8]) {
    if let Ok(map) = file::from_bytes(bytes) {
        assert!(file::from_bytes(&file::to_bytes(&map)).is_ok());
    }
}

/// Configuration files: refused with a place, or sound; what is sound can be written down.
pub fn config(bytes: &[u8]) {
    let Ok(text) = std::str::from_utf8(bytes) else { return };
    if let Ok(config) = RecordConfig::parse(text) {
        let _ = config.resolved();
    }
}
