//! `omniloc check`: is a recording or map sound?

use std::{path::PathBuf, process::ExitCode};

use anyhow::Context;
use serde_json::json;

use super::{
    DONE, FAILED,
    evaluate_map::open_map,
    file_kind::{FileKind, file_kind},
    options::{check_input, check_no_folder},
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
    check_no_folder(&args.file)?;
    match file_kind(&args.file).with_context(|| format!("reading {}", args.file.display()))? {
        FileKind::Map => return check_map(args),
        FileKind::Recording => {}
    }
    let verdict = verify(&args.file)?;
    let sound = verdict.is_sound();
    print(&if args.json { as_json(args, &verdict) } else { as_text(args, &verdict) })?;
    Ok(if sound { DONE } else { FAILED }.into())
}

/// A map that loads is sound: checksum, shapes and values are checked then.
fn check_map(args: &Args) -> anyhow::Result<ExitCode> {
    let map = open_map(&args.file);
    let problems: Vec<String> = map.as_ref().err().map(|error| format!("{error:#}")).into_iter().collect();
    let sound = map.is_ok();
    let file = args.file.display();
    print(&if args.json {
        format!("{:#}\n", json!({"file": args.file, "kind": "map", "sound": sound, "problems": problems}))
    } else {
        match &map {
            Ok(map) => format!(
                "{file}: sound: {} groups, {} learning positions, {} cells\n",
                map.groups.len(),
                map.positions_m.len(),
                map.cells.len()
            ),
            Err(error) => format!("problem: {}\n{file}: NOT SOUND\n", printable(&format!("{error:#}"))),
        }
    })?;
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
