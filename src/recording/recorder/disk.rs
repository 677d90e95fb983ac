//! How the disk is: a word for people, and what is known.

use super::storage::Space;
use crate::types::{Clock, NS_PER_S};

pub const OK: &str = "ok";
pub const SLOW: &str = "slow";
/// No room, and nothing may be deleted.
pub const FULL: &str = "full";
pub const READ_ONLY: &str = "read-only";
pub const FAILED: &str = "failed";

/// What is known about the disk.
#[derive(Debug, Clone, Default)]
pub struct Facts {
    pub space: Space,
    pub is_full: bool,
    pub error: Option<&'static str>,
    pub last_error: Option<String>,
    pub lost: u64,
    pub written_bytes: u64,
    /// Longest operation and when it ended; the one before is forgotten after a second.
    pub stall_ns: u64,
    stall_at_ns: u64,
}

impl Facts {
    /// An operation that began then has ended.
    pub fn note_stall(&mut self, clock: &dyn Clock, since_ns: u64) {
        let now_ns = clock.monotonic_ns();
        let took_ns = now_ns.saturating_sub(since_ns);
        if took_ns >= self.stall_ns || now_ns.saturating_sub(self.stall_at_ns) > NS_PER_S {
            (self.stall_ns, self.stall_at_ns) = (took_ns, now_ns);
        }
    }

    /// Forgets an operation that ended long ago.
    pub fn age(&mut self, now_ns: u64) {
        if now_ns.saturating_sub(self.stall_at_ns) > NS_PER_S {
            self.stall_ns = 0;
        }
    }
}
