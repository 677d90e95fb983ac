//! Frames become estimates: what a live drive and a replayed one do alike.

use tracing::{info, warn};

use super::lens_check::{LensCheck, LensVerdict};
use crate::{
    devices::{CameraEvent, CameraFrame},
    localize::{FrameError, Localizer, LocalizerError, MotionSettings, Timings},
    map::{MapError, OpenMap},
    types::{CalibrationError, DonutCalibration, EstimateWarnings, LocalizationState, PositionEstimate},
};

/// Localizes on one map, and keeps count.
pub struct Session {
    localizer: Localizer,
    /// Where the localizer takes the donut to be.
    calibration: DonutCalibration,
    lens_check: Option<LensCheck>,
    counts: Counts,
    last: Option<PositionEstimate>,
}

/// Since the start.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Counts {
    pub frames: u64,
    pub localized: u64,
    /// Frames that could not be used.
    pub unusable: u64,
    /// Frames that the camera lost.
    pub lost: u64,
}

#[derive(Debug, thiserror::Error)]
pub enum SessionError {
    #[error("the map is of another lens: {what}; train a map with this lens, or mount the one of the map")]
    Other { what: String },
    #[error("the lens cannot be where it is found")]
    Calibration(#[from] CalibrationError),
    #[error("the map cannot be read any more")]
    Map(#[from] MapError),
}

impl Session {
    /// # Errors
    /// When the map's donut does not lie within its images, or the map cannot be read.
    pub fn new(map: OpenMap, settings: MotionSettings, memory_bytes: usize) -> Result<Self, LocalizerError> {
        let calibration = map.info.calibration.clone();
        Ok(Self {
            localizer: Localizer::new(map, settings, memory_bytes)?,
            lens_check: Some(LensCheck::new(&calibration)),
            calibration,
            counts: Counts::default(),
            last: None,
        })
    }

    /// What the camera says; `Some` estimate after a frame.
    ///
    /// # Errors
    /// When the camera looks through another lens than the map's, or the map cannot be read any more.
    pub fn take(&mut self, event: &CameraEvent) -> Result<Option<PositionEstimate>, SessionError> {
        match event {
            CameraEvent::Opened(facts) => {
                info!(camera = facts.name, width_px = facts.width_px, height_px = facts.height_px, "camera open");
                // Whoever unplugged the camera may have turned the lens.
                self.lens_check = Some(LensCheck::new(&self.localizer.map_info().calibration));
                Ok(None)
            }
            CameraEvent::Lost(lost) => {
                self.counts.lost += lost.count;
                Ok(None)
            }
            CameraEvent::Frame(frame) => self.frame(frame).map(Some),
        }
    }

    fn frame(&mut self, frame: &CameraFrame) -> Result<PositionEstimate, SessionError> {
        if frame.damage.is_none() {
            self.check_lens(&frame.jpeg)?;
        }
        let (sequence, stamp_ns) = (frame.sequence, frame.stamp_ns);
        let estimate = match frame.damage {
            Some(_) => Err(self.localizer.skip(sequence, stamp_ns)),
            None => match self.localizer.take(sequence, stamp_ns, &frame.jpeg) {
                Ok(tracked) => Ok(tracked.estimate),
                Err(FrameError::Jpeg(_)) => Err(self.localizer.skip(sequence, stamp_ns)),
                Err(FrameError::Map(error)) => return Err(error.into()),
            },
        };
        self.counts.frames += 1;
        self.counts.unusable += u64::from(estimate.is_err());
        let estimate = self.held_back(estimate.unwrap_or_else(|skipped| skipped));
        self.counts.localized += u64::from(estimate.pose.is_some());
        self.tell(&estimate);
        self.last = Some(estimate);
        Ok(estimate)
    }

    fn check_lens(&mut self, jpeg: &[u8]) -> Result<(), SessionError> {
        let Some(verdict) = self.lens_check.as_mut().and_then(|check| check.look(jpeg)) else { return Ok(()) };
        self.lens_check = None;
        match verdict {
            LensVerdict::Fits => self.look_through(self.localizer.map_info().calibration.clone()),
            LensVerdict::Slipped { by_px: [x_px, y_px], calibration } => {
                warn!(x_px, y_px, "the lens has slipped since the survey: the panorama is cut out where it is now");
                self.look_through(calibration)
            }
            LensVerdict::Unclear(reason) => {
                warn!(reason, "the lens could not be checked; going on as before");
                Ok(())
            }
            LensVerdict::Other(what) => Err(SessionError::Other { what }),
        }
    }

    /// Goes on with the donut where it is; from the beginning if that is elsewhere than before.
    fn look_through(&mut self, calibration: DonutCalibration) -> Result<(), SessionError> {
        if calibration != self.calibration {
            self.localizer.look_through(&calibration)?;
            self.calibration = calibration;
        }
        Ok(())
    }

    /// No position is said before the lens is known to be the map's.
    fn held_back(&self, estimate: PositionEstimate) -> PositionEstimate {
        match estimate.state {
            LocalizationState::Localized if self.lens_check.is_some() => {
                PositionEstimate { state: LocalizationState::Candidate, pose: None, ..estimate }
            }
            _ => estimate,
        }
    }

    /// Changes of the state go into the log.
    fn tell(&self, estimate: &PositionEstimate) {
        let before = self.last.map_or(LocalizationState::Unknown, |last| last.state);
        let (state, frame) = (estimate.state.name(), estimate.sequence);
        match (estimate.state, before) {
            (LocalizationState::Localized, before) if before != LocalizationState::Localized => {
                info!(frame, state, "the position is known");
            }
            (LocalizationState::Lost, LocalizationState::Localized) => {
                let EstimateWarnings { unlike_the_map, contradiction, .. } = estimate.warnings;
                warn!(frame, state, unlike_the_map, contradiction, "the position is not known any more");
            }
            _ => {}
        }
    }

    pub fn counts(&self) -> Counts {
        self.counts
    }

    pub fn last(&self) -> Option<&PositionEstimate> {
        self.last.as_ref()
    }

    pub fn timings(&self) -> &Timings {
        self.localizer.timings()
    }
}
