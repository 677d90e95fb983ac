//! A figure: panels, what they show, and the numbers they were drawn from.

use serde_json::Value;

use super::chart::color::PAPER;
use super::chart::plot::{HALF_WIDTH_PX, PANEL_WIDTH_PX, Panel};
use super::chart::svg::{Paint, Shapes, document};

#[derive(Debug, Clone)]
pub struct Figure {
    /// Letters, digits and hyphens: part of file names and addresses.
    pub id: String,
    pub title: String,
    /// What to see, in a sentence or two.
    pub caption: String,
    pub panels: Vec<Panel>,
    /// Where panels are too wide for a telephone: the same, narrow.
    pub narrow: Vec<Panel>,
    /// Panels side by side in the file.
    pub columns: usize,
    /// Every number that is drawn.
    pub data: Value,
}

/// A figure, or why there is none.
#[derive(Debug, Clone)]
pub enum Drawn {
    Figure(Box<Figure>),
    LeftOut { title: String, why: String },
}

impl From<Figure> for Drawn {
    fn from(figure: Figure) -> Self {
        Self::Figure(Box::new(figure))
    }
}

impl Drawn {
    pub fn left_out(title: impl Into<String>, why: impl Into<String>) -> Self {
        Self::LeftOut { title: title.into(), why: why.into() }
    }
}

impl Figure {
    pub fn new(id: impl Into<String>, title: impl Into<String>, caption: impl Into<String>, data: Value) -> Self {
        Self {
            id: id.into(),
            title: title.into(),
            caption: caption.into(),
            panels: Vec::new(),
            narrow: Vec::new(),
            columns: 3,
            data,
        }
    }

    pub fn with_panels(self, panels: Vec<Panel>) -> Self {
        Self { panels, ..self }
    }

    /// Panels that `build` makes for a width: one, two or four of them two a row, others three a row; on a telephone one.
    pub fn responsive(self, build: impl Fn(f64) -> Vec<Panel>) -> Self {
        let narrow = build(PANEL_WIDTH_PX);
        if matches!(narrow.len(), 1 | 2 | 4) { self.halves(build) } else { Self { panels: narrow, columns: 3, ..self } }
    }

    /// Panels that `build` makes for a width, two a row; on a telephone one.
    pub fn halves(self, build: impl Fn(f64) -> Vec<Panel>) -> Self {
        Self { panels: build(HALF_WIDTH_PX), narrow: build(PANEL_WIDTH_PX), columns: 2, ..self }
    }

    /// All panels as one SVG, on white.
    pub fn whole(&self) -> String {
        const GAP_PX: f64 = 24.0;
        const MARGIN_PX: f64 = 14.0;
        let mut rows: Vec<([f64; 2], Shapes)> = Vec::new();
        for panels in self.panels.chunks(self.columns.max(1)) {
            let (mut row, mut x, mut height) = (Shapes::default(), 0.0, 0.0_f64);
            for panel in panels {
                row.moved([x, 0.0], &panel.shapes);
                x += panel.size_px[0] + GAP_PX;
                height = height.max(panel.size_px[1]);
            }
            rows.push(([x - GAP_PX, height], row));
        }
        let width = rows.iter().map(|(size, _)| size[0]).fold(0.0, f64::max) + 2.0 * MARGIN_PX;
        let height = rows.iter().map(|(size, _)| size[1] + GAP_PX).sum::<f64>() - GAP_PX + 2.0 * MARGIN_PX;
        let mut shapes = Shapes::default();
        shapes.rect([0.0, 0.0], [width, height], Paint::fill(PAPER));
        let mut y = MARGIN_PX;
        for (size, row) in &rows {
            shapes.moved([MARGIN_PX, y], row);
            y += size[1] + GAP_PX;
        }
        document([width, height], &shapes, &self.title)
    }
}

/// With a capital first letter.
pub fn capitalized(text: &str) -> String {
    let mut characters = text.chars();
    characters.next().map_or(String::new(), |first| first.to_uppercase().chain(characters).collect())
}

/// Letters, digits and single hyphens of a name: for files and addresses.
pub fn slug(name: &str) -> String {
    let mut slug = String::new();
    for character in name.chars().flat_map(char::to_lowercase) {
        if character.is_ascii_alphanumeric() {
            slug.push(character);
        } else if !slug.ends_with('-') && !slug.is_empty() {
            slug.push('-');
        }
        if slug.len() >= 40 {
            break;
        }
    }
    let slug = slug.trim_end_matches('-');
    if slug.is_empty() { "recording".into() } else { slug.into() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_become_plain_file_names() {
        let found = ["drive-378", "../../etc/passwd", "Müller's <b>yard</b>", "日本", ""].map(slug);
        assert_eq!(found, ["drive-378", "etc-passwd", "m-ller-s-b-yard-b", "recording", "recording"]);
        assert!(slug(&"long".repeat(50)).len() <= 40);
    }
}
