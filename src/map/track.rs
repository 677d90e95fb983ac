//! What was made of the positions that a map was learned from.

use serde::{Deserialize, Serialize};

use super::RecipeName;

/// Whether learning positions are corrected before learning.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum Smoothing {
    /// They are taken as the receiver gave them.
    None,
    /// By points of the scene, how the vehicle moved and places seen more than once, where a recording is a track.
    Track,
}

impl Smoothing {
    /// What a recipe does unless told otherwise: the paper's takes positions as they are.
    pub fn usual(recipe: RecipeName) -> Self {
        match recipe {
            RecipeName::Paper => Self::None,
            RecipeName::Default => Self::Track,
        }
    }
}

/// What smoothing did to one recording. Deviations are of one axis.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum TrackReport {
    Smoothed {
        /// Estimated error of the receiver, and how long it stays alike.
        receiver_std_m: f64,
        receiver_time_s: f64,
        /// Root mean square way that positions were moved.
        moved_m: f64,
        /// What is left of the error, as the model has it.
        remaining_std_m: f64,
        /// Matches of frames with other passes of the same street.
        views: usize,
    },
    LeftAlone(NotATrack),
}

impl TrackReport {
    /// What is left of the error, one standard deviation on either axis; `None` where nothing is known of it.
    pub fn remaining_std_m(&self) -> Option<f64> {
        match *self {
            Self::Smoothed { remaining_std_m, .. } => Some(remaining_std_m),
            Self::LeftAlone(_) => None,
        }
    }
}

/// Why the frames of a recording are no track.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum NotATrack {
    NoTime,
    NoYaw,
    TooFewFrames,
    NotAlongYaw,
    Undetermined,
}

impl NotATrack {
    pub fn describe(self) -> &'static str {
        match self {
            Self::NoTime => "not every frame has a time",
            Self::NoYaw => "not every frame has a yaw",
            Self::TooFewFrames => "too few frames",
            Self::NotAlongYaw => "the way from frame to frame does not follow the yaw",
            Self::Undetermined => "its motion does not determine it",
        }
    }
}
