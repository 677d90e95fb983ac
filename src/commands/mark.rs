//! `omniloc mark`: keep what is being recorded.

use std::{fs, path::PathBuf, process::ExitCode};

use anyhow::Context;

use super::{BadArgument, DONE};
use crate::recording::recorder::MARK_REQUEST;

/// Keep what is being recorded from being deleted when the disk is full
///
/// The present segment and the one before it are marked within a second. The button and SIGUSR1 do the same.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// The folder that `record` writes to
    #[arg(value_name = "FOLDER")]
    pub folder: PathBuf,
}

pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    if !args.folder.is_dir() {
        return Err(BadArgument(format!("{}: no such folder", args.folder.display())).into());
    }
    let request = args.folder.join(MARK_REQUEST);
    fs::write(&request, "").with_context(|| format!("writing {}", request.display()))?;
    Ok(DONE.into())
}
