//! Any bytes on the serial line: no panic, and what is decoded does not depend on how they were cut.
//!
//!     cargo fuzz run serial fuzz/corpus/serial tests/serial_corpus

#![no_main]

use libfuzzer_sys::fuzz_target;
use omniloc::{
    devices::SerialChunk,
    gnss::{DecoderCounters, DecoderSettings, GnssDecoder},
    types::GnssSample,
};

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

fuzz_target!(|bytes: &[u8]| {
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
});
