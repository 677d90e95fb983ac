//! `omniloc import`: a data-set folder becomes a recording.

use std::{path::PathBuf, process::ExitCode};

use super::{
    BadArgument, DONE,
    options::{OutputKind, check_input, check_output, parse_origin},
    print, printable,
};
use crate::{
    recording::{CalibrationSource, ImportSettings, import},
    types::{Geodetic, counted},
};

/// Turn a folder of images and positions into a recording
///
/// The folder holds images/, positions.csv with the header index,file,x_m,y_m,yaw_rad,time_s (yaw and time may be empty)
/// and donut.json, the calibration.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Folder with images/, positions.csv and donut.json
    pub dataset: PathBuf,
    /// The recording to write
    #[arg(long, value_name = "REC.mcap")]
    pub out: PathBuf,
    /// Where x = y = 0 lies, in degrees and metres above the ellipsoid; then WGS84 positions are written too
    #[arg(long, value_name = "LAT,LON[,ALT]", value_parser = parse_origin, allow_hyphen_values = true)]
    pub origin: Option<Geodetic>,
    /// Calibration to use instead of the folder's donut.json
    #[arg(long, value_name = "FILE", conflicts_with = "without_calibration")]
    pub calibration: Option<PathBuf>,
    /// Import without a calibration, to calibrate on the recording
    #[arg(long)]
    pub without_calibration: bool,
    /// Replace the output if it exists
    #[arg(long)]
    pub force: bool,
}

pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    args.calibration.as_deref().map_or(Ok(()), check_input)?;
    check_output(&args.out, OutputKind::File, args.force)?;
    let calibration = match (&args.calibration, args.without_calibration) {
        (Some(file), _) => CalibrationSource::File(file.clone()),
        (None, true) => CalibrationSource::None,
        (None, false) => CalibrationSource::Dataset,
    };
    let settings = ImportSettings { dataset: args.dataset.clone(), calibration, origin: args.origin };
    let report = import(&settings, &args.out).map_err(|error| {
        if error.is_bad_argument() { BadArgument(error.to_string()).into() } else { anyhow::Error::new(error) }
    })?;
    for warning in &report.warnings {
        eprintln!("warning: {warning}");
    }
    if report.completed_frames > 0 {
        let frames = counted(report.completed_frames, "frame");
        eprintln!("note: {frames} came without Huffman tables; the standard ones were added");
    }
    let (width_px, height_px) = report.image_size_px;
    print(&format!(
        "{}: {} of {width_px} x {height_px} px from {}\n",
        args.out.display(),
        counted(report.frames, "frame"),
        printable(&report.name)
    ))?;
    Ok(DONE.into())
}
