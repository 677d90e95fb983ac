//! Camera image → panorama, by a table made once per calibration.

use std::cell::RefCell;
use std::f64::consts::TAU;

use multiversion::multiversion;

use super::{Panorama, SAMPLED_COLUMNS, SAMPLED_ROWS, WIDE_COLUMNS, WIDE_ROWS};
use crate::types::{AzimuthSense, CalibrationError, DonutCalibration, LumaImage, Tiles};

/// Where in the camera image every sample of the panorama lies.
///
/// Sample (k, j) of the K × J = [`SAMPLED_ROWS`] × [`SAMPLED_COLUMNS`] panorama lies at
///
/// ```text
/// φ = start ± 2π (j + ½) / J        + where columns run clockwise on the screen
/// r = r_out − (r_out − r_in) (k + ½) / K      (row 0 is the outer rim; else r_in + …)
/// (x, y) = (cx + r cos φ, cy + r sin φ)       pixel centres at integer coordinates
/// ```
///
/// and is interpolated bilinearly. Where a sample spans more than [`MAX_SPACING_PX`] camera pixels, several sub-samples
/// are averaged, so that no camera pixel is skipped: the reduction is an area average at every size of camera image.
#[derive(Debug, Clone)]
pub struct UnwrapTable {
    image_width_px: usize,
    image_height_px: usize,
    azimuth: AzimuthSense,
    /// Sub-samples a sample, in azimuth and in radius.
    sub_columns: usize,
    sub_rows: usize,
    /// Tile × row × column: `K·sub_rows` rows of `J·sub_columns` columns, in tiles of [`TILE_COLUMNS`]` · sub_columns`.
    samples: Vec<Sample>,
    /// What they are interpolated from.
    needed: Tiles,
}

/// A bilinear sample: the top left of four neighbouring pixels and the weights of the right and the lower ones, in steps
/// of 1/65535: the table is read whole for every frame, and half the size is half the time.
#[derive(Debug, Clone, Copy)]
struct Sample {
    index: u32,
    right: u16,
    below: u16,
}

/// Columns unwrapped at a time, from rim to rim: so many that the camera pixels of one row are still in the fastest cache
/// when the next needs them.
const TILE_COLUMNS: usize = 64;
/// Samples interpolated at a time: their pixels are gathered first, one by one, and then weighed many at once.
const GATHERED: usize = 2 * TILE_COLUMNS;

/// Bilinear samples further apart than this skip pixels \[px\].
const MAX_SPACING_PX: f64 = 2.1;

thread_local! {
    /// The samples of one row of a tile, and their means: kept, so that a frame costs no allocation.
    static BUFFERS: RefCell<[Vec<f32>; 2]> = const { RefCell::new([Vec::new(), Vec::new()]) };
}

impl UnwrapTable {
    /// The table for images of `width_px` × `height_px`.
    ///
    /// # Errors
    /// When the donut does not lie in such an image.
    pub fn build(donut: &DonutCalibration, width_px: usize, height_px: usize) -> Result<Self, CalibrationError> {
        donut.check_in_image(width_px, height_px)?;
        let span = |length_px: f64, samples: usize| (length_px / samples as f64 / MAX_SPACING_PX).ceil().max(1.0);
        let sub_columns = span(TAU * donut.outer_radius_px, SAMPLED_COLUMNS) as usize;
        let sub_rows = span(donut.outer_radius_px - donut.inner_radius_px, SAMPLED_ROWS) as usize;
        let (columns, rows) = (SAMPLED_COLUMNS * sub_columns, SAMPLED_ROWS * sub_rows);

        let directions: Vec<(f64, f64)> = (0..columns)
            .map(|j| {
                let turned_rad = TAU * (j as f64 + 0.5) / columns as f64;
                let angle_rad = donut.start_angle_rad + if donut.clockwise { turned_rad } else { -turned_rad };
                (libm::cos(angle_rad), libm::sin(angle_rad))
            })
            .collect();
        let mut samples = Vec::with_capacity(columns * rows);
        for directions in directions.chunks_exact(TILE_COLUMNS * sub_columns) {
            for k in 0..rows {
                let fraction = (k as f64 + 0.5) / rows as f64;
                let inwards = if donut.top_is_outer { fraction } else { 1.0 - fraction };
                let radius_px = donut.outer_radius_px - (donut.outer_radius_px - donut.inner_radius_px) * inwards;
                samples.extend(directions.iter().map(|(cos, sin)| {
                    let x = donut.center_x_px + radius_px * cos;
                    let y = donut.center_y_px + radius_px * sin;
                    Sample::at(x, y, width_px, height_px)
                }));
            }
        }
        let mut needed = Tiles::none(width_px, height_px);
        for sample in &samples {
            let (left, top) = (sample.index as usize % width_px, sample.index as usize / width_px);
            for (x, y) in [(left, top), (left + 1, top), (left, top + 1), (left + 1, top + 1)] {
                needed.add_pixel(x, y);
            }
        }
        Ok(Self {
            image_width_px: width_px,
            image_height_px: height_px,
            azimuth: donut.azimuth,
            sub_columns,
            sub_rows,
            samples,
            needed,
        })
    }

    /// The part of the images that this table reads: all the decoder has to provide.
    pub fn needed(&self) -> &Tiles {
        &self.needed
    }

    /// Width and height of the images that this table unwraps.
    pub fn image_size_px(&self) -> (usize, usize) {
        (self.image_width_px, self.image_height_px)
    }

    /// Unwraps `image`.
    ///
    /// # Panics
    /// When the image is not of [`image_size_px`](Self::image_size_px).
    pub fn to_panorama(&self, image: &LumaImage) -> Panorama {
        let mut panorama = Panorama::zeros();
        self.unwrap_into(image, 0, &mut panorama);
        panorama
    }

    /// How many of the [`SAMPLED_COLUMNS`] the panorama of a vehicle at `yaw_rad` is to be shifted so that column 0
    /// looks east, whatever the heading: the paper's “(fixed)” rows.
    pub fn columns_to_east(&self, yaw_rad: f64) -> usize {
        let turn = match self.azimuth {
            AzimuthSense::Ccw => yaw_rad,
            AzimuthSense::Cw => -yaw_rad,
        };
        (turn / TAU * SAMPLED_COLUMNS as f64).round().rem_euclid(SAMPLED_COLUMNS as f64) as usize % SAMPLED_COLUMNS
    }

    /// Unwraps `image` into `panorama`, column `j` going to column `j + shift_columns` of [`SAMPLED_COLUMNS`].
    ///
    /// # Panics
    /// As [`to_panorama`](Self::to_panorama).
    pub fn unwrap_into(&self, image: &LumaImage, shift_columns: usize, panorama: &mut Panorama) {
        assert_eq!((image.width_px, image.height_px), self.image_size_px(), "the table is for another image size");
        BUFFERS.with_borrow_mut(|buffers| self.unwrap_with(buffers, image, shift_columns, panorama));
    }

    fn unwrap_with(
        &self,
        [values, means]: &mut [Vec<f32>; 2],
        image: &LumaImage,
        shift_columns: usize,
        panorama: &mut Panorama,
    ) {
        panorama.column_means.fill(0.0);
        panorama.wide.fill(0.0);
        let per_wide_row = 2 * self.sub_rows * self.sub_columns * TILE_COLUMNS;
        values.resize(per_wide_row, 0.0);
        means.resize(per_wide_row / self.sub_columns, 0.0);
        for (tile, samples) in self.samples.chunks_exact(WIDE_ROWS * per_wide_row).enumerate() {
            let first_column = (tile * TILE_COLUMNS + shift_columns) % SAMPLED_COLUMNS;
            let mut column_sums = [0.0; TILE_COLUMNS];
            for (samples, wide) in samples.chunks_exact(per_wide_row).zip(panorama.wide.chunks_exact_mut(WIDE_COLUMNS))
            {
                sample_pixels(samples, &image.pixels, self.image_width_px, values);
                let sums = if self.sub_columns == 1 {
                    sums_of_rows(values)
                } else {
                    for (mean, group) in means.iter_mut().zip(values.chunks_exact(self.sub_columns)) {
                        *mean = group.iter().sum::<f32>() / self.sub_columns as f32;
                    }
                    sums_of_rows(means)
                };
                column_sums.iter_mut().zip(&sums).for_each(|(column, sum)| *column += sum);
                add_in_pairs(&sums, first_column, wide);
            }
            for (j, sum) in column_sums.iter().enumerate() {
                panorama.column_means[(first_column + j) % SAMPLED_COLUMNS] = *sum;
            }
        }
        let rows = (SAMPLED_ROWS * self.sub_rows) as f32;
        panorama.column_means.iter_mut().for_each(|mean| *mean /= rows);
        let per_cell = (4 * self.sub_rows) as f32;
        panorama.wide.iter_mut().for_each(|value| *value /= per_cell);

        panorama.reduce_to_gray();
    }
}

impl Sample {
    /// The sample at (`x`, `y`) \[px\]; border pixels are repeated outside the image.
    fn at(x: f64, y: f64, width_px: usize, height_px: usize) -> Self {
        let x = x.clamp(0.0, width_px as f64 - 1.0);
        let y = y.clamp(0.0, height_px as f64 - 1.0);
        let left = (x.floor() as usize).min(width_px - 2);
        let top = (y.floor() as usize).min(height_px - 2);
        let weight = |fraction: f64| (fraction * f64::from(u16::MAX)).round() as u16;
        Self { index: (top * width_px + left) as u32, right: weight(x - left as f64), below: weight(y - top as f64) }
    }
}

/// Interpolates `samples` in `pixels`, whose rows are `width_px` long.
#[multiversion(targets("x86_64+avx512f+avx512vl+avx512bw", "x86_64+avx2+fma"))]
fn sample_pixels(samples: &[Sample], pixels: &[u8], width_px: usize, values: &mut [f32]) {
    interpolate(samples, pixels, width_px, values);
}

#[inline(always)]
fn interpolate<P: Copy + Default + Into<f32>>(samples: &[Sample], pixels: &[P], width_px: usize, values: &mut [f32]) {
    const STEP: f32 = 1.0 / u16::MAX as f32;
    let (mut upper, mut lower) = ([[P::default(); 2]; GATHERED], [[P::default(); 2]; GATHERED]);
    let pixels_below = &pixels[width_px..];
    for (samples, values) in samples.chunks(GATHERED).zip(values.chunks_mut(GATHERED)) {
        for ((upper, lower), sample) in upper.iter_mut().zip(&mut lower).zip(samples) {
            let index = sample.index as usize;
            upper.copy_from_slice(&pixels[index..index + 2]);
            lower.copy_from_slice(&pixels_below[index..index + 2]);
        }
        for ((value, sample), (upper, lower)) in values.iter_mut().zip(samples).zip(upper.iter().zip(&lower)) {
            let (right, below) = (f32::from(sample.right) * STEP, f32::from(sample.below) * STEP);
            let ([p00, p01], [p10, p11]): ([f32; 2], [f32; 2]) = (upper.map(Into::into), lower.map(Into::into));
            let top = p00 + right * (p01 - p00);
            let bottom = p10 + right * (p11 - p10);
            *value = top + below * (bottom - top);
        }
    }
}

/// The sums over all rows, in `values`, of each column of a tile.
#[inline]
fn sums_of_rows(values: &[f32]) -> [f32; TILE_COLUMNS] {
    let mut sums = [0.0; TILE_COLUMNS];
    for row in values.as_chunks::<TILE_COLUMNS>().0 {
        sums.iter_mut().zip(row).for_each(|(sum, value)| *sum += value);
    }
    sums
}

/// Adds the columns of a tile, of which the first is column `first` of the panorama, two by two to a row of the wide one.
fn add_in_pairs(sums: &[f32; TILE_COLUMNS], first: usize, wide: &mut [f32]) {
    let (mut sums, mut cell) = (&sums[..], first / 2);
    if first % 2 == 1 {
        // The first column of all is the second of its pair, and so the last has none.
        wide[cell] += sums[0];
        (sums, cell) = (&sums[1..], cell + 1);
    }
    let (pairs, last) = sums.as_chunks::<2>();
    let (before_wrap, after_wrap) = pairs.split_at(pairs.len().min(WIDE_COLUMNS - cell));
    let add = |wide: &mut [f32], pairs: &[[f32; 2]]| {
        wide.iter_mut().zip(pairs).for_each(|(cell, pair)| *cell += pair[0] + pair[1]);
    };
    add(&mut wide[cell..], before_wrap);
    add(wide, after_wrap);
    if let [last] = last {
        wide[(cell + pairs.len()) % WIDE_COLUMNS] += last;
    }
}

#[cfg(test)]
mod tests {
    use super::super::GRAY_SIZE;
    use super::*;
    use crate::types::LensKind;

    fn donut() -> DonutCalibration {
        DonutCalibration {
            kind: LensKind::Donut,
            center_x_px: 99.5,
            center_y_px: 88.25,
            inner_radius_px: 20.0,
            outer_radius_px: 80.0,
            top_is_outer: true,
            start_angle_rad: 0.0,
            clockwise: true,
            azimuth: AzimuthSense::Ccw,
        }
    }

    /// A donut image that encodes direction: brightness grows with cos of the angle.
    fn lighthouse(bright_rad: f64) -> LumaImage {
        LumaImage::from_fn(200, 180, |x, y| {
            let angle_rad = (y as f64 - 88.25).atan2(x as f64 - 99.5);
            (127.5 + 100.0 * (angle_rad - bright_rad).cos()) as u8
        })
    }

    fn brightest_column(panorama: &Panorama) -> usize {
        (0..SAMPLED_COLUMNS)
            .max_by(|&a, &b| panorama.column_means[a].total_cmp(&panorama.column_means[b]))
            .expect("there are columns")
    }

    #[test]
    fn columns_follow_the_start_angle_and_the_direction() {
        for (start_angle_rad, clockwise, bright_rad, column) in
            [(0.0, true, 1.0, 163), (0.0, false, 1.0, 861), (1.0, true, 1.5, 81), (1.0, false, 0.5, 81)]
        {
            let table = UnwrapTable::build(&DonutCalibration { start_angle_rad, clockwise, ..donut() }, 200, 180)
                .expect("the donut is inside");
            let found = brightest_column(&table.to_panorama(&lighthouse(bright_rad)));
            assert!(found.abs_diff(column) < 20, "{found} instead of {column}");
        }
    }

    #[test]
    fn row_zero_is_the_named_rim() {
        let rings =
            LumaImage::from_fn(
                200,
                180,
                |x, y| {
                    if (x as f64 - 99.5).hypot(y as f64 - 88.25) > 50.0 { 200 } else { 50 }
                },
            );
        for (top_is_outer, first, last) in [(true, 200.0, 50.0), (false, 50.0, 200.0)] {
            let table = UnwrapTable::build(&DonutCalibration { top_is_outer, ..donut() }, 200, 180).expect("inside");
            let panorama = table.to_panorama(&rings);
            assert_eq!((panorama.gray[0], panorama.gray[GRAY_SIZE * GRAY_SIZE - 1]), (first, last));
        }
    }

    #[test]
    fn all_sizes_have_the_same_mean() {
        let table = UnwrapTable::build(&donut(), 200, 180).expect("inside");
        let panorama = table.to_panorama(&lighthouse(0.3));
        let mean = |values: &[f32]| values.iter().map(|&v| f64::from(v)).sum::<f64>() / values.len() as f64;
        assert!((mean(&panorama.gray) - mean(&panorama.wide)).abs() < 1e-4);
        assert!((mean(&panorama.gray) - mean(&panorama.column_means)).abs() < 1e-4);
    }

    #[test]
    fn no_camera_pixel_is_skipped_in_a_large_image() {
        // One bright pixel in a large donut must be seen with its share of the area, wherever it lies.
        let large = DonutCalibration {
            center_x_px: 1500.0,
            center_y_px: 1500.0,
            inner_radius_px: 300.0,
            outer_radius_px: 1450.0,
            ..donut()
        };
        let table = UnwrapTable::build(&large, 3000, 3000).expect("inside");
        for (x, y) in [(2900, 1503), (1507, 213), (700, 811), (1901, 1777)] {
            let mut image = LumaImage::from_fn(3000, 3000, |_, _| 0);
            image.pixels[y * 3000 + x] = 255;
            let sum: f32 = table.to_panorama(&image).wide.iter().sum();
            let radius_px = (x as f32 - 1500.0).hypot(y as f32 - 1500.0);
            // Wide cells a camera pixel covers at this radius.
            let cells = (512.0 / (std::f32::consts::TAU * radius_px)) * (128.0 / 1150.0);
            assert!((sum / (255.0 * cells) - 1.0).abs() < 0.75, "({x}, {y}): {sum} {}", 255.0 * cells);
        }
    }

    #[test]
    fn turning_the_vehicle_shifts_the_columns_and_columns_to_east_undoes_it() {
        let table = UnwrapTable::build(&donut(), 200, 180).expect("inside");
        // A light in the east seen by a vehicle at some yaw: azimuth = yaw + column angle (ccw).
        let mut panorama = Panorama::zeros();
        for yaw_rad in [0.0, 0.7, -2.0, 3.1] {
            table.unwrap_into(&lighthouse(-yaw_rad), table.columns_to_east(yaw_rad), &mut panorama);
            let column = brightest_column(&panorama);
            assert!(column.min(SAMPLED_COLUMNS - column) < 20, "yaw {yaw_rad}: east at column {column}");
        }
    }

    #[test]
    fn a_shift_turns_all_sizes_alike() {
        let table = UnwrapTable::build(&donut(), 200, 180).expect("inside");
        let image = lighthouse(0.4);
        let (unturned, mut panorama) = (table.to_panorama(&image), Panorama::zeros());
        for shift in [0, 1, 2, 7, 63, 64, 65, 130, 1022, 1023, 1024 + 5] {
            table.unwrap_into(&image, shift, &mut panorama);
            let mut expected = unturned.column_means.clone();
            expected.rotate_right(shift % SAMPLED_COLUMNS);
            assert_eq!(panorama.column_means, expected, "shift {shift}");
            // In this image brightness depends on the direction alone, but for the steps of its pixels.
            for (i, &cell) in panorama.wide.iter().enumerate() {
                let pair = &expected[2 * (i % WIDE_COLUMNS)..][..2];
                assert!((cell - 0.5 * (pair[0] + pair[1])).abs() < 4.0, "shift {shift}, cell {i}: {cell} {pair:?}");
            }
        }
    }

    /// `golden.json`, key `unwrap`: values of an independent implementation.
    #[test]
    fn sampling_equals_the_reference_values() {
        let golden: serde_json::Value =
            serde_json::from_str(include_str!("../../tests/data/golden.json")).expect("golden.json parses");
        let pixels: Vec<f32> = (0..180)
            .flat_map(|y| (0..200).map(move |x| (f64::from(x), f64::from(y))))
            .map(|(x, y)| (0.5 * x + 0.25 * y + 20.0 * (x / 11.0).sin() * (y / 7.0).cos()) as f32)
            .collect();
        let (columns, rows) = (64, 16);
        let mut values = vec![0.0; columns * rows];
        for k in 0..rows {
            let radius_px = 80.0 - 60.0 * (k as f64 + 0.5) / rows as f64;
            let samples: Vec<Sample> = (0..columns)
                .map(|j| {
                    let angle_rad = TAU * (j as f64 + 0.5) / columns as f64;
                    Sample::at(99.5 + radius_px * angle_rad.cos(), 88.25 + radius_px * angle_rad.sin(), 200, 180)
                })
                .collect();
            interpolate(&samples, &pixels, 200, &mut values[k * columns..(k + 1) * columns]);
        }
        for (key, row) in [("row0_first8", 0), ("row15_first8", 15)] {
            for (j, expected) in golden["unwrap"][key].as_array().expect("a list").iter().enumerate() {
                let expected = expected.as_f64().expect("a number");
                let found = f64::from(values[row * columns + j]);
                assert!((found / expected - 1.0).abs() < 1e-6, "{key}[{j}]: {found} instead of {expected}");
            }
        }
        let sum: f64 = values.iter().map(|&v| f64::from(v)).sum();
        let expected = golden["unwrap"]["sum"].as_f64().expect("a number");
        assert!((sum / expected - 1.0).abs() < 1e-6, "{sum} instead of {expected}");
    }
}
