//! Images as the rest of the program sees them.

/// An 8-bit luma image: `pixels[y * width_px + x]`, row 0 on top, 0 black, 255 white.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct LumaImage {
    pub width_px: usize,
    pub height_px: usize,
    pub pixels: Vec<u8>,
}

impl LumaImage {
    /// An image whose pixel at column `x`, row `y` is `value(x, y)`.
    pub fn from_fn(width_px: usize, height_px: usize, value: impl Fn(usize, usize) -> u8) -> Self {
        let pixels =
            (0..height_px).flat_map(|y| (0..width_px).map(move |x| (x, y))).map(|(x, y)| value(x, y)).collect();
        Self { width_px, height_px, pixels }
    }

    pub fn row(&self, y: usize) -> &[u8] {
        &self.pixels[y * self.width_px..(y + 1) * self.width_px]
    }
}
