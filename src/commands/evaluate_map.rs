//! `omniloc evaluate --map`: every frame of other recordings against a map.

use std::path::Path;

use anyhow::Context;

use super::evaluate::{Args, read_views};
use super::options::check_input;
use super::printable;
use super::progress::Progress;
use super::reporter::Reporter;
use super::survey::{elsewhere, open_recordings, read_to_match, read_truth};
use crate::evaluate::baselines::{Baseline, BaselineRows};
use crate::evaluate::statistics::Section;
use crate::evaluate::{Evaluation, MapComparison, PositionShift, Statistics, map_entries};
use crate::map::{FeatureMap, file};
use crate::recording::Recording;
use crate::train::Survey;
use crate::types::{PositionM, counted};

/// Every frame of `recording` against a map.
pub fn on_map(
    args: &Args,
    path: &Path,
    recording: &Recording,
    reporter: Option<&mut Reporter>,
    progress: &Progress,
) -> anyhow::Result<Evaluation> {
    let map = open_map(path)?;
    let mut warnings = Vec::new();
    if map.info.recordings.iter().any(|trained_on| trained_on.name == recording.name) {
        let name = &recording.name;
        warnings.push(format!("the map was trained on {name}: it knows these frames, and the errors flatter"));
    }
    let descriptors = map.info.groups.iter().map(|group| group.recipe.descriptor).collect();
    let recording = moved_to(&map, path, recording.clone())?;
    let survey = read_to_match(&recording, descriptors, progress)?;
    map.info
        .check_lens(&survey.calibration, survey.image_size_px)
        .with_context(|| format!("{} against {}", recording.path.display(), path.display()))?;
    let truth_m = truth(args, &survey)?;
    warnings.extend(args.truth.as_ref().and_then(|path| elsewhere(path, &truth_m, &survey)));
    warnings.extend(off_the_map(&recording.name, path, &map, &truth_m));
    let mut entries = map_entries(&recording.name, &survey, &map, &truth_m);
    let learned = if args.survey.is_empty() { Vec::new() } else { open_surveys(args, path, &map, &mut warnings)? };
    warnings.iter().for_each(|warning| eprintln!("warning: {}", printable(warning)));
    if let Some(reporter) = reporter {
        progress.begin("report: what the map knows", 1);
        reporter.begin(&recording, &survey, &truth_m);
        reporter.take_map(&survey, path, &map, &learned);
    }

    let mut rows = BaselineRows::default();
    let comparison = MapComparison { dataset: &recording.name, survey: &survey, map: &map, truth_m: &truth_m };
    if args.baselines.contains(&Baseline::Nearest) {
        comparison.add_nearest(&mut rows);
    }
    let compare_images: Vec<&str> =
        args.baselines.iter().filter(|baseline| baseline.compares_images()).map(|baseline| baseline.name()).collect();
    if !compare_images.is_empty() && args.survey.is_empty() {
        let names = compare_images.join(", ");
        eprintln!(
            "note: no rows for {names}: a map holds features, not images; --survey names the recordings it is of"
        );
    } else if !compare_images.is_empty() {
        let views = read_views(&learned.iter().chain([&recording]).collect::<Vec<_>>(), args, false, progress)?;
        progress.begin("baselines", 1);
        comparison.add_views(&mut rows, &learned, &views);
    }
    comparison.add_median(&mut rows);
    rows.notes.iter().for_each(|note| progress.say(&format!("note: {note}")));
    entries.extend(rows.entries);
    let statistics = Statistics::of(&entries);
    let known = learned.iter().map(|recording| {
        let of_frames = recording.survey.iter().map(|frame| (frame.index, frame.position_m));
        let (indices, positions_m): (Vec<_>, Vec<_>) = of_frames.unzip();
        (recording.name.as_str(), indices, positions_m)
    });
    let section = Section { dataset: recording.name.clone(), split: None, noisy: false, fixed: false };
    let shifts = PositionShift::of_map(&section, &map.info, &map.positions_m, &known.collect::<Vec<_>>());
    Ok(Evaluation { entries, statistics, assignments: rows.assignments, shifts, warnings, inputs: Vec::new() })
}

/// Said where most of the positions lie outside all cells: nothing there can be found.
fn off_the_map(name: &str, path: &Path, map: &FeatureMap, truth_m: &[PositionM]) -> Option<String> {
    let off = truth_m.iter().filter(|&&position_m| map.cells.near(position_m, 1).next().is_none()).count();
    (2 * off > truth_m.len()).then(|| {
        format!(
            "{off} of the {} positions of {name} lie outside the cells of {}: no frame can be found there; is it a map of this \
             place, from the same origin?",
            truth_m.len(),
            path.display()
        )
    })
}

/// `recording` with its positions counted from the map's origin.
fn moved_to(map: &FeatureMap, path: &Path, mut recording: Recording) -> anyhow::Result<Recording> {
    if let Some(origin) = map.info.origin
        && !recording.move_origin(origin)
    {
        anyhow::bail!(
            "{}: does not know where on the Earth it lies, but {} does: positions cannot be compared; import it with \
             --origin",
            recording.path.display(),
            path.display()
        );
    }
    Ok(recording)
}

/// The recordings that a map was made of.
fn open_surveys(
    args: &Args,
    path: &Path,
    map: &FeatureMap,
    warnings: &mut Vec<String>,
) -> anyhow::Result<Vec<Recording>> {
    let recordings = open_recordings(&args.survey, None)?;
    for recording in &recordings {
        if !map.info.recordings.iter().any(|learned| learned.name == recording.name) {
            let of: Vec<&str> = map.info.recordings.iter().map(|learned| learned.name.as_str()).collect();
            warnings.push(format!(
                "{} was learned from {}, not from --survey {}: the baselines learn from another drive",
                path.display(),
                of.join(", "),
                recording.name
            ));
        }
    }
    let frames: usize = recordings.iter().map(|recording| recording.survey.len()).sum();
    if frames != map.positions_m.len() {
        warnings.push(format!(
            "{} was learned from {}, --survey has {frames}: the baselines do not learn from the same",
            path.display(),
            counted(map.positions_m.len(), "frame")
        ));
    }
    let moved = recordings.into_iter().map(|recording| {
        map.info
            .check_lens(&recording.calibration()?, map.info.image_size_px.into())
            .with_context(|| format!("--survey {}", recording.path.display()))?;
        moved_to(map, path, recording)
    });
    moved.collect()
}

pub fn open_map(path: &Path) -> anyhow::Result<FeatureMap> {
    check_input(path)?;
    let reader = std::fs::File::open(path).with_context(|| format!("opening the map {}", path.display()))?;
    file::read(reader).with_context(|| format!("loading the map {}", path.display()))
}

fn truth(args: &Args, survey: &Survey) -> anyhow::Result<Vec<PositionM>> {
    match &args.truth {
        Some(path) => read_truth(path, survey),
        None => Ok(survey.positions_m()),
    }
}
