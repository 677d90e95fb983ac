//! Watches the camera turn while a drive is recorded, which shows the latency of the serial line.
//!
//! On a thread of the lowest priority: recording goes first. A frame that comes while the thread is at work is passed
//! over.

use std::{
    io,
    sync::mpsc::{Receiver, SyncSender, sync_channel},
    thread,
};

use crate::{
    sync::{CameraTurns, VisualRotation},
    types::DonutCalibration,
};

/// Frames a second that are looked at: a turn takes seconds.
const RATE_HZ: u64 = 5;

/// Chooses frames that are [`RATE_HZ`] apart.
#[derive(Debug, Default)]
pub struct Sampler {
    next_ns: u64,
}

impl Sampler {
    pub fn wants(&mut self, stamp_ns: u64) -> bool {
        const INTERVAL_NS: u64 = 1_000_000_000 / RATE_HZ;
        let is_due = stamp_ns >= self.next_ns || self.next_ns > stamp_ns + INTERVAL_NS;
        if is_due {
            self.next_ns = stamp_ns + INTERVAL_NS;
        }
        is_due
    }
}

struct Copied {
    stamp_ns: u64,
    jpeg: Vec<u8>,
}

/// What hands frames to the thread. The thread ends with it.
pub struct TurnWatch {
    sampler: Sampler,
    to_thread: SyncSender<Copied>,
    /// Frames that the thread is done with, for their memory.
    done: Receiver<Copied>,
    idle: Option<Copied>,
}

impl TurnWatch {
    /// `emit` is called on the thread with every turn.
    pub fn start(
        calibration: DonutCalibration,
        mut emit: impl FnMut(VisualRotation) + Send + 'static,
    ) -> io::Result<Self> {
        let (to_thread, frames) = sync_channel::<Copied>(1);
        let (to_owner, done) = sync_channel(1);
        thread::Builder::new().name("turns".into()).spawn(move || {
            // On Linux this is the priority of the thread. Without it the watch only costs more.
            let _ = rustix::process::nice(19);
            let mut turns = CameraTurns::new(calibration);
            for frame in frames {
                turns.push(frame.stamp_ns, &frame.jpeg).into_iter().for_each(&mut emit);
                if to_owner.send(frame).is_err() {
                    return;
                }
            }
        })?;
        let idle = Some(Copied { stamp_ns: 0, jpeg: Vec::new() });
        Ok(Self { sampler: Sampler::default(), to_thread, done, idle })
    }

    /// Looks at the frame if it is time for one and the thread is free. Never waits.
    pub fn offer(&mut self, stamp_ns: u64, jpeg: &[u8]) {
        self.idle = self.idle.take().or_else(|| self.done.try_recv().ok());
        if self.idle.is_none() || !self.sampler.wants(stamp_ns) {
            return;
        }
        if let Some(mut frame) = self.idle.take() {
            frame.stamp_ns = stamp_ns;
            frame.jpeg.clear();
            frame.jpeg.extend_from_slice(jpeg);
            let _ = self.to_thread.try_send(frame);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn five_frames_a_second_are_looked_at_whatever_the_clock_does() {
        let mut sampler = Sampler::default();
        let count = |sampler: &mut Sampler, from_ms: u64| {
            (from_ms..from_ms + 2000).step_by(33).filter(|ms| sampler.wants(ms * 1_000_000)).count()
        };
        assert!((9..=10).contains(&count(&mut sampler, 50_000)));
        assert!((9..=10).contains(&count(&mut sampler, 1_000)), "a camera that starts over");
    }
}
