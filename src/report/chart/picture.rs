//! Pixels in a drawing: surfaces, photographs, and the drawing itself as a PNG.

use std::io::Cursor;
use std::sync::{Arc, LazyLock};

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use image::{ExtendedColorType, ImageEncoder};
use resvg::{tiny_skia, usvg};

/// Pixels with opacity, row by row.
#[derive(Debug, Clone, PartialEq)]
pub struct Rgba {
    pub width_px: usize,
    pub height_px: usize,
    pub values: Vec<u8>,
}

impl Rgba {
    pub fn transparent(width_px: usize, height_px: usize) -> Self {
        Self { width_px, height_px, values: vec![0; 4 * width_px * height_px] }
    }

    pub fn put(&mut self, x: usize, y: usize, [r, g, b]: [u8; 3]) {
        let at = 4 * (y * self.width_px + x);
        self.values[at..at + 4].copy_from_slice(&[r, g, b, 255]);
    }
}

/// Surfaces are enlarged, pixel for pixel, to at least so many: programs that smooth what they enlarge then blur little.
const LEAST_SIDE_PX: usize = 160;

/// `picture` as a PNG in a `data:` address.
pub fn png_address(picture: &Rgba) -> String {
    let times = if picture.height_px == 1 { 1 } else { LEAST_SIDE_PX.div_ceil(picture.width_px.max(1)).clamp(1, 8) };
    let (width, height) = (picture.width_px * times, picture.height_px * times);
    let mut values = Vec::with_capacity(4 * width * height);
    for row in picture.values.chunks_exact(4 * picture.width_px.max(1)) {
        let wide: Vec<u8> = row.chunks_exact(4).flat_map(|pixel| pixel.repeat(times)).collect();
        (0..times).for_each(|_| values.extend_from_slice(&wide));
    }
    let mut png = Vec::new();
    image::codecs::png::PngEncoder::new_with_quality(
        &mut png,
        image::codecs::png::CompressionType::Best,
        image::codecs::png::FilterType::Adaptive,
    )
    .write_image(&values, width as u32, height as u32, ExtendedColorType::Rgba8)
    .expect("pixels of that size, into memory");
    address("image/png", &png)
}

/// Quality of photographs in the report: they are small, and looked at.
const JPEG_QUALITY: u8 = 82;

/// A gray picture as a JPEG in a `data:` address.
pub fn gray_jpeg_address(values: &[u8], width_px: usize, height_px: usize) -> String {
    jpeg_address(values, width_px, height_px, ExtendedColorType::L8)
}

/// An image with colours likewise.
pub fn rgb_jpeg_address(image: &image::RgbImage) -> String {
    jpeg_address(image.as_raw(), image.width() as usize, image.height() as usize, ExtendedColorType::Rgb8)
}

fn jpeg_address(values: &[u8], width_px: usize, height_px: usize, color: ExtendedColorType) -> String {
    let mut jpeg = Cursor::new(Vec::new());
    image::codecs::jpeg::JpegEncoder::new_with_quality(&mut jpeg, JPEG_QUALITY)
        .write_image(values, width_px as u32, height_px as u32, color)
        .expect("pixels of that size, into memory");
    address("image/jpeg", jpeg.get_ref())
}

fn address(kind: &str, bytes: &[u8]) -> String {
    format!("data:{kind};base64,{}", STANDARD.encode(bytes))
}

/// The fonts of all drawings: a part of Inter, see `font/OFL.txt`. None of the system's is needed.
pub const FONT_REGULAR: &[u8] = include_bytes!("../font/inter-regular.otf");
pub const FONT_SEMIBOLD: &[u8] = include_bytes!("../font/inter-semibold.otf");

/// Our fonts as a style sheet, for pages that must look the same everywhere.
pub fn font_faces() -> String {
    let face = |bytes: &[u8], weight: u32| {
        format!(
            "@font-face{{font-family:Inter;font-weight:{weight};src:url({}) format(\"opentype\")}}",
            address("font/otf", bytes)
        )
    };
    face(FONT_REGULAR, 400) + &face(FONT_SEMIBOLD, 600)
}

static OPTIONS: LazyLock<usvg::Options<'static>> = LazyLock::new(|| {
    let mut fonts = usvg::fontdb::Database::new();
    fonts.load_font_data(FONT_REGULAR.to_vec());
    fonts.load_font_data(FONT_SEMIBOLD.to_vec());
    usvg::Options { font_family: "Inter".into(), fontdb: Arc::new(fonts), ..usvg::Options::default() }
});

#[derive(Debug, thiserror::Error)]
pub enum PictureError {
    #[error("the drawing is no sound SVG")]
    Svg(#[from] usvg::Error),
    #[error("no picture can be {width_px} x {height_px} pixels")]
    Size { width_px: u32, height_px: u32 },
    #[error("the picture cannot be written as PNG")]
    Png(#[from] image::ImageError),
}

/// A drawing as PNG on white, `scale` pixels a unit.
pub fn rasterized(svg: &str, scale: f32) -> Result<Vec<u8>, PictureError> {
    let tree = usvg::Tree::from_str(svg, &OPTIONS)?;
    let [width_px, height_px] = [tree.size().width(), tree.size().height()].map(|side| (side * scale).ceil() as u32);
    let pixels = tiny_skia::Pixmap::new(width_px, height_px);
    let mut pixels = pixels.ok_or(PictureError::Size { width_px, height_px })?;
    pixels.fill(tiny_skia::Color::WHITE);
    resvg::render(&tree, tiny_skia::Transform::from_scale(scale, scale), &mut pixels.as_mut());
    let rgb: Vec<u8> = pixels.data().chunks_exact(4).flat_map(|pixel| [pixel[0], pixel[1], pixel[2]]).collect();
    let mut png = Vec::new();
    image::codecs::png::PngEncoder::new(&mut png).write_image(&rgb, width_px, height_px, ExtendedColorType::Rgb8)?;
    Ok(png)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::report::chart::svg::{Anchor, Shapes, Type, document};

    /// Dark pixels of a drawing of `text` alone.
    fn dark_pixels(text: &str, bold: bool) -> usize {
        let mut shapes = Shapes::default();
        let style = Type::new(20.0, "#000000").anchored(Anchor::Middle);
        shapes.text([60.0, 30.0], text, if bold { style.bold() } else { style });
        let png = rasterized(&document([120.0, 40.0], &shapes, ""), 2.0).expect("a small drawing");
        let image = image::load_from_memory(&png).expect("PNG").to_luma8();
        assert_eq!((image.width(), image.height()), (240, 80));
        image.pixels().filter(|pixel| pixel[0] < 128).count()
    }

    #[test]
    fn text_is_in_pictures_without_any_font_of_the_system() {
        assert_eq!(dark_pixels("", false), 0);
        let (regular, bold) = (dark_pixels("Error 12 m", false), dark_pixels("Error 12 m", true));
        assert!(regular > 300 && bold > regular + 50, "{regular} {bold}");
        // What formulas need is in the font.
        for symbol in ["σ", "χ", "²", "≤", "−", "±", "·", "–", "°", "…", "√", "×", "→", "ν"] {
            assert!(dark_pixels(symbol, false) > 2, "{symbol}");
        }
    }

    #[test]
    fn pictures_in_drawings_are_drawn() {
        let mut picture = Rgba::transparent(2, 2);
        picture.put(0, 0, [0, 0, 0]);
        let gray = gray_jpeg_address(&[0; 64], 8, 8);
        let mut shapes = Shapes::default();
        shapes.image([0.0, 0.0], [20.0, 20.0], &png_address(&picture), true);
        shapes.image([20.0, 0.0], [20.0, 20.0], &gray, false);
        let png = rasterized(&document([40.0, 20.0], &shapes, ""), 1.0).expect("a small drawing");
        let image = image::load_from_memory(&png).expect("PNG").to_luma8();
        let at = |x, y| image.get_pixel(x, y)[0];
        assert_eq!([at(5, 5), at(15, 15)], [0, 255], "the empty pixel shows the paper");
        assert!(at(30, 10) < 10);
    }
}
