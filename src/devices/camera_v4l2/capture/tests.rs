//! The fault table, on a queue that obeys the rules of V4L2 and knows no kernel.

use std::collections::{BTreeSet, VecDeque};

use super::*;
use crate::{
    devices::{mjpeg, yuyv::YuyvFormat},
    jpeg::{scan, standard_huffman_segment},
    types::{ClockReading, ManualClock},
};

const MS: u64 = 1_000_000;
const BUFFERS: u32 = 4;

/// What the driver does next.
enum Step {
    Frame(Filled, Vec<u8>),
    /// No frame for so long; `wait` returns as often as that takes.
    Silence {
        ms: u64,
    },
    WaitFails(Errno),
    DequeueFails(Errno),
    Hangup(Errno),
    EnqueueFails(Errno),
}

struct FakeQueue<'a> {
    steps: VecDeque<Step>,
    clock: &'a ManualClock,
    stop: &'a Stop,
    bytes: Vec<u8>,
    ours: BTreeSet<u32>,
    enqueue_fails: Option<Errno>,
}

impl CaptureQueue for FakeQueue<'_> {
    fn wait(&mut self, at_most: Duration) -> Result<Waited, Errno> {
        if let Some(Step::EnqueueFails(_)) = self.steps.front()
            && let Some(Step::EnqueueFails(errno)) = self.steps.pop_front()
        {
            self.enqueue_fails = Some(errno);
        }
        match self.steps.front_mut() {
            Some(Step::Frame(..) | Step::DequeueFails(_)) => {
                self.clock.advance_ns(33 * MS);
                Ok(Waited::Ready)
            }
            Some(Step::Silence { ms }) => {
                let waited_ms = (*ms).min(at_most.as_millis() as u64);
                *ms -= waited_ms;
                let over = *ms == 0;
                self.clock.advance_ns(waited_ms * MS);
                if over {
                    self.steps.pop_front();
                }
                Ok(Waited::Nothing)
            }
            Some(Step::WaitFails(errno)) => {
                let errno = *errno;
                self.steps.pop_front();
                Err(errno)
            }
            Some(Step::Hangup(_)) => Ok(Waited::Gone),
            Some(Step::EnqueueFails(_)) => unreachable!("taken above"),
            None => {
                self.stop.stop();
                Ok(Waited::Nothing)
            }
        }
    }

    fn dequeue(&mut self) -> Result<Filled, Errno> {
        match self.steps.pop_front() {
            Some(Step::Frame(filled, bytes)) => {
                assert!(self.ours.insert(filled.index), "buffer {} was not the driver's", filled.index);
                self.bytes = bytes;
                Ok(filled)
            }
            Some(Step::DequeueFails(errno) | Step::Hangup(errno)) => Err(errno),
            _ => panic!("dequeued without being ready"),
        }
    }

    fn bytes(&self, filled: &Filled) -> &[u8] {
        assert!(self.ours.contains(&filled.index));
        &self.bytes
    }

    fn enqueue(&mut self, index: u32) -> Result<(), Errno> {
        assert!(self.ours.remove(&index), "buffer {index} was the driver's already");
        self.enqueue_fails.take().map_or(Ok(()), Err)
    }
}

fn picture() -> Vec<u8> {
    let mut jpeg = Vec::new();
    let luma: Vec<u8> = (0..64 * 48).map(|i| (i * 31 % 253) as u8).collect();
    jpeg_encoder::Encoder::new(&mut jpeg, 90).encode(&luma, 64, 48, jpeg_encoder::ColorType::Luma).expect("encodes");
    jpeg
}

/// The n-th step of a healthy camera, if steps take 33 ms.
fn filled(sequence: u32) -> Filled {
    let stamp = DriverStamp { ns: (1000 + 33 * u64::from(sequence)) * MS, monotonic: true, start_of_exposure: true };
    Filled { index: sequence % BUFFERS, bytes_used: 0, sequence, stamp, marked_damaged: false }
}

fn frame(sequence: u32) -> Step {
    Step::Frame(filled(sequence), picture())
}

struct Outcome {
    events: Vec<CameraEvent>,
    ended: Result<(), DeviceError>,
}

impl Outcome {
    fn frames(&self) -> Vec<&CameraFrame> {
        let frames = self.events.iter().filter_map(|event| match event {
            CameraEvent::Frame(frame) => Some(frame),
            _ => None,
        });
        frames.collect()
    }

    fn sequences(&self) -> Vec<u32> {
        self.frames().iter().map(|frame| frame.sequence).collect()
    }

    fn lost(&self) -> Vec<(u64, &'static str)> {
        let lost = self.events.iter().filter_map(|event| match event {
            CameraEvent::Lost(lost) => Some((lost.count, lost.reason)),
            _ => None,
        });
        lost.collect()
    }
}

fn run_with(converter: Converter, steps: Vec<Step>) -> Outcome {
    let clock = ManualClock::new(ClockReading { monotonic_ns: 1050 * MS, realtime_ns: 0 });
    let stop = Stop::default();
    let mut queue = FakeQueue {
        steps: steps.into(),
        clock: &clock,
        stop: &stop,
        bytes: Vec::new(),
        ours: BTreeSet::new(),
        enqueue_fails: None,
    };
    let capture = Capture {
        device: "/dev/video7".into(),
        frame_timeout: Duration::from_millis(2000),
        buffers: BUFFERS,
        converter,
    };
    let mut events = Vec::new();
    let ended = capture.run(&mut queue, &clock, &stop, &mut |event| events.push(event));
    assert!(queue.ours.is_empty(), "every buffer was given back");
    Outcome { events, ended }
}

fn run(steps: Vec<Step>) -> Outcome {
    run_with(Converter::Mjpeg(MjpegMender::new(64, 48)), steps)
}

#[test]
fn healthy_camera_gives_whole_stamped_frames() {
    let outcome = run((0..20).map(frame).collect());
    assert!(outcome.ended.is_ok());
    assert_eq!(outcome.sequences(), (0..20).collect::<Vec<_>>());
    for frame in outcome.frames() {
        assert_eq!(frame.damage, None);
        assert_eq!(*frame.jpeg, picture());
        assert_eq!(frame.stamp_ns, filled(frame.sequence).stamp.ns, "the driver's stamp is taken");
        assert!(frame.arrival_ns > frame.stamp_ns);
    }
    assert_eq!(outcome.lost(), []);
}

#[test]
fn silent_camera_is_reported_after_the_timeout() {
    let outcome = run(vec![frame(0), Step::Silence { ms: 5000 }]);
    assert_eq!(outcome.sequences(), [0]);
    match outcome.ended {
        Err(DeviceError::TimedOut { silence_s, .. }) => assert!((2.0..2.11).contains(&silence_s), "{silence_s}"),
        other => panic!("{other:?}"),
    }
}

#[test]
fn shorter_silence_is_endured() {
    let outcome = run(vec![frame(0), Step::Silence { ms: 1900 }, frame(1)]);
    assert!(outcome.ended.is_ok());
    assert_eq!(outcome.sequences(), [0, 1]);
}

#[test]
fn unplugging_is_disconnection_however_it_shows() {
    let table: [(&str, Vec<Step>); 6] = [
        ("ENODEV from DQBUF", vec![frame(0), Step::DequeueFails(Errno::NODEV)]),
        ("ENODEV from poll", vec![frame(0), Step::WaitFails(Errno::NODEV)]),
        ("ENODEV from QBUF", vec![Step::EnqueueFails(Errno::NODEV), frame(0)]),
        ("POLLHUP and ENODEV", vec![frame(0), Step::Hangup(Errno::NODEV)]),
        ("POLLERR and EINVAL", vec![frame(0), Step::Hangup(Errno::INVAL)]),
        ("POLLERR and EAGAIN", vec![frame(0), Step::Hangup(Errno::AGAIN)]),
    ];
    for (name, steps) in table {
        let outcome = run(steps);
        assert!(matches!(outcome.ended, Err(DeviceError::Disconnected { .. })), "{name}: {:?}", outcome.ended);
    }
}

#[test]
fn passing_errors_are_endured_and_read_errors_counted() {
    let outcome = run(vec![
        frame(0),
        Step::WaitFails(Errno::INTR),
        Step::DequeueFails(Errno::INTR),
        Step::DequeueFails(Errno::AGAIN),
        frame(1),
        // The driver counted the frame that it failed to read, and skipped another.
        Step::DequeueFails(Errno::IO),
        frame(4),
        // Here it counted none.
        Step::DequeueFails(Errno::IO),
        frame(5),
    ]);
    assert!(outcome.ended.is_ok());
    assert_eq!(outcome.sequences(), [0, 1, 4, 5]);
    assert_eq!(outcome.lost(), [(1, READ_ERROR), (1, SKIPPED), (1, READ_ERROR)]);
}

#[test]
fn read_errors_for_ever_are_silence() {
    let steps = (0..100).map(|_| Step::DequeueFails(Errno::IO)).collect();
    let outcome = run(steps);
    assert!(matches!(outcome.ended, Err(DeviceError::TimedOut { .. })), "{:?}", outcome.ended);
    assert_eq!(outcome.lost().len(), 1);
}

#[test]
fn other_errors_end_the_run() {
    let outcome = run(vec![frame(0), Step::DequeueFails(Errno::INVAL)]);
    assert_eq!(outcome.ended.expect_err("ends").health(), "failed");
    let outcome = run(vec![Step::EnqueueFails(Errno::INVAL), frame(0)]);
    assert_eq!(outcome.ended.expect_err("ends").health(), "failed");
}

#[test]
fn gaps_are_losses_also_across_the_wrap() {
    let outcome = run(vec![
        Step::Frame(Filled { sequence: u32::MAX - 1, ..filled(0) }, picture()),
        Step::Frame(Filled { sequence: 2, ..filled(1) }, picture()),
        Step::Frame(Filled { sequence: 3, ..filled(2) }, picture()),
        Step::Frame(Filled { sequence: 13, ..filled(3) }, picture()),
    ]);
    assert_eq!(outcome.sequences(), [u32::MAX - 1, 2, 3, 13]);
    assert_eq!(outcome.lost(), [(3, SKIPPED), (9, SKIPPED)]);
}

#[test]
fn empty_buffers_are_losses_and_no_sign_of_life() {
    let empty = |sequence| Step::Frame(filled(sequence), Vec::new());
    let outcome = run(vec![frame(0), empty(1), frame(2)]);
    assert_eq!(outcome.sequences(), [0, 2]);
    assert_eq!(outcome.lost(), [(1, EMPTY)]);
    let outcome = run((0..100).map(empty).collect());
    assert!(matches!(outcome.ended, Err(DeviceError::TimedOut { .. })), "{:?}", outcome.ended);
}

#[test]
fn damaged_frames_are_kept_and_flagged() {
    let whole = picture();
    let cut = whole[..whole.len() / 2].to_vec();
    let outcome = run(vec![
        // What was in the camera's memory when it was switched on.
        Step::Frame(filled(0), vec![0xAB; 3000]),
        Step::Frame(Filled { marked_damaged: true, ..filled(1) }, whole),
        Step::Frame(filled(2), cut),
        frame(3),
    ]);
    let damage: Vec<_> = outcome.frames().iter().map(|frame| frame.damage).collect();
    assert_eq!(damage, [Some(mjpeg::NO_START), Some(mjpeg::MARKED_BY_DRIVER), Some(mjpeg::NO_END), None]);
    assert_eq!(outcome.lost(), []);
}

#[test]
fn impossible_stamps_become_arrivals_less_the_usual_delay() {
    let stamped = |sequence, ns| {
        let stamp = DriverStamp { ns, ..filled(0).stamp };
        Step::Frame(Filled { stamp, ..filled(sequence) }, picture())
    };
    let outcome = run(vec![frame(0), stamped(1, 1000 * MS), stamped(2, 900_000 * MS), frame(3)]);
    let stamps: Vec<_> = outcome.frames().iter().map(|frame| frame.stamp_ns).collect();
    assert_eq!(stamps, [0, 1, 2, 3].map(|sequence| filled(sequence).stamp.ns));
}

#[test]
fn tables_are_inserted_on_the_way() {
    let mut bare = picture();
    while let Some(at) = bare.windows(2).position(|pair| pair == [0xFF, 0xC4]) {
        let length = usize::from(u16::from_be_bytes([bare[at + 2], bare[at + 3]]));
        bare.drain(at..at + 2 + length);
    }
    let outcome = run(vec![Step::Frame(filled(0), bare.clone())]);
    let jpeg = &outcome.frames()[0].jpeg;
    assert!(scan(jpeg).expect("a whole image").has_huffman_tables);
    assert_eq!(jpeg.len(), bare.len() + standard_huffman_segment().len());
}

#[test]
fn raw_frames_become_jpeg() {
    let format = YuyvFormat { width_px: 64, height_px: 48, bytes_per_line: 128, full_range: false };
    let encoder = YuyvEncoder::new(format, 90).expect("a possible format");
    let outcome = run_with(
        Converter::Yuyv(encoder.into(), Vec::new()),
        vec![
            Step::Frame(filled(0), vec![128; 128 * 48]),
            Step::Frame(filled(1), vec![128; 128 * 20]),
            Step::Frame(filled(2), Vec::new()),
        ],
    );
    let frames = outcome.frames();
    assert_eq!(frames.iter().map(|frame| frame.damage).collect::<Vec<_>>(), [None, Some("incomplete image")]);
    assert!(frames.iter().all(|frame| scan(&frame.jpeg).is_ok_and(|info| info.width_px == 64)));
    assert_eq!(outcome.lost(), [(1, EMPTY)]);
}

#[test]
fn a_stop_is_obeyed_while_frames_flow() {
    let clock = ManualClock::new(ClockReading { monotonic_ns: 1050 * MS, realtime_ns: 0 });
    let stop = Stop::default();
    let mut queue = FakeQueue {
        steps: (0..100).map(frame).collect(),
        clock: &clock,
        stop: &stop,
        bytes: Vec::new(),
        ours: BTreeSet::new(),
        enqueue_fails: None,
    };
    let capture = Capture {
        device: "/dev/video7".into(),
        frame_timeout: Duration::from_millis(2000),
        buffers: BUFFERS,
        converter: Converter::Mjpeg(MjpegMender::new(64, 48)),
    };
    let mut frames = 0;
    let ended = capture.run(&mut queue, &clock, &stop, &mut |_| {
        frames += 1;
        if frames == 3 {
            stop.stop();
        }
    });
    assert!(ended.is_ok());
    assert_eq!(frames, 3);
}
