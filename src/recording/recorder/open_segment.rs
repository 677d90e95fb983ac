//! A segment on the disk and what it still waits for.

use std::{
    collections::VecDeque,
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
};

use super::{
    entry::Entry,
    queue::Queued,
    segments::{Appender, Segment, SegmentName},
};
use crate::{recording::topics, types::NS_PER_S};

/// How long a segment that is no longer written to waits for pairs.
pub const PAIR_WAIT_NS: u64 = 5 * NS_PER_S;
/// How long it stays open after the last one: the pose follows its pair.
pub const LINGER_NS: u64 = NS_PER_S;

/// A segment that is written to or waits for pairs.
pub(super) struct OpenSegment {
    pub name: SegmentName,
    pub segment: Segment<Appender>,
    pub position: Arc<AtomicU64>,
    /// Position that the last sync reached.
    pub synced_bytes: u64,
    pub started_ns: u64,
    pub unsynced: VecDeque<Queued>,
    pub first_image: Option<u32>,
    pub last_image: Option<u32>,
    pub last_image_ns: u64,
    /// Frames whose pair has not come.
    pub awaiting: VecDeque<u32>,
    pub close_at_ns: u64,
}

impl OpenSegment {
    pub fn new(name: SegmentName, segment: Segment<Appender>, position: Arc<AtomicU64>, started_ns: u64) -> Self {
        Self {
            name,
            segment,
            synced_bytes: position.load(Ordering::Relaxed),
            position,
            started_ns,
            unsynced: VecDeque::new(),
            first_image: None,
            last_image: None,
            last_image_ns: 0,
            awaiting: VecDeque::new(),
            close_at_ns: 0,
        }
    }

    /// Takes down what an entry that was written says about frames and pairs.
    pub fn note(&mut self, entry: &Entry, now_ns: u64) {
        match entry {
            Entry::Image { sequence, .. } => {
                self.first_image = Some(self.first_image.map_or(*sequence, |first| first.min(*sequence)));
                self.last_image = self.last_image.max(Some(*sequence));
                self.last_image_ns = now_ns;
                self.awaiting.push_back(*sequence);
            }
            Entry::Message { topic, sequence, .. } if topic.name == topics::SURVEY_PAIR.name => {
                if let Some(at) = self.awaiting.iter().position(|frame| frame == sequence) {
                    self.awaiting.remove(at);
                    if self.awaiting.is_empty() {
                        self.close_at_ns = self.close_at_ns.min(now_ns + LINGER_NS);
                    }
                }
            }
            _ => {}
        }
    }
}
