//! A survey drive: what the devices say becomes what is recorded.
//!
//! Nothing here knows a thread, a file or a clock, so that a drive that is replayed takes the same way as a live one:
//!
//! ```text
//! frames ────────────────────────────┬──────────────► /camera/image
//! bytes ─┬─────────────────────────────────────────► /gnss/raw
//!        └► decoder ─► fixes, yaws ──┼─► synchronizer ─► /survey/pair, /survey/pose
//! pulses ────────────────────────────┘                   /gnss/fix, /gnss/heading
//! ```

use std::collections::BTreeMap;

use tracing::{info, warn};

use super::{complaints::Complaints, status::StatusCounter, system::SystemStatus};
use crate::{
    devices::{CameraEvent, CameraFacts, CameraFrame, GpioEvent, Lost, SerialEvent},
    gnss::{DecoderSettings, GnssDecoder},
    recording::{
        proto::{foxglove, omniloc},
        recorder::{Encoder, Entry, Loss, RecorderHealth},
        topics::{self, Topic, metadata},
    },
    sync::{self, Pair, Synchronizer, VisualRotation},
    types::{ClockReading, Fix, Geodetic, GnssSample, Heading},
};

/// Realtime that moves by more than this against the monotonic clock within a second was set [ns].
const CLOCK_STEP_NS: u64 = 100_000_000;

/// Why a pair may not be used whose frame found no room.
const NOT_RECORDED: &str = "not recorded";

/// Something that happened.
#[derive(Debug)]
pub enum Input {
    Camera(CameraEvent),
    Serial(SerialEvent),
    Gpio(GpioEvent),
    /// The pictures show that the vehicle has turned.
    Turn(VisualRotation),
    /// A device failed; the word says why. `None`: it ended.
    Health {
        device: Device,
        health: Option<&'static str>,
    },
    /// A second has passed.
    Tick(Tick),
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Device {
    Camera,
    Gnss,
    Gpio,
}

/// The state of what is not a device, once a second.
#[derive(Debug, Clone, Default)]
pub struct Tick {
    pub clocks: Option<ClockReading>,
    pub system: SystemStatus,
    pub recorder: RecorderHealth,
    /// Frames and chunks that found the queue to this place full since the tick before.
    pub frames_refused: u64,
    pub chunks_refused: u64,
}

/// Where the drive is recorded.
pub trait Sink {
    /// `false`: there was no room for it. Whoever records says so in the recording.
    fn push(&mut self, entry: Entry) -> bool;
    /// Keep what is being recorded.
    fn mark(&mut self);
}

/// The drive as far as it has come.
pub struct Survey {
    decoder: GnssDecoder,
    synchronizer: Synchronizer,
    status: StatusCounter,
    complaints: Complaints,
    /// Sentences and packets with wrong sums that the complaints know of.
    damaged_told: u64,
    encoder: Encoder,
    /// Number of the next frame if the camera's count starts anew.
    next_frame: u32,
    /// What the camera's count has to be shifted by: frame numbers never repeat in a recording.
    frame_shift: Option<u32>,
    origin_known: bool,
    last_clocks: Option<ClockReading>,
    samples: Vec<GnssSample>,
    pairs: Vec<Pair>,
}

impl Survey {
    /// `log_offset_ns`: realtime minus monotonic at the start, which makes dates for viewers out of stamps.
    ///
    /// # Errors
    /// Settings that cannot be.
    pub fn new(decoder: &DecoderSettings, sync: &sync::Settings, log_offset_ns: u64) -> Result<Self, String> {
        Ok(Self {
            decoder: GnssDecoder::new(decoder),
            synchronizer: Synchronizer::new(sync, None)?,
            status: StatusCounter::default(),
            complaints: Complaints::default(),
            damaged_told: 0,
            encoder: Encoder::new(log_offset_ns),
            next_frame: 0,
            frame_shift: None,
            origin_known: false,
            last_clocks: None,
            samples: Vec::new(),
            pairs: Vec::new(),
        })
    }

    /// The state a second ago: for the status line.
    pub fn status(&self) -> &omniloc::Status {
        self.status.last()
    }

    /// Camera and receiver have ended by themselves, as in a replay.
    pub fn has_ended(&self) -> bool {
        self.status.have_ended()
    }

    pub fn take(&mut self, input: Input, out: &mut dyn Sink) {
        match input {
            Input::Camera(CameraEvent::Opened(facts)) => self.camera_opened(&facts, out),
            Input::Camera(CameraEvent::Frame(frame)) => self.frame(frame, out),
            Input::Camera(CameraEvent::Lost(lost)) => self.lost(&topics::CAMERA_IMAGE, &lost, out),
            Input::Serial(SerialEvent::Opened { port, baud }) => {
                info!(port = %port.display(), baud, "serial line open");
                self.status.gnss_opened();
            }
            Input::Serial(SerialEvent::Chunk(chunk)) => self.chunk(&chunk, out),
            Input::Gpio(GpioEvent::Pulse { stamp_ns }) => {
                self.synchronizer.push_pps(stamp_ns);
                let pulse = omniloc::Pulse { timestamp: self.timestamp(stamp_ns) };
                out.push(self.encoder.message(&topics::GNSS_PULSE, 0, stamp_ns, &pulse));
            }
            Input::Gpio(GpioEvent::Button { .. }) => {
                info!("button pressed: this piece of the recording is kept");
                out.mark();
            }
            Input::Turn(VisualRotation { from_ns, to_ns, rotation_rad, .. }) => {
                self.synchronizer.push_visual_rotation(from_ns, to_ns, rotation_rad);
            }
            Input::Health { device, health } => self.status.device(device, health),
            Input::Tick(tick) => self.tick(&tick, out),
        }
    }

    /// Decides what is still waiting for a later fix. Nothing comes after this.
    pub fn finish(&mut self, out: &mut dyn Sink) {
        self.synchronizer.finish(&mut self.pairs);
        self.write_pairs(None, out);
    }

    fn camera_opened(&mut self, facts: &CameraFacts, out: &mut dyn Sink) {
        let CameraFacts { name, width_px, height_px, frame_rate_hz, pixel_format } = facts;
        info!(camera = %name, width_px, height_px, frame_rate_hz, %pixel_format, "camera open");
        self.status.camera_opened();
        self.frame_shift = None;
        let entries = [
            ("name", name.clone()),
            ("width_px", width_px.to_string()),
            ("height_px", height_px.to_string()),
            ("frame_rate_hz", frame_rate_hz.to_string()),
            ("sends", pixel_format.clone()),
            ("encoding", "jpeg".into()),
        ];
        out.push(facts_entry(metadata::CAMERA, entries));
    }

    fn frame(&mut self, frame: CameraFrame, out: &mut dyn Sink) {
        let shift = *self.frame_shift.get_or_insert(self.next_frame.wrapping_sub(frame.sequence));
        let sequence = frame.sequence.wrapping_add(shift);
        self.next_frame = sequence.wrapping_add(1);
        self.status.frame(frame.stamp_ns, frame.damage.is_some());
        if let Some(reason) = frame.damage {
            self.complaints.note(topics::CAMERA_IMAGE.name, reason, 1);
            out.push(Entry::Lost(Loss::one(&topics::CAMERA_IMAGE, reason, frame.stamp_ns)));
        }
        // A damaged frame is recorded too: whoever looks at it later sees what the camera sent.
        let is_recorded = out.push(Entry::Image { sequence, stamp_ns: frame.stamp_ns, jpeg: frame.jpeg });
        if !is_recorded {
            self.status.lost(&topics::CAMERA_IMAGE, 1);
        }
        let damage = if is_recorded { frame.damage } else { Some(NOT_RECORDED) };
        self.synchronizer.push_frame(sequence.into(), frame.stamp_ns, damage);
        self.poll(frame.arrival_ns, out);
    }

    fn chunk(&mut self, chunk: &crate::devices::SerialChunk, out: &mut dyn Sink) {
        let raw = omniloc::SerialChunk {
            timestamp: self.timestamp(chunk.arrival_ns),
            data: chunk.bytes.clone(),
            baud: chunk.baud,
        };
        out.push(self.encoder.message(&topics::GNSS_RAW, 0, chunk.arrival_ns, &raw));
        self.status.bytes(chunk.arrival_ns, chunk.bytes.len());

        let mut samples = std::mem::take(&mut self.samples);
        self.decoder.push(chunk, &mut samples);
        for sample in samples.drain(..) {
            self.sample(&sample, out);
        }
        self.samples = samples;
        self.poll(chunk.arrival_ns, out);
    }

    fn sample(&mut self, sample: &GnssSample, out: &mut dyn Sink) {
        self.synchronizer.push_sample(sample);
        match sample {
            GnssSample::Fix(fix) => {
                let stamp_ns = self.synchronizer.stamp_ns(fix.arrival_ns, fix.sample_time);
                self.status.fix(fix);
                let message = self.fix_message(fix, stamp_ns);
                out.push(self.encoder.message(&topics::GNSS_FIX, 0, stamp_ns, &message));
            }
            GnssSample::Heading(heading) => {
                let stamp_ns = self.synchronizer.stamp_ns(heading.arrival_ns, heading.sample_time);
                self.status.heading();
                let message = self.heading_message(heading, stamp_ns);
                out.push(self.encoder.message(&topics::GNSS_HEADING, 0, stamp_ns, &message));
            }
            GnssSample::NoFix { arrival_ns, .. } => self.status.no_fix(*arrival_ns),
            GnssSample::Rejected { arrival_ns, reason } => {
                self.status.rejected(*arrival_ns);
                let lost = Lost { count: 1, reason, stamp_ns: *arrival_ns };
                self.lost(&topics::GNSS_FIX, &lost, out);
            }
            GnssSample::Time { .. } => {}
        }
    }

    fn fix_message(&self, fix: &Fix, stamp_ns: u64) -> foxglove::LocationFix {
        use foxglove::location_fix::PositionCovarianceType::{DiagonalKnown, Unknown};
        let (position_covariance, kind) = match fix.position_std_m {
            Some([e, n, u]) => (vec![e * e, 0.0, 0.0, 0.0, n * n, 0.0, 0.0, 0.0, u * u], DiagonalKnown),
            None => (vec![0.0; 9], Unknown),
        };
        foxglove::LocationFix {
            timestamp: self.timestamp(stamp_ns),
            frame_id: topics::GNSS_FRAME.into(),
            latitude: fix.position.latitude_deg,
            longitude: fix.position.longitude_deg,
            altitude: fix.position.altitude_m,
            position_covariance,
            position_covariance_type: kind.into(),
        }
    }

    fn heading_message(&self, heading: &Heading, stamp_ns: u64) -> omniloc::Heading {
        omniloc::Heading {
            timestamp: self.timestamp(stamp_ns),
            yaw_rad: heading.yaw_rad,
            source: heading.source.into(),
            yaw_std_rad: heading.yaw_std_rad,
        }
    }

    fn lost(&mut self, topic: &'static Topic, lost: &Lost, out: &mut dyn Sink) {
        self.status.lost(topic, lost.count);
        self.complaints.note(topic.name, lost.reason, lost.count);
        let Lost { count, reason, stamp_ns } = *lost;
        out.push(Entry::Lost(Loss { topic, reason, count, first_ns: stamp_ns, last_ns: stamp_ns }));
    }

    fn poll(&mut self, now_ns: u64, out: &mut dyn Sink) {
        self.synchronizer.poll(now_ns, &mut self.pairs);
        self.write_pairs(Some(now_ns), out);
    }

    fn write_pairs(&mut self, now_ns: Option<u64>, out: &mut dyn Sink) {
        if !self.origin_known
            && let Some(origin) = self.synchronizer.origin()
        {
            self.origin_known = true;
            info!(latitude_deg = origin.latitude_deg, longitude_deg = origin.longitude_deg, "origin set");
            out.push(origin_entry(origin));
        }
        for pair in self.pairs.drain(..) {
            self.status.pair(&pair, now_ns);
            let (pair, pose) = self.encoder.pair(pair.sequence as u32, pair.stamp_ns, pair.to_message());
            out.push(pair);
            pose.into_iter().for_each(|pose| _ = out.push(pose));
        }
    }

    fn tick(&mut self, tick: &Tick, out: &mut dyn Sink) {
        if let Some(clocks) = tick.clocks {
            self.clock(clocks, out);
        }
        let now_ns = self.status.now_ns(tick);
        for (topic, count) in [(&topics::CAMERA_IMAGE, tick.frames_refused), (&topics::GNSS_RAW, tick.chunks_refused)] {
            if count > 0 {
                self.lost(topic, &Lost { count, reason: "computer too slow", stamp_ns: now_ns }, out);
            }
        }
        self.complain(now_ns);
        self.poll(now_ns, out);
        let timestamp = self.timestamp(now_ns);
        let status = self.status.second(tick, self.synchronizer.latency(), &self.decoder.counters());
        let status = omniloc::Status { timestamp, ..status.clone() };
        out.push(self.encoder.message(&topics::STATUS, 0, now_ns, &status));
    }

    fn complain(&mut self, now_ns: u64) {
        let damaged = self.decoder.counters().framing.refused();
        self.complaints.note(topics::GNSS_RAW.name, "sum or length wrong", damaged - self.damaged_told);
        self.damaged_told = damaged;
        for (topic, reason, count) in self.complaints.due(now_ns) {
            warn!(topic, reason, count, "lost or refused");
        }
    }

    fn clock(&mut self, clocks: ClockReading, out: &mut dyn Sink) {
        let ClockReading { monotonic_ns, realtime_ns } = clocks;
        let offset_ns = |clocks: ClockReading| i128::from(clocks.realtime_ns) - i128::from(clocks.monotonic_ns);
        let step_ns = self.last_clocks.replace(clocks).map_or(0, |last| offset_ns(clocks) - offset_ns(last));
        if step_ns.unsigned_abs() > CLOCK_STEP_NS.into() {
            warn!(step_s = step_ns as f64 * 1e-9, "the computer's date was set; stamps are not affected");
        }
        let utc = self.synchronizer.utc_at(monotonic_ns);
        let message = omniloc::ClockOffset {
            timestamp: self.timestamp(monotonic_ns),
            monotonic_ns,
            realtime_ns,
            gnss_utc_ns: utc.map(|(utc_ns, _)| utc_ns),
            gnss_utc_std_s: utc.map(|(_, std_s)| std_s),
            realtime_step_s: step_ns as f64 * 1e-9,
        };
        out.push(self.encoder.message(&topics::CLOCK, 0, monotonic_ns, &message));
    }

    fn timestamp(&self, stamp_ns: u64) -> Option<prost_types::Timestamp> {
        Some(self.encoder.timestamp(stamp_ns))
    }
}

fn facts_entry<const N: usize>(name: &'static str, entries: [(&str, String); N]) -> Entry {
    let entries: BTreeMap<_, _> = entries.into_iter().map(|(key, value)| (key.to_owned(), value)).collect();
    Entry::Facts { name, entries }
}

fn origin_entry(Geodetic { latitude_deg, longitude_deg, altitude_m }: Geodetic) -> Entry {
    let entries = [
        ("latitude_deg", latitude_deg.to_string()),
        ("longitude_deg", longitude_deg.to_string()),
        ("altitude_m", altitude_m.to_string()),
    ];
    facts_entry(metadata::ORIGIN, entries)
}
