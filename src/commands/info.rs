//! `omniloc info`: what is in a recording or map.

use std::{fs, path::PathBuf, process::ExitCode};

use anyhow::Context;
use serde_json::json;

use super::{
    DONE,
    evaluate_map::open_map,
    file_kind::{FileKind, file_kind},
    map_report,
    options::{check_input, check_no_folder},
    print, printable,
    progress::Progress,
};
use crate::recording::{DriveHealth, Recording, RecordingError, TopicSummary};
use crate::sync::{RecordedLag, latency_from_recording};

/// Show what is in a recording or map
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
        FileKind::Map => show_map(args)?,
        FileKind::Recording => show_recording(args)?,
    }
    Ok(DONE.into())
}

fn show_map(args: &Args) -> anyhow::Result<()> {
    let map = open_map(&args.file)?;
    let size_bytes = size_bytes(args);
    print(&if args.json {
        format!("{:#}\n", map_report::as_json(&args.file, &map, size_bytes))
    } else {
        map_report::as_text(&args.file, &map, size_bytes)
    })?;
    Ok(())
}

fn show_recording(args: &Args) -> anyhow::Result<()> {
    let recording = Recording::open_any(&args.file)?;
    let size_bytes = size_bytes(args);
    let lag = lag_of_pairs(&recording)?;
    print(&if args.json {
        format!("{:#}\n", as_json(&recording, size_bytes, lag))
    } else {
        as_text(&recording, size_bytes, lag)
    })?;
    Ok(())
}

/// By how much pairs and pictures disagree, if the recording shows it; decodes some hundred frames.
fn lag_of_pairs(recording: &Recording) -> anyhow::Result<Option<RecordedLag>> {
    let progress = Progress::new();
    let lag = latency_from_recording(recording, |frame, of| {
        if frame == 1 {
            progress.begin("comparing turns with the pictures", of);
        }
        progress.advance(1);
    });
    progress.finish();
    lag.with_context(|| format!("comparing turns with the pictures of {}", recording.path.display()))
}

fn describe_lag(RecordedLag { late_s, std_s, turns }: RecordedLag) -> String {
    let word = if late_s < 0.0 { "early" } else { "late" };
    let (late_ms, std_ms) = (late_s.abs() * 1e3, std_s * 1e3);
    format!("camera against yaw: pairs are {late_ms:.0} ms {word} (+- {std_ms:.0} ms, {turns} turns)")
}

fn size_bytes(args: &Args) -> u64 {
    fs::metadata(&args.file).map(|facts| facts.len()).unwrap_or_default()
}

/// Seconds between the first and the last message of all topics.
fn duration_s(recording: &Recording) -> f64 {
    let first_ns = recording.topics.values().map(|topic| topic.first_ns).min().unwrap_or_default();
    let last_ns = recording.topics.values().map(|topic| topic.last_ns).max().unwrap_or_default();
    last_ns.saturating_sub(first_ns) as f64 * 1e-9
}

/// Messages a second, counted between the first and the last.
fn rate_hz(topic: &TopicSummary) -> Option<f64> {
    let span_s = topic.last_ns.saturating_sub(topic.first_ns) as f64 * 1e-9;
    (span_s > 0.0).then(|| (topic.messages - 1) as f64 / span_s)
}

/// Smallest and largest east, north \[m\] of the usable frames.
fn extent_m(recording: &Recording) -> Option<[[f64; 2]; 2]> {
    let range = |axis: usize| {
        let along = recording.survey.iter().map(move |frame| frame.position_m[axis]);
        Some([along.clone().reduce(f64::min)?, along.reduce(f64::max)?])
    };
    Some([range(0)?, range(1)?])
}

fn with_yaw(recording: &Recording) -> usize {
    recording.survey.iter().filter(|frame| frame.yaw_rad.is_some()).count()
}

fn as_json(recording: &Recording, size_bytes: u64, lag: Option<RecordedLag>) -> serde_json::Value {
    let topics: serde_json::Map<_, _> = recording
        .topics
        .iter()
        .map(|(name, topic)| {
            let facts = json!({
                "schema": topic.schema_name, "messages": topic.messages, "rate_hz": rate_hz(topic),
                "first_ns": topic.first_ns, "last_ns": topic.last_ns,
            });
            (name.clone(), facts)
        })
        .collect();
    let extent = extent_m(recording);
    json!({
        "file": recording.path,
        "kind": "recording",
        "name": recording.name,
        "size_bytes": size_bytes,
        "duration_s": duration_s(recording),
        "topics": topics,
        "image_size_px": recording.image_size_px,
        "usable_frames": recording.survey.len(),
        "frames_with_yaw": with_yaw(recording),
        "unusable_pairs": recording.unusable.len(),
        "images_without_pair": recording.images_without_pair,
        "east_range_m": extent.map(|[east, _]| east),
        "north_range_m": extent.map(|[_, north]| north),
        "length_m": recording.length_m(),
        "origin": recording.origin.map(|origin| json!({
            "latitude_deg": origin.latitude_deg, "longitude_deg": origin.longitude_deg, "altitude_m": origin.altitude_m,
        })),
        "calibration": recording.calibration().ok(),
        "drive": (recording.health.seconds > 0).then(|| drive_json(&recording.health)),
        "camera_against_yaw": lag.map(|lag| json!({
            "late_s": lag.late_s, "std_s": lag.std_s, "turns": lag.turns,
        })),
        "metadata": recording.metadata,
    })
}

fn drive_json(health: &DriveHealth) -> serde_json::Value {
    let lost: Vec<_> = health.lost.iter().map(|((topic, reason), count)| json!([topic, reason, count])).collect();
    json!({
        "seconds": health.seconds,
        "lost": lost,
        "troubles_s": health.troubles,
        "mean_cpu_cores": health.mean_cpu_cores,
        "max_cpu_cores": health.max_cpu_cores,
        "first_minute_resident_bytes": health.first_minute_resident_bytes,
        "later_resident_bytes": health.later_resident_bytes,
        "max_queue_bytes": health.max_queue_bytes,
        "max_disk_stall_s": health.max_disk_stall_s,
        "max_temperature_celsius": health.max_temperature_celsius,
    })
}

/// How the drive was recorded.
fn drive_lines(health: &DriveHealth, line: &mut impl FnMut(&str, String)) {
    for ((topic, reason), count) in &health.lost {
        line("lost", format!("{count} on {topic}: {reason}"));
    }
    if health.seconds == 0 {
        return;
    }
    for (trouble, seconds) in &health.troubles {
        line("trouble", format!("{trouble}, {seconds} s"));
    }
    let mb = |bytes: u64| format!("{:.1} MB", bytes as f64 * 1e-6);
    let later = health.later_resident_bytes.map_or(String::new(), |bytes| format!(", then {}", mb(bytes)));
    line("processor", format!("{:.2} cores on average, {:.2} at most", health.mean_cpu_cores, health.max_cpu_cores));
    line("memory", format!("{} in the first minute{later}, without the queue", mb(health.first_minute_resident_bytes)));
    line(
        "disk",
        format!("waited for {:.2} s at most, {} in the queue", health.max_disk_stall_s, mb(health.max_queue_bytes)),
    );
}

fn as_text(recording: &Recording, size_bytes: u64, lag: Option<RecordedLag>) -> String {
    let mut lines: Vec<(String, String)> = Vec::new();
    let mut line = |label: &str, text: String| lines.push((label.into(), printable(&text)));
    line("recording", recording.name.clone());
    line("size", format!("{:.1} MB", size_bytes as f64 * 1e-6));
    line("duration", format!("{:.1} s", duration_s(recording)));
    if let Some((width_px, height_px)) = recording.image_size_px {
        line("images", format!("{width_px} x {height_px} px"));
    }
    line("usable frames", format!("{}, {} of them with yaw", recording.survey.len(), with_yaw(recording)));
    if !recording.unusable.is_empty() {
        line("unusable pairs", recording.unusable.len().to_string());
    }
    if recording.images_without_pair > 0 {
        line("without pair", format!("{} images", recording.images_without_pair));
    }
    if let Some([east, north]) = extent_m(recording) {
        let (width_m, height_m) = (east[1] - east[0], north[1] - north[0]);
        line("extent", format!("{width_m:.1} x {height_m:.1} m, way {:.1} m", recording.length_m()));
        line("east", format!("{:.2} .. {:.2} m", east[0], east[1]));
        line("north", format!("{:.2} .. {:.2} m", north[0], north[1]));
    }
    line(
        "origin",
        match recording.origin {
            Some(o) => format!("{:.7}, {:.7} deg, {:.1} m", o.latitude_deg, o.longitude_deg, o.altitude_m),
            None => "unknown: positions are local metres".into(),
        },
    );
    drive_lines(&recording.health, &mut line);
    line(
        "calibration",
        match recording.calibration() {
            Ok(donut) => format!(
                "donut, centre ({}, {}), radii {} .. {} px",
                donut.center_x_px, donut.center_y_px, donut.inner_radius_px, donut.outer_radius_px
            ),
            Err(RecordingError::NoCalibration { .. }) => "none: run `omniloc calibrate`".into(),
            Err(error) => format!("{:#}", anyhow::Error::new(error)),
        },
    );
    if let Some(lag) = lag {
        lines.push(("timing".into(), describe_lag(lag)));
    }
    let mut text: String = lines.iter().map(|(label, text)| format!("{label:<15}{text}\n")).collect();

    let name_width = recording.topics.keys().map(String::len).max().unwrap_or(0).max(5);
    text += &format!("\n{:<name_width$}  {:>9}  {:>9}  schema\n", "topic", "messages", "rate");
    for (name, topic) in &recording.topics {
        let rate = rate_hz(topic).map_or("-".into(), |hz| format!("{hz:.2} Hz"));
        let (name, schema) = (printable(name), printable(&topic.schema_name));
        text += &format!("{name:<name_width$}  {:>9}  {rate:>9}  {schema}\n", topic.messages);
    }
    for (record, entries) in &recording.metadata {
        let key_width = entries.keys().map(String::len).max().unwrap_or(0);
        text += &format!("\n{}\n", printable(record));
        for (key, value) in entries {
            // Settings are a whole file.
            let lines = value.lines().count();
            let value = if lines > 1 { format!("{lines} lines: see --json") } else { printable(value) };
            text += &format!("  {:<key_width$}  {value}\n", printable(key));
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_lag_of_pairs_is_one_line() {
        let lag = |late_s| describe_lag(RecordedLag { late_s, std_s: 0.004, turns: 6 });
        assert_eq!(lag(0.0121), "camera against yaw: pairs are 12 ms late (+- 4 ms, 6 turns)");
        assert_eq!(lag(-0.3), "camera against yaw: pairs are 300 ms early (+- 4 ms, 6 turns)");
    }
}
