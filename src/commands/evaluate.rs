//! `omniloc evaluate`: the paper's tables, and more, on one's own data.

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::Context;
use serde_json::json;

use super::evaluate_map::on_map;
use super::inputs::inputs;
use super::options::{OutputKind, check_input, check_no_folder, check_not_input, check_output, command_line, resolved};
use super::progress::Progress;
use super::reporter::Reporter;
use super::survey::{
    bad_argument, elsewhere, open_recordings, parse_descriptor, parse_spacing_m, read_to_learn, read_truth,
};
use super::{BadArgument, DONE, print, printable};
use crate::evaluate::baselines::{Baseline, Views};
use crate::evaluate::{
    Case, Entry, Evaluation, LEGEND, PositionShift, Protocol, Statistics, Variant, statistics, table,
};
use crate::features::Descriptor;
use crate::map::{Recipe, RecipeName, Selection, Smoothing, SplitKind};
use crate::metrics::uncertainty_verdict;
use crate::recording::{Recording, write_bytes_atomically};
use crate::train::{Outcomes, Similarity, Split, Survey, TrackSmoother, Trial};
use crate::types::counted;

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
    /// Correct the positions that are learned from, by points of the scene, how the vehicle moved and places seen more
    /// than once; errors are measured against the positions as they were recorded, or against --truth [default: track
    /// for the default recipe, none for the paper's]
    #[arg(long, value_enum)]
    pub smooth: Option<Smoothing>,
    /// What to compare with, separated by commas: none; nearest, the nearest learning image by z-scored properties;
    /// aligned, the nearest by circular correlation of small panoramas; bow, a bag of words of upright patches, by the
    /// paper's protocol and as nearest image; bow-surf, the same of SURF, in builds with that [default: nearest,aligned,bow]
    #[arg(
        long,
        value_enum,
        value_delimiter = ',',
        default_values = ["nearest", "aligned", "bow"],
        hide_default_value = true,
        hide_possible_values = true
    )]
    pub baselines: Vec<Baseline>,
    /// With --map: the recordings it was trained on, for the baselines that compare images; a map holds none
    #[arg(long, value_name = "REC.mcap", requires = "map")]
    pub survey: Vec<PathBuf>,
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
    #[arg(long, value_name = "DIR", hide = cfg!(not(feature = "report")))]
    pub report: Option<PathBuf>,
    /// Replace the JSON file or the report if it exists
    #[arg(long)]
    pub force: bool,
}

pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    let evaluation = evaluate(args)?;
    if let Some(path) = &args.json {
        write_json(path, args, evaluation)?;
    }
    Ok(DONE.into())
}

/// Evaluates and prints.
pub fn evaluate(args: &Args) -> anyhow::Result<Evaluation> {
    for baseline in &args.baselines {
        let refused = |reason: &str| BadArgument(format!("--baselines {}: {reason}", baseline.name()));
        baseline.check().map_err(refused)?;
        if *baseline == Baseline::None && args.baselines.len() > 1 {
            return Err(refused("goes with no other").into());
        }
    }
    for file in args.map.iter().chain(&args.truth) {
        check_input(file)?;
        check_no_folder(file)?;
    }
    for split in args.split.iter().filter(|split| !matches!(split.as_str(), "random" | "blocked")) {
        let is_file = check_input(Path::new(split)).and_then(|()| check_no_folder(Path::new(split)));
        is_file.with_context(|| format!("--split {split}: neither random nor blocked nor a file"))?;
    }
    if args.truth.is_some() && args.recordings.len() > 1 {
        return Err(BadArgument("--truth goes with one recording".into()).into());
    }
    if let Some(json) = &args.json {
        check_output(json, OutputKind::File, args.force)?;
        let inputs = args.recordings.iter().chain(&args.map).chain(&args.truth).chain(&args.survey);
        check_not_input(json, inputs)?;
        if let Some(report) = args.report.as_ref().filter(|report| resolved(json).starts_with(resolved(report))) {
            let (json, report) = (json.display(), report.display());
            return Err(BadArgument(format!(
                "--json {json}: lies in the folder of the report, {report}, which holds a report and nothing else; choose \
                 another name"
            ))
            .into());
        }
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
    let progress = Progress::new();
    let mut all = Evaluation::default();
    if args.json.is_some() || reporter.is_some() {
        all.inputs = inputs(args)?;
    }
    if let Some(reporter) = &mut reporter {
        reporter.take_inputs(&all.inputs);
    }
    for (number, recording) in recordings.iter().enumerate() {
        let evaluation = match &args.map {
            Some(path) => on_map(args, path, recording, reporter.as_mut(), &progress)?,
            None => protocol(args, recording, reporter.as_mut(), &progress)?,
        };
        if let Some(reporter) = &mut reporter {
            reporter.take_evaluation(&evaluation);
        }
        let Evaluation { entries, statistics, assignments, shifts, warnings, .. } = evaluation;
        progress.finish();
        print(&format!("\nTable {}: {}\n{}", number + 1, printable(&recording.name), table(&entries)))?;
        print(&in_words(&entries))?;
        PositionShift::lines(&shifts).iter().try_for_each(|line| print(&format!("{}\n", printable(line))))?;
        print(&statistics::text(&statistics))?;
        all.entries.extend(entries);
        all.statistics.methods.extend(statistics.methods);
        all.statistics.comparisons.extend(statistics.comparisons);
        all.assignments.extend(assignments);
        all.shifts.extend(shifts);
        all.warnings.extend(warnings);
    }
    print(&format!("\n{LEGEND}\n{}", statistics::LEGEND))?;
    if let Some(reporter) = reporter {
        let page = reporter.write(&recordings, &progress)?;
        progress.finish();
        print(&format!("\nreport     {}\n", page.display()))?;
    }
    Ok(all)
}

/// Options and what they were, for the report.
fn settings(args: &Args) -> Vec<(String, String)> {
    let list = |values: &mut dyn Iterator<Item = String>| values.collect::<Vec<_>>().join(", ");
    let own = || "as the recipe has it".to_owned();
    let name = |value: &dyn std::fmt::Debug| format!("{value:?}").to_lowercase();
    let mut settings = vec![("recordings", list(&mut args.recordings.iter().map(|path| path.display().to_string())))];
    match &args.map {
        Some(map) => settings.push(("map", map.display().to_string())),
        None => {
            let features = list(&mut args.features.iter().map(|descriptor| descriptor.name().into()));
            settings.extend([
                ("recipes", list(&mut args.recipe.iter().map(|recipe| recipe.name().into()))),
                ("feature types", if features.is_empty() { own() } else { features }),
                ("selection", args.select.map_or_else(own, |select| name(&select))),
                ("splits", list(&mut args.split.iter().cloned())),
                ("seeds", list(&mut (args.seed..args.seed + args.seeds).map(|seed| seed.to_string()))),
                ("variants of the random split", list(&mut args.variants.iter().map(|variant| name(variant)))),
                ("smoothing of the track", args.smooth.map_or_else(own, |smooth| name(&smooth))),
                (
                    "grid step",
                    args.grid_step_m.map_or("1 m outdoors, 0.1 m within 20 m".into(), |step_m| format!("{step_m} m")),
                ),
            ]);
        }
    }
    settings.push(("baselines", list(&mut args.baselines.iter().map(|baseline| baseline.name().into()))));
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
        let frames = entry.frames.iter().flatten().filter(|frame| frame.est_e_m.is_some()).count();
        text += &format!(
            "{}: the region of 95 % holds the true position in {:.1} % of {}: {}",
            entry.estimator,
            100.0 * covered,
            counted(frames, "frame"),
            uncertainty_verdict(covered, entry.nees_mean, frames)
        );
        if let Some(nees) = entry.nees_mean {
            text += &format!("; mean NEES {nees:.2} (2 is exact)");
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

/// Reads what the baselines that compare images need of all frames of `recordings`.
pub fn read_views(recordings: &[&Recording], args: &Args, fixed: bool, progress: &Progress) -> anyhow::Result<Views> {
    let frames = recordings.iter().map(|recording| recording.survey.len()).sum();
    if args.baselines.iter().any(|baseline| baseline.compares_images()) {
        progress.begin(if fixed { "reading views, turned by their yaw" } else { "reading views" }, frames);
    }
    Ok(Views::read(recordings, &args.baselines, fixed, |frames| progress.advance(frames))?)
}

/// The paper's protocol on one recording.
fn protocol(
    args: &Args,
    recording: &Recording,
    mut reporter: Option<&mut Reporter>,
    progress: &Progress,
) -> anyhow::Result<Evaluation> {
    let recipes: Vec<Recipe> = args
        .recipe
        .iter()
        .map(|&name| Recipe::new(name, &args.features))
        .map(|recipe| args.select.map_or(recipe.clone(), |selection| recipe.with_selection(selection)))
        .collect();
    let recording_of = std::slice::from_ref(recording);
    let read_all = |fixed: bool| -> anyhow::Result<(Survey, Views)> {
        let survey = read_to_learn(recording_of, &recipes, args.smooth, fixed, progress)?;
        Ok((survey, read_views(&[recording], args, fixed, progress)?))
    };
    let (plain, plain_views) = read_all(false)?;
    let wants_fixed = args.variants.contains(&Variant::Fixed) && args.split.iter().any(|split| split == "random");
    let has_yaws = plain.frames.iter().all(|frame| frame.yaw_rad.is_some());
    let fixed = if wants_fixed && has_yaws { Some(read_all(true)?) } else { None };
    if wants_fixed && fixed.is_none() {
        let name = printable(&recording.name);
        eprintln!("note: {name}: not every frame has a yaw; there are no (fixed) rows");
    }
    let exact_m = args.truth.as_ref().map(|path| read_truth(path, &plain)).transpose()?;
    let smooths = |recipe: &Recipe| args.smooth.unwrap_or(Smoothing::usual(recipe.name)) == Smoothing::Track;
    let similarity = |recipe: &Recipe| smooths(recipe).then(|| Similarity::of(&plain, recipe)).flatten();
    let similarities: Vec<Option<Similarity>> = recipes.iter().map(similarity).collect();
    let protocol = Protocol {
        dataset: &recording.name,
        recipes: &recipes,
        similarities: &similarities,
        smoother: &TrackSmoother::new(&plain, &plain.positions_m()),
        smoothing: args.smooth,
        truth_m: exact_m.as_deref(),
        grid_step_m: args.grid_step_m,
        baselines: &args.baselines,
    };
    if let Some(reporter) = &mut reporter {
        reporter.begin(recording, &plain, exact_m.as_ref().unwrap_or(&plain.positions_m()));
    }
    let doubtful = args.truth.as_ref().zip(exact_m.as_ref());
    let warnings: Vec<String> =
        doubtful.and_then(|(path, truth_m)| elsewhere(path, truth_m, &plain)).into_iter().collect();
    warnings.iter().for_each(|warning| eprintln!("warning: {}", printable(warning)));
    let mut all = Evaluation { warnings, ..Evaluation::default() };
    for case in cases(args, &plain)? {
        let (survey, views) = match (case.variant, &fixed) {
            (Variant::Fixed, Some((survey, views))) => (survey, views),
            (Variant::Fixed, None) => continue,
            _ => (&plain, &plain_views),
        };
        let mut seen = Ok(());
        let on_trial = |trial: &Trial, outcomes: &Outcomes| {
            if let (Some(reporter), Variant::Plain, Ok(())) = (&mut reporter, case.variant, &seen) {
                seen = reporter.take_trial(survey, &case, trial, outcomes);
            }
        };
        let on_step = |part: &str, step| progress.step(part, step);
        let results = protocol.run(survey, &case, on_step, on_trial).map_err(bad_argument)?;
        seen?;
        // What the fits have to say is said once, not for every seed and variant.
        let is_first = case.variant == Variant::Plain
            && case.split_name == args.split[0]
            && case.seed.is_none_or(|seed| seed == args.seed);
        progress.begin(&format!("baselines, {}", case.describe()), 1);
        let rows = protocol.run_baselines(survey, views, &case);
        for note in results.notes.iter().chain(&rows.notes).filter(|_| is_first) {
            progress.say(&format!("note: {note}"));
        }
        all.entries.extend(results.entries);
        all.shifts.extend(results.shifts);
        all.entries.extend(rows.entries);
        all.assignments.extend(rows.assignments);
    }
    progress.begin("statistics", 1);
    all.statistics = Statistics::of(&all.entries);
    Ok(all)
}

/// Splits, seeds and variants, in the order of the table.
fn cases(args: &Args, survey: &Survey) -> anyhow::Result<Vec<Case>> {
    let mut cases = Vec::new();
    let end = args.seed.checked_add(args.seeds).ok_or_else(|| {
        BadArgument(format!(
            "--seed {}: there are no {} seeds from there on; name a smaller one",
            args.seed, args.seeds
        ))
    })?;
    for (number, name) in args.split.iter().enumerate() {
        if args.split[..number].contains(name) {
            return Err(BadArgument(format!("--split {name}: is named twice; the same split is no second one")).into());
        }
        let kind = match name.as_str() {
            "random" => SplitKind::Random,
            "blocked" => SplitKind::Blocked,
            path => {
                let indices: Vec<usize> = survey.frames.iter().map(|frame| frame.index).collect();
                let file = std::fs::File::open(path).with_context(|| format!("opening the split {path}"))?;
                let split = Split::from_csv(file, &indices).with_context(|| format!("reading the split {path}"))?;
                cases.push(Case { split_name: path.into(), split, seed: None, variant: Variant::Plain });
                continue;
            }
        };
        let variants: &[Variant] = if kind == SplitKind::Random { &args.variants } else { &[Variant::Plain] };
        for &variant in variants {
            for seed in args.seed..end {
                let split = Split::new(kind, survey.len(), seed);
                cases.push(Case { split_name: name.clone(), split, seed: Some(seed), variant });
            }
        }
    }
    Ok(cases)
}

fn write_json(path: &Path, args: &Args, mut evaluation: Evaluation) -> anyhow::Result<()> {
    let command = command_line();
    let datasets: Vec<String> = args.recordings.iter().map(|path| path.display().to_string()).collect();
    if !args.frames {
        evaluation.entries.iter_mut().for_each(|entry| entry.frames = None);
    }
    let mut object = json!({
        "program": env!("CARGO_PKG_VERSION"),
        "command": command,
        "datasets": datasets,
        "inputs": evaluation.inputs,
        "warnings": evaluation.warnings,
        "results": evaluation.entries,
        "statistics": evaluation.statistics,
        "position_shifts": evaluation.shifts,
    });
    if args.frames {
        object["assignments"] = json!(evaluation.assignments);
    }
    write_bytes_atomically(path, format!("{object:#}\n").as_bytes())?;
    Ok(())
}
