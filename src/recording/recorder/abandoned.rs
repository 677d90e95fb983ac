//! Segments that a failing disk cut off.

use super::segments::{Appender, SegmentName};

/// Segments that were given up, until somebody takes them to mend them.
#[derive(Default)]
pub struct Abandoned {
    /// Those that could not be cut yet where they were last synced, and where that was.
    uncut: Vec<(SegmentName, Appender, u64)>,
    cut: Vec<SegmentName>,
}

impl Abandoned {
    /// A segment whose bytes behind `synced_bytes` are written again to another one.
    pub fn give_up(&mut self, name: SegmentName, file: Appender, synced_bytes: u64) {
        self.uncut.push((name, file, synced_bytes));
        self.cut();
    }

    /// A segment that is whole but for its end.
    pub fn note(&mut self, name: SegmentName) {
        self.cut.push(name);
    }

    /// Cuts what the disk lets be cut, so that no message is in two segments.
    pub fn cut(&mut self) {
        let cut = &mut self.cut;
        self.uncut.retain_mut(|(name, file, synced_bytes)| {
            let is_cut = file.cut(*synced_bytes).is_ok();
            if is_cut {
                cut.push(name.clone());
            }
            !is_cut
        });
    }

    /// The segments to be mended, once.
    pub fn take(&mut self) -> Vec<SegmentName> {
        std::mem::take(&mut self.cut)
    }
}
