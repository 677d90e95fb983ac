//! Is this the lens of the map, and where the map has it? Looked at once, on the first frames.

use crate::{
    calibrate::{DonutFinder, Orientation, Verdict},
    jpeg::LumaDecoder,
    types::DonutCalibration,
};

/// Frames that are looked at: each shows the rims, several outweigh a bad one.
const FRAMES: usize = 5;
/// After so many frames without a donut nothing more is found.
const MAX_FRAMES: usize = 40;
/// A centre as near as this to the map's is the same: finding it has such an error.
const SAME_PX: f64 = 1.0;
/// As far as this the lens may have slipped on the camera: the panorama is cut out where it is now.
const SLIPPED_PX: f64 = 10.0;
/// Radii that differ by more are of another lens, or of another distance to the camera.
const SAME_RADIUS_PX: f64 = 4.0;

/// What the first frames show.
#[derive(Debug, Clone, PartialEq)]
pub enum LensVerdict {
    Fits,
    /// By east and south on the picture \[px\]; the calibration to go on with.
    Slipped {
        by_px: [f64; 2],
        calibration: DonutCalibration,
    },
    /// The rims cannot be made out: nothing is known against the lens.
    Unclear(String),
    /// In words, what differs.
    Other(String),
}

pub struct LensCheck {
    expected: DonutCalibration,
    decoder: LumaDecoder,
    finder: Option<DonutFinder>,
    seen: usize,
    added: usize,
}

impl LensCheck {
    pub fn new(expected: &DonutCalibration) -> Self {
        Self { expected: expected.clone(), decoder: LumaDecoder::new(), finder: None, seen: 0, added: 0 }
    }

    /// Looks at a frame; the verdict once there is one.
    pub fn look(&mut self, jpeg: &[u8]) -> Option<LensVerdict> {
        self.seen += 1;
        if let Ok(image) = self.decoder.decode(jpeg) {
            if self.finder.is_none() {
                self.finder = DonutFinder::new(image.width_px, image.height_px).ok();
            }
            self.added += usize::from(self.finder.as_mut().is_some_and(|finder| finder.add(image).is_ok()));
        }
        let finder = self.finder.as_ref().filter(|_| self.added >= FRAMES && self.added.is_multiple_of(FRAMES));
        let found = finder.map(DonutFinder::finish);
        match found {
            Some(Ok(donut)) if donut.verdict == Verdict::Sure => {
                Some(self.judge(&donut.calibration(&Orientation::from(&self.expected))))
            }
            _ if self.seen < MAX_FRAMES => None,
            Some(Err(error)) => Some(LensVerdict::Unclear(error.to_string())),
            _ => Some(LensVerdict::Unclear("the donut is not seen clearly".into())),
        }
    }

    fn judge(&self, found: &DonutCalibration) -> LensVerdict {
        let expected = &self.expected;
        for (rim, found_px, expected_px) in [
            ("inner", found.inner_radius_px, expected.inner_radius_px),
            ("outer", found.outer_radius_px, expected.outer_radius_px),
        ] {
            if (found_px - expected_px).abs() > SAME_RADIUS_PX {
                let what = format!("its {rim} radius is {found_px:.1} px, the map's {expected_px:.1} px");
                return LensVerdict::Other(what);
            }
        }
        let by_px = [found.center_x_px - expected.center_x_px, found.center_y_px - expected.center_y_px];
        match libm::hypot(by_px[0], by_px[1]) {
            distance_px if distance_px <= SAME_PX => LensVerdict::Fits,
            distance_px if distance_px <= SLIPPED_PX => {
                let calibration = DonutCalibration {
                    center_x_px: found.center_x_px,
                    center_y_px: found.center_y_px,
                    ..expected.clone()
                };
                LensVerdict::Slipped { by_px, calibration }
            }
            distance_px => LensVerdict::Other(format!("its centre lies {distance_px:.0} px from the map's")),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::world::{Camera, Day, Pose, Renderer, World};

    fn frames(camera: &Camera) -> Vec<Vec<u8>> {
        let world = World::town_block(3);
        let mut renderer = Renderer::new(&world, &Day::new(1), camera).expect("a camera");
        (0..FRAMES)
            .map(|i| {
                let mut jpeg = Vec::new();
                renderer.render_jpeg(&Pose::at([1.8, 20.0 + 2.0 * i as f64], 1.5), i as f64, &mut jpeg);
                jpeg
            })
            .collect()
    }

    fn verdict(expected: &DonutCalibration, frames: &[Vec<u8>]) -> Option<LensVerdict> {
        let mut check = LensCheck::new(expected);
        frames.iter().find_map(|jpeg| check.look(jpeg))
    }

    #[test]
    fn the_map_s_lens_fits_a_slipped_one_is_followed_and_another_is_refused() {
        let camera = Camera::town();
        let frames = frames(&camera);
        assert_eq!(verdict(&camera.donut, &frames), Some(LensVerdict::Fits));

        let elsewhere = |x_px: f64, y_px: f64| DonutCalibration {
            center_x_px: camera.donut.center_x_px + x_px,
            center_y_px: camera.donut.center_y_px + y_px,
            ..camera.donut.clone()
        };
        let Some(LensVerdict::Slipped { by_px, calibration }) = verdict(&elsewhere(4.0, -3.0), &frames) else {
            panic!("five pixels are a slip");
        };
        assert!((by_px[0] + 4.0).abs() < 1.0 && (by_px[1] - 3.0).abs() < 1.0, "{by_px:?}");
        assert!((calibration.center_x_px - camera.donut.center_x_px).abs() < 1.0, "{calibration:?}");
        assert!(matches!(verdict(&elsewhere(25.0, 0.0), &frames), Some(LensVerdict::Other(_))));
        let wider = DonutCalibration { outer_radius_px: camera.donut.outer_radius_px - 12.0, ..camera.donut.clone() };
        assert!(matches!(verdict(&wider, &frames), Some(LensVerdict::Other(what)) if what.contains("outer radius")));
    }

    #[test]
    fn darkness_speaks_for_no_other_lens() {
        let mut dark = Vec::new();
        let encoder = image::codecs::jpeg::JpegEncoder::new_with_quality(&mut dark, 80);
        image::ImageEncoder::write_image(encoder, &vec![7; 640 * 480], 640, 480, image::ExtendedColorType::L8)
            .expect("encodes");
        let found = verdict(&Camera::town().donut, &vec![dark; MAX_FRAMES]);
        assert!(matches!(found, Some(LensVerdict::Unclear(_))), "{found:?}");
    }
}
