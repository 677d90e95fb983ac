//! `omniloc check`: is a recording or map sound?

use std::{path::PathBuf, process::ExitCode};

use anyhow::Context;
use serde_json::json;

use super::{
    DONE, FAILED,
    file_kind::{FileKind, file_kind},
};
use crate::recording::verify;

/// Check every byte of a recording or map
///
/// Exit code 0: sound; 1: not, and stdout says what is wrong.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Recording or map
    pub file: PathBuf,
    /// Print one JSON object
    #[arg(long)]
    pub json: bool,
}

pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    match file_kind(&args.file).with_context(|| format!("reading {}", args.file.display()))? {
        FileKind::Map => anyhow::bail!("{}: maps are not supported yet", args.file.display()),
        FileKind::Recording => {}
    }
    let verdict = verify(&args.file)?;
    let sound = verdict.is_sound();
    if args.json {
        let report = json!({
            "file": args.file, "kind": "recording", "sound": sound, "problems": verdict.problems,
            "unlisted_problems": verdict.unlisted_problems, "notes": verdict.notes, "chunks": verdict.chunks,
            "messages": verdict.messages, "images": verdict.images, "pairs": verdict.pairs,
        });
        println!("{report:#}");
    } else {
        for problem in &verdict.problems {
            println!("problem: {problem}");
        }
        if verdict.unlisted_problems > 0 {
            println!("problem: and {} more", verdict.unlisted_problems);
        }
        for note in &verdict.notes {
            println!("note: {note}");
        }
        println!(
            "{}: {}: {} chunks, {} messages, {} images, {} pairs",
            args.file.display(),
            if sound { "sound" } else { "NOT SOUND" },
            verdict.chunks,
            verdict.messages,
            verdict.images,
            verdict.pairs
        );
    }
    Ok(if sound { DONE } else { FAILED }.into())
}
