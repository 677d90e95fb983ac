//! `omniloc export`: out of a recording.

use std::{path::PathBuf, process::ExitCode};

use clap::ValueEnum;

use super::{
    BadArgument, DONE,
    options::{OutputKind, check_input, check_no_folder, check_not_input, check_output, parse_origin},
    print,
};
use crate::{
    recording::{ExportError, Format, Recording, export},
    types::Geodetic,
};

/// Write what is in a recording as a data set, table, track or images
#[derive(Debug, clap::Args)]
pub struct Args {
    /// The recording
    pub recording: PathBuf,
    /// What to write
    #[arg(long, value_name = "FORMAT")]
    pub to: To,
    /// The file or folder to write
    #[arg(long, value_name = "PATH")]
    pub out: PathBuf,
    /// Where east = north = 0 lies, if the recording does not say it or to override it
    #[arg(long, value_name = "LAT,LON[,ALT]", value_parser = parse_origin, allow_hyphen_values = true)]
    pub origin: Option<Geodetic>,
    /// Replace the output if it exists
    #[arg(long)]
    pub force: bool,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum To {
    /// The folder that `import` reads
    Dataset,
    /// One row a frame with everything known of it
    Csv,
    /// Points and track; needs an origin
    Geojson,
    /// Track; needs an origin
    Gpx,
    /// Points and track; needs an origin
    Kml,
    /// The JPEG files alone
    Images,
}

pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    check_input(&args.recording)?;
    check_no_folder(&args.recording)?;
    let (format, kind) = match args.to {
        To::Dataset => (Format::Dataset, OutputKind::Folder),
        To::Csv => (Format::Csv, OutputKind::File),
        To::Geojson => (Format::GeoJson, OutputKind::File),
        To::Gpx => (Format::Gpx, OutputKind::File),
        To::Kml => (Format::Kml, OutputKind::File),
        To::Images => (Format::Images, OutputKind::Folder),
    };
    check_output(&args.out, kind, args.force)?;
    check_not_input(&args.out, [&args.recording])?;
    let recording = Recording::open_any(&args.recording)?;
    let report = export(&recording, format, &args.out, args.origin).map_err(|error| match error {
        ExportError::NoOrigin { .. } => BadArgument(error.to_string()).into(),
        other => anyhow::Error::new(other),
    })?;
    if report.left_out > 0 {
        eprintln!("note: {} survey pairs are left out: marked invalid, or without an image", report.left_out);
    }
    if recording.images_without_pair > 0 {
        eprintln!("note: {} images are left out: no position is known for them", recording.images_without_pair);
    }
    print(&format!("{}: {} frames\n", args.out.display(), report.frames))?;
    Ok(DONE.into())
}
