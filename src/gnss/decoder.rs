//! Chunks of the serial line → checked samples: framing, what sentences and packets say, what of it can be.

use std::collections::VecDeque;

use serde::{Deserialize, Serialize};

use crate::{
    devices::SerialChunk,
    types::{GnssSample, NS_PER_S},
};

use super::{
    epoch::Epochs,
    framing::{Framed, Framer, FramingCounters, Protocol},
    nmea,
    plausibility::{self, Plausibility},
    sensor::Sensor,
    xbus,
};

#[derive(Debug, Clone, PartialEq, Default, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct DecoderSettings {
    #[serde(default)]
    pub protocol: Protocol,
    #[serde(default)]
    pub plausibility: plausibility::Settings,
}

impl DecoderSettings {
    pub fn check(&self) -> Result<(), String> {
        self.plausibility.check().map_err(|what| format!("plausibility.{what}"))
    }
}

/// What became of what arrived.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct DecoderCounters {
    pub framing: FramingCounters,
    /// Whole sentences and packets that say nothing of use, or the same as a better one.
    pub ignored: u64,
    pub fixes: u64,
    pub headings: u64,
    pub no_fixes: u64,
    pub times: u64,
    /// Whole, but not to be believed.
    pub rejected: u64,
    /// Gaps in the sensor's packet counter.
    pub packets_missed: u64,
}

impl DecoderCounters {
    /// Sentences and packets that were lost to damage or disbelief.
    pub fn lost(&self) -> u64 {
        self.framing.refused() + self.rejected
    }
}

/// When a sentence or packet was on the line, on the monotonic clock.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Arrival {
    pub start_ns: u64,
    pub end_ns: u64,
}

/// Turns chunks into samples. The same chunks give the same samples, wherever and whenever; cut differently they do too
/// if their stamps agree with each other.
#[derive(Debug, Clone)]
pub struct GnssDecoder {
    framer: Framer,
    arrivals: Arrivals,
    interpreter: Interpreter,
}

/// What sentences and packets mean, given those before.
#[derive(Debug, Clone)]
struct Interpreter {
    epochs: Epochs,
    sensor: Sensor,
    plausibility: Plausibility,
    counters: DecoderCounters,
}

impl GnssDecoder {
    pub fn new(settings: &DecoderSettings) -> Self {
        Self {
            framer: Framer::new(settings.protocol),
            arrivals: Arrivals::default(),
            interpreter: Interpreter {
                epochs: Epochs::default(),
                sensor: Sensor::default(),
                plausibility: Plausibility::new(&settings.plausibility),
                counters: DecoderCounters::default(),
            },
        }
    }

    /// Appends what is complete with this chunk to `out`, in the order of the stream.
    pub fn push(&mut self, chunk: &SerialChunk, out: &mut Vec<GnssSample>) {
        let Self { framer, arrivals, interpreter } = self;
        arrivals.note(chunk, framer.pending_bytes());
        let first_end = arrivals.end - chunk.bytes.len() as u64 + 1;
        for (end, &byte) in (first_end..).zip(&chunk.bytes) {
            framer.push(byte, &mut |framed, bytes_after| {
                let frame_end = end - bytes_after as u64;
                let frame_bytes = match framed {
                    Framed::Sentence(content) => content.len() + "$*hhrn".len(),
                    Framed::Packet { data, .. } => data.len() + "FFmls".len(),
                };
                interpreter.push(framed, arrivals.of(frame_end, frame_bytes), out);
            });
        }
    }

    pub fn counters(&self) -> DecoderCounters {
        DecoderCounters {
            framing: *self.framer.counters(),
            packets_missed: self.interpreter.sensor.packets_missed,
            ..self.interpreter.counters
        }
    }
}

impl Interpreter {
    fn push(&mut self, framed: Framed<'_>, arrival: Arrival, out: &mut Vec<GnssSample>) {
        let Self { epochs, sensor, plausibility, counters } = self;
        let mut emit = |sample: GnssSample| out.push(judge(sample, plausibility, counters));
        let is_used = match framed {
            Framed::Sentence(content) => nmea::parse(content).map(|said| epochs.push(said, arrival, &mut emit)),
            Framed::Packet { message_id: xbus::MTDATA2, data } => {
                xbus::parse(data).map(|said| sensor.push(&said, arrival.end_ns, &mut emit))
            }
            Framed::Packet { .. } => Ok(false),
        };
        match is_used {
            Ok(is_used) => self.counters.ignored += u64::from(!is_used),
            Err(reason) => emit(GnssSample::Rejected { arrival_ns: arrival.end_ns, reason }),
        }
    }
}

/// Counts a sample; one that cannot be becomes the reason why.
fn judge(sample: GnssSample, plausibility: &mut Plausibility, counters: &mut DecoderCounters) -> GnssSample {
    let (arrival_ns, verdict) = match &sample {
        GnssSample::Fix(fix) => (fix.arrival_ns, plausibility.check(fix)),
        GnssSample::Heading(heading) if !heading.yaw_rad.is_finite() => {
            (heading.arrival_ns, Err("heading is not a number"))
        }
        _ => (0, Ok(())),
    };
    let sample = match verdict {
        Ok(()) => sample,
        Err(reason) => GnssSample::Rejected { arrival_ns, reason },
    };
    *match &sample {
        GnssSample::Fix(_) => &mut counters.fixes,
        GnssSample::Heading(_) => &mut counters.headings,
        GnssSample::Time { .. } => &mut counters.times,
        GnssSample::NoFix { .. } => &mut counters.no_fixes,
        GnssSample::Rejected { .. } => &mut counters.rejected,
    } += 1;
    sample
}

/// When each of the last bytes arrived. The last byte of a chunk arrived at its stamp, and those before it one after the
/// other at the speed of the line, but not before the chunk before.
#[derive(Debug, Clone, Default)]
struct Arrivals {
    /// Oldest first; those that a frame may still end in.
    chunks: VecDeque<Mark>,
    /// Bytes of the stream so far.
    end: u64,
}

#[derive(Debug, Clone, Copy)]
struct Mark {
    /// Bytes of the stream up to the end of this chunk.
    end: u64,
    arrival_ns: u64,
    baud: u32,
    /// The stamp of the chunk before.
    not_before_ns: u64,
}

/// Start bit, eight data bits, stop bit.
const BITS_PER_BYTE: u64 = 10;

impl Arrivals {
    /// `pending`: bytes from before this chunk that may still become part of a frame.
    fn note(&mut self, chunk: &SerialChunk, pending: usize) {
        if chunk.bytes.is_empty() {
            return;
        }
        let pending_from = self.end - pending as u64;
        while self.chunks.front().is_some_and(|mark| mark.end <= pending_from && self.chunks.len() > 1) {
            self.chunks.pop_front();
        }
        let not_before_ns = self.chunks.back().map_or(0, |mark| mark.arrival_ns.min(chunk.arrival_ns));
        self.end += chunk.bytes.len() as u64;
        let SerialChunk { arrival_ns, baud, .. } = *chunk;
        self.chunks.push_back(Mark { end: self.end, arrival_ns, baud, not_before_ns });
    }

    /// Of the `bytes` bytes of the stream that end after `end`.
    fn of(&self, end: u64, bytes: usize) -> Arrival {
        let Some(mark) = self.chunks.iter().find(|mark| mark.end >= end) else {
            return Arrival { start_ns: 0, end_ns: 0 };
        };
        let line_time_ns = |bytes: u64| match mark.baud {
            0 => 0,
            baud => bytes.saturating_mul(BITS_PER_BYTE * NS_PER_S) / u64::from(baud),
        };
        let end_ns = mark.arrival_ns.saturating_sub(line_time_ns(mark.end - end)).max(mark.not_before_ns);
        Arrival { start_ns: end_ns.saturating_sub(line_time_ns(bytes as u64)), end_ns }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::gnss::encode;

    fn chunk(arrival_ns: u64, bytes: &[u8]) -> SerialChunk {
        // 100 000 bit/s: 100 µs a byte.
        SerialChunk { arrival_ns, baud: 100_000, bytes: bytes.to_vec() }
    }

    fn decode(chunks: &[SerialChunk]) -> Vec<GnssSample> {
        let mut decoder = GnssDecoder::new(&DecoderSettings::default());
        let mut out = Vec::new();
        chunks.iter().for_each(|chunk| decoder.push(chunk, &mut out));
        out
    }

    fn arrivals_ns(samples: &[GnssSample]) -> Vec<u64> {
        let heading = |sample: &GnssSample| match sample {
            GnssSample::Heading(heading) => Some(heading.arrival_ns),
            _ => None,
        };
        samples.iter().filter_map(heading).collect()
    }

    const HDT: &[u8] = b"$HEHDT,341.8,T*21\r\n";

    #[test]
    fn a_sentence_arrived_when_its_last_byte_did() {
        let twice = [HDT, HDT, b"$GP"].concat();
        let found = decode(&[chunk(1_000_000_000, &twice)]);
        assert_eq!(arrivals_ns(&found), [1_000_000_000 - 22 * 100_000, 1_000_000_000 - 3 * 100_000]);
    }

    #[test]
    fn no_byte_arrived_before_the_chunk_before_it() {
        // Held up by USB: both chunks read at nearly the same time.
        let found = decode(&[chunk(1_000_000_000, b"\n"), chunk(1_000_500_000, &[HDT, HDT].concat())]);
        assert_eq!(arrivals_ns(&found), [1_000_000_000, 1_000_500_000]);
    }

    #[test]
    fn a_packet_held_up_by_a_false_start_keeps_its_time() {
        let ack = [0xFA, 0xFF, 0x36, 0x0A, 0x20, 0x30, 0x0C];
        // The false start claims 12 bytes; the true packet, yaw 0 in ENU, comes in the same and the next chunk.
        let mut packet = vec![0xFA, 0xFF, 0x36, 15, 0x20, 0x30, 12];
        packet.extend([0; 12]);
        packet.push(super::super::framing::packet_sum(&packet[1..]));
        let (first, second) = packet.split_at(5);
        let found = decode(&[
            chunk(1_000_000_000, &[&ack[..4], first].concat()),
            chunk(2_000_000_000, second),
            chunk(3_000_000_000, &[0; 300]),
        ]);
        assert_eq!(arrivals_ns(&found), [2_000_000_000]);
    }

    /// Bytes that look like something: pieces of sentences and packets among noise.
    fn bytes() -> impl Strategy<Value = Vec<u8>> {
        let packet = proptest::collection::vec(any::<u8>(), 0..40).prop_map(|data| {
            let mut bytes = Vec::new();
            encode::write_packet(xbus::MTDATA2, &data, &mut bytes);
            bytes
        });
        let piece = prop_oneof![
            proptest::collection::vec(any::<u8>(), 0..30),
            proptest::collection::vec(proptest::sample::select(&b"$*,\r\n\xfa\xff\x36\x00"[..]), 0..30),
            "[$][A-Z]{5},[0-9.,NEMT]{0,80}[*][0-9A-F]{2}\r\n".prop_map(String::into_bytes),
            "(GNGGA|GNRMC|GPZDA|HEHDT|PASHR),[0-9]{6},[0-9.,NEMTA]{0,60}".prop_map(|content| {
                let mut bytes = Vec::new();
                encode::write_sentence(&content, &mut bytes);
                bytes
            }),
            packet,
        ];
        proptest::collection::vec(piece, 0..20).prop_map(|pieces| pieces.concat())
    }

    proptest! {
        #[test]
        fn any_bytes_are_survived_and_cutting_makes_no_difference(
            bytes in bytes(),
            cuts in proptest::collection::vec(any::<proptest::sample::Index>(), 0..30),
        ) {
            let at = |end: usize| NS_PER_S + end as u64 * 100_000;
            let mut ends: Vec<_> = cuts.iter().map(|cut| cut.index(bytes.len() + 1)).collect();
            ends.push(bytes.len());
            ends.sort_unstable();
            let starts = std::iter::once(0).chain(ends.iter().copied());
            let pieces: Vec<_> =
                starts.zip(&ends).map(|(start, &end)| chunk(at(end), &bytes[start..end])).collect();
            prop_assert_eq!(decode(&pieces), decode(&[chunk(at(bytes.len()), &bytes)]));
        }

        #[test]
        fn any_stamps_are_survived(chunks in proptest::collection::vec((any::<u64>(), any::<u32>(), bytes()), 0..6)) {
            let chunks: Vec<_> = chunks
                .into_iter()
                .map(|(arrival_ns, baud, bytes)| SerialChunk { arrival_ns, baud, bytes })
                .collect();
            decode(&chunks);
        }
    }

    #[test]
    fn marks_do_not_pile_up() {
        let mut decoder = GnssDecoder::new(&DecoderSettings::default());
        let mut out = Vec::new();
        for i in 0..10_000 {
            decoder.push(&chunk(i, &[0xFA]), &mut out);
            decoder.push(&chunk(i, &[]), &mut out);
        }
        assert!(decoder.arrivals.chunks.len() < 8, "{}", decoder.arrivals.chunks.len());
    }
}
