//! Where the vehicle is, and how sure that is.

use super::PositionM;

/// How much is known of where the vehicle is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum LocalizationState {
    /// Nothing yet.
    Unknown,
    /// One place is likelier than the others, not yet surely so.
    Candidate,
    /// The vehicle is where the estimate says, with the covariance it says.
    Localized,
    /// It was localized, and what the camera sees now contradicts it.
    Lost,
}

impl LocalizationState {
    /// The word for it in messages and files.
    pub fn name(self) -> &'static str {
        match self {
            Self::Unknown => "unknown",
            Self::Candidate => "candidate",
            Self::Localized => "localized",
            Self::Lost => "lost",
        }
    }
}

/// Covariance of a position, east and north \[m²\].
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct PositionCovariance {
    pub ee_m2: f64,
    pub en_m2: f64,
    pub nn_m2: f64,
}

impl PositionCovariance {
    pub fn scaled(self, factor: f64) -> Self {
        Self { ee_m2: factor * self.ee_m2, en_m2: factor * self.en_m2, nn_m2: factor * self.nn_m2 }
    }
}

/// What is known after a frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PositionEstimate {
    /// The frame's number.
    pub sequence: u32,
    /// When its exposure started, on the monotonic clock.
    pub stamp_ns: u64,
    pub state: LocalizationState,
    /// Of all frames so far. There is one in the state [`Localized`](LocalizationState::Localized) and in no other.
    pub pose: Option<EstimatedPose>,
    /// Of this frame alone: for diagnosis, not to steer by. `None` where the frame could not be used.
    pub single_frame_m: Option<PositionM>,
    pub warnings: EstimateWarnings,
}

/// A pose that may be relied on as far as its deviations say.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct EstimatedPose {
    /// In the map frame.
    pub position_m: PositionM,
    pub covariance: PositionCovariance,
    /// East, north \[m/s\], from the change of the position.
    pub velocity_mps: Option<[f64; 2]>,
    pub heading: Option<EstimatedHeading>,
}

/// Where the vehicle points.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct EstimatedHeading {
    /// From east, counter-clockwise, in (−π, π].
    pub yaw_rad: f64,
    /// One standard deviation.
    pub yaw_std_rad: f64,
}

/// What is unusual about a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct EstimateWarnings {
    /// It was damaged or could not be decoded, and was not used.
    pub bad_frame: bool,
    /// It resembles no place of the map: another place, or one that has changed.
    pub unlike_the_map: bool,
    /// It contradicts the frames before it.
    pub contradiction: bool,
    /// Several places are about as likely.
    pub ambiguous: bool,
}

impl EstimateWarnings {
    /// The words for those that hold.
    pub fn words(self) -> impl Iterator<Item = &'static str> {
        let all = [
            (self.bad_frame, "bad frame"),
            (self.unlike_the_map, "unlike the map"),
            (self.contradiction, "contradiction"),
            (self.ambiguous, "ambiguous"),
        ];
        all.into_iter().filter_map(|(holds, word)| holds.then_some(word))
    }
}
