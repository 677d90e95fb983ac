//! A camera in the simulated world.

use std::{
    sync::mpsc::{self, SyncSender},
    thread,
};

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

/// Frames that are rendered before they are due: one that takes longer than its interval delays none.
const FRAMES_AHEAD: usize = 32;

/// Frames at a steady rate; those that the computer is too slow to render are skipped, as a camera does.
pub struct SimulatedCamera {
    darkroom: Darkroom,
    /// Number of the next exposure since the start of the drive.
    next: u64,
}

impl SimulatedCamera {
    pub fn new(simulation: Simulation, renderer: Renderer) -> Self {
        let mender = MjpegMender::new(simulation.settings.width_px, simulation.settings.height_px);
        Self { darkroom: Darkroom { simulation, renderer, pool: BufferPool::default(), mender }, next: 0 }
    }

    pub fn facts(&self) -> CameraFacts {
        let settings = &self.darkroom.simulation.settings;
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
        let opened_ns = clock.monotonic_ns();
        if self.darkroom.simulation.is_troubled_by(FaultKind::CameraUnplugged, opened_ns) {
            return Err(DeviceError::NotPresent { device: DEVICE.into() });
        }
        emit(CameraEvent::Opened(self.facts()));
        // What was exposed while the camera was away is nobody's loss.
        while self.darkroom.stamp_ns(self.next) < opened_ns {
            self.next += 1;
        }
        let (first, next, darkroom) = (self.next, &mut self.next, &mut self.darkroom);
        let simulation = darkroom.simulation.clone();
        thread::scope(|scope| {
            // The thread ends when this end of the channel is gone.
            let (rendered, frames) = mpsc::sync_channel(FRAMES_AHEAD);
            scope.spawn(move || darkroom.render_ahead(first, clock, &rendered));
            let mut last_ns = opened_ns;
            for (number, event) in frames {
                *next = number + 1;
                let CameraEvent::Frame(frame) = event else {
                    emit(event);
                    continue;
                };
                if simulation.is_troubled_by(FaultKind::CameraUnplugged, frame.stamp_ns) {
                    return Err(DeviceError::Disconnected { device: DEVICE.into() });
                }
                if wait_until(frame.arrival_ns, clock, stop) {
                    return Ok(());
                }
                if simulation.is_troubled_by(FaultKind::CameraStalled, frame.stamp_ns) {
                    let silence_s = frame.stamp_ns.saturating_sub(last_ns) as f64 * 1e-9;
                    if silence_s >= STALL_TIMEOUT_S {
                        return Err(DeviceError::TimedOut { device: DEVICE.into(), silence_s });
                    }
                } else {
                    last_ns = frame.stamp_ns;
                    emit(CameraEvent::Frame(frame));
                }
            }
            Ok(())
        })
    }

    /// The next frame, without a clock; `None` at the end of the drive. Frames that a fault swallows are left out.
    pub fn next_frame(&mut self) -> Option<CameraFrame> {
        while !self.darkroom.is_over(self.next) {
            let number = self.next;
            self.next += 1;
            let stamp_ns = self.darkroom.stamp_ns(number);
            let swallowed = [FaultKind::CameraUnplugged, FaultKind::CameraStalled];
            if !swallowed.iter().any(|&kind| self.darkroom.simulation.is_troubled_by(kind, stamp_ns)) {
                return Some(self.darkroom.render(number, number as u32));
            }
        }
        None
    }
}

/// Where frames are made.
struct Darkroom {
    simulation: Simulation,
    renderer: Renderer,
    pool: BufferPool,
    mender: MjpegMender,
}

impl Darkroom {
    /// Renders from frame `first` to the end of the drive, as far ahead as the channel takes; what is late before it was
    /// begun is left out and reported, under the number of the last such frame.
    fn render_ahead(&mut self, first: u64, clock: &dyn Clock, rendered: &SyncSender<(u64, CameraEvent)>) {
        let mut number = first;
        while !self.is_over(number) {
            let now_ns = clock.monotonic_ns();
            let late = (number..).take_while(|&n| !self.is_over(n) && self.stamp_ns(n) + TRANSFER_NS < now_ns).count();
            let event = if late > 0 {
                number += late as u64 - 1;
                CameraEvent::Lost(Lost { count: late as u64, reason: SKIPPED, stamp_ns: now_ns })
            } else {
                CameraEvent::Frame(self.render(number, (number - first) as u32))
            };
            if rendered.send((number, event)).is_err() {
                return;
            }
            number += 1;
        }
    }

    fn render(&mut self, number: u64, sequence: u32) -> CameraFrame {
        let stamp_ns = self.stamp_ns(number);
        let mut jpeg = self.pool.take();
        self.renderer.render_jpeg(&self.simulation.pose_at(stamp_ns), self.simulation.time_s(stamp_ns), &mut jpeg);
        if self.simulation.is_troubled_by(FaultKind::FramesDamaged, stamp_ns) {
            let whole = (jpeg.len() as f64 * WHOLE_PART) as usize;
            jpeg.truncate(whole);
        }
        let damage = self.mender.mend(&mut jpeg, false);
        CameraFrame { sequence, stamp_ns, arrival_ns: stamp_ns + TRANSFER_NS, jpeg, damage }
    }

    fn stamp_ns(&self, number: u64) -> u64 {
        self.simulation.stamp_ns(number as f64 / self.simulation.settings.frame_rate_hz)
    }

    fn is_over(&self, number: u64) -> bool {
        self.stamp_ns(number) >= self.simulation.stamp_ns(self.simulation.duration_s())
    }
}
