//! How far the donut moves from frame to frame: each frame fitted alone, starting from the circles of the first few.

use super::evidence::Accumulator;
use super::fit::fit;
use super::search::Circles;
use crate::types::LumaImage;

/// Running mean and sum of squared deviations of the single frames' centres (Welford 1962).
#[derive(Debug, Clone, Default)]
pub(super) struct Wander {
    reference: Option<Circles>,
    frames: u32,
    mean_px: [f64; 2],
    squares_px2: [f64; 2],
}

/// How far a frame's donut is looked for from the reference \[px\]: cameras shake by a pixel or two.
const REACH_PX: f64 = 4.0;
/// A frame counts when this share of both rims has an edge on the circles.
const MIN_SUPPORT: f64 = 0.6;
/// A deviation from fewer frames is not worth telling.
const MIN_FRAMES: u32 = 4;

impl Wander {
    pub fn reference(&self) -> Option<Circles> {
        self.reference
    }

    pub fn start(&mut self, circles: Circles) {
        self.reference = Some(circles);
    }

    /// Frames whose rims cannot be seen alone do not count.
    pub fn add(&mut self, frame: &LumaImage, reference: Circles) {
        let mut alone = Accumulator::new(frame.width_px, frame.height_px);
        alone.add(frame);
        let Some(fit) = fit(&alone.maps(), 1.0, reference, REACH_PX) else { return };
        if fit.inner.supported.min(fit.outer.supported) < MIN_SUPPORT {
            return;
        }
        self.frames += 1;
        for axis in 0..2 {
            let before = fit.circles.center_px[axis] - self.mean_px[axis];
            self.mean_px[axis] += before / f64::from(self.frames);
            self.squares_px2[axis] += before * (fit.circles.center_px[axis] - self.mean_px[axis]);
        }
    }

    /// Root mean square over both axes of the sample standard deviations.
    pub fn deviation_px(&self) -> Option<f64> {
        (self.frames >= MIN_FRAMES)
            .then(|| (0.5 * (self.squares_px2[0] + self.squares_px2[1]) / f64::from(self.frames - 1)).sqrt())
    }
}
