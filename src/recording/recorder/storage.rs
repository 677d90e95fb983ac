//! The folder that segments are written to, as far as the recorder needs one. Tests have others, which lose power,
//! fail and stall.

use std::{
    fs::{self, File, OpenOptions},
    io::{self, Read, Seek, Write},
    path::{Path, PathBuf},
};

use rustix::{
    fs::{FlockOperation, flock},
    io::Errno,
};

/// A file being written. Bytes are only appended.
pub trait SegmentFile: Write + Send {
    /// Returns when everything written so far is on the disk.
    fn sync_data(&mut self) -> io::Result<()>;

    /// Cuts the file off.
    fn set_len(&mut self, bytes: u64) -> io::Result<()>;
}

pub trait ReadSeek: Read + Seek + Send {}

impl<T: Read + Seek + Send> ReadSeek for T {}

#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FileFacts {
    pub name: String,
    pub bytes: u64,
}

/// Room on the file system for a program without privileges.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Space {
    pub free_bytes: u64,
    pub total_bytes: u64,
}

impl Space {
    pub fn free_percent(self) -> f64 {
        if self.total_bytes == 0 { 0.0 } else { self.free_bytes as f64 / self.total_bytes as f64 * 100.0 }
    }
}

/// One folder. Names are names in it, without a path.
pub trait Storage: Send + Sync {
    /// A new file; one of that name must not exist.
    fn create(&self, name: &str) -> io::Result<Box<dyn SegmentFile>>;
    fn open(&self, name: &str) -> io::Result<Box<dyn ReadSeek>>;
    /// Replaces a file called `to`.
    fn rename(&self, from: &str, to: &str) -> io::Result<()>;
    fn remove(&self, name: &str) -> io::Result<()>;
    /// Regular files.
    fn list(&self) -> io::Result<Vec<FileFacts>>;
    fn space(&self) -> io::Result<Space>;
    /// Returns when creations, renamings and removals so far are on the disk.
    fn sync_folder(&self) -> io::Result<()>;
}

/// A folder of the operating system.
#[derive(Debug)]
pub struct Folder {
    path: PathBuf,
    /// Holds the lock on the folder.
    _locked: File,
}

impl Folder {
    /// The folder is made if it is not there. It is locked until this is dropped: another recorder would take the open
    /// segment for a cut one.
    pub fn new(path: &Path) -> io::Result<Self> {
        fs::create_dir_all(path)?;
        let folder = File::open(path)?;
        match flock(&folder, FlockOperation::NonBlockingLockExclusive) {
            Err(Errno::WOULDBLOCK) => {
                Err(io::Error::new(io::ErrorKind::ResourceBusy, "another recorder is writing to this folder"))
            }
            // Network file systems may have no locks.
            Ok(()) | Err(_) => Ok(Self { path: path.into(), _locked: folder }),
        }
    }
}

impl SegmentFile for File {
    fn sync_data(&mut self) -> io::Result<()> {
        File::sync_data(self)
    }

    fn set_len(&mut self, bytes: u64) -> io::Result<()> {
        File::set_len(self, bytes)
    }
}

impl Storage for Folder {
    fn create(&self, name: &str) -> io::Result<Box<dyn SegmentFile>> {
        let create = || OpenOptions::new().append(true).create_new(true).open(self.path.join(name));
        let file = match create() {
            // Somebody took the folder away.
            Err(error) if error.kind() == io::ErrorKind::NotFound => {
                fs::create_dir_all(&self.path).and_then(|()| create())?
            }
            outcome => outcome?,
        };
        Ok(Box::new(file))
    }

    fn open(&self, name: &str) -> io::Result<Box<dyn ReadSeek>> {
        Ok(Box::new(File::open(self.path.join(name))?))
    }

    fn rename(&self, from: &str, to: &str) -> io::Result<()> {
        fs::rename(self.path.join(from), self.path.join(to))
    }

    fn remove(&self, name: &str) -> io::Result<()> {
        fs::remove_file(self.path.join(name))
    }

    fn list(&self) -> io::Result<Vec<FileFacts>> {
        let mut files = Vec::new();
        for entry in fs::read_dir(&self.path)? {
            let entry = entry?;
            // A file that vanishes meanwhile is none; a name that is not UTF-8 is not ours.
            if let (Ok(facts), Ok(name)) = (entry.metadata(), entry.file_name().into_string())
                && facts.is_file()
            {
                files.push(FileFacts { name, bytes: facts.len() });
            }
        }
        Ok(files)
    }

    fn space(&self) -> io::Result<Space> {
        let facts = rustix::fs::statvfs(&self.path)?;
        Ok(Space {
            free_bytes: facts.f_bavail.saturating_mul(facts.f_frsize),
            total_bytes: facts.f_blocks.saturating_mul(facts.f_frsize),
        })
    }

    fn sync_folder(&self) -> io::Result<()> {
        match File::open(&self.path)?.sync_all() {
            // Some file systems, FAT among them, have no such call; they write folders at once or not at all.
            Err(error) if matches!(error.kind(), io::ErrorKind::InvalidInput | io::ErrorKind::Unsupported) => Ok(()),
            outcome => outcome,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_folder_does_what_the_recorder_needs() {
        let temporary = tempfile::tempdir().expect("a temporary folder");
        let folder = Folder::new(&temporary.path().join("a/b")).expect("makes it");
        let second = Folder::new(&temporary.path().join("a/b")).expect_err("is locked");
        assert_eq!(second.kind(), io::ErrorKind::ResourceBusy);
        let mut file = folder.create("x").expect("creates");
        file.write_all(b"hello").expect("writes");
        file.sync_data().expect("syncs");
        file.set_len(4).expect("cuts");
        file.write_all(b"!").expect("appends");
        assert_eq!(folder.create("x").err().map(|error| error.kind()), Some(io::ErrorKind::AlreadyExists));
        folder.rename("x", "y").expect("renames");
        fs::create_dir(temporary.path().join("a/b/sub")).expect("a folder is not listed");
        assert_eq!(folder.list().expect("lists"), [FileFacts { name: "y".into(), bytes: 5 }]);
        let mut text = String::new();
        folder.open("y").expect("opens").read_to_string(&mut text).expect("reads");
        assert_eq!(text, "hell!");
        folder.sync_folder().expect("syncs");
        let space = folder.space().expect("a file system");
        assert!(space.total_bytes > 0 && space.free_percent() <= 100.0, "{space:?}");
        folder.remove("y").expect("removes");
        assert_eq!(folder.list().expect("lists"), []);
    }
}
