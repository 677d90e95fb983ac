//! Where a single frame could have been taken: the probability of every cell.

use serde_json::json;

use super::paths::{draw_path, extent_of};
use crate::report::chart::color::{ColorMap, INK, VERMILION};
use crate::report::chart::map_plot::{Extent, map_plot};
use crate::report::chart::plot::{Key, LegendItem, Panel};
use crate::report::chart::scale::meters;
use crate::report::chart::svg::Paint;
use crate::report::dataset::Dataset;
use crate::report::figure::{Drawn, Figure};
use crate::report::insight::{FrameAnswer, Insight};
use crate::report::methods::recipe_name;
use crate::types::PositionM;

/// Log-likelihoods further below the best than this are all drawn alike \[nats, at the map's temperature\].
const SHOWN_NATS: f64 = 12.0;

pub fn likelihood(dataset: &Dataset) -> Drawn {
    const TITLE: &str = "What single frames say";
    let Some(insight) = dataset.shown_insight().filter(|insight| !insight.likelihoods.is_empty()) else {
        return Drawn::left_out(TITLE, "No feature was kept, so frames say nothing.");
    };
    let kinds = ["An ordinary frame", "A hard frame", "The worst frame"];
    let shown: Vec<(&str, &FrameAnswer, &[f32])> = kinds
        .into_iter()
        .zip(&insight.likelihoods)
        .filter_map(|(kind, (row, values))| {
            let answer = insight.frames.iter().find(|answer| answer.row == *row)?;
            Some((kind, answer, &values[..]))
        })
        .collect();
    let data = shown.iter().map(|(kind, answer, values)| {
        let grid = insight.cells.grid;
        let relative = relative_nats(values, insight.temperature);
        json!({
            "panel": kind,
            "frame": super::paths::frame_json(answer),
            "temperature": insight.temperature,
            "grid": {"origin_m": grid.origin_m, "step_m": grid.step_m, "columns": grid.columns, "rows": grid.rows},
            "cells": if insight.cells.len() == (grid.columns * grid.rows) as usize { None } else { Some(insight.cells.indices()) },
            "log_probability_below_best": relative.iter().map(|v| (f64::from(*v) * 1e3).round() * 1e-3).collect::<Vec<_>>(),
        })
    });
    let of = match &insight.split {
        Some((split, Some(seed))) => format!("the {}, {split} split, seed {seed},", recipe_name(insight.recipe)),
        Some((split, None)) => format!("the {}, {split},", recipe_name(insight.recipe)),
        None => "the map".into(),
    };
    let caption = format!(
        "Dark: where the frame was likely taken, by all features of {of} and its temperature {:.1}. One dark spot on the \
         ring is a sure and right answer; several are places that look alike. Gray: images learned from. Where all that \
         comes into question is close together, only that part of the map is shown. The frames are those with the median error, \
         the 95th percentile and the largest.",
        insight.temperature
    );
    let figure = Figure::new(format!("{}-likelihood", dataset.id), TITLE, caption, json!(data.collect::<Vec<_>>()));
    let panels = |width_px: f64| {
        shown.iter().map(|(kind, answer, values)| panel(dataset, insight, kind, answer, values, width_px)).collect()
    };
    figure.responsive(panels).into()
}

fn relative_nats(values: &[f32], temperature: f64) -> Vec<f32> {
    let greatest = values.iter().copied().fold(f32::NEG_INFINITY, f32::max);
    values.iter().map(|value| ((f64::from(value - greatest)) / temperature) as f32).collect()
}

/// The whole map, or what is around the places that come into question where that is a small part of it.
fn shown_extent(dataset: &Dataset, insight: &Insight, answer: &FrameAnswer, relative: &[f32]) -> Extent {
    /// Enlarged no further than to so many cells on either axis, and only to less than this share of the map.
    const LEAST_CELLS: f64 = 24.0;
    const SMALL_SHARE: f64 = 0.5;
    let whole = extent_of(dataset);
    let likely =
        (0..relative.len()).filter(|&i| f64::from(relative[i]) > -SHOWN_NATS).map(|i| insight.cells.center_m(i));
    let places: Vec<PositionM> = likely.chain([answer.truth_m, answer.estimate_m]).collect();
    let bound = |axis: usize, pick: fn(f64, f64) -> f64| places.iter().map(|p| p[axis]).reduce(pick).unwrap_or(0.0);
    let (low, high) = ([0, 1].map(|axis| bound(axis, f64::min)), [0, 1].map(|axis| bound(axis, f64::max)));
    let side = |low: PositionM, high: PositionM| (high[0] - low[0]).max(high[1] - low[1]);
    let side_m = (1.6 * side(low, high)).max(LEAST_CELLS * insight.cells.grid.step_m);
    if side_m > SMALL_SHARE * side(whole.low_m, whole.high_m) {
        return whole;
    }
    let middle_m = [0, 1].map(|axis: usize| 0.5 * (low[axis] + high[axis]));
    Extent { low_m: middle_m.map(|c| c - 0.5 * side_m), high_m: middle_m.map(|c| c + 0.5 * side_m) }
}

fn panel(
    dataset: &Dataset,
    insight: &Insight,
    kind: &str,
    answer: &FrameAnswer,
    values: &[f32],
    width_px: f64,
) -> Panel {
    let legend = vec![
        LegendItem::new("truth", Key::Dot(Paint::fill("#ffffff").outlined(INK, 1.6))),
        LegendItem::new("estimate", Key::Diamond(Paint::fill(VERMILION).outlined("#ffffff", 1.0))),
    ];
    let title = format!("{kind}: {}, {} m off", answer.index, meters(answer.error_m()));
    let relative = relative_nats(values, insight.temperature);
    let extent = shown_extent(dataset, insight, answer, &relative);
    let mut plot = map_plot(title, extent, legend, width_px);
    let range = [-SHOWN_NATS, 0.0];
    plot.surface(&insight.cells, &relative, range, ColorMap::Fading);
    draw_path(&mut plot, &insight.learning_m);
    let (truth, estimate) = (plot.at(answer.truth_m), plot.at(answer.estimate_m));
    plot.above.line(truth, estimate, Paint::stroke(VERMILION, 1.2));
    plot.above.circle(truth, 5.0, Paint::stroke("#ffffff", 4.0));
    plot.above.circle(truth, 5.0, Paint::stroke(INK, 1.8));
    plot.above.diamond(estimate, 4.5, Paint::fill(VERMILION).outlined("#ffffff", 1.0));
    plot.color_bar("log probability below the best [nat]", range, ColorMap::Fading);
    plot.finish()
}
