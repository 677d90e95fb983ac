//! Which files results are of.

use serde::Serialize;

/// A file that was read.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct InputFile {
    /// `recording`, `map`, `survey`, `truth` or `split`.
    pub role: &'static str,
    /// As it was named.
    pub file: String,
    pub sha256: String,
}
