//! Between a camera that does not wait and a localizer that may be slower.

use std::{
    collections::VecDeque,
    sync::{Condvar, Mutex, MutexGuard, PoisonError},
};

use crate::devices::CameraEvent;

/// Frames that may wait: more would only be older.
const CAPACITY: usize = 2;
/// Other events that may wait; a camera says few.
const OTHERS: usize = 64;

/// A queue in which new frames take the place of the oldest.
#[derive(Debug, Default)]
pub struct Newest {
    inner: Mutex<Inner>,
    arrived: Condvar,
}

#[derive(Debug, Default)]
struct Inner {
    events: VecDeque<CameraEvent>,
    passed_over: u64,
    is_closed: bool,
}

impl Newest {
    pub fn push(&self, event: CameraEvent) {
        let mut inner = self.lock();
        let is_frame = |event: &CameraEvent| matches!(event, CameraEvent::Frame(_));
        if is_frame(&event) && inner.events.iter().filter(|event| is_frame(event)).count() >= CAPACITY {
            let oldest = inner.events.iter().position(is_frame);
            oldest.and_then(|oldest| inner.events.remove(oldest));
            inner.passed_over += 1;
        }
        if inner.events.len() < CAPACITY + OTHERS {
            inner.events.push_back(event);
        }
        drop(inner);
        self.arrived.notify_one();
    }

    /// Waits for the next event; `None` once it is closed and empty.
    pub fn next(&self) -> Option<CameraEvent> {
        let waiting = |inner: &mut Inner| inner.events.is_empty() && !inner.is_closed;
        let inner = self.arrived.wait_while(self.lock(), waiting);
        inner.unwrap_or_else(PoisonError::into_inner).events.pop_front()
    }

    /// Nothing more will come.
    pub fn close(&self) {
        self.lock().is_closed = true;
        self.arrived.notify_all();
    }

    /// Frames that were never looked at, since the start.
    pub fn passed_over(&self) -> u64 {
        self.lock().passed_over
    }

    fn lock(&self) -> MutexGuard<'_, Inner> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::devices::{CameraFrame, Lost};

    fn frame(sequence: u32) -> CameraEvent {
        CameraEvent::Frame(CameraFrame { sequence, stamp_ns: 0, arrival_ns: 0, jpeg: Vec::new().into(), damage: None })
    }

    #[test]
    fn the_newest_frames_are_kept_and_everything_else() {
        let newest = Newest::default();
        newest.push(frame(0));
        newest.push(CameraEvent::Lost(Lost { count: 3, reason: "test", stamp_ns: 0 }));
        (1..5).for_each(|sequence| newest.push(frame(sequence)));
        newest.close();
        let mut found = Vec::new();
        while let Some(event) = newest.next() {
            found.push(match event {
                CameraEvent::Frame(frame) => i64::from(frame.sequence),
                _ => -1,
            });
        }
        assert_eq!(found, [-1, 3, 4]);
        assert_eq!(newest.passed_over(), 3);
    }
}
