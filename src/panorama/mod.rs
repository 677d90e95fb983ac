//! The donut, unwrapped.
//!
//! A panorama has row 0 at the rim that [`DonutCalibration::top_is_outer`] names and column 0 in the direction of
//! [`DonutCalibration::start_angle_rad`]; columns run on from there all the way round, so that the last column lies
//! next to the first. It is sampled at 1024 × 256 and kept at the three sizes the descriptors use: turning the vehicle
//! shifts the columns, so anything meant to be yaw-exact starts from the 1024 columns.

// The same estimates on every computer.
#![cfg_attr(not(test), deny(clippy::disallowed_methods))]

mod unwrap;

pub use unwrap::UnwrapTable;

/// Columns and rows of the sampled panorama.
pub const SAMPLED_COLUMNS: usize = 1024;
pub const SAMPLED_ROWS: usize = 256;
/// Columns and rows of [`Panorama::wide`].
pub const WIDE_COLUMNS: usize = 512;
pub const WIDE_ROWS: usize = 128;
/// Columns and rows of [`Panorama::gray`].
pub const GRAY_SIZE: usize = 128;

/// One unwrapped frame; gray values in 0..=255, row-major.
#[derive(Debug, Clone, PartialEq)]
pub struct Panorama {
    /// [`WIDE_ROWS`] × [`WIDE_COLUMNS`], area-averaged.
    pub wide: Vec<f32>,
    /// [`GRAY_SIZE`] × [`GRAY_SIZE`], area-averaged: the f\[a, b\] of the paper.
    pub gray: Vec<f32>,
    /// Mean gray value of each of the [`SAMPLED_COLUMNS`] columns.
    pub column_means: Vec<f32>,
}

impl Panorama {
    /// A panorama of zeros, to be filled by [`UnwrapTable::unwrap_into`].
    pub fn zeros() -> Self {
        Self {
            wide: vec![0.0; WIDE_ROWS * WIDE_COLUMNS],
            gray: vec![0.0; GRAY_SIZE * GRAY_SIZE],
            column_means: vec![0.0; SAMPLED_COLUMNS],
        }
    }

    /// The panorama with this `wide` image; the column means then have the resolution of `wide`.
    ///
    /// # Panics
    /// When `wide` is not [`WIDE_ROWS`] × [`WIDE_COLUMNS`].
    pub fn from_wide(wide: Vec<f32>) -> Self {
        assert_eq!(wide.len(), WIDE_ROWS * WIDE_COLUMNS, "one value a pixel");
        let mut panorama = Self { wide, ..Self::zeros() };
        panorama.reduce_to_gray();
        for row in panorama.wide.chunks_exact(WIDE_COLUMNS) {
            for (pair, value) in panorama.column_means.chunks_exact_mut(SAMPLED_COLUMNS / WIDE_COLUMNS).zip(row) {
                pair.iter_mut().for_each(|mean| *mean += value / WIDE_ROWS as f32);
            }
        }
        panorama
    }

    /// `gray` from `wide`, which has as many rows.
    fn reduce_to_gray(&mut self) {
        let per_gray = WIDE_COLUMNS / GRAY_SIZE;
        for (gray, group) in self.gray.iter_mut().zip(self.wide.chunks_exact(per_gray)) {
            *gray = group.iter().sum::<f32>() / per_gray as f32;
        }
    }

    /// The panorama as if the camera had been turned: column `j` moves to column `j + columns` of
    /// [`SAMPLED_COLUMNS`], which must be a multiple of what one column of `gray` spans (8).
    #[cfg(test)]
    pub(crate) fn rolled(&self, columns: usize) -> Self {
        let per_gray = SAMPLED_COLUMNS / GRAY_SIZE;
        assert_eq!(columns % per_gray, 0, "whole gray columns only");
        let roll = |values: &[f32], width: usize| -> Vec<f32> {
            let by = columns * width / SAMPLED_COLUMNS;
            values.chunks(width).flat_map(|row| (0..width).map(move |j| row[(j + width - by) % width])).collect()
        };
        Self {
            wide: roll(&self.wide, WIDE_COLUMNS),
            gray: roll(&self.gray, GRAY_SIZE),
            column_means: roll(&self.column_means, SAMPLED_COLUMNS),
        }
    }
}
