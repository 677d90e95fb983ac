//! Recordings: MCAP files that hold frames, positions and what is needed to use them.
//!
//! A *frame* is one image of the camera; a *pair* says where the vehicle was when that frame was exposed. They are
//! linked by the frame's sequence number. Positions are metres east and north from the recording's origin; where that
//! origin lies on the Earth may be unknown.

// The same estimates on every computer.
#![cfg_attr(not(test), deny(clippy::disallowed_methods))]

mod atomic;
mod dataset;
mod error;
mod estimate;
mod events;
mod export;
mod health;
mod import;
mod positions;
pub mod proto;
mod reader;
pub mod recorder;
mod records;
pub mod recover;
mod scan;
pub mod topics;
mod verify;
mod writer;

pub use atomic::{write_bytes_atomically, write_file_atomically};
pub use dataset::{Dataset, DatasetError};
pub use error::RecordingError;
pub use events::{DeviceRecord, DeviceRecords, TimedRecord};
pub use export::{ExportError, ExportReport, Format, export};
pub use health::DriveHealth;
pub use import::{CalibrationSource, ImportReport, ImportSettings, import};
pub use reader::{Frames, Recording, SurveyFrame, TopicSummary};
pub use verify::{Verdict, verify};
pub use writer::RecordingWriter;
