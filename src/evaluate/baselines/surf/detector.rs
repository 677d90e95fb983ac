//! Blobs: Bay et al. (2008), section 3.

use nalgebra::{Matrix3, Vector3};

use super::SurfSettings;
use super::integral::IntegralImage;

/// Octaves, and filters in each: sides of 9, 15, 21, 27; 15, 27, 39, 51; 27, 51, 75, 99 pixels.
const OCTAVES: usize = 3;
const LAYERS: usize = 4;

/// A local maximum of the determinant in space and scale.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Blob {
    pub x_px: f64,
    pub y_px: f64,
    pub scale_px: f64,
    pub strength: f64,
}

/// The determinant on every 2^octave-th pixel; NaN, which is greater than nothing, where the filter is not wholly in the
/// image.
struct Layer {
    width: usize,
    values: Vec<f64>,
}

/// det H ≈ Dxx Dyy − (w Dxy)² with the box filters of lobe l, L = 3 l, each divided by L² (Bay et al. 2008, eq. 3 and
/// figure 2), at pixel (x, y). Three lobes of 2 l − 1 by l weigh 1, −2, 1; four of l by l, one pixel from the axes, ±1.
fn determinant(image: &IntegralImage, x: usize, y: usize, lobe: usize, cross_weight: f64) -> f64 {
    let (half, long) = (lobe / 2, lobe - 1);
    let outer = lobe + half;
    let along = |at: usize, reach: usize| [at - reach, at + reach + 1];
    let xx = image.sum(along(x, outer), along(y, long)) - 3.0 * image.sum(along(x, half), along(y, long));
    let yy = image.sum(along(x, long), along(y, outer)) - 3.0 * image.sum(along(x, long), along(y, half));
    let (before, after) = (|at: usize| [at - lobe, at], |at: usize| [at + 1, at + lobe + 1]);
    let xy = image.sum(after(x), before(y)) + image.sum(before(x), after(y))
        - image.sum(before(x), before(y))
        - image.sum(after(x), after(y));
    let per_area = 1.0 / (9 * lobe * lobe) as f64;
    let [xx, yy, xy] = [xx, yy, xy].map(|d| d * per_area);
    xx * yy - (cross_weight * xy).powi(2)
}

/// Lobe of a filter: a third of its side.
fn lobe(octave: usize, layer: usize) -> usize {
    (2 << octave) * (layer + 1) + 1
}

impl Layer {
    fn of(image: &IntegralImage, octave: usize, layer: usize, cross_weight: f64) -> Self {
        let (step, lobe) = (1 << octave, lobe(octave, layer));
        let border = lobe + lobe / 2;
        let (width, height) = (image.width().div_ceil(step), image.height().div_ceil(step));
        let mut values = vec![f64::NAN; width * height];
        for y in 0..height {
            for x in 0..width {
                let (at_x, at_y) = (x * step, y * step);
                let inside = |at: usize, size: usize| at >= border && at + border < size;
                if inside(at_x, image.width()) && inside(at_y, image.height()) {
                    values[y * width + x] = determinant(image, at_x, at_y, lobe, cross_weight);
                }
            }
        }
        Self { width, values }
    }
}

/// The blobs whose determinant is greater than the threshold.
pub fn interest_points(image: &IntegralImage, settings: &SurfSettings) -> Vec<Blob> {
    let mut blobs = Vec::new();
    for octave in 0..OCTAVES {
        let layers: [Layer; LAYERS] =
            std::array::from_fn(|layer| Layer::of(image, octave, layer, settings.cross_weight));
        let width = layers[0].width;
        let height = layers[0].values.len() / width.max(1);
        for middle in 1..LAYERS - 1 {
            let around = [&layers[middle - 1], &layers[middle], &layers[middle + 1]];
            for y in 1..height.saturating_sub(1) {
                for x in 1..width - 1 {
                    let at = y * width + x;
                    if around[1].values[at] > settings.threshold && is_greatest(around, at) {
                        blobs.extend(interpolated(around, at, octave, middle));
                    }
                }
            }
        }
    }
    blobs
}

/// Whether the value at `at` of the middle layer exceeds its 26 neighbours, all of which there must be.
fn is_greatest(layers: [&Layer; 3], at: usize) -> bool {
    let (width, value) = (layers[1].width, layers[1].values[at]);
    layers.iter().enumerate().all(|(i, layer)| {
        (0..9).all(|j| {
            let other = at + (j / 3) * width + j % 3 - width - 1;
            (i == 1 && other == at) || layer.values[other] < value
        })
    })
}

/// The summit of the quadric through the value at `at` and its neighbours (Brown & Lowe 2002): −H⁻¹ ∇ from it. `None` where
/// that is nearer to another sample, or there is no summit.
fn interpolated(layers: [&Layer; 3], at: usize, octave: usize, layer: usize) -> Option<Blob> {
    let width = layers[1].width;
    // In steps of x, y and the layer.
    let value = |dx: isize, dy: isize, dl: isize| {
        layers[(1 + dl) as usize].values[at.wrapping_add_signed(dy * width as isize + dx)]
    };
    let along = |d: [isize; 3], sign: isize| value(sign * d[0], sign * d[1], sign * d[2]);
    const AXES: [[isize; 3]; 3] = [[1, 0, 0], [0, 1, 0], [0, 0, 1]];
    let center = value(0, 0, 0);
    let gradient = Vector3::from_fn(|i, _| 0.5 * (along(AXES[i], 1) - along(AXES[i], -1)));
    let hessian = Matrix3::from_fn(|i, j| {
        if i == j {
            return along(AXES[i], 1) + along(AXES[i], -1) - 2.0 * center;
        }
        let (plus, minus): ([isize; 3], [isize; 3]) =
            (std::array::from_fn(|k| AXES[i][k] + AXES[j][k]), std::array::from_fn(|k| AXES[i][k] - AXES[j][k]));
        0.25 * (along(plus, 1) + along(plus, -1) - along(minus, 1) - along(minus, -1))
    });
    let offset = -hessian.lu().solve(&gradient)?;
    if !offset.iter().all(|o| o.abs() <= 0.5) {
        return None;
    }
    let step = (1 << octave) as f64;
    let lobe = (2 << octave) as f64 * (layer as f64 + 1.0 + offset[2]) + 1.0;
    Some(Blob {
        x_px: ((at % width) as f64 + offset[0]) * step,
        y_px: ((at / width) as f64 + offset[1]) * step,
        // The 9 × 9 filter, of lobe 3, stands for a deviation of 1.2.
        scale_px: 0.4 * lobe,
        strength: center,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The filters written out, pixel by pixel: figure 2 of Bay et al. (2008).
    #[test]
    fn the_smallest_filters_are_those_of_the_figure() {
        let pixels: Vec<f32> = (0..9 * 9).map(|i| ((i * i * 31 + 7 * i) % 97) as f32).collect();
        let (mut xx, mut yy, mut xy) = (0.0, 0.0, 0.0);
        for (i, value) in pixels.iter().enumerate() {
            let (x, y, value) = (i % 9, i / 9, f64::from(*value));
            let lobes = [1.0, -2.0, 1.0];
            if (2..7).contains(&y) {
                xx += lobes[x / 3] * value;
            }
            if (2..7).contains(&x) {
                yy += lobes[y / 3] * value;
            }
            let side = |at: usize| match at {
                1..=3 => -1.0,
                5..=7 => 1.0,
                _ => 0.0,
            };
            xy -= side(x) * side(y) * value;
        }
        let expected = xx * yy / 81.0 / 81.0 - (0.9 * xy / 81.0).powi(2);
        let found = determinant(&IntegralImage::of(&pixels, 9), 4, 4, 3, 0.9);
        assert!((found - expected).abs() < 1e-9 * expected.abs(), "{found} {expected}");
    }

    #[test]
    fn filters_have_the_sides_of_the_publication() {
        let sides = |octave: usize| -> Vec<usize> { (0..LAYERS).map(|layer| 3 * lobe(octave, layer)).collect() };
        assert_eq!((sides(0), sides(1)), (vec![9, 15, 21, 27], vec![15, 27, 39, 51]));
    }

    #[test]
    fn a_quadric_s_summit_is_found_exactly() {
        let summit = [0.2, -0.3, 0.1];
        let layer = |l: usize| Layer {
            width: 3,
            values: (0..9)
                .map(|i| {
                    let [x, y, l] = [(i % 3) as f64 - 1.0, (i / 3) as f64 - 1.0, l as f64 - 1.0];
                    let [x, y, l] = [x - summit[0], y - summit[1], l - summit[2]];
                    100.0 - x * x - 2.0 * y * y - 3.0 * l * l - 0.5 * x * y + 0.4 * y * l
                })
                .collect(),
        };
        let layers: [Layer; 3] = std::array::from_fn(layer);
        let around = [&layers[0], &layers[1], &layers[2]];
        let blob = interpolated(around, 4, 0, 1).expect("a summit");
        assert!((blob.x_px - 1.2).abs() < 1e-9 && (blob.y_px - 0.7).abs() < 1e-9, "{blob:?}");
        assert!((blob.scale_px - 0.4 * (2.0 * 2.1 + 1.0)).abs() < 1e-9, "{blob:?}");
    }
}
