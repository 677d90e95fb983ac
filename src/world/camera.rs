//! The lens: which direction every pixel of the donut looks in.

use std::f64::consts::{FRAC_PI_2, TAU};

use super::{
    random::{Stream, standard_normal, stream},
    render::{PANORAMA_COLUMNS, PANORAMA_ROWS},
};
use crate::types::{AzimuthSense, CalibrationError, DonutCalibration, LensKind};

/// A camera with a donut lens, mounted on a vehicle.
///
/// The lens maps elevation linearly to the radius: the highest at the rim that [`DonutCalibration::top_is_outer`] names.
#[derive(Debug, Clone, PartialEq)]
pub struct Camera {
    pub width_px: usize,
    pub height_px: usize,
    pub donut: DonutCalibration,
    /// What the lens sees, of a camera that is level.
    pub top_elevation_rad: f64,
    pub bottom_elevation_rad: f64,
    /// Above the ground \[m\].
    pub height_m: f64,
    /// Tilt of the mounting: nose up, and left side up.
    pub pitch_rad: f64,
    pub roll_rad: f64,
    /// Standard deviation of the lens's blur \[px\].
    pub blur_px: f64,
    /// Width of the edge at the rims \[px\].
    pub rim_px: f64,
    /// Share of the light that is lost at the rims.
    pub vignetting: f64,
    /// Gray level of what lies around the donut and in its middle.
    pub surround: u8,
    /// Standard deviation of a pixel's noise \[gray levels\].
    pub noise: f64,
    /// Of the JPEG, 1 to 100.
    pub quality: u8,
}

#[derive(Debug, thiserror::Error, PartialEq)]
pub enum CameraError {
    #[error(transparent)]
    Donut(#[from] CalibrationError),
    #[error("simulated camera: {field} is {found}, expected {expected}")]
    BadValue { field: &'static str, found: f64, expected: &'static str },
}

impl Camera {
    /// On the roof of a car: 1280 × 720, the donut off the middle, from 40° below the horizon to 50° above it.
    pub fn town() -> Self {
        Self {
            width_px: 1280,
            height_px: 720,
            donut: DonutCalibration {
                kind: LensKind::Donut,
                center_x_px: 651.0,
                center_y_px: 352.0,
                inner_radius_px: 115.0,
                outer_radius_px: 335.0,
                top_is_outer: true,
                start_angle_rad: 0.0,
                clockwise: true,
                azimuth: AzimuthSense::Ccw,
            },
            top_elevation_rad: 50.0_f64.to_radians(),
            bottom_elevation_rad: -40.0_f64.to_radians(),
            height_m: 1.9,
            pitch_rad: 0.0,
            roll_rad: 0.0,
            blur_px: 0.8,
            rim_px: 2.0,
            vignetting: 0.25,
            surround: 12,
            noise: 1.5,
            quality: 85,
        }
    }

    /// On a cart.
    pub fn corridor() -> Self {
        Self { height_m: 1.2, ..Self::town() }
    }

    /// In the hand.
    pub fn hall() -> Self {
        Self { height_m: 1.5, ..Self::town() }
    }

    /// Mounted anew: pitch and roll are off by `deviation_rad` each, every seed another way.
    pub fn tilted(self, deviation_rad: f64, seed: u64) -> Self {
        let mut random = stream(seed, Stream::Mount);
        let mut off_rad = || deviation_rad * standard_normal(&mut random).clamp(-2.0, 2.0);
        Self { pitch_rad: self.pitch_rad + off_rad(), roll_rad: self.roll_rad + off_rad(), ..self }
    }

    /// The same lens before a sensor of another size; everything counted in pixels goes with the height.
    pub fn scaled_to(self, width_px: usize, height_px: usize) -> Self {
        let scale = height_px as f64 / self.height_px as f64;
        let middle = |size: usize| 0.5 * (size as f64 - 1.0);
        let donut = DonutCalibration {
            center_x_px: middle(width_px) + scale * (self.donut.center_x_px - middle(self.width_px)),
            center_y_px: middle(height_px) + scale * (self.donut.center_y_px - middle(self.height_px)),
            inner_radius_px: scale * self.donut.inner_radius_px,
            outer_radius_px: scale * self.donut.outer_radius_px,
            ..self.donut
        };
        Self { width_px, height_px, donut, ..self }
    }

    /// # Errors
    /// When the donut does not lie in the image, or a value makes no sense.
    pub fn check(&self) -> Result<(), CameraError> {
        for (field, size) in [("width_px", self.width_px), ("height_px", self.height_px)] {
            if !(64..=8192).contains(&size) {
                return Err(CameraError::BadValue { field, found: size as f64, expected: "64 to 8192" });
            }
        }
        self.donut.check_in_image(self.width_px, self.height_px)?;
        let steepest_rad = 1.4;
        let values = [
            ("top_elevation_rad", self.top_elevation_rad, 0.05..=steepest_rad, "0.05 to 1.4"),
            ("bottom_elevation_rad", self.bottom_elevation_rad, -steepest_rad..=-0.05, "-1.4 to -0.05"),
            ("height_m", self.height_m, 0.1..=100.0, "0.1 to 100"),
            ("pitch_rad", self.pitch_rad, -0.15..=0.15, "-0.15 to 0.15"),
            ("roll_rad", self.roll_rad, -0.15..=0.15, "-0.15 to 0.15"),
            ("blur_px", self.blur_px, 0.0..=10.0, "0 to 10"),
            ("rim_px", self.rim_px, 0.0..=20.0, "0 to 20"),
            ("vignetting", self.vignetting, 0.0..=0.9, "0 to 0.9"),
            ("noise", self.noise, 0.0..=30.0, "0 to 30"),
            ("quality", f64::from(self.quality), 1.0..=100.0, "1 to 100"),
        ];
        match values.into_iter().find(|(_, found, range, _)| !range.contains(found)) {
            Some((field, found, _, expected)) => Err(CameraError::BadValue { field, found, expected }),
            None => Ok(()),
        }
    }

    /// What the panorama behind the donut must show: somewhat more than the lens where it is tilted.
    pub(super) fn panorama_elevations_rad(&self) -> [f64; 2] {
        let tilt_rad = self.pitch_rad.hypot(self.roll_rad);
        let steepest_rad = FRAC_PI_2 - 0.05;
        [
            (self.top_elevation_rad + tilt_rad).min(steepest_rad),
            (self.bottom_elevation_rad - tilt_rad).max(-steepest_rad),
        ]
    }

    /// +1 where the world azimuth grows with the column of the panorama, else −1.
    pub(super) fn sense(&self) -> f64 {
        match self.donut.azimuth {
            AzimuthSense::Ccw => 1.0,
            AzimuthSense::Cw => -1.0,
        }
    }

    /// Standard deviation of the blur in columns and in rows of the panorama.
    pub(super) fn blur_cells(&self) -> [f64; 2] {
        let DonutCalibration { inner_radius_px, outer_radius_px, .. } = self.donut;
        let column_px = TAU * 0.5 * (inner_radius_px + outer_radius_px) / PANORAMA_COLUMNS as f64;
        let row_px = (outer_radius_px - inner_radius_px) / PANORAMA_ROWS as f64;
        [self.blur_px / column_px, self.blur_px / row_px]
    }

    /// Where in the panorama the pixel looks and how much light it gets from there; `None` outside the donut.
    pub(super) fn look(&self, x_px: f64, y_px: f64) -> Option<Look> {
        let donut = &self.donut;
        let (dx, dy) = (x_px - donut.center_x_px, y_px - donut.center_y_px);
        let radius_px = dx.hypot(dy);
        let rim = |inside_px: f64| (inside_px / self.rim_px.max(1e-3) + 0.5).clamp(0.0, 1.0);
        let shows = rim(radius_px - donut.inner_radius_px) * rim(donut.outer_radius_px - radius_px);
        if shows <= 0.0 {
            return None;
        }
        let outwards = (radius_px - donut.inner_radius_px) / (donut.outer_radius_px - donut.inner_radius_px);
        let upwards = if donut.top_is_outer { outwards } else { 1.0 - outwards };
        let elevation_rad = self.bottom_elevation_rad + upwards * (self.top_elevation_rad - self.bottom_elevation_rad);
        let turned_rad = dy.atan2(dx) - donut.start_angle_rad;
        let turned_rad = if donut.clockwise { turned_rad } else { -turned_rad };
        let (turned_rad, elevation_rad) = self.levelled(turned_rad, elevation_rad);
        let [top_rad, bottom_rad] = self.panorama_elevations_rad();
        let from_middle = 2.0 * outwards.clamp(0.0, 1.0) - 1.0;
        Some(Look {
            column: turned_rad.rem_euclid(TAU) / TAU * PANORAMA_COLUMNS as f64 - 0.5,
            row: (top_rad - elevation_rad) / (top_rad - bottom_rad) * PANORAMA_ROWS as f64 - 0.5,
            shows,
            light: 1.0 - self.vignetting * from_middle * from_middle,
        })
    }

    /// A direction of the tilted camera, as seen from a level one: angle from column 0 and elevation.
    fn levelled(&self, turned_rad: f64, elevation_rad: f64) -> (f64, f64) {
        if self.pitch_rad == 0.0 && self.roll_rad == 0.0 {
            return (turned_rad, elevation_rad);
        }
        let azimuth_rad = self.sense() * turned_rad;
        let (sin, cos) = elevation_rad.sin_cos();
        // Forward, left, up.
        let [x, y, z] = [cos * azimuth_rad.cos(), cos * azimuth_rad.sin(), sin];
        let (sin, cos) = self.pitch_rad.sin_cos();
        let [x, z] = [cos * x - sin * z, sin * x + cos * z];
        let (sin, cos) = self.roll_rad.sin_cos();
        let [y, z] = [cos * y - sin * z, sin * y + cos * z];
        (self.sense() * y.atan2(x), z.clamp(-1.0, 1.0).asin())
    }
}

/// A place in the panorama, counted from the centre of its first column and row.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Look {
    pub column: f64,
    pub row: f64,
    /// How much of the pixel lies inside the rims.
    pub shows: f64,
    pub light: f64,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn impossible_cameras_are_refused() {
        assert_eq!(Camera::town().check(), Ok(()));
        assert_eq!(Camera::town().scaled_to(320, 240).check(), Ok(()));
        let too_small = Camera { width_px: 640, height_px: 480, ..Camera::town() };
        assert!(matches!(too_small.check(), Err(CameraError::Donut(_))));
        for bad in [
            Camera { height_m: f64::NAN, ..Camera::town() },
            Camera { quality: 0, ..Camera::town() },
            Camera { pitch_rad: 1.0, ..Camera::town() },
            Camera { width_px: 1 << 20, ..Camera::town() },
        ] {
            assert!(matches!(bad.check(), Err(CameraError::BadValue { .. })), "{bad:?}");
        }
    }

    #[test]
    fn the_horizon_lies_where_elevation_is_linear_in_the_radius() {
        let camera = Camera::town();
        // 40 of 90 degrees from the inner rim.
        let horizon_px = 115.0 + 220.0 * 40.0 / 90.0;
        let look = camera.look(651.0, 352.0 + horizon_px).expect("inside");
        assert!((look.row + 0.5 - PANORAMA_ROWS as f64 * 50.0 / 90.0).abs() < 1e-9, "{look:?}");
        assert!((look.column + 0.5 - PANORAMA_COLUMNS as f64 / 4.0).abs() < 1e-9, "{look:?}");
        assert_eq!(camera.look(651.0, 352.0), None);
    }

    #[test]
    fn pitching_up_lowers_what_is_ahead() {
        let level = Camera::town();
        let pitched = Camera { pitch_rad: 0.05, ..Camera::town() };
        // The pixel that saw the horizon ahead now sees 0.05 rad above it; to the side nothing changes but the azimuth.
        let elevation_rad = |camera: &Camera, x: f64, y: f64| {
            let [top_rad, bottom_rad] = camera.panorama_elevations_rad();
            let row = camera.look(x, y).expect("inside").row;
            top_rad - (row + 0.5) * (top_rad - bottom_rad) / PANORAMA_ROWS as f64
        };
        let horizon_px = 115.0 + 220.0 * 40.0 / 90.0;
        for (dx, dy, rises_rad) in [(1.0, 0.0, 0.05), (-1.0, 0.0, -0.05), (0.0, 1.0, 0.0), (0.0, -1.0, 0.0)] {
            let at = (651.0 + dx * horizon_px, 352.0 + dy * horizon_px);
            let change_rad = elevation_rad(&pitched, at.0, at.1) - elevation_rad(&level, at.0, at.1);
            assert!((change_rad - rises_rad).abs() < 1e-3, "{dx} {dy}: {change_rad}");
        }
    }
}
