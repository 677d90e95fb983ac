//! `omniloc recover`: mends a recording that was cut off or damaged.

use std::{
    fmt::Write,
    path::{Path, PathBuf},
    process::ExitCode,
};

use anyhow::Context;
use serde_json::{Value, json};

use super::{
    BadArgument, DATA_LOST, DONE, FAILED,
    options::{OutputKind, check_input, check_not_input, check_output},
    print, printable,
};
use crate::recording::{
    recover::{Recovery, recover_file},
    verify,
};

/// Mend recordings that were cut off or damaged
///
/// Everything that is whole is copied into a new recording, which is then read back. The old file stays as it is. Exit
/// code 0: nothing was lost; 3: something was, and stdout says what; 1: a recording could not be mended.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Recordings
    #[arg(required = true, value_name = "REC")]
    pub recordings: Vec<PathBuf>,
    /// New recording; without it NAME.mcap.part becomes NAME.mcap, and NAME.mcap becomes NAME.recovered.mcap
    #[arg(long, value_name = "FILE")]
    pub out: Option<PathBuf>,
    /// Replace a new recording that exists
    #[arg(long)]
    pub force: bool,
    /// Print one JSON object
    #[arg(long)]
    pub json: bool,
}

/// What became of one recording.
enum Outcome {
    AlreadyWhole,
    Recovered { out: PathBuf, recovery: Recovery },
    Failed(anyhow::Error),
}

pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    if args.out.is_some() && args.recordings.len() > 1 {
        return Err(BadArgument("--out names one file, but there are several recordings".into()).into());
    }
    let mut outs = Vec::new();
    for recording in &args.recordings {
        check_input(recording)?;
        outs.push(args.out.clone().unwrap_or_else(|| default_out(recording)));
    }
    let mut exit = DONE;
    let mut reports = Vec::new();
    for (recording, out) in args.recordings.iter().zip(outs) {
        let outcome = mend(args, recording, out)?;
        exit = match (&outcome, exit) {
            (Outcome::Failed(_), _) | (_, FAILED) => FAILED,
            (Outcome::Recovered { recovery, .. }, _) if recovery.lost_something() => DATA_LOST,
            (_, exit) => exit,
        };
        if args.json {
            reports.push(as_json(recording, &outcome));
        } else {
            print(&as_text(recording, &outcome))?;
        }
    }
    if args.json {
        print(&format!("{:#}\n", json!({"recordings": reports})))?;
    }
    Ok(exit.into())
}

/// `Err` only for arguments that cannot be right; one hopeless recording must not keep the others from being mended.
fn mend(args: &Args, recording: &Path, out: PathBuf) -> anyhow::Result<Outcome> {
    if args.out.is_none() {
        match verify(recording).with_context(|| format!("reading {}", recording.display())) {
            Ok(verdict) if verdict.is_complete && verdict.is_sound() => return Ok(Outcome::AlreadyWhole),
            Ok(_) => {}
            Err(error) => return Ok(Outcome::Failed(error)),
        }
    }
    check_not_input(&out, [&recording.to_path_buf()])?;
    check_output(&out, OutputKind::File, args.force)?;
    Ok(match recover_file(recording, &out) {
        Ok(recovery) => Outcome::Recovered { out, recovery },
        Err(error) => Outcome::Failed(error.into()),
    })
}

fn default_out(recording: &Path) -> PathBuf {
    match recording.extension() {
        Some(extension) if extension == "part" => recording.with_extension(""),
        _ => recording.with_extension("recovered.mcap"),
    }
}

fn as_json(recording: &Path, outcome: &Outcome) -> Value {
    match outcome {
        Outcome::AlreadyWhole => json!({"file": recording, "outcome": "already whole"}),
        Outcome::Failed(error) => json!({"file": recording, "outcome": "failed", "error": format!("{error:#}")}),
        Outcome::Recovered { out, recovery } => json!({
            "file": recording, "outcome": "recovered", "out": out, "messages": recovery.messages,
            "topics": recovery.topics.iter().map(|(topic, facts)| (topic.clone(), facts.messages.into()))
                .collect::<serde_json::Map<_, _>>(),
            "times_ns": recovery.times_ns(), "reached_the_end": recovery.reached_the_end,
            "lost_something": recovery.lost_something(), "lost_bytes": recovery.lost_bytes,
            "zero_bytes": recovery.zero_bytes, "unreadable_bytes": recovery.unreadable_bytes,
            "lost_messages": recovery.lost_messages,
            "lost": recovery.spans.iter().map(|span| json!({
                "offset": span.offset, "bytes": span.bytes, "after_ns": span.after_ns, "before_ns": span.before_ns,
            })).collect::<Vec<_>>(),
        }),
    }
}

fn as_text(recording: &Path, outcome: &Outcome) -> String {
    let file = recording.display();
    let (out, recovery) = match outcome {
        Outcome::AlreadyWhole => return printable(&format!("{file}: already whole, nothing written")) + "\n",
        Outcome::Failed(error) => return printable(&format!("{file}: FAILED: {error:#}")) + "\n",
        Outcome::Recovered { out, recovery } => (out.display(), recovery),
    };
    let seconds = recovery.times_ns().map_or(0.0, |(first_ns, last_ns)| (last_ns - first_ns) as f64 * 1e-9);
    let mut lines = vec![format!("{file}: {} messages over {seconds:.1} s written to {out}", recovery.messages)];
    if recovery.unreadable_bytes > 0 {
        lines.push(format!("the disk could not read {} bytes", recovery.unreadable_bytes));
    }
    if !recovery.lost_something() {
        lines.push("nothing was lost".into());
    } else {
        let zeros = match recovery.zero_bytes {
            0 => String::new(),
            zeros => format!(", {zeros} of them zeros: room for data that never reached the disk"),
        };
        lines.push(format!("lost: {} bytes{zeros}", recovery.lost_bytes));
    }
    // Times count from the first message that was kept.
    let start_ns = recovery.times_ns().map_or(0, |(first_ns, _)| first_ns);
    let second = |ns: u64| (i128::from(ns) - i128::from(start_ns)) as f64 * 1e-9;
    for span in &recovery.spans {
        let mut line = format!("lost: {} bytes at byte {}", span.bytes, span.offset);
        if let Some(ns) = span.after_ns {
            let _ = write!(line, ", after {:.3} s", second(ns));
        }
        if let Some(ns) = span.before_ns {
            let _ = write!(line, ", before {:.3} s", second(ns));
        }
        lines.push(line);
    }
    lines.extend(recovery.lost_messages.iter().map(|(topic, count)| format!("lost: {count} messages on {topic}")));
    lines.iter().map(|line| printable(line) + "\n").collect()
}
