//! `omniloc evaluate`: the paper's tables, and more, on one's own data.

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::Context;
use serde_json::json;

use super::options::{OutputKind, check_input, check_not_input, check_output};
use super::progress::Progress;
use super::reporter::Reporter;
#[cfg(not(feature = "report"))]
use super::reporter::TrialFacts;
use super::survey::{
    bad_argument, default_grid_step_m, open_recordings, parse_descriptor, parse_spacing_m, read_to_learn,
    read_to_match, read_truth,
};
use super::{BadArgument, DONE, print};
use crate::evaluate::{Entry, LEGEND, SequenceFigures, against_map, table};
use crate::features::Descriptor;
use crate::map::{FeatureMap, Recipe, RecipeName, Selection, Smoothing, SplitKind, file};
use crate::metrics::{ErrorFigures, component_median};
use crate::recording::{Recording, write_bytes_atomically};
#[cfg(feature = "report")]
use crate::report::TrialFacts;
use crate::train::{Outcome, Similarity, Split, Survey, TrackSmoother, Trial, noisy, run as run_trial};
use crate::types::PositionM;

/// Measure how well the method localizes on recordings
///
/// Without --map: the paper's protocol on every recording by itself - 50 % of the frames to learn from, 25 % to choose
/// features on, 25 % to test on - with the paper's recipe and the default one side by side, over several seeds, once
/// with frames drawn at random and once with whole stretches of the drive. With --map: every frame of other recordings
/// against that map.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Recordings
    #[arg(required = true, value_name = "REC.mcap")]
    pub recordings: Vec<PathBuf>,
    /// Measure against this map, frame by frame
    #[arg(
        long,
        value_name = "AREA.map",
        conflicts_with_all = ["recipe", "features", "select", "split", "seed", "seeds", "variants", "grid_step_m", "smooth"]
    )]
    pub map: Option<PathBuf>,
    /// Recipes to compare, separated by commas [default: paper,default]
    #[arg(long, value_enum, value_delimiter = ',', default_values = ["paper", "default"], hide_default_value = true)]
    pub recipe: Vec<RecipeName>,
    /// Feature types, in place of the recipes' own
    #[arg(long, value_delimiter = ',', value_parser = parse_descriptor)]
    pub features: Vec<Descriptor>,
    /// How features are chosen [default: backward for the paper's recipe, none for the default one]
    #[arg(long, value_enum)]
    pub select: Option<Selection>,
    /// How frames are split: random, blocked, or a CSV file `index,set` with learning, validation, test; several are
    /// separated by commas [default: random,blocked]
    #[arg(long, value_delimiter = ',', default_values = ["random", "blocked"], hide_default_value = true)]
    pub split: Vec<String>,
    /// Leave out frames that are closer than this to the one before [m; default: as many as make 800 frames]
    #[arg(long, value_name = "M", value_parser = parse_spacing_m)]
    pub spacing_m: Option<f64>,
    /// First seed of the splits
    #[arg(long, default_value_t = 0)]
    pub seed: u64,
    /// Number of seeds
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u64).range(1..=1000))]
    pub seeds: u64,
    /// Variants of the random split: plain; noisy, with 0.3 m of noise on all positions; fixed, with every panorama
    /// turned by its yaw [default: plain,noisy,fixed]
    #[arg(
        long,
        value_enum,
        value_delimiter = ',',
        default_values = ["plain", "noisy", "fixed"],
        hide_default_value = true,
        hide_possible_values = true
    )]
    pub variants: Vec<Variant>,
    /// Correct the positions that are learned from, by how the vehicle moved and by places seen more than once; errors
    /// are measured against the positions as they were recorded, or against --truth [default: track for the default
    /// recipe, none for the paper's]
    #[arg(long, value_enum)]
    pub smooth: Option<Smoothing>,
    /// Distance of neighbouring candidate cells [m; default: 1 outdoors, 0.1 where the positions lie within 20 m]
    #[arg(long, value_name = "M", allow_negative_numbers = true)]
    pub grid_step_m: Option<f64>,
    /// Measure errors against these positions (CSV `index,x_m,y_m`) instead of the recorded ones
    #[arg(long, value_name = "CSV")]
    pub truth: Option<PathBuf>,
    /// Write all results as one JSON object
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
    /// Put every test frame's estimate into the JSON
    #[arg(long, requires = "json")]
    pub frames: bool,
    /// Write a page with figures and tables into this folder, with the figures as SVG and PNG and every number that is
    /// drawn as JSON
    #[arg(long, value_name = "DIR")]
    pub report: Option<PathBuf>,
    /// With --map and --report: recordings that the map was learned from, to show their images beside the worst frames
    #[arg(long, value_name = "REC.mcap", requires_all = ["map", "report"], num_args = 1)]
    pub survey: Vec<PathBuf>,
    /// Replace the JSON file or the report if it exists
    #[arg(long)]
    pub force: bool,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum Variant {
    Plain,
    Noisy,
    Fixed,
}

/// What a trial is run on.
struct Case {
    split_name: String,
    split: Split,
    /// `None` for a split from a file.
    seed: Option<u64>,
    variant: Variant,
}

pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    let entries = evaluate(args)?;
    if let Some(path) = &args.json {
        write_json(path, args, entries)?;
    }
    Ok(DONE.into())
}

/// Evaluates and prints.
pub fn evaluate(args: &Args) -> anyhow::Result<Vec<Entry>> {
    if args.truth.is_some() && args.recordings.len() > 1 {
        return Err(BadArgument("--truth goes with one recording".into()).into());
    }
    if let Some(json) = &args.json {
        check_output(json, OutputKind::File, args.force)?;
        let inputs = args.recordings.iter().chain(&args.map).chain(&args.truth);
        check_not_input(json, inputs)?;
        let folder = json.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
        if !folder.is_dir() {
            return Err(
                BadArgument(format!("--json {}: there is no folder {}", json.display(), folder.display())).into()
            );
        }
    }
    // Against a map every frame counts: only learning is costly.
    let spacing_m = args.spacing_m.or(args.map.as_ref().map(|_| 0.0));
    let recordings = open_recordings(&args.recordings, spacing_m)?;
    let mut reporter =
        args.report.as_ref().map(|folder| Reporter::new(folder, args.force, settings(args))).transpose()?;
    let surveys = if args.survey.is_empty() { Vec::new() } else { open_recordings(&args.survey, Some(0.0))? };
    let progress = Progress::new();
    let mut all = Vec::new();
    for (number, recording) in recordings.iter().enumerate() {
        let entries = match &args.map {
            Some(path) => on_map(args, path, recording, reporter.as_mut(), &progress)?,
            None => protocol(args, recording, reporter.as_mut(), &progress)?,
        };
        if let Some(reporter) = &mut reporter {
            reporter.take_entries(&entries);
        }
        progress.finish();
        print(&format!("\nTable {}: {}\n{}", number + 1, recording.name, table(&entries)))?;
        print(&in_words(&entries))?;
        all.extend(entries);
    }
    print(&format!("\n{LEGEND}"))?;
    if let Some(reporter) = reporter {
        let page = reporter.write(&recordings, &surveys, &progress)?;
        progress.finish();
        print(&format!("\nreport     {}\n", page.display()))?;
    }
    Ok(all)
}

/// Options and what they were, for the report.
fn settings(args: &Args) -> Vec<(String, String)> {
    let list = |values: &mut dyn Iterator<Item = String>| values.collect::<Vec<_>>().join(", ");
    let own = |what: &str| format!("as the recipe has it{what}");
    let mut settings = vec![("recordings", list(&mut args.recordings.iter().map(|path| path.display().to_string())))];
    match &args.map {
        Some(map) => settings.push(("map", map.display().to_string())),
        None => settings.extend([
            ("recipes", list(&mut args.recipe.iter().map(|recipe| recipe.name().into()))),
            (
                "feature types",
                match args.features.is_empty() {
                    true => own(""),
                    false => list(&mut args.features.iter().map(|descriptor| descriptor.name().into())),
                },
            ),
            ("selection", args.select.map_or_else(|| own(""), |select| format!("{select:?}").to_lowercase())),
            ("splits", list(&mut args.split.iter().cloned())),
            ("seeds", list(&mut (args.seed..args.seed + args.seeds).map(|seed| seed.to_string()))),
            ("variants of the random split", list(&mut args.variants.iter().map(|v| format!("{v:?}").to_lowercase()))),
            (
                "smoothing of the track",
                args.smooth.map_or_else(|| own(""), |smooth| format!("{smooth:?}").to_lowercase()),
            ),
            (
                "grid step",
                args.grid_step_m.map_or("1 m outdoors, 0.1 m within 20 m".into(), |step_m| format!("{step_m} m")),
            ),
        ]),
    }
    let spacing = match (args.spacing_m, &args.map) {
        (Some(spacing_m), _) => format!("{spacing_m} m"),
        (None, Some(_)) => "none: every frame".into(),
        (None, None) => "none up to 800 frames".into(),
    };
    settings.push(("least spacing of the frames", spacing));
    let truth = args.truth.as_ref().map_or("positions as recorded".into(), |path| path.display().to_string());
    settings.push(("errors are measured against", truth));
    settings.into_iter().map(|(key, value)| (key.to_owned(), value)).collect()
}

/// What a table has no columns for: how far the estimates against a map may be trusted.
fn in_words(entries: &[Entry]) -> String {
    let mut text = String::new();
    for entry in entries {
        if entry.coverage_95.is_none() && entry.estimator == "filtered" {
            text += "filtered: not sure of the position in any frame, so there are no errors to speak of\n";
        }
        let Some(covered) = entry.coverage_95 else { continue };
        text += &format!(
            "{}: the region of 95 % holds the true position in {:.1} % of the frames",
            entry.estimator,
            100.0 * covered
        );
        if let Some(nees) = entry.nees_mean {
            text += &format!(", mean NEES {nees:.2} (2 is exact)");
        }
        if let Some(heading_deg) = entry.heading_median_deg {
            text += &format!("; heading off by {heading_deg:.1} deg (median)");
        }
        if let (Some(share), Some(s), Some(m)) =
            (entry.localized_share, entry.first_localized_s, entry.first_localized_m)
        {
            text += &format!("; {:.1} % of the frames localized, first after {s:.1} s and {m:.1} m", 100.0 * share);
        }
        text += "\n";
    }
    text
}

/// Every frame of `recording` against a map.
fn on_map(
    args: &Args,
    path: &Path,
    recording: &Recording,
    reporter: Option<&mut Reporter>,
    progress: &Progress,
) -> anyhow::Result<Vec<Entry>> {
    let map = open_map(path)?;
    if map.info.recordings.iter().any(|trained_on| trained_on.name == recording.name) {
        eprintln!("warning: the map was trained on {}: it knows these frames, and the errors flatter", recording.name);
    }
    let descriptors = map.info.groups.iter().map(|group| group.recipe.descriptor).collect();
    let mut recording = recording.clone();
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
    let survey = read_to_match(&recording, descriptors, progress)?;
    map.info
        .check_lens(&survey.calibration, survey.image_size_px)
        .with_context(|| format!("{} against {}", recording.path.display(), path.display()))?;
    let truth_m = truth(args, &survey)?;
    let indices: Vec<usize> = survey.frames.iter().map(|frame| frame.index).collect();
    let base = Entry {
        dataset: recording.name.clone(),
        estimator: "single",
        n_learning: map.positions_m.len(),
        n_learned_from: map.positions_m.len(),
        n_test: survey.len(),
        ..Entry::default()
    };
    let know_nothing_m = component_median(&map.positions_m);
    let outcomes = against_map(&survey, &map, &truth_m);
    if let Some(reporter) = reporter {
        reporter.begin(&recording, &survey, &truth_m)?;
        reporter.take_map(&survey, path, &map, &outcomes.sequences)?;
    }
    let mut entries: Vec<Entry> = outcomes
        .single
        .into_iter()
        .map(|outcome| {
            let entry = Entry {
                recipe: Some(map.info.recipe.name()),
                features: outcome.features,
                m: Some(outcome.m),
                rank: Some(outcome.rank),
                kept: Some(outcome.kept),
                compression: compression(outcome.m, outcome.kept),
                coverage_95: outcome.coverage_95,
                ..base.clone()
            };
            let entry = entry.with_figures(ErrorFigures::of(&outcome.estimates_m, &truth_m, know_nothing_m));
            entry.with_frames(&indices, &truth_m, &outcome.estimates_m)
        })
        .collect();
    let stamps_ns: Vec<u64> = survey.frames.iter().map(|frame| frame.stamp_ns).collect();
    let yaws_rad: Vec<Option<f64>> = survey.frames.iter().map(|frame| frame.yaw_rad).collect();
    for sequence in &outcomes.sequences {
        let said = sequence.poses.iter().zip(&truth_m).filter_map(|(pose, truth_m)| Some((pose.as_ref()?, *truth_m)));
        let (estimates_m, said_truth_m): (Vec<_>, Vec<_>) = said.map(|(pose, truth)| (pose.position_m, truth)).unzip();
        let figures = SequenceFigures::of(sequence, &stamps_ns, &truth_m, &yaws_rad);
        let entry = Entry {
            recipe: Some(map.info.recipe.name()),
            features: sequence.estimator.into(),
            estimator: sequence.estimator,
            ..base.clone()
        };
        let entry = entry.with_figures(ErrorFigures::of(&estimates_m, &said_truth_m, know_nothing_m));
        let entry = figures.map_or(entry.clone(), |figures| entry.with_sequence(&figures));
        entries.push(entry.with_poses(&indices, &truth_m, sequence));
    }
    entries.push(median_entry(base, &map.positions_m, &truth_m));
    Ok(entries)
}

pub fn open_map(path: &Path) -> anyhow::Result<FeatureMap> {
    check_input(path)?;
    let reader = std::fs::File::open(path).with_context(|| format!("opening the map {}", path.display()))?;
    file::read(reader).with_context(|| format!("loading the map {}", path.display()))
}

/// The paper's protocol on one recording.
fn protocol(
    args: &Args,
    recording: &Recording,
    mut reporter: Option<&mut Reporter>,
    progress: &Progress,
) -> anyhow::Result<Vec<Entry>> {
    let recipes: Vec<Recipe> = args
        .recipe
        .iter()
        .map(|&name| Recipe::new(name, &args.features))
        .map(|recipe| args.select.map_or(recipe.clone(), |selection| recipe.with_selection(selection)))
        .collect();
    let recording_of = std::slice::from_ref(recording);
    let plain = read_to_learn(recording_of, &recipes, false, progress)?;
    let wants_fixed = args.variants.contains(&Variant::Fixed) && args.split.iter().any(|split| split == "random");
    let fixed = match wants_fixed && plain.frames.iter().all(|frame| frame.yaw_rad.is_some()) {
        true => Some(read_to_learn(recording_of, &recipes, true, progress)?),
        false => None,
    };
    if wants_fixed && fixed.is_none() {
        eprintln!("note: {}: not every frame has a yaw; there are no (fixed) rows", recording.name);
    }
    let truth_m = truth(args, &plain)?;
    if let Some(reporter) = &mut reporter {
        reporter.begin(recording, &plain, &truth_m)?;
    }
    let similarity = |recipe: &Recipe| match smoothing(args, recipe) {
        Smoothing::None => None,
        Smoothing::Track => Similarity::of(&plain, recipe),
    };
    let similarities: Vec<Option<Similarity>> = recipes.iter().map(similarity).collect();
    let smoother = TrackSmoother::new(&plain, &plain.positions_m());
    let mut entries = Vec::new();
    for case in cases(args, &plain)? {
        let survey = match (case.variant, &fixed) {
            (Variant::Fixed, Some(fixed)) => fixed,
            (Variant::Fixed, None) => continue,
            _ => &plain,
        };
        let learning = Learning { recipes: &recipes, similarities: &similarities, smoother: &smoother };
        entries.extend(trial_entries(
            args,
            recording,
            survey,
            &learning,
            &truth_m,
            &case,
            reporter.as_deref_mut(),
            progress,
        )?);
    }
    Ok(entries)
}

/// Splits, seeds and variants, in the order of the table.
fn cases(args: &Args, survey: &Survey) -> anyhow::Result<Vec<Case>> {
    let mut cases = Vec::new();
    for name in &args.split {
        let kind = match name.as_str() {
            "random" => SplitKind::Random,
            "blocked" => SplitKind::Blocked,
            path => {
                check_input(Path::new(path))
                    .with_context(|| format!("--split {path}: neither random nor blocked nor a file"))?;
                let indices: Vec<usize> = survey.frames.iter().map(|frame| frame.index).collect();
                let file = std::fs::File::open(path).with_context(|| format!("opening the split {path}"))?;
                let split = Split::from_csv(file, &indices).with_context(|| format!("reading the split {path}"))?;
                cases.push(Case { split_name: path.into(), split, seed: None, variant: Variant::Plain });
                continue;
            }
        };
        let variants: &[Variant] = if kind == SplitKind::Random { &args.variants } else { &[Variant::Plain] };
        for &variant in variants {
            for seed in args.seed..args.seed + args.seeds {
                let split = Split::new(kind, survey.len(), seed);
                cases.push(Case { split_name: name.clone(), split, seed: Some(seed), variant });
            }
        }
    }
    Ok(cases)
}

/// What all cases learn with.
struct Learning<'a> {
    recipes: &'a [Recipe],
    /// One a recipe; `None` where no track is smoothed, or nothing is known of how images change.
    similarities: &'a [Option<Similarity>],
    /// Of the positions as they were recorded.
    smoother: &'a TrackSmoother,
}

/// All rows of one case: the recipes, and the answer that knows nothing.
fn trial_entries(
    args: &Args,
    recording: &Recording,
    survey: &Survey,
    learning: &Learning,
    truth_m: &[PositionM],
    case: &Case,
    mut reporter: Option<&mut Reporter>,
    progress: &Progress,
) -> anyhow::Result<Vec<Entry>> {
    let recorded_m = match case.variant {
        Variant::Noisy => noisy(&survey.positions_m(), case.seed.unwrap_or(0)),
        _ => survey.positions_m(),
    };
    // Noise on all positions is also on those that errors are measured against, unless the truth is given.
    let truth_m = if args.truth.is_some() { truth_m } else { &recorded_m };
    let pick = |rows: &[usize], of: &[PositionM]| -> Vec<PositionM> { rows.iter().map(|&row| of[row]).collect() };
    let (test_m, validation_m) = (pick(&case.split.test, truth_m), pick(&case.split.validation, &recorded_m));
    let indices: Vec<usize> = case.split.test.iter().map(|&row| survey.frames[row].index).collect();
    let grid_step_m = args.grid_step_m.unwrap_or_else(|| default_grid_step_m(&recorded_m));
    let base = Entry {
        dataset: recording.name.clone(),
        estimator: "single",
        split: Some(case.split_name.clone()),
        seed: case.seed,
        noisy: case.variant == Variant::Noisy,
        fixed: case.variant == Variant::Fixed,
        n_learning: case.split.learning.len(),
        n_validation: case.split.validation.len(),
        n_test: case.split.test.len(),
        n_learned_from: case.split.learning.len(),
        ..Entry::default()
    };
    // What the fits have to say is said once, not for every seed and variant.
    let announced = case.variant == Variant::Plain
        && case.split_name == args.split[0]
        && case.seed.is_none_or(|seed| seed == args.seed);
    let know_nothing_m = component_median(&pick(&case.split.learning, &recorded_m));
    let noisy_smoother = (case.variant == Variant::Noisy).then(|| TrackSmoother::new(survey, &recorded_m));
    let smoother = noisy_smoother.as_ref().unwrap_or(learning.smoother);
    let mut entries = Vec::new();
    for (recipe, similarity) in learning.recipes.iter().zip(learning.similarities) {
        let variant = match case.variant {
            Variant::Plain => "",
            Variant::Noisy => " (noisy)",
            Variant::Fixed => " (fixed)",
        };
        let seed = case.seed.map(|seed| format!(", seed {seed}")).unwrap_or_default();
        let part = format!("{}, {}{variant}{seed}", recipe.name.name(), case.split_name);
        let learned_m = match smoothing(args, recipe) {
            Smoothing::None => recorded_m.clone(),
            Smoothing::Track => {
                // The images of frames that are never learned from have no part in it.
                let mut learned = case.split.learning.clone();
                if recipe.refit {
                    learned.extend(&case.split.validation);
                    learned.sort_unstable();
                }
                smoother.smoothed(&learned, similarity.as_ref()).positions_m
            }
        };
        let trial = Trial { recipe, split: &case.split, grid_step_m, recorded_m: &learned_m };
        let outcomes = run_trial(survey, &trial, |step| progress.step(&part, step)).map_err(bad_argument)?;
        if let (Some(reporter), Variant::Plain) = (&mut reporter, case.variant) {
            let (split_name, seed, learned_m) = (&case.split_name[..], case.seed, &learned_m[..]);
            let facts = TrialFacts { recipe, split: &case.split, split_name, seed, grid_step_m, learned_m, truth_m };
            reporter.take_trial(survey, &facts, &outcomes)?;
        }
        for outcome in &outcomes.rows {
            for (warning, count) in outcome.warnings.iter().filter(|_| announced) {
                let (features, of) = (&outcome.features, outcome.rank);
                progress.say(&format!("note: {part}: {features}: {count} of {of} fits: {}", warning.describe()));
            }
            let base = Entry { n_learned_from: outcomes.learned_from, ..base.clone() };
            let entry = outcome_entry(base, recipe, outcome, &validation_m, &test_m, know_nothing_m);
            let estimates_m = estimates_of(recipe, outcome);
            entries.push(entry.with_frames(&indices, &test_m, estimates_m));
        }
    }
    entries.push(median_entry(base, &pick(&case.split.learning, &recorded_m), &test_m));
    Ok(entries)
}

/// The estimates that a recipe stands for: with the features it keeps.
fn estimates_of<'a>(recipe: &Recipe, outcome: &'a Outcome) -> &'a [PositionM] {
    match recipe.selection {
        Selection::None => &outcome.all_test_m,
        Selection::Backward | Selection::Folded => &outcome.kept_test_m,
    }
}

fn outcome_entry(
    base: Entry,
    recipe: &Recipe,
    outcome: &Outcome,
    validation_m: &[PositionM],
    test_m: &[PositionM],
    know_nothing_m: PositionM,
) -> Entry {
    let rmse_m = |estimates_m: &[PositionM], truth_m: &[PositionM]| {
        ErrorFigures::of(estimates_m, truth_m, know_nothing_m).map(|f| f.rmse_m)
    };
    let selects = recipe.selection != Selection::None;
    let entry = Entry {
        recipe: Some(recipe.name.name()),
        features: outcome.features.clone(),
        m: Some(outcome.m),
        rank: Some(outcome.rank),
        kept: Some(outcome.kept),
        compression: compression(outcome.m, outcome.kept),
        rmse_all_test_m: rmse_m(&outcome.all_test_m, test_m),
        rmse_be_validation_m: rmse_m(&outcome.kept_validation_m, validation_m),
        rmse_be_test_m: selects.then(|| rmse_m(&outcome.kept_test_m, test_m)).flatten(),
        bic_all: outcome.bic_all,
        bic_kept: outcome.bic_kept.filter(|_| selects),
        ..base
    };
    entry.with_figures(ErrorFigures::of(estimates_of(recipe, outcome), test_m, know_nothing_m))
}

/// The row of always answering the median of the learning positions.
fn median_entry(base: Entry, learning_m: &[PositionM], truth_m: &[PositionM]) -> Entry {
    let median_m = component_median(learning_m);
    let answers = vec![median_m; truth_m.len()];
    Entry { features: "median".into(), ..base }.with_figures(ErrorFigures::of(&answers, truth_m, median_m))
}

fn compression(m: usize, kept: usize) -> Option<f64> {
    (kept > 0).then(|| m as f64 / kept as f64)
}

fn smoothing(args: &Args, recipe: &Recipe) -> Smoothing {
    args.smooth.unwrap_or(Smoothing::usual(recipe.name))
}

fn truth(args: &Args, survey: &Survey) -> anyhow::Result<Vec<PositionM>> {
    match &args.truth {
        Some(path) => read_truth(path, survey),
        None => Ok(survey.positions_m()),
    }
}

fn write_json(path: &Path, args: &Args, mut entries: Vec<Entry>) -> anyhow::Result<()> {
    if !args.frames {
        entries.iter_mut().for_each(|entry| entry.frames = None);
    }
    let command: Vec<String> = std::env::args().collect();
    let datasets: Vec<String> = args.recordings.iter().map(|path| path.display().to_string()).collect();
    let object = json!({
        "program": env!("CARGO_PKG_VERSION"),
        "command": command,
        "datasets": datasets,
        "results": entries,
    });
    write_bytes_atomically(path, format!("{object:#}\n").as_bytes())?;
    Ok(())
}
