//! The recorder with its threads: a slow disk, a full one, marks, and `kill -9`.

mod disk;
mod drive;

use std::{
    io::{self, BufRead, BufReader, Write},
    process::{Command, Stdio},
    sync::{Arc, Condvar, Mutex, PoisonError},
    thread,
    time::{Duration, Instant},
};

use disk::Disk;
use drive::{BOOT_ID, Drive, FRAME_NS, START, finished, jpeg, mend_all, random, read_segments, rounds, settings};
use omniloc::{
    recording::{
        proto::omniloc::{Dropped, SerialChunk, SurveyPair},
        recorder::{
            FileFacts, Folder, Head, MARK_REQUEST, ReadSeek, Recorder, RecorderHandle, SegmentFile, Settings, Space,
            Storage,
        },
        topics,
    },
    types::{Clock, ManualClock, NS_PER_S, SystemClock},
};
use prost::Message;
use rand::Rng;

/// No test should ever wait so long.
const GIVE_UP: Duration = Duration::from_secs(120);

fn wait_until(what: &str, mut is_so: impl FnMut() -> bool) {
    let started = Instant::now();
    while !is_so() {
        assert!(started.elapsed() < GIVE_UP, "{what} does not come");
        thread::sleep(Duration::from_millis(1));
    }
}

/// Holds every sync up while it is shut.
#[derive(Clone, Default)]
struct Gate(Arc<(Mutex<bool>, Condvar)>);

impl Gate {
    fn set_shut(&self, shut: bool) {
        *self.0.0.lock().unwrap_or_else(PoisonError::into_inner) = shut;
        self.0.1.notify_all();
    }

    fn pass(&self) {
        let guard = self.0.0.lock().unwrap_or_else(PoisonError::into_inner);
        drop(self.0.1.wait_while(guard, |shut| *shut));
    }
}

struct Gated {
    disk: Disk,
    gate: Gate,
}

struct GatedFile(Box<dyn SegmentFile>, Gate);

impl Write for GatedFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.0.write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.0.flush()
    }
}

impl SegmentFile for GatedFile {
    fn sync_data(&mut self) -> io::Result<()> {
        self.1.pass();
        self.0.sync_data()
    }

    fn set_len(&mut self, bytes: u64) -> io::Result<()> {
        self.0.set_len(bytes)
    }
}

impl Storage for Gated {
    fn create(&self, name: &str) -> io::Result<Box<dyn SegmentFile>> {
        Ok(Box::new(GatedFile(self.disk.create(name)?, self.gate.clone())))
    }
    fn open(&self, name: &str) -> io::Result<Box<dyn ReadSeek>> {
        self.disk.open(name)
    }
    fn rename(&self, from: &str, to: &str) -> io::Result<()> {
        self.disk.rename(from, to)
    }
    fn remove(&self, name: &str) -> io::Result<()> {
        self.disk.remove(name)
    }
    fn list(&self) -> io::Result<Vec<FileFacts>> {
        self.disk.list()
    }
    fn space(&self) -> io::Result<Space> {
        self.disk.space()
    }
    fn sync_folder(&self) -> io::Result<()> {
        self.disk.sync_folder()
    }
}

/// A vehicle at 30 frames of 200 kB a second.
struct Vehicle {
    handle: RecorderHandle,
    clock: Arc<ManualClock>,
    frame: u32,
    dropped: u64,
}

impl Vehicle {
    const FRAME_BYTES: usize = 200_000;

    fn drive(&mut self, seconds: u32) {
        for _ in 0..seconds * 30 {
            let (frame, now_ns) = (self.frame, self.clock.monotonic_ns());
            self.frame += 1;
            let chunk = SerialChunk { timestamp: Some(self.handle.timestamp(now_ns)), ..Default::default() };
            assert!(
                self.handle.push_message(&topics::GNSS_RAW, frame, now_ns, &chunk),
                "there is always room for this"
            );
            let jpeg = jpeg(frame, Self::FRAME_BYTES);
            self.dropped += u64::from(!self.handle.push_image(frame, now_ns, jpeg.into()));
            assert!(self.handle.push_pair(frame, now_ns, SurveyPair { valid: true, ..Default::default() }));
            self.clock.advance_ns(FRAME_NS);
        }
    }

    fn wait_until_synced(&self) {
        wait_until("the sync", || {
            self.clock.advance_ns(1_000_000);
            self.handle.health().queue_bytes == 0
        });
    }
}

/// Drives two seconds on a good disk, `stall_s` on one that does not answer, two on a good one.
fn stalled_drive(stall_s: u32) -> (Disk, Vehicle) {
    let (disk, gate) = (Disk::new(), Gate::default());
    let storage = Arc::new(Gated { disk: disk.clone(), gate: gate.clone() });
    let clock = Arc::new(ManualClock::new(START));
    let head = Head::new("", "test", BOOT_ID, START);
    let recorder = Recorder::start(Settings::new("/simulated"), head, BOOT_ID, storage, clock.clone()).expect("starts");
    let mut vehicle = Vehicle { handle: recorder.handle(), clock, frame: 0, dropped: 0 };
    vehicle.drive(2);
    vehicle.wait_until_synced();
    assert_eq!(vehicle.handle.health().disk, "ok");

    gate.set_shut(true);
    vehicle.drive(stall_s);
    wait_until("the stall", || vehicle.handle.health().disk == "slow");
    let health = vehicle.handle.health();
    assert!(health.disk_stall_s > 2.0 && health.unsynced_s > 2.0, "{health:?}");
    assert!(health.queue_bytes <= health.queue_capacity_bytes, "{health:?}");
    gate.set_shut(false);

    vehicle.wait_until_synced();
    vehicle.drive(2);
    let report = recorder.finish(GIVE_UP);
    assert!(report.is_complete, "{report:?}");
    assert_eq!(report.health.lost, vehicle.dropped);
    (disk, vehicle)
}

#[test]
fn a_stall_of_seven_seconds_loses_nothing() {
    let (disk, vehicle) = stalled_drive(7);
    assert_eq!(vehicle.dropped, 0);
    let names = disk.names();
    let found = read_segments(finished(&names).into_iter().map(|name| (name, disk.read(name))));
    let frames: Vec<u32> =
        found.iter().filter(|((topic, _), _)| topic == "/camera/image").map(|((_, frame), _)| *frame).collect();
    assert_eq!(frames, (0..vehicle.frame).collect::<Vec<_>>());
    assert!(found.iter().all(|((topic, _), _)| topic != "/dropped"));
}

#[test]
fn what_a_longer_stall_costs_is_in_the_recording() {
    let (disk, vehicle) = stalled_drive(15);
    assert!(vehicle.dropped > 0);
    let names = disk.names();
    let found = read_segments(finished(&names).into_iter().map(|name| (name, disk.read(name))));
    let count = |topic: &str| found.iter().filter(|((found, _), _)| found == topic).count() as u64;
    assert_eq!(count("/camera/image") + vehicle.dropped, u64::from(vehicle.frame));
    assert_eq!(count("/gnss/raw"), u64::from(vehicle.frame));
    assert_eq!(count("/survey/pair"), u64::from(vehicle.frame), "a pair is kept when its frame is not");
    let stated: Vec<Dropped> = found
        .iter()
        .filter(|((topic, _), _)| topic == "/dropped")
        .map(|(_, message)| Dropped::decode(message.payload.as_slice()).expect("decodes"))
        .collect();
    assert_eq!(stated.iter().map(|dropped| dropped.count).sum::<u64>(), vehicle.dropped);
    for dropped in &stated {
        assert_eq!((dropped.topic.as_str(), dropped.reason.as_str()), ("/camera/image", "queue full"));
        assert!(dropped.first_ns <= dropped.last_ns && dropped.first_ns > Some(START.monotonic_ns));
    }
}

#[test]
fn a_disk_that_never_answers_does_not_hold_up_the_end() {
    let (disk, gate) = (Disk::new(), Gate::default());
    gate.set_shut(true);
    let storage = Arc::new(Gated { disk, gate: gate.clone() });
    let clock = Arc::new(ManualClock::new(START));
    let head = Head::new("", "test", BOOT_ID, START);
    let recorder = Recorder::start(Settings::new("/simulated"), head, BOOT_ID, storage, clock).expect("starts");
    assert!(recorder.handle().push_image(0, START.monotonic_ns, jpeg(0, 100).into()));
    let report = recorder.finish(Duration::from_millis(20));
    assert!(!report.is_complete && report.health.queue_bytes > 0, "{report:?}");
    gate.set_shut(false);
}

/// A disk of 8 MiB, 3 MiB of which are to stay free.
fn small_disk() -> (Disk, Settings) {
    let disk = Disk::with_capacity(8 << 20);
    for stray in ["drive.mcap", "0123abcd-1.mcap", "notes.txt"] {
        disk.create(stray).expect("creates").write_all(&[1; 1000]).expect("writes");
    }
    (disk, Settings { min_free_mib: 3, ..settings() })
}

#[test]
fn the_oldest_unmarked_segments_make_room() {
    let (disk, settings) = small_disk();
    let mut drive = Drive::start(settings, Arc::new(disk.clone()), 10_000).expect("starts");
    for frame in 0..30 * 40 {
        drive.step();
        if frame == 30 * 3 {
            disk.create(MARK_REQUEST).expect("somebody asks for it");
        }
        let free_bytes = disk.space().expect("known").free_bytes;
        assert!(free_bytes >= 2 << 20, "frame {frame}: {free_bytes} bytes free");
    }
    assert_eq!(drive.writer.disk(), "ok");
    assert!(drive.finish());
    let names = disk.names();
    assert!(["drive.mcap", "0123abcd-1.mcap", "notes.txt"].iter().all(|stray| names.iter().any(|name| name == stray)));
    assert!(!names.iter().any(|name| name == MARK_REQUEST), "the request is done with");
    let marked: Vec<_> = names.iter().filter_map(|name| name.strip_suffix(".keep")).collect();
    assert_eq!(marked.len(), 2, "the present segment and the one before it: {names:?}");
    let numbers: Vec<u32> = finished(&names).iter().map(|name| name[9..15].parse().expect("a number")).collect();
    let marked: Vec<u32> = marked.iter().map(|name| name[9..15].parse().expect("a number")).collect();
    assert_eq!(numbers[..2], marked, "the marked ones are the oldest left");
    assert!(numbers.len() > 5 && numbers[2] > marked[1] + 5, "others went: {numbers:?}");
    assert!(numbers[2..].windows(2).all(|pair| pair[1] == pair[0] + 1), "from the oldest on: {numbers:?}");
}

#[test]
fn a_disk_full_of_marked_segments_is_reported_and_survived() {
    let (disk, settings) = small_disk();
    let mut drive = Drive::start(settings, Arc::new(disk.clone()), 10_000).expect("starts");
    let mut words = Vec::new();
    for frame in 0..30 * 40 {
        drive.step();
        if frame % 15 == 0 {
            drive.writer.mark();
        }
        if words.last() != Some(&drive.writer.disk()) {
            words.push(drive.writer.disk());
        }
    }
    assert_eq!(words, ["ok", "full"]);
    let kept = finished(&disk.names()).len();
    // Somebody makes room.
    let names = disk.names();
    let oldest = finished(&names)[0];
    for file in [oldest.to_owned(), oldest.replace(".mcap", ".keep")] {
        disk.remove(&file).expect("removes");
    }
    drive.clock.advance_ns(10 * NS_PER_S);
    drive.tick();
    let space = disk.space().expect("known");
    assert!(space.free_bytes < 3 << 20, "it records what fits: {space:?}");
    assert!(finished(&disk.names()).len() + 1 >= kept, "marked ones stay");
}

const KILL_FOLDER: &str = "OMNILOC_TEST_KILL_FOLDER";

/// Not a test: the program that is killed. Records in bursts and says after each how many frames are on the disk.
#[test]
fn program_that_is_killed() {
    let Some(folder) = std::env::var_os(KILL_FOLDER) else { return };
    let clock = Arc::new(SystemClock);
    let head = Head::new("", "test", BOOT_ID, clock.read());
    let storage = Arc::new(Folder::new(folder.as_ref()).expect("the folder is there"));
    let settings = Settings { sync_interval_ms: 5, segment_s: 0, min_free_mib: 0, min_free_percent: 0.0, ..settings() };
    let recorder = Recorder::start(settings, head, BOOT_ID, storage, clock.clone()).expect("starts");
    let handle = recorder.handle();
    for burst in 0u32.. {
        for frame in burst * 5..burst * 5 + 5 {
            let stamp_ns = clock.monotonic_ns();
            assert!(handle.push_image(frame, stamp_ns, jpeg(frame, 30_000).into()));
            assert!(handle.push_pair(frame, stamp_ns, SurveyPair { valid: true, ..Default::default() }));
        }
        wait_until("the sync", || handle.health().queue_bytes == 0);
        println!("synced {}", burst * 5 + 5);
    }
}

#[test]
fn kill_9_loses_nothing_that_was_synced() {
    for round in 0..rounds(10).min(10_000) {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let mut child = Command::new(std::env::current_exe().expect("this program"))
            .args(["program_that_is_killed", "--exact", "--nocapture", "--test-threads=1"])
            .env(KILL_FOLDER, folder.path())
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .expect("starts");
        let mut random = random(round);
        let (bursts, after_us) = (random.random_range(1..20), random.random_range(0..15_000));
        let mut lines = BufReader::new(child.stdout.take().expect("piped")).lines();
        let number = |line: &str| line.split_once("synced ").and_then(|(_, count)| count.parse::<u32>().ok());
        let mut synced = 0;
        for _ in 0..bursts {
            let line = lines.by_ref().find_map(|line| number(&line.expect("readable")));
            synced = line.expect("it runs until it is killed");
        }
        thread::sleep(Duration::from_micros(after_us));
        child.kill().expect("SIGKILL");
        child.wait().expect("ends");
        for line in lines {
            synced = number(&line.unwrap_or_default()).unwrap_or(synced);
        }

        let storage = Folder::new(folder.path()).expect("the lock went with the process");
        mend_all(&storage).expect("mends");
        let names: Vec<String> = storage.list().expect("readable").into_iter().map(|file| file.name).collect();
        let contents = |name: &str| std::fs::read(folder.path().join(name)).expect("readable");
        let found = read_segments(finished(&names).into_iter().map(|name| (name, contents(name))));
        let mut frames = Vec::new();
        for ((topic, frame), message) in &found {
            if topic == "/camera/image" {
                assert!(message.payload == jpeg(*frame, 30_000), "round {round}: frame {frame} is damaged");
                frames.push(*frame);
            }
        }
        frames.sort();
        assert!(frames.len() as u32 >= synced, "round {round}: {synced} synced, {frames:?} found");
        assert_eq!(frames, (0..frames.len() as u32).collect::<Vec<_>>(), "round {round}");
        assert!(names.iter().all(|name| name.ends_with(".mcap")), "round {round}: {names:?}");
    }
}

#[test]
fn the_next_start_mends_what_the_last_left_cut() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let path = folder.path().join("0123abcd-000007.mcap.part");
    let whole = {
        let disk = Disk::new();
        let mut drive = Drive::start(settings(), Arc::new(disk.clone()), 5000).expect("starts");
        (0..20).for_each(|_| drive.step());
        assert!(drive.finish());
        let names = disk.names();
        disk.read(finished(&names)[0])
    };
    std::fs::write(&path, &whole[..whole.len() * 2 / 3]).expect("writes");
    let clock = Arc::new(SystemClock);
    let head = Head::new("", "test", BOOT_ID, clock.read());
    let storage = Arc::new(Folder::new(folder.path()).expect("a folder"));
    let settings = Settings { min_free_mib: 0, min_free_percent: 0.0, ..Settings::new(folder.path()) };
    let recorder = Recorder::start(settings, head, BOOT_ID, storage, clock.clone()).expect("starts");
    assert!(recorder.handle().push_image(0, clock.monotonic_ns(), jpeg(0, 100).into()));
    wait_until("the mending", || recorder.handle().health().mended == 1);
    assert!(recorder.finish(GIVE_UP).is_complete);
    let mut names: Vec<_> =
        std::fs::read_dir(folder.path()).expect("readable").map(|entry| entry.expect("readable").file_name()).collect();
    names.sort();
    assert_eq!(names, ["0123abcd-000007.mcap", "0123abcd-000008.mcap"], "and numbers go on");
    let found =
        read_segments([("a.mcap", std::fs::read(folder.path().join("0123abcd-000007.mcap")).expect("readable"))]);
    assert!(found.len() > 10);
}
