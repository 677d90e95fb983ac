//! Between the producers, which never wait, and the writer thread, which may wait for the disk.
//!
//! Bounded by bytes. What has been written but not yet synced counts as well: the writer keeps it to write it again if
//! the disk fails. Frames may only fill the greater part; the rest is for everything else, which is small.

use std::{
    collections::VecDeque,
    sync::{Condvar, Mutex, MutexGuard, PoisonError},
    time::Duration,
};

use super::entry::{Entry, Loss};

/// Part of the capacity that frames may not take: 1/8. At 64 MiB that is five minutes of everything else.
const RESERVED_SHARE: usize = 8;
/// Kinds of losses kept apart.
const MAX_LOSSES: usize = 16;

const QUEUE_FULL: &str = "queue full";

/// An entry and when it came.
#[derive(Debug)]
pub struct Queued {
    pub entry: Entry,
    /// On the monotonic clock.
    pub pushed_ns: u64,
    pub(super) bytes: usize,
}

impl Queued {
    pub fn new(entry: Entry, pushed_ns: u64) -> Self {
        let bytes = entry.bytes();
        Self { entry, pushed_ns, bytes }
    }
}

#[derive(Debug)]
pub struct Queue {
    capacity_bytes: usize,
    state: Mutex<State>,
    filled: Condvar,
}

#[derive(Debug, Default)]
struct State {
    entries: VecDeque<Queued>,
    /// Of the entries, and of those handed out and not released.
    bytes: usize,
    /// Losses that no entry says yet.
    losses: Vec<Loss>,
    lost: u64,
    /// Something other than an entry waits for the writer.
    is_called: bool,
    is_closed: bool,
}

impl Queue {
    pub fn new(capacity_bytes: usize) -> Self {
        Self { capacity_bytes, state: Mutex::default(), filled: Condvar::new() }
    }

    pub fn capacity_bytes(&self) -> usize {
        self.capacity_bytes
    }

    /// Never waits. `false`: there was no room, or the queue is closed; the loss is counted.
    pub fn push(&self, entry: Entry, pushed_ns: u64) -> bool {
        let bytes = entry.bytes();
        let mut state = self.lock();
        let room = match entry {
            Entry::Image { .. } => self.capacity_bytes - self.capacity_bytes / RESERVED_SHARE,
            _ => self.capacity_bytes,
        };
        if state.is_closed || state.bytes.saturating_add(bytes) > room {
            state.lose(&entry);
            return false;
        }
        let topic = entry.topic_and_stamp().map(|(topic, _)| topic);
        // The run of losses on this topic is over: say so before what follows it.
        if let Some(at) = state.losses.iter().position(|loss| Some(loss.topic) == topic) {
            let loss = state.losses.swap_remove(at);
            state.add(Entry::Lost(loss), pushed_ns);
        }
        state.add(entry, pushed_ns);
        drop(state);
        self.filled.notify_one();
        true
    }

    /// Waits for an entry, a [`call`](Self::call) or the time to pass, and takes up to `max` entries. Their bytes count
    /// until they are [released](Self::release). `false`: closed and empty.
    pub fn take(&self, into: &mut Vec<Queued>, max: usize, at_most: Duration) -> bool {
        let idle = |state: &mut State| state.entries.is_empty() && !state.is_called && !state.is_closed;
        let waited = self.filled.wait_timeout_while(self.lock(), at_most, idle);
        let mut state = waited.unwrap_or_else(PoisonError::into_inner).0;
        state.is_called = false;
        let count = state.entries.len().min(max);
        into.extend(state.entries.drain(..count));
        count > 0 || !state.is_closed
    }

    /// Wakes the writer.
    pub fn call(&self) {
        self.lock().is_called = true;
        self.filled.notify_one();
    }

    /// So many bytes are on the disk, or given up.
    pub fn release(&self, bytes: usize) {
        let mut state = self.lock();
        state.bytes = state.bytes.saturating_sub(bytes);
    }

    /// Nothing more comes in; what is there can still be taken.
    pub fn close(&self) {
        self.lock().is_closed = true;
        self.filled.notify_one();
    }

    /// Losses that nothing was pushed after.
    pub fn take_losses(&self) -> Vec<Loss> {
        std::mem::take(&mut self.lock().losses)
    }

    /// Bytes held, and how many messages were lost so far.
    pub fn usage(&self) -> (usize, u64) {
        let state = self.lock();
        (state.bytes, state.lost)
    }

    /// Whoever panicked while holding the state left it usable: counts may be off by one entry.
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl State {
    fn add(&mut self, entry: Entry, pushed_ns: u64) {
        let queued = Queued::new(entry, pushed_ns);
        self.bytes += queued.bytes;
        self.entries.push_back(queued);
    }

    fn lose(&mut self, entry: &Entry) {
        // A loss that cannot be written stays a loss of what it speaks of.
        let loss = match (entry, entry.topic_and_stamp()) {
            (Entry::Lost(loss), _) => *loss,
            (_, Some((topic, stamp_ns))) => Loss::one(topic, QUEUE_FULL, stamp_ns),
            (_, None) => return,
        };
        self.lost += loss.count;
        let same = |known: &&mut Loss| known.topic == loss.topic && known.reason == loss.reason;
        if let Some(known) = self.losses.iter_mut().find(same) {
            known.count += loss.count;
            known.last_ns = known.last_ns.max(loss.last_ns);
        } else if self.losses.len() < MAX_LOSSES {
            self.losses.push(loss);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::recording::topics;

    fn image(stamp_ns: u64) -> Entry {
        Entry::Image { sequence: stamp_ns as u32, stamp_ns, jpeg: vec![0; 1000].into() }
    }

    fn bytes(stamp_ns: u64) -> Entry {
        Entry::Message { topic: &topics::GNSS_RAW, sequence: 0, stamp_ns, payload: vec![0; 10].into() }
    }

    fn take(queue: &Queue, max: usize) -> Vec<Queued> {
        let mut taken = Vec::new();
        assert!(queue.take(&mut taken, max, Duration::ZERO));
        taken
    }

    #[test]
    fn a_full_queue_drops_frames_says_so_once_and_keeps_everything_else() {
        let queue = Queue::new(16_000);
        let accepted: Vec<bool> = (0..20).map(|stamp_ns| queue.push(image(stamp_ns), 0)).collect();
        let room = accepted.iter().filter(|&&accepted| accepted).count();
        assert!((11..14).contains(&room) && accepted[..room].iter().all(|&accepted| accepted), "{accepted:?}");
        assert!(queue.push(bytes(20), 0), "there is room for small things");
        assert_eq!(queue.usage().1, 20 - room as u64);

        let taken = take(&queue, 100);
        assert_eq!(taken.len(), room + 1);
        assert!(!queue.push(image(21), 0), "what is not on the disk takes room");
        queue.release(taken.iter().map(|queued| queued.bytes).sum());
        assert_eq!(queue.usage().0, 0);
        assert!(queue.push(image(22), 0));
        let taken = take(&queue, 100);
        let expected = Loss {
            topic: &topics::CAMERA_IMAGE,
            reason: "queue full",
            count: 21 - room as u64,
            first_ns: room as u64,
            last_ns: 21,
        };
        assert!(matches!(taken[0].entry, Entry::Lost(loss) if loss == expected), "{:?}", taken[0]);
        assert!(matches!(taken[1].entry, Entry::Image { stamp_ns: 22, .. }));
    }

    #[test]
    fn nothing_can_fill_it_without_bound() {
        let queue = Queue::new(16_000);
        let accepted = (0..10_000).filter(|&stamp_ns| queue.push(bytes(stamp_ns), 0)).count();
        assert!(accepted < 16_000 / 10 && queue.usage().0 <= 16_000);
        assert_eq!(
            queue.take_losses(),
            [Loss {
                topic: &topics::GNSS_RAW,
                reason: "queue full",
                count: 10_000 - accepted as u64,
                first_ns: accepted as u64,
                last_ns: 9_999,
            }]
        );
    }

    #[test]
    fn a_closed_queue_hands_out_what_it_has_and_then_ends() {
        let queue = Queue::new(16_000);
        assert!(queue.push(bytes(1), 0));
        queue.close();
        assert!(!queue.push(bytes(2), 0));
        assert_eq!(take(&queue, 1).len(), 1);
        assert!(!queue.take(&mut Vec::new(), 1, Duration::from_secs(1000)), "returns at once");
    }
}
