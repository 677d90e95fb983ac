//! The topics of a recording: name, schema, content.
//!
//! | topic | schema | content |
//! |---|---|---|
//! | `/camera/image` | foxglove.CompressedImage | the JPEG; the MCAP sequence number is the frame's number |
//! | `/gnss/raw` | omniloc.SerialChunk | bytes as received |
//! | `/gnss/fix` | foxglove.LocationFix | position on WGS84, only if the origin is known |
//! | `/gnss/heading` | omniloc.Heading | yaw and where it came from |
//! | `/gnss/pulse` | omniloc.Pulse | edges of the receiver's pulse a second |
//! | `/survey/pair` | omniloc.SurveyPair | where the vehicle was when a frame was exposed |
//! | `/survey/pose` | foxglove.PoseInFrame | the same in the frame `map`, for viewers |
//! | `/clock` | omniloc.ClockOffset | monotonic clock, realtime and UTC of the receiver side by side |
//! | `/status` | omniloc.Status | rates, lag, disk, temperature: once a second |
//! | `/dropped` | omniloc.Dropped | every loss: what, how much, why |
//! | `/pose/estimate` | omniloc.PositionEstimate | where the localizer takes the vehicle to be |
//!
//! Where frames are localized, `/survey/pose` shows the estimates that may be relied on.

/// A topic and the schema of its messages.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Topic {
    pub name: &'static str,
    pub schema_name: &'static str,
    /// Serialized `FileDescriptorSet` with everything the message imports.
    pub schema: &'static [u8],
}

macro_rules! topic {
    ($name:literal, $schema:literal) => {
        Topic {
            name: $name,
            schema_name: $schema,
            schema: include_bytes!(concat!(env!("OUT_DIR"), "/", $schema, ".fds")),
        }
    };
}

pub static CAMERA_IMAGE: Topic = topic!("/camera/image", "foxglove.CompressedImage");
pub static GNSS_RAW: Topic = topic!("/gnss/raw", "omniloc.SerialChunk");
pub static GNSS_FIX: Topic = topic!("/gnss/fix", "foxglove.LocationFix");
pub static GNSS_HEADING: Topic = topic!("/gnss/heading", "omniloc.Heading");
pub static GNSS_PULSE: Topic = topic!("/gnss/pulse", "omniloc.Pulse");
pub static SURVEY_PAIR: Topic = topic!("/survey/pair", "omniloc.SurveyPair");
pub static SURVEY_POSE: Topic = topic!("/survey/pose", "foxglove.PoseInFrame");
pub static CLOCK: Topic = topic!("/clock", "omniloc.ClockOffset");
pub static STATUS: Topic = topic!("/status", "omniloc.Status");
pub static DROPPED: Topic = topic!("/dropped", "omniloc.Dropped");
pub static POSE_ESTIMATE: Topic = topic!("/pose/estimate", "omniloc.PositionEstimate");

/// All topics, in the order a recorder declares them in. A new one comes last: [`recover`](super::recover) takes channel
/// numbers of older recordings for places in this list.
pub static ALL: [&Topic; 11] = [
    &CAMERA_IMAGE,
    &GNSS_RAW,
    &GNSS_FIX,
    &GNSS_HEADING,
    &GNSS_PULSE,
    &SURVEY_PAIR,
    &SURVEY_POSE,
    &CLOCK,
    &STATUS,
    &DROPPED,
    &POSE_ESTIMATE,
];

/// Topics whose messages carry the number of the frame that they belong to.
pub static OF_FRAMES: [&Topic; 3] = [&SURVEY_PAIR, &SURVEY_POSE, &POSE_ESTIMATE];

/// The ENU frame of all positions.
pub const MAP_FRAME: &str = "map";
/// The camera's frame of reference.
pub const CAMERA_FRAME: &str = "camera";
/// The receiver's frame of reference.
pub const GNSS_FRAME: &str = "gnss";

/// The attachment that holds the donut calibration, as JSON.
pub const CALIBRATION_ATTACHMENT: &str = "donut.json";

/// Metadata records.
pub mod metadata {
    /// Program and version that wrote the recording.
    pub const PROGRAM: &str = "program";
    /// Resolved settings.
    pub const SETTINGS: &str = "settings";
    /// Name and kind of the source.
    pub const SOURCE: &str = "source";
    /// Frames and units, for people.
    pub const CONVENTIONS: &str = "conventions";
    /// Where east = north = 0 lies: `latitude_deg`, `longitude_deg`, `altitude_m`. Absent if unknown.
    pub const ORIGIN: &str = "origin";
    /// Size of the images and what is known about the camera.
    pub const CAMERA: &str = "camera";
    /// `log_offset_ns`: log time minus stamp. Absent: they are the same.
    pub const CLOCK: &str = "clock";
    /// The recording was mended: what was lost.
    pub const RECOVERY: &str = "recovery";
}
