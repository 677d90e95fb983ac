//! What is recorded, one message at a time.

use std::collections::BTreeMap;

use prost::Message;

use crate::{
    recording::{
        estimate::estimate_messages,
        proto::omniloc,
        topics::{self, Topic},
        writer::{survey_messages, timestamp},
    },
    types::{BufferPool, PooledBytes, PositionEstimate},
};

/// One thing to be recorded.
#[derive(Debug)]
pub enum Entry {
    /// A frame. Sequence numbers grow over the whole drive, also when the camera starts its own count again.
    Image {
        sequence: u32,
        stamp_ns: u64,
        jpeg: PooledBytes,
    },
    /// A message that is encoded already, see [`Encoder`]. `sequence` is the frame's number where it belongs to one.
    Message {
        topic: &'static Topic,
        sequence: u32,
        stamp_ns: u64,
        payload: PooledBytes,
    },
    /// Facts that hold from now on, such as the origin: written now and at the start of every later segment.
    Facts {
        name: &'static str,
        entries: BTreeMap<String, String>,
    },
    Lost(Loss),
}

/// Messages of one topic that were lost one after the other.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Loss {
    pub topic: &'static Topic,
    /// A short fixed phrase.
    pub reason: &'static str,
    pub count: u64,
    /// Stamps of the first and the last.
    pub first_ns: u64,
    pub last_ns: u64,
}

impl Loss {
    pub fn one(topic: &'static Topic, reason: &'static str, stamp_ns: u64) -> Self {
        Self { topic, reason, count: 1, first_ns: stamp_ns, last_ns: stamp_ns }
    }

    pub fn extend(&mut self, stamp_ns: u64) {
        self.count += 1;
        self.first_ns = self.first_ns.min(stamp_ns);
        self.last_ns = self.last_ns.max(stamp_ns);
    }

    /// The message on `/dropped`, stamped with the last loss.
    pub(super) fn message(&self, timestamp: prost_types::Timestamp) -> omniloc::Dropped {
        omniloc::Dropped {
            timestamp: Some(timestamp),
            topic: self.topic.name.into(),
            count: self.count,
            reason: self.reason.into(),
            first_ns: Some(self.first_ns),
            last_ns: Some(self.last_ns),
        }
    }
}

impl Entry {
    /// Where it belongs and when it was, if it is a message.
    pub(super) fn topic_and_stamp(&self) -> Option<(&'static Topic, u64)> {
        match self {
            Self::Image { stamp_ns, .. } => Some((&topics::CAMERA_IMAGE, *stamp_ns)),
            Self::Message { topic, stamp_ns, .. } => Some((topic, *stamp_ns)),
            Self::Facts { .. } => None,
            Self::Lost(loss) => Some((&topics::DROPPED, loss.last_ns)),
        }
    }

    /// The frame that a pair, a pose or an estimate belongs to.
    pub(super) fn pair_of_frame(&self) -> Option<u32> {
        match self {
            Self::Message { topic, sequence, .. } => {
                topics::OF_FRAMES.iter().any(|of_frame| of_frame.name == topic.name).then_some(*sequence)
            }
            _ => None,
        }
    }

    /// Memory it takes.
    pub(super) fn bytes(&self) -> usize {
        size_of::<Self>()
            + match self {
                Self::Image { jpeg, .. } => jpeg.len(),
                Self::Message { payload, .. } => payload.len(),
                Self::Facts { entries, .. } => entries.iter().map(|(key, value)| key.len() + value.len()).sum(),
                Self::Lost(_) => 0,
            }
    }
}

/// Makes entries of messages, with the timestamps that viewers want.
#[derive(Debug, Clone)]
pub struct Encoder {
    log_offset_ns: u64,
    pool: BufferPool,
}

impl Encoder {
    /// `log_offset_ns`: see [`Head`](super::Head).
    pub fn new(log_offset_ns: u64) -> Self {
        Self { log_offset_ns, pool: BufferPool::default() }
    }

    /// The protobuf timestamp of a stamp on the monotonic clock.
    pub fn timestamp(&self, stamp_ns: u64) -> prost_types::Timestamp {
        timestamp(stamp_ns.saturating_add(self.log_offset_ns))
    }

    /// A message whose timestamp is [`timestamp`](Self::timestamp) of the stamp.
    pub fn message(&self, topic: &'static Topic, sequence: u32, stamp_ns: u64, message: &impl Message) -> Entry {
        let mut payload = self.pool.take();
        message.encode(&mut *payload).expect("a vector grows as needed");
        Entry::Message { topic, sequence, stamp_ns, payload }
    }

    /// Where the vehicle was at frame `sequence`: the pair and, if it is valid, the pose for viewers. Timestamp and frame
    /// number are filled in.
    pub fn pair(&self, sequence: u32, stamp_ns: u64, pair: omniloc::SurveyPair) -> (Entry, Option<Entry>) {
        let (pair, pose) = survey_messages(self.timestamp(stamp_ns), sequence, pair);
        let pose = pose.map(|pose| self.message(&topics::SURVEY_POSE, sequence, stamp_ns, &pose));
        (self.message(&topics::SURVEY_PAIR, sequence, stamp_ns, &pair), pose)
    }

    /// Where the localizer takes the vehicle to be and, if that may be relied on, the pose for viewers.
    pub fn estimate(&self, estimate: &PositionEstimate) -> (Entry, Option<Entry>) {
        let PositionEstimate { sequence, stamp_ns, .. } = *estimate;
        let (message, pose) = estimate_messages(self.timestamp(stamp_ns), estimate);
        let pose = pose.map(|pose| self.message(&topics::SURVEY_POSE, sequence, stamp_ns, &pose));
        (self.message(&topics::POSE_ESTIMATE, sequence, stamp_ns, &message), pose)
    }
}
