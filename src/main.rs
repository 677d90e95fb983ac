//! Arguments in, exit code out; errors are printed here and nowhere else.

use std::process::ExitCode;

use clap::Parser;
use omniloc::commands::calibrate::{self, CalibrateArgs};

/// Tells a vehicle where it is from one omnidirectional camera
#[derive(Debug, Parser)]
#[command(version)]
enum Cli {
    Calibrate(CalibrateArgs),
}

fn main() -> ExitCode {
    let outcome = match Cli::parse() {
        Cli::Calibrate(args) => calibrate::run(&args),
    };
    outcome.unwrap_or_else(|error| {
        eprintln!("omniloc: {error:#}");
        ExitCode::FAILURE
    })
}
