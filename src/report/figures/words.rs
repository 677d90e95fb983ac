//! Which learning images a bag of words may answer with: figure 6 of Do et al. (2015).

use serde_json::json;

use super::paths::extent_of;
use crate::evaluate::WordAssignment;
use crate::report::chart::color::{BLUE, FAINT, VERMILION};
use crate::report::chart::map_plot::map_plot;
use crate::report::chart::plot::{Key, LegendItem, Panel};
use crate::report::chart::svg::Paint;
use crate::report::dataset::Dataset;
use crate::report::figure::{Drawn, Figure, capitalized};

pub fn words(dataset: &Dataset) -> Drawn {
    const TITLE: &str = "What a bag of words learns from";
    // The first seed of every plain split.
    let mut shown: Vec<&WordAssignment> = Vec::new();
    for assignment in &dataset.assignments {
        let section = &assignment.section;
        let is_plain = !section.noisy && !section.fixed;
        if is_plain && !shown.iter().any(|other| other.section == *section && other.features == assignment.features) {
            shown.push(assignment);
        }
    }
    let Some(first) = shown.first() else {
        return Drawn::left_out(
            TITLE,
            "No bag of words was run by the paper’s rule: see --baselines, and --survey beside --map.",
        );
    };
    let caption = format!(
        "The paper’s rule: a learning image within {} m of a test position (circles) carries the label of the nearest one, \
         and answering means choosing a label; the others (gray) are left out. So the rule knows where the test images \
         are, and an answer within the circle counts as no error: the row “nearest image” is the fair one. {} words, {} \
         neighbours, {:.0} % of the test images with the right label.",
        first.radius_m,
        first.words,
        first.neighbours,
        100.0 * first.classified_share
    );
    let figure = Figure::new(format!("{}-words", dataset.id), TITLE, caption, json!(shown));
    figure.responsive(|width_px| shown.iter().map(|one| panel(dataset, one, width_px)).collect()).into()
}

fn panel(dataset: &Dataset, of: &WordAssignment, width_px: f64) -> Panel {
    let labelled = of.learning.iter().filter(|frame| frame.label.is_some()).count();
    let legend = vec![
        LegendItem::new(format!("test ({})", of.test.len()), Key::Dot(Paint::fill(BLUE))),
        LegendItem::new(format!("labelled ({labelled})"), Key::Diamond(Paint::fill(VERMILION))),
        LegendItem::new(format!("left out ({})", of.learning.len() - labelled), Key::Dot(Paint::fill(FAINT))),
    ];
    let seed = of.seed.map(|seed| format!(", seed {seed}")).unwrap_or_default();
    let title = match &of.section.split {
        Some(split) => format!("{} split{seed}", capitalized(split)),
        None => "Against the map".into(),
    };
    let mut plot = map_plot(title, extent_of(dataset), legend, width_px);
    let radius_px = of.radius_m * plot.px_a_m();
    for frame in &of.test {
        let at = plot.at([frame.e_m, frame.n_m]);
        plot.inside.circle(at, radius_px, Paint::fill(BLUE).outlined(BLUE, 0.8).opacity(0.10));
    }
    for frame in &of.learning {
        let at = plot.at([frame.e_m, frame.n_m]);
        match frame.label {
            Some(_) => plot.inside.diamond(at, 3.0, Paint::fill(VERMILION)),
            None => plot.inside.circle(at, 1.8, Paint::fill(FAINT)),
        }
    }
    for frame in &of.test {
        let at = plot.at([frame.e_m, frame.n_m]);
        plot.inside.circle(at, 2.4, Paint::fill(BLUE).outlined("#ffffff", 0.6));
    }
    plot.finish()
}
