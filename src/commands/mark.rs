//! `omniloc mark`: keeps what is being recorded from being deleted.

use std::{path::PathBuf, process::ExitCode};

use anyhow::Context;

use super::{BadArgument, DONE, print};
use crate::recording::recorder::request_mark;

/// Keep the segment being recorded, and the one before it, when the disk gets full
///
/// Works on a folder that `record` is writing to; the recorder marks the segments within a second. To release them,
/// remove the empty .keep files beside them.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Folder that is being recorded to
    pub folder: PathBuf,
}

pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    let folder = args.folder.display();
    if !args.folder.is_dir() {
        return Err(BadArgument(format!("{folder}: no such folder")).into());
    }
    if !request_mark(&args.folder).with_context(|| format!("asking the recorder in {folder}"))? {
        return Err(
            BadArgument(format!("{folder}: nothing is being recorded there; expected the recorder's folder")).into()
        );
    }
    print(&format!("{folder}: the present and the previous segment will be kept\n"))?;
    Ok(DONE.into())
}
