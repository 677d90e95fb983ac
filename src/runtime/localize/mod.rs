//! Localizing: the camera's thread, the localizer's thread, and outputs that nobody waits for.
//!
//! ```text
//! camera thread ─► the newest frames ─► localizer thread ─► outputs (a thread each)
//!                                             └─► status line, journal
//! ```
//!
//! [`playback`] takes a recorded drive the same way without a clock. A frame that comes while older ones wait takes the place of the oldest: an estimate is of now. `session` is what a live
//! and a replayed drive have in common.

pub mod lens_check;
pub mod live;
mod newest;
pub mod playback;
pub mod session;

pub use live::{LocalizeReport, LocalizeStatus};
pub use session::{Counts, Session, SessionError};
