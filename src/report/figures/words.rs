//! Which test image's label every learning image of a bag of words carries: figure 6 of Do et al. (2015).

use std::collections::BTreeMap;

use serde_json::{Value, json};

use super::paths::extent_of;
use crate::evaluate::WordAssignment;
use crate::report::chart::color::{BLUE, FAINT, GREEN, INK, MUTED, ORANGE, PAPER, PURPLE, SKY, VERMILION};
use crate::report::chart::map_plot::map_plot;
use crate::report::chart::plot::{Key, LegendItem, Panel};
use crate::report::chart::svg::Paint;
use crate::report::dataset::Dataset;
use crate::report::figure::{Drawn, Figure, capitalized};
use crate::types::{PositionM, counted, distance_m};

/// Labels that lie next to each other differ in it.
const COLORS: [&str; 6] = [BLUE, VERMILION, GREEN, ORANGE, PURPLE, SKY];
/// Everything within the radius of a test image.
const REACHED: &str = "#f1f4f8";

/// How many images of either kind there are.
struct Counts {
    right: usize,
    wrong: usize,
    labelled: usize,
    left_out: usize,
}

impl Counts {
    fn of(assignment: &WordAssignment) -> Self {
        let right = assignment.test.iter().filter(|test| test.predicted == test.index).count();
        let labelled = assignment.learning.iter().filter(|frame| frame.label.is_some()).count();
        let (wrong, left_out) = (assignment.test.len() - right, assignment.learning.len() - labelled);
        Self { right, wrong, labelled, left_out }
    }
}

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
        "The paper’s rule: test images (large dots) are the labels. Every learning image (small dot) within {} m of one \
         carries the label of the nearest: the line leads to it, in its colour. Answering means choosing a label. So the rule \
         knows where the test images are, and an answer a few metres off counts as no error: the row “nearest image” is the \
         fair one. {}, {}, {:.0} % of the test images with the right label; those with a wrong one are white inside.",
        first.radius_m,
        counted(first.words, "word"),
        counted(first.neighbours, "neighbour"),
        100.0 * first.classified_share
    );
    let data = shown.iter().map(|one| as_json(one)).collect();
    let figure = Figure::new(format!("{}-words", dataset.id), TITLE, caption, Value::Array(data));
    figure.responsive(|width_px| shown.iter().map(|one| panel(dataset, one, width_px)).collect()).into()
}

fn as_json(assignment: &WordAssignment) -> Value {
    let Counts { right, wrong, labelled, left_out } = Counts::of(assignment);
    let mut data = json!(assignment);
    data["counts"] = json!({
        "test_right": right, "test_wrong": wrong, "learning_labelled": labelled, "learning_left_out": left_out,
    });
    data
}

fn panel(dataset: &Dataset, of: &WordAssignment, width_px: f64) -> Panel {
    let counts = Counts::of(of);
    let white = |color| Paint::fill(PAPER).outlined(color, 1.8);
    let mut legend = vec![
        LegendItem::new(
            format!("test, label right ({})", counts.right),
            Key::Dot(Paint::fill(BLUE).outlined(INK, 0.8)),
        ),
        LegendItem::new(format!("wrong ({})", counts.wrong), Key::Dot(white(BLUE))),
        LegendItem::new(
            format!("learning, line to its label ({})", counts.labelled),
            Key::Line(Paint::stroke(BLUE, 1.2)),
        ),
        LegendItem::new(format!("left out ({})", counts.left_out), Key::Dot(Paint::fill(PAPER).outlined(MUTED, 0.9))),
    ];
    let none_of = [false, counts.wrong == 0, false, counts.left_out == 0];
    let mut none_of = none_of.into_iter();
    legend.retain(|_| !none_of.next().unwrap_or(false));
    let seed = of.seed.map(|seed| format!(", seed {seed}")).unwrap_or_default();
    let title = match &of.section.split {
        Some(split) => format!("{} split{seed}", capitalized(split)),
        None => "Against the map".into(),
    };
    let mut plot = map_plot(title, extent_of(dataset), legend, width_px);
    let positions_m: Vec<PositionM> = of.test.iter().map(|test| [test.e_m, test.n_m]).collect();
    // The outline of all circles together: where they overlap, the fillings hide the lines.
    let radius_px = of.radius_m * plot.px_a_m();
    for (wider_px, color) in [(1.0, FAINT), (0.0, REACHED)] {
        for &position_m in &positions_m {
            plot.dot(position_m, radius_px + wider_px, Paint::fill(color));
        }
    }
    let color_of: BTreeMap<usize, (PositionM, &str)> = of
        .test
        .iter()
        .zip(colors_apart(&positions_m))
        .map(|(test, color)| (test.index, ([test.e_m, test.n_m], color)))
        .collect();
    for frame in &of.learning {
        let at_m = [frame.e_m, frame.n_m];
        match frame.label.and_then(|label| color_of.get(&label)) {
            Some(&(label_m, color)) => {
                plot.segment(at_m, label_m, Paint::stroke(color, 1.2));
                plot.dot(at_m, 1.7, Paint::fill(color));
            }
            None => plot.dot(at_m, 1.7, Paint::fill(PAPER).outlined(MUTED, 0.9)),
        }
    }
    for test in &of.test {
        let Some(&(at_m, color)) = color_of.get(&test.index) else { continue };
        let is_right = test.predicted == test.index;
        plot.dot(at_m, 3.4, if is_right { Paint::fill(color).outlined(INK, 0.8) } else { white(color) });
    }
    plot.finish()
}

/// A colour a position, one after the other the one whose nearest position so far is furthest away.
fn colors_apart(positions_m: &[PositionM]) -> Vec<&'static str> {
    let mut chosen: Vec<usize> = Vec::with_capacity(positions_m.len());
    for &position_m in positions_m {
        let mut nearest_m = [f64::INFINITY; COLORS.len()];
        for (&color, &other_m) in chosen.iter().zip(positions_m) {
            nearest_m[color] = nearest_m[color].min(distance_m(position_m, other_m));
        }
        // Of several, the first.
        let best = (0..COLORS.len()).rev().max_by(|&a, &b| nearest_m[a].total_cmp(&nearest_m[b])).unwrap_or(0);
        chosen.push(best);
    }
    chosen.into_iter().map(|color| COLORS[color]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn neighbouring_labels_differ_in_colour() {
        let lattice: Vec<PositionM> = (0..60).map(|i| [f64::from(i % 10) * 0.3, f64::from(i / 10) * 0.3]).collect();
        let colors = colors_apart(&lattice);
        for (i, a) in lattice.iter().enumerate() {
            for (j, b) in lattice.iter().enumerate().skip(i + 1) {
                assert!(distance_m(*a, *b) > 0.31 || colors[i] != colors[j], "{i} and {j}");
            }
        }
        assert!(COLORS.iter().all(|color| colors.contains(color)));
        assert!(colors_apart(&[]).is_empty());
    }
}
