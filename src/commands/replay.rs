//! `omniloc replay`: a recorded drive through the same tasks again.

use std::{
    fs::File,
    io::{BufWriter, Write},
    path::{Path, PathBuf},
    process::ExitCode,
};

use anyhow::Context;

use super::{
    BadArgument, DONE, chain, journal, localize,
    options::{OutputKind, check_input, check_no_folder, check_not_input, check_output},
    print, record,
};
use crate::{
    config::{LocalizeConfig, RecordConfig},
    outputs::{TimedEstimate, json_lines},
    recording::{
        DeviceRecords, Recording, RecordingError,
        recorder::{self, Encoder, Entry, Segment},
        topics, write_file_atomically,
    },
    runtime::{
        drive::{self, replay_head},
        localize::{LocalizeReport, LocalizeStatus, Session, live, playback as playback_localize},
        playback,
        survey::{Sink, Survey},
    },
    sync::CameraTurns,
    types::{LocalFrame, PositionEstimate},
};

/// Feed a recording to the tasks of a drive, as if the devices said everything again
///
/// With `--mode record` positions and pairs are made anew from the bytes of the receiver, with the settings of now: a
/// better decoder, another latency. With `--mode localize` the frames are localized on a map; estimates go to stdout as
/// JSON lines, and with `--out` into a recording. `--speed max` needs no clock and gives the same bytes every time; a
/// number plays through the real drivers, the receiver's bytes through a pseudo-terminal.
#[derive(Debug, clap::Args)]
pub struct Args {
    #[arg(value_name = "REC.mcap")]
    pub recording: PathBuf,
    /// What the tasks are to do
    #[arg(long, value_enum)]
    pub mode: Mode,
    /// The map to localize on
    #[arg(long, value_name = "AREA.map", required_if_eq("mode", "localize"))]
    pub map: Option<PathBuf>,
    /// The recording that is made: a file, or with `--speed N` a folder of segments
    #[arg(long, value_name = "OUT", required_if_eq("mode", "record"))]
    pub out: Option<PathBuf>,
    /// Times as fast as it was recorded, or `max`
    #[arg(long, default_value = "max", value_parser = parse_speed)]
    pub speed: Speed,
    /// Settings: of a file for `record`, `[gnss]` and `[sync]`; of one for `localize`, `[motion]` and `[outputs]`; everything
    /// else in it is left aside
    #[arg(long, value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// At the end, print how long every step of a frame took
    #[arg(long)]
    pub timings: bool,
    /// Replace the output if it exists
    #[arg(long)]
    pub force: bool,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum Mode {
    /// Make the recording anew
    Record,
    /// Say where the vehicle was
    Localize,
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
    if let Some(out) = &args.out {
        check_not_input(out, [&args.recording].into_iter().chain(&args.map))?;
        match args.speed {
            Speed::Max => check_output(out, OutputKind::File, args.force)?,
            // Segments of two drives in one folder are mixed up for good.
            Speed::Times(_) => check_output(out, OutputKind::Folder, false)?,
        }
    }
    match args.mode {
        Mode::Record => record_again(args),
        Mode::Localize => localize(args),
    }
}

fn record_again(args: &Args) -> anyhow::Result<ExitCode> {
    if args.map.is_some() || args.timings {
        return Err(BadArgument("--map and --timings go with --mode localize".into()).into());
    }
    let out = args.out.as_deref().context("--out is required")?;
    let given = args.config.as_deref().map(RecordConfig::load).transpose();
    let given = given.map_err(|error| BadArgument(chain(&error)))?;
    journal::start();
    let recording = Recording::open_any(&args.recording)?;
    let config = RecordConfig::for_replay(&args.recording, &recording.name, out, given.as_ref());
    match args.speed {
        Speed::Max => as_fast_as_it_goes(args, out, &recording, &config),
        Speed::Times(times) => {
            let config = RecordConfig { replay_speed: times, ..config };
            let outcome = drive::record(&config, |status| journal::show_status(record::line(status)));
            journal::finish();
            record::finish(&outcome?)
        }
    }
}

fn localize(args: &Args) -> anyhow::Result<ExitCode> {
    let map = args.map.as_deref().context("--map is required")?;
    check_input(map)?;
    let given = args.config.as_deref().map(LocalizeConfig::load).transpose();
    let given = given.map_err(|error| BadArgument(chain(&error)))?;
    let recording = Recording::open_any(&args.recording)?;
    let config = LocalizeConfig::for_replay(&args.recording, &recording.name, map, given.as_ref());
    journal::start();
    match args.speed {
        Speed::Max => localize_as_fast_as_it_goes(args, &recording, &config),
        Speed::Times(times) => {
            let recorder = args.out.as_deref().map(recorder::Settings::new);
            let config = LocalizeConfig { replay_speed: times, recorder, ..config };
            let outcome = live::localize(&config, |status| journal::show_status(localize::line(status)));
            journal::finish();
            localize::finish(&outcome?, args.timings)
        }
    }
}

fn localize_as_fast_as_it_goes(
    args: &Args,
    recording: &Recording,
    config: &LocalizeConfig,
) -> anyhow::Result<ExitCode> {
    let map = live::open_map(&config.map.file)?;
    let map_frame = map.info.origin.map(LocalFrame::new);
    let log_offset_ns = drive::log_offset_ns(recording);
    let mut session = live::start_session(map, config)?;
    let mut stdout = BufWriter::new(std::io::stdout().lock());
    let mut line = Vec::new();
    let mut each = |estimate: &PositionEstimate| {
        let utc_ns = i64::try_from(estimate.stamp_ns + log_offset_ns).ok().filter(|_| log_offset_ns > 0);
        line.clear();
        json_lines::write_line(&TimedEstimate { estimate: *estimate, utc_ns }, map_frame.as_ref(), &mut line);
        stdout.write_all(&line)
    };
    let has_gone = |error: &std::io::Error| error.kind() == std::io::ErrorKind::BrokenPipe;
    let play = |session: &mut Session, each: &mut dyn FnMut(&PositionEstimate) -> std::io::Result<()>| {
        let records = DeviceRecords::open(&args.recording)?;
        playback_localize::play(records, session, each)
            .with_context(|| format!("replaying {}", args.recording.display()))
    };
    match &args.out {
        None => match play(&mut session, &mut each) {
            // Whoever reads has seen enough.
            Err(error) if error.chain().any(|cause| cause.downcast_ref().is_some_and(has_gone)) => {}
            outcome => outcome?,
        },
        Some(out) => {
            let head = drive::localize_head(recording, config);
            let first_ns = drive::first_clocks(&args.recording)?.monotonic_ns;
            let encoder = Encoder::new(log_offset_ns);
            write_file_atomically(out, |file| {
                let failed = |error| RecordingError::cannot_write(out, error);
                let segment = Segment::start(file, &head, first_ns).map_err(failed)?;
                let mut to_file = ToFile { segment, entries: 0, error: None };
                play(&mut session, &mut |estimate| {
                    let (message, pose) = encoder.estimate(estimate);
                    to_file.push(message);
                    pose.into_iter().for_each(|pose| _ = to_file.push(pose));
                    each(estimate).or_else(|error| if has_gone(&error) { Ok(()) } else { Err(error) })
                })?;
                if let Some(error) = to_file.error {
                    return Err(failed(error).into());
                }
                to_file.segment.finish().map_err(failed)?;
                Ok::<(), anyhow::Error>(())
            })?;
        }
    }
    match stdout.flush() {
        Err(error) if !has_gone(&error) => return Err(error.into()),
        _ => {}
    }
    let status = LocalizeStatus {
        counts: session.counts(),
        last: session.last().copied(),
        timings: *session.timings(),
        ..LocalizeStatus::default()
    };
    localize::finish(&LocalizeReport { status, outputs: Vec::new(), recorder: None }, args.timings)
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

fn as_fast_as_it_goes(
    args: &Args,
    out_path: &Path,
    recording: &Recording,
    config: &RecordConfig,
) -> anyhow::Result<ExitCode> {
    let head = replay_head(recording, config)?;
    let log_offset_ns = head.log_offset_ns;
    let clocks_recorded = recording.topics.contains_key(topics::CLOCK.name);
    let turns = recording.calibration().ok().map(CameraTurns::new);
    let mut survey = Survey::new(&config.decoder, &config.sync, log_offset_ns).map_err(anyhow::Error::msg)?;
    let mut entries = 0;
    write_file_atomically(out_path, |file| {
        let failed = |error| RecordingError::cannot_write(out_path, error);
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
        out_path.display()
    ))?;
    Ok(DONE.into())
}
