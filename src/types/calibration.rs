//! Where the donut lies in the camera image.

use serde::{Deserialize, Serialize};

/// How the world azimuth changes from one panorama column to the next.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum AzimuthSense {
    /// azimuth = yaw + 2π j / W: counter-clockwise with the column index j.
    Ccw,
    /// azimuth = yaw − 2π j / W.
    Cw,
}

/// The donut of one camera and lens: what `donut.json` holds. The serialized names are those of the data-set format.
///
/// Pixel centres are at integer coordinates: the top left pixel's centre is (0, 0).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DonutCalibration {
    /// Always `donut`; other lens models would have other names.
    pub kind: LensKind,
    #[serde(rename = "cx")]
    pub center_x_px: f64,
    #[serde(rename = "cy")]
    pub center_y_px: f64,
    #[serde(rename = "r_in")]
    pub inner_radius_px: f64,
    #[serde(rename = "r_out")]
    pub outer_radius_px: f64,
    /// Row 0 of the panorama is the outer rim.
    pub top_is_outer: bool,
    /// Direction of column 0 in the image, from the +x axis \[rad\], counted like `clockwise` says.
    #[serde(rename = "start_angle")]
    pub start_angle_rad: f64,
    /// Columns run clockwise on the screen (+x towards +y, y pointing down).
    pub clockwise: bool,
    /// How the world azimuth of a column follows from the vehicle's yaw.
    pub azimuth: AzimuthSense,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum LensKind {
    Donut,
}

#[derive(Debug, thiserror::Error, PartialEq)]
pub enum CalibrationError {
    #[error("donut calibration: {field} is {found}, expected {expected}")]
    BadValue { field: &'static str, found: f64, expected: &'static str },
    #[error(
        "donut outside the frame: centre ({center_x_px:.1}, {center_y_px:.1}), outer radius {outer_radius_px:.1} px, \
         but the image is {width_px} x {height_px}; run `omniloc calibrate` on this recording"
    )]
    OutsideFrame { center_x_px: f64, center_y_px: f64, outer_radius_px: f64, width_px: usize, height_px: usize },
}

impl DonutCalibration {
    /// Refuses values that no lens can have.
    pub fn check(&self) -> Result<(), CalibrationError> {
        let fields = [
            ("cx", self.center_x_px),
            ("cy", self.center_y_px),
            ("r_in", self.inner_radius_px),
            ("r_out", self.outer_radius_px),
            ("start_angle", self.start_angle_rad),
        ];
        for (field, found) in fields {
            if !found.is_finite() {
                return Err(CalibrationError::BadValue { field, found, expected: "a finite number" });
            }
        }
        if self.inner_radius_px < 1.0 {
            let found = self.inner_radius_px;
            return Err(CalibrationError::BadValue { field: "r_in", found, expected: "at least 1 px" });
        }
        if self.outer_radius_px < self.inner_radius_px + 8.0 {
            let found = self.outer_radius_px;
            return Err(CalibrationError::BadValue { field: "r_out", found, expected: "at least r_in + 8 px" });
        }
        Ok(())
    }

    /// Refuses a donut that does not lie in an image of this size. The rim may be cut by at most
    /// [`CUT_RIM_PX`](Self::CUT_RIM_PX).
    pub fn check_in_image(&self, width_px: usize, height_px: usize) -> Result<(), CalibrationError> {
        self.check()?;
        let reach = |center: f64, size: usize| {
            center - self.outer_radius_px >= -Self::CUT_RIM_PX
                && center + self.outer_radius_px <= size as f64 - 1.0 + Self::CUT_RIM_PX
        };
        if reach(self.center_x_px, width_px) && reach(self.center_y_px, height_px) {
            return Ok(());
        }
        Err(CalibrationError::OutsideFrame {
            center_x_px: self.center_x_px,
            center_y_px: self.center_y_px,
            outer_radius_px: self.outer_radius_px,
            width_px,
            height_px,
        })
    }

    /// How far the outer rim may reach beyond the image \[px\]: border pixels are repeated there.
    pub const CUT_RIM_PX: f64 = 2.0;
}

#[cfg(test)]
mod tests {
    use super::*;

    fn calibration() -> DonutCalibration {
        serde_json::from_str(
            r#"{"kind": "donut", "cx": 651.0, "cy": 352.0, "r_in": 115.0, "r_out": 335.0, "top_is_outer": true,
                "start_angle": 0.0, "clockwise": true, "azimuth": "ccw"}"#,
        )
        .expect("the data-set format parses")
    }

    #[test]
    fn donut_outside_the_frame_is_refused() {
        let donut = calibration();
        assert_eq!(donut.check_in_image(1280, 720), Ok(()));
        let error = donut.check_in_image(640, 480).expect_err("the donut is larger");
        assert!(error.to_string().contains("640 x 480"), "{error}");
    }

    #[test]
    fn impossible_radii_are_refused() {
        for (inner, outer) in [(0.0, 100.0), (100.0, 100.0), (200.0, 100.0), (f64::NAN, 100.0)] {
            let donut = DonutCalibration { inner_radius_px: inner, outer_radius_px: outer, ..calibration() };
            assert!(donut.check().is_err(), "{inner} {outer}");
        }
    }
}
