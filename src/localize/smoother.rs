//! What later frames say of earlier ones: the forward-backward smoother, for whole drives.
//!
//! Two passes. The first finds the hill in which each frame lies: the belief after a frame from the frames up to it, times
//! the belief before the frame from the frames after it, which a filter that runs backwards has – the two-filter form of
//! the forward-backward algorithm (Bresler 1986). A random motion has the same law in both directions, and the belief of a
//! filter that has seen nothing is uniform, so that the product is exact up to its factor. The second pass is a
//! Rauch-Tung-Striebel smoother (1965) over what the frames say by themselves within their hills, at a velocity that
//! stays the same but for a white acceleration: unlike the cells, it knows that velocity in each direction.

use super::belief::Mode;
use super::kalman::{State, Transition, symmetric};
use super::motion::MotionSettings;
use super::tracker::{Observation, Tracker};
use crate::map::FeatureMap;
use crate::types::{NS_PER_S, PositionCovariance, PositionM};

/// Where a vehicle was, all frames considered.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Smoothed {
    pub position_m: PositionM,
    pub covariance: PositionCovariance,
}

/// Beliefs are kept where they are at least this.
const LEAST_PROBABILITY: f32 = 1e-9;
/// Neighbouring frames err alike: of all frames of a drive, so many together are worth one.
const FRAMES_ALIKE: f64 = 4.0;

/// Smooths a drive: frames in the order of their stamps.
pub fn smooth(map: &FeatureMap, settings: MotionSettings, frames: &[Observation]) -> Vec<Smoothed> {
    let mut forward = Tracker::new(map, settings);
    let after: Vec<_> = frames
        .iter()
        .map(|frame| {
            forward.take(frame);
            forward.belief().on_cells(LEAST_PROBABILITY)
        })
        .collect();

    let last_ns = frames.last().map_or(0, |frame| frame.stamp_ns);
    let mut backward = Tracker::new(map, settings);
    let mut sightings: Vec<Mode> = frames
        .iter()
        .zip(&after)
        .rev()
        .map(|(frame, after)| {
            // The drive the other way round.
            let reversed = Observation { stamp_ns: last_ns - frame.stamp_ns, ..*frame };
            backward.advance(reversed.stamp_ns, None);
            let hill = backward.belief().product(after);
            backward.take(&reversed);
            let seen = backward.sighting(hill.mean_m, frame.log_likelihood);
            Mode { covariance: seen.covariance.scaled(FRAMES_ALIKE), ..seen }
        })
        .collect();
    sightings.reverse();

    let stamps_ns: Vec<u64> = frames.iter().map(|frame| frame.stamp_ns).collect();
    let smoothed = rauch_tung_striebel(&stamps_ns, &sightings, &settings);
    smoothed
        .into_iter()
        .map(|state| Smoothed {
            position_m: state.position_m(),
            covariance: forward.with_map_error(state.position_covariance()),
        })
        .collect()
}

fn rauch_tung_striebel(stamps_ns: &[u64], sightings: &[Mode], settings: &MotionSettings) -> Vec<State> {
    let Some(first) = sightings.first() else { return Vec::new() };
    let start = State::first(first, settings);
    // Forward: the state after each frame, and before it with the transition that led there.
    let (mut states, mut predicted) = (vec![start], vec![(start, Transition::after(0.0, settings))]);
    for (i, seen) in sightings.iter().enumerate().skip(1) {
        let dt_s = stamps_ns[i].saturating_sub(stamps_ns[i - 1]) as f64 / NS_PER_S as f64;
        let transition = Transition::after(dt_s, settings);
        let before = states[i - 1].predicted(&transition);
        let Some(after) = before.updated(seen) else { return states };
        states.push(after);
        predicted.push((before, transition));
    }
    // Backward.
    for i in (0..states.len() - 1).rev() {
        let (before_next, transition) = predicted[i + 1];
        let Some(inverse) = before_next.covariance.try_inverse() else { continue };
        let gain = states[i].covariance * transition.matrix.transpose() * inverse;
        let next = states[i + 1];
        states[i] = State {
            mean: states[i].mean + gain * (next.mean - before_next.mean),
            covariance: symmetric(
                states[i].covariance + gain * (next.covariance - before_next.covariance) * gain.transpose(),
            ),
        };
    }
    states
}

#[cfg(test)]
mod tests {
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;
    use crate::types::distance_m;

    /// A drive round a bend, sighted with an error of 1 m on either axis.
    fn drive() -> (Vec<u64>, Vec<PositionM>, Vec<Mode>) {
        let mut random = ChaCha8Rng::seed_from_u64(5);
        let mut normal = || (0..12).map(|_| random.random::<f64>()).sum::<f64>() - 6.0;
        let (mut stamps_ns, mut truth_m, mut sightings) = (Vec::new(), Vec::new(), Vec::new());
        for i in 0..200 {
            let angle_rad = f64::from(i) * 0.02;
            let position_m = [40.0 * angle_rad.cos(), 40.0 * angle_rad.sin()];
            stamps_ns.push(u64::try_from(i).expect("counts up") * NS_PER_S / 5);
            truth_m.push(position_m);
            let covariance = PositionCovariance { ee_m2: 1.0, en_m2: 0.0, nn_m2: 1.0 };
            let mean_m = [position_m[0] + normal(), position_m[1] + normal()];
            sightings.push(Mode { probability: 1.0, mean_m, covariance });
        }
        (stamps_ns, truth_m, sightings)
    }

    #[test]
    fn all_frames_together_know_more_than_each() {
        let (stamps_ns, truth_m, sightings) = drive();
        let states = rauch_tung_striebel(&stamps_ns, &sightings, &MotionSettings::default());
        let mean_square_m2 = |errors: &mut dyn Iterator<Item = f64>| errors.map(|e| e * e).sum::<f64>() / 200.0;
        let smoothed_m2 =
            mean_square_m2(&mut states.iter().zip(&truth_m).map(|(s, t)| distance_m([s.mean[0], s.mean[1]], *t)));
        let single_m2 = mean_square_m2(&mut sightings.iter().zip(&truth_m).map(|(s, t)| distance_m(s.mean_m, *t)));
        assert!(smoothed_m2 < 0.3 * single_m2, "{smoothed_m2} of {single_m2}");
        let stated_m2 = states.iter().map(|s| s.covariance[(0, 0)] + s.covariance[(1, 1)]).sum::<f64>() / 200.0;
        assert!((1.0..8.0).contains(&(stated_m2 / smoothed_m2)), "{stated_m2} for {smoothed_m2}");
    }

    /// The same drive backwards is smoothed to the same places.
    #[test]
    fn time_has_no_direction() {
        let (stamps_ns, _, sightings) = drive();
        let settings = MotionSettings::default();
        let there = rauch_tung_striebel(&stamps_ns, &sightings, &settings);
        let last_ns = stamps_ns[199];
        let reversed_ns: Vec<u64> = stamps_ns.iter().rev().map(|ns| last_ns - ns).collect();
        let reversed: Vec<Mode> = sightings.iter().rev().copied().collect();
        let back = rauch_tung_striebel(&reversed_ns, &reversed, &settings);
        for i in 20..180 {
            let (a, b) = (there[i].mean, back[199 - i].mean);
            assert!(distance_m([a[0], a[1]], [b[0], b[1]]) < 0.01, "{i}: {a} {b}");
        }
    }
}
