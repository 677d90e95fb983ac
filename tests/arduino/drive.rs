//! Sketch and sensor in step, and what our decoder makes of the lines that come out.

use omniloc::{
    devices::SerialChunk,
    gnss::{
        DecoderCounters, DecoderSettings, GnssDecoder, Protocol,
        encode::Measurement,
        framing::{Framed, Framer},
    },
    types::{Fix, Geodetic, GnssSample, Heading, LocalFrame, North, TimeScale, wrap_angle_rad},
};

use crate::{
    mti::{Mti, TICK_MS},
    rig::Rig,
};

/// 2026-11-22 23:59:57: a midnight is in every drive.
pub const START_UTC_NS: i64 = 1_795_391_997_000_000_000;
pub const NS_PER_TICK: i64 = 10_000_000;

/// A drive at 3 m/s north-east through the corner of a degree, turning by half a degree a tick.
pub fn truth(tick: u64) -> Measurement {
    let way_deg = tick as f64 * 2.7e-7;
    Measurement {
        utc_ns: START_UTC_NS + tick as i64 * NS_PER_TICK,
        position: Some(Geodetic {
            latitude_deg: -0.000_05 + way_deg,
            longitude_deg: 7.999_95 + way_deg,
            altitude_m: 455.2 - tick as f64 * 0.01,
        }),
        position_std_m: [0.9, 0.9, 2.5],
        velocity_mps: [2.1, 2.1, 0.0],
        roll_rad: 0.02,
        pitch_rad: -0.01,
        yaw_rad: wrap_angle_rad(tick as f64 * 0.5_f64.to_radians()),
        yaw_std_rad: 0.01,
        satellites: 9,
        horizontal_dilution: 0.9,
    }
}

pub fn without_satellites(tick: u64) -> Measurement {
    Measurement { position: None, ..truth(tick) }
}

/// Sketch and sensor, and what the sketch has sent to the computer.
pub struct Drive {
    pub rig: Rig,
    pub sensor: Mti,
    pub to_sensor: Vec<u8>,
    pub received: Vec<u8>,
    pub tick: u64,
}

impl Drive {
    /// The board is on, the sensor comes a moment later.
    pub fn new(mut rig: Rig, sensor: Mti) -> Self {
        let sent = rig.run(20, &[]);
        Self { rig, sensor, to_sensor: sent.to_sensor, received: sent.to_computer, tick: 0 }
    }

    pub fn ticks(&mut self, count: u64, truth: impl Fn(u64) -> Measurement) {
        for _ in 0..count {
            let said = self.sensor.tick(&self.to_sensor, &truth(self.tick));
            self.send(&said);
        }
    }

    /// A tick with other bytes than those of the sensor.
    pub fn send(&mut self, bytes: &[u8]) {
        let sent = self.rig.run(TICK_MS, bytes);
        self.received.extend(sent.to_computer);
        self.to_sensor = sent.to_sensor;
        self.tick += 1;
    }

    /// Ticks in which nothing comes from the sensor, and nothing gets to it.
    pub fn silence(&mut self, count: u64) {
        (0..count).for_each(|_| self.send(&[]));
        self.to_sensor.clear();
    }

    pub fn take(&mut self) -> Said {
        Said::new(&std::mem::take(&mut self.received))
    }
}

/// What the decoder makes of lines, and what the heartbeats say.
pub struct Said {
    pub fixes: Vec<Fix>,
    pub headings: Vec<Heading>,
    pub no_fixes: usize,
    pub rejected: Vec<&'static str>,
    pub counters: DecoderCounters,
    pub health: Vec<Vec<String>>,
    pub errors: Vec<Vec<String>>,
}

/// Fields of `$POMNH` and `$POMNE`.
pub const STATE: usize = 3;
pub const PULSES: usize = 8;
pub const PULSE_INTERVAL: usize = 9;
pub const COUNTERS: [&str; 9] =
    ["wrong sums", "skipped", "overruns", "framing", "dropped", "missed", "refused", "losses", "peak"];

impl Said {
    pub fn new(bytes: &[u8]) -> Self {
        Self::of_chunks(&[SerialChunk { arrival_ns: 10_000_000_000, baud: 115_200, bytes: bytes.to_vec() }])
    }

    pub fn of_chunks(chunks: &[SerialChunk]) -> Self {
        let mut decoder = GnssDecoder::new(&DecoderSettings::default());
        let mut samples = Vec::new();
        chunks.iter().for_each(|chunk| decoder.push(chunk, &mut samples));
        let mut said = Self {
            fixes: Vec::new(),
            headings: Vec::new(),
            no_fixes: 0,
            rejected: Vec::new(),
            counters: decoder.counters(),
            health: Vec::new(),
            errors: Vec::new(),
        };
        for sample in samples {
            match sample {
                GnssSample::Fix(fix) => said.fixes.push(fix),
                GnssSample::Heading(heading) => said.headings.push(heading),
                GnssSample::NoFix { .. } => said.no_fixes += 1,
                GnssSample::Rejected { reason, .. } => said.rejected.push(reason),
                GnssSample::Time { .. } => {}
            }
        }
        let mut framer = Framer::new(Protocol::Nmea);
        for &byte in chunks.iter().flat_map(|chunk| &chunk.bytes) {
            framer.push(byte, &mut |framed, _| {
                let Framed::Sentence(content) = framed else { return };
                assert!(content.len() + 5 <= 82, "longer than NMEA 0183 allows: {content}");
                let fields: Vec<String> = content.split(',').map(str::to_owned).collect();
                match fields[0].as_str() {
                    "POMNH" => said.health.push(fields),
                    "POMNE" => said.errors.push(fields),
                    _ => {}
                }
            });
        }
        said
    }

    pub fn states(&self) -> String {
        self.health.iter().map(|fields| fields[STATE].as_str()).collect()
    }

    /// One of [`COUNTERS`] in the last heartbeat.
    pub fn count(&self, name: &str) -> u64 {
        let at = COUNTERS.iter().position(|&counter| counter == name).expect("a counter");
        self.errors.last().expect("a heartbeat")[2 + at].parse().expect("a number")
    }

    pub fn assert_no_losses(&self) {
        assert_eq!(self.counters.lost(), 0, "{:?} {:?}", self.counters, self.rejected);
        for counter in COUNTERS.iter().filter(|&&name| name != "peak") {
            assert_eq!(self.count(counter), 0, "{counter}");
        }
    }

    /// Ticks of the headings and of the fixes, each compared with what was true then.
    pub fn ticks(&self, truth: impl Fn(u64) -> Measurement) -> (Vec<u64>, Vec<u64>) {
        let tick = |ns: i64| ((ns - START_UTC_NS) / NS_PER_TICK) as u64;
        let headings = self.headings.iter().map(|heading| {
            let time = heading.sample_time.expect("a time");
            let measured = truth(tick(time.ns));
            assert_eq!((time.ns, time.scale), (measured.utc_ns, TimeScale::Utc));
            let error_rad = wrap_angle_rad(heading.yaw_rad - measured.yaw_rad);
            assert!(error_rad.abs() < YAW_ERROR_DEG.to_radians(), "{heading:?} {measured:?}");
            assert_eq!(heading.north, North::True);
            tick(time.ns)
        });
        let fixes = self.fixes.iter().map(|fix| {
            let time = fix.sample_time.expect("a time");
            let measured = truth(tick(time.ns));
            assert_eq!((time.ns, time.scale), (measured.utc_ns, TimeScale::Utc));
            let error_m = distance_m(fix.position, measured.position.expect("a position"));
            assert!(error_m < POSITION_ERROR_M, "{error_m} m: {fix:?} {measured:?}");
            tick(time.ns)
        });
        (headings.collect(), fixes.collect())
    }
}

/// Half of the last digit, and what a 32-bit float holds of 180 degrees.
pub const YAW_ERROR_DEG: f64 = 0.000_5 + 0.000_01;

/// Half of the last digits of latitude and longitude are 1 mm each, of the height 5 mm.
pub const POSITION_ERROR_M: f64 = 0.006;

pub fn distance_m(a: Geodetic, b: Geodetic) -> f64 {
    LocalFrame::new(a).to_enu_m(b).iter().map(|d| d * d).sum::<f64>().sqrt()
}
