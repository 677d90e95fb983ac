//! What can be wrong with a recording.

use std::{io, path::PathBuf};

use crate::types::CalibrationError;

/// Why a recording cannot be read or written. Each text names the file, what was found, and what helps.
#[derive(Debug, thiserror::Error)]
pub enum RecordingError {
    #[error("{path}: cannot read the recording", path = path.display())]
    CannotRead { path: PathBuf, source: io::Error },
    #[error("{path}: cannot write: {}", hint(cause), path = path.display())]
    CannotWrite { path: PathBuf, cause: io::Error },
    #[error(
        "{path}: not an MCAP recording: it starts with {found}, expected the MCAP magic bytes 89 4D 43 41 50 30 0D 0A",
        path = path.display()
    )]
    NotMcap { path: PathBuf, found: String },
    #[error(
        "{path}: cut off at byte {offset}: {what}; run `omniloc recover {path}` to keep what was recorded before",
        path = path.display()
    )]
    Truncated { path: PathBuf, offset: u64, what: &'static str },
    #[error("{path}: damaged at byte {offset}: {what}; see all damage with `omniloc check {path}`", path = path.display())]
    Damaged { path: PathBuf, offset: u64, what: String },
    #[error(
        "{path}: no calibration: expected the attachment donut.json; run `omniloc calibrate {path}` and import again \
         with `--calibration`",
        path = path.display()
    )]
    NoCalibration { path: PathBuf },
    #[error("{path}: bad calibration in the attachment donut.json", path = path.display())]
    BadCalibration { path: PathBuf, source: CalibrationError },
    #[error("{path}: bad calibration in the attachment donut.json: {what}", path = path.display())]
    UnreadableCalibration { path: PathBuf, what: String },
    #[error(
        "{path}: no usable frame: found {images} images and {pairs} survey pairs of which {usable} are valid and have \
         an image; expected at least one",
        path = path.display()
    )]
    NoUsablePair { path: PathBuf, images: u64, pairs: usize, usable: usize },
}

/// The cause of a failed write and what to do about it.
fn hint(error: &io::Error) -> String {
    match error.kind() {
        io::ErrorKind::StorageFull => format!("the disk is full ({error}); make room or choose another folder"),
        io::ErrorKind::FileTooLarge | io::ErrorKind::QuotaExceeded => {
            format!("the file size or disk quota limit is reached ({error}); nothing was kept")
        }
        io::ErrorKind::NotFound => format!("the folder does not exist ({error})"),
        io::ErrorKind::NotADirectory => format!("the folder is a file ({error})"),
        io::ErrorKind::PermissionDenied | io::ErrorKind::ReadOnlyFilesystem => {
            format!("the folder may not be written to ({error})")
        }
        _ => error.to_string(),
    }
}

impl RecordingError {
    /// The error of the MCAP writer as ours.
    pub fn cannot_write(path: &std::path::Path, error: mcap::McapError) -> Self {
        let cause = match error {
            mcap::McapError::Io(cause) => cause,
            other => std::io::Error::other(other),
        };
        Self::CannotWrite { path: path.into(), cause }
    }
}
