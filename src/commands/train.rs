//! `omniloc train`: recordings become a map.

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::Context;

use super::appearances::share_seen_once;
use super::evaluate_map::open_map;
use super::map_report;
use super::options::{OutputKind, check_input, check_not_input, check_output};
use super::progress::Progress;
use super::survey::{
    bad_argument, in_one_place, open_recordings, parse_descriptor, parse_spacing_m, read_to_learn, read_to_match,
};
use super::{BadArgument, DONE, print};
use crate::features::Descriptor;
use crate::map::{Grid, Recipe, RecipeName, Selection, Smoothing, SplitKind, file};
use crate::recording::write_bytes_atomically;
use crate::train::{TrainSettings, train, update};

/// Turn recordings of a place into a map
///
/// A quarter of the frames is first held back to choose features and to measure on; the map is then of all frames. The
/// default recipe is the one that measures best; `paper` is Do et al. (2015) to the letter.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Recordings of the place, all with the same lens; a folder stands for all in it
    #[arg(required = true, value_name = "REC.mcap")]
    pub recordings: Vec<PathBuf>,
    /// The map to write
    #[arg(long, value_name = "AREA.map")]
    pub out: PathBuf,
    /// Add one drive to this map instead of making a new one: another appearance, other streets. Its accuracy before and
    /// after is measured on frames of both that are held back; a map that has become worse is not written
    #[arg(
        long,
        value_name = "OLD.map",
        conflicts_with_all = ["features", "select", "grid_step_m", "within_m"]
    )]
    pub update: Option<PathBuf>,
    /// With --update: write the map even if it has become worse
    #[arg(long, requires = "update")]
    pub even_if_worse: bool,
    #[arg(long, value_enum, default_value = "default")]
    pub recipe: RecipeName,
    /// Feature types, in place of the recipe's own: fft, hist, sp, gradient, patches, patch-words
    #[arg(long, value_delimiter = ',', value_parser = parse_descriptor)]
    pub features: Vec<Descriptor>,
    /// How features are chosen [default: backward for the paper's recipe, none for the default one]
    #[arg(long, value_enum)]
    pub select: Option<Selection>,
    /// How the frames held back are drawn
    #[arg(long, value_enum, default_value = "random")]
    pub split: SplitKind,
    /// Seed of the split
    #[arg(long, default_value_t = 0)]
    pub seed: u64,
    /// Distance of neighbouring candidate cells [m; default: 1 outdoors, 0.1 where the positions lie within 20 m]
    #[arg(long, value_name = "M", allow_negative_numbers = true)]
    pub grid_step_m: Option<f64>,
    /// Candidate cells are at most this far from a learning position [m; default: 7 times the positions' spacing]
    #[arg(long, value_name = "M", allow_negative_numbers = true)]
    pub within_m: Option<f64>,
    /// Leave out frames that are closer than this to the one before [m; default: as many as make 800 frames]
    #[arg(long, value_name = "M", value_parser = parse_spacing_m)]
    pub spacing_m: Option<f64>,
    /// Correct the recorded positions before learning, by points of the scene, how the vehicle moved and places
    /// seen more than once
    /// [default: track for the default recipe, none for the paper's and with --update]
    #[arg(long, value_enum)]
    pub smooth: Option<Smoothing>,
    /// Replace the output if it exists
    #[arg(long)]
    pub force: bool,
}

/// A map of less skill than this is warned about.
const MIN_SKILL: f64 = 0.5;

/// A map of which a larger share was seen in one appearance only is warned about.
const MANY_SEEN_ONCE: f64 = 0.1;

pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    check_output(&args.out, OutputKind::File, args.force)?;
    check_not_input(&args.out, &args.recordings)?;
    if let Some(old) = &args.update {
        return add_drive(args, old);
    }
    let recipe = Recipe::new(args.recipe, &args.features);
    let recipe = match args.select {
        Some(selection) => recipe.with_selection(selection),
        None => recipe,
    };
    let recordings = in_one_place(open_recordings(&args.recordings, args.spacing_m)?)?;
    let progress = Progress::new();
    let smoothing = args.smooth.unwrap_or(Smoothing::usual(args.recipe));
    let survey = read_to_learn(&recordings, std::slice::from_ref(&recipe), Some(smoothing), false, &progress)?;
    let settings = TrainSettings {
        split: args.split,
        seed: args.seed,
        grid_step_m: args.grid_step_m.unwrap_or_else(|| Grid::usual_step_m(&survey.positions_m())),
        within_m: args.within_m,
        smoothing,
    };
    let sources: Vec<String> = recordings.iter().map(|recording| recording.name.clone()).collect();
    let map =
        train(&survey, &sources, &recipe, &settings, |step| progress.step("training", step)).map_err(bad_argument)?;
    let bytes = file::to_bytes(&map);
    write_bytes_atomically(&args.out, &bytes)?;
    progress.finish();
    let seen_once = share_seen_once(&recordings);
    if seen_once > MANY_SEEN_ONCE {
        let place = match (100.0 * seen_once).round() {
            100.0 => "its place".into(),
            percent => format!("{percent:.0} % of its place"),
        };
        eprintln!(
            "warning: the map has seen {place} only once: in other light or after a change it will err more there; record it \
             again on another day and name all recordings"
        );
    }
    if let Some(figures) = map.info.validation.last().filter(|figures| figures.skill < MIN_SKILL) {
        eprintln!(
            "warning: on the frames held back the map errs by {:.1} m (RMSE), hardly less than always answering the median \
             position: the frames are too far apart, too few, or their positions are wrong",
            figures.rmse_m
        );
    }
    print(&map_report::as_text(&args.out, &map, bytes.len() as u64))?;
    Ok(DONE.into())
}

/// A map with one more drive, if that does not make it worse.
fn add_drive(args: &Args, old: &Path) -> anyhow::Result<ExitCode> {
    check_input(old)?;
    check_not_input(&args.out, [&old.to_path_buf()])?;
    let map = open_map(old)?;
    let mut recordings = open_recordings(&args.recordings, args.spacing_m)?;
    let [recording] = recordings.as_mut_slice() else {
        return Err(BadArgument("--update adds one recording at a time: each is to be judged by itself".into()).into());
    };
    if let Some(origin) = map.info.origin
        && !recording.move_origin(origin)
    {
        let path = recording.path.display();
        anyhow::bail!("{path}: does not know where on the Earth it lies, but {} does", old.display());
    }
    let progress = Progress::new();
    let descriptors = map.info.groups.iter().map(|group| group.recipe.descriptor).collect();
    let survey = read_to_match(recording, descriptors, &progress)?;
    map.info
        .check_lens(&survey.calibration, survey.image_size_px)
        .with_context(|| format!("{} into {}", recording.path.display(), old.display()))?;
    // Without other passes to compare with, smoothing one drive brings little.
    let smoothing = args.smooth.unwrap_or(Smoothing::None);
    let (updated, report) = update(&map, &survey, &recording.name, smoothing)
        .with_context(|| format!("adding {} to {}", recording.path.display(), old.display()))?;
    progress.finish();
    print(&map_report::of_update(&report))?;
    if report.is_worse() && !args.even_if_worse {
        anyhow::bail!(
            "{} was not written: with this drive the map is worse on frames that were held back; --even-if-worse writes it",
            args.out.display()
        );
    }
    let bytes = file::to_bytes(&updated);
    write_bytes_atomically(&args.out, &bytes)?;
    print(&map_report::as_text(&args.out, &updated, bytes.len() as u64))?;
    Ok(DONE.into())
}
