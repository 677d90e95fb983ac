//! Finds the speed of a serial line by listening.
//!
//! At the right speed sentences and packets with right sums come; at any other, noise. One right sum may be chance, two
//! are not. A speed that has worked is given up only when noise comes in for [`NOISE_NS`] without anything right.

use super::gnss_serial::Baud;
use crate::{
    gnss::{Protocol, framing::Framer},
    types::NS_PER_S,
};

/// Most likely first: the Arduino's and the Xsens sensor's default, other usual settings, then the rest.
const RATES: [u32; 9] = [115_200, 460_800, 57_600, 38_400, 9_600, 230_400, 921_600, 19_200, 4_800];

/// Long enough for a receiver that speaks once a second.
const DWELL_NS: u64 = 3 * NS_PER_S / 2;
/// The first speed is listened to longer: an Arduino may be starting.
const FIRST_DWELL_NS: u64 = 5 * NS_PER_S / 2;
/// Right sums that make a speed the right one.
const FRAMES: u64 = 2;

const NOISE_NS: u64 = 5 * NS_PER_S;
/// With a speed that was set, noise is put up with for longer: nothing else can be tried.
const FIXED_NOISE_NS: u64 = 10 * NS_PER_S;
/// Less is no noise but a broken sentence.
const NOISE_BYTES: u64 = 256;

/// No speed brought anything right.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct NothingFound {
    pub heard_bytes: u64,
    /// The speed that was set, if it was not to be found.
    fixed: Option<u32>,
}

impl std::fmt::Display for NothingFound {
    fn fmt(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
        let heard = self.heard_bytes;
        match self.fixed {
            Some(baud) => write!(
                f,
                "no NMEA sentence or Xbus packet in {heard} bytes at {baud} baud; try baud = \"auto\", check the wiring"
            ),
            None => write!(
                f,
                "no NMEA sentence or Xbus packet in {heard} bytes at any rate from 4800 to 921600 baud; check the wiring \
                 and what the device is set to send"
            ),
        }
    }
}

pub(super) struct RateHunt {
    fixed: Option<u32>,
    /// Place in [`RATES`].
    at: usize,
    /// Speeds that were tried without success since the last one that worked.
    failed: usize,
    framer: Framer,
    /// When this speed was set.
    since_ns: u64,
    /// The last right sum, and bytes since it.
    last_frame_ns: u64,
    noise_bytes: u64,
    /// Bytes since the hunt began.
    heard_bytes: u64,
}

impl RateHunt {
    pub fn new(baud: Baud, now_ns: u64) -> Self {
        let fixed = match baud {
            Baud::Fixed(baud) => Some(baud),
            Baud::Auto => None,
        };
        Self {
            fixed,
            at: 0,
            failed: 0,
            framer: Framer::new(Protocol::Auto),
            since_ns: now_ns,
            last_frame_ns: now_ns,
            noise_bytes: 0,
            heard_bytes: 0,
        }
    }

    /// The speed to be set now.
    pub fn baud(&self) -> u32 {
        self.fixed.unwrap_or(RATES[self.at])
    }

    /// The right speed is not known yet.
    pub fn is_hunting(&self) -> bool {
        self.fixed.is_none() && !self.has_found()
    }

    /// This speed has brought something right.
    pub fn has_found(&self) -> bool {
        self.frames() >= FRAMES
    }

    fn frames(&self) -> u64 {
        let counters = self.framer.counters();
        counters.sentences + counters.packets
    }

    pub fn heard(&mut self, bytes: &[u8], now_ns: u64) {
        let before = self.frames();
        bytes.iter().for_each(|&byte| self.framer.push(byte, &mut |_, _| {}));
        self.heard_bytes += bytes.len() as u64;
        self.noise_bytes += bytes.len() as u64;
        if self.frames() > before {
            self.last_frame_ns = now_ns;
            self.noise_bytes = 0;
        }
        if self.has_found() {
            self.failed = 0;
            self.heard_bytes = 0;
        }
    }

    /// The speed to go on with; an error once all have been tried.
    pub fn next(&mut self, now_ns: u64) -> Result<u32, NothingFound> {
        let quiet_ns = now_ns.saturating_sub(self.last_frame_ns.max(self.since_ns));
        let is_noise = self.noise_bytes >= NOISE_BYTES;
        let is_wrong = match (self.fixed, self.has_found()) {
            (Some(_), _) => is_noise && quiet_ns > FIXED_NOISE_NS,
            (None, true) => is_noise && quiet_ns > NOISE_NS,
            (None, false) if self.at == 0 && self.failed == 0 => quiet_ns > FIRST_DWELL_NS,
            (None, false) => quiet_ns > DWELL_NS,
        };
        if !is_wrong {
            return Ok(self.baud());
        }
        self.failed += 1;
        if self.fixed.is_some() || self.failed >= RATES.len() {
            return Err(NothingFound { heard_bytes: self.heard_bytes.max(self.noise_bytes), fixed: self.fixed });
        }
        self.at = (self.at + 1) % RATES.len();
        self.framer = Framer::new(Protocol::Auto);
        self.since_ns = now_ns;
        self.noise_bytes = 0;
        Ok(self.baud())
    }
}
