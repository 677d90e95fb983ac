//! The reference values of `tests/data/golden.json`, made by an independent implementation (and by pyrtools where the
//! key says so).

use serde_json::Value;

use crate::panorama::{GRAY_SIZE, Panorama, SAMPLED_COLUMNS};

pub fn golden() -> Value {
    serde_json::from_str(include_str!("../tests/data/golden.json")).expect("golden.json parses")
}

pub fn list(value: &Value) -> Vec<f64> {
    value.as_array().expect("a list").iter().map(|entry| entry.as_f64().expect("a number")).collect()
}

/// The test image of `golden.json`: gray value of row a, column b.
pub fn golden_gray(a: usize, b: usize) -> f64 {
    use std::f64::consts::TAU;
    let n = GRAY_SIZE as f64;
    let (x, y) = (b as f64, a as f64);
    let texture = ((73 * a + 151 * b + 7 * a * b) % 97) as f64 / 4.0;
    110.0 + 55.0 * (TAU * 3.0 * x / n + y / 9.0).sin() + 35.0 * (TAU * 5.0 * y / n).cos() + texture
}

/// The test image as a panorama.
pub fn golden_panorama() -> Panorama {
    let mut panorama = Panorama::zeros();
    for (i, value) in panorama.gray.iter_mut().enumerate() {
        *value = golden_gray(i / GRAY_SIZE, i % GRAY_SIZE) as f32;
    }
    let sum: f64 = panorama.gray.iter().map(|&value| f64::from(value)).sum();
    assert!((sum - golden()["image_sum"].as_f64().expect("a number")).abs() < 0.1, "the image is the one meant: {sum}");
    for (j, mean) in panorama.column_means.iter_mut().enumerate() {
        let b = j * GRAY_SIZE / SAMPLED_COLUMNS;
        *mean = ((0..GRAY_SIZE).map(|a| golden_gray(a, b)).sum::<f64>() / GRAY_SIZE as f64) as f32;
    }
    panorama
}

/// Every entry within `tolerance` of the expected one, relative to it.
pub fn assert_close(name: &str, found: &[f32], expected: &[f64], tolerance: f64) {
    assert_eq!(found.len(), expected.len(), "{name}");
    for (i, (&found, &expected)) in found.iter().zip(expected).enumerate() {
        let error = (f64::from(found) - expected).abs() / expected.abs();
        assert!(error < tolerance, "{name}[{i}]: {found} instead of {expected} (relative {error:.1e})");
    }
}
