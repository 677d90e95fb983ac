//! Samples and frames in, pairs out.

use std::collections::VecDeque;

use libm::{cos, hypot, sin};

use super::{
    InvalidReason, LatencyEstimate, LatencySource, Pair, Settings,
    clock_map::Verdict,
    interpolate::{Waypoint, interpolate, interpolate_yaw_rad},
    latency::Latency,
    receiver_clocks::{ClockKind, ReceiverClocks},
    timeline::{Placed, Timeline},
};
use crate::types::{
    Fix, FixQuality, Geodetic, GnssSample, Heading, LocalFrame, NS_PER_S, North, SampleTime, distance_m,
};

/// Frames that may wait for their fixes: 30 s at 120 Hz.
const FRAMES_WAITING: usize = 3600;
/// Samples held back while it shows whether the receiver's clock was set.
const SAMPLES_HELD: usize = 512;
/// A line that stalls hands over samples of up to this age; what is older, or from the future, has a wrong time.
const MAX_AGE_NS: i64 = 10 * NS_PER_S as i64;
const MAX_LEAD_NS: i64 = 100_000_000;
/// After a position has come, its velocity may come in a sentence of its own.
const VELOCITY_WAIT_NS: u64 = 200_000_000;
/// The source of the yaw is changed when it has been silent for so long.
const YAW_SOURCE_SILENCE_NS: u64 = 2 * NS_PER_S;
/// A frame's stamp and a sample's own time are no better than this, whatever is known of the clocks: both are counted in
/// milliseconds, by a USB host or in a sentence \[s\].
const STAMP_STD_S: f64 = 0.001;
/// Below this speed a receiver without a course stands still \[m/s\].
const STANDING_MPS: f64 = 0.3;

/// Pairs frames with positions and yaws. It has no clock: it knows what it is told, in the order it is told.
#[derive(Debug)]
pub struct Synchronizer {
    settings: Settings,
    origin: Option<(Geodetic, LocalFrame)>,
    clocks: ReceiverClocks,
    latency: Latency,
    fixes: Timeline<PlacedFix>,
    yaws: Timeline<YawSample>,
    held: VecDeque<Held>,
    frames: VecDeque<Frame>,
    yaw_source: Option<YawSource>,
    /// Of the last fix that was too uncertain to begin with.
    refused_std_m: Option<f64>,
    now_ns: u64,
    statistics: Statistics,
}

/// What has happened so far.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Statistics {
    pub valid_pairs: u64,
    pub invalid_pairs: u64,
    /// Valid pairs that have a yaw.
    pub pairs_with_yaw: u64,
    /// Fixes that may not be used: simulated, or carried on without satellites and without a stated deviation.
    pub refused_fixes: u64,
    /// Samples whose time cannot be, or that came after all that is kept.
    pub misplaced_samples: u64,
    /// How often a clock of the receiver was set.
    pub clock_steps: u64,
    /// How often the latency changed for good, or the clock by so little that it cannot be told from that.
    pub latency_jumps: u64,
    /// Mean lateness of samples after the earliest possible \[s\].
    pub jitter_s: f64,
    /// Turns that the latency was found from.
    pub turns: usize,
    pub frames_waiting: usize,
    pub samples_kept: usize,
}

#[derive(Debug, Clone, Copy)]
struct Frame {
    sequence: u64,
    stamp_ns: u64,
    damage: Option<&'static str>,
}

#[derive(Debug, Clone, Copy)]
struct PlacedFix {
    arrival_ns: u64,
    clock: ClockKind,
    waypoint: Waypoint,
    std_m: Option<f64>,
}

#[derive(Debug, Clone, Copy)]
struct YawSample {
    yaw_rad: f64,
}

#[derive(Debug, Clone, Copy)]
enum Payload {
    Fix(PlacedFix),
    Yaw(YawSample),
    Nothing,
}

#[derive(Debug, Clone, Copy)]
struct Held {
    clock: ClockKind,
    ns: i64,
    arrival_ns: u64,
    payload: Payload,
}

#[derive(Debug, Clone, Copy)]
struct YawSource {
    name: &'static str,
    north: North,
    last_arrival_ns: u64,
}

impl Synchronizer {
    /// `origin`: where east = north = 0 lies; else the first good fix says so.
    ///
    /// # Errors
    /// As [`Settings::check`].
    pub fn new(settings: &Settings, origin: Option<Geodetic>) -> Result<Self, String> {
        settings.check()?;
        Ok(Self {
            settings: settings.clone(),
            origin: origin.map(|origin| (origin, LocalFrame::new(origin))),
            clocks: ReceiverClocks::default(),
            latency: Latency::new(settings),
            fixes: Timeline::default(),
            yaws: Timeline::default(),
            held: VecDeque::new(),
            frames: VecDeque::new(),
            yaw_source: None,
            refused_std_m: None,
            now_ns: 0,
            statistics: Statistics::default(),
        })
    }

    /// Takes in what the receiver said.
    pub fn push_sample(&mut self, sample: &GnssSample) {
        match sample {
            GnssSample::Fix(fix) => {
                let payload = self.accept_fix(fix).map_or(Payload::Nothing, Payload::Fix);
                self.take_in(fix.arrival_ns, fix.sample_time, payload);
            }
            GnssSample::Heading(heading) => {
                let payload = self.accept_heading(heading).map_or(Payload::Nothing, Payload::Yaw);
                self.take_in(heading.arrival_ns, heading.sample_time, payload);
            }
            GnssSample::Time { arrival_ns, sample_time } => {
                self.take_in(*arrival_ns, Some(*sample_time), Payload::Nothing);
            }
            GnssSample::NoFix { arrival_ns, sample_time } => {
                self.take_in(*arrival_ns, *sample_time, Payload::Nothing);
            }
            GnssSample::Rejected { .. } => {}
        }
    }

    /// An edge of the receiver's pulse, which starts a UTC second.
    pub fn push_pps(&mut self, stamp_ns: u64) {
        self.latency.pulses.push(stamp_ns);
    }

    /// The vehicle turned by this much, counter-clockwise, between two frames, as the camera saw it.
    pub fn push_visual_rotation(&mut self, from_ns: u64, to_ns: u64, rotation_rad: f64) {
        self.latency.push_rotation(from_ns, to_ns, rotation_rad);
    }

    /// A frame to be paired; `damage` is why it may not be used.
    pub fn push_frame(&mut self, sequence: u64, stamp_ns: u64, damage: Option<&'static str>) {
        self.frames.push_back(Frame { sequence, stamp_ns, damage });
    }

    /// Decides the frames that can be decided at `now_ns`, in the order they came.
    pub fn poll(&mut self, now_ns: u64, out: &mut Vec<Pair>) {
        self.now_ns = self.now_ns.max(now_ns);
        self.measure_turns();
        let latency = self.latency();
        let max_wait_ns = (self.settings.max_wait_s * 1e9) as u64;
        while let Some(frame) = self.frames.front() {
            let last_call =
                self.now_ns >= frame.stamp_ns.saturating_add(max_wait_ns) || self.frames.len() > FRAMES_WAITING;
            let Some(pair) = self.decide(*frame, latency, last_call) else { return };
            self.frames.pop_front();
            self.count(&pair);
            out.push(pair);
        }
    }

    /// Decides all frames with what there is.
    pub fn finish(&mut self, out: &mut Vec<Pair>) {
        self.measure_turns();
        let latency = self.latency();
        while let Some(frame) = self.frames.pop_front() {
            if let Some(pair) = self.decide(frame, latency, true) {
                self.count(&pair);
                out.push(pair);
            }
        }
    }

    /// Where east = north = 0 lies, as soon as that is known.
    pub fn origin(&self) -> Option<Geodetic> {
        self.origin.map(|(origin, _)| origin)
    }

    /// The latency of the serial line as it is known now.
    pub fn latency(&self) -> LatencyEstimate {
        self.latency.estimate(self.now_ns, self.clocks.utc_offset_ns(self.now_ns))
    }

    /// When a sample was taken, on the monotonic clock: the stamp of what is recorded of it.
    pub fn stamp_ns(&self, arrival_ns: u64, sample_time: Option<SampleTime>) -> u64 {
        let latency_ns = (self.latency().latency_s * 1e9) as i64;
        let placed = sample_time.and_then(|time| self.clocks.peek(time, arrival_ns));
        let instant = placed.unwrap_or_else(|| self.clocks.instant_of_arrival(arrival_ns));
        let zero_latency_ns = self.clocks.zero_latency_ns(instant).unwrap_or(arrival_ns as i64);
        let plausible = (arrival_ns as i64).saturating_sub(zero_latency_ns);
        let zero_latency_ns =
            if (-MAX_LEAD_NS..=MAX_AGE_NS).contains(&plausible) { zero_latency_ns } else { arrival_ns as i64 };
        zero_latency_ns.saturating_sub(latency_ns).max(0) as u64
    }

    /// UTC at an instant of the monotonic clock \[ns since 1970\], and its standard deviation \[s\].
    pub fn utc_at(&self, monotonic_ns: u64) -> Option<(i64, f64)> {
        let offset_ns = self.clocks.utc_offset_ns(monotonic_ns).filter(|_| self.clocks.is_dated())?;
        let latency = self.latency();
        let latency_ns = (latency.latency_s * 1e9).round() as i64;
        let utc_ns = (monotonic_ns as i64).saturating_add(latency_ns).saturating_sub(offset_ns);
        Some((utc_ns, self.time_std_s(latency, ClockKind::Utc)))
    }

    pub fn statistics(&self) -> Statistics {
        Statistics {
            clock_steps: self.clocks.steps(),
            latency_jumps: self.clocks.jumps(),
            jitter_s: self.clocks.mean_excess_s(),
            turns: self.latency.turns(),
            frames_waiting: self.frames.len(),
            samples_kept: self.fixes.len() + self.yaws.len() + self.held.len(),
            ..self.statistics
        }
    }

    /// One standard deviation of the monotonic time of samples on a clock. A pulse shows the offset of UTC by itself,
    /// whatever the envelope; anything else is counted from the envelope.
    fn time_std_s(&self, latency: LatencyEstimate, clock: ClockKind) -> f64 {
        match (latency.source, clock) {
            (LatencySource::Pulse, ClockKind::Utc) => latency.std_s,
            (LatencySource::Pulse, _) => {
                hypot(hypot(latency.std_s, self.clocks.std_s(clock)), self.clocks.std_s(ClockKind::Utc))
            }
            _ => hypot(latency.std_s, self.clocks.std_s(clock)),
        }
    }

    fn accept_fix(&mut self, fix: &Fix) -> Option<PlacedFix> {
        let std_m = horizontal_std_m(fix).filter(|std_m| std_m.is_finite());
        let carried_on = fix.quality == FixQuality::DeadReckoning && fix.position_std_m.is_none();
        if fix.quality == FixQuality::Simulated || carried_on || !fix.position.is_plausible() {
            self.statistics.refused_fixes += 1;
            return None;
        }
        let frame = match self.origin {
            Some((_, frame)) => frame,
            None if std_m.is_some_and(|std_m| std_m > self.settings.max_position_std_m) => {
                self.refused_std_m = std_m;
                return None;
            }
            None => {
                let frame = LocalFrame::new(fix.position);
                self.origin = Some((fix.position, frame));
                frame
            }
        };
        let [east_m, north_m, _] = frame.to_enu_m(fix.position);
        let velocity_mps = match (fix.speed_mps, fix.course_rad) {
            (Some(speed), Some(course)) => Some([speed * cos(course), speed * sin(course)]),
            (Some(speed), None) if speed < STANDING_MPS => Some([0.0, 0.0]),
            _ => None,
        };
        let waypoint = Waypoint { position_m: [east_m, north_m], velocity_mps };
        Some(PlacedFix { arrival_ns: fix.arrival_ns, clock: ClockKind::Arrival, waypoint, std_m })
    }

    /// Yaws of two sources are not mixed: true north goes before magnetic, then whoever was first.
    fn accept_heading(&mut self, heading: &Heading) -> Option<YawSample> {
        if !heading.yaw_rad.is_finite() {
            return None;
        }
        let silent_ns = |known: &YawSource| heading.arrival_ns.saturating_sub(known.last_arrival_ns);
        let better = |known: &YawSource| known.north == North::Magnetic && heading.north == North::True;
        let own = |known: &YawSource| known.name == heading.source && known.north == heading.north;
        let takes_over = |known: &YawSource| own(known) || better(known) || silent_ns(known) > YAW_SOURCE_SILENCE_NS;
        if !self.yaw_source.as_ref().is_none_or(takes_over) {
            return None;
        }
        self.yaw_source =
            Some(YawSource { name: heading.source, north: heading.north, last_arrival_ns: heading.arrival_ns });
        // Declination is counted clockwise, yaw counter-clockwise.
        let declination_rad = match heading.north {
            North::True => 0.0,
            North::Magnetic => self.settings.magnetic_declination_deg.to_radians(),
        };
        Some(YawSample { yaw_rad: heading.yaw_rad - declination_rad })
    }

    fn take_in(&mut self, arrival_ns: u64, sample_time: Option<SampleTime>, payload: Payload) {
        self.now_ns = self.now_ns.max(arrival_ns);
        let Some(time) = sample_time else {
            let instant = self.clocks.instant_of_arrival(arrival_ns);
            self.place(ClockKind::Arrival, instant.ns, arrival_ns, payload);
            return;
        };
        let jumps = self.clocks.jumps();
        let (clock, ns, verdict) = self.clocks.push(time, arrival_ns);
        if self.clocks.jumps() != jumps {
            self.latency.forget_turns();
        }
        if verdict == Verdict::Undecided {
            if self.held.len() == SAMPLES_HELD {
                self.held.pop_front();
                self.statistics.misplaced_samples += 1;
            }
            self.held.push_back(Held { clock, ns, arrival_ns, payload });
            return;
        }
        for _ in 0..self.held.len() {
            match self.held.pop_front() {
                Some(held) if held.clock == clock => self.place(clock, held.ns, held.arrival_ns, held.payload),
                Some(other) => self.held.push_back(other),
                None => {}
            }
        }
        self.place(clock, ns, arrival_ns, payload);
    }

    fn place(&mut self, clock: ClockKind, ns: i64, arrival_ns: u64, payload: Payload) {
        let instant = self.clocks.instant(clock, ns);
        let age_ns = self.clocks.zero_latency_ns(instant).map(|ns| (arrival_ns as i64).saturating_sub(ns));
        if !age_ns.is_some_and(|age_ns| (-MAX_LEAD_NS..=MAX_AGE_NS).contains(&age_ns)) {
            self.statistics.misplaced_samples += 1;
            return;
        }
        match payload {
            Payload::Fix(fix) => {
                self.fixes.insert(&self.clocks, instant, PlacedFix { clock, ..fix }, |there, new| {
                    there.waypoint.velocity_mps = there.waypoint.velocity_mps.or(new.waypoint.velocity_mps);
                    there.std_m = there.std_m.or(new.std_m);
                });
            }
            Payload::Yaw(yaw) => {
                self.yaws.insert(&self.clocks, instant, yaw, |_, _| {});
            }
            Payload::Nothing => {}
        }
    }

    fn measure_turns(&mut self) {
        let Some(newest_ns) = self.yaws.newest_ns(&self.clocks) else { return };
        while self.latency.wants_yaw(newest_ns) {
            self.latency.compare_with_yaw(self.yaws.placed(&self.clocks).map(|(ns, yaw)| (ns, yaw.yaw_rad)));
        }
    }

    /// The pair of a frame; `None` while what belongs to it may still come, unless this is the `last_call`.
    fn decide(&self, frame: Frame, latency: LatencyEstimate, last_call: bool) -> Option<Pair> {
        let latency_ns = (latency.latency_s * 1e9).round() as i64;
        let exposed_ns = (frame.stamp_ns as i64).saturating_add(latency_ns);
        let (before, after) = self.fixes.around(&self.clocks, exposed_ns);
        let (yaw_before, yaw_after) = self.yaws.around(&self.clocks, exposed_ns);
        if !last_call && !self.is_complete(before, after, yaw_before, yaw_after, exposed_ns) {
            return None;
        }
        let mut pair = Pair {
            sequence: frame.sequence,
            stamp_ns: frame.stamp_ns,
            position_m: None,
            yaw_rad: None,
            position_std_m: None,
            interpolation_gap_s: None,
            interpolation_gap_m: None,
            serial_latency_s: latency.latency_s,
            serial_latency_m: None,
            time_std_s: hypot(
                self.time_std_s(latency, before.map_or(ClockKind::Arrival, |(_, fix)| fix.clock)),
                STAMP_STD_S,
            ),
            invalid: None,
        };
        pair.invalid = match (before, after) {
            (Some(before), Some(after)) => self.fill_position(&mut pair, before, after, exposed_ns),
            (None, _) => match self.refused_std_m {
                Some(std_m) if self.origin.is_none() => Some(InvalidReason::Uncertain { std_m }),
                _ => Some(InvalidReason::NoPositionYet),
            },
            (Some(_), None) => Some(InvalidReason::NoFixAfter { waited_s: self.settings.max_wait_s }),
        };
        if let (Some((before_ns, before)), Some((after_ns, after))) = (yaw_before, yaw_after) {
            let gap_s = seconds(after_ns, before_ns);
            if gap_s <= self.settings.max_heading_gap_s {
                let w = if gap_s > 0.0 { seconds(exposed_ns, before_ns) / gap_s } else { 0.0 };
                pair.yaw_rad = Some(interpolate_yaw_rad(before.yaw_rad, after.yaw_rad, w));
            }
        }
        if let Some(why) = frame.damage {
            pair.invalid = Some(InvalidReason::FrameDamaged(why));
        }
        Some(pair)
    }

    /// Whether nothing that would change the pair is still to come.
    fn is_complete(
        &self,
        before: Option<Placed<'_, PlacedFix>>,
        after: Option<Placed<'_, PlacedFix>>,
        yaw_before: Option<Placed<'_, YawSample>>,
        yaw_after: Option<Placed<'_, YawSample>>,
        exposed_ns: i64,
    ) -> bool {
        let Some((_, after)) = after else { return false };
        let states_velocity = before.is_some_and(|(_, before)| before.waypoint.velocity_mps.is_some());
        let velocity_may_come = states_velocity
            && after.waypoint.velocity_mps.is_none()
            && self.now_ns < after.arrival_ns.saturating_add(VELOCITY_WAIT_NS);
        let yaw_may_come = yaw_after.is_none()
            && yaw_before.is_some_and(|(ns, _)| seconds(exposed_ns, ns) <= self.settings.max_heading_gap_s);
        !velocity_may_come && !yaw_may_come
    }

    /// The position between two fixes, or why it may not be used.
    fn fill_position(
        &self,
        pair: &mut Pair,
        (before_ns, before): Placed<'_, PlacedFix>,
        (after_ns, after): Placed<'_, PlacedFix>,
        exposed_ns: i64,
    ) -> Option<InvalidReason> {
        let (gap_s, elapsed_s) = (seconds(after_ns, before_ns), seconds(exposed_ns, before_ns));
        let found = interpolate(&before.waypoint, &after.waypoint, elapsed_s, gap_s);
        pair.position_m = Some(found.position_m);
        pair.interpolation_gap_s = Some(gap_s);
        pair.interpolation_gap_m = Some(distance_m(before.waypoint.position_m, after.waypoint.position_m));
        pair.serial_latency_m = Some(found.speed_mps * pair.serial_latency_s);
        if let (Some(before_m), Some(after_m)) = (before.std_m, after.std_m) {
            // Errors of neighbouring fixes are alike, so that their mean is no better than they are. The error of the
            // time lies along the way: half of its variance goes to each axis.
            let w = if gap_s > 0.0 { elapsed_s / gap_s } else { 0.0 };
            let fix_m = (1.0 - w) * before_m + w * after_m;
            let along_m = found.speed_mps * pair.time_std_s / std::f64::consts::SQRT_2;
            pair.position_std_m = Some(hypot(hypot(fix_m, found.std_m), along_m));
        }
        if gap_s > self.settings.max_gap_s {
            return Some(InvalidReason::Gap { gap_s });
        }
        let too_uncertain = pair.position_std_m.filter(|&std_m| std_m > self.settings.max_position_std_m);
        too_uncertain.map(|std_m| InvalidReason::Uncertain { std_m })
    }

    fn count(&mut self, pair: &Pair) {
        match pair.invalid {
            None => self.statistics.valid_pairs += 1,
            Some(_) => self.statistics.invalid_pairs += 1,
        }
        if pair.invalid.is_none() && pair.yaw_rad.is_some() {
            self.statistics.pairs_with_yaw += 1;
        }
    }
}

fn seconds(to_ns: i64, from_ns: i64) -> f64 {
    to_ns.saturating_sub(from_ns) as f64 * 1e-9
}

/// One standard deviation of a fix, each horizontal axis: as stated; else from the dilution of precision.
fn horizontal_std_m(fix: &Fix) -> Option<f64> {
    if let Some([east_m, north_m, _]) = fix.position_std_m {
        return Some((east_m * east_m + north_m * north_m).sqrt() / std::f64::consts::SQRT_2);
    }
    // Error of one range \[m\]; the dilution is that of both horizontal axes together.
    let range_std_m = match fix.quality {
        FixQuality::Autonomous => 3.0,
        FixQuality::Differential => 1.0,
        FixQuality::RtkFloat => 0.2,
        FixQuality::RtkFixed => 0.02,
        FixQuality::DeadReckoning | FixQuality::Simulated => return None,
    };
    Some(fix.horizontal_dilution? * range_std_m / std::f64::consts::SQRT_2)
}
