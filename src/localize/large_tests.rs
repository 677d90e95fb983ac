use faer::Mat;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::*;
use crate::features::COMPASS_BYTES;
use crate::localize::{Observation, Tracked};
use crate::map::{Compass, FeatureMap, NoiseModel, file, tests::small_map};
use crate::types::{NS_PER_S, PositionM};

const FEATURES: usize = 24;

/// A road round a square of 300 m, of which every place looks a little different.
struct Road {
    map: FeatureMap,
    /// Radians per metre east and north, and the phase, of every feature.
    waves: Vec<[f64; 3]>,
}

impl Road {
    fn new() -> Self {
        let corners = [[0.0, 0.0], [300.0, 0.0], [300.0, 300.0], [0.0, 300.0], [0.0, 0.0]];
        let side = |from: PositionM, to: PositionM| {
            (0..150).map(move |i| [0, 1].map(|axis| from[axis] + (to[axis] - from[axis]) * f64::from(i) / 150.0))
        };
        let road: Vec<PositionM> = corners.windows(2).flat_map(|pair| side(pair[0], pair[1])).collect();
        let cells = CandidateCells::around(&road, 1.0, Some(3.0)).expect("a grid");
        let mut random = ChaCha8Rng::seed_from_u64(3);
        let mut wave = || [0.15, 0.15, 3.0].map(|scale| scale * (2.0 * random.random::<f64>() - 1.0));
        let waves: Vec<[f64; 3]> = (0..FEATURES).map(|_| wave()).collect();

        let mut map = small_map();
        let on_cells =
            |wave: &[f64; 3]| cells.centers_m().iter().map(|&at_m| look(wave, at_m) as f32).collect::<Vec<_>>();
        let (group, info) = (&mut map.groups[0], &mut map.info.groups[0]);
        group.field_mean = waves.iter().flat_map(on_cells).collect();
        group.field_variance = vec![1.0; cells.len()];
        group.scaling.projection = Mat::zeros(FEATURES, info.recipe.descriptor.dimensions());
        group.learning = Mat::zeros(road.len(), FEATURES);
        (info.features, info.rank, info.recipe.noise) = (FEATURES, FEATURES, NoiseModel::UnknownScale);
        (map.info.temperature, map.info.least_resemblance) = (1.0, Some(20.0));
        (map.info.grid, map.cells) = (cells.grid, cells);
        map.compass = Some(Compass {
            yaws_rad: (0..road.len()).map(|i| 0.01 * i as f64).collect(),
            signatures: (0..road.len() * COMPASS_BYTES).map(|_| random.random::<i8>() / 2).collect(),
            positions_m: road.clone(),
            sense: 1.0,
            std_rad: map.info.heading_std_rad.expect("has a compass"),
        });
        map.positions_m = road;
        Self { map, waves }
    }

    fn open(&self) -> OpenMap {
        OpenMap::open(Box::new(file::to_bytes(&self.map))).expect("sound")
    }
}

/// Every learning panorama looks quite different.
fn signature(road: &Road, at_m: PositionM) -> &[i8] {
    let compass = road.map.compass.as_ref().expect("has one");
    let away_m = |i: &usize| distance_m(compass.positions_m[*i], at_m);
    let nearest = (0..compass.positions_m.len()).min_by(|a, b| away_m(a).total_cmp(&away_m(b)));
    compass.signature(nearest.expect("there are some"))
}

/// What a feature is at a position, in deviations of the noise.
fn look(wave: &[f64; 3], at_m: PositionM) -> f64 {
    10.0 * (wave[0] * at_m[0] + wave[1] * at_m[1] + wave[2]).sin()
}

/// Ten frames a second, with some noise.
struct Camera<'a> {
    road: &'a Road,
    random: ChaCha8Rng,
    frames: u32,
}

impl<'a> Camera<'a> {
    fn new(road: &'a Road) -> Self {
        Self { road, random: ChaCha8Rng::seed_from_u64(5), frames: 0 }
    }

    fn features(&mut self, at_m: PositionM) -> (u32, u64, Vec<f32>) {
        let mut noise = || 12.0_f64.sqrt() * (self.random.random::<f64>() - 0.5);
        let features = self.road.waves.iter().map(|wave| (look(wave, at_m) + noise()) as f32).collect();
        self.frames += 1;
        (self.frames, u64::from(self.frames) * NS_PER_S / 10, features)
    }
}

/// Follows the vehicle on a map that is read as it is needed.
struct Follower<'a> {
    camera: Camera<'a>,
    large: LargeMap,
    tracker: Tracker,
    /// At the cells that the last frame was matched with.
    log_likelihood: Vec<f32>,
}

impl<'a> Follower<'a> {
    fn new(road: &'a Road) -> Self {
        let (map, settings) = (road.open(), MotionSettings::default());
        let tracker = Tracker::on_cells(&map.info, &map.cells, None, settings);
        Self { camera: Camera::new(road), large: LargeMap::new(map, 0, settings), tracker, log_likelihood: Vec::new() }
    }

    fn see(&mut self, at_m: PositionM) -> Result<Tracked, MapError> {
        let (sequence, stamp_ns, features) = self.camera.features(at_m);
        let nowhere = MapFields::log_likelihood_nowhere(&self.large.map.info.groups, &features);
        let frame = Features { stamp_ns, features: &features, nowhere };
        self.large.match_frame(&frame, &mut self.tracker, &mut Vec::new(), &mut self.log_likelihood)?;
        let (log_likelihood, features) = (&self.log_likelihood[..], &features[..]);
        let compass = signature(self.camera.road, at_m);
        let frame = Observation { sequence, stamp_ns, log_likelihood, nowhere, features, compass };
        Ok(self.tracker.take(&frame))
    }

    fn searched_everywhere(&self) -> bool {
        self.log_likelihood.len() == self.large.map.cells.len()
    }
}

#[test]
fn a_window_follows_the_vehicle_as_the_whole_map_does() {
    let road = Road::new();
    let (mut follower, mut camera) = (Follower::new(&road), Camera::new(&road));
    let (mut tracker, fields) = (Tracker::new(&road.map, MotionSettings::default()), MapFields::of(&road.map));
    let mut windows = Vec::new();
    for i in 0..280 {
        let at_m = [5.0 + f64::from(i), 0.0];
        let found = follower.see(at_m).expect("sound").estimate;

        let (sequence, stamp_ns, features) = camera.features(at_m);
        let mut log_likelihood = vec![0.0; road.map.cells.len()];
        fields.add_log_likelihood(&features, &mut Vec::new(), &mut log_likelihood);
        let nowhere = MapFields::log_likelihood_nowhere(&road.map.info.groups, &features);
        let (log_likelihood, features) = (&log_likelihood[..], &features[..]);
        let compass = signature(&road, at_m);
        let frame = Observation { sequence, stamp_ns, log_likelihood, nowhere, features, compass };
        let expected = tracker.take(&frame).estimate;

        assert_eq!(found.state, expected.state, "{i}");
        if let Some((found, expected)) = found.pose.zip(expected.pose) {
            assert!(distance_m(found.position_m, expected.position_m) < 0.02, "{i}: {found:?} {expected:?}");
            assert!(distance_m(found.position_m, at_m) < 1.0, "{i}: {found:?} {at_m:?}");
            let [yaw_rad, expected_rad] = [found, expected].map(|pose| pose.heading.expect("has a compass").yaw_rad);
            assert!((yaw_rad - expected_rad).abs() < 1e-6, "{i}: {yaw_rad} {expected_rad}");
            let ratio = found.covariance.ee_m2 / expected.covariance.ee_m2;
            assert!((ratio - 1.0).abs() < 0.05, "{i}: {ratio}");
            windows.extend((!follower.searched_everywhere()).then_some(follower.log_likelihood.len()));
        }
    }
    let (frames, widest) = (windows.len(), windows.iter().max());
    assert!(frames > 250, "{frames}");
    assert!(widest.is_some_and(|&widest| widest < road.map.cells.len() / 4), "{widest:?} of {}", road.map.cells.len());
}

/// From one side of the square to the one across, between two frames.
#[test]
fn who_is_carried_off_is_found_again() {
    let road = Road::new();
    let mut follower = Follower::new(&road);
    let mut drive = |north_m: f64| {
        let mut at = |i: i32| {
            let at_m = [100.0 + 0.5 * f64::from(i), north_m];
            let pose = follower.see(at_m).expect("sound").estimate.pose;
            assert!(pose.is_none_or(|pose| distance_m(pose.position_m, at_m) < 2.0), "{i}: {pose:?}");
            pose.is_some()
        };
        (0..60).map(&mut at).collect::<Vec<bool>>()
    };
    let (here, there) = (drive(0.0), drive(300.0));
    assert!(here[59] && !there[0] && there[30] && there[59], "{there:?}");
}

/// Frames of a day that fit nowhere well do not each cost as much as the whole map.
#[test]
fn searches_are_spared() {
    let road = Road::new();
    let mut follower = Follower::new(&road);
    let mut searches = 0;
    for i in 0..200 {
        // No frame is good enough any more.
        if i == 100 {
            follower.large.map.info.least_resemblance = Some(1e6);
        }
        let state = follower.see([50.0 + 0.5 * f64::from(i), 0.0]).expect("sound").estimate.state;
        if i >= 100 {
            assert_eq!(state, LocalizationState::Localized, "{i}");
            searches += u32::from(follower.searched_everywhere());
        }
    }
    assert!((5..30).contains(&searches), "{searches}");
}

#[test]
fn a_block_that_was_damaged_since_is_not_used() {
    let road = Road::new();
    let mut bytes = file::to_bytes(&road.map);
    let value = road.map.groups[0].field_mean[7].to_le_bytes();
    let at = bytes.windows(4).rposition(|window| window == value).expect("the value is there");
    bytes[at] ^= 1;
    let map = OpenMap::open(Box::new(bytes)).expect("the whole is sound");
    let mut follower = Follower { large: LargeMap::new(map, 0, MotionSettings::default()), ..Follower::new(&road) };
    let error = follower.see([0.0, 0.0]).expect_err("damaged");
    assert!(error.to_string().contains("does not fit its checksum"), "{error}");
}
