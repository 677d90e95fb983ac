//! The recorder's threads and what others hold of them.

use std::{
    collections::VecDeque,
    io,
    path::PathBuf,
    sync::{
        Arc, Mutex, PoisonError,
        atomic::{AtomicBool, Ordering},
        mpsc,
    },
    thread,
    time::{Duration, Instant},
};

use prost::Message;
use tracing::{info, warn};

use super::{
    DriveWriter, Encoder, Entry, Head, Part, Queue, Queued, SegmentName, Settings, Space, Storage, cut_segments,
    mend::{Mended, mend},
};
use crate::{
    recording::{RecordingError, proto::omniloc, topics::Topic},
    types::{Clock, NS_PER_S, PooledBytes, PositionEstimate},
};

/// The writer looks at the clock at least this often.
const TICK: Duration = Duration::from_millis(100);
/// Entries between two looks at the clock: two frames a tenth of a second are usual.
const BATCH: usize = 16;
/// Mending pauses while the queue is fuller than this part of its capacity, and after each MiB: recording goes first.
const BUSY_SHARE: usize = 4;
const MEND_PAUSE: Duration = Duration::from_millis(20);
/// After a failure the disk is left alone for so long.
const MEND_RETRY: Duration = Duration::from_secs(2);

/// The recorder of one drive.
pub struct Recorder {
    handle: RecorderHandle,
    ended: mpsc::Receiver<RecorderReport>,
}

/// What producers hold. Cloned freely; nothing in it ever waits for the disk.
#[derive(Clone)]
pub struct RecorderHandle {
    shared: Arc<Shared>,
    encoder: Encoder,
}

struct Shared {
    queue: Queue,
    clock: Arc<dyn Clock>,
    health: Mutex<RecorderHealth>,
    mark: AtomicBool,
    /// The drive is over: mending ends where it is.
    stop: AtomicBool,
}

/// How the recorder is.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct RecorderHealth {
    pub queue_bytes: u64,
    pub queue_capacity_bytes: u64,
    /// Longest disk operation of the last second, or of the present one so far.
    pub disk_stall_s: f64,
    pub disk_free_bytes: u64,
    pub disk_free_percent: f64,
    pub written_bytes: u64,
    /// Being written; empty if there is none.
    pub segment: String,
    /// Age of the oldest message that a power cut would lose now.
    pub unsynced_s: f64,
    /// Messages lost since the start.
    pub lost: u64,
    /// One of [`disk`](super::disk).
    pub disk: &'static str,
    /// The last thing that the disk said when it failed.
    pub last_error: Option<String>,
    /// Segments of earlier drives that were mended, and that still wait.
    pub mended: u64,
    pub to_mend: u64,
    busy_since_ns: u64,
    oldest_unsynced_ns: Option<u64>,
}

/// What became of the drive.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct RecorderReport {
    /// Everything that was accepted is on the disk, and the last segment is finished.
    pub is_complete: bool,
    pub health: RecorderHealth,
}

impl Recorder {
    /// Starts the threads. Segments that earlier drives left cut off are mended meanwhile.
    ///
    /// # Errors
    /// The folder cannot be read. What goes wrong later is in [`RecorderHandle::health`].
    pub fn start(
        settings: Settings,
        head: Head,
        boot_id: &str,
        storage: Arc<dyn Storage>,
        clock: Arc<dyn Clock>,
    ) -> Result<Self, RecordingError> {
        let cannot_read =
            |folder: PathBuf| move |source: io::Error| RecordingError::CannotRead { path: folder, source };
        let folder = settings.folder.clone();
        let cut = cut_segments(&*storage).map_err(cannot_read(folder.clone()))?;
        let queue = Queue::new(usize::try_from(settings.queue_mib << 20).unwrap_or(usize::MAX));
        let encoder = Encoder::new(head.log_offset_ns);
        let drive = DriveWriter::new(settings, head, boot_id, storage.clone(), clock.clone());
        let drive = drive.map_err(cannot_read(folder.clone()))?;
        let shared = Arc::new(Shared {
            queue,
            clock,
            health: Mutex::new(RecorderHealth { disk: super::disk::OK, ..Default::default() }),
            mark: AtomicBool::new(false),
            stop: AtomicBool::new(false),
        });
        let (to_mender, from_writer) = mpsc::channel();
        for name in cut {
            shared.health().to_mend += 1;
            // The receiver is alive: it is in this function.
            let _ = to_mender.send(name);
        }
        let (to_owner, ended) = mpsc::channel();
        let spawn = |name: &str, run: Box<dyn FnOnce() + Send>| thread::Builder::new().name(name.into()).spawn(run);
        let for_mender = shared.clone();
        let mending = move || mend_all(&for_mender, &*storage, &from_writer);
        spawn("mender", Box::new(mending)).map_err(cannot_read(folder.clone()))?;
        let for_writer = shared.clone();
        let writing = move || drop(to_owner.send(record(&for_writer, drive, &to_mender)));
        spawn("recorder", Box::new(writing)).map_err(cannot_read(folder))?;
        Ok(Self { handle: RecorderHandle { shared, encoder }, ended })
    }

    pub fn handle(&self) -> RecorderHandle {
        self.handle.clone()
    }

    /// Writes what is queued, ends the segment and says how it went. Nothing more is accepted from now on.
    ///
    /// If the disk does not answer within `at_most`, the report says that the drive is not complete; what was synced is
    /// safe, and the next start mends the segment.
    pub fn finish(self, at_most: Duration) -> RecorderReport {
        let shared = &self.handle.shared;
        shared.stop.store(true, Ordering::SeqCst);
        shared.queue.close();
        let incomplete = |_| RecorderReport { is_complete: false, health: self.handle.health() };
        self.ended.recv_timeout(at_most).unwrap_or_else(incomplete)
    }
}

impl RecorderHandle {
    /// Records an entry. Never waits; `false` if there was no room, which is counted and written down.
    pub fn push(&self, entry: Entry) -> bool {
        let now_ns = self.shared.clock.monotonic_ns();
        self.shared.queue.push(entry, now_ns)
    }

    pub fn push_image(&self, sequence: u32, stamp_ns: u64, jpeg: PooledBytes) -> bool {
        self.push(Entry::Image { sequence, stamp_ns, jpeg })
    }

    /// A message whose timestamp is [`timestamp`](Self::timestamp) of the stamp.
    pub fn push_message(&self, topic: &'static Topic, sequence: u32, stamp_ns: u64, message: &impl Message) -> bool {
        self.push(self.encoder.message(topic, sequence, stamp_ns, message))
    }

    /// Where the vehicle was at frame `sequence`; timestamp and frame number are filled in.
    pub fn push_pair(&self, sequence: u32, stamp_ns: u64, pair: omniloc::SurveyPair) -> bool {
        let (pair, pose) = self.encoder.pair(sequence, stamp_ns, pair);
        let pushed = self.push(pair);
        pose.is_none_or(|pose| self.push(pose)) && pushed
    }

    /// Where the localizer takes the vehicle to be.
    pub fn push_estimate(&self, estimate: &PositionEstimate) -> bool {
        let (estimate, pose) = self.encoder.estimate(estimate);
        let pushed = self.push(estimate);
        pose.is_none_or(|pose| self.push(pose)) && pushed
    }

    /// The protobuf timestamp of a stamp on the monotonic clock.
    pub fn timestamp(&self, stamp_ns: u64) -> prost_types::Timestamp {
        self.encoder.timestamp(stamp_ns)
    }

    /// Keeps the present segment and the one before it from being deleted.
    pub fn mark(&self) {
        self.shared.mark.store(true, Ordering::SeqCst);
        self.shared.queue.call();
    }

    pub fn health(&self) -> RecorderHealth {
        let mut health = self.shared.health().clone();
        let (queue_bytes, lost) = self.shared.queue.usage();
        let now_ns = self.shared.clock.monotonic_ns();
        let age_s = |since_ns: u64| now_ns.saturating_sub(since_ns) as f64 / NS_PER_S as f64;
        health.queue_bytes = queue_bytes as u64;
        health.queue_capacity_bytes = self.shared.queue.capacity_bytes() as u64;
        health.lost += lost;
        // The writer cannot speak while it waits for the disk.
        if health.busy_since_ns > 0 {
            health.disk_stall_s = health.disk_stall_s.max(age_s(health.busy_since_ns));
        }
        health.unsynced_s = health.oldest_unsynced_ns.map_or(0.0, age_s);
        if health.disk == super::disk::OK && health.disk_stall_s > 2.0 {
            health.disk = super::disk::SLOW;
        }
        health
    }
}

impl Shared {
    fn health(&self) -> std::sync::MutexGuard<'_, RecorderHealth> {
        self.health.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn publish(&self, drive: &DriveWriter, busy_since_ns: u64, first_ns: Option<u64>) {
        let facts = drive.facts();
        let Space { free_bytes, .. } = facts.space;
        let oldest = drive.oldest_unsynced_ns();
        let mut health = self.health();
        health.disk_stall_s = facts.stall_ns as f64 / NS_PER_S as f64;
        health.disk_free_bytes = free_bytes;
        health.disk_free_percent = facts.space.free_percent();
        health.written_bytes = facts.written_bytes;
        health.segment.clear();
        if let Some(name) = drive.segment_name() {
            health.segment.push_str(&name.file(Part::Finished));
        }
        health.lost = facts.lost;
        health.disk = drive.disk();
        health.last_error.clone_from(&facts.last_error);
        health.busy_since_ns = busy_since_ns;
        health.oldest_unsynced_ns = [oldest, first_ns].into_iter().flatten().min();
    }
}

/// The writer thread.
fn record(shared: &Shared, mut drive: DriveWriter, to_mender: &mpsc::Sender<SegmentName>) -> RecorderReport {
    let mut batch: Vec<Queued> = Vec::with_capacity(BATCH);
    let mut going = true;
    while going {
        going = shared.queue.take(&mut batch, BATCH, TICK);
        shared.publish(&drive, shared.clock.monotonic_ns(), batch.first().map(|queued| queued.pushed_ns));
        if shared.mark.swap(false, Ordering::SeqCst) {
            drive.mark();
        }
        for queued in batch.drain(..) {
            drive.write(queued);
        }
        drive.tick();
        if !going {
            for loss in shared.queue.take_losses() {
                let pushed_ns = shared.clock.monotonic_ns();
                drive.write(Queued { entry: Entry::Lost(loss), pushed_ns, bytes: 0 });
            }
        }
        shared.queue.release(drive.take_released_bytes());
        for name in drive.take_abandoned() {
            shared.health().to_mend += 1;
            // Without a mender the next start does it.
            let _ = to_mender.send(name);
        }
        shared.publish(&drive, 0, None);
    }
    let is_complete = drive.finish();
    shared.queue.release(drive.take_released_bytes());
    shared.publish(&drive, 0, None);
    let (_, lost) = shared.queue.usage();
    let mut health = shared.health().clone();
    health.lost += lost;
    RecorderReport { is_complete, health }
}

/// The mending thread: at the lowest priority, and only while recording has time.
fn mend_all(shared: &Shared, storage: &dyn Storage, names: &mpsc::Receiver<SegmentName>) {
    // On Linux this is the priority of the thread. Without it mending only costs more.
    let _ = rustix::process::nice(19);
    let is_over = || shared.stop.load(Ordering::SeqCst);
    let mut waiting = VecDeque::new();
    while !is_over() {
        if waiting.is_empty() {
            let Ok(name) = names.recv() else { return };
            waiting.push_back(name);
        }
        waiting.extend(names.try_iter());
        let Some(name) = waiting.pop_front() else { continue };
        let mut pause = || loop {
            if is_over() {
                return Err(io::Error::other("the drive is over; the next start goes on"));
            }
            thread::sleep(MEND_PAUSE);
            if shared.queue.usage().0 < shared.queue.capacity_bytes() / BUSY_SHARE {
                return Ok(());
            }
        };
        match mend(storage, &name, &mut pause) {
            Ok(outcome) => {
                tell_mended(&name, &outcome);
                let mut health = shared.health();
                health.to_mend -= 1;
                health.mended += 1;
            }
            Err(error) => {
                warn!(segment = name.file(Part::Finished), %error, "segment could not be mended yet");
                waiting.push_back(name);
                let retry = Instant::now() + MEND_RETRY;
                while !is_over() && Instant::now() < retry {
                    thread::sleep(MEND_PAUSE);
                }
            }
        }
    }
}

fn tell_mended(name: &SegmentName, outcome: &Mended) {
    let segment = name.file(Part::Finished);
    match outcome {
        Mended::Finished(recovery) => {
            info!(segment, messages = recovery.messages, lost_bytes = recovery.lost_bytes, "segment mended");
        }
        Mended::WasWhole => info!(segment, "segment was whole, only its name was missing"),
        Mended::WasEmpty => info!(segment, "segment had nothing in it and is removed"),
        Mended::Unreadable => {
            warn!(segment = name.file(Part::Damaged), "nothing in a cut segment can be read; it is kept");
        }
    }
}
