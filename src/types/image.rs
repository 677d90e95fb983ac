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

/// Tiles of 8 × 8 px of an image: those that hold what somebody needs of it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Tiles {
    columns: usize,
    /// By rows.
    needed: Vec<bool>,
}

impl Tiles {
    pub const SIDE_PX: usize = 8;

    /// No tile of an image of `width_px` × `height_px`.
    pub fn none(width_px: usize, height_px: usize) -> Self {
        let columns = width_px.div_ceil(Self::SIDE_PX);
        Self { columns, needed: vec![false; columns * height_px.div_ceil(Self::SIDE_PX)] }
    }

    /// Adds the tile that holds pixel (`x`, `y`).
    ///
    /// # Panics
    /// When there is no such pixel.
    pub fn add_pixel(&mut self, x: usize, y: usize) {
        assert!(x / Self::SIDE_PX < self.columns, "column {x} is outside the image");
        self.needed[y / Self::SIDE_PX * self.columns + x / Self::SIDE_PX] = true;
    }

    /// Whether tile (`column`, `row`) is needed; none outside the image is.
    #[inline]
    pub fn contains(&self, column: usize, row: usize) -> bool {
        column < self.columns && self.needed.get(row * self.columns + column) == Some(&true)
    }
}
