//! What removing features one by one does to the error: on the frames it was decided on, and on others.

use serde_json::json;

use crate::report::chart::color::{BLUE, INK, VERMILION};
use crate::report::chart::plot::{Axis, Key, LABEL, LegendItem, Panel, Plot, Spec};
use crate::report::chart::scale::Scale;
use crate::report::chart::svg::{Anchor, Paint};
use crate::report::dataset::{Dataset, EliminationRun};
use crate::report::figure::{Drawn, Figure, capitalized};
use crate::report::methods::feature_name;

pub fn elimination(dataset: &Dataset) -> Drawn {
    const TITLE: &str = "Backward elimination";
    let Some(first) = dataset.eliminations.first() else {
        let why = match &dataset.map {
            Some(_) => {
                "A map holds the features that were kept, not how the others were removed: omniloc evaluate without --map \
                        shows that."
            }
            None => "No recipe that was run removes features one by one.",
        };
        return Drawn::left_out(TITLE, why);
    };
    let mut types: Vec<&str> = Vec::new();
    let of_split: Vec<&EliminationRun> = dataset.eliminations.iter().filter(|run| run.split == first.split).collect();
    for run in &of_split {
        if !types.contains(&run.features.as_str()) {
            types.push(&run.features);
        }
    }
    let panels = |width_px: f64| {
        let of_type = |features: &&str| {
            let runs: Vec<&EliminationRun> = of_split.iter().copied().filter(|run| run.features == *features).collect();
            panel(features, &runs, width_px)
        };
        types.iter().map(of_type).collect()
    };
    let data = dataset.eliminations.iter().map(|run| {
        let all = run.validation_rmse_m.len() - 1;
        json!({
            "features": run.features,
            "split": run.split,
            "seed": run.seed,
            "kept": run.kept,
            "features_left": (0..=all).map(|removed| all - removed).collect::<Vec<_>>(),
            "validation_rmse_m": run.validation_rmse_m,
            "test_rmse_m": run.test_rmse_m,
        })
    });
    let caption = format!(
        "From all features (left) to none (right). The features are chosen where the validation error (blue) is least; \
         whether that was worth it shows in the test error (orange), on frames that had no part in the choice. Thin: single \
         seeds of the {} split; thick: their mean; rings: the number kept.",
        first.split
    );
    let figure = Figure::new(format!("{}-elimination", dataset.id), TITLE, caption, json!(data.collect::<Vec<_>>()));
    figure.responsive(panels).into()
}

fn panel(features: &str, runs: &[&EliminationRun], width_px: f64) -> Panel {
    let most = runs.iter().map(|run| run.validation_rmse_m.len() - 1).max().unwrap_or(1) as f64;
    let greatest =
        runs.iter().flat_map(|run| run.validation_rmse_m.iter().chain(&run.test_rmse_m)).copied().fold(0.0, f64::max);
    // From many to few.
    let x = Axis::new("features kept", Scale::linear(-most, 0.0));
    let ticks = Scale::linear(0.0, most).ticks(5).into_iter().map(|tick| (-tick.value, tick.label));
    let x = x.with_ticks(ticks.collect::<Vec<_>>().into_iter().rev());
    let y = Axis::new("RMSE [m]", Scale::linear(0.0, 1.08 * greatest));
    let mut spec = Spec::new(capitalized(&feature_name(features)), x, y);
    spec.width_px = width_px;
    spec.area_height_px = 240.0;
    spec.legend = vec![
        LegendItem::new("validation", Key::Line(Paint::stroke(BLUE, 2.4))),
        LegendItem::new("test", Key::Line(Paint::stroke(VERMILION, 2.4))),
        LegendItem::new("kept", Key::Dot(Paint::fill("#ffffff").outlined(INK, 1.4))),
    ];
    let mut plot = Plot::new(spec);
    let of = |run: &EliminationRun, values: &[f64]| -> Vec<[f64; 2]> {
        let all = run.validation_rmse_m.len() - 1;
        values.iter().enumerate().map(|(removed, &rmse_m)| [-((all - removed) as f64), rmse_m]).collect()
    };
    type Pick = fn(&EliminationRun) -> &[f64];
    let sets: [(Pick, &str); 2] = [(|run| &run.validation_rmse_m, BLUE), (|run| &run.test_rmse_m, VERMILION)];
    for (pick, color) in sets {
        let (thin, thick) = (if runs.len() > 1 { 0.7 } else { 2.2 }, 2.4);
        for run in runs {
            plot.curve(&of(run, pick(run)), Paint::stroke(color, thin).opacity(if runs.len() > 1 { 0.4 } else { 1.0 }));
        }
        if runs.len() > 1 {
            // By the number left, where every seed has as many.
            let least = runs.iter().map(|run| pick(run).len()).min().unwrap_or(0);
            let mean = (0..least).rev().map(|left| {
                let at = |run: &&EliminationRun| pick(run)[pick(run).len() - 1 - left];
                [-(left as f64), runs.iter().map(at).sum::<f64>() / runs.len() as f64]
            });
            plot.curve(&mean.collect::<Vec<_>>(), Paint::stroke(color, thick));
        }
    }
    for run in runs {
        let at = run.validation_rmse_m.len() - 1 - run.kept;
        for (values, color) in [(&run.validation_rmse_m, BLUE), (&run.test_rmse_m, VERMILION)] {
            plot.dot([-(run.kept as f64), values[at]], 3.0, Paint::fill("#ffffff").outlined(color, 1.4));
        }
    }
    plot.note([0.0, 1.08 * greatest], [-4.0, 14.0], "none: the median", LABEL.anchored(Anchor::End));
    plot.finish()
}
