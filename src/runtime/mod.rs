//! Which task feeds which, how devices are kept running, and how everything stops.
//!
//! ```text
//! camera thread ─┐                                       ┌─► recorder's queue ─► writer thread ─► segments
//! serial thread ─┼─► bounded queues ─► survey (one task) ─┤
//! pins thread   ─┘                                       └─► status line, journal
//! ```
//!
//! Nothing but the writer thread touches the disk. A device that fails is started again by its own thread and stops
//! nobody else. On SIGTERM and SIGINT the producers stop, the queues drain and the recording is finished, all within
//! [`live::STOP_LIMIT`].
//!
//! `drive` puts a drive together, `live` runs it, `supervisor` keeps each device running, and `survey` is what becomes
//! of what they say; `service` tells systemd how it goes; `playback` takes a recorded drive through the same survey without any clock. `localize` is the same
//! for drives that are localized.

// The same estimates on every computer.
#![cfg_attr(not(test), deny(clippy::disallowed_methods))]

mod complaints;
pub mod drive;
pub mod live;
pub mod localize;
pub mod playback;
mod service;
mod signals;
mod status;
mod supervisor;
pub mod survey;
pub mod system;
mod turn_watch;
