//! Records a drive: from many producers to segments on a disk that may be slow, full, failing, or about to lose power.
//!
//! ```text
//! producers ─► queue (bounded, never waits) ─► writer thread ─► segments ─► finished segments
//!                                                                  └─ cut ─► mending thread ─┘
//! ```
//!
//! Only the writer thread and the mending thread touch the disk. `drive.rs` does the writer's work without a thread,
//! `segments.rs` writes one segment, `guard.rs` makes room except of what `marks.rs` keeps, `mend.rs` mends what a power
//! cut or a failing disk (`abandoned.rs`) left behind.

mod abandoned;
pub mod disk;
mod drive;
mod entry;
mod guard;
mod marks;
mod mend;
mod open_segment;
mod queue;
mod retry;
mod segments;
mod storage;
mod thread;

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

pub use drive::DriveWriter;
pub use entry::{Encoder, Entry, Loss};
pub use marks::{MARK_REQUEST, request_mark};
pub use mend::{Mended, cut_segments, mend};
pub use open_segment::PAIR_WAIT_NS;
pub use queue::{Queue, Queued};
pub use segments::{Head, Part, Segment, SegmentName};
pub use storage::{FileFacts, Folder, ReadSeek, SegmentFile, Space, Storage};
pub use thread::{Recorder, RecorderHandle, RecorderHealth, RecorderReport};

/// `[recorder]` of the configuration.
#[derive(Debug, Clone, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct Settings {
    /// Where segments go. It is made if it is not there.
    pub folder: PathBuf,
    /// What may wait for the disk. Seven seconds of 30 frames of 200 kB are 42 MB.
    #[serde(default = "default_queue_mib")]
    pub queue_mib: u64,
    /// A segment ends when it is this long or this large. A minute is short enough to be copied or lost alone.
    #[serde(default = "default_segment_s")]
    pub segment_s: u64,
    #[serde(default = "default_segment_mib")]
    pub segment_mib: u64,
    /// How long a message may wait to be written to the disk for good. With the time that takes, less than the second
    /// that a power cut may cost.
    #[serde(default = "default_sync_interval_ms")]
    pub sync_interval_ms: u64,
    /// When less than this is free, at most half of the disk, the oldest segments that are not marked are deleted.
    #[serde(default = "default_min_free_mib")]
    pub min_free_mib: u64,
    #[serde(default = "default_min_free_percent")]
    pub min_free_percent: f64,
}

fn default_queue_mib() -> u64 {
    64
}

fn default_segment_s() -> u64 {
    60
}

fn default_segment_mib() -> u64 {
    512
}

fn default_sync_interval_ms() -> u64 {
    500
}

fn default_min_free_mib() -> u64 {
    2048
}

fn default_min_free_percent() -> f64 {
    10.0
}

impl Settings {
    /// The defaults of every key but the folder.
    pub fn new(folder: impl Into<PathBuf>) -> Self {
        Self {
            folder: folder.into(),
            queue_mib: default_queue_mib(),
            segment_s: default_segment_s(),
            segment_mib: default_segment_mib(),
            sync_interval_ms: default_sync_interval_ms(),
            min_free_mib: default_min_free_mib(),
            min_free_percent: default_min_free_percent(),
        }
    }

    /// Refuses what cannot work: key, found, expected.
    pub fn check(&self) -> Result<(), String> {
        if self.folder.as_os_str().is_empty() {
            return Err("folder is empty, expected the folder that segments go to".into());
        }
        for (key, found, least, most) in [
            ("queue_mib", self.queue_mib, 8, 4096),
            ("segment_s", self.segment_s, 5, 3600),
            // FAT cannot hold a file of 4 GiB.
            ("segment_mib", self.segment_mib, 16, 4000),
            ("sync_interval_ms", self.sync_interval_ms, 50, 1000),
            ("min_free_mib", self.min_free_mib, 64, 1 << 20),
        ] {
            if !(least..=most).contains(&found) {
                return Err(format!("{key} is {found}, expected {least} to {most}"));
            }
        }
        if !(0.0..=90.0).contains(&self.min_free_percent) {
            return Err(format!("min_free_percent is {}, expected 0 to 90", self.min_free_percent));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn impossible_settings_are_refused_by_key() {
        let good = Settings::new("/data");
        assert_eq!(good.check(), Ok(()));
        for (key, bad) in [
            ("folder", Settings::new("")),
            ("queue_mib", Settings { queue_mib: 0, ..good.clone() }),
            ("segment_s", Settings { segment_s: 0, ..good.clone() }),
            ("segment_mib", Settings { segment_mib: 5000, ..good.clone() }),
            ("sync_interval_ms", Settings { sync_interval_ms: 1001, ..good.clone() }),
            ("min_free_mib", Settings { min_free_mib: 0, ..good.clone() }),
            ("min_free_percent", Settings { min_free_percent: f64::NAN, ..good.clone() }),
        ] {
            let message = bad.check().expect_err(key);
            assert!(message.starts_with(key) && message.contains("expected"), "{message}");
        }
    }
}
