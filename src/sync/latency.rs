//! The constant part of the serial line's latency, which one-way data cannot show.

use super::{
    Settings,
    pulses::Pulses,
    yaw_lag::{LagEstimate, MAX_LAG_S, PIECE_S, Piece, YawLag, YawPoint},
};
use crate::types::NS_PER_S;
use std::collections::VecDeque;

/// Latencies are in 0..1 s: which second an edge starts follows from that. The envelope may lie this much too low.
const EDGE_SLACK_NS: i64 = 20_000_000;
/// Rotations kept: 24 s at 120 Hz.
const ROTATIONS: usize = 2880;

/// Where a latency comes from, the best first.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LatencySource {
    /// Edges of the receiver's pulse.
    Pulse,
    /// Turns that the camera saw.
    Visual,
    /// The settings.
    Configured,
}

impl LatencySource {
    /// The word for it in `/status`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Pulse => "pulse",
            Self::Visual => "visual",
            Self::Configured => "configured",
        }
    }
}

/// The smallest time from a sample to the arrival of its last byte.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LatencyEstimate {
    pub latency_s: f64,
    /// One standard deviation.
    pub std_s: f64,
    pub source: LatencySource,
}

/// All that can tell the latency.
#[derive(Debug, Clone)]
pub struct Latency {
    configured: LatencyEstimate,
    pub pulses: Pulses,
    visual: VisualLag,
}

impl Latency {
    pub fn new(settings: &Settings) -> Self {
        let configured = LatencyEstimate {
            latency_s: settings.serial_latency_s,
            std_s: settings.serial_latency_std_s,
            source: LatencySource::Configured,
        };
        Self { configured, pulses: Pulses::default(), visual: VisualLag::default() }
    }

    /// The camera turned by this much, counter-clockwise, between two frames.
    pub fn push_rotation(&mut self, from_ns: u64, to_ns: u64, rotation_rad: f64) {
        self.visual.push(from_ns, to_ns, rotation_rad);
    }

    /// Whether a piece of the camera's yaw waits to be compared with a yaw that has come up to `newest_yaw_ns`.
    pub fn wants_yaw(&self, newest_yaw_ns: i64) -> bool {
        self.visual.is_piece_complete(newest_yaw_ns)
    }

    /// The receiver's yaw in zero-latency time, for the piece that waits.
    pub fn compare_with_yaw(&mut self, yaw: impl Iterator<Item = (i64, f64)>) {
        self.visual.compare(yaw);
    }

    /// What was found out from turns holds no longer: the envelope jumped.
    pub fn forget_turns(&mut self) {
        self.visual = VisualLag::default();
    }

    /// The latency now. `utc_offset_ns` is the envelope of the clock that the pulse belongs to.
    pub fn estimate(&self, now_ns: u64, utc_offset_ns: Option<i64>) -> LatencyEstimate {
        if let (Some(offset_ns), Some(phase)) = (utc_offset_ns, self.pulses.phase(now_ns)) {
            let above_ns = offset_ns.wrapping_sub(phase.phase_ns).rem_euclid(NS_PER_S as i64);
            let negative = above_ns >= NS_PER_S as i64 - EDGE_SLACK_NS;
            let latency_ns = if negative { above_ns - NS_PER_S as i64 } else { above_ns };
            let source = LatencySource::Pulse;
            return LatencyEstimate { latency_s: latency_ns as f64 * 1e-9, std_s: phase.std_s, source };
        }
        match self.visual.estimate {
            Some(LagEstimate { lag_s, std_s, .. }) if std_s < self.configured.std_s => {
                LatencyEstimate { latency_s: lag_s, std_s, source: LatencySource::Visual }
            }
            _ => self.configured,
        }
    }

    /// Turns that the visual estimate comes from.
    pub fn turns(&self) -> usize {
        self.visual.estimate.map_or(0, |estimate| estimate.turns)
    }
}

/// The lag between the camera's yaw and the receiver's in zero-latency time: the latency.
#[derive(Debug, Clone, Default)]
struct VisualLag {
    /// Yaw since some frame, without a hole.
    camera: VecDeque<(u64, f64)>,
    lag: YawLag,
    estimate: Option<LagEstimate>,
}

const PIECE_NS: u64 = PIECE_S as u64 * NS_PER_S;
/// Over a longer time the yaw is not known well enough in between.
const MAX_STEP_NS: u64 = NS_PER_S / 2;
const MAX_LAG_NS: u64 = (MAX_LAG_S * 1e9) as u64;

impl VisualLag {
    fn push(&mut self, from_ns: u64, to_ns: u64, rotation_rad: f64) {
        if to_ns <= from_ns || to_ns - from_ns > MAX_STEP_NS || !rotation_rad.is_finite() {
            self.camera.clear();
            return;
        }
        let continued = self.camera.back().filter(|&&(last_ns, _)| last_ns == from_ns);
        let Some(&(_, yaw_rad)) = continued else {
            self.camera.clear();
            self.camera.extend([(from_ns, 0.0), (to_ns, rotation_rad)]);
            return;
        };
        if self.camera.len() >= ROTATIONS {
            self.camera.pop_front();
        }
        self.camera.push_back((to_ns, yaw_rad + rotation_rad));
    }

    /// The end of the piece at the front.
    fn piece_end_ns(&self) -> Option<u64> {
        let (start_ns, _) = self.camera.front()?;
        let end_ns = start_ns.saturating_add(PIECE_NS);
        self.camera.back().filter(|&&(last_ns, _)| last_ns >= end_ns).map(|_| end_ns)
    }

    fn is_piece_complete(&self, newest_yaw_ns: i64) -> bool {
        let reaches = |end_ns: u64| newest_yaw_ns >= 0 && newest_yaw_ns as u64 > end_ns.saturating_add(MAX_LAG_NS);
        self.piece_end_ns().is_some_and(reaches)
    }

    fn compare(&mut self, yaw: impl Iterator<Item = (i64, f64)>) {
        let Some(end_ns) = self.piece_end_ns() else { return };
        let Some(&(start_ns, _)) = self.camera.front() else { return };
        let since_s = |ns: i64| ns.saturating_sub(start_ns as i64) as f64 * 1e-9;
        // Stamps in seconds since boot: the set of pieces forgets by age.
        let boot_s = start_ns as f64 * 1e-9;
        let yaw: Vec<YawPoint> = yaw.map(|(ns, yaw_rad)| (boot_s + since_s(ns), yaw_rad)).collect();
        let piece = self.camera.iter().take_while(|point| point.0 <= end_ns);
        let camera: Vec<YawPoint> = piece.map(|&(ns, yaw_rad)| (boot_s + since_s(ns as i64), yaw_rad)).collect();
        // The last point of a piece is the first of the next.
        self.camera.drain(..camera.len().saturating_sub(1).max(1));
        if let Some(piece) = Piece::compare(&camera, &yaw) {
            self.lag.push(piece);
            self.estimate = self.lag.estimate();
        }
    }
}
