//! `omniloc record`: a survey drive.

use std::{path::PathBuf, process::ExitCode};

use super::{BadArgument, DATA_LOST, DONE, chain, journal, print};
use crate::{
    config::RecordConfig,
    recording::proto::omniloc::Status,
    runtime::drive::{self, DriveReport},
};

/// Record a survey drive: camera and receiver become synchronized pairs
///
/// Runs until SIGTERM, SIGHUP or SIGINT (Ctrl-C), which end it cleanly within 20 s, or until the power is cut, which costs at
/// most the last second. What an earlier power cut left behind is mended at the start. SIGUSR1, the button or `omniloc
/// mark` keep what is being recorded from being deleted when the disk is full.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// The configuration; `config/record.toml` explains every key
    #[arg(long, value_name = "FILE")]
    pub config: PathBuf,
    /// Only check the configuration and print it with all defaults
    #[arg(long)]
    pub check: bool,
}

pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    let config = RecordConfig::load(&args.config).map_err(|error| BadArgument(chain(&error)))?;
    if args.check {
        print(&config.resolved())?;
    }
    let wrong = |what| BadArgument(format!("{}: {what}", args.config.display()));
    config.camera.check_driver().map_err(wrong)?;
    if args.check {
        return Ok(DONE.into());
    }
    if let Some(calibration) = &config.vehicle.calibration {
        drive::read_calibration(calibration).map_err(|error| wrong(format!("vehicle.calibration: {error:#}")))?;
    }
    journal::start();
    let outcome = drive::record(&config, |status| journal::show_status(line(status)));
    journal::finish();
    finish(&outcome?)
}

/// Says what was recorded; [`DATA_LOST`] if something was lost.
pub fn finish(report: &DriveReport) -> anyhow::Result<ExitCode> {
    print(&summary(report))?;
    Ok(if report.is_lossless() { DONE } else { DATA_LOST }.into())
}

/// The state on one line.
pub fn line(status: &Status) -> String {
    let latency = status.serial_latency_s.map_or(String::new(), |s| format!(" -{:.0} ms", s * 1e3));
    format!(
        "camera {} {:.1}/s lost {} | gnss {} {:.0}/s{latency} | pairs {} (+{} unusable) | disk {} {:.1} GB free, {:.0} MB \
         written, queue {:.0} % | cpu {:.0} % {:.0} MB",
        status.camera_health,
        status.camera_fps,
        status.frames_dropped,
        status.gnss_health,
        status.fix_hz,
        status.pairs,
        status.pairs_invalid,
        status.disk_health,
        status.disk_free_bytes as f64 * 1e-9,
        status.written_bytes as f64 * 1e-6,
        100.0 * status.queue_bytes as f64 / (status.queue_capacity_bytes.max(1)) as f64,
        100.0 * status.cpu_cores,
        status.resident_bytes as f64 * 1e-6,
    )
}

fn summary(DriveReport { status, recorder, folder, .. }: &DriveReport) -> String {
    let mut text = format!(
        "recorded       {} frames, {} pairs, {} of them unusable, {:.1} MB in {}\n",
        status.frames,
        status.pairs + status.pairs_invalid,
        status.pairs_invalid,
        recorder.health.written_bytes as f64 * 1e-6,
        folder.display(),
    );
    text += &format!("lost           {} frames, {} messages\n", status.frames_dropped, recorder.health.lost);
    if !recorder.is_complete {
        text += "warning        the disk did not take everything, or lost it; the next start mends what it finds\n";
    }
    text
}
