//! `omniloc doctor`: what is wrong, and what to do.

use std::{path::PathBuf, process::ExitCode};

use serde_json::json;

use super::{BadArgument, DONE, FAILED, chain, print, printable};
use crate::{
    config::{LocalizeConfig, RecordConfig},
    doctor::{Finding, Purpose, Verdict, examine},
};

/// Look at camera, receiver, disk and computer, and say what is wrong and what to do
///
/// Takes about half a minute. Exit code 1 when what the configuration asks for could not work; warnings are no failure.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// The configuration for `record` or `localize` whose devices are looked at
    #[arg(long, value_name = "FILE")]
    pub config: PathBuf,
    /// Print the findings as one JSON object
    #[arg(long)]
    pub json: bool,
}

pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    let purpose = load(args)?;
    let mut findings = Vec::new();
    let mut written = Ok(());
    examine(&purpose, |finding| {
        if !args.json && written.is_ok() {
            written = print(&as_text(&finding));
        }
        findings.push(finding);
    })?;
    written?;
    let worst = findings.iter().map(|finding| finding.verdict).max().unwrap_or(Verdict::Ok);
    let works = worst < Verdict::Problem;
    if args.json {
        let program = env!("CARGO_PKG_VERSION");
        print(&format!("{:#}\n", json!({"program": program, "works": works, "findings": findings})))?;
    } else {
        let count = |verdict| findings.iter().filter(|finding| finding.verdict == verdict).count();
        let (problems, warnings) = (count(Verdict::Problem), count(Verdict::Warning));
        let what = match purpose {
            Purpose::Record(_) => "record",
            Purpose::Localize(_) => "localize",
        };
        let can = if works { "this can" } else { "so this cannot" };
        print(&format!("{problems} problems, {warnings} warnings: {can} {what}\n"))?;
    }
    Ok(if works { DONE } else { FAILED }.into())
}

/// Only a localizing vehicle has these tables.
fn load(args: &Args) -> Result<Purpose, BadArgument> {
    let is_for_localizing = std::fs::read_to_string(&args.config)
        .ok()
        .and_then(|text| text.parse::<toml::Table>().ok())
        .is_some_and(|tables| ["map", "motion", "outputs"].iter().any(|name| tables.contains_key(*name)));
    let purpose = match is_for_localizing {
        true => LocalizeConfig::load(&args.config).map(|config| Purpose::Localize(Box::new(config))),
        false => RecordConfig::load(&args.config).map(|config| Purpose::Record(Box::new(config))),
    };
    purpose.map_err(|error| BadArgument(chain(&error)))
}

fn as_text(finding: &Finding) -> String {
    let mark = match finding.verdict {
        Verdict::Ok => "ok      ",
        Verdict::Warning => "warning ",
        Verdict::Problem => "PROBLEM ",
    };
    let mut text = format!("{mark} {:<12} {}\n", finding.check, printable(&finding.found));
    if !finding.advice.is_empty() {
        text += &format!("{:21} -> {}\n", "", printable(&finding.advice));
    }
    text
}
