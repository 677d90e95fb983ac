//! In how many appearances was a place seen: in other light, with other traffic and parked cars?

use crate::recording::Recording;
use crate::types::{NS_PER_S, PositionM, distance_m};

/// Recordings that began within this of the one before saw the same light and the same parked cars \[s\].
const ONE_APPEARANCE_S: u64 = 3 * 3600;
/// Log times before this count from when the computer was switched on, or from the first image: 2001-09-09.
const FIRST_DATE_NS: u64 = 1_000_000_000 * NS_PER_S;
/// Frames within so many of their spacings see the same, and at least so far apart.
const SAME_PLACE_SPACINGS: f64 = 7.0;
const SAME_PLACE_M: f64 = 1.0;

/// Share of the frames of `recordings` whose place is seen in no other appearance than theirs.
pub fn share_seen_once(recordings: &[Recording]) -> f64 {
    let began_ns = |recording: &Recording| recording.topics.values().map(|summary| summary.first_ns).min().unwrap_or(0);
    let appearances = appearances_begun(&recordings.iter().map(began_ns).collect::<Vec<_>>());
    let of_recordings = recordings.iter().zip(appearances);
    let frames: Vec<(usize, PositionM)> = of_recordings
        .flat_map(|(recording, appearance)| recording.survey.iter().map(move |frame| (appearance, frame.position_m)))
        .collect();
    let length_m = recordings.iter().map(Recording::length_m).sum::<f64>();
    share_alone(&frames, (SAME_PLACE_SPACINGS * length_m / frames.len().max(1) as f64).max(SAME_PLACE_M))
}

/// Share of `frames` (appearance, position) with none of another appearance within `reach_m`.
fn share_alone(frames: &[(usize, PositionM)], reach_m: f64) -> f64 {
    let is_alone = |&&(appearance, position_m): &&(usize, PositionM)| {
        let is_same =
            |&(other, there_m): &(usize, PositionM)| other != appearance && distance_m(position_m, there_m) <= reach_m;
        !frames.iter().any(is_same)
    };
    frames.iter().filter(is_alone).count() as f64 / frames.len().max(1) as f64
}

/// The appearance of each recording, by when it began. One that does not know the date has an appearance of its own.
fn appearances_begun(log_times_ns: &[u64]) -> Vec<usize> {
    let mut in_order: Vec<usize> = (0..log_times_ns.len()).collect();
    in_order.sort_by_key(|&recording| log_times_ns[recording]);
    let mut appearances = vec![0; log_times_ns.len()];
    for pair in in_order.windows(2) {
        let [before_ns, ns] = [log_times_ns[pair[0]], log_times_ns[pair[1]]];
        let is_same = before_ns > FIRST_DATE_NS && ns - before_ns < ONE_APPEARANCE_S * NS_PER_S;
        appearances[pair[1]] = appearances[pair[0]] + usize::from(!is_same);
    }
    appearances
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn laps_of_one_hour_are_one_appearance_and_unknown_dates_are_one_each() {
        const HOUR_NS: u64 = 3600 * NS_PER_S;
        let noon = 1_750_000_000 * NS_PER_S;
        let table: [(&[u64], &[usize]); 5] = [
            (&[noon], &[0]),
            (&[noon, noon + HOUR_NS / 2, noon + HOUR_NS], &[0, 0, 0]),
            (&[noon + 8 * HOUR_NS, noon], &[1, 0]),
            (&[noon, noon + 24 * HOUR_NS, noon + 25 * HOUR_NS], &[0, 1, 1]),
            (&[0, 0], &[0, 1]),
        ];
        for (log_times_ns, expected) in table {
            assert_eq!(appearances_begun(log_times_ns), expected, "{log_times_ns:?}");
        }
    }

    #[test]
    fn another_day_elsewhere_is_no_second_appearance() {
        let street = |appearance: usize, north_m: f64| (0..20).map(move |i| (appearance, [f64::from(i), north_m]));
        let frames = |second_north_m: f64| street(0, 0.0).chain(street(1, second_north_m)).collect::<Vec<_>>();
        assert_eq!(share_alone(&frames(50.0), 7.0), 1.0);
        assert_eq!(share_alone(&frames(3.0), 7.0), 0.0);
        let half: Vec<_> = street(0, 0.0).chain(street(1, 3.0).take(3)).collect();
        // Within 7 m of the three: those at 0 to 8 m, 3 m aside.
        assert_eq!(share_alone(&half, 7.0), 11.0 / 23.0);
    }
}
