//! `omniloc demo`: the whole way on a sample, without any hardware.

use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Instant;

use anyhow::Context;
use clap::Parser;

use super::{BadArgument, Cli, DONE, print};

/// Import, train and evaluate on a small sample of real photographs
///
/// The sample is 75 photographs of a courtyard, about 10 m apart, with phone GPS. It shows that the whole way works on
/// real pixels, not how accurate the method can be.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Where recording, map and results go
    #[arg(long, default_value = "demo", value_name = "DIR")]
    pub out: PathBuf,
    /// Folder of the sample [default: samples/courtyard-75 here, beside the program, or in the source tree]
    #[arg(long, value_name = "DIR")]
    pub sample: Option<PathBuf>,
}

/// Name of the sample's folder.
const SAMPLE: &str = "samples/courtyard-75";

pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    let start = Instant::now();
    let sample = find_sample(args.sample.as_deref())?;
    std::fs::create_dir_all(&args.out).with_context(|| format!("making the folder {}", args.out.display()))?;
    let out = |name: &str| args.out.join(name).display().to_string();
    let (recording, map, results) = (out("courtyard-75.mcap"), out("courtyard-75.map"), out("evaluation.json"));
    let sample = sample.display().to_string();

    step(
        "75 photographs and their positions become one recording",
        &["import", &sample, "--out", &recording, "--force"],
    )?;
    step("the recording becomes a map", &["train", &recording, "--out", &map, "--force"])?;
    step(
        "how well would it localize? The paper's protocol: learn from half of the frames, choose on a quarter, test on the rest",
        &[
            "evaluate",
            &recording,
            "--split",
            "random",
            "--variants",
            "plain",
            "--seeds",
            "2",
            "--json",
            &results,
            "--force",
        ],
    )?;
    print(&format!(
        "\nWhat this shows: real photographs go all the way to positions. With neighbours about 10 m apart and phone GPS of\n\
         3 to 10 m there is little to interpolate between, and errors stay near those of always answering the median\n\
         position (skill 0): the place is surveyed too sparsely for any recipe. A drive with a frame a metre localizes to\n\
         about a metre; see the README.\n\n\
         recording {recording}   omniloc info {recording}\n\
         map       {map}   omniloc info {map}\n\
         results   {results}\n\
         {:.0} s\n",
        start.elapsed().as_secs_f64()
    ))?;
    Ok(DONE.into())
}

/// Says what is done, shows the command, and runs exactly what a user would type.
fn step(what: &str, arguments: &[&str]) -> anyhow::Result<()> {
    print(&format!("\n# {what}\n$ omniloc {}\n", arguments.join(" ")))?;
    let line = Cli::try_parse_from(std::iter::once("omniloc").chain(arguments.iter().copied()))?;
    line.command.run()?;
    Ok(())
}

fn find_sample(given: Option<&Path>) -> anyhow::Result<PathBuf> {
    if let Some(folder) = given {
        return Ok(folder.to_owned());
    }
    let beside_program = std::env::current_exe().ok().and_then(|exe| {
        let prefix = exe.parent()?.parent()?;
        Some(prefix.join("share/omniloc").join(SAMPLE))
    });
    let places =
        [Some(PathBuf::from(SAMPLE)), beside_program, Some(Path::new(env!("CARGO_MANIFEST_DIR")).join(SAMPLE))];
    let found = places.into_iter().flatten().find(|folder| folder.join("positions.csv").is_file());
    found.ok_or_else(|| BadArgument(format!("no {SAMPLE} found; name its folder with --sample")).into())
}
