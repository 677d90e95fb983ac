//! Shapes as SVG text.
//!
//! Everything that is drawn goes through here: numbers are rounded to a hundredth of a pixel, and text and attributes are
//! escaped, whatever a recording is called.

use std::fmt::Write;

/// Text within HTML or XML, or within a quoted attribute.
pub fn escaped(text: &str) -> String {
    let mut safe = String::with_capacity(text.len());
    for character in text.chars() {
        match character {
            '&' => safe.push_str("&amp;"),
            '<' => safe.push_str("&lt;"),
            '>' => safe.push_str("&gt;"),
            '"' => safe.push_str("&quot;"),
            '\'' => safe.push_str("&#39;"),
            // No control character may be in XML, not even escaped, and what turns text around could fool a reader.
            c if (c.is_control() && !matches!(c, '\n' | '\t'))
                || matches!(c, '\u{202a}'..='\u{202e}' | '\u{2066}'..='\u{2069}' | '\u{fffe}' | '\u{ffff}') =>
            {
                safe.push('\u{fffd}');
            }
            c => safe.push(c),
        }
    }
    safe
}

/// A coordinate \[px\], to a hundredth; what is no number is drawn far outside, not written as one.
pub fn px(value: f64) -> String {
    let value = if value.is_finite() { value.clamp(-1e5, 1e5) } else { -1e5 };
    let mut text = format!("{value:.2}");
    while text.ends_with('0') {
        text.pop();
    }
    if text.ends_with('.') {
        text.pop();
    }
    if text == "-0" { "0".into() } else { text }
}

/// How a shape is painted.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Paint {
    pub fill: Option<&'static str>,
    pub stroke: Option<&'static str>,
    pub width: f64,
    pub dashes: Option<&'static str>,
    pub opacity: f64,
}

impl Paint {
    pub const fn fill(color: &'static str) -> Self {
        Self { fill: Some(color), stroke: None, width: 0.0, dashes: None, opacity: 1.0 }
    }

    pub const fn stroke(color: &'static str, width: f64) -> Self {
        Self { fill: None, stroke: Some(color), width, dashes: None, opacity: 1.0 }
    }

    pub const fn outlined(self, color: &'static str, width: f64) -> Self {
        Self { stroke: Some(color), width, ..self }
    }

    pub const fn dashed(self, dashes: &'static str) -> Self {
        Self { dashes: Some(dashes), ..self }
    }

    pub const fn opacity(self, opacity: f64) -> Self {
        Self { opacity, ..self }
    }

    fn attributes(&self) -> String {
        let mut text = format!(" fill=\"{}\"", self.fill.unwrap_or("none"));
        if let Some(stroke) = self.stroke {
            let _ = write!(text, " stroke=\"{stroke}\" stroke-width=\"{}\"", px(self.width));
        }
        if let Some(dashes) = self.dashes {
            let _ = write!(text, " stroke-dasharray=\"{dashes}\"");
        }
        if self.opacity < 1.0 {
            let _ = write!(text, " opacity=\"{}\"", px(self.opacity));
        }
        text
    }
}

/// Which end of a text is at its position.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Anchor {
    Start,
    Middle,
    End,
}

/// How a text is set.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Type {
    pub size_px: f64,
    pub color: &'static str,
    pub anchor: Anchor,
    pub bold: bool,
}

impl Type {
    pub const fn new(size_px: f64, color: &'static str) -> Self {
        Self { size_px, color, anchor: Anchor::Start, bold: false }
    }

    pub const fn anchored(self, anchor: Anchor) -> Self {
        Self { anchor, ..self }
    }

    pub const fn bold(self) -> Self {
        Self { bold: true, ..self }
    }
}

/// What is drawn so far.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Shapes(String);

impl Shapes {
    pub fn append(&mut self, other: &Self) {
        self.0 += &other.0;
    }

    pub fn line(&mut self, from: [f64; 2], to: [f64; 2], paint: Paint) {
        let ([x1, y1], [x2, y2]) = (from.map(px), to.map(px));
        let _ = write!(self.0, "<line x1=\"{x1}\" y1=\"{y1}\" x2=\"{x2}\" y2=\"{y2}\"{}/>", paint.attributes());
    }

    pub fn polyline(&mut self, points: &[[f64; 2]], paint: Paint) {
        self.points("polyline", points, paint);
    }

    pub fn polygon(&mut self, points: &[[f64; 2]], paint: Paint) {
        self.points("polygon", points, paint);
    }

    fn points(&mut self, element: &str, points: &[[f64; 2]], paint: Paint) {
        if points.is_empty() {
            return;
        }
        let _ = write!(self.0, "<{element} points=\"");
        for [x, y] in points {
            let _ = write!(self.0, "{},{} ", px(*x), px(*y));
        }
        let _ = write!(self.0, "\" stroke-linejoin=\"round\"{}/>", paint.attributes());
    }

    pub fn circle(&mut self, [x, y]: [f64; 2], radius_px: f64, paint: Paint) {
        let _ =
            write!(self.0, "<circle cx=\"{}\" cy=\"{}\" r=\"{}\"{}/>", px(x), px(y), px(radius_px), paint.attributes());
    }

    /// A circle that says `title` where the pointer rests on it.
    pub fn titled_circle(&mut self, [x, y]: [f64; 2], radius_px: f64, paint: Paint, title: &str) {
        let (x, y, r, title) = (px(x), px(y), px(radius_px), escaped(title));
        let _ = write!(
            self.0,
            "<circle cx=\"{x}\" cy=\"{y}\" r=\"{r}\"{}><title>{title}</title></circle>",
            paint.attributes()
        );
    }

    pub fn diamond(&mut self, [x, y]: [f64; 2], radius_px: f64, paint: Paint) {
        let r = radius_px;
        self.polygon(&[[x, y - r], [x + r, y], [x, y + r], [x - r, y]], paint);
    }

    pub fn rect(&mut self, [x, y]: [f64; 2], [width, height]: [f64; 2], paint: Paint) {
        let (width, height) = (px(width.max(0.0)), px(height.max(0.0)));
        let _ = write!(
            self.0,
            "<rect x=\"{}\" y=\"{}\" width=\"{width}\" height=\"{height}\"{}/>",
            px(x),
            px(y),
            paint.attributes()
        );
    }

    /// An ellipse turned counter-clockwise, as seen, by `turn_rad`.
    pub fn ellipse(&mut self, [x, y]: [f64; 2], [a, b]: [f64; 2], turn_rad: f64, paint: Paint) {
        let (x, y, turn) = (px(x), px(y), px(-turn_rad.to_degrees()));
        let _ = write!(
            self.0,
            "<ellipse cx=\"{x}\" cy=\"{y}\" rx=\"{}\" ry=\"{}\" transform=\"rotate({turn} {x} {y})\"{}/>",
            px(a),
            px(b),
            paint.attributes()
        );
    }

    pub fn text(&mut self, at: [f64; 2], text: &str, style: Type) {
        self.put_text(at, text, style, "");
    }

    /// A text with a light rim, to be read on whatever lies below.
    pub fn haloed_text(&mut self, at: [f64; 2], text: &str, style: Type) {
        let halo = " stroke=\"#ffffff\" stroke-width=\"3\" stroke-linejoin=\"round\" paint-order=\"stroke\"";
        self.put_text(at, text, style, halo);
    }

    fn put_text(&mut self, [x, y]: [f64; 2], text: &str, style: Type, more: &str) {
        let anchor = match style.anchor {
            Anchor::Start => "",
            Anchor::Middle => " text-anchor=\"middle\"",
            Anchor::End => " text-anchor=\"end\"",
        };
        let weight = if style.bold { " font-weight=\"600\"" } else { "" };
        let _ = write!(
            self.0,
            "<text x=\"{}\" y=\"{}\" font-size=\"{}\" fill=\"{}\"{anchor}{weight}{more}>{}</text>",
            px(x),
            px(y),
            px(style.size_px),
            style.color,
            escaped(text)
        );
    }

    /// A picture, as a `data:` address, stretched over a rectangle; `sharp` shows its pixels as they are.
    pub fn image(&mut self, [x, y]: [f64; 2], [width, height]: [f64; 2], address: &str, sharp: bool) {
        let rendering =
            if sharp { " style=\"image-rendering:pixelated\" image-rendering=\"optimizeSpeed\"" } else { "" };
        let _ = write!(
            self.0,
            "<image x=\"{}\" y=\"{}\" width=\"{}\" height=\"{}\" preserveAspectRatio=\"none\"{rendering} href=\"{}\"/>",
            px(x),
            px(y),
            px(width),
            px(height),
            escaped(address)
        );
    }

    /// `inner`, cut off at a rectangle.
    pub fn clipped(&mut self, [x, y]: [f64; 2], [width, height]: [f64; 2], inner: &Self) {
        let rectangle = [x, y, width, height].map(px);
        let [x, y, width, height] = &rectangle;
        let _ = write!(
            self.0,
            "<svg x=\"{x}\" y=\"{y}\" width=\"{width}\" height=\"{height}\" viewBox=\"{}\" overflow=\"hidden\">{}</svg>",
            rectangle.join(" "),
            inner.0
        );
    }

    /// `inner`, moved.
    pub fn moved(&mut self, [x, y]: [f64; 2], inner: &Self) {
        let _ = write!(self.0, "<g transform=\"translate({} {})\">{}</g>", px(x), px(y), inner.0);
    }
}

/// Fonts of a drawing; the first is the one the report brings along.
pub const FONT_FAMILY: &str = "Inter, Helvetica, Arial, sans-serif";

/// A whole drawing.
pub fn document([width, height]: [f64; 2], shapes: &Shapes, label: &str) -> String {
    format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {w} {h}\" width=\"{w}\" height=\"{h}\" role=\"img\" \
         aria-label=\"{}\" font-family=\"{FONT_FAMILY}\">{}</svg>",
        escaped(label),
        shapes.0,
        w = px(width),
        h = px(height),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hostile_names_are_text_only() {
        let hostile = "<script>alert(\"1\")</script>&'\u{0}\u{202e}";
        let mut shapes = Shapes::default();
        shapes.text([1.0, 2.0], hostile, Type::new(11.0, "#000"));
        shapes.titled_circle([1.0, 2.0], 3.0, Paint::fill("#000"), hostile);
        let whole = document([10.0, 10.0], &shapes, hostile);
        assert!(!whole.contains("<script") && !whole.contains('\u{0}') && !whole.contains('\u{202e}'), "{whole}");
        assert_eq!(whole.matches("&lt;script&gt;alert(&quot;1&quot;)&lt;/script&gt;&amp;&#39;").count(), 3);
    }

    #[test]
    fn coordinates_are_short_and_always_numbers() {
        let found = [1.0, -0.001, 2.345_67, f64::NAN, f64::INFINITY, 1e300, 120.0].map(px);
        assert_eq!(found, ["1", "0", "2.35", "-100000", "-100000", "100000", "120"]);
    }
}
