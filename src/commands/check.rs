//! `omniloc check`: is a recording or map sound?

use std::{path::PathBuf, process::ExitCode};

use anyhow::Context;
use serde_json::json;

use super::{
    DONE, FAILED,
    file_kind::{FileKind, file_kind},
    options::check_input,
    print, printable,
};
use crate::recording::{Verdict, verify};

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
    check_input(&args.file)?;
    match file_kind(&args.file).with_context(|| format!("reading {}", args.file.display()))? {
        FileKind::Map => anyhow::bail!("{}: maps are not supported yet", args.file.display()),
        FileKind::Recording => {}
    }
    let verdict = verify(&args.file)?;
    let sound = verdict.is_sound();
    print(&if args.json { as_json(args, &verdict) } else { as_text(args, &verdict) })?;
    Ok(if sound { DONE } else { FAILED }.into())
}

fn as_json(args: &Args, verdict: &Verdict) -> String {
    let report = json!({
        "file": args.file, "kind": "recording", "sound": verdict.is_sound(), "problems": verdict.problems,
        "unlisted_problems": verdict.unlisted_problems, "notes": verdict.notes, "chunks": verdict.chunks,
        "messages": verdict.messages, "images": verdict.images, "pairs": verdict.pairs,
    });
    format!("{report:#}\n")
}

fn as_text(args: &Args, verdict: &Verdict) -> String {
    let mut lines: Vec<String> = verdict.problems.iter().map(|problem| format!("problem: {problem}")).collect();
    if verdict.unlisted_problems > 0 {
        lines.push(format!("problem: and {} more", verdict.unlisted_problems));
    }
    lines.extend(verdict.notes.iter().map(|note| format!("note: {note}")));
    lines.push(format!(
        "{}: {}: {} chunks, {} messages, {} images, {} pairs",
        args.file.display(),
        if verdict.is_sound() { "sound" } else { "NOT SOUND" },
        verdict.chunks,
        verdict.messages,
        verdict.images,
        verdict.pairs
    ));
    lines.iter().map(|line| printable(line) + "\n").collect()
}
