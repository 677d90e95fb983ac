//! Arguments in, exit code out; errors are printed here and nowhere else.

use std::process::ExitCode;

use clap::Parser;
use omniloc::commands::{BAD_ARGUMENTS, BadArgument, Command, FAILED};

/// Tells a vehicle where it is from one omnidirectional camera
#[derive(Debug, Parser)]
#[command(version)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

fn main() -> ExitCode {
    match Cli::parse().command.run() {
        Ok(code) => code,
        Err(error) => {
            eprintln!("error: {error:#}");
            if error.is::<BadArgument>() { BAD_ARGUMENTS.into() } else { FAILED.into() }
        }
    }
}
