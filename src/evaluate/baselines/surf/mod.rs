//! SURF, the local descriptor of the paper's bag of words: Bay, Ess, Tuytelaars & Van Gool, “Speeded-up robust features
//! (SURF)”, Computer Vision and Image Understanding 110 (2008) 346–359, cited as Bay et al. (2008).
//!
//! Blobs are where the determinant of the Hessian is greatest in space and scale, with box filters for the second
//! derivatives of a Gaussian; each is described by how the gray values change about it, turned to where they change most.
//! Written from that publication.
//!
//! **Patents.** US 8,165,401, US 8,670,619 and EP 2027558 are about this method and may be in force.
//! This is an academic baseline: it is built only with the feature `surf`, no released package has it, and nothing else
//! depends on it.

mod descriptor;
mod detector;
mod integral;

use descriptor::{descriptor, orientation_rad};
use detector::interest_points;
pub use integral::IntegralImage;

use crate::panorama::{Panorama, WIDE_COLUMNS, WIDE_ROWS};

/// Numbers of a descriptor.
pub const DIMENSIONS: usize = 64;
/// What counts as a blob.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SurfSettings {
    /// Blobs with a smaller determinant are none, in gray levels⁴ (0..=255).
    pub threshold: f64,
    /// What balances the box filter of the mixed derivative: w of their eq. 3. Others take 0.6.
    pub cross_weight: f64,
}

impl Default for SurfSettings {
    fn default() -> Self {
        Self { threshold: 30.0, cross_weight: 0.9 }
    }
}

/// Columns of its other end that a panorama is continued with: nearly the radius of the largest descriptor.
const MARGIN: usize = 96;

/// A blob and its surroundings.
#[derive(Debug, Clone, PartialEq)]
pub struct SurfPoint {
    /// Pixel centres are at integer coordinates.
    pub x_px: f64,
    pub y_px: f64,
    /// Deviation of the Gaussian whose derivatives it was found with \[px\].
    pub scale_px: f64,
    /// The determinant.
    pub strength: f64,
    /// Where the gray values rise most, from x towards y, −π..π.
    pub orientation_rad: f64,
    pub descriptor: [f32; DIMENSIONS],
}

/// All blobs of a `width`-columns wide image of gray values 0..=255, the strongest first.
pub fn describe(pixels: &[f32], width: usize, settings: &SurfSettings) -> Vec<SurfPoint> {
    let image = IntegralImage::of(pixels, width);
    let mut points: Vec<SurfPoint> = interest_points(&image, settings)
        .into_iter()
        .map(|blob| {
            let orientation_rad = orientation_rad(&image, &blob);
            SurfPoint {
                x_px: blob.x_px,
                y_px: blob.y_px,
                scale_px: blob.scale_px,
                strength: blob.strength,
                orientation_rad,
                descriptor: descriptor(&image, &blob, orientation_rad),
            }
        })
        .collect();
    points.sort_by(|a, b| b.strength.total_cmp(&a.strength));
    points
}

/// All blobs of the 512 × 128 panorama, each once wherever its seam lies.
pub fn describe_panorama(panorama: &Panorama) -> Vec<SurfPoint> {
    let mut continued = Vec::with_capacity((WIDE_COLUMNS + 2 * MARGIN) * WIDE_ROWS);
    for row in panorama.wide.chunks_exact(WIDE_COLUMNS) {
        continued.extend(&row[WIDE_COLUMNS - MARGIN..]);
        continued.extend(row);
        continued.extend(&row[..MARGIN]);
    }
    let first = MARGIN as f64 - 0.5;
    let mut points = describe(&continued, WIDE_COLUMNS + 2 * MARGIN, &SurfSettings::default());
    points.retain(|point| (first..first + WIDE_COLUMNS as f64).contains(&point.x_px));
    points.iter_mut().for_each(|point| point.x_px -= MARGIN as f64);
    points
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A soft spot at (x, y) on a slope that rises towards `towards_rad`.
    fn blob(width: usize, height: usize, [x, y]: [f64; 2], radius_px: f64, towards_rad: f64) -> Vec<f32> {
        let pixel = |i: usize| {
            let (dx, dy) = ((i % width) as f64 - x, (i / width) as f64 - y);
            let spot = (-0.5 * (dx * dx + dy * dy) / (radius_px * radius_px)).exp();
            100.0 + 80.0 * spot + 1.5 * (dx * towards_rad.cos() + dy * towards_rad.sin())
        };
        (0..width * height).map(|i| pixel(i) as f32).collect()
    }

    #[test]
    fn a_blob_is_found_where_and_as_large_as_it_is() {
        let at = [81.3, 63.6];
        let of = |radius_px: f64| {
            let points = describe(&blob(160, 128, at, radius_px, 0.7), 160, &SurfSettings::default());
            points.first().expect("a blob").clone()
        };
        let (small, large) = (of(3.0), of(6.0));
        for found in [&small, &large] {
            assert!((found.x_px - at[0]).abs() < 0.3 && (found.y_px - at[1]).abs() < 0.3, "{found:?}");
        }
        // Box filters are rough; that twice the size is twice the scale they must show.
        assert!((1.7..2.3).contains(&(large.scale_px / small.scale_px)), "{} {}", small.scale_px, large.scale_px);
    }

    #[test]
    fn descriptors_turn_with_the_image() {
        let of = |towards_rad: f64| {
            let image = blob(160, 160, [80.3, 79.6], 5.0, towards_rad);
            describe(&image, 160, &SurfSettings::default()).first().expect("a blob").clone()
        };
        let straight = of(0.0);
        for towards_rad in [0.4, 1.3, -2.0] {
            let turned = of(towards_rad);
            let error_rad =
                crate::types::wrap_angle_rad(turned.orientation_rad - straight.orientation_rad - towards_rad);
            // A round spot says little of a direction: half of a sector.
            assert!(error_rad.abs() < 0.5, "{towards_rad}: {error_rad}");
            let alike: f32 = straight.descriptor.iter().zip(&turned.descriptor).map(|(a, b)| a * b).sum();
            assert!(alike > 0.95, "{towards_rad}: {alike}");
        }
    }

    #[test]
    fn points_of_a_panorama_are_those_of_the_turned_one_shifted() {
        let spots = [[3.3, 40.6, 3.0], [120.7, 60.2, 4.0], [250.4, 80.9, 5.0], [505.6, 70.3, 6.0]];
        let pixel = |i: usize| {
            let (x, y) = ((i % WIDE_COLUMNS) as f64, (i / WIDE_COLUMNS) as f64);
            let of_spot = |[at_x, at_y, radius_px]: [f64; 3]| {
                let half = WIDE_COLUMNS as f64 / 2.0;
                let dx = (x - at_x + half).rem_euclid(2.0 * half) - half;
                (-0.5 * (dx * dx + (y - at_y).powi(2)) / (radius_px * radius_px)).exp()
            };
            (50.0 + 150.0 * spots.into_iter().map(of_spot).sum::<f64>()) as f32
        };
        let there = Panorama::from_wide((0..WIDE_COLUMNS * WIDE_ROWS).map(pixel).collect());
        let sorted = |panorama: &Panorama, shift_px: f64| {
            let mut points = describe_panorama(panorama);
            let width = WIDE_COLUMNS as f64;
            points.iter_mut().for_each(|point| point.x_px = (point.x_px + shift_px + 1.0).rem_euclid(width));
            points.sort_by(|a, b| a.x_px.total_cmp(&b.x_px));
            points
        };
        // 8 · 40 columns of the sampled panorama are 160 of this one.
        let (before, after) = (sorted(&there, 160.0), sorted(&there.rolled(8 * 40), 0.0));
        assert!(before.len() >= spots.len() && before.len() == after.len(), "{} {}", before.len(), after.len());
        for (a, b) in before.iter().zip(&after) {
            assert!((a.x_px - b.x_px).abs() < 1e-3 && (a.y_px - b.y_px).abs() < 1e-3, "{a:?} {b:?}");
            assert!((a.scale_px - b.scale_px).abs() < 1e-3, "{a:?} {b:?}");
        }
    }

    #[test]
    fn an_image_without_contrast_has_no_points() {
        for gray in [0.0, 255.0] {
            assert!(describe(&vec![gray; 100 * 80], 100, &SurfSettings::default()).is_empty());
        }
        assert!(describe(&[], 1, &SurfSettings::default()).is_empty());
    }
}
