//! A camera in the simulated world.

use super::{FaultKind, Simulation};
use crate::{
    devices::{
        CameraEvent, CameraFacts, CameraFrame, DeviceError, Lost, Stop, camera_v4l2::capture::SKIPPED,
        mjpeg::MjpegMender, wait_until,
    },
    types::{BufferPool, Clock},
    world::Renderer,
};

/// What errors call it.
const DEVICE: &str = "the simulated camera";
/// From the start of the exposure to the hand-over: exposure, read-out and transfer of a webcam \[ns\].
const TRANSFER_NS: u64 = 45_000_000;
/// Part of a damaged frame that arrives.
const WHOLE_PART: f64 = 0.6;
/// A real camera's driver reports a silence after this time \[s\].
const STALL_TIMEOUT_S: f64 = 2.0;

/// Frames at a steady rate; those that the computer is too slow to render are skipped, as a camera does.
pub struct SimulatedCamera {
    simulation: Simulation,
    renderer: Renderer,
    pool: BufferPool,
    mender: MjpegMender,
    /// Number of the next exposure since the start of the drive.
    next: u64,
}

impl SimulatedCamera {
    pub fn new(simulation: Simulation, renderer: Renderer) -> Self {
        let mender = MjpegMender::new(simulation.settings.width_px, simulation.settings.height_px);
        Self { simulation, renderer, pool: BufferPool::default(), mender, next: 0 }
    }

    pub fn facts(&self) -> CameraFacts {
        let settings = &self.simulation.settings;
        CameraFacts {
            name: "simulated".into(),
            width_px: settings.width_px,
            height_px: settings.height_px,
            frame_rate_hz: settings.frame_rate_hz,
            pixel_format: "MJPG".into(),
        }
    }

    /// The device function; `Ok` also at the end of the drive.
    pub fn run(
        &mut self,
        clock: &dyn Clock,
        stop: &Stop,
        emit: &mut dyn FnMut(CameraEvent),
    ) -> Result<(), DeviceError> {
        if self.has(FaultKind::CameraUnplugged, clock.monotonic_ns()) {
            return Err(DeviceError::NotPresent { device: DEVICE.into() });
        }
        emit(CameraEvent::Opened(self.facts()));
        // What was exposed while the camera was away is nobody's loss.
        while self.stamp_ns(self.next) < clock.monotonic_ns() {
            self.next += 1;
        }
        let opened_at = self.next;
        let mut last_ns = clock.monotonic_ns();
        while !self.is_over() {
            let stamp_ns = self.stamp_ns(self.next);
            if self.has(FaultKind::CameraUnplugged, stamp_ns) {
                return Err(DeviceError::Disconnected { device: DEVICE.into() });
            }
            let frame = self.render((self.next - opened_at) as u32);
            if wait_until(frame.arrival_ns, clock, stop) {
                return Ok(());
            }
            if self.has(FaultKind::CameraStalled, stamp_ns) {
                let silence_s = stamp_ns.saturating_sub(last_ns) as f64 * 1e-9;
                if silence_s >= STALL_TIMEOUT_S {
                    return Err(DeviceError::TimedOut { device: DEVICE.into(), silence_s });
                }
            } else {
                last_ns = stamp_ns;
                emit(CameraEvent::Frame(frame));
            }
            self.next += 1;
            self.skip_what_is_late(clock.monotonic_ns(), emit);
        }
        Ok(())
    }

    /// The next frame, without a clock; `None` at the end of the drive. Frames that a fault swallows are left out.
    pub fn next_frame(&mut self) -> Option<CameraFrame> {
        while !self.is_over() {
            let (number, stamp_ns) = (self.next, self.stamp_ns(self.next));
            self.next += 1;
            if !self.has(FaultKind::CameraUnplugged, stamp_ns) && !self.has(FaultKind::CameraStalled, stamp_ns) {
                self.next -= 1;
                let frame = self.render(number as u32);
                self.next += 1;
                return Some(frame);
            }
        }
        None
    }

    fn render(&mut self, sequence: u32) -> CameraFrame {
        let stamp_ns = self.stamp_ns(self.next);
        let time_s = self.simulation.time_s(stamp_ns);
        let mut jpeg = self.pool.take();
        self.renderer.render_jpeg(&self.simulation.pose_at(stamp_ns), time_s, &mut jpeg);
        if self.has(FaultKind::FramesDamaged, stamp_ns) {
            let whole = (jpeg.len() as f64 * WHOLE_PART) as usize;
            jpeg.truncate(whole);
        }
        let damage = self.mender.mend(&mut jpeg, false);
        CameraFrame { sequence, stamp_ns, arrival_ns: stamp_ns + TRANSFER_NS, jpeg, damage }
    }

    fn skip_what_is_late(&mut self, now_ns: u64, emit: &mut dyn FnMut(CameraEvent)) {
        let mut count = 0;
        while !self.is_over() && self.stamp_ns(self.next) + TRANSFER_NS < now_ns {
            self.next += 1;
            count += 1;
        }
        if count > 0 {
            emit(CameraEvent::Lost(Lost { count, reason: SKIPPED, stamp_ns: now_ns }));
        }
    }

    fn stamp_ns(&self, number: u64) -> u64 {
        self.simulation.stamp_ns(number as f64 / self.simulation.settings.frame_rate_hz)
    }

    fn is_over(&self) -> bool {
        self.stamp_ns(self.next) >= self.simulation.stamp_ns(self.simulation.duration_s())
    }

    fn has(&self, kind: FaultKind, stamp_ns: u64) -> bool {
        self.simulation.settings.has(kind, self.simulation.time_s(stamp_ns))
    }
}
