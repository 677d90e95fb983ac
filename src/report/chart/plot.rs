//! A plot: title, legend, axes with units, and what is drawn between them.

use super::color::{GRID, INK, MUTED, PAPER};
use super::scale::Scale;
use super::svg::{Anchor, Paint, Shapes, Type};
use super::text::{fitted, width_px};

/// Width of an ordinary panel \[px\]: three beside one another on a desk, one on a telephone.
pub const PANEL_WIDTH_PX: f64 = 364.0;
/// Width of a panel of which a desk shows two beside one another \[px\].
pub const HALF_WIDTH_PX: f64 = 556.0;
/// Plotting area of an ordinary panel is this high \[px\].
pub const AREA_HEIGHT_PX: f64 = 220.0;

pub const TITLE: Type = Type::new(13.0, INK).bold();
pub const LABEL: Type = Type::new(11.0, MUTED);
pub const TICK: Type = Type::new(10.5, MUTED);
pub const NOTE: Type = Type::new(11.0, INK);

/// A finished drawing with a title of its own.
#[derive(Debug, Clone, PartialEq)]
pub struct Panel {
    pub title: String,
    pub size_px: [f64; 2],
    pub shapes: Shapes,
}

/// What a series looks like in a legend.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Key {
    Line(Paint),
    Dot(Paint),
    Diamond(Paint),
    Box(Paint),
}

#[derive(Debug, Clone, PartialEq)]
pub struct LegendItem {
    pub label: String,
    pub key: Key,
}

impl LegendItem {
    pub fn new(label: impl Into<String>, key: Key) -> Self {
        Self { label: label.into(), key }
    }
}

/// An axis: what it measures, with its unit, and from where to where.
#[derive(Debug, Clone, PartialEq)]
pub struct Axis {
    pub label: String,
    pub scale: Scale,
    /// In place of round values.
    pub ticks: Option<Vec<super::scale::Tick>>,
}

impl Axis {
    pub fn new(label: impl Into<String>, scale: Scale) -> Self {
        Self { label: label.into(), scale, ticks: None }
    }

    /// With ticks at these values.
    pub fn with_ticks(self, ticks: impl IntoIterator<Item = (f64, String)>) -> Self {
        let ticks = ticks.into_iter().map(|(value, label)| super::scale::Tick { value, label }).collect();
        Self { ticks: Some(ticks), ..self }
    }

    fn ticks(&self, wanted: usize) -> Vec<super::scale::Tick> {
        self.ticks.clone().unwrap_or_else(|| self.scale.ticks(wanted))
    }
}

/// How a plot is to be.
#[derive(Debug, Clone, PartialEq)]
pub struct Spec {
    pub title: String,
    pub width_px: f64,
    pub area_height_px: f64,
    pub x: Axis,
    pub y: Axis,
    pub legend: Vec<LegendItem>,
    /// Lines across the area at the ticks.
    pub grid: bool,
    /// Room for the labels on the left, where it is not to depend on them \[px\].
    pub left_px: Option<f64>,
}

impl Spec {
    pub fn new(title: impl Into<String>, x: Axis, y: Axis) -> Self {
        Self {
            title: title.into(),
            width_px: PANEL_WIDTH_PX,
            area_height_px: AREA_HEIGHT_PX,
            x,
            y,
            legend: Vec::new(),
            grid: true,
            left_px: None,
        }
    }
}

/// A plot being drawn.
#[derive(Debug, Clone)]
pub struct Plot {
    title: String,
    size_px: [f64; 2],
    pub x: Scale,
    pub y: Scale,
    /// Upper left corner and size of the plotting area \[px\].
    pub area_at: [f64; 2],
    pub area_size: [f64; 2],
    below: Shapes,
    /// Drawn within the area, cut off at its borders.
    pub inside: Shapes,
    /// Drawn on top, not cut off.
    pub above: Shapes,
}

const TITLE_HEIGHT_PX: f64 = 24.0;
pub const LEGEND_ROW_PX: f64 = 17.0;
const AXIS_LABEL_PX: f64 = 18.0;

impl Plot {
    pub fn new(spec: Spec) -> Self {
        let Spec { title, width_px: width, area_height_px, x, y, legend, grid, left_px } = spec;
        let y_ticks = y.ticks((area_height_px / 40.0).clamp(3.0, 8.0) as usize);
        let widest = y_ticks.iter().map(|tick| width_px(&tick.label, TICK.size_px, false)).fold(0.0, f64::max);
        let left = left_px.unwrap_or((widest + 10.0).max(14.0));
        let right = 12.0;
        let mut below = Shapes::default();
        below.text([0.0, 14.0], &fitted(&title, TITLE.size_px, true, width), TITLE);
        let rows = put_legend(&mut below, [0.0, TITLE_HEIGHT_PX], width, &legend);
        let mut top = TITLE_HEIGHT_PX + LEGEND_ROW_PX * rows as f64;
        if !y.label.is_empty() {
            below.text([0.0, top + 13.0], &fitted(&y.label, LABEL.size_px, false, width), LABEL);
            top += AXIS_LABEL_PX + 6.0;
        } else {
            top += 8.0;
        }
        let area_at = [left, top];
        let area_size = [width - left - right, area_height_px];
        let x_scale = x.scale.onto(area_at[0], area_at[0] + area_size[0]);
        let y_scale = y.scale.onto(area_at[1] + area_size[1], area_at[1]);
        let bottom = area_at[1] + area_size[1];

        for tick in &y_ticks {
            let at = y_scale.px(tick.value);
            if grid {
                below.line([left, at], [left + area_size[0], at], Paint::stroke(GRID, 1.0));
            }
            below.text([left - 6.0, at + 3.6], &tick.label, TICK.anchored(Anchor::End));
        }
        let mut free_from = f64::NEG_INFINITY;
        for tick in x.ticks((area_size[0] / 55.0).clamp(2.0, 12.0) as usize) {
            let at = x_scale.px(tick.value);
            if grid {
                below.line([at, area_at[1]], [at, bottom], Paint::stroke(GRID, 1.0));
            }
            let half = 0.5 * width_px(&tick.label, TICK.size_px, false);
            let at = at.min(width - half);
            // Labels that would run into each other are left out.
            if at - half > free_from {
                below.text([at, bottom + 14.0], &tick.label, TICK.anchored(Anchor::Middle));
                free_from = at + half + 4.0;
            }
        }
        below.line([left, bottom], [left + area_size[0], bottom], Paint::stroke(MUTED, 1.0));
        let mut height = bottom + 20.0;
        if !x.label.is_empty() {
            let middle = left + 0.5 * area_size[0];
            let label = fitted(&x.label, LABEL.size_px, false, width);
            let half = 0.5 * width_px(&label, LABEL.size_px, false);
            below.text(
                [middle.clamp(half, (width - half).max(half)), bottom + 30.0],
                &label,
                LABEL.anchored(Anchor::Middle),
            );
            height += AXIS_LABEL_PX;
        }
        Self {
            title,
            size_px: [width, height],
            x: x_scale,
            y: y_scale,
            area_at,
            area_size,
            below,
            inside: Shapes::default(),
            above: Shapes::default(),
        }
    }

    /// The pixel of a pair of values.
    pub fn at(&self, [x, y]: [f64; 2]) -> [f64; 2] {
        [self.x.px(x), self.y.px(y)]
    }

    pub fn curve(&mut self, points: &[[f64; 2]], paint: Paint) {
        let points: Vec<_> = points.iter().map(|&point| self.at(point)).collect();
        self.inside.polyline(&points, paint);
    }

    /// A staircase that rises at its points.
    pub fn staircase(&mut self, points: &[[f64; 2]], paint: Paint) {
        let mut corners = Vec::with_capacity(2 * points.len());
        for pair in points.windows(2) {
            corners.extend([pair[0], [pair[1][0], pair[0][1]]]);
        }
        corners.extend(points.last());
        self.curve(&corners, paint);
    }

    /// The area between two curves of the same x.
    pub fn band(&mut self, lower: &[[f64; 2]], upper: &[[f64; 2]], paint: Paint) {
        let outline: Vec<_> = lower.iter().chain(upper.iter().rev()).map(|&point| self.at(point)).collect();
        self.inside.polygon(&outline, paint);
    }

    pub fn dot(&mut self, point: [f64; 2], radius_px: f64, paint: Paint) {
        let at = self.at(point);
        self.inside.circle(at, radius_px, paint);
    }

    pub fn segment(&mut self, from: [f64; 2], to: [f64; 2], paint: Paint) {
        let (from, to) = (self.at(from), self.at(to));
        self.inside.line(from, to, paint);
    }

    /// A note at a pair of values, moved by some pixels.
    pub fn note(&mut self, point: [f64; 2], [dx, dy]: [f64; 2], text: &str, style: Type) {
        let [x, y] = self.at(point);
        self.above.haloed_text([x + dx, y + dy], text, style);
    }

    /// A text that whatever lies below it stops at.
    pub fn label(&mut self, [x, y]: [f64; 2], text: &str, style: Type) {
        let wide = width_px(text, style.size_px, style.bold);
        let left = match style.anchor {
            Anchor::Start => x,
            Anchor::Middle => x - 0.5 * wide,
            Anchor::End => x - wide,
        };
        let (above, below) = (0.85 * style.size_px, 0.3 * style.size_px);
        self.above.rect([left - 2.0, y - above], [wide + 4.0, above + below], Paint::fill(PAPER));
        self.above.text([x, y], text, style);
    }

    pub fn finish(self) -> Panel {
        let mut shapes = self.below;
        shapes.clipped(self.area_at, self.area_size, &self.inside);
        shapes.append(&self.above);
        Panel { title: self.title, size_px: self.size_px, shapes }
    }

    /// Makes room below the plot; returns where it begins.
    pub fn room_below(&mut self, height_px: f64) -> f64 {
        let from = self.size_px[1];
        self.size_px[1] += height_px;
        from
    }
}

/// Draws a legend in as many rows as it takes; returns their number.
pub fn put_legend(shapes: &mut Shapes, [left, top]: [f64; 2], width: f64, items: &[LegendItem]) -> usize {
    const KEY_PX: f64 = 18.0;
    const GAP_PX: f64 = 14.0;
    let (mut x, mut row) = (left, 0);
    for item in items {
        let label = fitted(&item.label, NOTE.size_px, false, width - KEY_PX - 5.0);
        let wide = KEY_PX + 5.0 + width_px(&label, NOTE.size_px, false);
        if x > left && x + wide > left + width {
            (x, row) = (left, row + 1);
        }
        let middle = top + LEGEND_ROW_PX * (row as f64 + 0.5);
        let center = [x + 0.5 * KEY_PX, middle];
        match item.key {
            Key::Line(paint) => shapes.line([x, middle], [x + KEY_PX, middle], paint),
            Key::Dot(paint) => shapes.circle(center, 4.0, paint),
            Key::Diamond(paint) => shapes.diamond(center, 5.0, paint),
            Key::Box(paint) => shapes.rect([x + 2.0, middle - 5.0], [KEY_PX - 4.0, 10.0], paint),
        }
        shapes.text([x + KEY_PX + 5.0, middle + 3.8], &label, NOTE);
        x += wide + GAP_PX;
    }
    if items.is_empty() { 0 } else { row + 1 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::report::chart::svg::document;

    #[test]
    fn a_plot_holds_its_curve_within_its_axes() {
        let x = Axis::new("error [m]", Scale::linear(0.0, 10.0));
        let mut plot = Plot::new(Spec::new("Errors", x, Axis::new("share", Scale::linear(0.0, 1.0))));
        let corner = plot.at([10.0, 1.0]);
        assert_eq!(corner, [plot.area_at[0] + plot.area_size[0], plot.area_at[1]]);
        plot.curve(&[[0.0, 0.0], [20.0, 2.0]], Paint::stroke("#000", 1.0));
        let panel = plot.finish();
        let text = document(panel.size_px, &panel.shapes, &panel.title);
        assert!(text.contains("overflow=\"hidden\"") && text.contains("error [m]"), "{text}");
    }

    /// The white below a label covers all of it, on whichever side it is anchored.
    #[test]
    fn lines_stop_at_labels() {
        for (anchor, left) in [(Anchor::Start, 100.0), (Anchor::End, 100.0 - width_px("a row", 11.0, false))] {
            let axis = || Axis::new("", Scale::linear(0.0, 1.0));
            let mut plot = Plot::new(Spec::new("", axis(), axis()));
            plot.label([100.0, 50.0], "a row", NOTE.anchored(anchor));
            let panel = plot.finish();
            let text = document(panel.size_px, &panel.shapes, "");
            let (rect, label) =
                (text.find(&format!("<rect x=\"{}\"", super::super::svg::px(left - 2.0))), text.find("a row"));
            assert!(rect.is_some() && rect < label, "{text}");
        }
    }

    #[test]
    fn long_legends_take_several_rows_and_stay_inside() {
        let items: Vec<LegendItem> =
            (0..9).map(|i| LegendItem::new(format!("method number {i}"), Key::Dot(Paint::fill("#000")))).collect();
        let mut shapes = Shapes::default();
        let rows = put_legend(&mut shapes, [0.0, 0.0], PANEL_WIDTH_PX, &items);
        assert!((3..=5).contains(&rows), "{rows}");
        assert_eq!(put_legend(&mut shapes, [0.0, 0.0], PANEL_WIDTH_PX, &[]), 0);
    }
}
