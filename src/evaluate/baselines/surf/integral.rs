//! Sums over upright boxes in four look-ups.

/// I(x, y) = Σ of all pixels left of x and above y.
pub struct IntegralImage {
    width: usize,
    height: usize,
    /// (height + 1) × (width + 1).
    sums: Vec<f64>,
}

impl IntegralImage {
    /// Of an image that is `width` columns wide.
    pub fn of(pixels: &[f32], width: usize) -> Self {
        let height = pixels.len() / width;
        let mut sums = vec![0.0; (width + 1) * (height + 1)];
        for (y, row) in pixels.chunks_exact(width).enumerate() {
            let mut of_row = 0.0;
            for (x, value) in row.iter().enumerate() {
                of_row += f64::from(*value);
                sums[(y + 1) * (width + 1) + x + 1] = sums[y * (width + 1) + x + 1] + of_row;
            }
        }
        Self { width, height, sums }
    }

    pub fn width(&self) -> usize {
        self.width
    }

    pub fn height(&self) -> usize {
        self.height
    }

    /// Σ over x0 ≤ x < x1, y0 ≤ y < y1, which must lie in the image.
    pub fn sum(&self, [x0, x1]: [usize; 2], [y0, y1]: [usize; 2]) -> f64 {
        let at = |x: usize, y: usize| self.sums[y * (self.width + 1) + x];
        (at(x1, y1) - at(x0, y1)) - (at(x1, y0) - at(x0, y0))
    }

    /// How the gray values rise along x and y about the point (x, y): the box of 2 `half` × 2 `half` pixels that is centred
    /// nearest to it, one half minus the other. 0 where it is not wholly in the image.
    pub fn haar(&self, x: f64, y: f64, half: usize) -> [f64; 2] {
        // The border between pixels i − 1 and i is at i − ½.
        let (x, y) = ((x + 0.5).round(), (y + 0.5).round());
        let reach = half as f64;
        let inside = |at: f64, size: usize| at - reach >= 0.0 && at + reach <= size as f64;
        if !inside(x, self.width) || !inside(y, self.height) {
            return [0.0; 2];
        }
        let (x, y) = (x as usize, y as usize);
        let (left, right, above, below) = (x - half, x + half, y - half, y + half);
        [
            self.sum([x, right], [above, below]) - self.sum([left, x], [above, below]),
            self.sum([left, right], [y, below]) - self.sum([left, right], [above, y]),
        ]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sums_are_those_of_the_pixels() {
        let pixels: Vec<f32> = (0..5 * 7).map(|i| ((i * 37) % 11) as f32).collect();
        let image = IntegralImage::of(&pixels, 7);
        for (xs, ys) in [([0, 7], [0, 5]), ([2, 5], [1, 4]), ([3, 3], [0, 2]), ([6, 7], [4, 5])] {
            let direct: f32 =
                (ys[0]..ys[1]).flat_map(|y| (xs[0]..xs[1]).map(move |x| y * 7 + x)).map(|i| pixels[i]).sum();
            assert_eq!(image.sum(xs, ys), f64::from(direct));
        }
    }

    #[test]
    fn a_slope_rises_by_its_slope() {
        let pixels: Vec<f32> = (0..20 * 30).map(|i| (2 * (i % 30) + 5 * (i / 30)) as f32).collect();
        let image = IntegralImage::of(&pixels, 30);
        // Two boxes of 8 × 4 pixels whose centres are 4 apart.
        assert_eq!(image.haar(14.6, 10.3, 4), [2.0 * 4.0 * 32.0, 5.0 * 4.0 * 32.0]);
        assert_eq!(image.haar(2.0, 10.0, 4), [0.0; 2]);
    }
}
