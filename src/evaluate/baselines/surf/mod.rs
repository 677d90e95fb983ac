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

    /// A soft disk at (x, y) with a softer one beside it, so that there is an orientation.
    fn blob(width: usize, height: usize, [x, y]: [f64; 2], radius_px: f64, towards_rad: f64) -> Vec<f32> {
        let spot = |px: f64, py: f64, x: f64, y: f64, radius_px: f64| {
            (-0.5 * ((px - x).powi(2) + (py - y).powi(2)) / radius_px.powi(2)).exp()
        };
        let (x2, y2) = (x + 2.5 * radius_px * towards_rad.cos(), y + 2.5 * radius_px * towards_rad.sin());
        let pixel = |i: usize| {
            let (px, py) = ((i % width) as f64, (i / width) as f64);
            40.0 + 150.0 * spot(px, py, x, y, radius_px) + 40.0 * spot(px, py, x2, y2, 0.8 * radius_px)
        };
        (0..width * height).map(|i| pixel(i) as f32).collect()
    }

    #[test]
    fn a_blob_is_found_where_and_as_large_as_it_is() {
        let at = [81.3, 63.6];
        let points = describe(&blob(160, 128, at, 4.0, 0.7), 160, &SurfSettings::default());
        let strongest = points.first().expect("a blob");
        // The softer spot pulls a little.
        assert!((strongest.x_px - at[0]).abs() < 0.8 && (strongest.y_px - at[1]).abs() < 0.8, "{strongest:?}");
        // The determinant of a Gaussian blob is greatest at its own deviation; box filters are rough.
        assert!((3.0..5.5).contains(&strongest.scale_px), "{strongest:?}");
    }

    #[test]
    fn descriptors_turn_with_the_image() {
        let of = |towards_rad: f64| {
            describe(&blob(160, 160, [80.0, 80.0], 5.0, towards_rad), 160, &SurfSettings::default())[0].clone()
        };
        let straight = of(0.0);
        for towards_rad in [0.4, 1.3, -2.0] {
            let turned = of(towards_rad);
            let error_rad =
                crate::types::wrap_angle_rad(turned.orientation_rad - straight.orientation_rad - towards_rad);
            assert!(error_rad.abs() < 0.15, "{towards_rad}: {error_rad}");
            let alike: f32 = straight.descriptor.iter().zip(&turned.descriptor).map(|(a, b)| a * b).sum();
            assert!(alike > 0.95, "{towards_rad}: {alike}");
        }
    }

    #[test]
    fn points_of_a_panorama_are_those_of_the_turned_one_shifted() {
        let pixels = blob(WIDE_COLUMNS, WIDE_ROWS, [8.0, 60.0], 5.0, 2.0);
        let there = Panorama::from_wide(pixels);
        let turned = there.rolled(8 * 40);
        let (a, b) = (describe_panorama(&there), describe_panorama(&turned));
        assert!(!a.is_empty() && a.len() == b.len());
        for (a, b) in a.iter().zip(&b) {
            assert!((a.x_px + 160.0 - b.x_px).rem_euclid(WIDE_COLUMNS as f64) < 1e-6);
            assert!(a.descriptor.iter().zip(&b.descriptor).all(|(a, b)| (a - b).abs() < 1e-4));
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
