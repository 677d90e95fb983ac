//! From one frame to the next: the discrete Bayes filter, and what may be said of its belief.

use super::belief::{Belief, Mode};
use super::kalman::{State, Transition};
use super::motion::{ConstantVelocity, Motion, MotionModel, MotionSettings};
use super::news::{News, Reach, Worth};
use super::state::{Evidence, StateMachine};
use crate::localize::{most_likely_cell, refined_m, summit_near};
use crate::map::{CandidateCells, Compass, FeatureMap, MapInfo};
use crate::types::{
    EstimateWarnings, EstimatedHeading, EstimatedPose, LocalizationState, NS_PER_S, PositionCovariance,
    PositionEstimate, PositionM, distance_m,
};

/// What a frame says.
#[derive(Debug, Clone, Copy)]
pub struct Observation<'a> {
    pub sequence: u32,
    pub stamp_ns: u64,
    /// Log-likelihood of every candidate cell, not yet divided by the map's temperature.
    pub log_likelihood: &'a [f32],
    /// The log-likelihood of a place the map knows nothing of; `None` where the map's recipe has none.
    pub nowhere: Option<f32>,
    /// The features of all groups, one behind the other.
    pub features: &'a [f32],
    /// The [signature](super::heading) of the panorama that headings are taken from.
    pub compass: &'a [i8],
}

/// Mixed into the belief with every independent frame: nothing is ruled out for good.
const DOUBT: f64 = 1e-4;
/// And after a frame that contradicts those before it.
const DOUBT_IN_CONTRADICTION: f64 = 0.5;
/// A frame fits where the vehicle was expected if a cell within so many deviations, and at least so many steps, is likely.
const FITTING_STDS: f64 = 3.0;
const FITTING_STEPS: f64 = 3.0;
/// Without a usable frame for so long, and so many times as long as it usually takes, a position must be found anew \[s\].
const BLIND_S: f64 = 1.5;
const BLIND_INTERVALS: f64 = 3.0;
/// Weight of an interval between frames in the usual one.
const INTERVAL_WEIGHT: f64 = 0.1;
/// Somewhere is expected if it is more likely than not.
const EXPECTED: f64 = 0.5;
/// The place of a frame is looked for by itself once the belief has so much of its probability in one hill.
const TRACKED: f64 = 0.95;

/// Follows a vehicle over the cells of a map.
pub struct Tracker {
    cells: CandidateCells,
    refine: bool,
    temperature: f64,
    /// What the variance of a sighting is multiplied by: the map's gaps are narrower than those the temperature is of.
    narrower: f64,
    /// Variance on either axis that the positions of the map itself have.
    map_variance_m2: f64,
    compass: Option<Compass>,
    belief: Belief,
    motion: Box<dyn MotionModel>,
    settings: MotionSettings,
    /// Where in its hill the vehicle is, at the time of the last stamp; `None` while there is no one hill.
    in_hill: Option<State>,
    states: StateMachine,
    last_stamp_ns: Option<u64>,
    /// Of the last frame that was not skipped.
    last_used_ns: Option<u64>,
    /// Between usable frames; `None` before the second \[s\].
    usual_interval_s: Option<f64>,
    news: News,
    /// Variance that motions have added since pictures show how far the vehicle can have come \[m²\].
    wandered_m2: f64,
    /// What the last frame was worth.
    last_share: f64,
    doubt: f64,
}

fn seconds(from_ns: u64, to_ns: u64) -> f64 {
    to_ns.saturating_sub(from_ns) as f64 / NS_PER_S as f64
}

/// What a frame changed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tracked {
    pub estimate: PositionEstimate,
    /// The hill of the belief, whatever the state.
    pub mode: Mode,
    /// How much better the best place fits than none, in nats; `None` where the map cannot say.
    pub resemblance: Option<f64>,
}

impl Tracker {
    pub fn new(map: &FeatureMap, settings: MotionSettings) -> Self {
        Self::on_cells(&map.info, &map.cells, map.compass.clone(), settings)
    }

    /// On these cells, and with this compass, of a map.
    pub fn on_cells(
        info: &MapInfo,
        cells: &CandidateCells,
        compass: Option<Compass>,
        settings: MotionSettings,
    ) -> Self {
        Self {
            cells: cells.clone(),
            refine: info.refine,
            temperature: info.temperature,
            narrower: info.gap_ratio.powi(-2),
            map_variance_m2: info.position_std_m().powi(2),
            compass,
            belief: Belief::uniform(cells),
            motion: Box::new(ConstantVelocity::new(settings)),
            settings,
            in_hill: None,
            states: StateMachine::new(info.least_resemblance),
            last_stamp_ns: None,
            last_used_ns: None,
            usual_interval_s: None,
            news: News::new(info),
            wandered_m2: 0.0,
            last_share: 1.0,
            doubt: 0.0,
        }
    }

    /// With another model of the motion, such as one of odometry.
    pub fn with_motion(self, motion: Box<dyn MotionModel>) -> Self {
        Self { motion, ..self }
    }

    /// Goes on with other cells of the same map.
    pub(super) fn look_at(&mut self, cells: &CandidateCells) {
        self.belief = self.belief.on(cells);
        self.belief.doubt(DOUBT);
        self.cells = cells.clone();
    }

    /// Goes on with another part of the map's compass.
    pub(super) fn turn_by(&mut self, compass: Option<Compass>) {
        self.compass = compass;
    }

    /// As if nothing had been seen before.
    pub fn start_again(&mut self) {
        self.belief.forget();
        self.motion.observe(None);
        self.in_hill = None;
        self.states.start_again();
        self.news.forget();
        (self.last_stamp_ns, self.last_used_ns, self.usual_interval_s) = (None, None, None);
        (self.wandered_m2, self.last_share, self.doubt) = (0.0, 1.0, 0.0);
    }

    /// Where the vehicle was after the last frame.
    pub(super) fn hill(&self) -> Mode {
        self.belief.mode()
    }

    pub(super) fn speed_mps(&self) -> Option<f64> {
        self.motion.velocity_mps().map(|[east, north]| libm::hypot(east, north))
    }

    pub(super) fn state(&self) -> LocalizationState {
        self.states.state()
    }

    /// Seconds since the last frame.
    pub(super) fn since_last_s(&self, stamp_ns: u64) -> f64 {
        self.last_stamp_ns.map_or(0.0, |last| seconds(last, stamp_ns))
    }

    /// A frame that could not be used: only time has passed.
    pub fn skip(&mut self, sequence: u32, stamp_ns: u64) -> PositionEstimate {
        self.advance(stamp_ns, None);
        let mode = self.belief.mode();
        let state = self.state();
        let pose = (state == LocalizationState::Localized).then(|| self.pose(&mode, &[]));
        let warnings = EstimateWarnings { bad_frame: true, ..EstimateWarnings::default() };
        PositionEstimate { sequence, stamp_ns, state, pose, single_frame_m: None, warnings }
    }

    /// Takes a frame. Stamps must not fall; one that does counts as no time having passed.
    pub fn take(&mut self, frame: &Observation) -> Tracked {
        let Worth { share, reach } = self.news.of(frame.stamp_ns, frame.features);
        self.advance(frame.stamp_ns, reach);
        let expected = self.belief.mode();
        self.note_interval(frame.stamp_ns);
        self.last_share = share;
        self.belief.weigh(frame.log_likelihood, (share / self.temperature) as f32);
        let mode = self.belief.mode();

        let best = most_likely_cell(frame.log_likelihood);
        let contradiction = self.contradiction(frame.log_likelihood, best, &expected);
        let resemblance =
            frame.nowhere.map(|nowhere| f64::from(frame.log_likelihood[best] - nowhere) / self.temperature);
        let evidence = Evidence { probability: mode.probability, contradiction, resemblance, share };
        let (state, warnings) = self.states.take(&evidence);
        self.doubt = if warnings.contradiction { DOUBT_IN_CONTRADICTION } else { DOUBT * share };
        self.follow(&mode, frame.log_likelihood);

        let single_frame_m = match self.refine {
            true => refined_m(&self.cells, frame.log_likelihood, best),
            false => self.cells.center_m(best),
        };
        let pose = (state == LocalizationState::Localized).then(|| self.pose(&mode, frame.compass));
        let (sequence, stamp_ns) = (frame.sequence, frame.stamp_ns);
        let single_frame_m = Some(single_frame_m);
        let estimate = PositionEstimate { sequence, stamp_ns, state, pose, single_frame_m, warnings };
        Tracked { estimate, mode, resemblance }
    }

    /// The belief, for a smoother.
    pub(super) fn belief(&self) -> &Belief {
        &self.belief
    }

    /// What the last frame, with this log-likelihood, says by itself of the place around `position_m`: the summit of its hill
    /// there. The flanks, which the temperature raises, are known far less well, and the mean of the hill with them.
    pub(super) fn sighting(&self, position_m: PositionM, log_likelihood: &[f32]) -> Mode {
        let hill = self.belief.seen_near(position_m, (1.0 / self.last_share) as f32);
        let summit_m = if self.refine { summit_near(&self.cells, log_likelihood, hill.mean_m) } else { None };
        Mode { mean_m: summit_m.unwrap_or(hill.mean_m), covariance: hill.covariance.scaled(self.narrower), ..hill }
    }

    /// Moves the belief to the time of a frame, before what that frame says; within `reach`, if pictures show one.
    pub(super) fn advance(&mut self, stamp_ns: u64, reach: Option<Reach>) {
        let dt_s = self.since_last_s(stamp_ns);
        self.last_stamp_ns = Some(stamp_ns);
        if dt_s > 0.0 {
            let motion = self.motion_within(dt_s, reach);
            self.belief.spread(motion.mean_m, motion.std_m);
            let transition = Transition::after(dt_s, &self.settings);
            self.in_hill = self.in_hill.map(|state| state.predicted(&transition));
        }
        self.belief.doubt(self.doubt);
        self.doubt = 0.0;
        let interval_s = self.last_used_ns.map(|last| seconds(last, stamp_ns));
        let longest_s = self.usual_interval_s.map(|usual_s| BLIND_S.max(BLIND_INTERVALS * usual_s));
        if interval_s.zip(longest_s).is_some_and(|(interval_s, longest_s)| interval_s > longest_s) {
            self.states.lose();
        }
    }

    /// A usable frame has come.
    fn note_interval(&mut self, stamp_ns: u64) {
        if let Some(interval_s) = self.last_used_ns.replace(stamp_ns).map(|last| seconds(last, stamp_ns)) {
            let usual_s = self.usual_interval_s.unwrap_or(interval_s);
            self.usual_interval_s = Some(usual_s + INTERVAL_WEIGHT * (interval_s - usual_s));
        }
    }

    fn motion_within(&mut self, dt_s: f64, reach: Option<Reach>) -> Motion {
        let Some(Reach { way_m, time_s }) = reach else {
            self.wandered_m2 = 0.0;
            return self.motion.predict(dt_s);
        };
        self.motion.limit(way_m / time_s.max(dt_s));
        let Motion { mean_m, std_m } = self.motion.predict(dt_s);
        let std_m = std_m.min((way_m * way_m - self.wandered_m2).max(0.0).sqrt());
        self.wandered_m2 += std_m * std_m;
        Motion { mean_m, std_m }
    }

    /// How much likelier the frame finds its best cell than any where the vehicle was expected to be, in nats; 0 where
    /// nothing was expected.
    fn contradiction(&self, log_likelihood: &[f32], best: usize, expected: &Mode) -> f64 {
        if expected.probability < EXPECTED {
            return 0.0;
        }
        let PositionCovariance { ee_m2, nn_m2, .. } = expected.covariance;
        let reach_m = (FITTING_STDS * ee_m2.max(nn_m2).sqrt()).max(FITTING_STEPS * self.cells.grid.step_m);
        if distance_m(self.cells.center_m(best), expected.mean_m) <= reach_m {
            return 0.0;
        }
        let near = |cell: &usize| distance_m(self.cells.center_m(*cell), expected.mean_m) <= reach_m;
        let here = (0..log_likelihood.len()).filter(near).map(|cell| log_likelihood[cell]).reduce(f32::max);
        let best = log_likelihood[best];
        here.map_or(f64::INFINITY, |here| f64::from(best - here) / self.temperature)
    }

    /// Takes what a frame with this log-likelihood says of the place in the hill `mode` of the belief.
    fn follow(&mut self, mode: &Mode, log_likelihood: &[f32]) {
        if mode.probability < TRACKED {
            self.in_hill = None;
            return self.motion.observe(None);
        }
        let seen = self.sighting(mode.mean_m, log_likelihood);
        let seen = Mode { covariance: seen.covariance.scaled(1.0 / self.last_share), ..seen };
        let PositionCovariance { ee_m2, nn_m2, .. } = seen.covariance;
        self.motion.observe(Some(&seen));
        // The belief may have gone over to another hill.
        let reach_m = FITTING_STEPS * self.cells.grid.step_m + FITTING_STDS * ee_m2.max(nn_m2).sqrt();
        let here = self.in_hill.filter(|state| distance_m(state.position_m(), mode.mean_m) <= reach_m);
        self.in_hill = here.and_then(|state| state.updated(&seen)).or(Some(State::first(&seen, &self.settings)));
    }

    fn pose(&self, mode: &Mode, compass: &[i8]) -> EstimatedPose {
        let (position_m, covariance) = match &self.in_hill {
            Some(state) => (state.position_m(), state.position_covariance()),
            None => (mode.mean_m, mode.covariance),
        };
        EstimatedPose {
            position_m,
            covariance: self.with_map_error(covariance),
            velocity_mps: self.motion.velocity_mps(),
            heading: self.heading(position_m, compass),
        }
    }

    pub(super) fn with_map_error(&self, covariance: PositionCovariance) -> PositionCovariance {
        PositionCovariance {
            ee_m2: covariance.ee_m2 + self.map_variance_m2,
            nn_m2: covariance.nn_m2 + self.map_variance_m2,
            ..covariance
        }
    }

    /// The heading of a panorama with this signature at about `position_m`, if the map has a compass.
    pub fn heading(&self, position_m: PositionM, signature: &[i8]) -> Option<EstimatedHeading> {
        self.compass.as_ref()?.heading(signature, position_m)
    }
}

#[cfg(test)]
mod tests {
    use LocalizationState::{Candidate, Localized, Lost};

    use super::*;
    use crate::map::tests::small_map;

    /// A map of 40 x 40 m; frames say where they are with 0.7 m on either axis.
    struct Drive {
        tracker: Tracker,
        cells: CandidateCells,
        temperature: f64,
        frames: u32,
    }

    impl Drive {
        fn new() -> Self {
            let small = small_map();
            let cells = CandidateCells::around(&[[0.0, 0.0], [40.0, 40.0]], 1.0, None).expect("a small grid");
            let temperature = small.info.temperature;
            let map = FeatureMap { cells: cells.clone(), ..small };
            Self { tracker: Tracker::new(&map, MotionSettings::default()), cells, temperature, frames: 0 }
        }

        fn see(&mut self, time_s: f64, at_m: PositionM) -> PositionEstimate {
            let log = |c: &PositionM| -0.5 * self.temperature * distance_m(*c, at_m).powi(2) / 0.7_f64.powi(2);
            let log_likelihood: Vec<f32> = self.cells.centers_m().iter().map(|c| log(c) as f32).collect();
            self.frames += 1;
            // Every view differs from the one before.
            let features = [9.0 * (self.frames % 2) as f32, self.frames as f32];
            let stamp_ns = stamp_ns(time_s);
            let frame = Observation {
                sequence: self.frames,
                stamp_ns,
                log_likelihood: &log_likelihood,
                nowhere: Some(-100.0),
                features: &features,
                compass: &[],
            };
            self.tracker.take(&frame).estimate
        }
    }

    fn stamp_ns(time_s: f64) -> u64 {
        (time_s * NS_PER_S as f64) as u64
    }

    #[test]
    fn a_vehicle_is_followed_however_seldom_it_is_seen() {
        for interval_s in [0.1, 1.0, 5.0] {
            let mut drive = Drive::new();
            let estimates: Vec<PositionEstimate> =
                (0..12).map(|i| drive.see(interval_s * f64::from(i), [10.0 + 0.5 * f64::from(i), 20.0])).collect();
            assert!(estimates[..2].iter().all(|estimate| estimate.state == Candidate && estimate.pose.is_none()));
            let last = estimates[11].pose.unwrap_or_else(|| panic!("{interval_s} s: {:?}", estimates[11]));
            assert!(distance_m(last.position_m, [15.5, 20.0]) < 0.7, "{interval_s} s: {last:?}");
        }
    }

    #[test]
    fn a_jump_is_not_followed_at_once() {
        let mut drive = Drive::new();
        (0..6).for_each(|i| _ = drive.see(f64::from(i), [10.0, 10.0 + f64::from(i)]));
        let jumped = drive.see(6.0, [35.0, 35.0]);
        assert_eq!((jumped.state, jumped.pose), (Lost, None), "{jumped:?}");
        assert!(jumped.warnings.contradiction);
        let states: Vec<LocalizationState> = (7..12).map(|i| drive.see(f64::from(i), [35.0, 35.0]).state).collect();
        assert!(states[0] != Localized && states[4] == Localized, "{states:?}");
    }

    #[test]
    fn frames_that_cannot_be_used_are_bridged_for_a_while() {
        let mut drive = Drive::new();
        (0..8).for_each(|i| _ = drive.see(0.2 * f64::from(i), [10.0 + f64::from(i), 20.0]));
        let bridged = drive.tracker.skip(8, stamp_ns(1.6));
        let pose = bridged.pose.expect("it was seen a moment ago");
        assert!(distance_m(pose.position_m, [18.0, 20.0]) < 1.0 && bridged.warnings.bad_frame, "{bridged:?}");
        assert_eq!(drive.tracker.skip(9, stamp_ns(4.0)).state, Lost);
        assert_eq!(drive.see(4.2, [31.0, 20.0]).state, Candidate);
    }
}
