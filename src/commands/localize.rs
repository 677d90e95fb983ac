//! `omniloc localize`: where is the vehicle?

use std::{path::PathBuf, process::ExitCode};

use super::{BadArgument, DATA_LOST, DONE, journal, options::check_input, print};
use crate::{
    config::LocalizeConfig,
    localize::Stage,
    outputs::OutputError,
    runtime::localize::{LocalizeReport, LocalizeStatus, live},
    types::PositionEstimate,
};

/// Localize the vehicle by its camera, on a map
///
/// One estimate a frame goes to the outputs that the configuration names: JSON lines, NMEA 0183 for gpsd and chart
/// plotters. No position is said before it is sure, and none any more when frames contradict it. Runs until SIGTERM,
/// SIGHUP or SIGINT (Ctrl-C).
#[derive(Debug, clap::Args)]
pub struct Args {
    /// The configuration; `config/localize.toml` explains every key
    #[arg(long, value_name = "FILE")]
    pub config: PathBuf,
    /// Only check the configuration and print it with all defaults
    #[arg(long)]
    pub check: bool,
    /// At the end, print how long every step of a frame took
    #[arg(long)]
    pub timings: bool,
}

pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    let config = LocalizeConfig::load(&args.config).map_err(|error| BadArgument(super::chain(&error)))?;
    if args.check {
        print(&config.resolved())?;
    }
    let wrong = |what| BadArgument(format!("{}: {what}", args.config.display()));
    config.camera.check_driver().map_err(wrong)?;
    if args.check {
        return Ok(DONE.into());
    }
    check_input(&config.map.file).map_err(|BadArgument(what)| wrong(format!("map.file: {what}")))?;
    journal::start();
    let outcome = live::localize(&config, |status| journal::show_status(line(status)));
    journal::finish();
    match outcome {
        Err(error) if matches!(error.downcast_ref(), Some(OutputError::NoOrigin)) => {
            Err(wrong(error.to_string()).into())
        }
        outcome => finish(&outcome?, args.timings),
    }
}

/// Says what became of the drive, on stderr: stdout may be full of estimates. [`DATA_LOST`] if no frame came.
pub fn finish(report: &LocalizeReport, with_timings: bool) -> anyhow::Result<ExitCode> {
    eprint!("{}", summary(report));
    if with_timings {
        eprint!("{}", timings(&report.status));
    }
    let nothing_came = report.status.counts.frames == 0;
    let is_recorded = report.recorder.as_ref().is_none_or(|recorder| recorder.is_complete && recorder.health.lost == 0);
    Ok(if nothing_came || !is_recorded { DATA_LOST } else { DONE }.into())
}

/// The state on one line.
pub fn line(status: &LocalizeStatus) -> String {
    let counts = &status.counts;
    let place = status.last.as_ref().map_or("nothing seen yet".into(), place);
    format!(
        "camera {} {:.1}/s lost {} | {place} | localized {:.0} % | {:.1} ms a frame, {} passed over | cpu {:.0} % {:.0} MB",
        status.camera_health,
        status.frames_per_s,
        counts.lost,
        100.0 * counts.localized as f64 / counts.frames.max(1) as f64,
        status.timings.mean_frame().as_secs_f64() * 1e3,
        status.passed_over,
        100.0 * status.system.cpu_cores,
        status.system.resident_bytes as f64 * 1e-6,
    )
}

fn place(estimate: &PositionEstimate) -> String {
    let Some(pose) = &estimate.pose else { return estimate.state.name().into() };
    let [e_m, n_m] = pose.position_m;
    let std_m = (0.5 * (pose.covariance.ee_m2 + pose.covariance.nn_m2)).sqrt();
    let heading = pose.heading.map_or(String::new(), |heading| format!(", {:.0} deg", heading.yaw_rad.to_degrees()));
    format!("{} e {e_m:.1} n {n_m:.1} m +- {std_m:.1} m{heading}", estimate.state.name())
}

/// What became of the drive.
pub fn summary(report: &LocalizeReport) -> String {
    let status = &report.status;
    let counts = &status.counts;
    let mut text = format!(
        "localized      {} of {} frames, {} unusable, {} lost by the camera, {} passed over\n",
        counts.localized, counts.frames, counts.unusable, counts.lost, status.passed_over
    );
    for output in &report.outputs {
        text += &format!("output         {}: {} delivered, {} lost\n", output.name, output.delivered, output.lost);
    }
    text
}

/// Mean times of the steps, in milliseconds.
pub fn timings(status: &LocalizeStatus) -> String {
    let ms = |duration: std::time::Duration| duration.as_secs_f64() * 1e3;
    let mut text = String::from("step          mean\n");
    for stage in Stage::ALL {
        text += &format!("{:10} {:7.3} ms\n", stage.name(), ms(status.timings.mean(stage)));
    }
    text + &format!(
        "{:10} {:7.3} ms, at most {:.1} ms, {} frames\n",
        "frame",
        ms(status.timings.mean_frame()),
        ms(status.timings.longest()),
        status.timings.frames()
    )
}
