//! Which positions were learned from, chosen on and tested on.

use serde_json::json;

use super::paths::extent_of;
use crate::report::chart::color::{BLUE, ColorMap, ORANGE, VERMILION};
use crate::report::chart::map_plot::map_plot;
use crate::report::chart::plot::{Key, LegendItem, Panel};
use crate::report::chart::svg::Paint;
use crate::report::dataset::{Dataset, ShownSplit};
use crate::report::figure::{Drawn, Figure, capitalized};
use crate::report::insight::Insight;

/// Seeds of a kind of split that are shown.
const SHOWN_SEEDS: usize = 3;
/// About what [`ColorMap::Fading`] is at a tenth.
const CELL: &str = "#e4eff9";

pub fn splits(dataset: &Dataset) -> Drawn {
    if let (Some(map), Some(insight)) = (&dataset.map, dataset.insights.first()) {
        let names: Vec<&str> = map.info.recordings.iter().map(|recording| recording.name.as_str()).collect();
        let caption = format!(
            "The map was learned from {}. Frames are looked for in the pale blue cells only; a frame taken outside of them \
             cannot be found.",
            names.join(", ")
        );
        let data = json!({"learning_m": insight.learning_m, "frames_m": dataset.truth_m, "recordings": names,
            "cells": insight.cells.len(), "grid_step_m": insight.cells.grid.step_m,
            "grid_origin_m": insight.cells.grid.origin_m, "cell_indices": insight.cells.indices()});
        let figure = Figure::new(format!("{}-tiles", dataset.id), "The map and the drive", caption, data);
        return figure.responsive(|width_px| vec![map_panel(dataset, insight, width_px)]).into();
    }
    let mut shown: Vec<&ShownSplit> = Vec::new();
    for split in &dataset.splits {
        if shown.iter().filter(|other| other.name == split.name).count() < SHOWN_SEEDS {
            shown.push(split);
        }
    }
    let sets =
        |split: &ShownSplit| [split.split.learning.clone(), split.split.validation.clone(), split.split.test.clone()];
    let data = dataset.splits.iter().map(|split| {
        let [learning, validation, test] =
            sets(split).map(|rows| rows.into_iter().map(|row| dataset.frames[row].index).collect::<Vec<_>>());
        json!({"split": split.name, "seed": split.seed, "learning": learning, "validation": validation, "test": test})
    });
    let data: Vec<_> = data.collect();
    let positions: Vec<_> =
        dataset.frames.iter().map(|frame| json!({"index": frame.index, "position_m": frame.position_m})).collect();
    let caption = "Learning images are what the map is made of, features are chosen on validation images, and errors are \
                   measured on test images only. Where single frames are drawn at random, each test frame lies between \
                   learned neighbours; where whole stretches are held out, the map must bridge them.";
    let id = format!("{}-tiles", dataset.id);
    let figure =
        Figure::new(id, "Learning, validation and test", caption, json!({"splits": data, "frames": positions}));
    figure
        .responsive(|width_px| shown.iter().map(|split| panel(dataset, split, sets(split), width_px)).collect())
        .into()
}

fn map_panel(dataset: &Dataset, insight: &Insight, width_px: f64) -> Panel {
    let legend = vec![
        LegendItem::new("learned from", Key::Dot(Paint::fill(BLUE))),
        LegendItem::new("this recording", Key::Dot(Paint::fill(VERMILION))),
        LegendItem::new("candidate cells", Key::Box(Paint::fill(CELL))),
    ];
    let mut plot = map_plot("Learned from and driven", extent_of(dataset), legend, width_px);
    // All of one colour.
    let ones = vec![1.0; insight.cells.len()];
    plot.surface(&insight.cells, &ones, [0.0, 10.0], ColorMap::Fading);
    insight.learning_m.iter().for_each(|&at| plot.dot(at, 2.0, Paint::fill(BLUE)));
    dataset.truth_m.iter().for_each(|&at| plot.dot(at, 1.6, Paint::fill(VERMILION)));
    plot.finish()
}

fn panel(dataset: &Dataset, split: &ShownSplit, sets: [Vec<usize>; 3], width_px: f64) -> Panel {
    const LOOKS: [(&str, &str, f64); 3] =
        [("learning", "#9db8cf", 2.4), ("validation", ORANGE, 2.6), ("test", VERMILION, 2.8)];
    let legend = LOOKS.iter().zip(&sets).map(|((name, color, _), rows)| {
        LegendItem::new(format!("{name} ({})", rows.len()), Key::Dot(Paint::fill(color)))
    });
    let seed = split.seed.map(|seed| format!(", seed {seed}")).unwrap_or_default();
    let mut plot =
        map_plot(format!("{} split{seed}", capitalized(&split.name)), extent_of(dataset), legend.collect(), width_px);
    for ((_, color, radius), rows) in LOOKS.iter().zip(&sets) {
        for &row in rows {
            plot.dot(dataset.frames[row].position_m, *radius, Paint::fill(color));
        }
    }
    plot.finish()
}
