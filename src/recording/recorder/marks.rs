//! Marks: segments that are never deleted to make room.

use std::{fs::File, io, path::Path};

use rustix::{
    fs::{FlockOperation, flock},
    io::Errno,
};
use tracing::{info, warn};

use super::{
    segments::{Part, SegmentName},
    storage::Storage,
};

/// A file of this name in the folder asks for the present segment to be marked: `omniloc mark`.
pub const MARK_REQUEST: &str = "mark.request";

/// Asks the recorder that writes to this folder to keep its present segment. `false`: there is none.
pub fn request_mark(folder: &Path) -> io::Result<bool> {
    let lock = flock(&File::open(folder)?, FlockOperation::NonBlockingLockExclusive);
    if lock != Err(Errno::WOULDBLOCK) {
        return Ok(false);
    }
    File::create(folder.join(MARK_REQUEST))?;
    Ok(true)
}

/// Whether a mark was asked for since the last call.
pub fn take_request(storage: &dyn Storage) -> bool {
    storage.open(MARK_REQUEST).is_ok() && storage.remove(MARK_REQUEST).is_ok()
}

/// Segments that want to be marked; written as soon as the disk takes them.
#[derive(Debug, Default)]
pub struct Marks {
    wanted: Vec<SegmentName>,
}

impl Marks {
    /// Marks the segment `current` and the one before it.
    pub fn want(&mut self, current: SegmentName, storage: &dyn Storage) {
        let files = storage.list().unwrap_or_default();
        let names = files.into_iter().filter_map(|file| SegmentName::parse(&file.name));
        let is_before = |(name, part): &(SegmentName, Part)| name.number < current.number && *part != Part::Keep;
        self.wanted.extend(names.filter(is_before).map(|(name, _)| name).max());
        self.wanted.push(current);
        self.write(storage);
    }

    /// Writes the marks that are wanted, or as many as the disk takes: the rest stays wanted.
    pub fn write(&mut self, storage: &dyn Storage) {
        let Some(first) = self.wanted.first() else { return };
        let outcome = self.wanted.iter().try_for_each(|name| match storage.create(&name.file(Part::Keep)) {
            Err(error) if error.kind() != io::ErrorKind::AlreadyExists => Err(error),
            _ => Ok(()),
        });
        match outcome.and_then(|()| storage.sync_folder()) {
            Ok(()) => {
                info!(from = first.file(Part::Finished), "segments marked to be kept");
                self.wanted.clear();
            }
            Err(error) => warn!(%error, "segments could not be marked yet"),
        }
    }
}
