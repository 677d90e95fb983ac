//! The commands: one file each. Results go to stdout, diagnostics to stderr.

mod appearances;
pub mod calibrate;
pub mod check;
pub mod completions;
pub mod demo;
pub mod doctor;
pub mod evaluate;
mod evaluate_map;
pub mod export;
pub mod file_kind;
pub mod frame_source;
pub mod import;
pub mod info;
mod inputs;
pub mod journal;
pub mod localize;
pub mod man;
pub mod map_report;
pub mod mark;
pub mod options;
pub mod progress;
pub mod record;
pub mod recover;
pub mod replay;
#[cfg(feature = "report")]
mod report_folder;
#[cfg(feature = "report")]
mod reporter;
#[cfg(not(feature = "report"))]
#[path = "no_reporter.rs"]
mod reporter;
pub mod simulate;
pub mod survey;
pub mod train;

use std::{
    io::{self, Write},
    process::ExitCode,
};

use clap::{CommandFactory, Parser, Subcommand};

/// Done.
pub const DONE: u8 = 0;
/// The command could not do its work: what a file holds, be it a recording, a map or a CSV, is part of that.
pub const FAILED: u8 = 1;
/// Bad arguments or a bad configuration file.
pub const BAD_ARGUMENTS: u8 = 2;
/// Done, but data was lost.
pub const DATA_LOST: u8 = 3;

/// Tells a vehicle where it is from one omnidirectional camera
///
/// Your own data in three commands: omniloc import FOLDER --out drive.mcap; omniloc train drive.mcap --out area.map;
/// omniloc evaluate drive.mcap. Exit codes: 0 done, 1 failed, 2 bad arguments, 3 done but data was lost.
#[derive(Debug, Parser)]
#[command(name = "omniloc", version)]
pub struct Cli {
    #[command(subcommand)]
    pub command: Command,
}

#[derive(Debug, Subcommand)]
pub enum Command {
    Demo(demo::Args),
    Record(record::Args),
    Localize(localize::Args),
    Replay(replay::Args),
    Import(import::Args),
    Calibrate(calibrate::CalibrateArgs),
    Train(train::Args),
    Evaluate(evaluate::Args),
    Export(export::Args),
    Simulate(simulate::Args),
    Info(info::Args),
    Check(check::Args),
    Recover(recover::Args),
    Mark(mark::Args),
    Doctor(doctor::Args),
    Completions(completions::Args),
    Man(man::Args),
}

impl Command {
    pub fn run(&self) -> anyhow::Result<ExitCode> {
        match self {
            Self::Demo(args) => demo::run(args),
            Self::Record(args) => record::run(args),
            Self::Localize(args) => localize::run(args),
            Self::Replay(args) => replay::run(args),
            Self::Import(args) => import::run(args),
            Self::Calibrate(args) => calibrate::run(args),
            Self::Train(args) => train::run(args),
            Self::Evaluate(args) => evaluate::run(args),
            Self::Export(args) => export::run(args),
            Self::Simulate(args) => simulate::run(args),
            Self::Info(args) => info::run(args),
            Self::Check(args) => check::run(args),
            Self::Recover(args) => recover::run(args),
            Self::Mark(args) => mark::run(args),
            Self::Doctor(args) => doctor::run(args),
            Self::Completions(args) => completions::run(args, Cli::command()),
            Self::Man(args) => man::run(args, Cli::command()),
        }
    }
}

/// An error that is the caller's: it ends the program with [`BAD_ARGUMENTS`].
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct BadArgument(pub String);

/// Writes results to stdout. A reader that has seen enough (`omniloc info FILE | head`) is no error.
pub fn print(text: &str) -> io::Result<()> {
    let mut stdout = io::stdout().lock();
    match stdout.write_all(text.as_bytes()).and_then(|()| stdout.flush()) {
        Err(error) if error.kind() == io::ErrorKind::BrokenPipe => Ok(()),
        outcome => {
            outcome.map_err(|error| io::Error::new(error.kind(), format!("writing the results to stdout: {error}")))
        }
    }
}

/// An error with all that it came from, on one line.
pub fn chain(error: &dyn std::error::Error) -> String {
    let mut text = error.to_string();
    let mut cause = error.source();
    while let Some(error) = cause {
        text += &format!(": {error}");
        cause = error.source();
    }
    text
}

/// Text from a file must not steer the terminal.
pub fn printable(text: &str) -> String {
    text.chars().map(|character| if character.is_control() { '\u{FFFD}' } else { character }).collect()
}
