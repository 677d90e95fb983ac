//! How the camera turns, frame by frame.

use super::visual_rotation::{RotationTracker, VisualRotation};
use crate::{
    jpeg::LumaDecoder,
    panorama::{Panorama, UnwrapTable},
    types::DonutCalibration,
};

/// Unwraps frames and compares each with the one before.
pub struct CameraTurns {
    calibration: DonutCalibration,
    decoder: LumaDecoder,
    /// For frames of the size that came last; `None` if the donut does not fit into them.
    table: Option<UnwrapTable>,
    size_px: (usize, usize),
    panorama: Panorama,
    tracker: RotationTracker,
}

impl CameraTurns {
    pub fn new(calibration: DonutCalibration) -> Self {
        let tracker = RotationTracker::new(calibration.azimuth);
        let (decoder, panorama) = (LumaDecoder::new(), Panorama::zeros());
        Self { calibration, decoder, table: None, size_px: (0, 0), panorama, tracker }
    }

    /// The turn since the frame before. `None`: it is the first, is damaged, or looks too different. A damaged frame is
    /// passed over; the next one is compared with the one before it.
    pub fn push(&mut self, stamp_ns: u64, jpeg: &[u8]) -> Option<VisualRotation> {
        let image = self.decoder.decode(jpeg).ok()?;
        if (image.width_px, image.height_px) != self.size_px {
            self.size_px = (image.width_px, image.height_px);
            self.table = UnwrapTable::build(&self.calibration, image.width_px, image.height_px).ok();
            self.tracker.restart();
        }
        self.table.as_ref()?.unwrap_into(image, 0, &mut self.panorama);
        self.tracker.push(stamp_ns, &self.panorama)
    }

    /// The next frame is compared with none.
    pub fn restart(&mut self) {
        self.tracker.restart();
    }
}
