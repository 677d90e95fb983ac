//! `omniloc replay`: a recorded drive through the same tasks again.

use std::{fs::File, io::BufWriter, path::PathBuf, process::ExitCode};

use anyhow::Context;

use super::{
    BadArgument, DONE, journal,
    options::{OutputKind, check_input, check_no_folder, check_not_input, check_output},
    print, record,
};
use crate::{
    config::RecordConfig,
    recording::{
        DeviceRecords, Recording, RecordingError,
        recorder::{Entry, Segment},
        topics, write_file_atomically,
    },
    runtime::{
        drive::{self, replay_head},
        playback,
        survey::{Sink, Survey},
    },
    sync::CameraTurns,
};

/// Feed a recording to the tasks that made it, as if the devices said everything again
///
/// Positions and pairs are made anew from the bytes of the receiver, with the settings of now: a better decoder, another
/// latency. `--speed max` needs no clock and gives the same bytes every time; a number plays through the real drivers,
/// the receiver's bytes through a pseudo-terminal.
#[derive(Debug, clap::Args)]
pub struct Args {
    #[arg(value_name = "REC.mcap")]
    pub recording: PathBuf,
    /// What the tasks are to do
    #[arg(long, value_enum)]
    pub mode: Mode,
    /// The recording that is made: a file, or with `--speed N` a folder of segments
    #[arg(long, value_name = "OUT")]
    pub out: PathBuf,
    /// Times as fast as it was recorded, or `max`
    #[arg(long, default_value = "max", value_parser = parse_speed)]
    pub speed: Speed,
    /// Settings for `[gnss]` and `[sync]`; everything else in the file is left aside
    #[arg(long, value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// Replace the output if it exists
    #[arg(long)]
    pub force: bool,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum Mode {
    /// Make the recording anew
    Record,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Speed {
    Max,
    Times(f64),
}

fn parse_speed(text: &str) -> Result<Speed, String> {
    match text.parse() {
        _ if text == "max" => Ok(Speed::Max),
        Ok(times) if (0.01..=1000.0).contains(&times) => Ok(Speed::Times(times)),
        _ => Err("expected `max` or a number from 0.01 to 1000".into()),
    }
}

pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    check_input(&args.recording)?;
    check_no_folder(&args.recording)?;
    check_not_input(&args.out, std::slice::from_ref(&args.recording))?;
    match args.speed {
        Speed::Max => check_output(&args.out, OutputKind::File, args.force)?,
        // Segments of two drives in one folder are mixed up for good.
        Speed::Times(_) => check_output(&args.out, OutputKind::Folder, false)?,
    }
    let given = args.config.as_deref().map(RecordConfig::load).transpose();
    let given = given.map_err(|error| BadArgument(error.to_string()))?;
    journal::start();
    let recording = Recording::open_any(&args.recording)?;
    let config = RecordConfig::for_replay(&args.recording, &recording.name, &args.out, given.as_ref());
    match args.speed {
        Speed::Max => as_fast_as_it_goes(args, &recording, &config),
        Speed::Times(times) => {
            let config = RecordConfig { replay_speed: times, ..config };
            let outcome = drive::record(&config, |status| journal::show_status(&record::line(status)));
            journal::finish();
            record::finish(&outcome?)
        }
    }
}

/// Entries become one file at once.
struct ToFile<'a> {
    segment: Segment<&'a mut BufWriter<File>>,
    entries: u64,
    error: Option<mcap::McapError>,
}

impl Sink for ToFile<'_> {
    fn push(&mut self, entry: Entry) -> bool {
        if self.error.is_none() {
            self.entries += 1;
            self.error = self.segment.write(&entry).err();
        }
        true
    }

    /// A replay deletes nothing, so that nothing needs to be kept.
    fn mark(&mut self) {}
}

fn as_fast_as_it_goes(args: &Args, recording: &Recording, config: &RecordConfig) -> anyhow::Result<ExitCode> {
    let head = replay_head(recording, config)?;
    let log_offset_ns = head.log_offset_ns;
    let clocks_recorded = recording.topics.contains_key(topics::CLOCK.name);
    let turns = recording.calibration().ok().map(CameraTurns::new);
    let mut survey = Survey::new(&config.decoder, &config.sync, log_offset_ns).map_err(anyhow::Error::msg)?;
    let mut entries = 0;
    write_file_atomically(&args.out, |file| {
        let failed = |error| RecordingError::cannot_write(&args.out, error);
        let first_ns = drive::first_clocks(&args.recording)?.monotonic_ns;
        let segment = Segment::start(file, &head, first_ns).map_err(failed)?;
        let mut out = ToFile { segment, entries: 0, error: None };
        let records = DeviceRecords::open(&args.recording)?;
        playback::play(records, &mut survey, turns, clocks_recorded, log_offset_ns, &mut out)?;
        if let Some(error) = out.error {
            return Err(failed(error).into());
        }
        entries = out.entries;
        out.segment.finish().map_err(failed)?;
        Ok::<(), anyhow::Error>(())
    })
    .with_context(|| format!("replaying {}", args.recording.display()))?;
    let status = survey.status();
    print(&format!(
        "replayed       {} frames, {} pairs, {} of them unusable\nwritten        {entries} messages to {}\n",
        status.frames,
        status.pairs + status.pairs_invalid,
        status.pairs_invalid,
        args.out.display()
    ))?;
    Ok(DONE.into())
}
