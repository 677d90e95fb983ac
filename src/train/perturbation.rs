//! The same place on another day, guessed: a panorama with other light, shadows, traffic and a slightly tilted camera.
//!
//! One drive shows how features change from place to place, not from day to day. These perturbations show how they
//! react to what a day changes, so that directions that react strongly can be trusted less (see
//! [`noise_whitening`](super::noise_whitening)). The ranges were chosen to be plausible, not fitted to any data set.

use std::f32::consts::TAU;

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::panorama::{Panorama, WIDE_COLUMNS, WIDE_ROWS};

/// Largest tilt of the camera, as a shift of rows \[px of the wide panorama\].
const MAX_TILT_ROWS: f32 = 1.5;
/// Deviation of log γ of the tone curve, of the overall log-exposure, and of the log-light around the horizon (first and
/// second harmonic) and from rim to rim.
const LOG_GAMMA_STD: f32 = 0.25;
const LOG_EXPOSURE_STD: f32 = 0.3;
const LOG_SIDE_LIGHT_STD: f32 = 0.3;
const LOG_SECOND_HARMONIC_STD: f32 = 0.15;
const LOG_VERTICAL_STD: f32 = 0.3;
/// Up to so many shadows, and so many vehicles or people.
const MAX_SHADOWS: u32 = 3;
const MAX_OCCLUDERS: u32 = 3;
/// Deviation of pixel noise \[gray levels\].
const PIXEL_NOISE_STD: f32 = 2.0;

/// A perturbed copy of `panorama`; `seed` and `stream` say which.
pub fn perturbed(panorama: &Panorama, seed: u64, stream: u64) -> Panorama {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    random.set_stream(stream);
    let mut wide = tilted(&panorama.wide, &mut random);
    relight(&mut wide, &mut random);
    occlude(&mut wide, &mut random);
    for value in &mut wide {
        *value = (*value + PIXEL_NOISE_STD * standard_normal(&mut random)).clamp(0.0, 255.0);
    }
    Panorama::from_wide(wide)
}

/// Rows shifted by a cosine of the azimuth: what a small tilt does.
fn tilted(wide: &[f32], random: &mut ChaCha8Rng) -> Vec<f32> {
    let (amplitude, direction) = (random.random_range(0.0..MAX_TILT_ROWS), random.random_range(0.0..TAU));
    let shifts: Vec<f32> = (0..WIDE_COLUMNS).map(|column| amplitude * (azimuth(column) - direction).cos()).collect();
    let mut tilted = Vec::with_capacity(wide.len());
    for row in 0..WIDE_ROWS {
        for (column, shift) in shifts.iter().enumerate() {
            let from = (row as f32 + shift).clamp(0.0, (WIDE_ROWS - 1) as f32);
            let above = (from as usize).min(WIDE_ROWS - 2);
            let fraction = from - above as f32;
            let (a, b) = (wide[above * WIDE_COLUMNS + column], wide[(above + 1) * WIDE_COLUMNS + column]);
            tilted.push(a + fraction * (b - a));
        }
    }
    tilted
}

/// Another tone curve, exposure and distribution of light, and hard-edged shadows or patches of sun.
fn relight(wide: &mut [f32], random: &mut ChaCha8Rng) {
    let gamma = (LOG_GAMMA_STD * standard_normal(random)).exp();
    let exposure = LOG_EXPOSURE_STD * standard_normal(random);
    let (side, side_at) = (LOG_SIDE_LIGHT_STD * standard_normal(random), random.random_range(0.0..TAU));
    let (second, second_at) = (LOG_SECOND_HARMONIC_STD * standard_normal(random), random.random_range(0.0..TAU));
    let vertical = LOG_VERTICAL_STD * standard_normal(random);
    let of_column: Vec<f32> = (0..WIDE_COLUMNS)
        .map(|column| {
            let azimuth = azimuth(column);
            exposure + side * (azimuth - side_at).cos() + second * (2.0 * azimuth - second_at).cos()
        })
        .collect();
    let mut log_light: Vec<f32> = (0..WIDE_ROWS)
        .flat_map(|row| {
            let from_middle = row as f32 / WIDE_ROWS as f32 - 0.5;
            of_column.iter().map(move |light| light + vertical * from_middle)
        })
        .collect();
    for _ in 0..random.random_range(0..=MAX_SHADOWS) {
        let (width, height) = (random.random_range(15..120), random.random_range(15..60));
        let (left, top) = (random.random_range(0..WIDE_COLUMNS), random.random_range(0..WIDE_ROWS - height));
        let (skew, strength) = (random.random_range(-1.0..1.0_f32), random.random_range(-0.7..0.5_f32));
        for row in 0..height {
            let start = left as i32 + (skew * row as f32) as i32;
            for column in start..start + width {
                let column = column.rem_euclid(WIDE_COLUMNS as i32) as usize;
                log_light[(top + row) * WIDE_COLUMNS + column] += strength;
            }
        }
    }
    for (value, log_light) in wide.iter_mut().zip(log_light) {
        *value = 255.0 * (value.clamp(0.0, 255.0) / 255.0).powf(gamma) * log_light.exp();
    }
}

/// Plain boxes near the horizon, the taller ones with a roof of another shade.
fn occlude(wide: &mut [f32], random: &mut ChaCha8Rng) {
    for _ in 0..random.random_range(0..=MAX_OCCLUDERS) {
        let (width, height) = (random.random_range(6..50), random.random_range(10..40));
        let left = random.random_range(0..WIDE_COLUMNS);
        let rows = WIDE_ROWS as f32;
        let top = random.random_range(0.35 * rows..0.9 * rows - height as f32 / 2.0) as usize;
        let shade = random.random_range(10.0..200.0);
        fill(wide, left, top, width, height, shade);
        if height > 16 {
            fill(wide, left + width / 6, top, width * 2 / 3, height / 3, random.random_range(10.0..200.0));
        }
    }
}

fn fill(wide: &mut [f32], left: usize, top: usize, width: usize, height: usize, shade: f32) {
    for row in top..(top + height).min(WIDE_ROWS) {
        for column in left..left + width {
            wide[row * WIDE_COLUMNS + column % WIDE_COLUMNS] = shade;
        }
    }
}

fn azimuth(column: usize) -> f32 {
    TAU * column as f32 / WIDE_COLUMNS as f32
}

/// A standard normal number (Box & Muller 1958).
pub(crate) fn standard_normal(random: &mut ChaCha8Rng) -> f32 {
    let radius = (-2.0 * (1.0 - random.random::<f32>()).ln()).sqrt();
    radius * (TAU * random.random::<f32>()).cos()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn panorama() -> Panorama {
        let wide = (0..WIDE_ROWS * WIDE_COLUMNS).map(|i| 100.0 + 50.0 * (i as f32 / 37.0).sin()).collect();
        Panorama::from_wide(wide)
    }

    #[test]
    fn a_seed_repeats_and_streams_differ() {
        assert_eq!(perturbed(&panorama(), 1, 2), perturbed(&panorama(), 1, 2));
        assert_ne!(perturbed(&panorama(), 1, 2), perturbed(&panorama(), 1, 3));
    }

    #[test]
    fn values_stay_in_range_whatever_the_dice() {
        for stream in 0..50 {
            let perturbed = perturbed(&panorama(), 7, stream);
            assert!(perturbed.wide.iter().all(|value| (0.0..=255.0).contains(value)));
        }
    }

    #[test]
    fn normal_numbers_have_mean_zero_and_unit_variance() {
        let mut random = ChaCha8Rng::seed_from_u64(5);
        let values: Vec<f32> = (0..20_000).map(|_| standard_normal(&mut random)).collect();
        let mean = values.iter().sum::<f32>() / 20_000.0;
        let variance = values.iter().map(|v| v * v).sum::<f32>() / 20_000.0;
        assert!(mean.abs() < 0.03 && (variance - 1.0).abs() < 0.05, "{mean} {variance}");
    }
}
