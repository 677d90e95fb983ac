//! How large the errors are: methods side by side, their distribution, and recall.

use serde_json::json;

use crate::evaluate::Entry;
use crate::report::chart::color::{FAINT, INK, PAPER};
use crate::report::chart::plot::{Axis, Key, LABEL, LegendItem, NOTE, Panel, Plot, Spec};
use crate::report::chart::scale::{Scale, meters};
use crate::report::chart::svg::{Anchor, Paint};
use crate::report::chart::text::fitted;
use crate::report::dataset::Dataset;
use crate::report::figure::{Drawn, Figure, capitalized};
use crate::report::methods::{Kind, Method, methods};

/// Distances at which a frame counts as found in the tables \[m\].
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

/// A case and its methods.
fn methods_of_cases<'a>(dataset: &'a Dataset, shown: impl Fn(&Method) -> bool) -> Vec<(String, Vec<Method<'a>>)> {
    let of_case = |(split, title): (Option<String>, String)| {
        let mut methods = methods(dataset, split.as_deref());
        methods.retain(|method| shown(method) && !method.answers_labels());
        (capitalized(&title), methods)
    };
    cases(dataset).into_iter().map(of_case).filter(|(_, methods)| !methods.is_empty()).collect()
}

/// RMSE and median of every method, every seed a dot.
pub fn comparison(dataset: &Dataset) -> Drawn {
    const TITLE: &str = "How the methods compare";
    let shown = methods_of_cases(dataset, |method| method.mean(|entry| entry.rmse_m).is_some());
    if shown.is_empty() {
        return Drawn::left_out(TITLE, "No method gave an estimate.");
    }
    let of_method = |method: &Method| {
        json!({
            "split": method.entries[0].split,
            "method": method.label,
            "seeds": method.entries.iter().map(|entry| entry.seed).collect::<Vec<_>>(),
            "rmse_m": method.entries.iter().map(|entry| entry.rmse_m).collect::<Vec<_>>(),
            "median_m": method.entries.iter().map(|entry| entry.median_m).collect::<Vec<_>>(),
            "rmse_mean_m": method.mean(|entry| entry.rmse_m),
            "median_mean_m": method.mean(|entry| entry.median_m),
            "rmse_interval_m": interval(dataset, method),
        })
    };
    let data: Vec<_> = shown.iter().flat_map(|(_, methods)| methods.iter().map(of_method)).collect();
    let caption = if shown.iter().all(|(_, methods)| methods.iter().all(|method| method.entries.len() == 1)) {
        "Left is better. The line runs from the median error (bar) to the root mean square error (diamond): a long line says \
         that few gross errors make up most of the second. Black: the interval that holds 95 % of bootstrap draws of \
         stretches of the drive."
    } else {
        "Left is better. Each dot is the RMSE of one seed of the split, the diamond their mean, the bar the mean of the \
         median errors: a long way between bar and diamond says that few gross errors make up most of the RMSE. Black: the \
         interval that holds 95 % of bootstrap draws of stretches of the drive and of seeds."
    };
    let figure = Figure::new(format!("{}-comparison", dataset.id), TITLE, caption, json!(data));
    let panel = |width_px: f64| {
        let of_case =
            |(title, methods): &(String, Vec<Method>)| comparison_panel(dataset, title, &refs(methods), width_px);
        shown.iter().map(of_case).collect()
    };
    figure.halves(panel).into()
}

/// The bootstrap interval of the RMSE \[m\].
fn interval(dataset: &Dataset, method: &Method) -> Option<[f64; 2]> {
    method
        .statistics(&dataset.statistics)
        .and_then(|statistics| Some([statistics.rmse_m.low?, statistics.rmse_m.high?]))
}

fn refs<'b, 'a>(methods: &'b [Method<'a>]) -> Vec<&'b Method<'a>> {
    methods.iter().collect()
}

fn comparison_panel(dataset: &Dataset, title: &str, methods: &[&Method], width_px: f64) -> Panel {
    const ROW_PX: f64 = 34.0;
    let values = |of: fn(&Entry) -> Option<f64>| {
        methods.iter().flat_map(move |m| m.entries.iter().filter_map(move |e| of(e))).collect::<Vec<f64>>()
    };
    let all: Vec<f64> = values(|e| e.rmse_m).into_iter().chain(values(|e| e.median_m)).filter(|v| *v > 0.0).collect();
    let low = all.iter().copied().fold(f64::INFINITY, f64::min) / 1.25;
    let high = all.iter().copied().fold(0.0, f64::max) * 1.6;
    let x = Axis::new("error [m], logarithmic", Scale::log(low, high));
    let y = Axis::new("", Scale::linear(0.0, methods.len() as f64)).with_ticks([]);
    let mut spec = Spec::new(format!("{title}: RMSE (median)"), x, y);
    spec.width_px = width_px;
    spec.area_height_px = ROW_PX * methods.len() as f64 + 6.0;
    spec.legend = vec![
        LegendItem::new("RMSE", Key::Diamond(Paint::fill(INK))),
        LegendItem::new("of a seed", Key::Dot(Paint::fill(FAINT))),
        LegendItem::new("95 % interval", Key::Line(Paint::stroke(INK, 1.2))),
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
        let label = fitted(&method.label, NOTE.size_px, false, width_px - 110.0);
        plot.label([left + 4.0, middle - 5.0], &label, NOTE);
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
        if let Some([low, high]) = interval(dataset, method) {
            let ends = [low, high].map(|value| plot.at(at(value)));
            plot.inside.line(ends[0], ends[1], Paint::stroke(INK, 1.2));
            for [x, y] in ends {
                plot.inside.line([x, y - 3.5], [x, y + 3.5], Paint::stroke(INK, 1.2));
            }
        }
        let [x, y] = plot.at(at(rmse_m));
        plot.inside.diamond([x, y], 5.5, Paint::fill(method.color));
        let text = format!("{}  ({})", meters(rmse_m), meters(median_m));
        let right = plot.area_at[0] + plot.area_size[0];
        plot.label([right, middle - 5.0], &text, NOTE.anchored(Anchor::End));
    }
    plot.finish()
}

/// Share of the frames with at most such an error.
pub fn distribution(dataset: &Dataset) -> Drawn {
    const TITLE: &str = "Distribution of the errors";
    let shown = methods_of_cases(dataset, |method| frames_of(method) > 0);
    if shown.is_empty() {
        return Drawn::left_out(TITLE, "No method gave an estimate.");
    }
    let of_method = |method: &Method| {
        json!({
            "split": method.entries[0].split,
            "method": method.label,
            "errors_m": method.sorted_errors_m(),
            "frames": frames_of(method),
        })
    };
    let data: Vec<_> = shown.iter().flat_map(|(_, methods)| methods.iter().map(of_method)).collect();
    let whole = |method: &&Method| method.kind != Kind::Part;
    let is_single = |method: &Method| method.entries[0].estimator == "single";
    let parts = |method: &&Method| method.kind == Kind::Part || method.kind == Kind::Whole && is_single(method);
    let has_parts = shown.iter().any(|(_, methods)| methods.iter().any(|method| method.kind == Kind::Part));
    let panels = |width_px: f64| {
        let mut panels = Vec::new();
        for (title, methods) in &shown {
            panels.push(distribution_panel(title, &methods.iter().filter(whole).collect::<Vec<_>>(), width_px));
        }
        for (title, methods) in shown.iter().filter(|_| has_parts) {
            let title = format!("{title}: feature types");
            panels.push(distribution_panel(&title, &methods.iter().filter(parts).collect::<Vec<_>>(), width_px));
        }
        panels
    };
    let caption = "The curve of a good method is high and to the left: at a given error (across) it has found a large share \
                   of the frames (up). Frames without an estimate count as not found. All seeds together.";
    let figure = Figure::new(format!("{}-distribution", dataset.id), TITLE, caption, json!(data));
    figure.halves(panels).into()
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
            // Errors of labels may be zero.
            errors_m.get(errors_m.len() / 20).copied().filter(|error_m| *error_m > 0.0)
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
        points.extend(
            errors_m.iter().enumerate().filter(|(_, e)| **e > plot.x.low).map(|(i, &e)| [e, (i + 1) as f64 / n]),
        );
        points.push([plot.x.high, errors_m.len() as f64 / n]);
        plot.staircase(&points, paint(method));
    }
    plot.finish()
}

/// Share of the frames found within some distances.
pub fn recall(dataset: &Dataset) -> Drawn {
    const TITLE: &str = "Recall";
    let at_m = dataset.yardstick().recall_m;
    let shown = methods_of_cases(dataset, |method| method.kind != Kind::Part && frames_of(method) > 0);
    if shown.is_empty() {
        return Drawn::left_out(TITLE, "No method gave an estimate.");
    }
    let of_method = |method: &Method| {
        json!({
            "split": method.entries[0].split,
            "method": method.label,
            "at_m": at_m,
            "recall": at_m.map(|at_m| recall_at(method, at_m)),
            "frames": frames_of(method),
        })
    };
    let data: Vec<_> = shown.iter().flat_map(|(_, methods)| methods.iter().map(of_method)).collect();
    let [a, b, c, d] = at_m;
    let caption = format!(
        "Share of all test frames whose estimate is within {a}, {b}, {c} and {d} m of the truth, from the darkest part of \
         each bar to the lightest; place recognition is usually measured so. All seeds together."
    );
    let figure = Figure::new(format!("{}-recall", dataset.id), TITLE, caption, json!(data));
    let panels = |width_px: f64| {
        let of_case = |(title, methods): &(String, Vec<Method>)| recall_panel(title, &refs(methods), at_m, width_px);
        shown.iter().map(of_case).collect()
    };
    figure.halves(panels).into()
}

pub fn recall_at(method: &Method, at_m: f64) -> f64 {
    let found = method.errors().iter().filter(|frame| frame.error_m <= at_m).count();
    found as f64 / frames_of(method).max(1) as f64
}

fn recall_panel(title: &str, methods: &[&Method], at_m: [f64; 4], width_px: f64) -> Panel {
    const BAR_PX: f64 = 30.0;
    let percent = [0.0, 0.25, 0.5, 0.75, 1.0].map(|v| (v, format!("{:.0} %", 100.0 * v)));
    let x = Axis::new("share of the test frames", Scale::linear(0.0, 1.0)).with_ticks(percent);
    let mut spec = Spec::new(title, x, Axis::new("", Scale::linear(0.0, methods.len() as f64)).with_ticks([]));
    spec.width_px = width_px;
    spec.area_height_px = BAR_PX * methods.len() as f64 + 4.0;
    let shade = |i: usize| [0.25, 0.45, 0.7, 1.0][i];
    // From the widest, so that the strictest lies on top.
    let key = |(i, at_m): (usize, &f64)| {
        LegendItem::new(format!("within {at_m} m"), Key::Box(Paint::fill(INK).opacity(shade(3 - i))))
    };
    spec.legend = at_m.iter().enumerate().map(key).collect();
    let mut plot = Plot::new(spec);
    for (i, method) in methods.iter().enumerate() {
        let row = methods.len() as f64 - i as f64 - 0.5;
        let [left, middle] = plot.at([0.0, row]);
        for (k, &at_m) in at_m.iter().enumerate().rev() {
            let right = plot.x.px(recall_at(method, at_m));
            plot.inside.rect([left, middle + 1.0], [right - left, 8.0], Paint::fill(PAPER));
            plot.inside.rect(
                [left, middle + 1.0],
                [right - left, 8.0],
                Paint::fill(method.color).opacity(shade(3 - k)),
            );
        }
        let label = fitted(&method.label, NOTE.size_px, false, width_px - 130.0);
        plot.label([left + 2.0, middle - 3.0], &label, NOTE);
        let shares = at_m.map(|at_m| format!("{:.0}", 100.0 * recall_at(method, at_m))).join(" · ");
        let right = plot.area_at[0] + plot.area_size[0];
        plot.label([right, middle - 3.0], &format!("{shares} %"), LABEL.anchored(Anchor::End));
    }
    plot.finish()
}
