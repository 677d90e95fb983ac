//! The loop from filled buffers to frames. It makes no system call: a [`CaptureQueue`] does, or a test.

use std::time::Duration;

use rustix::io::Errno;
use tracing::{debug, info, warn};

use super::{
    super::{CameraEvent, CameraFrame, DeviceError, Lost, Stop, mjpeg::MjpegMender, yuyv::YuyvEncoder},
    stamps::{DriverStamp, SequenceJudge, StampJudge},
};
use crate::types::{BufferPool, Clock, PooledBytes};

/// So long a stop request may go unnoticed.
const WAIT: Duration = Duration::from_millis(100);
/// Before asking again when the driver announced a frame that it did not have, or failed to read one.
const RETRY: Duration = Duration::from_millis(5);

/// A buffer that the driver has filled and handed over.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Filled {
    pub index: u32,
    pub bytes_used: u32,
    pub sequence: u32,
    pub stamp: DriverStamp,
    /// The driver's error flag: the data is damaged.
    pub marked_damaged: bool,
}

/// What waiting for a buffer ended with.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Waited {
    /// The time was over.
    Nothing,
    Ready,
    /// POLLERR or POLLHUP.
    Gone,
}

/// The driver's queue of buffers. Each buffer belongs to the driver except between `dequeue` and `enqueue`.
pub trait CaptureQueue {
    fn wait(&mut self, at_most: Duration) -> Result<Waited, Errno>;
    fn dequeue(&mut self) -> Result<Filled, Errno>;
    /// The bytes of a dequeued buffer.
    fn bytes(&self, filled: &Filled) -> &[u8];
    fn enqueue(&mut self, index: u32) -> Result<(), Errno>;
}

/// How the camera's bytes become JPEG.
#[derive(Debug)]
pub enum Converter {
    Mjpeg(MjpegMender),
    /// With a copy of the raw frame, so that the driver has its buffer back while we encode.
    Yuyv(Box<YuyvEncoder>, Vec<u8>),
}

/// What the loop needs to know of the camera.
#[derive(Debug)]
pub struct Capture {
    /// For messages.
    pub device: String,
    pub frame_timeout: Duration,
    pub buffers: u32,
    pub converter: Converter,
}

impl Capture {
    /// Emits frames until told to stop or until the camera is gone.
    pub fn run(
        mut self,
        queue: &mut dyn CaptureQueue,
        clock: &dyn Clock,
        stop: &Stop,
        emit: &mut dyn FnMut(CameraEvent),
    ) -> Result<(), DeviceError> {
        let mut state = State {
            pool: BufferPool::default(),
            stamps: StampJudge::new(self.buffers),
            sequence: SequenceJudge::default(),
            read_errors: 0,
            last_frame_ns: clock.monotonic_ns(),
        };
        let ended = self.until_it_ends(&mut state, queue, clock, stop, emit);
        if state.read_errors > 0 {
            emit(lost(state.read_errors, READ_ERROR, clock.monotonic_ns()));
        }
        let rejected_stamps = state.stamps.rejected();
        match &self.converter {
            Converter::Mjpeg(mender) => {
                let counts = mender.counts();
                info!(
                    device = self.device,
                    counts.frames,
                    counts.damaged,
                    counts.tables_inserted,
                    counts.stray_bytes_removed,
                    rejected_stamps,
                    "camera closed"
                );
            }
            Converter::Yuyv(..) => info!(device = self.device, rejected_stamps, "camera closed"),
        }
        ended
    }

    fn until_it_ends(
        &mut self,
        state: &mut State,
        queue: &mut dyn CaptureQueue,
        clock: &dyn Clock,
        stop: &Stop,
        emit: &mut dyn FnMut(CameraEvent),
    ) -> Result<(), DeviceError> {
        while !stop.is_stopped() {
            let waited = match queue.wait(WAIT) {
                Ok(waited) => waited,
                Err(Errno::INTR) => continue,
                Err(errno) => return Err(self.fault(errno)),
            };
            if waited != Waited::Nothing {
                match queue.dequeue() {
                    Ok(filled) => self.take(state, &filled, queue, clock, emit)?,
                    Err(Errno::INTR) => {}
                    Err(Errno::NODEV) => return Err(self.fault(Errno::NODEV)),
                    // Of a queue that is in error, every buffer fetched before was worth trying.
                    Err(_) if waited == Waited::Gone => return Err(self.fault(Errno::NODEV)),
                    Err(Errno::AGAIN) => {
                        stop.wait(RETRY);
                    }
                    // Passing, says the V4L2 manual; when it is not, the silence ends it.
                    Err(Errno::IO) => {
                        state.read_errors += 1;
                        debug!(device = self.device, "the camera driver failed to read a frame");
                        stop.wait(RETRY);
                    }
                    Err(errno) => return Err(self.fault(errno)),
                }
            }
            let silence = Duration::from_nanos(clock.monotonic_ns().saturating_sub(state.last_frame_ns));
            if silence > self.frame_timeout {
                return Err(DeviceError::TimedOut { device: self.device.clone(), silence_s: silence.as_secs_f64() });
            }
        }
        Ok(())
    }

    /// Copies the frame, gives the buffer back, and only then does what takes time.
    fn take(
        &mut self,
        state: &mut State,
        filled: &Filled,
        queue: &mut dyn CaptureQueue,
        clock: &dyn Clock,
        emit: &mut dyn FnMut(CameraEvent),
    ) -> Result<(), DeviceError> {
        let arrival_ns = clock.monotonic_ns();
        let mut jpeg = state.pool.take();
        let raw: &mut Vec<u8> = match &mut self.converter {
            Converter::Mjpeg(_) => &mut jpeg,
            Converter::Yuyv(_, raw) => raw,
        };
        raw.clear();
        raw.extend_from_slice(queue.bytes(filled));
        let is_empty = raw.is_empty();
        queue.enqueue(filled.index).map_err(|errno| self.fault(errno))?;

        let numbered = state.sequence.number(filled.sequence);
        state.report_missing(numbered.missing, arrival_ns, emit);
        if is_empty {
            emit(lost(1, EMPTY, arrival_ns));
            return Ok(());
        }
        let stamp_ns = state.stamps.stamp_ns(filled.stamp, arrival_ns);
        state.last_frame_ns = arrival_ns;
        let damage = self.converter.convert(filled.marked_damaged, &mut jpeg);
        if let Some(reason) = damage {
            debug!(device = self.device, sequence = numbered.sequence, reason, "damaged frame");
        }
        emit(CameraEvent::Frame(CameraFrame { sequence: numbered.sequence, stamp_ns, arrival_ns, jpeg, damage }));
        Ok(())
    }

    fn fault(&self, errno: Errno) -> DeviceError {
        let device = self.device.clone();
        match errno {
            Errno::NODEV | Errno::NXIO => DeviceError::Disconnected { device },
            errno => {
                warn!(device, %errno, "the camera driver failed");
                DeviceError::Io { device, source: errno.into() }
            }
        }
    }
}

impl Converter {
    /// `jpeg` holds the camera's bytes if they are MJPEG, and is empty otherwise.
    fn convert(&mut self, marked_damaged: bool, jpeg: &mut PooledBytes) -> Option<&'static str> {
        match self {
            Self::Mjpeg(mender) => mender.mend(jpeg, marked_damaged),
            Self::Yuyv(encoder, raw) => encoder.encode(raw, marked_damaged, jpeg),
        }
    }
}

pub const SKIPPED: &str = "skipped by the camera";
pub const EMPTY: &str = "empty frame";
pub const READ_ERROR: &str = "read error";

struct State {
    pool: BufferPool,
    stamps: StampJudge,
    sequence: SequenceJudge,
    /// Not yet reported: each explains one missing sequence number, or a frame that got none.
    read_errors: u64,
    last_frame_ns: u64,
}

impl State {
    fn report_missing(&mut self, missing: u32, stamp_ns: u64, emit: &mut dyn FnMut(CameraEvent)) {
        let read_errors = std::mem::take(&mut self.read_errors);
        if read_errors > 0 {
            emit(lost(read_errors, READ_ERROR, stamp_ns));
        }
        let skipped = u64::from(missing).saturating_sub(read_errors);
        if skipped > 0 {
            emit(lost(skipped, SKIPPED, stamp_ns));
        }
    }
}

fn lost(count: u64, reason: &'static str, stamp_ns: u64) -> CameraEvent {
    CameraEvent::Lost(Lost { count, reason, stamp_ns })
}

#[cfg(test)]
mod tests;
