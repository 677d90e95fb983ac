//! Whole files or none: an output gets its name when it is complete and on the disk.

use std::{
    fs::{self, File, OpenOptions, Permissions},
    io::{self, BufWriter, Write},
    os::{
        fd::AsRawFd,
        unix::fs::{OpenOptionsExt, PermissionsExt},
    },
    path::Path,
};

use rustix::fs::{AtFlags, CWD, OFlags, linkat};
use tempfile::{NamedTempFile, TempPath};

use super::error::RecordingError;

/// Begin and end of the names of files that are not complete.
const PREFIX: &str = ".omniloc-";
const SUFFIX: &str = ".tmp";
/// The umask still applies.
const MODE: u32 = 0o666;

/// Writes a file that has no name, and gives it its name only when it is whole and on the disk. Whatever ends the program
/// before, Ctrl-C included, leaves nothing behind; on file systems that know no nameless files, a hidden one.
///
/// # Errors
/// What `write` returns, or that the folder cannot be written to. The target is then as it was before.
pub fn write_file_atomically<E: From<RecordingError>>(
    path: &Path,
    write: impl FnOnce(&mut BufWriter<File>) -> Result<(), E>,
) -> Result<(), E> {
    let folder = folder_of(path);
    let failed = |cause: io::Error| RecordingError::CannotWrite { path: path.into(), cause };

    let (file, name) = create(folder).map_err(failed)?;
    let mut out = BufWriter::with_capacity(1 << 20, file);
    write(&mut out)?;
    let file = out.into_inner().map_err(|error| failed(error.into_error()))?;
    file.sync_all().map_err(failed)?;
    let name = match name {
        Some(name) => name,
        None => link(&file, folder).map_err(failed)?,
    };
    name.persist(path).map_err(|error| failed(error.error))?;
    sync_folder(folder);
    Ok(())
}

/// A new file in `folder`, without a name where the file system can do that.
fn create(folder: &Path) -> io::Result<(File, Option<TempPath>)> {
    let mut nameless = OpenOptions::new();
    nameless.read(true).write(true).mode(MODE).custom_flags(OFlags::TMPFILE.bits() as i32);
    if let Ok(file) = nameless.open(folder) {
        return Ok((file, None));
    }
    if !folder.is_dir() {
        // Says why without the hidden file's name.
        fs::read_dir(folder)?;
    }
    let (file, name) = builder().tempfile_in(folder).map_err(without_name)?.into_parts();
    Ok((file, Some(name)))
}

fn builder() -> tempfile::Builder<'static, 'static> {
    let mut builder = tempfile::Builder::new();
    builder.prefix(PREFIX).suffix(SUFFIX).permissions(Permissions::from_mode(MODE));
    builder
}

/// Gives a nameless file a hidden name, which can then take the place of another one: a link alone cannot.
fn link(file: &File, folder: &Path) -> io::Result<TempPath> {
    let descriptor = format!("/proc/self/fd/{}", file.as_raw_fd());
    let link = |hidden: &Path| Ok(linkat(CWD, &descriptor, CWD, hidden, AtFlags::SYMLINK_FOLLOW)?);
    let linked: NamedTempFile<()> = builder().make_in(folder, link).map_err(without_name)?;
    Ok(linked.into_temp_path())
}

/// `tempfile` says the name of the hidden file, which helps nobody.
fn without_name(error: io::Error) -> io::Error {
    error.raw_os_error().map_or_else(|| error.kind().into(), io::Error::from_raw_os_error)
}

/// [`write_file_atomically`] of bytes that are there already.
pub fn write_bytes_atomically(path: &Path, bytes: &[u8]) -> Result<(), RecordingError> {
    write_file_atomically(path, |out| {
        out.write_all(bytes).map_err(|cause| RecordingError::CannotWrite { path: path.into(), cause })
    })
}

/// The folder that holds `path`.
pub(super) fn folder_of(path: &Path) -> &Path {
    path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

/// Makes a rename last through a power cut. Some file systems cannot sync a folder; the file itself is safe already.
pub(super) fn sync_folder(folder: &Path) {
    let _ = fs::File::open(folder).and_then(|folder| folder.sync_all());
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_failed_write_leaves_the_old_file_and_nothing_else() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let path = folder.path().join("a.mcap");
        fs::write(&path, "old").expect("writes");
        let full = |out: &mut BufWriter<File>| {
            out.write_all(b"half a recording").expect("writes");
            let cause = io::ErrorKind::StorageFull.into();
            Err(RecordingError::CannotWrite { path: path.clone(), cause })
        };
        let message = write_file_atomically(&path, full).expect_err("it fails").to_string();
        assert!(message.contains("a.mcap: cannot write: the disk is full"), "{message}");
        assert_eq!(fs::read(&path).expect("readable"), b"old");
        assert_eq!(fs::read_dir(folder.path()).expect("readable").count(), 1);
    }

    #[test]
    fn while_it_is_written_a_file_has_no_name_and_a_missing_folder_is_called_missing() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let path = folder.path().join("a.map");
        let count = || fs::read_dir(folder.path()).expect("readable").count();
        let has_nameless = create(folder.path()).expect("creates").1.is_none();
        write_file_atomically(&path, |out| {
            out.write_all(b"whole").expect("writes");
            assert_eq!(count(), usize::from(!has_nameless), "this file system knows nameless files: {has_nameless}");
            Ok::<(), RecordingError>(())
        })
        .expect("writes");
        assert_eq!((fs::read(&path).expect("readable"), count()), (b"whole".to_vec(), 1));

        let missing = folder.path().join("no/a.map");
        let message = write_bytes_atomically(&missing, b"").expect_err("there is no such folder").to_string();
        assert!(message.contains("the folder does not exist") && !message.contains(PREFIX), "{message}");
    }
}
