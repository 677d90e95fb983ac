//! Arguments in, exit code out; errors are printed here and nowhere else.

use std::process::ExitCode;

use clap::Parser;
use omniloc::commands::{BAD_ARGUMENTS, BadArgument, Cli, FAILED, printable};

fn main() -> ExitCode {
    match Cli::parse().command.run() {
        Ok(code) => code,
        Err(error) => {
            // Messages may have several lines; what they quote from a file must not steer the terminal.
            let lines: Vec<String> = format!("{error:#}").lines().map(printable).collect();
            eprintln!("error: {}", lines.join("\n"));
            if error.is::<BadArgument>() { BAD_ARGUMENTS.into() } else { FAILED.into() }
        }
    }
}
