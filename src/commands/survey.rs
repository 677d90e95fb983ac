//! Opening recordings for training and evaluation.

use std::path::PathBuf;

use anyhow::Context;

use super::BadArgument;
use super::options::{check_input, check_not_input, with_folders};
use super::progress::Progress;
use crate::features::Descriptor;
use crate::map::{PERTURBED_COPIES, Recipe, Smoothing};
use crate::recording::{Recording, RecordingError};
use crate::train::{Survey, SurveyOptions, TrialError};
use crate::types::{PositionM, counted, distance_m};

/// Learning takes time with the third power of the number of frames: more than this many are thinned out.
const MAX_FRAMES: usize = 800;

/// Opens `paths`, all of which must be usable; a folder stands for the recordings in it.
///
/// Of frames closer than `spacing_m` to the one before, only the first is kept. Without it, a drive of more than
/// [`MAX_FRAMES`] frames is thinned to about that many.
pub fn open_recordings(paths: &[PathBuf], spacing_m: Option<f64>) -> anyhow::Result<Vec<Recording>> {
    let mut recordings = open_all(&with_folders(paths)?)?;
    refuse_copies(&recordings)?;
    let frames = recordings.iter().map(|recording| recording.survey.len()).sum::<usize>();
    match spacing_m {
        Some(spacing_m) => recordings.iter_mut().for_each(|recording| recording.keep_spaced(spacing_m)),
        None if frames <= MAX_FRAMES => {}
        None => {
            let spacing_m = recordings.iter().map(Recording::length_m).sum::<f64>() / MAX_FRAMES as f64;
            eprintln!("note: {frames} frames are thinned to one every {spacing_m:.2} m; --spacing-m chooses otherwise");
            recordings.iter_mut().for_each(|recording| recording.thin(spacing_m));
        }
    }
    Ok(recordings)
}

/// Recordings further apart than this are not of one place \[m\].
const ONE_PLACE_M: f64 = 50_000.0;

/// Counts the positions of all recordings from the origin of the first.
///
/// # Errors
/// They are not of one place.
pub fn in_one_place(mut recordings: Vec<Recording>) -> Result<Vec<Recording>, BadArgument> {
    if let Some(origin) = recordings.first().and_then(|first| first.origin) {
        // One that does not know its own origin is refused where they are put together.
        recordings.iter_mut().for_each(|recording| _ = recording.move_origin(origin));
    }
    let Some((first, others)) = recordings.split_first() else { return Ok(recordings) };
    for other in others {
        let apart_m = distance_m(first.survey[0].position_m, other.survey[0].position_m);
        if apart_m > ONE_PLACE_M {
            let (first, other) = (first.path.display(), other.path.display());
            let apart_km = apart_m / 1000.0;
            return Err(BadArgument(format!("{first} and {other} lie {apart_km:.0} km apart: a map is of one place")));
        }
    }
    Ok(recordings)
}

/// A drive that is there twice would count twice.
fn refuse_copies(recordings: &[Recording]) -> Result<(), BadArgument> {
    let frames = |recording: &Recording| -> Vec<(u64, PositionM)> {
        recording.survey.iter().map(|frame| (frame.stamp_ns, frame.position_m)).collect()
    };
    for (i, recording) in recordings.iter().enumerate() {
        let is_copy = |earlier: &&Recording| {
            earlier.calibration_json() == recording.calibration_json() && frames(earlier) == frames(recording)
        };
        if let Some(first) = recordings[..i].iter().find(is_copy) {
            let (copy, first) = (recording.path.display(), first.path.display());
            return Err(BadArgument(format!("{copy} holds the same frames as {first}: name it once")));
        }
    }
    Ok(())
}

fn open_all(paths: &[PathBuf]) -> anyhow::Result<Vec<Recording>> {
    for (i, path) in paths.iter().enumerate() {
        check_not_input(path, &paths[..i]).map_err(|_| BadArgument(format!("{} is named twice", path.display())))?;
    }
    let (mut recordings, mut useless) = (Vec::new(), None);
    for path in paths {
        check_input(path)?;
        match Recording::open(path) {
            Ok(recording) => {
                let unusable = recording.unusable.len();
                if unusable > 0 {
                    let frames = counted(unusable, "frame");
                    eprintln!("note: {}: left out for want of a usable position: {frames}", path.display());
                }
                recordings.push(recording);
            }
            // What a start of the vehicle leaves at which camera or receiver never came.
            Err(error @ RecordingError::NoUsablePair { .. }) => {
                if paths.len() > 1 {
                    eprintln!("note: left out: {error}");
                }
                useless = Some(error);
            }
            Err(error) => return Err(error.into()),
        }
    }
    match useless {
        Some(error) if recordings.is_empty() => Err(error.into()),
        _ => Ok(recordings),
    }
}

/// Reads what learning by `recipes` needs of all frames, with what `smoothing` needs, if not that of each recipe.
pub fn read_to_learn(
    recordings: &[Recording],
    recipes: &[Recipe],
    smoothing: Option<Smoothing>,
    fixed: bool,
    progress: &Progress,
) -> anyhow::Result<Survey> {
    let smooths = |recipe: &Recipe| smoothing.unwrap_or(Smoothing::usual(recipe.name)) == Smoothing::Track;
    let options = SurveyOptions {
        descriptors: recipes.iter().flat_map(Recipe::descriptors).collect(),
        perturbed: recipes.iter().flat_map(Recipe::perturbed).collect(),
        fixed,
        // A panorama that is turned by its yaw says nothing of the heading.
        compass: !fixed,
        follow: !fixed && recipes.iter().any(smooths),
        repetitions: PERTURBED_COPIES,
        seed: 0,
    };
    read(recordings, options, progress)
}

/// Reads what matching all frames against a map with these `descriptors` needs.
pub fn read_to_match(
    recording: &Recording,
    descriptors: Vec<Descriptor>,
    progress: &Progress,
) -> anyhow::Result<Survey> {
    let options = SurveyOptions {
        descriptors,
        perturbed: Vec::new(),
        fixed: false,
        compass: true,
        follow: false,
        repetitions: 0,
        seed: 0,
    };
    read(std::slice::from_ref(recording), options, progress)
}

fn read(recordings: &[Recording], mut options: SurveyOptions, progress: &Progress) -> anyhow::Result<Survey> {
    options.descriptors.sort_unstable();
    options.descriptors.dedup();
    let frames = recordings.iter().map(|recording| recording.survey.len()).sum();
    progress.begin(if options.fixed { "reading frames, turned by their yaw" } else { "reading frames" }, frames);
    Ok(Survey::read(recordings, &options, |frames| progress.advance(frames))?)
}

/// A grid that cannot be is the caller's mistake.
pub fn bad_argument(error: TrialError) -> anyhow::Error {
    match error {
        TrialError::Cells(_) | TrialError::TableTooLarge { .. } => BadArgument(error.to_string()).into(),
        other => other.into(),
    }
}

/// A distance, as an argument.
pub fn parse_spacing_m(text: &str) -> Result<f64, String> {
    let spacing_m = text.parse().ok().filter(|spacing_m| (0.0..=1000.0).contains(spacing_m));
    spacing_m.ok_or_else(|| "expected metres from 0 to 1000".into())
}

/// A feature type, as an argument.
pub fn parse_descriptor(name: &str) -> Result<Descriptor, String> {
    name.parse().map_err(|error: crate::features::UnknownDescriptor| error.to_string())
}

/// Positions from a CSV `index,x_m,y_m`, one for every frame of `survey`.
pub fn read_truth(path: &std::path::Path, survey: &Survey) -> anyhow::Result<Vec<PositionM>> {
    check_input(path)?;
    let context = || format!("reading the truth {}", path.display());
    let mut csv = csv::ReaderBuilder::new().trim(csv::Trim::All).from_path(path).with_context(context)?;
    let header = csv.headers().with_context(context)?;
    if header != vec!["index", "x_m", "y_m"] {
        let found = header.iter().collect::<Vec<_>>().join(",");
        anyhow::bail!("{}: line 1: header is `{found}`, expected `index,x_m,y_m`", path.display());
    }
    let mut truth = std::collections::HashMap::new();
    for record in csv.records() {
        let record = record.with_context(context)?;
        let line = record.position().map_or(0, |position| position.line());
        let number = |i: usize, name: &str| {
            let value: Option<f64> = record[i].parse().ok().filter(|value: &f64| value.is_finite());
            value.with_context(|| {
                format!("{}: line {line}: {name} is `{}`, expected a finite number", path.display(), &record[i])
            })
        };
        let index: usize = record[0].parse().with_context(|| {
            format!("{}: line {line}: index is `{}`, expected a whole number", path.display(), &record[0])
        })?;
        if truth.insert(index, [number(1, "x_m")?, number(2, "y_m")?]).is_some() {
            anyhow::bail!("{}: line {line}: index {index} was given before", path.display());
        }
    }
    let of_frame = |index: usize| {
        truth.get(&index).copied().with_context(|| format!("{}: no line for frame {index}", path.display()))
    };
    let positions_m: Vec<PositionM> =
        survey.frames.iter().map(|frame| of_frame(frame.index)).collect::<anyhow::Result<_>>()?;
    if truth.len() > positions_m.len() {
        let extra = truth.len() - positions_m.len();
        let (path, lines) = (path.display(), counted(extra, "line"));
        eprintln!("warning: {path}: {lines} of no frame; is it the truth of this recording?");
    }
    Ok(positions_m)
}

/// A truth that lies further from the recorded positions than any receiver errs is of another drive, or counted from another
/// origin \[m\].
const ELSEWHERE_M: f64 = 10.0;

/// Why `truth_m`, read from `path`, is hardly that of `survey`.
pub fn elsewhere(path: &std::path::Path, truth_m: &[PositionM], survey: &Survey) -> Option<String> {
    let apart = truth_m.iter().zip(&survey.frames);
    let mut apart_m: Vec<f64> = apart.map(|(&truth_m, frame)| distance_m(truth_m, frame.position_m)).collect();
    apart_m.sort_unstable_by(f64::total_cmp);
    let median_m = *apart_m.get(apart_m.len() / 2)?;
    (median_m > ELSEWHERE_M).then(|| {
        format!(
            "--truth {}: half of its positions are more than {median_m:.1} m from the recorded ones: is it the truth of this \
             recording, from the same origin?",
            path.display()
        )
    })
}
