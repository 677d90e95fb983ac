//! Is what the covariance promises true? NEES against χ², and coverage against what was asked for.

use serde_json::json;

use crate::metrics::{nees_bounds, uncertainty_verdict};
use crate::report::chart::color::{FAINT, INK};
use crate::report::chart::plot::{Axis, Key, LABEL, LegendItem, NOTE, Panel, Plot, Spec};
use crate::report::chart::scale::{Scale, number};
use crate::report::chart::svg::{Anchor, Paint};
use crate::report::dataset::Dataset;
use crate::report::figure::{Drawn, Figure};
use crate::report::insight::FrameAnswer;

struct Series<'a> {
    label: String,
    paint: Paint,
    answers: &'a [FrameAnswer],
}

/// Fewer frames than this show nothing of a distribution.
const MIN_FRAMES: usize = 8;
/// 1.96 standard deviations hold 95 %.
const BAND_DEVIATIONS: f64 = 1.96;

pub fn reliability(dataset: &Dataset) -> Drawn {
    const TITLE: &str = "Reliability of the stated uncertainty";
    let series = series(dataset);
    if series.is_empty() {
        return Drawn::left_out(TITLE, format!("Fewer than {MIN_FRAMES} frames have an estimate with a covariance."));
    }
    let data = series.iter().map(|series| {
        let mut nees: Vec<f64> = series.answers.iter().map(|a| a.nees).collect();
        let mut levels: Vec<f64> = series.answers.iter().map(|a| a.credible_level).collect();
        nees.sort_unstable_by(f64::total_cmp);
        levels.sort_unstable_by(f64::total_cmp);
        let bounds = nees_bounds(nees.len());
        json!({
            "estimates": series.label,
            "frames": nees.len(),
            "nees_mean": mean_nees(series),
            "nees_median": nees[nees.len() / 2],
            "nees_mean_bounds_95": bounds,
            "nees": nees,
            "credible_level": levels,
            "coverage_50": coverage(&levels, 0.5),
            "coverage_90": coverage(&levels, 0.9),
            "coverage_95": coverage(&levels, 0.95),
            "verdict": uncertainty_verdict(coverage(&levels, 0.95), Some(mean_nees(series)), levels.len()),
        })
    });
    let data: Vec<_> = data.collect();
    let verdicts: Vec<String> = series.iter().map(verdict).collect();
    let caption = format!(
        "Regions that should hold the truth in 95 % of the frames hold it in {}. The words judge by that share and by the mean NEES, each \
         against what chance leaves to independent frames. Left: a curve on the dashed line keeps its promise; below it the regions \
         are too small (over-confident), above it too large. Right: the normalised error squared should follow χ² with two \
         degrees of freedom, of median 1.4 and mean 2; a curve further right is over-confident, further left too cautious. \
         Gray: where 95 % of such curves lie by chance.",
        verdicts.join(", ")
    );
    let figure = Figure::new(format!("{}-reliability", dataset.id), TITLE, caption, json!(data));
    figure.with_panels(vec![coverage_panel(&series), nees_panel(&series), table_panel(&series)]).into()
}

fn series(dataset: &Dataset) -> Vec<Series<'_>> {
    use crate::report::chart::color::{BLUE, VERMILION};
    use crate::report::methods::{FILTERED, SMOOTHED};
    let of_insights = dataset.insights.iter().map(|insight| {
        let color = if insight.recipe == "paper" { VERMILION } else { BLUE };
        let (label, is_first) = match &insight.split {
            Some((split, _)) => (format!("{}, {split}", insight.recipe), dataset.splits[0].name == *split),
            None => ("single frames".into(), true),
        };
        let paint = Paint::stroke(color, 2.0);
        Series { label, paint: if is_first { paint } else { paint.dashed("5 3") }, answers: &insight.frames }
    });
    let of_sequences = dataset.sequences.iter().map(|sequence| {
        let paint = match sequence.estimator {
            "filtered" => Paint::stroke(FILTERED, 2.0).dashed("12 3"),
            _ => Paint::stroke(SMOOTHED, 2.0).dashed("5 2"),
        };
        Series { label: sequence.estimator.into(), paint, answers: &sequence.answers }
    });
    of_insights.chain(of_sequences).filter(|series| series.answers.len() >= MIN_FRAMES).collect()
}

/// As in `93 % of 378 (filtered: as stated)`.
fn verdict(series: &Series) -> String {
    let levels: Vec<f64> = series.answers.iter().map(|a| a.credible_level).collect();
    let covered = coverage(&levels, 0.95);
    format!(
        "{} % of {} ({}: {})",
        number(100.0 * covered, 0),
        levels.len(),
        series.label,
        uncertainty_verdict(covered, Some(mean_nees(series)), levels.len())
    )
}

fn mean_nees(series: &Series) -> f64 {
    series.answers.iter().map(|a| a.nees).sum::<f64>() / series.answers.len() as f64
}

fn coverage(levels: &[f64], nominal: f64) -> f64 {
    levels.iter().filter(|&&level| level < nominal).count() as f64 / levels.len() as f64
}

fn legend(series: &[Series]) -> Vec<LegendItem> {
    series.iter().map(|series| LegendItem::new(series.label.clone(), Key::Line(series.paint))).collect()
}

fn coverage_panel(all: &[Series]) -> Panel {
    let percent = || [0.0, 0.25, 0.5, 0.75, 1.0].map(|v| (v, format!("{:.0} %", 100.0 * v)));
    let x = Axis::new("probability asked for", Scale::linear(0.0, 1.0)).with_ticks(percent());
    let y = Axis::new("share of the frames in the region", Scale::linear(0.0, 1.0)).with_ticks(percent());
    let mut spec = Spec::new("Coverage", x, y);
    spec.area_height_px = 300.0;
    spec.legend = legend(all);
    let mut plot = Plot::new(spec);
    let least = all.iter().map(|series| series.answers.len()).min().unwrap_or(1) as f64;
    let nominal: Vec<f64> = (0..=50).map(|i| f64::from(i) / 50.0).collect();
    let half = |p: f64| BAND_DEVIATIONS * (p * (1.0 - p) / least).sqrt();
    let lower: Vec<_> = nominal.iter().map(|&p| [p, (p - half(p)).max(0.0)]).collect();
    let upper: Vec<_> = nominal.iter().map(|&p| [p, (p + half(p)).min(1.0)]).collect();
    plot.band(&lower, &upper, Paint::fill(FAINT).opacity(0.3));
    plot.curve(&[[0.0, 0.0], [1.0, 1.0]], Paint::stroke(INK, 1.2).dashed("4 3"));
    for series in all.iter().rev() {
        let mut levels: Vec<f64> = series.answers.iter().map(|a| a.credible_level).collect();
        levels.sort_unstable_by(f64::total_cmp);
        let n = levels.len() as f64;
        let mut points = vec![[0.0, 0.0]];
        points.extend(levels.iter().enumerate().map(|(i, &level)| [level, (i + 1) as f64 / n]));
        points.push([1.0, 1.0]);
        plot.staircase(&points, series.paint);
    }
    plot.note([0.98, 0.0], [0.0, -8.0], "over-confident", LABEL.anchored(Anchor::End));
    plot.note([0.02, 1.0], [0.0, 16.0], "too cautious", LABEL);
    plot.finish()
}

fn nees_panel(all: &[Series]) -> Panel {
    let greatest =
        all.iter().flat_map(|s| s.answers.iter().map(|a| a.nees)).filter(|v| v.is_finite()).fold(10.0, f64::max);
    let x = Axis::new("NEES, eᵀP⁻¹e, logarithmic".replace("ᵀ", "′"), Scale::log(0.05, greatest.min(1e4) * 1.2));
    let percent = [0.0, 0.25, 0.5, 0.75, 1.0].map(|v| (v, format!("{:.0} %", 100.0 * v)));
    let y = Axis::new("share of the frames below", Scale::linear(0.0, 1.0)).with_ticks(percent);
    let mut spec = Spec::new("NEES against χ² with 2 degrees of freedom", x, y);
    spec.area_height_px = 300.0;
    spec.legend = legend(all);
    spec.legend.push(LegendItem::new("χ²(2)", Key::Line(Paint::stroke(INK, 1.2).dashed("4 3"))));
    let mut plot = Plot::new(spec);
    let least = all.iter().map(|series| series.answers.len()).min().unwrap_or(1) as f64;
    let values: Vec<f64> =
        (0..=80).map(|i| plot.x.low * (plot.x.high / plot.x.low).powf(f64::from(i) / 80.0)).collect();
    let below = |v: f64| 1.0 - (-0.5 * v).exp();
    let half = |p: f64| BAND_DEVIATIONS * (p * (1.0 - p) / least).sqrt();
    let lower: Vec<_> = values.iter().map(|&v| [v, (below(v) - half(below(v))).max(0.0)]).collect();
    let upper: Vec<_> = values.iter().map(|&v| [v, (below(v) + half(below(v))).min(1.0)]).collect();
    plot.band(&lower, &upper, Paint::fill(FAINT).opacity(0.3));
    plot.curve(&values.iter().map(|&v| [v, below(v)]).collect::<Vec<_>>(), Paint::stroke(INK, 1.2).dashed("4 3"));
    for series in all.iter().rev() {
        let mut nees: Vec<f64> = series.answers.iter().map(|a| a.nees).collect();
        nees.sort_unstable_by(f64::total_cmp);
        let n = nees.len() as f64;
        let low = plot.x.low;
        let mut points = vec![[low, nees.iter().filter(|v| **v <= low).count() as f64 / n]];
        points.extend(nees.iter().enumerate().filter(|(_, v)| **v > low).map(|(i, &v)| [v, (i + 1) as f64 / n]));
        points.push([plot.x.high, nees.iter().filter(|v| **v <= plot.x.high).count() as f64 / n]);
        plot.staircase(&points, series.paint);
    }
    plot.finish()
}

/// The same in numbers.
fn table_panel(all: &[Series]) -> Panel {
    const ROW_PX: f64 = 24.0;
    let x = Axis::new("", Scale::linear(0.0, 1.0)).with_ticks([]);
    let mut spec = Spec::new("In numbers", x, Axis::new("", Scale::linear(0.0, 1.0)).with_ticks([]));
    spec.area_height_px = ROW_PX * (all.len() as f64 + 2.0) + 10.0;
    let mut plot = Plot::new(spec);
    let (left, top) = (0.0, plot.area_at[1]);
    let columns = [150.0, 198.0, 246.0, 302.0, 362.0];
    for (at, text) in columns.iter().zip(["frames", "in 50 %", "in 95 %", "NEES", "expected"]) {
        plot.above.text([*at, top + 8.0], text, LABEL.anchored(Anchor::End));
    }
    for (i, series) in all.iter().enumerate() {
        let y = top + ROW_PX * (i as f64 + 1.0) + 8.0;
        let mut levels: Vec<f64> = series.answers.iter().map(|a| a.credible_level).collect();
        levels.sort_unstable_by(f64::total_cmp);
        let mean = mean_nees(series);
        let [low, high] = nees_bounds(levels.len());
        let percent = |nominal: f64| format!("{:.0} %", 100.0 * coverage(&levels, nominal));
        let cells = [
            number(levels.len() as f64, 0),
            percent(0.5),
            percent(0.95),
            number(mean, if mean < 100.0 { 1 } else { 0 }),
            format!("{}–{}", number(low, 1), number(high, 1)),
        ];
        plot.above.line([left, y - 5.0], [left + 12.0, y - 5.0], series.paint);
        plot.above.text(
            [left + 16.0, y - 1.0],
            &crate::report::chart::text::fitted(&series.label, 11.0, false, 100.0),
            NOTE,
        );
        for (at, text) in columns.iter().zip(cells) {
            plot.above.text([*at, y - 1.0], &text, NOTE.anchored(Anchor::End));
        }
    }
    let y = top + ROW_PX * (all.len() as f64 + 1.0) + 12.0;
    plot.above.text([left, y], "NEES: mean; expected: where 95 % of such means lie", LABEL);
    let bottom = plot.area_at[1] + plot.area_size[1];
    plot.above.line(
        [plot.area_at[0], bottom],
        [plot.area_at[0] + plot.area_size[0], bottom],
        Paint::stroke("#ffffff", 3.0),
    );
    plot.finish()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn coverage_counts_what_lies_inside() {
        assert_eq!(coverage(&[0.1, 0.4, 0.9, 0.99], 0.5), 0.5);
        assert_eq!(coverage(&[0.1, 0.4, 0.9, 0.99], 0.95), 0.75);
    }
}
