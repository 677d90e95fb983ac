//! Frames in, estimates out: the hot path. After the first frame nothing is allocated.

use std::time::{Duration, Instant};

use super::large::{Features, LargeMap};
use super::likelihood::MapFields;
use super::motion::MotionSettings;
use super::tracker::{Observation, Tracked, Tracker};
use crate::features::scaling::Scaling;
use crate::features::{COMPASS_BYTES, Describer, Descriptor};
use crate::jpeg::{JpegError, LumaDecoder};
use crate::map::{MapError, MapInfo, OpenMap};
use crate::panorama::{Panorama, UnwrapTable};
use crate::types::{CalibrationError, DonutCalibration, PositionEstimate};

/// Of a map's fields, so many bytes stay in memory; a map that has more is read as it is needed.
pub const FIELDS_IN_MEMORY_BYTES: usize = 32 << 20;

/// Localizes the frames of one camera on one map.
pub struct Localizer {
    decoder: LumaDecoder,
    table: UnwrapTable,
    describer: Describer,
    panorama: Panorama,
    descriptors: Vec<Descriptor>,
    properties: Vec<Vec<f32>>,
    info: MapInfo,
    scalings: Vec<RowScaling>,
    fields: Fields,
    /// Of all groups, one behind the other.
    features: Vec<f32>,
    log_likelihood: Vec<f32>,
    scratch: Vec<f32>,
    compass: Vec<i8>,
    tracker: Tracker,
    timings: Timings,
}

/// z = W (y − μ) in single precision.
struct RowScaling {
    mean: Vec<f32>,
    /// W, row by row.
    projection: Vec<f32>,
}

/// What frames are matched with.
enum Fields {
    /// All of it is in memory.
    Whole(MapFields),
    Large(Box<LargeMap>),
}

/// Why there is no localizing on a map.
#[derive(Debug, thiserror::Error)]
pub enum LocalizerError {
    #[error("the map's donut does not lie within its images")]
    Calibration(#[from] CalibrationError),
    #[error(transparent)]
    Map(#[from] MapError),
}

/// Why a frame has no estimate of its own.
#[derive(Debug, thiserror::Error)]
pub enum FrameError {
    /// The frame cannot be used; [`Localizer::skip`] gives the estimate.
    #[error(transparent)]
    Jpeg(#[from] JpegError),
    /// Nothing can be said any more.
    #[error("the map cannot be read any more")]
    Map(#[from] MapError),
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
    /// `memory_bytes`: how much of the map's fields may be in memory.
    ///
    /// # Errors
    /// When the donut does not lie within the map's images, or the map cannot be read.
    pub fn new(map: OpenMap, settings: MotionSettings, memory_bytes: usize) -> Result<Self, LocalizerError> {
        let info = map.info.clone();
        let descriptors: Vec<Descriptor> = info.groups.iter().map(|group| group.recipe.descriptor).collect();
        let cells = map.cells.clone();
        let scalings: Vec<RowScaling> = map.scalings.iter().map(RowScaling::of).collect();
        let (fields, compass) = if map.fields_bytes() <= memory_bytes {
            let fields = MapFields::new(&info.groups, cells.len(), map.all_fields()?);
            (Fields::Whole(fields), map.compass(|_| true)?)
        } else {
            (Fields::Large(Box::new(LargeMap::new(map, memory_bytes, settings))), None)
        };
        Ok(Self {
            decoder: LumaDecoder::new(),
            table: table(&info, &info.calibration)?,
            describer: Describer::new(),
            panorama: Panorama::zeros(),
            properties: Describer::room_for(&descriptors),
            descriptors,
            features: vec![0.0; info.groups.iter().map(|group| group.features).sum()],
            log_likelihood: vec![0.0; cells.len()],
            scratch: Vec::with_capacity(cells.len()),
            compass: vec![0; COMPASS_BYTES],
            tracker: Tracker::on_cells(&info, &cells, compass, settings),
            timings: Timings::default(),
            info,
            scalings,
            fields,
        })
    }

    /// What the map says of itself.
    pub fn map_info(&self) -> &MapInfo {
        &self.info
    }

    /// Goes on with a donut that is elsewhere in the images, as if nothing had been seen before.
    ///
    /// # Errors
    /// When the donut does not lie within the map's images.
    pub fn look_through(&mut self, calibration: &DonutCalibration) -> Result<(), CalibrationError> {
        self.table = table(&self.info, calibration)?;
        self.tracker.start_again();
        Ok(())
    }

    /// The estimate after a frame. One that cannot be decoded, or is of another size than the map's, is skipped.
    ///
    /// # Errors
    /// Why the frame was skipped; or that the map's file has been damaged.
    pub fn take(&mut self, sequence: u32, stamp_ns: u64, jpeg: &[u8]) -> Result<Tracked, FrameError> {
        let mut watch = Stopwatch::start();
        let image = self.decoder.decode_needed(jpeg, self.table.needed())?;
        let expected = self.table.image_size_px();
        if (image.width_px, image.height_px) != expected {
            let (found_w, found_h) = (image.width_px, image.height_px);
            let (width_px, height_px) = expected;
            let what = format!("it has {found_w} x {found_h} px, the map's images have {width_px} x {height_px} px");
            return Err(JpegError::Damaged(what).into());
        }
        watch.lap(Stage::Decode);
        self.table.unwrap_into(image, 0, &mut self.panorama);
        watch.lap(Stage::Unwrap);
        self.describer.describe(&self.descriptors, &self.panorama, &mut self.properties);
        self.describer.compass(&self.descriptors, &self.panorama, &mut self.compass);
        watch.lap(Stage::Describe);
        self.scale();
        let nowhere = self.match_cells(stamp_ns)?;
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

    /// Properties → features.
    fn scale(&mut self) {
        let mut rest = self.features.as_mut_slice();
        for (scaling, properties) in self.scalings.iter().zip(&mut self.properties) {
            properties.iter_mut().zip(&scaling.mean).for_each(|(property, mean)| *property -= mean);
            let features;
            (features, rest) = rest.split_at_mut(scaling.projection.len() / properties.len());
            let rows = scaling.projection.chunks_exact(properties.len());
            features.iter_mut().zip(rows).for_each(|(feature, row)| *feature = dot(row, properties));
        }
    }

    /// Features → log-likelihood of every cell, and of no place.
    fn match_cells(&mut self, stamp_ns: u64) -> Result<Option<f32>, MapError> {
        let Self { features, scratch, log_likelihood, .. } = self;
        let nowhere = MapFields::log_likelihood_nowhere(&self.info.groups, features);
        match &mut self.fields {
            Fields::Whole(fields) => {
                log_likelihood.fill(0.0);
                fields.add_log_likelihood(features, scratch, log_likelihood);
            }
            Fields::Large(map) => {
                let frame = Features { stamp_ns, features, nowhere };
                map.match_frame(&frame, &mut self.tracker, scratch, log_likelihood)?;
            }
        }
        Ok(nowhere)
    }
}

fn table(info: &MapInfo, calibration: &DonutCalibration) -> Result<UnwrapTable, CalibrationError> {
    let [width_px, height_px] = info.image_size_px;
    UnwrapTable::build(calibration, width_px, height_px)
}

impl RowScaling {
    fn of(scaling: &Scaling) -> Self {
        let rows = (0..scaling.features()).flat_map(|r| scaling.projection.row(r).iter());
        Self {
            mean: scaling.mean.iter().map(|&mean| mean as f32).collect(),
            projection: rows.map(|&w| w as f32).collect(),
        }
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
