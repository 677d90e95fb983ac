//! Bytes of the serial line → positions, headings and times that can be believed.
//!
//! ```text
//! SerialChunk ─► framing ─┬─► nmea ─► epoch  ─┬─► plausibility ─► GnssSample
//!                         └─► xbus ─► sensor ─┘
//! ```
//!
//! | module | what it is for |
//! |---|---|
//! | [`framing`] | finds sentences and packets in the stream and checks their sums |
//! | `nmea`, `xbus` | what one sentence, one packet says |
//! | `epoch`, `sensor` | puts together what belongs to one moment |
//! | [`plausibility`] | refuses what cannot be |
//! | [`decoder`] | all of it: chunks in, samples out, everything counted |
//! | [`encode`] | the other way round, for the simulator: what our Arduino and an Xsens sensor send |
//!
//! Nothing here knows a port, a clock or a thread, so a recording decodes to what the drive decoded to. A *sentence* is
//! NMEA text, a *packet* Xbus binary, a *frame* either. The *arrival* of a frame is when its last byte came in, on the
//! monotonic clock; its *sample time* is when the receiver measured, on the receiver's clock.

// The same estimates on every computer.
#![cfg_attr(not(test), deny(clippy::disallowed_methods))]

pub mod decoder;
pub mod encode;
mod epoch;
pub mod framing;
mod nmea;
pub mod plausibility;
mod sensor;
mod time;
mod xbus;

pub use decoder::{DecoderCounters, DecoderSettings, GnssDecoder};
pub use framing::Protocol;
pub(crate) use framing::xor;
pub(crate) use time::{NS_PER_DAY, date_of_day};
