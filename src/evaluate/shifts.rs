//! How far positions were moved before anything was learned at them.

use serde::Serialize;

use super::statistics::Section;
use crate::map::{MapInfo, TrackReport};
use crate::types::{PositionM, distance_m};

/// What smoothing made of the positions that were learned from, in one trial or map.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PositionShift {
    #[serde(flatten)]
    pub section: Section,
    pub seed: Option<u64>,
    pub recipe: &'static str,
    /// Whose positions they are.
    pub recording: String,
    /// Frames learned from.
    pub frames: usize,
    /// Root mean square and largest distance between learned and recorded positions \[m\]. A map knows the first only;
    /// the second is there where the recordings it was learned from are.
    pub rms_m: f64,
    pub largest_m: Option<f64>,
    /// The frame that was moved furthest.
    pub largest_index: Option<usize>,
    pub track: TrackReport,
}

/// Distances between positions: root mean square, the largest, and whose it is.
struct Distances {
    rms_m: f64,
    largest_m: f64,
    row: usize,
}

impl Distances {
    fn of(pairs: impl Iterator<Item = (usize, PositionM, PositionM)>) -> Option<Self> {
        let (mut n, mut sum_m2, mut largest_m, mut largest_row) = (0_usize, 0.0, -1.0, 0);
        for (row, from_m, to_m) in pairs {
            let apart_m = distance_m(from_m, to_m);
            n += 1;
            sum_m2 += apart_m * apart_m;
            if apart_m > largest_m {
                (largest_m, largest_row) = (apart_m, row);
            }
        }
        (n > 0).then(|| Self { rms_m: (sum_m2 / n as f64).sqrt(), largest_m, row: largest_row })
    }
}

impl PositionShift {
    /// Of a trial that learned at `learned_m` of the frames at `rows`, recorded at `recorded_m`, both of all frames.
    pub fn of_trial(
        (section, seed): (Section, Option<u64>),
        recipe: &'static str,
        rows: &[usize],
        [recorded_m, learned_m]: [&[PositionM]; 2],
        indices: &[usize],
        track: TrackReport,
    ) -> Option<Self> {
        let Distances { rms_m, largest_m, row } =
            Distances::of(rows.iter().map(|&row| (row, recorded_m[row], learned_m[row])))?;
        Some(Self {
            recording: section.dataset.clone(),
            section,
            seed,
            recipe,
            frames: rows.len(),
            rms_m,
            largest_m: Some(largest_m),
            largest_index: Some(indices[row]),
            track,
        })
    }

    /// Of the recordings of a map that learned at `learned_m`. `known` are the name, the frames' own indices and the recorded
    /// positions of those that are there.
    pub fn of_map(
        section: &Section,
        info: &MapInfo,
        learned_m: &[PositionM],
        known: &[(&str, Vec<usize>, Vec<PositionM>)],
    ) -> Vec<Self> {
        let mut first = 0;
        let of_recording = info.recordings.iter().filter_map(|of| {
            let rows = first..first + of.frames;
            first = rows.end;
            let track = of.track?;
            let moved_m = match track {
                TrackReport::Smoothed { moved_m, .. } => moved_m,
                TrackReport::LeftAlone(_) => 0.0,
            };
            let found = known.iter().find(|(name, indices, _)| *name == of.name && indices.len() == of.frames);
            let distances = found.zip(learned_m.get(rows)).and_then(|((_, indices, recorded_m), learned_m)| {
                let pairs = indices.iter().zip(recorded_m).zip(learned_m).map(|((&i, &r), &l)| (i, r, l));
                // Other frames of the same recording are moved by something else.
                Distances::of(pairs).filter(|found| (found.rms_m - moved_m).abs() <= 0.01 * moved_m + 1e-6)
            });
            Some(Self {
                section: section.clone(),
                seed: None,
                recipe: info.recipe.name(),
                recording: of.name.clone(),
                frames: of.frames,
                rms_m: moved_m,
                largest_m: distances.as_ref().map(|found| found.largest_m),
                largest_index: distances.as_ref().map(|found| found.row),
                track,
            })
        });
        of_recording.collect()
    }

    /// A line a recording, recipe and kind of positions, all splits and seeds together.
    pub fn lines(shifts: &[Self]) -> Vec<String> {
        let mut groups: Vec<Vec<&Self>> = Vec::new();
        for shift in shifts {
            let key = |of: &Self| (of.recipe, of.recording.clone(), of.section.noisy);
            match groups.iter_mut().find(|group| key(group[0]) == key(shift)) {
                Some(group) => group.push(shift),
                None => groups.push(vec![shift]),
            }
        }
        groups.iter().map(|group| line(group)).collect()
    }
}

fn line(group: &[&PositionShift]) -> String {
    let first = group[0];
    let noisy = if first.section.noisy { ", with noise on them" } else { "" };
    let of = format!("positions of {} that the {} recipe learned from{noisy}", first.recording, first.recipe);
    let smoothed = || group.iter().filter(|shift| matches!(shift.track, TrackReport::Smoothed { .. }));
    if let (None, TrackReport::LeftAlone(why)) = (smoothed().next(), first.track) {
        return format!("{of}: as recorded: {}", why.describe());
    }
    let frames: usize = smoothed().map(|shift| shift.frames).sum();
    let rms_m = (smoothed().map(|shift| shift.frames as f64 * shift.rms_m.powi(2)).sum::<f64>() / frames as f64).sqrt();
    let furthest = smoothed().filter_map(|shift| Some((shift.largest_m?, shift.largest_index?)));
    let furthest = furthest.max_by(|a, b| a.0.total_cmp(&b.0));
    let furthest = furthest.map_or(String::new(), |(m, index)| format!(", frame {index} furthest, by {m:.2} m"));
    let over = if group.len() > 1 { format!(", over {} trials", group.len()) } else { String::new() };
    format!("{of}: moved by smoothing, by {rms_m:.2} m (root mean square{over}){furthest}")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::map::NotATrack;

    fn section() -> Section {
        Section { dataset: "yard".into(), split: Some("random".into()), noisy: false, fixed: false }
    }

    const TRACK: TrackReport = TrackReport::Smoothed {
        receiver_std_m: 0.6,
        receiver_time_s: 20.0,
        moved_m: 0.5,
        remaining_std_m: 0.2,
        views: 3,
    };

    #[test]
    fn shifts_are_those_of_the_frames_learned_from() {
        let (recorded_m, learned_m) = ([[0.0, 0.0]; 4], [[0.3, 0.4], [9.0, 9.0], [0.0, 1.0], [0.0, 0.0]]);
        let of = |seed, rows: &[usize]| {
            let positions = [&recorded_m[..], &learned_m[..]];
            PositionShift::of_trial((section(), Some(seed)), "default", rows, positions, &[10, 11, 12, 13], TRACK)
        };
        let shifts = [of(0, &[0, 3]), of(1, &[0, 2])].map(|shift| shift.expect("there are frames"));
        assert!((shifts[0].rms_m - 0.125_f64.sqrt()).abs() < 1e-12, "{shifts:?}");
        assert_eq!((shifts[1].largest_m, shifts[1].largest_index, shifts[1].frames), (Some(1.0), Some(12), 2));
        // (0.25 + 0 + 0.25 + 1) / 4
        assert_eq!(
            PositionShift::lines(&shifts),
            [
                "positions of yard that the default recipe learned from: moved by smoothing, by 0.61 m (root mean square, over \
              2 trials), frame 12 furthest, by 1.00 m"
            ]
        );
        assert_eq!(of(0, &[]), None);
    }

    #[test]
    fn positions_that_were_left_alone_say_why() {
        let alone = TrackReport::LeftAlone(NotATrack::NoYaw);
        let positions = [[0.0, 0.0]; 2];
        let shift =
            PositionShift::of_trial((section(), None), "default", &[0, 1], [&positions, &positions], &[0, 1], alone);
        let lines = PositionShift::lines(&shift.into_iter().collect::<Vec<_>>());
        assert!(lines[0].ends_with("as recorded: not every frame has a yaw"), "{lines:?}");
    }
}
