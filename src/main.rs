//! Arguments in, exit code out; errors are printed here and nowhere else.

use std::process::ExitCode;

use clap::Parser;
use omniloc::commands::{BAD_ARGUMENTS, BadArgument, Cli, FAILED};

fn main() -> ExitCode {
    match Cli::parse().command.run() {
        Ok(code) => code,
        Err(error) => {
            eprintln!("error: {error:#}");
            if error.is::<BadArgument>() { BAD_ARGUMENTS.into() } else { FAILED.into() }
        }
    }
}
