//! Recordings → positions and properties of every frame: what training and evaluation work on.

use std::collections::BTreeMap;

use faer::Mat;

use super::panoramas::describe_panoramas;
use super::perturbation::perturbed;
use super::track::{KeptImage, PointFollower, PointTrack, Sighting};
use crate::features::{COMPASS_BYTES, Describer, Descriptor};
use crate::panorama::Panorama;
use crate::recording::{Recording, RecordingError, SurveyFrame};
use crate::types::{DonutCalibration, Geodetic, PositionM};

/// All usable frames of one or more recordings of a place.
#[derive(Debug, Clone)]
pub struct Survey {
    pub calibration: DonutCalibration,
    pub origin: Option<Geodetic>,
    /// Width and height of the camera images \[px\].
    pub image_size_px: (usize, usize),
    pub frames: Vec<SurveyedFrame>,
    /// Frame × [`COMPASS_BYTES`]; empty if not asked for.
    compass: Vec<i8>,
    points: Vec<PointTrack>,
    /// Of each frame, if points were followed through it.
    images: Vec<Option<KeptImage>>,
    properties: BTreeMap<Descriptor, Properties>,
}

/// One frame, without its pixels.
#[derive(Debug, Clone, PartialEq)]
pub struct SurveyedFrame {
    /// Which of the recordings, counted from 0.
    pub recording: usize,
    /// The frame's own index in its recording.
    pub index: usize,
    pub stamp_ns: u64,
    pub position_m: PositionM,
    pub yaw_rad: Option<f64>,
    /// On the recording's own clock; `None` where stamps only count.
    pub time_s: Option<f64>,
}

#[derive(Debug, Clone, Default)]
struct Properties {
    /// Frame × property.
    clean: Vec<f32>,
    /// Frame × repetition × property: perturbed minus clean.
    changes: Vec<f32>,
}

/// What is to be computed.
#[derive(Debug, Clone, PartialEq)]
pub struct SurveyOptions {
    pub descriptors: Vec<Descriptor>,
    /// Turn every panorama by its yaw so that column 0 looks east: the paper's “(fixed)” rows.
    pub fixed: bool,
    /// Compass signatures too.
    pub compass: bool,
    /// Points of the scene are followed from frame to frame, where all frames of a recording have a yaw and a time.
    pub follow: bool,
    /// Perturbed copies of every frame, for the descriptors in `perturbed`.
    pub repetitions: usize,
    pub perturbed: Vec<Descriptor>,
    pub seed: u64,
}

#[derive(Debug, thiserror::Error)]
pub enum SurveyError {
    #[error(transparent)]
    Recording(#[from] RecordingError),
    #[error("{recording}: frame {index}")]
    Frame { recording: String, index: usize, source: crate::jpeg::JpegError },
    #[error(
        "{recording}: frame {index} is {found:?} px, the frames before it {expected:?} px: one camera setting a recording"
    )]
    SizeChanged { recording: String, index: usize, found: (usize, usize), expected: (usize, usize) },
    #[error("{recording}")]
    Calibration { recording: String, source: crate::types::CalibrationError },
    #[error(
        "mixed calibrations: {first} has {expected}, {other} has {found}; \
         a map is of one lens: calibrate both alike or train two maps"
    )]
    MixedCalibrations { first: String, other: String, expected: String, found: String },
    #[error("only one of {first} and {other} knows where on the Earth it lies: they cannot be put into one map")]
    MixedOrigins { first: String, other: String },
    #[error("{recording}: frame {index} has no yaw, which turning the panorama needs")]
    NoYaw { recording: String, index: usize },
}

impl Survey {
    /// Reads every usable frame of `recordings`. `on_frames` is told how many more are done.
    ///
    /// # Errors
    /// Names the recording and the frame.
    pub fn read(
        recordings: &[Recording],
        options: &SurveyOptions,
        on_frames: impl Fn(usize),
    ) -> Result<Self, SurveyError> {
        let first = &recordings[0];
        let calibration = first.calibration()?;
        let mut survey = Self {
            calibration,
            origin: first.origin,
            image_size_px: (0, 0),
            frames: Vec::new(),
            compass: Vec::new(),
            points: Vec::new(),
            images: Vec::new(),
            properties: options.descriptors.iter().map(|&descriptor| (descriptor, Properties::default())).collect(),
        };
        for (number, recording) in recordings.iter().enumerate() {
            survey.check_same_lens(first, recording)?;
            survey.append(number, recording, options, &on_frames)?;
        }
        Ok(survey)
    }

    fn check_same_lens(&self, first: &Recording, recording: &Recording) -> Result<(), SurveyError> {
        let found = recording.calibration()?;
        let names = || (first.path.display().to_string(), recording.path.display().to_string());
        if found != self.calibration {
            let (first, other) = names();
            let describe = |c: &DonutCalibration| {
                let (x, y) = (c.center_x_px, c.center_y_px);
                format!("centre ({x}, {y}) and radii {}..{} px", c.inner_radius_px, c.outer_radius_px)
            };
            let (expected, found) = (describe(&self.calibration), describe(&found));
            return Err(SurveyError::MixedCalibrations { first, other, expected, found });
        }
        if recording.origin != self.origin {
            let (first, other) = names();
            return Err(SurveyError::MixedOrigins { first, other });
        }
        Ok(())
    }

    /// Decodes, unwraps and describes the frames of a recording, and appends them.
    fn append(
        &mut self,
        number: usize,
        recording: &Recording,
        options: &SurveyOptions,
        on_frames: impl Fn(usize),
    ) -> Result<(), SurveyError> {
        let first = self.frames.len();
        let describe = |describer: &mut Describer, i: usize, panorama: &Panorama| {
            describe_frame(describer, panorama, options, (first + i) as u64)
        };
        let is_track = |frame: &SurveyFrame| frame.yaw_rad.is_some() && frame.known_time_s().is_some();
        let mut follower = (options.follow && recording.survey.iter().all(is_track))
            .then(|| PointFollower::new(self.calibration.azimuth));
        let mut sightings: Vec<Vec<Sighting>> = Vec::new();
        let take = |frame: SurveyFrame, DescribedFrame { properties, compass, wide }| {
            self.images.push(follower.is_some().then(|| KeptImage::new(&wide, self.calibration.azimuth)));
            if let (Some(follower), Some(yaw_rad)) = (&mut follower, frame.yaw_rad) {
                sightings.push(follower.take(&wide, yaw_rad));
            }
            self.compass.extend(compass);
            self.frames.push(SurveyedFrame {
                recording: number,
                index: frame.index,
                stamp_ns: frame.stamp_ns,
                position_m: frame.position_m,
                yaw_rad: frame.yaw_rad,
                time_s: frame.known_time_s(),
            });
            for (descriptor, (clean, changes)) in options.descriptors.iter().zip(properties) {
                let of_descriptor = self.properties.get_mut(descriptor).expect("made for these descriptors");
                of_descriptor.clean.extend(clean);
                of_descriptor.changes.extend(changes);
            }
        };
        let image_size_px = describe_panoramas(recording, options.fixed, Describer::new, describe, take, on_frames)?;
        self.image_size_px = image_size_px.unwrap_or(self.image_size_px);
        self.points.extend(PointTrack::gather(first, &sightings));
        Ok(())
    }

    pub fn len(&self) -> usize {
        self.frames.len()
    }

    pub fn is_empty(&self) -> bool {
        self.frames.is_empty()
    }

    /// Positions as recorded \[m\].
    pub fn positions_m(&self) -> Vec<PositionM> {
        self.frames.iter().map(|frame| frame.position_m).collect()
    }

    /// Numbers of the recordings that the frames at `rows` are from.
    pub fn recordings_of(&self, rows: &[usize]) -> Vec<usize> {
        rows.iter().map(|&row| self.frames[row].recording).collect()
    }

    /// Compass signatures of all frames, frame × [`COMPASS_BYTES`]; empty if they were not asked for.
    pub fn compass(&self) -> &[i8] {
        &self.compass
    }

    /// Points of the scene that were followed.
    pub fn points(&self) -> &[PointTrack] {
        &self.points
    }

    /// Of every frame, where points were followed.
    pub fn images(&self) -> &[Option<KeptImage>] {
        &self.images
    }

    /// What the frames are described by.
    pub fn descriptors(&self) -> Vec<Descriptor> {
        self.properties.keys().copied().collect()
    }

    /// Properties of the frames at `rows`, n × d.
    ///
    /// # Panics
    /// When the survey was read without this descriptor.
    pub fn properties(&self, descriptor: Descriptor, rows: &[usize]) -> Mat<f64> {
        let (values, d) = (&self.properties[&descriptor].clean, descriptor.dimensions());
        Mat::from_fn(rows.len(), d, |i, k| f64::from(values[rows[i] * d + k]))
    }

    /// How perturbations changed the properties of the frames at `rows`, (n · repetitions) × d; no rows for a descriptor
    /// that was not perturbed.
    pub fn changes(&self, descriptor: Descriptor, rows: &[usize]) -> Mat<f64> {
        let (values, d) = (&self.properties[&descriptor].changes, descriptor.dimensions());
        let repetitions = values.len() / (self.frames.len() * d).max(1);
        let at = |i: usize| (rows[i / repetitions] * repetitions + i % repetitions) * d;
        Mat::from_fn(rows.len() * repetitions, d, |i, k| f64::from(values[at(i) + k]))
    }
}

/// What is kept of one panorama.
struct DescribedFrame {
    /// Properties and how they change under perturbations, a pair a descriptor.
    properties: Vec<(Vec<f32>, Vec<f32>)>,
    compass: Vec<i8>,
    wide: Vec<f32>,
}

fn describe_frame(
    describer: &mut Describer,
    panorama: &Panorama,
    options: &SurveyOptions,
    stream: u64,
) -> DescribedFrame {
    let mut clean = Describer::room_for(&options.descriptors);
    describer.describe(&options.descriptors, panorama, &mut clean);
    let mut compass = vec![0; if options.compass { COMPASS_BYTES } else { 0 }];
    if options.compass {
        describer.compass(&options.descriptors, panorama, &mut compass);
    }
    let mut changes = vec![Vec::new(); options.descriptors.len()];
    let mut there = Describer::room_for(&options.perturbed);
    for repetition in 0..if options.perturbed.is_empty() { 0 } else { options.repetitions as u64 } {
        let other_day = perturbed(panorama, options.seed, stream * options.repetitions as u64 + repetition);
        describer.describe(&options.perturbed, &other_day, &mut there);
        for (descriptor, there) in options.perturbed.iter().zip(&there) {
            let at = options.descriptors.iter().position(|other| other == descriptor);
            let at = at.expect("what is perturbed is also described");
            changes[at].extend(there.iter().zip(&clean[at]).map(|(there, here)| there - here));
        }
    }
    let wide = if options.follow { panorama.wide.clone() } else { Vec::new() };
    DescribedFrame { properties: clean.into_iter().zip(changes).collect(), compass, wide }
}
