//! `omniloc demo`: the whole way in a simulated town, without any hardware.

use std::{
    fs,
    path::{Path, PathBuf},
    process::ExitCode,
    time::Instant,
};

use anyhow::Context;
use clap::Parser;

use super::{Cli, DONE, print};

/// Drive through a simulated town, record it, learn a map and localize on another day
///
/// Camera and receiver are simulated; what records, pairs, learns and localizes is the real program, and the receiver's
/// bytes pass through the real serial driver. Every command is shown as you would type it.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Where recordings, map and results go; those of an earlier demo are replaced
    #[arg(long, default_value = "demo", value_name = "DIR")]
    pub out: PathBuf,
}

/// A drive of the demo.
struct Drive {
    name: &'static str,
    day_seed: u64,
    drive_seed: u64,
    lane_shift_m: f64,
    frame_rate_hz: f64,
}

const SURVEY: Drive = Drive { name: "monday", day_seed: 1, drive_seed: 1, lane_shift_m: 0.0, frame_rate_hz: 4.0 };
/// Other light and traffic, driven 0.4 m further right, with fewer frames.
const ANOTHER_DAY: Drive = Drive { name: "tuesday", day_seed: 2, drive_seed: 2, lane_shift_m: 0.4, frame_rate_hz: 1.0 };
/// Times as fast as real time: a drive of three minutes takes half a minute.
const SPEED: f64 = 6.0;

pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    let start = Instant::now();
    fs::create_dir_all(&args.out).with_context(|| format!("making the folder {}", args.out.display()))?;
    let map = args.out.join("town.map").display().to_string();
    let results = args.out.join("evaluation.json").display().to_string();
    let report = args.out.join("report").display().to_string();

    let survey = record(args, &SURVEY, "a survey drive: camera and receiver become pairs of frame and position")?;
    step("what is in the recording", &["info", &survey])?;
    step("the recording becomes a map", &["train", &survey, "--out", &map, "--force"])?;
    let other =
        record(args, &ANOTHER_DAY, "the same streets on another day: other light, other traffic, another lane")?;
    step(
        "every frame of that day, one by one, against the map: where was it? Errors against the receiver's positions, which \
         themselves err by 0.6 m on each axis",
        &with_report(&["evaluate", &other, "--map", &map, "--json", &results, "--force"], &report, &survey),
    )?;
    print(&format!(
        "\nWhat this shows: a drive is recorded and synchronized, a map is learned from it, and on another day each single\n\
         frame tells where it was taken, without GPS and without knowing where the vehicle was before. Filtered, as\n\
         `omniloc localize` does it on the vehicle, a position comes with a covariance and a heading, and only when it is sure.\n\n\
         recordings {survey}   omniloc info {survey}\n\
         \x20          {other}\n\
         map        {map}   omniloc info {map}\n\
         results    {results}\n\
         {}\
         {:.0} s\n",
        report_line(&report),
        start.elapsed().as_secs_f64()
    ))?;
    Ok(DONE.into())
}

/// The arguments, and those that ask for a report where the program has them.
fn with_report<'a>(arguments: &[&'a str], report: &'a str, survey: &'a str) -> Vec<&'a str> {
    // Words would take longer than all the rest.
    let more = ["--report", report, "--survey", survey, "--baselines", "nearest,aligned"];
    if cfg!(feature = "report") { [arguments, &more].concat() } else { arguments.to_vec() }
}

fn report_line(report: &str) -> String {
    match cfg!(feature = "report") {
        true => format!("report     {report}/index.html   open it in a browser\n"),
        false => String::new(),
    }
}

/// Drives once; returns the recording.
fn record(args: &Args, drive: &Drive, what: &str) -> anyhow::Result<String> {
    let folder = args.out.join(drive.name);
    for old in recordings(&folder).unwrap_or_default() {
        fs::remove_file(&old).with_context(|| format!("removing {}", old.display()))?;
    }
    let config = args.out.join(format!("{}.toml", drive.name));
    fs::write(&config, configuration(drive)).with_context(|| format!("writing {}", config.display()))?;
    // Frames that a busy computer is too slow to render are lost, as it says; the drive is good without them.
    step(what, &["record", "--config", &config.display().to_string()])?;
    let recording = recordings(&folder)?.into_iter().next();
    let recording = recording.with_context(|| format!("{}: nothing was recorded", folder.display()))?;
    Ok(recording.display().to_string())
}

fn recordings(folder: &Path) -> anyhow::Result<Vec<PathBuf>> {
    let entries = fs::read_dir(folder).with_context(|| format!("reading the folder {}", folder.display()))?;
    let paths = entries.map(|entry| entry.map(|entry| entry.path()));
    let mut paths = paths.collect::<Result<Vec<_>, _>>().with_context(|| format!("reading {}", folder.display()))?;
    paths.retain(|path| path.extension().is_some_and(|extension| extension == "mcap"));
    paths.sort();
    Ok(paths)
}

fn configuration(Drive { name, day_seed, drive_seed, lane_shift_m, frame_rate_hz }: &Drive) -> String {
    format!(
        "# Made by `omniloc demo`; config/simulated.toml explains the keys.\n\
         [vehicle]\nname = \"simulated car, {name}\"\n\n\
         [camera]\ndriver = \"simulated\"\n\n\
         [gnss]\ndriver = \"simulated\"\n\n\
         [recorder]\nfolder = \"{name}\"\nsegment_s = 3600\nsegment_mib = 4000\nmin_free_mib = 256\n\
         min_free_percent = 0.0\n\n\
         [simulation]\nplace = \"town\"\nday_seed = {day_seed}\ndrive_seed = {drive_seed}\nlane_shift_m = {lane_shift_m:.1}\n\
         speed = {SPEED:.1}\nframe_rate_hz = {frame_rate_hz:.1}\n"
    )
}

/// Says what is done, shows the command, and runs exactly what a user would type.
fn step(what: &str, arguments: &[&str]) -> anyhow::Result<()> {
    print(&format!("\n# {what}\n$ omniloc {}\n", arguments.join(" ")))?;
    let line = Cli::try_parse_from(std::iter::once("omniloc").chain(arguments.iter().copied()))?;
    line.command.run()?;
    Ok(())
}
