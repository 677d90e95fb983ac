//! A drive against a map, second by second: state, error, and what deviation was stated.

use serde_json::json;

use super::time_s;
use crate::report::chart::color::{FAINT, MUTED, ORANGE, SKY, VERMILION};
use crate::report::chart::plot::{Axis, Key, LABEL, LegendItem, PANEL_WIDTH_PX, Panel, Plot, Spec};
use crate::report::chart::scale::Scale;
use crate::report::chart::svg::{Paint, Shapes};
use crate::report::dataset::{Dataset, ShownSequence};
use crate::report::figure::{Drawn, Figure};
use crate::report::insight::FrameAnswer;
use crate::report::methods::{FILTERED, SMOOTHED};
use crate::types::LocalizationState;

const WIDE_PX: f64 = 1136.0;

pub fn timeline(dataset: &Dataset) -> Drawn {
    const TITLE: &str = "The drive, second by second";
    if dataset.map.is_none() {
        let why = "Test frames of a split are not consecutive. omniloc evaluate --map takes a whole drive, frame after frame, as \
                   the vehicle does.";
        return Drawn::left_out(TITLE, why);
    }
    let Some(filtered) = dataset.sequences.iter().find(|sequence| sequence.estimator == "filtered") else {
        return Drawn::left_out(
            TITLE,
            "It is not known when the frames were taken, so there is no order to filter them in.",
        );
    };
    if dataset.frames.iter().any(|frame| frame.time_s.is_none()) {
        return Drawn::left_out(TITLE, "It is not known when the frames were taken.");
    }
    let data = json!({
        "time_s": (0..dataset.frames.len()).map(|row| time_s(&dataset.frames, row)).collect::<Vec<_>>(),
        "index": dataset.frames.iter().map(|frame| frame.index).collect::<Vec<_>>(),
        "state": filtered.states,
        "single": dataset.insights[0].frames.iter().map(|a| json!([a.index, a.error_m()])).collect::<Vec<_>>(),
        "filtered": filtered.answers.iter().map(point_json).collect::<Vec<_>>(),
        "smoothed": dataset.sequences.iter().find(|s| s.estimator == "smoothed")
            .map(|s| s.answers.iter().map(point_json).collect::<Vec<_>>()),
    });
    let caption = "Top: what the localizer says of itself; a position is given only while it is localized. Below: the error \
                   of single frames (gray dots), of the filter (line) and of the smoother, and the region in which the \
                   filter says the truth lies with 95 % (shaded: its radius). The line should stay inside the shade.";
    let mut figure = Figure::new(format!("{}-timeline", dataset.id), TITLE, caption, data);
    figure.columns = 1;
    figure.narrow = vec![panel(dataset, filtered, PANEL_WIDTH_PX)];
    figure.with_panels(vec![panel(dataset, filtered, WIDE_PX)]).into()
}

/// Number, error and radius of the 95 % region \[m\].
fn point_json(answer: &FrameAnswer) -> serde_json::Value {
    json!([answer.index, answer.error_m(), radius_95_m(answer)])
}

/// Radius of the circle of the same area as the 95 % ellipse.
fn radius_95_m(answer: &FrameAnswer) -> f64 {
    let ([a, b], _) = crate::report::chart::map_plot::ellipse_m(&answer.covariance, 0.95);
    (a * b).sqrt()
}

/// The radius that nearly all regions stay below, so that the shade fits in.
fn usual_radius_m(answers: &[FrameAnswer]) -> f64 {
    let mut radii_m: Vec<f64> = answers.iter().map(radius_95_m).collect();
    radii_m.sort_unstable_by(f64::total_cmp);
    radii_m.get(radii_m.len() * 49 / 50).copied().unwrap_or(1.0)
}

/// Where the axis begins: errors below it are drawn on it.
fn lowest_m(answers: &[FrameAnswer]) -> f64 {
    let mut errors_m: Vec<f64> = answers.iter().map(FrameAnswer::error_m).collect();
    errors_m.sort_unstable_by(f64::total_cmp);
    errors_m.get(errors_m.len() / 20).map_or(0.05, |error_m| error_m.clamp(0.005, 0.1))
}

fn state_color(state: LocalizationState) -> &'static str {
    match state {
        LocalizationState::Unknown => FAINT,
        LocalizationState::Candidate => ORANGE,
        LocalizationState::Localized => SKY,
        LocalizationState::Lost => VERMILION,
    }
}

fn panel(dataset: &Dataset, filtered: &ShownSequence, width_px: f64) -> Panel {
    const BAND_PX: f64 = 12.0;
    let times: Vec<f64> = (0..dataset.frames.len()).filter_map(|row| time_s(&dataset.frames, row)).collect();
    let end_s = times.last().copied().unwrap_or(1.0);
    let single = &dataset.insights[0].frames;
    let all = single.iter().chain(&filtered.answers).map(FrameAnswer::error_m);
    let (low, high) = (lowest_m(single), all.fold(usual_radius_m(&filtered.answers), f64::max) * 1.3);
    let x = Axis::new("time since the first frame [s]", Scale::linear(0.0, end_s));
    let y = Axis::new("error [m], logarithmic", Scale::log(low, high));
    let mut spec = Spec::new("State, error and stated deviation", x, y);
    spec.width_px = width_px;
    spec.area_height_px = 280.0;
    let states = [
        LocalizationState::Unknown,
        LocalizationState::Candidate,
        LocalizationState::Localized,
        LocalizationState::Lost,
    ];
    let has_state = |state: &&LocalizationState| filtered.states.contains(&Some(state.name()));
    spec.legend = vec![
        LegendItem::new("single frames", Key::Dot(Paint::fill(MUTED).opacity(0.6))),
        LegendItem::new("filtered", Key::Line(Paint::stroke(FILTERED, 2.0))),
        LegendItem::new("95 % region of the filter", Key::Box(Paint::fill(FILTERED).opacity(0.2))),
        LegendItem::new("smoothed", Key::Line(Paint::stroke(SMOOTHED, 1.4).dashed("5 2"))),
    ];
    spec.legend.extend(
        states
            .iter()
            .filter(has_state)
            .map(|state| LegendItem::new(state.name(), Key::Box(Paint::fill(state_color(*state))))),
    );
    let mut plot = Plot::new(spec);
    // Runs of frames that follow one another.
    let runs = |answers: &'_ [FrameAnswer]| -> Vec<Vec<FrameAnswer>> {
        let mut runs: Vec<Vec<FrameAnswer>> = Vec::new();
        for answer in answers {
            match runs.last_mut() {
                Some(run) if run[run.len() - 1].row + 1 == answer.row => run.push(*answer),
                _ => runs.push(vec![*answer]),
            }
        }
        runs
    };
    for run in runs(&filtered.answers) {
        let upper: Vec<_> = run.iter().map(|a| [times[a.row], radius_95_m(a)]).collect();
        let lower: Vec<_> = run.iter().map(|a| [times[a.row], low]).collect();
        plot.band(&lower, &upper, Paint::fill(FILTERED).opacity(0.16));
    }
    for answer in single {
        plot.dot([times[answer.row], answer.error_m().max(low)], 1.6, Paint::fill(MUTED).opacity(0.6));
    }
    let smoothed = dataset.sequences.iter().find(|sequence| sequence.estimator == "smoothed");
    for (sequence, paint) in
        [(smoothed, Paint::stroke(SMOOTHED, 1.4).dashed("5 2")), (Some(filtered), Paint::stroke(FILTERED, 2.0))]
    {
        for run in sequence.map(|sequence| runs(&sequence.answers)).unwrap_or_default() {
            let points: Vec<_> = run.iter().map(|a| [times[a.row], a.error_m().max(low)]).collect();
            plot.curve(&points, paint);
        }
    }
    let mut band = Shapes::default();
    let top = plot.area_at[1];
    for (row, state) in filtered.states.iter().enumerate() {
        let (from, to) = (plot.x.px(times[row]), plot.x.px(times.get(row + 1).copied().unwrap_or(end_s)));
        if let Some(state) = states.iter().find(|known| Some(known.name()) == *state) {
            band.rect([from, top], [(to - from).max(0.5) + 0.3, BAND_PX], Paint::fill(state_color(*state)));
        }
    }
    plot.inside.append(&band);
    let localized = filtered.states.iter().filter(|state| **state == Some(LocalizationState::Localized.name())).count();
    let text =
        format!("{:.0} % of the frames localized", 100.0 * localized as f64 / filtered.states.len().max(1) as f64);
    let at = [plot.area_at[0] + 6.0, top + BAND_PX + 14.0];
    plot.above.haloed_text(at, &text, LABEL);
    plot.finish()
}
