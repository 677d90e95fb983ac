//! Counts what happens, and once a second says how things are.

use super::{
    survey::{Device, Tick},
    system::SystemStatus,
};
use crate::{
    gnss::DecoderCounters,
    recording::{
        proto::omniloc::Status,
        topics::{self, Topic},
    },
    sync::{LatencyEstimate, Pair},
    types::{Fix, NS_PER_S},
};

/// A camera or receiver that was heard within this time is well.
const HEARD_NS: u64 = 2 * NS_PER_S;

/// A device that is open and has said nothing for so long is silent rather than starting \[s\].
const START_S: u32 = 3;

/// One device: what its last failure was, and when it was last heard.
#[derive(Debug, Default)]
struct DeviceState {
    failure: Option<&'static str>,
    ended: bool,
    opened: u32,
    /// Seconds since it was opened for the first time, without a word from it.
    waited_s: u32,
    last_heard_ns: Option<u64>,
}

impl DeviceState {
    fn health(&self, now_ns: u64) -> &'static str {
        match (self.last_heard_ns, self.failure) {
            _ if self.ended => "stopped",
            (_, Some(failure)) => failure,
            (Some(heard_ns), None) if now_ns.saturating_sub(heard_ns) <= HEARD_NS => "ok",
            (Some(_), None) => "silent",
            (None, None) if self.waited_s > START_S => "silent",
            (None, None) => "waiting",
        }
    }

    /// A device that could be opened is there; whether it says something is another matter.
    fn open(&mut self) {
        self.opened += 1;
        self.failure = self.failure.filter(|failure| ["silent", "bad data"].contains(failure));
    }

    fn second(&mut self) {
        self.waited_s += u32::from(self.opened > 0 && self.last_heard_ns.is_none());
    }

    fn heard(&mut self, stamp_ns: u64) {
        self.last_heard_ns = Some(stamp_ns);
        self.failure = None;
    }
}

/// Counts of the second that is running, and the totals.
#[derive(Debug, Default)]
pub struct StatusCounter {
    camera: DeviceState,
    gnss: DeviceState,
    status: Status,
    frames_this_second: u32,
    fixes_this_second: u32,
    headings_this_second: u32,
    /// Bytes came that say something, but no fix: the receiver is well and sees no satellites.
    searching: bool,
    /// When bytes came last, whatever they say.
    last_bytes_ns: Option<u64>,
    /// When something whole came that cannot be believed.
    last_rejected_ns: Option<u64>,
    last_second_ns: u64,
    newest_ns: u64,
}

impl StatusCounter {
    pub fn last(&self) -> &Status {
        &self.status
    }

    pub fn have_ended(&self) -> bool {
        self.camera.ended && self.gnss.ended
    }

    pub fn camera_opened(&mut self) {
        self.camera.open();
    }

    pub fn gnss_opened(&mut self) {
        self.gnss.open();
    }

    pub fn device(&mut self, device: Device, health: Option<&'static str>) {
        let state = match device {
            Device::Camera => &mut self.camera,
            Device::Gnss => &mut self.gnss,
            Device::Gpio => return,
        };
        state.ended = health.is_none();
        state.failure = health;
    }

    pub fn frame(&mut self, stamp_ns: u64, damaged: bool) {
        self.newest_ns = self.newest_ns.max(stamp_ns);
        self.camera.heard(stamp_ns);
        self.status.frames += 1;
        self.frames_this_second += 1;
        self.status.frames_damaged += u64::from(damaged);
    }

    pub fn lost(&mut self, topic: &Topic, count: u64) {
        if topic.name == topics::CAMERA_IMAGE.name {
            self.status.frames_dropped += count;
        }
    }

    pub fn bytes(&mut self, arrival_ns: u64, count: usize) {
        self.newest_ns = self.newest_ns.max(arrival_ns);
        self.last_bytes_ns = Some(arrival_ns);
        self.status.serial_bytes += count as u64;
    }

    pub fn fix(&mut self, fix: &Fix) {
        self.newest_ns = self.newest_ns.max(fix.arrival_ns);
        self.gnss.heard(fix.arrival_ns);
        self.searching = false;
        self.fixes_this_second += 1;
        self.status.speed_mps = fix.speed_mps;
        self.status.position_std_m = fix.position_std_m.map(|[east_m, north_m, _]| east_m.max(north_m));
    }

    pub fn no_fix(&mut self, arrival_ns: u64) {
        self.gnss.heard(arrival_ns);
        self.searching = true;
    }

    pub fn rejected(&mut self, arrival_ns: u64) {
        self.last_rejected_ns = Some(arrival_ns);
    }

    pub fn heading(&mut self) {
        self.headings_this_second += 1;
    }

    pub fn pair(&mut self, pair: &Pair, now_ns: Option<u64>) {
        if pair.invalid.is_some() {
            self.status.pairs_invalid += 1;
        } else {
            self.status.pairs += 1;
        }
        self.status.pair_lag_s = now_ns.map(|now_ns| now_ns.saturating_sub(pair.stamp_ns) as f64 * 1e-9);
    }

    /// The instant of a tick; a replay without clocks goes by the newest stamp.
    pub fn now_ns(&self, tick: &Tick) -> u64 {
        tick.clocks.map_or(self.newest_ns, |clocks| clocks.monotonic_ns)
    }

    fn gnss_health(&self, now_ns: u64) -> &'static str {
        let is_recent = |last_ns: Option<u64>| last_ns.is_some_and(|last_ns| last_ns + HEARD_NS >= now_ns);
        match self.gnss.health(now_ns) {
            "ok" if self.searching => "no fix",
            "silent" | "waiting" | "bad data" if is_recent(self.last_rejected_ns) => "implausible",
            "silent" | "waiting" | "bad data" if is_recent(self.last_bytes_ns) => "unreadable",
            health => health,
        }
    }

    /// Closes the second.
    pub fn second(&mut self, tick: &Tick, latency: LatencyEstimate, serial: &DecoderCounters) -> &Status {
        let now_ns = self.now_ns(tick);
        self.camera.second();
        self.gnss.second();
        let span_s = now_ns.saturating_sub(self.last_second_ns) as f64 * 1e-9;
        let per_second = |count: &mut u32| if span_s > 0.0 { f64::from(std::mem::take(count)) / span_s } else { 0.0 };
        let SystemStatus { cpu_cores, resident_bytes, temperature_celsius, throttled } = tick.system;
        let gnss_health = self.gnss_health(now_ns);
        self.status = Status {
            camera_health: self.camera.health(now_ns).into(),
            gnss_health: gnss_health.into(),
            disk_health: tick.recorder.disk.into(),
            camera_fps: per_second(&mut self.frames_this_second),
            camera_restarts: self.camera.opened.saturating_sub(1),
            fix_hz: per_second(&mut self.fixes_this_second),
            heading_hz: per_second(&mut self.headings_this_second),
            gnss_restarts: self.gnss.opened.saturating_sub(1),
            serial_latency_s: Some(latency.latency_s),
            queue_bytes: tick.recorder.queue_bytes,
            queue_capacity_bytes: tick.recorder.queue_capacity_bytes,
            disk_stall_s: tick.recorder.disk_stall_s,
            disk_free_bytes: tick.recorder.disk_free_bytes,
            disk_free_percent: tick.recorder.disk_free_percent,
            written_bytes: tick.recorder.written_bytes,
            segment: tick.recorder.segment.clone(),
            unsynced_s: tick.recorder.unsynced_s,
            cpu_cores,
            resident_bytes,
            temperature_celsius,
            throttled,
            ..self.status.clone()
        };
        self.status.serial_rejected = serial.lost();
        self.last_second_ns = now_ns;
        &self.status
    }
}
