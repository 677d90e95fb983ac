//! Where the frames were, where the method says they were, and where it fails: figure 7 of Do et al. (2015), and a map of
//! the errors.

use serde_json::json;

use super::errors::cases;
use crate::report::chart::color::{BLUE, ERROR_CLASSES, FAINT, INK, VERMILION};
use crate::report::chart::map_plot::{Extent, ellipse_m, map_plot};
use crate::report::chart::plot::{Key, LABEL, LegendItem, Panel, Plot};
use crate::report::chart::scale::{meters, number};
use crate::report::chart::svg::{Anchor, Paint};
use crate::report::dataset::Dataset;
use crate::report::figure::{Drawn, Figure};
use crate::report::insight::{FrameAnswer, Insight};
use crate::report::methods::{FILTERED, FrameError, Kind, Method, SMOOTHED, methods, recipe_name};
use crate::types::PositionM;

/// The ellipses hold so much of the probability.
const ELLIPSE: f64 = 0.95;
/// Maps with more frames than this show the ellipses of every second, third, … one.
const MAX_ELLIPSES: usize = 60;

/// Ellipses with a longer semi-axis, as a share of the map's diagonal, would hide the others.
const WIDEST_SHARE: f64 = 0.15;

/// A set of answers on a map.
struct Layer<'a> {
    title: String,
    color: &'static str,
    answers: &'a [FrameAnswer],
}

fn layers(dataset: &Dataset) -> Vec<Layer<'_>> {
    // What the report is about comes first.
    let mut insights: Vec<&Insight> = dataset.insights.iter().collect();
    insights.sort_by_key(|insight| insight.recipe != "default");
    let mut layers: Vec<Layer> = insights
        .into_iter()
        .map(|insight| {
            let color = if insight.recipe == "paper" { VERMILION } else { BLUE };
            let title = match &insight.split {
                Some((split, Some(seed))) => format!("{}, {split} split, seed {seed}", recipe_name(insight.recipe)),
                Some((split, None)) => format!("{}, {split}", recipe_name(insight.recipe)),
                None => "Single frames, all features".into(),
            };
            Layer { title, color, answers: &insight.frames }
        })
        .collect();
    layers.extend(dataset.sequences.iter().filter(|s| !s.answers.is_empty()).map(|sequence| {
        let (title, color) = match sequence.estimator {
            "filtered" => ("Filtered: as on the vehicle", FILTERED),
            "smoothed" => ("Smoothed: with later frames too", SMOOTHED),
            other => (other, BLUE),
        };
        Layer { title: title.into(), color, answers: &sequence.answers }
    }));
    layers
}

/// Positions that the surroundings are drawn of: everything that was driven or learned.
pub fn extent_of(dataset: &Dataset) -> Extent {
    let learned = dataset.insights.iter().flat_map(|insight| &insight.learning_m);
    Extent::of(dataset.truth_m.iter().chain(learned))
}

/// The path and the estimates, with what joins them.
pub fn estimates(dataset: &Dataset) -> Drawn {
    const TITLE: &str = "Estimates on the map";
    let layers = layers(dataset);
    if layers.is_empty() {
        return Drawn::left_out(TITLE, "No feature was kept, so there are no estimates.");
    }
    let extent = extent_of(dataset);
    let data = layers.iter().map(|layer| {
        json!({
            "panel": layer.title,
            "ellipse_probability": ELLIPSE,
            "frames": layer.answers.iter().map(frame_json).collect::<Vec<_>>(),
        })
    });
    let caption = "Lines join each true position (ring) with its estimate (dot): short lines are good, long ones are gross \
                   errors. Ellipses are the stated 95 % regions; those of frames that could be at several places are as \
                   wide as the map, and are counted instead of drawn. Gray: the whole path.";
    let figure = Figure::new(format!("{}-estimates", dataset.id), TITLE, caption, json!(data.collect::<Vec<_>>()));
    figure
        .responsive(|width_px| layers.iter().map(|layer| estimates_panel(dataset, extent, layer, width_px)).collect())
        .into()
}

pub fn frame_json(answer: &FrameAnswer) -> serde_json::Value {
    json!({
        "index": answer.index,
        "truth_m": answer.truth_m,
        "estimate_m": answer.estimate_m,
        "error_m": answer.error_m(),
        "covariance_m2": [answer.covariance.ee_m2, answer.covariance.en_m2, answer.covariance.nn_m2],
        "nees": answer.nees,
        "credible_level": answer.credible_level,
    })
}

/// The path, broken where it jumps.
pub fn draw_path(plot: &mut Plot, positions_m: &[PositionM]) {
    for &position_m in positions_m {
        plot.dot(position_m, 1.5, Paint::fill(FAINT));
    }
}

fn estimates_panel(dataset: &Dataset, extent: Extent, layer: &Layer, width_px: f64) -> Panel {
    let legend = vec![
        LegendItem::new("truth", Key::Dot(Paint::fill("#ffffff").outlined(INK, 1.2))),
        LegendItem::new("estimate", Key::Dot(Paint::fill(layer.color))),
        LegendItem::new("95 % region", Key::Dot(Paint::fill(layer.color).opacity(0.22))),
    ];
    let mut plot = map_plot(layer.title.clone(), extent, legend, width_px);
    draw_path(&mut plot, &dataset.truth_m);
    let step = layer.answers.len().div_ceil(MAX_ELLIPSES).max(1);
    let widest_m = WIDEST_SHARE * (extent.high_m[0] - extent.low_m[0]).hypot(extent.high_m[1] - extent.low_m[1]);
    let is_wide = |answer: &FrameAnswer| ellipse_m(&answer.covariance, ELLIPSE).0[0] > widest_m;
    for answer in layer.answers.iter().step_by(step).filter(|answer| !is_wide(answer)) {
        let paint = Paint::fill(layer.color).outlined(layer.color, 1.0).opacity(0.16);
        plot.covariance_ellipse(answer.estimate_m, &answer.covariance, ELLIPSE, paint);
    }
    for answer in layer.answers {
        plot.segment(answer.truth_m, answer.estimate_m, Paint::stroke(layer.color, 1.1).opacity(0.75));
    }
    for answer in layer.answers {
        plot.dot(answer.truth_m, 2.0, Paint::fill("#ffffff").outlined(INK, 0.8));
    }
    for answer in layer.answers {
        let at = plot.at(answer.estimate_m);
        let title = format!("frame {}: {} m off", answer.index, meters(answer.error_m()));
        plot.inside.titled_circle(at, 2.2, Paint::fill(layer.color), &title);
    }
    let wide = layer.answers.iter().filter(|answer| is_wide(answer)).count();
    if wide > 0 {
        let text = format!("{wide} of {} regions are longer than {} m", layer.answers.len(), meters(2.0 * widest_m));
        put_note(&mut plot, &text);
    }
    plot.finish()
}

/// A note above the right end of a map, where nothing lies below it.
fn put_note(plot: &mut Plot, text: &str) {
    let at = [plot.area_at[0] + plot.area_size[0], plot.area_at[1] - 9.0];
    plot.above.text(at, text, LABEL.anchored(Anchor::End));
}

/// Where on the map the errors are.
pub fn error_map(dataset: &Dataset) -> Drawn {
    const TITLE: &str = "Where it fails";
    let mut shown: Vec<(String, Vec<FrameError>)> = Vec::new();
    let mut data = Vec::new();
    for (split, case) in cases(dataset) {
        let methods = methods(dataset, split.as_deref());
        let whole = |method: &&Method| method.kind == Kind::Whole && !method.errors().is_empty();
        for method in methods.iter().filter(whole) {
            let errors = method.errors();
            data.push(json!({
                "split": split,
                "method": method.label,
                "frames": errors.iter().map(|frame| json!({
                    "index": frame.index, "seed": frame.seed, "truth_m": frame.truth_m, "error_m": frame.error_m,
                })).collect::<Vec<_>>(),
            }));
            shown.push((format!("{}, {case}", method.label), errors));
        }
    }
    if shown.is_empty() {
        return Drawn::left_out(TITLE, "No method gave an estimate.");
    }
    let caption = "Every test frame at its true position, coloured and sized by its error, all seeds together; large dark \
                   red dots are gross errors. Gray: the whole path.";
    let figure = Figure::new(format!("{}-error-map", dataset.id), TITLE, caption, json!(data));
    let panels =
        |width_px: f64| shown.iter().map(|(title, errors)| error_panel(dataset, title, errors, width_px)).collect();
    figure.responsive(panels).into()
}

fn error_panel(dataset: &Dataset, title: &str, errors: &[FrameError], width_px: f64) -> Panel {
    let yardstick = dataset.yardstick();
    let bounds_m = yardstick.error_classes_m;
    let keys = ERROR_CLASSES.iter().enumerate();
    let legend = keys.map(|(i, class)| LegendItem::new(class_label(&bounds_m, i), Key::Dot(Paint::fill(class.color))));
    let mut plot = map_plot(title, extent_of(dataset), legend.collect(), width_px);
    draw_path(&mut plot, &dataset.truth_m);
    let mut sorted: Vec<&FrameError> = errors.iter().collect();
    sorted.sort_by(|a, b| a.error_m.total_cmp(&b.error_m));
    for frame in sorted {
        let class = &ERROR_CLASSES[bounds_m.iter().position(|bound| frame.error_m <= *bound).unwrap_or(bounds_m.len())];
        let at = plot.at(frame.truth_m);
        let title = format!("frame {}: {} m off", frame.index, meters(frame.error_m));
        plot.inside.titled_circle(at, class.radius_px, Paint::fill(class.color).outlined("#ffffff", 0.6), &title);
    }
    let gross_m = yardstick.gross_m;
    let gross = errors.iter().filter(|frame| frame.error_m > gross_m).count();
    put_note(&mut plot, &format!("{gross} of {} frames over {gross_m} m", number(errors.len() as f64, 0)));
    plot.finish()
}

fn class_label(bounds_m: &[f64; 4], class: usize) -> String {
    match class {
        0 => format!("≤ {} m", bounds_m[0]),
        4 => format!("> {} m", bounds_m[3]),
        i => format!("{}–{} m", bounds_m[i - 1], bounds_m[i]),
    }
}
