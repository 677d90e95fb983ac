//! Frames in, estimates out: the hot path. After the first frame nothing is allocated.

use std::time::{Duration, Instant};

use super::likelihood::FieldOnCells;
use super::motion::MotionSettings;
use super::tracker::{Observation, Tracked, Tracker};
use crate::features::{COMPASS_BYTES, Describer, Descriptor};
use crate::jpeg::{JpegError, LumaDecoder};
use crate::map::{FeatureMap, NoiseModel};
use crate::panorama::{Panorama, UnwrapTable};
use crate::types::{CalibrationError, DonutCalibration, PositionEstimate};

/// Localizes the frames of one camera on one map.
pub struct Localizer {
    decoder: LumaDecoder,
    table: UnwrapTable,
    describer: Describer,
    panorama: Panorama,
    descriptors: Vec<Descriptor>,
    properties: Vec<Vec<f32>>,
    groups: Vec<Group>,
    /// Of all groups, one behind the other.
    features: Vec<f32>,
    log_likelihood: Vec<f32>,
    scratch: Vec<f32>,
    compass: Vec<i8>,
    tracker: Tracker,
    timings: Timings,
}

/// One descriptor's part: z = W (y − μ) and the field of z on the cells.
struct Group {
    mean: Vec<f32>,
    /// W, row by row.
    projection: Vec<f32>,
    field: FieldOnCells,
    noise: NoiseModel,
    weight: f32,
}

/// The steps of a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Stage {
    Decode,
    Unwrap,
    Describe,
    Match,
    Track,
}

impl Stage {
    pub const ALL: [Self; 5] = [Self::Decode, Self::Unwrap, Self::Describe, Self::Match, Self::Track];

    pub fn name(self) -> &'static str {
        match self {
            Self::Decode => "decode",
            Self::Unwrap => "unwrap",
            Self::Describe => "describe",
            Self::Match => "match",
            Self::Track => "track",
        }
    }
}

/// How long the steps took, over all frames.
#[derive(Debug, Clone, Copy, Default)]
pub struct Timings {
    frames: u32,
    stages: [Duration; Stage::ALL.len()],
    longest: Duration,
}

impl Timings {
    pub fn frames(&self) -> u32 {
        self.frames
    }

    /// The mean time of a step.
    pub fn mean(&self, stage: Stage) -> Duration {
        self.stages[stage as usize] / self.frames.max(1)
    }

    /// The mean time from the JPEG to the estimate.
    pub fn mean_frame(&self) -> Duration {
        self.stages.iter().sum::<Duration>() / self.frames.max(1)
    }

    /// The longest that a frame took.
    pub fn longest(&self) -> Duration {
        self.longest
    }
}

impl Localizer {
    /// `calibration`: where the donut is now; the map's own, or a little beside it.
    ///
    /// # Errors
    /// When the donut does not lie within the map's images.
    pub fn new(
        map: &FeatureMap,
        calibration: &DonutCalibration,
        settings: MotionSettings,
    ) -> Result<Self, CalibrationError> {
        let [width_px, height_px] = map.info.image_size_px;
        let descriptors: Vec<Descriptor> = map.info.groups.iter().map(|group| group.recipe.descriptor).collect();
        let groups = map.info.groups.iter().zip(&map.groups).map(|(info, group)| Group {
            mean: group.scaling.mean.iter().map(|&mean| mean as f32).collect(),
            projection: (0..group.scaling.features())
                .flat_map(|r| group.scaling.projection.row(r).iter().map(|&w| w as f32).collect::<Vec<_>>())
                .collect(),
            field: FieldOnCells::of(group),
            noise: info.recipe.noise,
            weight: info.recipe.weight as f32,
        });
        Ok(Self {
            decoder: LumaDecoder::new(),
            table: UnwrapTable::build(calibration, width_px, height_px)?,
            describer: Describer::new(),
            panorama: Panorama::zeros(),
            properties: Describer::room_for(&descriptors),
            groups: groups.collect(),
            descriptors,
            features: vec![0.0; map.groups.iter().map(|group| group.scaling.features()).sum()],
            log_likelihood: vec![0.0; map.cells.len()],
            scratch: Vec::with_capacity(map.cells.len()),
            compass: vec![0; COMPASS_BYTES],
            tracker: Tracker::new(map, settings),
            timings: Timings::default(),
        })
    }

    /// The estimate after a frame. One that cannot be decoded, or is of another size than the map's, is skipped.
    ///
    /// # Errors
    /// Why the frame was skipped; [`skip`](Self::skip) gives the estimate.
    pub fn take(&mut self, sequence: u32, stamp_ns: u64, jpeg: &[u8]) -> Result<Tracked, JpegError> {
        let mut watch = Stopwatch::start();
        let image = self.decoder.decode_needed(jpeg, self.table.needed())?;
        let expected = self.table.image_size_px();
        if (image.width_px, image.height_px) != expected {
            let (found_w, found_h) = (image.width_px, image.height_px);
            let (width_px, height_px) = expected;
            return Err(JpegError::Damaged(format!(
                "it has {found_w} x {found_h} px, the map's images have {width_px} x {height_px} px"
            )));
        }
        watch.lap(Stage::Decode);
        self.table.unwrap_into(image, 0, &mut self.panorama);
        watch.lap(Stage::Unwrap);
        self.describer.describe(&self.descriptors, &self.panorama, &mut self.properties);
        self.describer.compass(&self.descriptors, &self.panorama, &mut self.compass);
        watch.lap(Stage::Describe);
        let nowhere = self.match_cells();
        watch.lap(Stage::Match);
        let observation = Observation {
            sequence,
            stamp_ns,
            log_likelihood: &self.log_likelihood,
            nowhere,
            features: &self.features,
            compass: &self.compass,
        };
        let tracked = self.tracker.take(&observation);
        watch.lap(Stage::Track);
        self.timings.add(&watch);
        Ok(tracked)
    }

    /// The estimate after a frame that could not be used.
    pub fn skip(&mut self, sequence: u32, stamp_ns: u64) -> PositionEstimate {
        self.tracker.skip(sequence, stamp_ns)
    }

    pub fn timings(&self) -> &Timings {
        &self.timings
    }

    /// Properties → features → log-likelihood of every cell, and of no place.
    fn match_cells(&mut self) -> Option<f32> {
        self.log_likelihood.fill(0.0);
        let mut nowhere = Some(0.0);
        let mut rest = self.features.as_mut_slice();
        for (group, properties) in self.groups.iter().zip(&mut self.properties) {
            let features;
            (features, rest) = rest.split_at_mut(group.field.features());
            properties.iter_mut().zip(&group.mean).for_each(|(property, mean)| *property -= mean);
            let rows = group.projection.chunks_exact(properties.len());
            features.iter_mut().zip(rows).for_each(|(feature, row)| *feature = dot(row, properties));
            let Group { field, noise, weight, .. } = group;
            field.add_log_likelihood(features, *noise, *weight, &mut self.scratch, &mut self.log_likelihood);
            let of_group = field.log_likelihood_nowhere(features, *noise);
            nowhere = nowhere.zip(of_group).map(|(sum, value)| sum + weight * value);
        }
        nowhere
    }
}

/// Σ a_i b_i in eight sums: the same order on every processor.
fn dot(a: &[f32], b: &[f32]) -> f32 {
    const LANES: usize = 8;
    let mut sums = [0.0_f32; LANES];
    let (a_lanes, b_lanes) = (a.chunks_exact(LANES), b.chunks_exact(LANES));
    let rest: f32 = a_lanes.remainder().iter().zip(b_lanes.remainder()).map(|(a, b)| a * b).sum();
    for (a, b) in a_lanes.zip(b_lanes) {
        for lane in 0..LANES {
            sums[lane] += a[lane] * b[lane];
        }
    }
    sums.iter().sum::<f32>() + rest
}

struct Stopwatch {
    last: Instant,
    laps: [Duration; Stage::ALL.len()],
}

impl Stopwatch {
    fn start() -> Self {
        Self { last: Instant::now(), laps: [Duration::ZERO; Stage::ALL.len()] }
    }

    fn lap(&mut self, stage: Stage) {
        let now = Instant::now();
        self.laps[stage as usize] = now - self.last;
        self.last = now;
    }
}

impl Timings {
    fn add(&mut self, watch: &Stopwatch) {
        self.frames += 1;
        self.stages.iter_mut().zip(&watch.laps).for_each(|(sum, lap)| *sum += *lap);
        self.longest = self.longest.max(watch.laps.iter().sum());
    }
}
