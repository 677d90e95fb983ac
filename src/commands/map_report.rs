//! What `info`, `check` and `train` say about a map.

use std::path::Path;

use serde_json::json;

use super::printable;
use crate::map::{FeatureMap, GroupHyperparameters, TrackReport};
use crate::metrics::ErrorFigures;
use crate::train::UpdateReport;
use crate::types::counted;

pub fn as_json(path: &Path, map: &FeatureMap, size_bytes: u64) -> serde_json::Value {
    json!({
        "file": path,
        "kind": "map",
        "size_bytes": size_bytes,
        "learning_positions": map.positions_m.len(),
        "cells": map.cells.len(),
        "info": map.info,
    })
}

/// What adding a drive did to a map.
pub fn of_update(report: &UpdateReport) -> String {
    let mut text = format!("added           {}\n", counted(report.frames, "frame"));
    if let Some(track) = &report.track {
        text += &format!("positions       {}\n", positions(track));
    }
    text += &format!("cells           {}, {} before\n", report.cells[1], report.cells[0]);
    text += "held back              frames   RMSE  median     P95   >10 m\n";
    let mut line = |of: &str, figures: &ErrorFigures| {
        text += &format!(
            "{of:<22} {:>6} {:>5.2}m {:>6.2}m {:>6.2}m {:>6.1}%\n",
            figures.n,
            figures.rmse_m,
            figures.median_m,
            figures.p95_m,
            100.0 * figures.share_over_10m
        );
    };
    for (of, figures) in [("of the map", report.old.as_ref()), ("of the drive", Some(&report.new))] {
        if let Some(figures) = figures {
            line(&format!("{of}, before"), &figures.before);
            line(&format!("{of}, after"), &figures.after);
        }
    }
    text
}

pub fn as_text(path: &Path, map: &FeatureMap, size_bytes: u64) -> String {
    let info = &map.info;
    let mut lines: Vec<(&str, String)> = vec![
        ("map", format!("{}, version {}, by omniloc {}", path.display(), info.format_version, info.program)),
        ("size", format!("{:.1} MB", size_bytes as f64 * 1e-6)),
    ];
    for recording in &info.recordings {
        lines.push(("trained on", format!("{}, {}", recording.name, counted(recording.frames, "frame"))));
        if let Some(track) = &recording.track {
            lines.push(("positions", positions(track)));
        }
    }
    let selection = if info.groups.iter().any(|group| group.features < group.rank) { "chosen" } else { "all kept" };
    lines.push(("recipe", format!("{}, features {selection}", info.recipe.name())));
    let (columns, rows) = (f64::from(info.grid.columns), f64::from(info.grid.rows));
    lines.push((
        "cells",
        format!(
            "{} of {columns} x {rows}, {} m apart, over {:.1} x {:.1} m",
            map.cells.len(),
            info.grid.step_m,
            (columns - 1.0) * info.grid.step_m,
            (rows - 1.0) * info.grid.step_m
        ),
    ));
    lines.push((
        "temperature",
        format!("{:.1}: divides log-likelihoods before they are probabilities", info.temperature),
    ));
    if let Some(least) = info.least_resemblance {
        lines.push(("elsewhere", format!("frames of other places stay below a resemblance of {least:.1}")));
    }
    lines.push((
        "headings",
        match info.heading_std_rad {
            Some(std_rad) => format!("from {} panoramas, to {:.1} deg", map.positions_m.len(), std_rad.to_degrees()),
            None => "none: not every frame has a yaw".into(),
        },
    ));
    let donut = &info.calibration;
    lines.push((
        "lens",
        format!(
            "donut, centre ({:.1}, {:.1}), radii {:.1} .. {:.1} px in {} x {} px",
            donut.center_x_px,
            donut.center_y_px,
            donut.inner_radius_px,
            donut.outer_radius_px,
            info.image_size_px[0],
            info.image_size_px[1]
        ),
    ));
    lines.push((
        "origin",
        match info.origin {
            Some(o) => format!("{:.7}, {:.7} deg, {:.1} m", o.latitude_deg, o.longitude_deg, o.altitude_m),
            None => "unknown: positions are local metres".into(),
        },
    ));
    let mut text: String = lines.iter().map(|(label, text)| format!("{label:<15}{}\n", printable(text))).collect();

    text += &format!("\n{:<19} {:>5} {:>5} {:>5}  hyperparameters\n", "features", "m", "rank", "kept");
    for group in &info.groups {
        let descriptor = group.recipe.descriptor;
        text += &format!(
            "{:<19} {:>5} {:>5} {:>5}  {}\n",
            descriptor.name(),
            descriptor.dimensions(),
            group.rank,
            group.features,
            hyperparameters(&group.hyperparameters)
        );
        for (warning, count) in group.hyperparameters.warnings() {
            text += &format!("{:<19} {count} of {}: {}\n", "", group.features, warning.describe());
        }
    }
    text += &format!(
        "\n{:<19} {:>7} {:>7} {:>7} {:>7}   on {} frames held back\n",
        "validation",
        "RMSE",
        "median",
        "P95",
        ">10 m",
        info.validation.first().map_or(0, |figures| figures.frames)
    );
    for figures in &info.validation {
        text += &format!(
            "{:<19} {:>6.2}m {:>6.2}m {:>6.2}m {:>6.1}%\n",
            figures.features,
            figures.rmse_m,
            figures.median_m,
            figures.p95_m,
            100.0 * figures.share_over_10m
        );
    }
    text
}

fn positions(track: &TrackReport) -> String {
    match track {
        TrackReport::Smoothed { receiver_std_m, receiver_time_s, moved_m, remaining_std_m, views } => format!(
            "moved by {moved_m:.2} m; receiver errs by {receiver_std_m:.2} m an axis, alike for {receiver_time_s:.0} s; \
             {remaining_std_m:.2} m an axis remain; {views} matches with other passes"
        ),
        TrackReport::LeftAlone(why) => format!("as recorded: {}", why.describe()),
    }
}

fn hyperparameters(hyperparameters: &GroupHyperparameters) -> String {
    match hyperparameters {
        GroupHyperparameters::Shared(shared) => format!(
            "shared: length {:.2} m, signal {:.2}, noise {:.2}",
            shared.length_scale_m[0], shared.signal_std, shared.noise_std
        ),
        GroupHyperparameters::Each(fits) => {
            let mut lengths_m: Vec<f64> = fits.iter().flat_map(|fit| fit.hyperparameters.length_scale_m).collect();
            lengths_m.sort_by(f64::total_cmp);
            let at = |quantile: f64| lengths_m.get((quantile * (lengths_m.len() - 1) as f64) as usize).copied();
            match (at(0.1), at(0.5), at(0.9)) {
                (Some(low), Some(middle), Some(high)) => {
                    format!("one set a feature: lengths {low:.2} .. {middle:.2} .. {high:.2} m (P10, P50, P90)")
                }
                _ => "none".into(),
            }
        }
    }
}
