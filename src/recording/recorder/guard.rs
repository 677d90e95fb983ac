//! Keeps room on the disk: the oldest segments go first, marked ones never.

use std::{collections::BTreeSet, io};

use tracing::warn;

use super::{
    Settings,
    segments::{Part, SegmentName},
    storage::{FileFacts, Space, Storage},
};

/// How much is to stay free.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Guard {
    pub min_free_bytes: u64,
    pub min_free_percent: f64,
}

impl Guard {
    /// What `settings` want on a disk of this size, at most half of it: a guard that can never be content would delete
    /// one segment after the other.
    pub fn new(settings: &Settings, space: Space) -> Self {
        let wanted_bytes = settings.min_free_mib << 20;
        let half_bytes = match space.total_bytes {
            0 => u64::MAX, // unknown
            total_bytes => total_bytes / 2,
        };
        Self { min_free_bytes: wanted_bytes.min(half_bytes), min_free_percent: settings.min_free_percent }
    }

    pub fn warn_if_less_than(&self, settings: &Settings) {
        if self.min_free_bytes < settings.min_free_mib << 20 {
            warn!(
                "min_free_mib = {} is more than half of the disk; {} MiB are kept free",
                settings.min_free_mib,
                self.min_free_bytes >> 20
            );
        }
    }

    pub fn is_low(&self, space: Space) -> bool {
        space.free_bytes < self.min_free_bytes || space.free_percent() < self.min_free_percent
    }
}

/// Deletes one segment. `None`: nothing may be deleted.
///
/// One at a time: deleting a large file takes as long as a slow write, and the queue must not fill up meanwhile.
pub(super) fn delete_oldest(storage: &dyn Storage) -> io::Result<Option<FileFacts>> {
    let Some(oldest) = oldest_unmarked(storage.list()?) else { return Ok(None) };
    storage.remove(&oldest.name)?;
    Ok(Some(oldest))
}

/// Finished and unreadable segments only: not what is being written or mended, and no file of anybody else.
fn oldest_unmarked(files: Vec<FileFacts>) -> Option<FileFacts> {
    let ours: Vec<_> = files
        .into_iter()
        .filter_map(|facts| SegmentName::parse(&facts.name).map(|(name, part)| (name, part, facts)))
        .collect();
    let marked: BTreeSet<SegmentName> =
        ours.iter().filter(|(_, part, _)| *part == Part::Keep).map(|(name, ..)| name.clone()).collect();
    let may_go = |(name, part, _): &(SegmentName, Part, FileFacts)| {
        matches!(part, Part::Finished | Part::Damaged) && !marked.contains(name)
    };
    ours.into_iter().filter(may_go).min_by(|a, b| a.0.cmp(&b.0)).map(|(.., facts)| facts)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn room_is_short_by_bytes_or_by_percent() {
        let guard = Guard { min_free_bytes: 2000, min_free_percent: 10.0 };
        for (free_bytes, total_bytes, low) in
            [(5000, 10_000, false), (1999, 10_000, true), (2000, 10_000, false), (2000, 40_000, true), (0, 0, true)]
        {
            assert_eq!(guard.is_low(Space { free_bytes, total_bytes }), low, "{free_bytes} of {total_bytes}");
        }
    }

    #[test]
    fn more_than_half_of_the_disk_is_never_wanted() {
        let settings = Settings { min_free_mib: 100, min_free_percent: 10.0, ..Settings::new("/data") };
        let of_disk = |total_mib: u64| {
            Guard::new(&settings, Space { free_bytes: 0, total_bytes: total_mib << 20 }).min_free_bytes >> 20
        };
        assert_eq!([1000, 201, 150, 0].map(of_disk), [100, 100, 75, 100]);
    }

    #[test]
    fn oldest_goes_first_and_what_is_marked_open_or_not_ours_stays() {
        let names = [
            "bbbbbbbb-000004.mcap",
            "ffffffff-000001.mcap",
            "ffffffff-000001.keep",
            "cccccccc-000002.mcap.part",
            "cccccccc-000000.mcap.mending",
            "aaaaaaaa-000003.mcap.damaged",
            "drive.mcap",
            "aaaaaaaa-1.mcap",
        ];
        let mut files: Vec<FileFacts> = names.map(|name| FileFacts { name: name.into(), bytes: 1 }).into();
        let mut deleted = Vec::new();
        while let Some(oldest) = oldest_unmarked(files.clone()) {
            files.retain(|file| *file != oldest);
            deleted.push(oldest.name);
        }
        assert_eq!(deleted, ["aaaaaaaa-000003.mcap.damaged", "bbbbbbbb-000004.mcap"]);
    }
}
