//! The map: what localizing needs to know of a place.
//!
//! A map is made by [`train`](crate::train) and never changed by localizing. It holds one *group* a descriptor: the
//! scaling that turns properties into features, the learning features with the hyperparameters of their Gaussian
//! processes, and the posterior of every feature on the candidate cells, which is all that matching a frame reads.

// The same estimates on every computer.
#![cfg_attr(not(test), deny(clippy::disallowed_methods))]

mod blocks;
mod cells;
mod compass;
pub mod file;
mod recipe;
mod track;

use faer::Mat;
use serde::{Deserialize, Serialize};

pub use blocks::{BLOCK_SIDE, Block};
pub use cells::{CandidateCells, CellsError, Grid};
pub use compass::Compass;
pub use file::{FORMAT_VERSION, GroupField, MapError, OpenMap};
pub use recipe::{
    GroupHyperparameters, GroupRecipe, Model, NoiseModel, NoiseWhiteningSettings, PERTURBED_COPIES, Recipe, RecipeName,
    Selection, SplitKind,
};
pub use track::{NotATrack, Smoothing, TrackReport};

use crate::features::scaling::Scaling;
use crate::gp::Hyperparameters;
use crate::jpeg::MAX_SIDE_PX;
use crate::types::{DonutCalibration, Geodetic, PositionM};

#[derive(Debug, Clone)]
pub struct FeatureMap {
    pub info: MapInfo,
    /// Learning positions \[m\].
    pub positions_m: Vec<PositionM>,
    pub cells: CandidateCells,
    /// In the order of [`MapInfo::groups`].
    pub groups: Vec<MapGroup>,
    /// Panoramas of known heading, where the recordings have a yaw for every frame.
    pub compass: Option<Compass>,
}

/// The numbers of one group: d properties, k features, n learning positions, c cells.
#[derive(Debug, Clone)]
pub struct MapGroup {
    pub scaling: Scaling,
    /// Learning features, n × k.
    pub learning: Mat<f64>,
    /// Posterior mean, k × c.
    pub field_mean: Vec<f32>,
    /// Predictive variance, noise included: k × c, or 1 × c where all features share it.
    pub field_variance: Vec<f32>,
}

/// Everything but the large arrays.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct MapInfo {
    pub format_version: u32,
    /// Version of the program that trained it.
    pub program: String,
    pub recordings: Vec<TrainedOn>,
    pub recipe: RecipeName,
    pub selection: Selection,
    /// Positions are refined between the cells.
    pub refine: bool,
    pub split: SplitKind,
    pub seed: u64,
    pub origin: Option<Geodetic>,
    pub calibration: DonutCalibration,
    /// Width and height of the camera images \[px\].
    pub image_size_px: [usize; 2],
    pub grid: Grid,
    pub groups: Vec<GroupInfo>,
    /// p(cell) ∝ exp(log-likelihood / temperature): learned from frames that were held back, whole recordings of them
    /// where there are several.
    pub temperature: f64,
    /// How many times as much as in the map's own gaps between learning images frames err in those in which the temperature was
    /// learned: the variance of what a frame says of its place is divided by the square.
    pub gap_ratio: f64,
    /// Frames that resemble their best cell less than this for a while are of no place in the map: how much likelier it is
    /// than no place, in nats at the map's temperature. `None` where the map cannot tell.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub least_resemblance: Option<f64>,
    /// One standard deviation of headings, measured on the learning panoramas \[rad\]. `None` without a compass.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub heading_std_rad: Option<f64>,
    /// Errors on frames that the choices were made on but that nothing was fitted to.
    pub validation: Vec<ValidationFigures>,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TrainedOn {
    pub name: String,
    pub frames: usize,
    /// What was made of its positions; `None` where they were to be taken as they are.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub track: Option<TrackReport>,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct GroupInfo {
    pub recipe: GroupRecipe,
    /// Features before and after the selection.
    pub rank: usize,
    pub features: usize,
    pub hyperparameters: GroupHyperparameters,
}

/// Single-frame errors of one group, or of all fused \[m\].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ValidationFigures {
    pub features: String,
    pub frames: usize,
    pub rmse_m: f64,
    pub median_m: f64,
    pub p95_m: f64,
    pub share_over_10m: f64,
    /// 1 − RMSE / RMSE of always answering the median of the learning positions.
    pub skill: f64,
}

/// Donuts whose centre or radii differ by more than this are of another lens, or of one that was moved \[px\].
const SAME_LENS_PX: f64 = 3.0;

#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error(
    "the map is of another lens: {what} is {found} here and {expected} in the map; \
     calibrate the recording, or train a map with this lens"
)]
pub struct OtherLens {
    what: &'static str,
    found: String,
    expected: String,
}

impl MapInfo {
    /// Refuses what no training writes: a file may hold anything. The grid is checked with its cells.
    fn check(&self) -> Result<(), String> {
        let [width_px, height_px] = self.image_size_px;
        if width_px > MAX_SIDE_PX || height_px > MAX_SIDE_PX {
            return Err(format!("images of {width_px} x {height_px} px"));
        }
        self.calibration.check_in_image(width_px, height_px).map_err(|error| error.to_string())?;
        if self.origin.is_some_and(|origin| !origin.is_plausible()) {
            return Err("its origin is not on Earth".into());
        }
        if self.groups.is_empty() || self.recordings.is_empty() {
            return Err("it has no groups of features, or no recordings".into());
        }
        if self.least_resemblance.is_some_and(|least| !(-1e6..=1e6).contains(&least)) {
            return Err("a resemblance that cannot be".into());
        }
        if self.heading_std_rad.is_some_and(|std_rad| !(1e-6..=10.0).contains(&std_rad)) {
            return Err("a deviation of headings that cannot be".into());
        }
        if !(1e-3..=1e6).contains(&self.temperature) {
            return Err(format!("temperature {:e}", self.temperature));
        }
        if !(1e-2..=1e2).contains(&self.gap_ratio) {
            return Err(format!("a ratio of gaps of {:e}", self.gap_ratio));
        }
        for (i, group) in self.groups.iter().enumerate() {
            let name = group.recipe.descriptor;
            if self.groups[..i].iter().any(|other| other.recipe.descriptor == name) {
                return Err(format!("{name} is there twice"));
            }
            if !(1..=group.rank).contains(&group.features) || group.rank > name.dimensions() {
                let (features, rank, m) = (group.features, group.rank, name.dimensions());
                return Err(format!("{name}: {features} features of rank {rank} from {m} properties"));
            }
            let fitted: Vec<Hyperparameters> = match &group.hyperparameters {
                GroupHyperparameters::Shared(shared) => vec![*shared],
                GroupHyperparameters::Each(fits) if fits.len() == group.features => {
                    fits.iter().map(|fit| fit.hyperparameters).collect()
                }
                GroupHyperparameters::Each(fits) => {
                    return Err(format!("{name}: {} fits of {} features", fits.len(), group.features));
                }
            };
            let positive = |values: &Hyperparameters| {
                let [l1, l2] = values.length_scale_m;
                [values.signal_std, values.noise_std, l1, l2].iter().all(|value| value.is_finite() && *value > 0.0)
            };
            if !fitted.iter().all(positive) {
                return Err(format!("{name}: hyperparameters that are not positive"));
            }
        }
        Ok(())
    }

    /// One standard deviation, on either axis, of the positions that the map was learned from, as far as smoothing knows
    /// it; 0 where they were taken as they are \[m\].
    pub fn position_std_m(&self) -> f64 {
        let known = |recording: &TrainedOn| {
            let remaining_std_m = recording.track?.remaining_std_m()?;
            Some((recording.frames as f64, remaining_std_m * remaining_std_m))
        };
        let (frames, sum_m2) = (self.recordings.iter().filter_map(known))
            .fold((0.0, 0.0), |(n, sum), (frames, variance_m2)| (n + frames, sum + frames * variance_m2));
        if frames > 0.0 { (sum_m2 / frames).sqrt() } else { 0.0 }
    }

    /// Refuses frames of a camera that the map does not fit: other image size, other donut.
    pub fn check_lens(&self, donut: &DonutCalibration, image_size_px: (usize, usize)) -> Result<(), OtherLens> {
        let ours = &self.calibration;
        let other = |what, found: String, expected: String| Err(OtherLens { what, found, expected });
        if image_size_px != self.image_size_px.into() {
            let size = |width_px, height_px| format!("{width_px} x {height_px} px");
            let found = size(image_size_px.0, image_size_px.1);
            return other("the image size", found, size(self.image_size_px[0], self.image_size_px[1]));
        }
        for (what, found, expected) in [
            ("the centre's x", donut.center_x_px, ours.center_x_px),
            ("the centre's y", donut.center_y_px, ours.center_y_px),
            ("the inner radius", donut.inner_radius_px, ours.inner_radius_px),
            ("the outer radius", donut.outer_radius_px, ours.outer_radius_px),
        ] {
            if (found - expected).abs() > SAME_LENS_PX {
                return other(what, format!("{found:.1} px"), format!("{expected:.1} px"));
            }
        }
        if donut.top_is_outer != ours.top_is_outer {
            return other("top_is_outer", donut.top_is_outer.to_string(), ours.top_is_outer.to_string());
        }
        Ok(())
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::features::{COMPASS_BYTES, Descriptor};
    use crate::types::{AzimuthSense, LensKind};

    /// Three positions, two features of `sp`.
    pub fn small_map() -> FeatureMap {
        let positions_m = vec![[0.0, 0.0], [1.0, 0.5], [2.0, 1.0]];
        let cells = CandidateCells::around(&positions_m, 1.0, None).expect("a small grid");
        let recipe = Recipe::new(RecipeName::Default, &[Descriptor::Sp]);
        let hyperparameters = Hyperparameters { signal_std: 1.0, noise_std: 0.5, length_scale_m: [2.0; 2] };
        let d = Descriptor::Sp.dimensions();
        let c = cells.len();
        FeatureMap {
            info: MapInfo {
                format_version: FORMAT_VERSION,
                program: "0.0.0".into(),
                recordings: vec![TrainedOn { name: "yard".into(), frames: 3, track: None }],
                recipe: RecipeName::Default,
                selection: Selection::None,
                refine: true,
                split: SplitKind::Random,
                seed: 0,
                origin: None,
                calibration: DonutCalibration {
                    kind: LensKind::Donut,
                    center_x_px: 320.0,
                    center_y_px: 240.0,
                    inner_radius_px: 50.0,
                    outer_radius_px: 200.0,
                    top_is_outer: true,
                    start_angle_rad: 0.0,
                    clockwise: true,
                    azimuth: AzimuthSense::Ccw,
                },
                image_size_px: [640, 480],
                grid: cells.grid,
                groups: vec![GroupInfo {
                    recipe: recipe.groups[0],
                    rank: 3,
                    features: 2,
                    hyperparameters: GroupHyperparameters::Shared(hyperparameters),
                }],
                temperature: 4.0,
                gap_ratio: 1.0,
                least_resemblance: Some(-12.0),
                heading_std_rad: Some(0.02),
                validation: Vec::new(),
            },
            groups: vec![MapGroup {
                scaling: Scaling {
                    mean: (0..d).map(|k| k as f64).collect(),
                    projection: Mat::from_fn(2, d, |r, k| (r * d + k) as f64 * 0.1),
                },
                learning: Mat::from_fn(3, 2, |i, r| i as f64 - r as f64),
                field_mean: (0..2 * c).map(|i| i as f32 * 0.25).collect(),
                field_variance: vec![0.5; c],
            }],
            compass: Some(Compass {
                positions_m: positions_m.clone(),
                yaws_rad: vec![0.1, 0.2, -3.0],
                signatures: (0..3 * COMPASS_BYTES).map(|i| (i % 255) as i8).collect(),
                sense: 1.0,
                std_rad: 0.02,
            }),
            positions_m,
            cells,
        }
    }
}
