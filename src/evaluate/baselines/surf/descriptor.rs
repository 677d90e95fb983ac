//! What is about a blob: Bay et al. (2008), section 4.

use std::f64::consts::{FRAC_PI_3, TAU};

use super::DIMENSIONS;
use super::detector::Blob;
use super::integral::IntegralImage;

/// Deviations of the Gaussian weights for orientation and descriptor, in scales.
const ORIENTATION_DEVIATION: f64 = 2.0;
const DESCRIPTOR_DEVIATION: f64 = 3.3;
/// Sub-regions along a side, and samples along a side of one.
const REGIONS: usize = 4;
const SAMPLES: usize = 5;

/// Where the gray values rise most about `blob` (section 4.1): of the responses of wavelets of side 4 s within 6 s, weighted
/// with a Gaussian of 2 s, those with a direction within a sector of 60° are added up; the longest sum of all sectors.
pub fn orientation_rad(image: &IntegralImage, blob: &Blob) -> f64 {
    let s = blob.scale_px;
    let half = ((2.0 * s).round() as usize).max(1);
    let mut responses = Vec::with_capacity(113);
    for i in -6..=6 {
        for j in -6..=6 {
            let (x, y) = (f64::from(i), f64::from(j));
            let square = x * x + y * y;
            if square < 36.0 {
                let weight = (-0.5 * square / (ORIENTATION_DEVIATION * ORIENTATION_DEVIATION)).exp();
                let [dx, dy] = image.haar(blob.x_px + s * x, blob.y_px + s * y, half).map(|d| weight * d);
                responses.push((dy.atan2(dx), [dx, dy]));
            }
        }
    }
    let sum_from = |from_rad: f64| {
        let within = |angle_rad: f64| (angle_rad - from_rad).rem_euclid(TAU) < FRAC_PI_3;
        responses
            .iter()
            .filter(|(angle_rad, _)| within(*angle_rad))
            .fold([0.0, 0.0], |[x, y], (_, [dx, dy])| [x + dx, y + dy])
    };
    let sums = responses.iter().map(|&(from_rad, _)| sum_from(from_rad));
    let longest = sums.max_by(|a, b| (a[0].hypot(a[1])).total_cmp(&b[0].hypot(b[1])));
    longest.map_or(0.0, |[x, y]| y.atan2(x))
}

/// Section 4.2: a window of side 20 s, turned by the orientation, in 4 × 4 regions of 5 × 5 samples; of the responses d of
/// wavelets of side 2 s in the turned axes, weighted with a Gaussian of 3.3 s, each region gives Σ dx, Σ dy, Σ |dx|, Σ |dy|.
/// Unit length; zeros where nothing changes.
pub fn descriptor(image: &IntegralImage, blob: &Blob, orientation_rad: f64) -> [f32; DIMENSIONS] {
    let s = blob.scale_px;
    let half = (s.round() as usize).max(1);
    let (sin, cos) = orientation_rad.sin_cos();
    let mut sums = [[0.0; 4]; REGIONS * REGIONS];
    let side = REGIONS * SAMPLES;
    let from_center = |i: usize| i as f64 - 0.5 * (side - 1) as f64;
    for row in 0..side {
        for column in 0..side {
            let (u, v) = (from_center(column), from_center(row));
            let (x, y) = (blob.x_px + s * (cos * u - sin * v), blob.y_px + s * (sin * u + cos * v));
            let weight = (-0.5 * (u * u + v * v) / (DESCRIPTOR_DEVIATION * DESCRIPTOR_DEVIATION)).exp();
            let [dx, dy] = image.haar(x, y, half).map(|d| weight * d);
            let (du, dv) = (cos * dx + sin * dy, cos * dy - sin * dx);
            let sums = &mut sums[row / SAMPLES * REGIONS + column / SAMPLES];
            sums.iter_mut().zip([du, dv, du.abs(), dv.abs()]).for_each(|(sum, d)| *sum += d);
        }
    }
    let sums = sums.as_flattened();
    let length = sums.iter().map(|d| d * d).sum::<f64>().sqrt();
    std::array::from_fn(|i| if length > 0.0 { (sums[i] / length) as f32 } else { 0.0 })
}
