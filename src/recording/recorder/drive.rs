//! One drive becomes segments: the recorder's work without its thread.
//!
//! An entry is *acknowledged* when it has been synced. Until then it is kept, and if the disk fails, the segment is
//! abandoned where it was last synced and the entry is written again to the next one: a failed sync may have lost
//! anything since the last good one, and cannot be repeated.
//!
//! A pair is known later than its frame. When a new segment starts, the old one is therefore kept open until the pairs
//! of its frames have come, or for [`PAIR_WAIT_NS`]; a pair that comes later is dropped and counted.

use std::{
    collections::VecDeque,
    io,
    sync::{Arc, atomic::Ordering},
};

use mcap::McapError;
use tracing::{info, warn};

use super::{
    Settings,
    abandoned::Abandoned,
    disk::{self, Facts},
    entry::{Entry, Loss},
    guard::{Guard, delete_oldest},
    marks::{self, Marks},
    open_segment::{LINGER_NS, OpenSegment, PAIR_WAIT_NS},
    queue::Queued,
    retry::Retry,
    segments::{Appender, Head, Part, Segment, SegmentName},
    storage::Storage,
};
use crate::types::{Clock, NS_PER_S};

/// Without frames for so long a segment may end anywhere.
const FRAME_WAIT_NS: u64 = NS_PER_S;
/// How often free space is looked at, and how often a segment is deleted when there is too little.
const GUARD_INTERVAL_NS: u64 = NS_PER_S / 2;
/// Unsynced for longer than this: the disk is slow.
const SLOW_NS: u64 = 2 * NS_PER_S;

/// Writes one drive.
pub struct DriveWriter {
    storage: Arc<dyn Storage>,
    clock: Arc<dyn Clock>,
    settings: Settings,
    head: Head,
    boot_id: String,
    next_number: u64,
    current: Option<OpenSegment>,
    /// Waits for pairs.
    closing: Option<OpenSegment>,
    /// Not written yet.
    waiting: VecDeque<Queued>,
    /// Frames up to this number are in segments that are closed.
    closed_through: Option<u32>,
    /// Losses that are not written yet.
    losses: Vec<Loss>,
    released_bytes: usize,
    retry: Retry,
    guard_at_ns: u64,
    marks: Marks,
    abandoned: Abandoned,
    /// Somebody took away a file that was being written.
    has_vanished: bool,
    facts: Facts,
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Which {
    Current,
    Closing,
}

enum Route {
    To(Which),
    /// The pair's segment is closed.
    TooLate,
}

impl DriveWriter {
    /// Numbers go on behind those in the folder. Nothing is written before there is something to write.
    pub fn new(
        settings: Settings,
        head: Head,
        boot_id: &str,
        storage: Arc<dyn Storage>,
        clock: Arc<dyn Clock>,
    ) -> io::Result<Self> {
        let numbers = storage.list()?.into_iter().filter_map(|file| Some(SegmentName::parse(&file.name)?.0.number));
        let next_number = numbers.max().map_or(1, |last| last + 1);
        if let Ok(space) = storage.space() {
            Guard::new(&settings, space).warn_if_less_than(&settings);
        }
        Ok(Self {
            storage,
            clock,
            settings,
            head,
            boot_id: boot_id.into(),
            next_number,
            current: None,
            closing: None,
            waiting: VecDeque::new(),
            closed_through: None,
            losses: Vec::new(),
            released_bytes: 0,
            retry: Retry::default(),
            guard_at_ns: 0,
            marks: Marks::default(),
            abandoned: Abandoned::default(),
            has_vanished: false,
            facts: Facts::default(),
        })
    }

    /// Takes an entry and writes what can be written.
    pub fn write(&mut self, queued: Queued) {
        self.waiting.push_back(queued);
        self.write_waiting();
    }

    /// Does what is due: syncs, ends segments, makes room, marks, tries again.
    pub fn tick(&mut self) {
        self.write_losses();
        self.write_waiting();
        for which in [Which::Closing, Which::Current] {
            if self.sync_is_due(which) {
                self.sync(which);
            }
        }
        let now_ns = self.clock.monotonic_ns();
        if self.closing.as_ref().is_some_and(|closing| now_ns >= closing.close_at_ns) {
            self.close();
        }
        if now_ns >= self.guard_at_ns {
            self.guard_at_ns = now_ns + GUARD_INTERVAL_NS;
            self.keep_room();
            self.abandoned.cut();
            if marks::take_request(&*self.storage) {
                self.mark();
            }
        }
        self.marks.write(&*self.storage);
        self.facts.age(now_ns);
    }

    /// Marks the segment being written and the one before it: they are not deleted to make room.
    pub fn mark(&mut self) {
        let current = match &self.current {
            Some(current) => current.name.number,
            None => self.next_number,
        };
        self.marks.want(SegmentName::new(&self.boot_id, current), &*self.storage);
    }

    /// Syncs and ends what is open. `false`: not all of it is on the disk.
    pub fn finish(&mut self) -> bool {
        // A disk that failed just now gets a second chance on a new segment.
        for _ in 0..2 {
            self.write_losses();
            self.retry.at_once();
            self.write_waiting();
            self.close();
            if self.sync(Which::Current) {
                self.closing = self.current.take();
                self.close();
            }
            if self.pending() == 0 && self.losses.is_empty() {
                break;
            }
        }
        self.abandoned.cut();
        self.pending() == 0 && self.losses.is_empty() && !self.has_vanished
    }

    /// Bytes of entries that are no longer kept, since the last call.
    pub fn take_released_bytes(&mut self) -> usize {
        std::mem::take(&mut self.released_bytes)
    }

    /// Segments that were cut off by a failure since the last call: to be mended.
    pub fn take_abandoned(&mut self) -> Vec<SegmentName> {
        self.abandoned.take()
    }

    pub(super) fn facts(&self) -> &Facts {
        &self.facts
    }

    /// Entries that are not on the disk for good: at 0 all that was written so far is acknowledged.
    pub fn pending(&self) -> usize {
        let unsynced = [&self.current, &self.closing].into_iter().flatten().map(|open| open.unsynced.len());
        self.waiting.len() + unsynced.sum::<usize>()
    }

    pub fn segment_name(&self) -> Option<&SegmentName> {
        self.current.as_ref().map(|current| &current.name)
    }

    /// When the oldest entry that is not on the disk was pushed.
    pub fn oldest_unsynced_ns(&self) -> Option<u64> {
        let open = [&self.current, &self.closing].into_iter().flatten();
        let oldest = open.filter_map(|open| open.unsynced.front());
        oldest.chain(self.waiting.front()).map(|queued| queued.pushed_ns).min()
    }

    /// Messages that the disk's failures cost.
    pub fn lost(&self) -> u64 {
        self.facts.lost
    }

    /// One of [`disk`].
    pub fn disk(&self) -> &'static str {
        let age_ns = self.oldest_unsynced_ns().map_or(0, |ns| self.clock.monotonic_ns().saturating_sub(ns));
        match self.facts.error {
            Some(error) => error,
            None if self.facts.is_full => disk::FULL,
            None if age_ns > SLOW_NS || self.facts.stall_ns > SLOW_NS => disk::SLOW,
            None => disk::OK,
        }
    }

    fn write_waiting(&mut self) {
        while let Some(front) = self.waiting.front() {
            let wants_start = self.current.is_none() || self.rotation_is_due(&front.entry);
            if wants_start && !self.start_segment() && self.current.is_none() {
                return;
            }
            let Some(queued) = self.waiting.pop_front() else { return };
            if let Entry::Facts { name, entries } = &queued.entry
                && self.head.metadata.insert((*name).into(), entries.clone()).as_ref() == Some(entries)
            {
                self.release(&queued);
                continue;
            }
            match self.route(&queued.entry) {
                Route::To(which) => self.write_to(which, queued),
                Route::TooLate => {
                    self.lose(&queued.entry, "pair after its segment");
                    self.release(&queued);
                }
            }
        }
    }

    fn rotation_is_due(&self, entry: &Entry) -> bool {
        let (Some(current), None) = (&self.current, &self.closing) else { return false };
        let now_ns = self.clock.monotonic_ns();
        let is_long = now_ns.saturating_sub(current.started_ns) >= self.settings.segment_s * NS_PER_S;
        let is_large = current.position.load(Ordering::Relaxed) >= self.settings.segment_mib << 20;
        let at_frame = matches!(entry, Entry::Image { .. })
            || now_ns.saturating_sub(current.last_image_ns.max(current.started_ns)) > FRAME_WAIT_NS;
        (is_long || is_large) && at_frame && self.retry.is_due(now_ns)
    }

    fn route(&self, entry: &Entry) -> Route {
        let Some(frame) = entry.pair_of_frame() else { return Route::To(Which::Current) };
        let is_in = |open: &OpenSegment| {
            open.first_image.is_some_and(|first| frame >= first) && open.last_image.is_some_and(|last| frame <= last)
        };
        if self.current.as_ref().is_some_and(is_in) {
            Route::To(Which::Current)
        } else if self.closing.as_ref().is_some_and(is_in) {
            Route::To(Which::Closing)
        } else if self.closed_through.is_some_and(|last| frame <= last) {
            Route::TooLate
        } else {
            Route::To(Which::Current)
        }
    }

    fn open(&mut self, which: Which) -> &mut Option<OpenSegment> {
        match which {
            Which::Current => &mut self.current,
            Which::Closing => &mut self.closing,
        }
    }

    fn write_to(&mut self, which: Which, queued: Queued) {
        let now_ns = self.clock.monotonic_ns();
        let Some(open) = self.open(which) else { return };
        let before_bytes = open.position.load(Ordering::Relaxed);
        let outcome = open.segment.write(&queued.entry);
        open.note(&queued.entry, now_ns);
        open.unsynced.push_back(queued);
        let written_bytes = open.position.load(Ordering::Relaxed) - before_bytes;
        self.facts.written_bytes += written_bytes;
        if written_bytes > 0 {
            self.facts.note_stall(&*self.clock, now_ns);
        }
        if let Err(error) = outcome {
            self.fail(which, error);
        }
    }

    fn sync_is_due(&mut self, which: Which) -> bool {
        let now_ns = self.clock.monotonic_ns();
        let interval_ns = self.settings.sync_interval_ms * 1_000_000;
        let oldest = self.open(which).as_ref().and_then(|open| open.unsynced.front());
        oldest.is_some_and(|oldest| now_ns.saturating_sub(oldest.pushed_ns) >= interval_ns)
    }

    /// `false`: there is no such segment any more.
    fn sync(&mut self, which: Which) -> bool {
        let since_ns = self.clock.monotonic_ns();
        let Some(open) = self.open(which) else { return false };
        let before_bytes = open.position.load(Ordering::Relaxed);
        let outcome = open.segment.flush();
        open.synced_bytes = if outcome.is_ok() { open.position.load(Ordering::Relaxed) } else { open.synced_bytes };
        let written_bytes = open.position.load(Ordering::Relaxed) - before_bytes;
        let synced = if outcome.is_ok() { std::mem::take(&mut open.unsynced) } else { VecDeque::new() };
        self.facts.written_bytes += written_bytes;
        self.facts.note_stall(&*self.clock, since_ns);
        match outcome {
            Ok(()) => {
                synced.iter().for_each(|queued| self.release(queued));
                // The vector goes back with its capacity.
                if let Some(open) = self.open(which) {
                    open.unsynced = synced;
                    open.unsynced.clear();
                }
                self.recovered();
                true
            }
            Err(error) => {
                self.fail(which, error);
                false
            }
        }
    }

    fn recovered(&mut self) {
        if self.facts.error.take().is_some() {
            info!("the disk works again");
        }
        self.retry.succeeded();
    }

    /// Starts the next segment; the present one, synced, waits for its pairs. `false`: it could not be started.
    fn start_segment(&mut self) -> bool {
        if !self.retry.is_due(self.clock.monotonic_ns()) {
            return false;
        }
        if self.current.is_some() && !self.sync(Which::Current) && !self.retry.is_due(self.clock.monotonic_ns()) {
            return false;
        }
        self.keep_room();
        let since_ns = self.clock.monotonic_ns();
        let outcome = self.create();
        self.facts.note_stall(&*self.clock, since_ns);
        let new = match outcome {
            Ok(new) => new,
            Err(error) => {
                self.note_failure(&error);
                return false;
            }
        };
        info!(segment = new.name.file(Part::Open), "segment started");
        if let Some(mut old) = self.current.replace(new) {
            let wait_ns = if old.awaiting.is_empty() { LINGER_NS } else { PAIR_WAIT_NS };
            old.close_at_ns = since_ns + wait_ns;
            self.closing = Some(old);
        }
        true
    }

    fn create(&mut self) -> io::Result<OpenSegment> {
        let name = SegmentName::new(&self.boot_id, self.next_number);
        let file_name = name.file(Part::Open);
        let file = match self.storage.create(&file_name) {
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {
                self.next_number += 1;
                return Err(error);
            }
            outcome => outcome?,
        };
        self.next_number += 1;
        let started_ns = self.clock.monotonic_ns();
        let (out, position) = Appender::new(file);
        let first_ns = self.waiting.front().and_then(|queued| queued.entry.topic_and_stamp()).map_or(0, |(_, ns)| ns);
        let started = Segment::start(out, &self.head, first_ns).map_err(io_error);
        // What is acknowledged must be in a file that has a name.
        let outcome = started.and_then(|segment| self.storage.sync_folder().map(|()| segment));
        let segment = outcome.inspect_err(|_| {
            let _ = self.storage.remove(&file_name);
        })?;
        Ok(OpenSegment::new(name, segment, position, started_ns))
    }

    /// Ends the segment that waited for pairs.
    fn close(&mut self) {
        if !self.sync(Which::Closing) {
            return;
        }
        let since_ns = self.clock.monotonic_ns();
        let Some(OpenSegment { name, segment, last_image, .. }) = self.closing.take() else { return };
        self.closed_through = self.closed_through.max(last_image);
        let [open, finished] = [Part::Open, Part::Finished].map(|part| name.file(part));
        let outcome = segment.finish().map_err(io_error).map(drop);
        let outcome = outcome.and_then(|()| self.storage.rename(&open, &finished));
        let outcome = outcome.and_then(|()| self.storage.sync_folder());
        self.facts.note_stall(&*self.clock, since_ns);
        match outcome {
            Ok(()) => info!(segment = finished, "segment finished"),
            Err(error) => {
                // Nothing is lost: its entries are synced, and it will be mended; unless somebody took the file away.
                self.has_vanished |= error.kind() == io::ErrorKind::NotFound;
                warn!(segment = open, %error, "segment could not be finished");
                self.abandoned.note(name);
            }
        }
    }

    /// Gives up a segment where it was last synced. What came later is written again to the next one.
    fn fail(&mut self, which: Which, error: McapError) {
        self.note_failure(&io_error(error));
        let Some(open) = self.open(which).take() else { return };
        let OpenSegment { name, segment, synced_bytes, unsynced, last_image, .. } = open;
        self.abandoned.give_up(name, segment.abandon(), synced_bytes);
        let first_kept = unsynced.iter().find_map(|queued| match queued.entry {
            Entry::Image { sequence, .. } => Some(sequence),
            _ => None,
        });
        match which {
            Which::Current => {
                let closed = first_kept.map_or(last_image, |first| first.checked_sub(1));
                self.closed_through = self.closed_through.max(closed);
                for queued in unsynced.into_iter().rev() {
                    self.waiting.push_front(queued);
                }
            }
            Which::Closing => {
                self.closed_through = self.closed_through.max(last_image);
                for queued in unsynced {
                    self.lose(&queued.entry, "write failed");
                    self.release(&queued);
                }
            }
        }
    }

    /// Says what is wrong, makes room if that is what is missing, and decides when to try again.
    fn note_failure(&mut self, error: &io::Error) {
        let word = match error.kind() {
            io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded => disk::FULL,
            io::ErrorKind::ReadOnlyFilesystem | io::ErrorKind::PermissionDenied => disk::READ_ONLY,
            _ => disk::FAILED,
        };
        if self.facts.error != Some(word) {
            warn!(%error, state = word, "the disk fails");
        }
        self.facts.error = Some(word);
        self.facts.last_error = Some(error.to_string());
        let has_room_now = word == disk::FULL && self.delete_oldest();
        self.retry.failed(self.clock.monotonic_ns(), has_room_now);
    }

    fn keep_room(&mut self) {
        let Ok(space) = self.storage.space() else { return };
        let guard = Guard::new(&self.settings, space);
        self.facts.space = space;
        self.facts.is_full = guard.is_low(space) && !self.delete_oldest();
    }

    fn delete_oldest(&mut self) -> bool {
        match delete_oldest(&*self.storage) {
            Ok(Some(deleted)) => {
                info!(segment = deleted.name, bytes = deleted.bytes, "oldest segment deleted to make room");
                true
            }
            Ok(None) => false,
            Err(error) => {
                warn!(%error, "no room could be made");
                false
            }
        }
    }

    fn lose(&mut self, entry: &Entry, reason: &'static str) {
        let Some((topic, stamp_ns)) = entry.topic_and_stamp() else { return };
        self.facts.lost += 1;
        match self.losses.iter_mut().find(|loss| loss.topic == topic && loss.reason == reason) {
            Some(loss) => loss.extend(stamp_ns),
            None => self.losses.push(Loss::one(topic, reason, stamp_ns)),
        }
    }

    fn write_losses(&mut self) {
        let pushed_ns = self.clock.monotonic_ns();
        for loss in std::mem::take(&mut self.losses) {
            // Not counted in the queue, and not as acknowledged either.
            self.waiting.push_back(Queued { entry: Entry::Lost(loss), pushed_ns, bytes: 0 });
        }
    }

    fn release(&mut self, queued: &Queued) {
        self.released_bytes += queued.bytes;
    }
}

fn io_error(error: McapError) -> io::Error {
    match error {
        McapError::Io(error) => error,
        other => io::Error::other(other),
    }
}
