//! Is a difference real? Every method against the one the report is about, on the same frames.

use serde_json::json;

use super::errors::cases;
use crate::evaluate::statistics::{Comparison, p_text};
use crate::report::chart::color::{INK, MUTED};
use crate::report::chart::plot::{Axis, Key, LABEL, LegendItem, NOTE, Panel, Plot, Spec};
use crate::report::chart::scale::{Scale, meters, number};
use crate::report::chart::svg::{Anchor, Paint};
use crate::report::chart::text::fitted;
use crate::report::dataset::Dataset;
use crate::report::figure::{Drawn, Figure, capitalized};
use crate::report::methods::{Kind, Method, methods};

struct Compared<'a> {
    label: String,
    color: &'static str,
    comparison: &'a Comparison,
}

pub fn paired(dataset: &Dataset) -> Drawn {
    const TITLE: &str = "Which differences are real";
    let mut shown: Vec<(String, Vec<Compared>)> = Vec::new();
    let mut references: Vec<String> = Vec::new();
    for (split, title) in cases(dataset) {
        let all = methods(dataset, split.as_deref());
        let compared = |method: &Method| {
            let comparison = method.comparison(&dataset.statistics)?;
            let (label, color) = (method.label.clone(), method.color);
            (method.kind != Kind::Nothing).then_some(Compared { label, color, comparison })
        };
        let compared: Vec<Compared> = all.iter().filter_map(compared).collect();
        if let Some(first) = compared.first() {
            references.push(Method::name_of_parts(&first.comparison.reference));
            shown.push((capitalized(&title), compared));
        }
    }
    if shown.is_empty() {
        return Drawn::left_out(TITLE, "There is only one method, and nothing to compare it with.");
    }
    let data: Vec<_> = shown
        .iter()
        .flat_map(|(_, all)| all.iter().map(|one| json!({"method": one.label, "comparison": one.comparison})))
        .collect();
    references.dedup();
    let caption = format!(
        "Mean error of each method minus that of the {}, on the same frames: to the right of zero it is worse. Lines: 95 % of \
         bootstrap draws of stretches of the drive, or of the runs that were held out; none where there is but one. Filled: real, with p below 0.05 after Holm’s correction for all \
         comparisons of the table; hollow: could be chance.",
        references.join(", or the ")
    );
    let figure = Figure::new(format!("{}-paired", dataset.id), TITLE, caption, json!(data));
    figure.halves(|width_px| shown.iter().map(|(title, all)| panel(title, all, width_px)).collect()).into()
}

/// Differences up to this are drawn in proportion, larger ones by their logarithm \[m\].
const LINEAR_M: f64 = 0.1;

fn squeezed(difference_m: f64) -> f64 {
    (difference_m / LINEAR_M).asinh()
}

fn panel(title: &str, all: &[Compared], width_px: f64) -> Panel {
    const ROW_PX: f64 = 32.0;
    let values = || all.iter().map(|one| &one.comparison.mean_difference_m);
    let low = values().map(|estimate| estimate.low.unwrap_or(estimate.value)).fold(-0.2, f64::min);
    let high = values().map(|estimate| estimate.high.unwrap_or(estimate.value)).fold(0.2, f64::max);
    let ticks =
        [-100.0, -10.0, -1.0, -0.1, 0.0, 0.1, 1.0, 10.0, 100.0].into_iter().filter(|v| (low..=high).contains(v));
    let ticks = ticks.map(|v: f64| (squeezed(v), number(v, usize::from(v.abs() < 1.0 && v != 0.0))));
    let margin = 0.04 * (squeezed(high) - squeezed(low));
    let x = Axis::new(
        "mean error larger by [m], logarithmic on either side",
        Scale::linear(squeezed(low) - margin, squeezed(high) + margin),
    );
    let y = Axis::new("", Scale::linear(0.0, all.len() as f64)).with_ticks([]);
    let mut spec = Spec::new(title, x.with_ticks(ticks.collect::<Vec<_>>()), y);
    spec.width_px = width_px;
    spec.area_height_px = ROW_PX * all.len() as f64 + 6.0;
    spec.legend = vec![
        LegendItem::new("real", Key::Dot(Paint::fill(INK))),
        LegendItem::new("could be chance", Key::Dot(Paint::fill("#ffffff").outlined(INK, 1.4))),
        LegendItem::new("95 % interval", Key::Line(Paint::stroke(INK, 2.0))),
    ];
    let mut plot = Plot::new(spec);
    plot.segment([0.0, 0.0], [0.0, all.len() as f64], Paint::stroke(MUTED, 1.2));
    for (i, one) in all.iter().enumerate() {
        let row = all.len() as f64 - i as f64 - 0.68;
        let estimate = &one.comparison.mean_difference_m;
        if let (Some(low), Some(high)) = (estimate.low, estimate.high) {
            plot.segment([squeezed(low), row], [squeezed(high), row], Paint::stroke(one.color, 2.0));
        }
        let dot = match one.comparison.is_real {
            true => Paint::fill(one.color).outlined(one.color, 1.4),
            false => Paint::fill("#ffffff").outlined(one.color, 1.4),
        };
        plot.dot([squeezed(estimate.value), row], 4.0, dot);
        let middle = plot.at([0.0, row + 0.3])[1];
        let left = plot.area_at[0] + 2.0;
        plot.label([left, middle], &fitted(&one.label, NOTE.size_px, false, width_px - 150.0), NOTE);
        let sign = if estimate.value > 0.0 { "+" } else { "" };
        let p = match one.comparison.p_holm.map(p_text) {
            Some(p) if p.starts_with('<') => format!("p {p}"),
            Some(p) => format!("p = {p}"),
            None => "p –".into(),
        };
        let right = plot.area_at[0] + plot.area_size[0];
        let text = format!("{sign}{} m, {p}", meters(estimate.value));
        plot.label([right, middle], &text, LABEL.anchored(Anchor::End));
    }
    plot.finish()
}
