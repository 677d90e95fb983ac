//! Byte streams as receivers, sensors and bad lines send them, each with what is decoded from it beside it.
//!
//! `tests/serial_corpus/make.py` writes the streams, in another language and without our encoders. What is expected was
//! read and judged line by line; `OMNILOC_BLESS=1` writes it anew, to be read again. A bug found in the field becomes one
//! more stream.

use std::{
    fmt::Write,
    fs,
    path::{Path, PathBuf},
};

use omniloc::{
    devices::SerialChunk,
    gnss::{DecoderCounters, DecoderSettings, GnssDecoder},
    types::{GnssSample, NS_PER_S, SampleTime, TimeScale},
};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

const MIN_STREAMS: usize = 50;
const RANDOM_SPLITS: usize = 8;

struct Stream {
    path: PathBuf,
    bytes: Vec<u8>,
    /// Divides 10 s / byte without a remainder, so that times do not depend on how the stream is cut.
    baud: u32,
}

fn streams() -> Vec<Stream> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/serial_corpus");
    let entries = fs::read_dir(folder).expect("the corpus is there");
    let mut streams: Vec<_> = entries
        .map(|entry| entry.expect("a folder entry").path())
        .filter(|path| path.extension().is_some_and(|extension| extension == "bin"))
        .map(|path| {
            let name = path.file_stem().expect("a file").to_string_lossy();
            let baud = name.split_once('@').map_or(100_000, |(_, baud)| baud.parse().expect("a number"));
            Stream { bytes: fs::read(&path).expect("readable"), baud, path }
        })
        .collect();
    streams.sort_by(|a, b| a.path.cmp(&b.path));
    streams
}

impl Stream {
    /// Decodes it in pieces that end at `ends`; the first byte begins to arrive one second after boot.
    fn decode(&self, ends: impl IntoIterator<Item = usize>) -> (Vec<GnssSample>, DecoderCounters) {
        let mut decoder = GnssDecoder::new(&DecoderSettings::default());
        let (mut samples, mut start) = (Vec::new(), 0);
        for end in ends.into_iter().chain([self.bytes.len()]) {
            let bytes = self.bytes[start..end].to_vec();
            let arrival_ns = NS_PER_S + end as u64 * 10 * NS_PER_S / u64::from(self.baud);
            decoder.push(&SerialChunk { arrival_ns, baud: self.baud, bytes }, &mut samples);
            start = end;
        }
        (samples, decoder.counters())
    }
}

/// One line a sample, then the counters that are not 0.
fn to_text(samples: &[GnssSample], counters: &DecoderCounters) -> String {
    let mut text = String::new();
    for sample in samples {
        let arrival_ns = match sample {
            GnssSample::Fix(fix) => fix.arrival_ns,
            GnssSample::Heading(heading) => heading.arrival_ns,
            GnssSample::Time { arrival_ns, .. }
            | GnssSample::NoFix { arrival_ns, .. }
            | GnssSample::Rejected { arrival_ns, .. } => *arrival_ns,
        };
        write!(text, "@{:.1} ms ", (arrival_ns - NS_PER_S) as f64 * 1e-6).expect("memory");
        match sample {
            GnssSample::Fix(fix) => {
                let place = fix.position;
                write!(text, "fix {} {}", fix.source, time_text(fix.sample_time)).expect("memory");
                write!(text, " {:.8} {:.8} {:.3} m", place.latitude_deg, place.longitude_deg, place.altitude_m)
                    .expect("memory");
                write!(text, " {:?}", fix.quality).expect("memory");
                if let Some([east, north, up]) = fix.position_std_m {
                    write!(text, " std {east:.3} {north:.3} {up:.3} m").expect("memory");
                }
                optional(&mut text, "satellites", fix.satellites.map(f64::from), 0);
                optional(&mut text, "dilution", fix.horizontal_dilution, 2);
                optional(&mut text, "m/s", fix.speed_mps, 3);
                optional(&mut text, "course deg", fix.course_rad.map(f64::to_degrees), 3);
            }
            GnssSample::Heading(heading) => {
                write!(text, "heading {} {}", heading.source, time_text(heading.sample_time)).expect("memory");
                write!(text, " yaw {:.3} deg {:?}", heading.yaw_rad.to_degrees(), heading.north).expect("memory");
                optional(&mut text, "std deg", heading.yaw_std_rad.map(f64::to_degrees), 3);
            }
            GnssSample::Time { sample_time, .. } => {
                write!(text, "time {}", time_text(Some(*sample_time))).expect("memory");
            }
            GnssSample::NoFix { sample_time, .. } => {
                write!(text, "no fix {}", time_text(*sample_time)).expect("memory");
            }
            GnssSample::Rejected { reason, .. } => write!(text, "rejected: {reason}").expect("memory"),
        }
        text.push('\n');
    }
    let framing = &counters.framing;
    for (name, count) in [
        ("bytes", framing.bytes),
        ("framed_bytes", framing.framed_bytes),
        ("skipped_bytes", framing.skipped_bytes),
        ("sentences", framing.sentences),
        ("packets", framing.packets),
        ("wrong_sentence_sums", framing.wrong_sentence_sums),
        ("missing_sums", framing.missing_sums),
        ("overlong_sentences", framing.overlong_sentences),
        ("broken_sentences", framing.broken_sentences),
        ("wrong_packet_sums", framing.wrong_packet_sums),
        ("broken_packets", framing.broken_packets),
        ("ignored", counters.ignored),
        ("fixes", counters.fixes),
        ("headings", counters.headings),
        ("no_fixes", counters.no_fixes),
        ("times", counters.times),
        ("rejected", counters.rejected),
        ("packets_missed", counters.packets_missed),
    ] {
        if count > 0 {
            writeln!(text, "{name} {count}").expect("memory");
        }
    }
    text
}

fn optional(text: &mut String, name: &str, value: Option<f64>, decimals: usize) {
    if let Some(value) = value {
        write!(text, " {name} {value:.decimals$}").expect("memory");
    }
}

fn time_text(time: Option<SampleTime>) -> String {
    let Some(SampleTime { ns, scale }) = time else { return "at ?".to_owned() };
    let (days, of_day_s) = (ns.div_euclid(86_400_000_000_000), ns.rem_euclid(86_400_000_000_000) as f64 * 1e-9);
    match scale {
        TimeScale::Utc => format!("utc day {days} {of_day_s:.4} s"),
        TimeScale::UtcOfDay => format!("of day {days} {of_day_s:.4} s"),
        TimeScale::Device => format!("device {:.4} s", ns as f64 * 1e-9),
    }
}

#[test]
fn streams_decode_to_what_is_expected() {
    let streams = streams();
    assert!(streams.len() >= MIN_STREAMS, "{} streams", streams.len());
    let bless = std::env::var_os("OMNILOC_BLESS").is_some();
    let mut wrong = String::new();
    for stream in &streams {
        let (samples, counters) = stream.decode([]);
        let found = to_text(&samples, &counters);
        let path = stream.path.with_extension("expected");
        if bless {
            fs::write(&path, &found).expect("writable");
            continue;
        }
        let expected = fs::read_to_string(&path).unwrap_or_else(|_| "no such file\n".to_owned());
        if found != expected {
            write!(wrong, "{}\nexpected:\n{expected}found:\n{found}\n", path.display()).expect("memory");
        }
    }
    assert!(wrong.is_empty(), "{wrong}");
}

#[test]
fn where_a_stream_is_cut_makes_no_difference() {
    let mut random = ChaCha8Rng::seed_from_u64(1);
    for stream in streams() {
        let whole = stream.decode([]);
        let name = stream.path.display();
        assert!(stream.decode(1..stream.bytes.len()) == whole, "{name} byte by byte");
        for _ in 0..RANDOM_SPLITS {
            let mut ends: Vec<_> = (1..stream.bytes.len()).filter(|_| random.random_bool(0.05)).collect();
            // An empty chunk now and then.
            ends.extend(ends.first().copied());
            ends.sort_unstable();
            assert!(stream.decode(ends.clone()) == whole, "{name} cut at {ends:?}");
        }
    }
}
