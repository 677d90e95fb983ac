//! A drive whose truth is known, and what a receiver, a pulse and a camera say of it.

use std::f64::consts::{FRAC_PI_2, TAU};

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::super::{Pair, Settings, Synchronizer};
use crate::{
    train::perturbation::standard_normal,
    types::{
        Fix, FixQuality, Geodetic, GnssSample, Heading, LocalFrame, NS_PER_S, North, PositionM, SampleTime, TimeScale,
        wrap_angle_rad,
    },
};

pub const ORIGIN: Geodetic = Geodetic { latitude_deg: 40.82, longitude_deg: -73.9, altitude_m: 30.0 };
/// Monotonic time of the start of the drive.
pub const START_NS: u64 = 1_000 * NS_PER_S + 123_456_789;
/// UTC of that moment, 20 s before midnight.
pub const START_UTC_NS: i64 = 1_760_054_380_250_000_000;
const DAY_NS: i64 = 86_400 * NS_PER_S as i64;

/// Where the vehicle truly is: around a block with rounded corners, stopping once a minute.
#[derive(Debug, Clone, Copy)]
pub struct Truth {
    pub position_m: PositionM,
    pub yaw_rad: f64,
    pub speed_mps: f64,
}

const SIDE_M: f64 = 60.0;
const CORNER_M: f64 = 18.0;
const PERIOD_S: f64 = 60.0;
const STEPS: usize = 6000;

pub struct Way {
    /// Way driven in a period, every 10 ms.
    driven_m: Vec<f64>,
}

impl Way {
    fn new() -> Self {
        let mut driven_m = vec![0.0];
        for step in 0..STEPS {
            let middle_s = (step as f64 + 0.5) * PERIOD_S / STEPS as f64;
            driven_m.push(driven_m[step] + Self::speed_mps(middle_s) * PERIOD_S / STEPS as f64);
        }
        Self { driven_m }
    }

    /// 5.5 to 8.5 m/s; slows down, stands for 6 s and goes on once a period.
    fn speed_mps(time_s: f64) -> f64 {
        let in_period_s = time_s.rem_euclid(PERIOD_S);
        let from_stop_s = ((in_period_s - 40.0).abs() - 3.0).clamp(0.0, 4.0);
        let going = 0.5 - 0.5 * (from_stop_s / 4.0 * TAU / 2.0).cos();
        going * (7.0 + 1.5 * (TAU * time_s / 30.0).sin())
    }

    pub fn at(&self, time_s: f64) -> Truth {
        let place = time_s.rem_euclid(PERIOD_S) / PERIOD_S * STEPS as f64;
        let index = (place as usize).min(STEPS - 1);
        let within = self.driven_m[index] + (place - index as f64) * (self.driven_m[index + 1] - self.driven_m[index]);
        let driven_m = (time_s / PERIOD_S).floor() * self.driven_m[STEPS] + within;

        let quarter_m = SIDE_M + CORNER_M * FRAC_PI_2;
        let corner = (driven_m / quarter_m).floor();
        let in_quarter_m = driven_m - corner * quarter_m;
        let direction_rad = corner.rem_euclid(4.0) * FRAC_PI_2;
        let turned_rad = ((in_quarter_m - SIDE_M) / CORNER_M).max(0.0);
        // One quarter from its own start, heading east.
        let [x, y] = [in_quarter_m.min(SIDE_M) + CORNER_M * turned_rad.sin(), CORNER_M * (1.0 - turned_rad.cos())];
        let mut start_m = [0.0, 0.0];
        for quarter in 0..corner.rem_euclid(4.0) as usize {
            let (sin, cos) = (quarter as f64 * FRAC_PI_2).sin_cos();
            let [dx, dy] = [SIDE_M + CORNER_M, CORNER_M];
            start_m = [start_m[0] + cos * dx - sin * dy, start_m[1] + sin * dx + cos * dy];
        }
        let (sin, cos) = direction_rad.sin_cos();
        Truth {
            position_m: [start_m[0] + cos * x - sin * y, start_m[1] + sin * x + cos * y],
            yaw_rad: wrap_angle_rad(direction_rad + turned_rad),
            speed_mps: Self::speed_mps(time_s),
        }
    }
}

/// What is said, and when on the monotonic clock.
#[derive(Debug, Clone)]
pub enum Event {
    Sample(GnssSample),
    Frame { sequence: u64, stamp_ns: u64 },
    Pulse { stamp_ns: u64 },
    Rotation { from_ns: u64, to_ns: u64, rotation_rad: f64 },
}

/// How the drive is observed.
#[derive(Debug, Clone)]
pub struct Observers {
    pub scale: Option<TimeScale>,
    pub fix_hz: f64,
    pub yaw_hz: f64,
    pub frame_hz: f64,
    pub latency_s: f64,
    /// Mean of the exponential jitter; the line keeps the order.
    pub jitter_s: f64,
    /// Receiver's clock against the monotonic clock.
    pub drift: f64,
    /// One standard deviation of a fix, each axis, and for how long errors are alike.
    pub position_std_m: f64,
    pub velocities: bool,
    pub pulse: bool,
    pub rotations: bool,
}

impl Default for Observers {
    fn default() -> Self {
        Self {
            scale: Some(TimeScale::Utc),
            fix_hz: 4.0,
            yaw_hz: 100.0,
            frame_hz: 15.0,
            latency_s: 0.3,
            jitter_s: 0.04,
            drift: 30e-6,
            position_std_m: 0.0,
            velocities: false,
            pulse: false,
            rotations: false,
        }
    }
}

const NOISE_CORRELATION_S: f64 = 3.0;
const YAW_STD_RAD: f64 = 0.005;
/// Of the camera's direction in one frame, and how much of a turn it sees.
const CAMERA_STD_RAD: f64 = 0.003;
const CAMERA_GAIN: f64 = 0.97;

pub struct Drive {
    pub way: Way,
    pub observers: Observers,
    rng: ChaCha8Rng,
    frame: LocalFrame,
    error_m: [f64; 2],
    line_free_ns: u64,
    burst_until_s: f64,
    last_camera: Option<(u64, f64)>,
    frames: u64,
}

impl Drive {
    pub fn new(observers: Observers, seed: u64) -> Self {
        Self {
            way: Way::new(),
            observers,
            rng: ChaCha8Rng::seed_from_u64(seed),
            frame: LocalFrame::new(ORIGIN),
            error_m: [0.0; 2],
            line_free_ns: 0,
            burst_until_s: f64::NEG_INFINITY,
            last_camera: None,
            frames: 0,
        }
    }

    /// Truth at an instant of the monotonic clock.
    pub fn truth_at(&self, monotonic_ns: u64) -> Truth {
        self.way.at((monotonic_ns as i64 - START_NS as i64) as f64 * 1e-9)
    }

    /// When the drive is `time_s` old.
    pub fn monotonic_ns(time_s: f64) -> u64 {
        START_NS + (time_s * 1e9).round() as u64
    }

    /// The receiver's clock when the drive is `time_s` old.
    pub fn receiver_ns(&self, time_s: f64, scale: TimeScale) -> i64 {
        let since_ns = (time_s * 1e9 * (1.0 - self.observers.drift)).round() as i64;
        match scale {
            TimeScale::Utc => START_UTC_NS + since_ns,
            TimeScale::UtcOfDay => (START_UTC_NS + since_ns) - START_UTC_NS / DAY_NS * DAY_NS,
            TimeScale::Device => 7_000_000_000 + since_ns,
        }
    }

    /// What is said of the drive from one second to another, in the order of its coming.
    pub fn events(&mut self, from_s: f64, to_s: f64) -> Vec<(u64, Event)> {
        let mut events = Vec::new();
        let ticks = |hz: f64| ((from_s * hz).ceil() as u64..(to_s * hz).ceil() as u64).map(move |i| i as f64 / hz);
        let mut samples: Vec<(f64, bool)> = ticks(self.observers.fix_hz).map(|t| (t, true)).collect();
        samples.extend(ticks(self.observers.yaw_hz).map(|t| (t, false)));
        samples.sort_by(|a, b| a.0.total_cmp(&b.0));
        for (time_s, is_fix) in samples {
            let arrival_ns = self.arrival_ns(time_s);
            let sample = if is_fix { self.fix(time_s, arrival_ns) } else { self.heading(time_s, arrival_ns) };
            events.push((arrival_ns, Event::Sample(sample)));
        }
        for time_s in ticks(self.observers.frame_hz) {
            self.see(time_s + 0.0123, &mut events);
        }
        if self.observers.pulse {
            self.pulses(from_s, to_s, &mut events);
        }
        events.sort_by_key(|event| event.0);
        events
    }

    /// Through the line, which keeps the order and sometimes is busy for a while.
    fn arrival_ns(&mut self, time_s: f64) -> u64 {
        if self.rng.random_bool(0.001) {
            self.burst_until_s = time_s + self.rng.random_range(0.1..0.6);
        }
        let jitter_s = -self.observers.jitter_s * (1.0 - self.rng.random::<f64>()).ln();
        let burst_s = (self.burst_until_s - time_s).max(0.0);
        let arrival_ns = Self::monotonic_ns(time_s + self.observers.latency_s + jitter_s.max(burst_s));
        self.line_free_ns = self.line_free_ns.max(arrival_ns);
        self.line_free_ns
    }

    fn sample_time(&self, time_s: f64) -> Option<SampleTime> {
        self.observers.scale.map(|scale| SampleTime { ns: self.receiver_ns(time_s, scale), scale })
    }

    fn fix(&mut self, time_s: f64, arrival_ns: u64) -> GnssSample {
        let std_m = self.observers.position_std_m;
        let keep = (-1.0 / self.observers.fix_hz / NOISE_CORRELATION_S).exp();
        let fresh = (1.0 - keep * keep).sqrt();
        self.error_m =
            self.error_m.map(|error| keep * error + fresh * std_m * f64::from(standard_normal(&mut self.rng)));
        let truth = self.way.at(time_s);
        let [east_m, north_m] = [0, 1].map(|i| truth.position_m[i] + self.error_m[i]);
        GnssSample::Fix(Fix {
            arrival_ns,
            sample_time: self.sample_time(time_s),
            position: self.frame.plane_to_geodetic([east_m, north_m]),
            position_std_m: Some([std_m, std_m, 2.0 * std_m]),
            quality: FixQuality::Autonomous,
            satellites: Some(9),
            horizontal_dilution: Some(1.0),
            speed_mps: self.observers.velocities.then_some(truth.speed_mps),
            course_rad: self.observers.velocities.then_some(truth.yaw_rad),
            source: "GGA",
        })
    }

    fn heading(&mut self, time_s: f64, arrival_ns: u64) -> GnssSample {
        let yaw_rad =
            wrap_angle_rad(self.way.at(time_s).yaw_rad + YAW_STD_RAD * f64::from(standard_normal(&mut self.rng)));
        GnssSample::Heading(Heading {
            arrival_ns,
            sample_time: self.sample_time(time_s),
            yaw_rad,
            yaw_std_rad: None,
            north: North::True,
            source: "HDT",
        })
    }

    fn see(&mut self, time_s: f64, events: &mut Vec<(u64, Event)>) {
        let stamp_ns = Self::monotonic_ns(time_s);
        self.frames += 1;
        let read_out_ns = stamp_ns + 40_000_000;
        events.push((read_out_ns, Event::Frame { sequence: self.frames, stamp_ns }));
        let seen_rad = self.way.at(time_s).yaw_rad;
        let noise_rad = CAMERA_STD_RAD * f64::from(standard_normal(&mut self.rng));
        if let Some((from_ns, last_rad)) = self.last_camera
            && self.observers.rotations
        {
            let last_noise_rad = last_rad - self.truth_at(from_ns).yaw_rad;
            let turned_rad = wrap_angle_rad(seen_rad - self.truth_at(from_ns).yaw_rad);
            let rotation_rad = CAMERA_GAIN * turned_rad + noise_rad - last_noise_rad;
            events.push((read_out_ns + 30_000_000, Event::Rotation { from_ns, to_ns: stamp_ns, rotation_rad }));
        }
        self.last_camera = Some((stamp_ns, seen_rad + noise_rad));
    }

    /// An edge a UTC second, one in ten missing, one in ten doubled by a spurious one.
    fn pulses(&mut self, from_s: f64, to_s: f64, events: &mut Vec<(u64, Event)>) {
        let utc_at = |time_s| self.receiver_ns(time_s, TimeScale::Utc) as f64 * 1e-9;
        let (first, last) = (utc_at(from_s).ceil() as i64, utc_at(to_s).floor() as i64);
        for second in first..=last {
            let since_ns = second * NS_PER_S as i64 - START_UTC_NS;
            let true_ns = START_NS as f64 + since_ns as f64 / (1.0 - self.observers.drift);
            let edge_ns = (true_ns + 20e3 * f64::from(standard_normal(&mut self.rng))) as u64;
            if self.rng.random_bool(0.9) {
                events.push((edge_ns, Event::Pulse { stamp_ns: edge_ns }));
            }
            if self.rng.random_bool(0.1) {
                let stamp_ns = edge_ns + self.rng.random_range(5_000_000..900_000_000);
                events.push((stamp_ns, Event::Pulse { stamp_ns }));
            }
        }
    }
}

pub fn synchronizer(settings: &Settings) -> Synchronizer {
    Synchronizer::new(settings, Some(ORIGIN)).expect("sound settings")
}

/// Tells the synchronizer all events and returns the pairs decided meanwhile.
pub fn play(synchronizer: &mut Synchronizer, events: &[(u64, Event)]) -> Vec<Pair> {
    let mut pairs = Vec::new();
    for (now_ns, event) in events {
        match event {
            Event::Sample(sample) => synchronizer.push_sample(sample),
            Event::Frame { sequence, stamp_ns } => synchronizer.push_frame(*sequence, *stamp_ns, None),
            Event::Pulse { stamp_ns } => synchronizer.push_pps(*stamp_ns),
            Event::Rotation { from_ns, to_ns, rotation_rad } => {
                synchronizer.push_visual_rotation(*from_ns, *to_ns, *rotation_rad);
            }
        }
        synchronizer.poll(*now_ns, &mut pairs);
    }
    pairs
}
