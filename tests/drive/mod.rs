//! A short drive of small frames, and what became of it.

#![allow(dead_code, reason = "each test program uses a part")]

use std::{collections::BTreeMap, io, path::Path, sync::Arc};

use omniloc::{
    recording::{
        proto::omniloc as messages,
        recorder::{
            DriveWriter, Encoder, Entry, Head, Part, Queued, SegmentName, Settings, Storage, cut_segments, mend,
        },
        topics, verify,
    },
    types::{Clock, ClockReading, ManualClock},
};
use rand::{Rng, RngCore, SeedableRng, rngs::StdRng};

pub const BOOT_ID: &str = "0123abcd-0000-4000-8000-000000000000";
pub const FRAME_NS: u64 = 1_000_000_000 / 30;
/// Pairs come so many frames late.
const PAIR_LAG: u32 = 12;

pub const START: ClockReading = ClockReading { monotonic_ns: 5_000_000_000, realtime_ns: 1_700_000_000_000_000_000 };

/// A JPEG of about so many bytes that is like no other: noise in a comment, then a picture.
pub fn jpeg(seed: u32, bytes: usize) -> Vec<u8> {
    let mut picture = Vec::new();
    image::codecs::jpeg::JpegEncoder::new(&mut picture)
        .encode(&[seed as u8; 64], 8, 8, image::ExtendedColorType::L8)
        .expect("encodes");
    let mut jpeg = picture[..2].to_vec();
    let mut random = StdRng::seed_from_u64(seed.into());
    let mut left = bytes;
    while left > 0 {
        let mut noise = vec![0; left.min(60_000)];
        left -= noise.len();
        random.fill_bytes(&mut noise);
        jpeg.extend([0xFF, 0xFE]);
        jpeg.extend(((noise.len() + 2) as u16).to_be_bytes());
        jpeg.extend(noise);
    }
    jpeg.extend(&picture[2..]);
    jpeg
}

/// What identifies a message: topic, sequence number.
pub type Key = (String, u32);

/// A message that was recorded.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Pushed {
    pub stamp_ns: u64,
    pub payload: Vec<u8>,
}

/// A drive being recorded, with everything that was pushed.
pub struct Drive {
    pub writer: DriveWriter,
    pub clock: Arc<ManualClock>,
    pub pushed: BTreeMap<Key, Pushed>,
    /// What was acknowledged.
    pub acknowledged: Vec<Key>,
    unacknowledged: Vec<Key>,
    encoder: Encoder,
    frame_bytes: usize,
    frame: u32,
}

pub fn settings() -> Settings {
    Settings { segment_s: 1, ..Settings::new("/simulated") }
}

impl Drive {
    pub fn start(settings: Settings, storage: Arc<dyn Storage>, frame_bytes: usize) -> io::Result<Self> {
        let clock = Arc::new(ManualClock::new(START));
        let head = Head::new("[camera]", "test", BOOT_ID, START);
        let encoder = Encoder::new(head.log_offset_ns);
        let writer = DriveWriter::new(settings, head, BOOT_ID, storage, clock.clone())?;
        Ok(Self {
            writer,
            clock,
            pushed: BTreeMap::new(),
            acknowledged: Vec::new(),
            unacknowledged: Vec::new(),
            encoder,
            frame_bytes,
            frame: 0,
        })
    }

    /// A thirtieth of a second: serial bytes, a frame, the pair of an earlier frame.
    pub fn step(&mut self) {
        let now_ns = self.clock.monotonic_ns();
        let frame = self.frame;
        self.frame += 1;
        let chunk = messages::SerialChunk {
            timestamp: Some(self.encoder.timestamp(now_ns)),
            data: format!("$GPGGA,{frame}*00\r\n").into_bytes(),
            baud: 115_200,
        };
        self.push(self.encoder.message(&topics::GNSS_RAW, frame, now_ns, &chunk));
        let bytes = self.frame_bytes / 2 + (frame as usize * 7919) % (self.frame_bytes + 1);
        self.push(Entry::Image { sequence: frame, stamp_ns: now_ns, jpeg: jpeg(frame, bytes).into() });
        if let Some(of_frame) = frame.checked_sub(PAIR_LAG) {
            let stamp_ns = now_ns - u64::from(PAIR_LAG) * FRAME_NS;
            let pair = messages::SurveyPair { east_m: f64::from(of_frame), valid: true, ..Default::default() };
            let (pair, pose) = self.encoder.pair(of_frame, stamp_ns, pair);
            self.push(pair);
            self.push(pose.expect("it is valid"));
        }
        self.clock.advance_ns(FRAME_NS);
        self.tick();
    }

    pub fn tick(&mut self) {
        self.writer.tick();
        self.note_acknowledged();
    }

    pub fn finish(&mut self) -> bool {
        let is_complete = self.writer.finish();
        self.note_acknowledged();
        is_complete
    }

    fn push(&mut self, entry: Entry) {
        let (key, pushed) = match &entry {
            Entry::Image { sequence, stamp_ns, jpeg } => {
                ((topics::CAMERA_IMAGE.name.into(), *sequence), Pushed { stamp_ns: *stamp_ns, payload: jpeg.to_vec() })
            }
            Entry::Message { topic, sequence, stamp_ns, payload } => {
                ((topic.name.into(), *sequence), Pushed { stamp_ns: *stamp_ns, payload: payload.to_vec() })
            }
            _ => unreachable!("the drive pushes messages"),
        };
        self.pushed.insert(key.clone(), pushed);
        self.unacknowledged.push(key);
        self.writer.write(Queued::new(entry, self.clock.monotonic_ns()));
        self.note_acknowledged();
    }

    fn note_acknowledged(&mut self) {
        if self.writer.pending() == 0 {
            self.acknowledged.append(&mut self.unacknowledged);
        }
    }
}

/// Everything that finished segments hold; payloads of images are the JPEGs. Panics if one is not readable.
pub fn read_segments<'a>(segments: impl IntoIterator<Item = (&'a str, Vec<u8>)>) -> Vec<(Key, Pushed)> {
    use prost::Message;
    let folder = tempfile::tempdir().expect("a temporary folder");
    let mut found = Vec::new();
    for (name, bytes) in segments {
        let path = folder.path().join(name);
        std::fs::write(&path, &bytes).expect("writes");
        check_segment(&path);
        for message in mcap::MessageStream::new(&bytes).expect("readable") {
            let message = message.expect("readable");
            let payload = match message.channel.topic.as_str() {
                "/camera/image" => {
                    let image = omniloc::recording::proto::foxglove::CompressedImage::decode(&*message.data);
                    image.expect("decodes").data
                }
                _ => message.data.to_vec(),
            };
            let stamp_ns = message.publish_time;
            found.push(((message.channel.topic.clone(), message.sequence), Pushed { stamp_ns, payload }));
        }
    }
    found
}

fn check_segment(path: &Path) {
    let verdict = verify(path).expect("readable");
    assert!(verdict.is_complete && verdict.is_sound(), "{}: {:?}", path.display(), verdict.problems);
    let recording = omniloc::recording::Recording::open_any(path).expect("readable");
    assert!(recording.metadata.contains_key(topics::metadata::SETTINGS), "{:?}", recording.metadata);
}

/// Mends all cut segments.
pub fn mend_all(storage: &dyn Storage) -> io::Result<()> {
    for name in cut_segments(storage)? {
        mend(storage, &name, &mut || Ok(()))?;
    }
    Ok(())
}

/// Names of the finished segments.
pub fn finished(names: &[String]) -> Vec<&str> {
    let is_finished = |name: &&str| SegmentName::parse(name).is_some_and(|(_, part)| part == Part::Finished);
    names.iter().map(String::as_str).filter(is_finished).collect()
}

/// How often to run a campaign: a few times, or what `OMNILOC_SOAK` says.
pub fn rounds(short: u64) -> u64 {
    std::env::var("OMNILOC_SOAK").ok().and_then(|count| count.parse().ok()).unwrap_or(short)
}

pub fn random(seed: u64) -> StdRng {
    StdRng::seed_from_u64(seed)
}

pub fn pick<T: Copy>(random: &mut StdRng, from: &[T]) -> T {
    from[random.random_range(0..from.len())]
}
