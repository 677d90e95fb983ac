//! What a map knows of a feature: figure 5 of Do et al. (2015), from above instead of in perspective.

use serde_json::json;

use super::paths::extent_of;
use crate::report::chart::color::{ColorMap, INK};
use crate::report::chart::map_plot::map_plot;
use crate::report::chart::plot::{PANEL_WIDTH_PX, Panel};
use crate::report::chart::svg::Paint;
use crate::report::dataset::Dataset;
use crate::report::figure::{Drawn, Figure};
use crate::report::insight::{GroupSurfaces, Insight, Surface};
use crate::report::methods::{feature_name, recipe_name};

pub fn surfaces(dataset: &Dataset) -> Drawn {
    const TITLE: &str = "What the map knows: posterior mean and variance";
    // One group a recipe, of the first split: its first, as in the paper.
    let mut recipes: Vec<&str> = Vec::new();
    let mut shown: Vec<(&Insight, &GroupSurfaces)> = Vec::new();
    for insight in &dataset.insights {
        if !recipes.contains(&insight.recipe) {
            recipes.push(insight.recipe);
            shown.extend(insight.surfaces.first().map(|group| (insight, group)));
        }
    }
    if shown.is_empty() {
        return Drawn::left_out(TITLE, "No feature was kept.");
    }
    let (mut panels, mut data) = (Vec::new(), Vec::new());
    for (insight, group) in &shown {
        let name = format!("{}, {}", recipe_name(insight.recipe), feature_name(group.descriptor.name()));
        let means = || group.shown.iter().flat_map(|surface| surface.mean.iter());
        let greatest = f64::from(means().fold(0.0_f32, |greatest, value| greatest.max(value.abs())));
        for surface in &group.shown {
            panels.push(mean_panel(dataset, insight, &name, surface, greatest));
        }
        // Where all features share their variance, one picture says it.
        let shared = group.shown.windows(2).all(|pair| pair[0].variance == pair[1].variance);
        for surface in group.shown.iter().take(if shared { 1 } else { usize::MAX }) {
            panels.push(variance_panel(dataset, insight, &name, surface, shared));
        }
        for surface in &group.shown {
            data.push(surface_json(insight, group, surface));
        }
    }
    let caption = "A feature is a number read from each image; the map is what that number should be at every place \
                   (blue below its mean, red above), and how sure that is (variance, noise included). Dots: images learned \
                   from. Of each recipe’s first type, the three features that tell most: whose mean varies most against the variance.";
    let figure = Figure::new(format!("{}-surfaces", dataset.id), TITLE, caption, json!(data));
    figure.with_panels(panels).into()
}

fn surface_json(insight: &Insight, group: &GroupSurfaces, surface: &Surface) -> serde_json::Value {
    let grid = insight.cells.grid;
    let rounded = |values: &[f32]| values.iter().map(|v| (f64::from(*v) * 1e4).round() * 1e-4).collect::<Vec<_>>();
    json!({
        "recipe": insight.recipe,
        "split": insight.split.as_ref().map(|(split, _)| split),
        "seed": insight.split.as_ref().and_then(|(_, seed)| *seed),
        "type": group.descriptor.name(),
        "feature": surface.feature,
        "features": group.features,
        "signal_std": surface.hyperparameters.signal_std,
        "noise_std": surface.hyperparameters.noise_std,
        "length_scale_m": surface.hyperparameters.length_scale_m,
        "grid": {"origin_m": grid.origin_m, "step_m": grid.step_m, "columns": grid.columns, "rows": grid.rows},
        "cells": if insight.cells.len() == (grid.columns * grid.rows) as usize { None } else { Some(insight.cells.indices()) },
        "mean": rounded(&surface.mean),
        "variance": rounded(&surface.variance),
        "learning_m": insight.learning_m,
    })
}

fn mean_panel(dataset: &Dataset, insight: &Insight, name: &str, surface: &Surface, greatest: f64) -> Panel {
    let range = [-greatest, greatest];
    let mut plot = map_plot(
        format!("{name}: mean of feature {}", surface.feature),
        extent_of(dataset),
        Vec::new(),
        PANEL_WIDTH_PX,
    );
    plot.surface(&insight.cells, &surface.mean, range, ColorMap::Diverging);
    for &position_m in &insight.learning_m {
        plot.dot(position_m, 1.3, Paint::fill(INK).opacity(0.7));
    }
    let unit = if insight.recipe == "paper" { "its standard deviations" } else { "standard deviations of its noise" };
    plot.color_bar(&format!("value of the feature, in {unit}"), range, ColorMap::Diverging);
    plot.finish()
}

fn variance_panel(dataset: &Dataset, insight: &Insight, name: &str, surface: &Surface, shared: bool) -> Panel {
    let high = f64::from(surface.variance.iter().copied().fold(0.0_f32, f32::max));
    let low = f64::from(surface.variance.iter().copied().fold(f32::INFINITY, f32::min));
    let range = [low, if high > low { high } else { low + 1.0 }];
    let title = match shared {
        true => format!("{name}: variance, all features"),
        false => format!("{name}: variance of feature {}", surface.feature),
    };
    let mut plot = map_plot(title, extent_of(dataset), Vec::new(), PANEL_WIDTH_PX);
    plot.surface(&insight.cells, &surface.variance, range, ColorMap::Sequential);
    for &position_m in &insight.learning_m {
        plot.dot(position_m, 1.3, Paint::fill("#ffffff").outlined(INK, 0.5));
    }
    plot.color_bar("variance of the feature, noise included", range, ColorMap::Sequential);
    plot.finish()
}
