//! Mends the segments that a power cut or a failing disk left behind.

use std::{
    io::{self, Read, Seek, SeekFrom, Write},
    path::Path,
};

use super::{
    segments::{Appender, Part, SegmentName},
    storage::Storage,
};
use crate::recording::{
    recover::{self, Recovery, StreamError},
    verify::verify_reader,
};

/// What became of a segment.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Mended {
    /// Only its name was missing.
    WasWhole,
    /// All that could be read is in the finished segment.
    Finished(Recovery),
    /// There was no message in it and nothing that could have been one.
    WasEmpty,
    /// Nothing in it could be read; it is kept as `.damaged`.
    Unreadable,
}

/// Cut segments in the folder, oldest first; also those of which only the copy is left that a mending made.
pub fn cut_segments(storage: &dyn Storage) -> io::Result<Vec<SegmentName>> {
    let parsed = storage.list()?.into_iter().filter_map(|file| SegmentName::parse(&file.name));
    let is_cut = |part: Part| matches!(part, Part::Open | Part::Mending);
    let mut names: Vec<_> = parsed.filter(|(_, part)| is_cut(*part)).map(|(name, _)| name).collect();
    names.sort();
    names.dedup();
    Ok(names)
}

/// Turns a cut segment into a finished one. It may be interrupted at any point and be done again: the cut segment is
/// removed only when the finished one holds all that could be read from it, was read back, and is on the disk.
///
/// `before_read` is called about once a MiB; its error ends the mending.
pub fn mend(
    storage: &dyn Storage,
    name: &SegmentName,
    before_read: &mut dyn FnMut() -> io::Result<()>,
) -> io::Result<Mended> {
    let [open, finished, mending] = [Part::Open, Part::Finished, Part::Mending].map(|part| name.file(part));
    if is_whole(storage, &finished)? {
        // The power went after the mended copy had got its name.
        remove_if_there(storage, &open)?;
        remove_if_there(storage, &mending)?;
        return Ok(Mended::WasWhole);
    }
    if is_whole(storage, &open)? {
        rename(storage, &open, &finished)?;
        remove_if_there(storage, &mending)?;
        return Ok(Mended::WasWhole);
    }
    if !is_there(storage, &open)? {
        // Not by us: the segment goes after its copy has got its name.
        let is_whole = is_whole(storage, &mending)?;
        rename(storage, &mending, &if is_whole { finished } else { name.file(Part::Damaged) })?;
        return Ok(if is_whole { Mended::WasWhole } else { Mended::Unreadable });
    }
    remove_if_there(storage, &mending)?;
    let input = storage.open(&open)?;
    let (mut out, _) = Appender::new(storage.create(&mending)?);
    let outcome = recover::recover(input, &mut out, before_read).map_err(|error| match error {
        StreamError::Read(error) | StreamError::Write(error) => error,
    });
    let recovery = outcome.and_then(|recovery| out.flush().map(|()| recovery)).inspect_err(|_| {
        let _ = storage.remove(&mending);
    })?;
    drop(out);
    if recovery.messages == 0 {
        remove(storage, &mending)?;
        if recovery.lost_bytes == recovery.zero_bytes {
            remove(storage, &open)?;
            return Ok(Mended::WasEmpty);
        }
        rename(storage, &open, &name.file(Part::Damaged))?;
        return Ok(Mended::Unreadable);
    }
    let verdict = verify_file(storage, &mending)?;
    if let Err(what) = recover::compare(&verdict, &recovery) {
        let _ = storage.remove(&mending);
        return Err(io::Error::other(format!("the mended copy is not as it was written: {what}")));
    }
    rename(storage, &mending, &finished)?;
    remove(storage, &open)?;
    Ok(Mended::Finished(recovery))
}

fn rename(storage: &dyn Storage, from: &str, to: &str) -> io::Result<()> {
    storage.rename(from, to)?;
    storage.sync_folder()
}

fn remove(storage: &dyn Storage, name: &str) -> io::Result<()> {
    storage.remove(name)?;
    storage.sync_folder()
}

fn remove_if_there(storage: &dyn Storage, name: &str) -> io::Result<()> {
    match remove(storage, name) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => Err(error),
        _ => Ok(()),
    }
}

fn is_there(storage: &dyn Storage, name: &str) -> io::Result<bool> {
    match storage.open(name) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(false),
        outcome => outcome.map(|_| true),
    }
}

/// Whether a file is there and complete. A look at its end spares reading one that is not.
fn is_whole(storage: &dyn Storage, name: &str) -> io::Result<bool> {
    let mut file = match storage.open(name) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(false),
        outcome => outcome?,
    };
    let mut end = [0; mcap::MAGIC.len()];
    let has_end = file.seek(SeekFrom::End(-(end.len() as i64))).is_ok() && file.read_exact(&mut end).is_ok();
    Ok(has_end && end == mcap::MAGIC && verify_file(storage, name)?.is_complete)
}

fn verify_file(storage: &dyn Storage, name: &str) -> io::Result<crate::recording::Verdict> {
    let mut file = storage.open(name)?;
    let size = file.seek(SeekFrom::End(0))?;
    file.rewind()?;
    verify_reader(Path::new(name), file, size).map_err(io::Error::other)
}
