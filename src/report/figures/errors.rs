//! How large the errors are: methods side by side, their distribution, and recall.

use serde_json::json;

use crate::report::chart::color::{FAINT, INK};
use crate::report::chart::plot::{Axis, HALF_WIDTH_PX, Key, LABEL, LegendItem, NOTE, PANEL_WIDTH_PX, Panel, Plot, Spec};
use crate::report::chart::scale::{Scale, meters};
use crate::report::chart::svg::{Anchor, Paint};
use crate::report::chart::text::fitted;
use crate::report::dataset::Dataset;
use crate::report::figure::{Drawn, Figure};
use crate::report::methods::{Kind, Method, methods};
use crate::evaluate::Entry;

/// Distances at which a frame counts as found \[m\].
pub const RECALL_AT_M: [f64; 4] = [1.0, 2.0, 5.0, 10.0];

/// The splits of a dataset, or that it was measured against a map.
pub fn cases(dataset: &Dataset) -> Vec<(Option<String>, String)> {
    let named = |split: &String| match split.as_str() {
        "random" => "frames drawn at random".to_owned(),
        "blocked" => "whole stretches held out".to_owned(),
        other => format!("split of {other}"),
    };
    let splits = dataset.split_names();
    if splits.is_empty() {
        return vec![(None, "every frame against the map".into())];
    }
    splits.iter().map(|split| (Some(split.clone()), named(split))).collect()
}

/// RMSE and median of every method, every seed a dot.
pub fn comparison(dataset: &Dataset) -> Drawn {
    let (mut panels, mut narrow) = (Vec::new(), Vec::new());
    let mut data = Vec::new();
    for (split, title) in cases(dataset) {
        let methods = methods(dataset, split.as_deref());
        let measured: Vec<&Method> = methods.iter().filter(|m| m.mean(|e| e.rmse_m).is_some()).collect();
        if measured.is_empty() {
            continue;
        }
        panels.push(comparison_panel(&title, &measured, HALF_WIDTH_PX));
        narrow.push(comparison_panel(&title, &measured, PANEL_WIDTH_PX));
        for method in measured {
            data.push(json!({
                "split": split,
                "method": method.label,
                "seeds": method.entries.iter().map(|entry| entry.seed).collect::<Vec<_>>(),
                "rmse_m": method.entries.iter().map(|entry| entry.rmse_m).collect::<Vec<_>>(),
                "median_m": method.entries.iter().map(|entry| entry.median_m).collect::<Vec<_>>(),
                "rmse_mean_m": method.mean(|entry| entry.rmse_m),
                "median_mean_m": method.mean(|entry| entry.median_m),
            }));
        }
    }
    if panels.is_empty() {
        return Drawn::left_out("How the methods compare", "No method gave an estimate.");
    }
    let seeds = dataset.entries.iter().filter_map(|entry| entry.seed).collect::<std::collections::BTreeSet<_>>().len();
    let caption = match seeds {
        0 | 1 => "Left is better. The bar runs from the median error (bar) to the root mean square error (diamond): a long \
                  bar says that few gross errors make up most of the second.",
        _ => "Left is better. Each dot is the RMSE of one seed of the split, the diamond their mean, the bar the mean of \
              the median errors: a long way between bar and diamond says that few gross errors make up most of the RMSE.",
    };
    let mut figure = Figure::new(format!("{}-comparison", dataset.id), "How the methods compare", caption, json!(data));
    figure.columns = 2;
    figure.narrow = narrow;
    figure.with_panels(panels).into()
}

fn comparison_panel(title: &str, methods: &[&Method], width_px: f64) -> Panel {
    const ROW_PX: f64 = 34.0;
    let values = |of: fn(&Entry) -> Option<f64>| {
        methods.iter().flat_map(move |m| m.entries.iter().filter_map(move |e| of(e))).collect::<Vec<f64>>()
    };
    let all: Vec<f64> = values(|e| e.rmse_m).into_iter().chain(values(|e| e.median_m)).filter(|v| *v > 0.0).collect();
    let low = all.iter().copied().fold(f64::INFINITY, f64::min) / 1.25;
    let high = all.iter().copied().fold(0.0, f64::max) * 1.6;
    let x = Axis::new("error [m], logarithmic", Scale::log(low, high));
    let y = Axis::new("", Scale::linear(0.0, methods.len() as f64)).with_ticks([]);
    let mut spec = Spec::new(title, x, y);
    spec.width_px = width_px;
    spec.area_height_px = ROW_PX * methods.len() as f64;
    spec.legend = vec![
        LegendItem::new("RMSE, mean", Key::Diamond(Paint::fill(INK))),
        LegendItem::new("RMSE of a seed", Key::Dot(Paint::fill(FAINT))),
        LegendItem::new("median error", Key::Box(Paint::fill(INK).opacity(0.45))),
    ];
    if methods.iter().all(|method| method.entries.len() == 1) {
        spec.legend.remove(1);
    }
    let mut plot = Plot::new(spec);
    for (i, method) in methods.iter().enumerate() {
        let row = methods.len() as f64 - i as f64 - 0.5;
        let [left, middle] = plot.at([plot.x.low, row]);
        let (Some(rmse_m), Some(median_m)) = (method.mean(|e| e.rmse_m), method.mean(|e| e.median_m)) else { continue };
        // The name stands above its line, so that it may be as long as it is.
        plot.above.haloed_text([left + 4.0, middle - 5.0], &fitted(&method.label, NOTE.size_px, false, width_px - 110.0), NOTE);
        let at = |value: f64| [value, row - 0.16];
        plot.segment(at(median_m), at(rmse_m), Paint::stroke(method.color, 2.0).opacity(0.5));
        let [x, y] = plot.at(at(median_m));
        plot.inside.rect([x - 2.0, y - 6.0], [4.0, 12.0], Paint::fill(method.color).opacity(0.75));
        if method.entries.len() > 1 {
            for entry in &method.entries {
                if let Some(rmse_m) = entry.rmse_m {
                    plot.dot(at(rmse_m), 2.6, Paint::fill(method.color).opacity(0.45));
                }
            }
        }
        let [x, y] = plot.at(at(rmse_m));
        plot.inside.diamond([x, y], 5.5, Paint::fill(method.color));
        let text = format!("{}  ({})", meters(rmse_m), meters(median_m));
        let right = plot.area_at[0] + plot.area_size[0];
        plot.above.haloed_text([right, middle - 5.0], &text, NOTE.anchored(Anchor::End));
    }
    plot.finish()
}

/// Share of the frames with at most such an error.
pub fn distribution(dataset: &Dataset) -> Drawn {
    let (mut panels, mut narrow) = (Vec::new(), Vec::new());
    let mut data = Vec::new();
    for (split, title) in cases(dataset) {
        let all = methods(dataset, split.as_deref());
        let whole = |m: &&Method| m.kind != Kind::Part;
        let parts = |m: &&Method| m.kind == Kind::Part || m.kind == Kind::Whole && m.entries[0].estimator == "single";
        let sets: [(String, Vec<&Method>); 2] = [
            (format!("Methods: {title}"), all.iter().filter(whole).collect()),
            (format!("Feature types: {title}"), all.iter().filter(parts).collect()),
        ];
        for (i, (title, methods)) in sets.into_iter().enumerate() {
            if methods.iter().all(|m| m.sorted_errors_m().is_empty()) || i == 1 && !all.iter().any(|m| m.kind == Kind::Part) {
                continue;
            }
            panels.push(distribution_panel(&title, &methods, HALF_WIDTH_PX));
            narrow.push(distribution_panel(&title, &methods, PANEL_WIDTH_PX));
        }
        for method in &all {
            data.push(json!({
                "split": split,
                "method": method.label,
                "errors_m": method.sorted_errors_m(),
                "frames": frames_of(method),
            }));
        }
    }
    if panels.is_empty() {
        return Drawn::left_out("Distribution of the errors", "No method gave an estimate.");
    }
    let caption = "The curve of a good method is high and to the left: at a given error (across) it has found a large share \
                   of the frames (up). Frames without an estimate count as not found. All seeds together.";
    let mut figure = Figure::new(format!("{}-distribution", dataset.id), "Distribution of the errors", caption, json!(data));
    figure.columns = 2;
    figure.narrow = narrow;
    figure.with_panels(panels).into()
}

/// All frames, those without an estimate too.
fn frames_of(method: &Method) -> usize {
    method.entries.iter().map(|entry| entry.frames.as_ref().map_or(0, Vec::len)).sum()
}

fn distribution_panel(title: &str, methods: &[&Method], width_px: f64) -> Panel {
    let greatest = methods.iter().filter_map(|m| m.sorted_errors_m().last().copied()).fold(0.0, f64::max);
    let mut firsts: Vec<f64> = methods
        .iter()
        .filter_map(|m| {
            let errors_m = m.sorted_errors_m();
            errors_m.get(errors_m.len() / 20).copied()
        })
        .collect();
    firsts.sort_unstable_by(f64::total_cmp);
    let low = firsts.first().copied().unwrap_or(0.1).clamp(0.01, 1.0) / 2.0;
    let x = Axis::new("error [m], logarithmic", Scale::log(low, greatest.max(2.0 * low) * 1.1));
    let percent = [0.0, 0.25, 0.5, 0.75, 1.0].map(|v| (v, format!("{:.0} %", 100.0 * v)));
    let y = Axis::new("share of the test frames", Scale::linear(0.0, 1.0)).with_ticks(percent);
    let mut spec = Spec::new(title, x, y);
    spec.width_px = width_px;
    spec.area_height_px = 260.0;
    let paint = |method: &Method| {
        let paint = Paint::stroke(method.color, if method.kind == Kind::Whole { 2.4 } else { 1.5 });
        method.dashes.map_or(paint, |dashes| paint.dashed(dashes))
    };
    spec.legend = methods.iter().map(|m| LegendItem::new(m.label.clone(), Key::Line(paint(m)))).collect();
    let mut plot = Plot::new(spec);
    // What matters most is drawn last.
    for method in methods.iter().rev() {
        let errors_m = method.sorted_errors_m();
        let n = frames_of(method).max(errors_m.len()).max(1) as f64;
        let mut points = vec![[plot.x.low, errors_m.iter().filter(|&&e| e <= plot.x.low).count() as f64 / n]];
        points.extend(errors_m.iter().enumerate().filter(|(_, e)| **e > plot.x.low).map(|(i, &e)| [e, (i + 1) as f64 / n]));
        points.push([plot.x.high, errors_m.len() as f64 / n]);
        plot.staircase(&points, paint(method));
    }
    plot.finish()
}

/// Share of the frames found within 1, 2, 5 and 10 m.
pub fn recall(dataset: &Dataset) -> Drawn {
    let (mut panels, mut narrow) = (Vec::new(), Vec::new());
    let mut data = Vec::new();
    for (split, title) in cases(dataset) {
        let methods = methods(dataset, split.as_deref());
        let shown: Vec<&Method> = methods.iter().filter(|m| m.kind != Kind::Part && frames_of(m) > 0).collect();
        if shown.is_empty() {
            continue;
        }
        panels.push(recall_panel(&title, &shown, HALF_WIDTH_PX));
        narrow.push(recall_panel(&title, &shown, PANEL_WIDTH_PX));
        for method in &shown {
            data.push(json!({
                "split": split,
                "method": method.label,
                "at_m": RECALL_AT_M,
                "recall": RECALL_AT_M.map(|at_m| recall_at(method, at_m)),
                "frames": frames_of(method),
            }));
        }
    }
    if panels.is_empty() {
        return Drawn::left_out("Recall", "No method gave an estimate.");
    }
    let caption = "Share of all test frames whose estimate is at most so far from the truth; place recognition is usually \
                   measured so. All seeds together.";
    let mut figure = Figure::new(format!("{}-recall", dataset.id), "Recall at 1, 2, 5 and 10 m", caption, json!(data));
    figure.columns = 2;
    figure.narrow = narrow;
    figure.with_panels(panels).into()
}

pub fn recall_at(method: &Method, at_m: f64) -> f64 {
    let found = method.errors().iter().filter(|frame| frame.error_m <= at_m).count();
    found as f64 / frames_of(method).max(1) as f64
}

fn recall_panel(title: &str, methods: &[&Method], width_px: f64) -> Panel {
    const BAR_PX: f64 = 30.0;
    let percent = [0.0, 0.25, 0.5, 0.75, 1.0].map(|v| (v, format!("{:.0} %", 100.0 * v)));
    let x = Axis::new("share of the test frames", Scale::linear(0.0, 1.0)).with_ticks(percent);
    let mut spec = Spec::new(title, x, Axis::new("", Scale::linear(0.0, methods.len() as f64)).with_ticks([]));
    spec.width_px = width_px;
    spec.area_height_px = BAR_PX * methods.len() as f64 + 4.0;
    let shade = |i: usize| [0.25, 0.45, 0.7, 1.0][i];
    // From the widest, so that the strictest lies on top.
    let key = |(i, at_m): (usize, &f64)| {
        LegendItem::new(format!("within {at_m:.0} m"), Key::Box(Paint::fill(INK).opacity(shade(3 - i))))
    };
    spec.legend = RECALL_AT_M.iter().enumerate().map(key).collect();
    let mut plot = Plot::new(spec);
    for (i, method) in methods.iter().enumerate() {
        let row = methods.len() as f64 - i as f64 - 0.5;
        let [left, middle] = plot.at([0.0, row]);
        for (k, &at_m) in RECALL_AT_M.iter().enumerate().rev() {
            let right = plot.x.px(recall_at(method, at_m));
            plot.inside.rect([left, middle + 1.0], [right - left, 8.0], Paint::fill(super::super::chart::color::PAPER));
            plot.inside.rect([left, middle + 1.0], [right - left, 8.0], Paint::fill(method.color).opacity(shade(3 - k)));
        }
        plot.above.haloed_text([left + 2.0, middle - 3.0], &fitted(&method.label, NOTE.size_px, false, width_px - 130.0), NOTE);
        let shares = RECALL_AT_M.map(|at_m| format!("{:.0}", 100.0 * recall_at(method, at_m))).join(" · ");
        let right = plot.area_at[0] + plot.area_size[0];
        plot.above.haloed_text([right, middle - 3.0], &format!("{shares} %"), LABEL.anchored(Anchor::End));
    }
    plot.finish()
}
