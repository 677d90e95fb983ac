//! Finds the donut in camera images: its centre and the radii of its two rims.
//!
//! Pure functions over luma images; no files, no clocks. Three steps, one file each:
//!
//! 1. `evidence`: temporal mean and deviation of every pixel. The rims stay, the content moves.
//! 2. `search`: coarse-to-fine search for the concentric pair of circles with content between them and flatness beyond.
//! 3. `fit`: sub-pixel rim points on 360 rays, robust least-squares circles, standard deviations.
//!
//! `judge` decides whether to believe it, `wander` measures how far the donut moves from frame to frame, and [`overlay`]
//! draws the result on a frame for a person to see.
//!
//! The *rim* is where image content changes to surround or hub: the middle of that edge. Pixel centres are at integer
//! coordinates, as in [`DonutCalibration`](crate::types::DonutCalibration).

// The same estimates on every computer.
#![cfg_attr(not(test), deny(clippy::disallowed_methods))]

mod evidence;
mod fit;
mod judge;
mod overlay;
mod search;
#[cfg(test)]
mod synthetic;
#[cfg(test)]
mod tests;
mod wander;

pub use overlay::overlay;

use evidence::Accumulator;
use fit::Fit;
use wander::Wander;

use crate::types::{AzimuthSense, DonutCalibration, LensKind, LumaImage};

/// Where the donut is, how well that is known, and whether to believe it.
#[derive(Debug, Clone, PartialEq)]
pub struct DonutEstimate {
    pub center_x_px: f64,
    pub center_y_px: f64,
    pub inner_radius_px: f64,
    pub outer_radius_px: f64,
    /// Standard deviations of the four above: of the donut's mean place in these frames. What one frame cannot show is
    /// how far the camera shakes; from eight frames on that is measured and included.
    pub center_x_std_px: f64,
    pub center_y_std_px: f64,
    pub inner_radius_std_px: f64,
    pub outer_radius_std_px: f64,
    pub inner_rim: RimEvidence,
    pub outer_rim: RimEvidence,
    /// Distance between the centres of the two rims when each is fitted alone.
    pub center_disagreement_px: f64,
    /// How far the centre moves from frame to frame, root mean square of an axis (shaking or a loose lens). `None` with
    /// fewer than eight frames.
    pub wander_px: Option<f64>,
    /// From 0 to 1: the weakest of the checks behind the verdict.
    pub confidence: f64,
    pub verdict: Verdict,
    pub frames_used: u32,
}

/// How well one rim is seen.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RimEvidence {
    /// Share of its circumference inside the image.
    pub visible: f64,
    /// Share of the visible directions with an edge on the circle.
    pub supported: f64,
}

#[derive(Debug, Clone, PartialEq)]
pub enum Verdict {
    Sure,
    /// What speaks against it, in words.
    Doubtful(Vec<String>),
}

#[derive(Debug, thiserror::Error, PartialEq)]
pub enum FindDonutError {
    #[error("no frames to find the donut in")]
    NoFrames,
    #[error("frame of {found_width_px} x {found_height_px} px among frames of {width_px} x {height_px} px")]
    DifferentSizes { width_px: usize, height_px: usize, found_width_px: usize, found_height_px: usize },
    #[error("frame says {width_px} x {height_px} px but has {pixels} pixels")]
    BadFrame { width_px: usize, height_px: usize, pixels: usize },
    #[error("image of {width_px} x {height_px} px is too small: a donut needs at least {MIN_SIDE_PX} px a side")]
    TooSmall { width_px: usize, height_px: usize },
    #[error("no donut found: {reason}")]
    NotFound { reason: String },
}

/// Smallest image side: smaller images have too few pixels on the inner rim.
pub const MIN_SIDE_PX: usize = 96;

/// Finds the donut in frames held in memory; [`DonutFinder`] takes them one by one.
///
/// # Errors
/// No frames, frames of different sizes, too small ones, or no donut in them.
pub fn find_donut(frames: &[LumaImage]) -> Result<DonutEstimate, FindDonutError> {
    let first = frames.first().ok_or(FindDonutError::NoFrames)?;
    let mut finder = DonutFinder::new(first.width_px, first.height_px)?;
    frames.iter().try_for_each(|frame| finder.add(frame))?;
    finder.finish()
}

/// Gathers evidence frame by frame in memory that does not grow.
#[derive(Debug, Clone)]
pub struct DonutFinder {
    evidence: Accumulator,
    wander: Wander,
}

impl DonutFinder {
    /// # Errors
    /// When the image is smaller than [`MIN_SIDE_PX`] on a side.
    pub fn new(width_px: usize, height_px: usize) -> Result<Self, FindDonutError> {
        if width_px.min(height_px) < MIN_SIDE_PX {
            return Err(FindDonutError::TooSmall { width_px, height_px });
        }
        Ok(Self { evidence: Accumulator::new(width_px, height_px), wander: Wander::default() })
    }

    /// # Errors
    /// When the frame's size is not that of the others; the frames before it still count.
    pub fn add(&mut self, frame: &LumaImage) -> Result<(), FindDonutError> {
        let (width_px, height_px) = (self.evidence.width_px, self.evidence.height_px);
        if (frame.width_px, frame.height_px) != (width_px, height_px) {
            let (found_width_px, found_height_px) = (frame.width_px, frame.height_px);
            return Err(FindDonutError::DifferentSizes { width_px, height_px, found_width_px, found_height_px });
        }
        if frame.pixels.len() != width_px * height_px {
            return Err(FindDonutError::BadFrame { width_px, height_px, pixels: frame.pixels.len() });
        }
        self.evidence.add(frame);
        match self.wander.reference() {
            Some(circles) => self.wander.add(frame, circles),
            // At 4, 8, 16, ... frames: seldom enough to cost little when there is no donut.
            None if self.evidence.frames >= 4 && self.evidence.frames.is_power_of_two() => {
                if let Ok((_, fit)) = self.find() {
                    self.wander.start(fit.circles);
                }
            }
            None => (),
        }
        Ok(())
    }

    /// The donut in the frames so far.
    ///
    /// # Errors
    /// No frames, or no donut in them.
    pub fn finish(&self) -> Result<DonutEstimate, FindDonutError> {
        if self.evidence.frames == 0 {
            return Err(FindDonutError::NoFrames);
        }
        let (candidate, mut fit) = self.find()?;
        let wander_px = self.wander.deviation_px();
        let of_mean_px = wander_px.unwrap_or(0.0) / f64::from(self.evidence.frames).sqrt();
        // Shaking moves the centre, not the radii.
        fit.deviations_px[0] = libm::hypot(fit.deviations_px[0], of_mean_px);
        fit.deviations_px[1] = libm::hypot(fit.deviations_px[1], of_mean_px);
        let mut estimate = judge::judge(&candidate, &fit, self.evidence.frames)?;
        estimate.wander_px = wander_px;
        Ok(estimate)
    }

    fn find(&self) -> Result<(search::Candidate, Fit), FindDonutError> {
        let not_found = |reason: &str| FindDonutError::NotFound { reason: reason.to_owned() };
        let maps = self.evidence.maps();
        let mean_weight = if maps.show_motion() { search::MEAN_WEIGHT_WITH_MOTION } else { 1.0 };
        let candidate = search::search(&maps, mean_weight).ok_or_else(|| not_found("no circle has a visible edge"))?;
        let fit = fit::fit(&maps, mean_weight, candidate.circles, search::search_error_px(&maps))
            .ok_or_else(|| not_found("too few edges lie on a pair of circles"))?;
        Ok((candidate, fit))
    }
}

/// What the picture alone does not show: how the panorama is cut out of the donut.
#[derive(Debug, Clone, PartialEq)]
pub struct Orientation {
    pub top_is_outer: bool,
    pub start_angle_rad: f64,
    pub clockwise: bool,
    pub azimuth: AzimuthSense,
}

impl Default for Orientation {
    /// A lens that shows the sky at the outer rim, seen upright: row 0 is the outer rim, columns run clockwise from the
    /// image's +x axis, and the world azimuth grows with them.
    fn default() -> Self {
        Self { top_is_outer: true, start_angle_rad: 0.0, clockwise: true, azimuth: AzimuthSense::Ccw }
    }
}

impl From<&DonutCalibration> for Orientation {
    fn from(known: &DonutCalibration) -> Self {
        Self {
            top_is_outer: known.top_is_outer,
            start_angle_rad: known.start_angle_rad,
            clockwise: known.clockwise,
            azimuth: known.azimuth,
        }
    }
}

impl DonutEstimate {
    pub fn calibration(&self, orientation: &Orientation) -> DonutCalibration {
        // Finer digits than a hundredth of the systematic 0.1 px mean nothing.
        let rounded = |px: f64| (px * 1000.0).round() / 1000.0;
        DonutCalibration {
            kind: LensKind::Donut,
            center_x_px: rounded(self.center_x_px),
            center_y_px: rounded(self.center_y_px),
            inner_radius_px: rounded(self.inner_radius_px),
            outer_radius_px: rounded(self.outer_radius_px),
            top_is_outer: orientation.top_is_outer,
            start_angle_rad: orientation.start_angle_rad,
            clockwise: orientation.clockwise,
            azimuth: orientation.azimuth,
        }
    }
}
