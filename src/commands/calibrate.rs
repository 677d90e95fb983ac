//! `omniloc calibrate`: finds the donut, writes `donut.json` and a picture to judge it by.

use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::{Context, bail};
use serde_json::json;

use super::options::{OutputKind, check_not_input, check_output};
use super::{BadArgument, frame_source, print};
use crate::calibrate::{DonutEstimate, DonutFinder, FindDonutError, Orientation, Verdict, overlay};
use crate::recording::write_bytes_atomically;
use crate::types::{AzimuthSense, DonutCalibration, LumaImage};

/// Find the donut in camera images: centre and radii
///
/// Direction, start angle, which rim is up and the azimuth sense cannot be seen in the picture: they are taken from the
/// existing calibration of the recording or data set, else from the defaults of the options below.
#[derive(Debug, clap::Args)]
pub struct CalibrateArgs {
    /// Recordings (.mcap), a data-set folder, or image files
    #[arg(required = true)]
    input: Vec<PathBuf>,
    /// Where the calibration goes
    #[arg(long, default_value = "donut.json")]
    out: PathBuf,
    /// Where the picture with the circles goes
    #[arg(long, default_value = "donut.png")]
    overlay: PathBuf,
    /// Frames to look at, spread evenly over the input
    #[arg(long, default_value_t = 30, value_parser = clap::value_parser!(u32).range(1..))]
    frames: u32,
    /// Direction of column 0 from the image's +x axis [rad; default: as before, else 0]
    #[arg(long, value_name = "RAD", allow_negative_numbers = true)]
    start_angle: Option<f64>,
    /// Columns run clockwise on the screen [default: as before, else true]
    #[arg(long, value_name = "BOOL")]
    clockwise: Option<bool>,
    /// Row 0 of the panorama is the outer rim [default: as before, else true]
    #[arg(long, value_name = "BOOL")]
    top_is_outer: Option<bool>,
    /// World azimuth grows (ccw) or falls (cw) with the column [default: as before, else ccw]
    #[arg(long, value_parser = parse_azimuth, value_name = "ccw|cw")]
    azimuth: Option<AzimuthSense>,
    /// Write the files even when the result is doubtful
    #[arg(long)]
    accept_doubtful: bool,
    /// Replace existing files
    #[arg(long)]
    force: bool,
    /// Print one JSON object instead of text
    #[arg(long)]
    json: bool,
}

fn parse_azimuth(text: &str) -> Result<AzimuthSense, String> {
    match text {
        "ccw" => Ok(AzimuthSense::Ccw),
        "cw" => Ok(AzimuthSense::Cw),
        other => Err(format!("{other} is neither ccw nor cw")),
    }
}

/// What one run found out.
struct Outcome {
    estimate: DonutEstimate,
    calibration: DonutCalibration,
    existing: Option<DonutCalibration>,
    unreadable: Vec<String>,
    written: Vec<PathBuf>,
    cut_rim_px: Option<f64>,
}

/// Exit code 0 when the donut is found and written, 1 when not: then no file is written.
///
/// # Errors
/// No donut, unreadable input, or files that exist or cannot be written.
pub fn run(args: &CalibrateArgs) -> anyhow::Result<ExitCode> {
    for path in [&args.out, &args.overlay] {
        check_output(path, OutputKind::File, args.force)?;
        check_not_input(path, &args.input)?;
    }
    if let Some(angle) = args.start_angle.filter(|angle| !angle.is_finite()) {
        return Err(BadArgument(format!("--start-angle is {angle}, expected a finite number")).into());
    }
    let source = frame_source::open(&args.input, args.frames as usize)?;
    let existing = source.calibration;
    let (estimate, frame, unreadable) = estimate(source.frames)?;
    let orientation = orientation(args, existing.as_ref());
    let calibration = estimate.calibration(&orientation);
    let cut_rim_px = cut_rim_px(&calibration, &frame);
    let mut outcome = Outcome { estimate, calibration, existing, unreadable, written: Vec::new(), cut_rim_px };

    let accepted = outcome.estimate.verdict == Verdict::Sure || args.accept_doubtful;
    if accepted {
        let mut png = std::io::Cursor::new(Vec::new());
        overlay(&frame, &outcome.estimate, &orientation)
            .write_to(&mut png, image::ImageFormat::Png)
            .context("encoding the picture")?;
        let mut text = serde_json::to_string_pretty(&outcome.calibration).context("encoding the calibration")?;
        text.push('\n');
        // The calibration last: where it is, the picture is too.
        write_bytes_atomically(&args.overlay, png.get_ref())?;
        write_bytes_atomically(&args.out, text.as_bytes())?;
        outcome.written = vec![args.out.clone(), args.overlay.clone()];
    }
    let report = if args.json { format!("{:#}\n", json_report(&outcome)) } else { text_report(&outcome, accepted) };
    print(&report)?;
    Ok(if accepted { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

/// Streams the frames through the finder. Also the first frame, to draw on, and why others could not be read.
fn estimate(
    frames: impl Iterator<Item = anyhow::Result<LumaImage>>,
) -> anyhow::Result<(DonutEstimate, LumaImage, Vec<String>)> {
    let mut state: Option<(DonutFinder, LumaImage)> = None;
    let mut unreadable = Vec::new();
    for frame in frames {
        let frame = match frame {
            Ok(frame) => frame,
            Err(error) => {
                unreadable.push(format!("{error:#}"));
                continue;
            }
        };
        match &mut state {
            Some((finder, _)) => finder.add(&frame)?,
            None => {
                let mut finder = DonutFinder::new(frame.width_px, frame.height_px)?;
                finder.add(&frame)?;
                state = Some((finder, frame));
            }
        }
    }
    let Some((finder, first)) = state else {
        return match unreadable.first() {
            Some(reason) => bail!("none of {} images could be read: {reason}", unreadable.len()),
            None => Err(FindDonutError::NoFrames.into()),
        };
    };
    Ok((finder.finish()?, first, unreadable))
}

fn orientation(args: &CalibrateArgs, existing: Option<&DonutCalibration>) -> Orientation {
    let known = existing.map(Orientation::from).unwrap_or_default();
    Orientation {
        top_is_outer: args.top_is_outer.unwrap_or(known.top_is_outer),
        start_angle_rad: args.start_angle.unwrap_or(known.start_angle_rad),
        clockwise: args.clockwise.unwrap_or(known.clockwise),
        azimuth: args.azimuth.unwrap_or(known.azimuth),
    }
}

/// How far the outer rim reaches beyond the image, when that is more than unwrapping accepts \[px\].
fn cut_rim_px(donut: &DonutCalibration, frame: &LumaImage) -> Option<f64> {
    donut.check_in_image(frame.width_px, frame.height_px).err()?;
    let beyond = |center: f64, size: usize| {
        (donut.outer_radius_px - center).max(center + donut.outer_radius_px - (size as f64 - 1.0))
    };
    Some(beyond(donut.center_x_px, frame.width_px).max(beyond(donut.center_y_px, frame.height_px)))
}

/// Distance of the centres and change of the radii \[px\].
fn moved(outcome: &Outcome) -> Option<(f64, f64, f64)> {
    let (new, old) = (&outcome.calibration, outcome.existing.as_ref()?);
    Some((
        (new.center_x_px - old.center_x_px).hypot(new.center_y_px - old.center_y_px),
        new.inner_radius_px - old.inner_radius_px,
        new.outer_radius_px - old.outer_radius_px,
    ))
}

fn text_report(outcome: &Outcome, accepted: bool) -> String {
    let donut = &outcome.estimate;
    let mut lines = vec![
        format!(
            "centre        {:.2} ± {:.2}, {:.2} ± {:.2} px",
            donut.center_x_px, donut.center_x_std_px, donut.center_y_px, donut.center_y_std_px
        ),
        format!("inner radius  {:.2} ± {:.2} px", donut.inner_radius_px, donut.inner_radius_std_px),
        format!("outer radius  {:.2} ± {:.2} px", donut.outer_radius_px, donut.outer_radius_std_px),
        format!(
            "evidence      {} frames; edge on the circle for {:.0} % of the inner and {:.0} % of the outer rim",
            donut.frames_used,
            100.0 * donut.inner_rim.supported,
            100.0 * donut.outer_rim.supported
        ),
    ];
    if let Some(wander_px) = donut.wander_px {
        lines.push(format!("shaking       the donut moves by {wander_px:.1} px (rms of an axis) between frames"));
    }
    match &donut.verdict {
        Verdict::Sure => lines.push(format!("verdict       sure, confidence {:.2}", donut.confidence)),
        Verdict::Doubtful(doubts) => {
            lines.push(format!("verdict       doubtful, confidence {:.2}: {}", donut.confidence, doubts.join("; ")));
        }
    }
    if let Some((center, inner, outer)) = moved(outcome) {
        lines.push(format!(
            "before        centre moved by {center:.1} px, inner radius by {inner:+.1} px, outer by {outer:+.1} px"
        ));
    }
    if let Some(beyond_px) = outcome.cut_rim_px {
        lines.push(format!(
            "note          the outer rim reaches {beyond_px:.0} px beyond the image, and unwrapping accepts {:.0}: \
             move the camera, or set a smaller r_out",
            DonutCalibration::CUT_RIM_PX
        ));
    }
    if let Some(reason) = outcome.unreadable.first() {
        lines.push(format!("skipped       {} images, the first: {reason}", outcome.unreadable.len()));
    }
    if accepted {
        let names: Vec<String> = outcome.written.iter().map(|path| path.display().to_string()).collect();
        lines.push(format!("written       {}", names.join(", ")));
    } else {
        lines.push("written       nothing; --accept-doubtful writes it, more frames may settle it".to_owned());
    }
    lines.join("\n") + "\n"
}

fn json_report(outcome: &Outcome) -> serde_json::Value {
    let donut = &outcome.estimate;
    let (verdict, doubts) = match &donut.verdict {
        Verdict::Sure => ("sure", &[] as &[String]),
        Verdict::Doubtful(doubts) => ("doubtful", doubts.as_slice()),
    };
    json!({
        "calibration": outcome.calibration,
        "std_px": {
            "cx": donut.center_x_std_px, "cy": donut.center_y_std_px,
            "r_in": donut.inner_radius_std_px, "r_out": donut.outer_radius_std_px,
        },
        "frames_used": donut.frames_used,
        "inner_rim": {"visible": donut.inner_rim.visible, "supported": donut.inner_rim.supported},
        "outer_rim": {"visible": donut.outer_rim.visible, "supported": donut.outer_rim.supported},
        "center_disagreement_px": donut.center_disagreement_px,
        "wander_px": donut.wander_px,
        "confidence": donut.confidence,
        "verdict": verdict,
        "doubts": doubts,
        "moved_px": moved(outcome).map(|(center, inner, outer)| json!({"center": center, "r_in": inner, "r_out": outer})),
        "rim_beyond_image_px": outcome.cut_rim_px,
        "unreadable": outcome.unreadable,
        "written": outcome.written,
    })
}
