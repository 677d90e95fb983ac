//! The inverse discrete cosine transform of a block of 8 × 8.

use multiversion::multiversion;

/// Side of a block.
pub const SIDE: usize = 8;
/// Rows or columns of low frequencies that are all that many blocks have.
const HALF: usize = SIDE / 2;

/// Bits of the fixed-point constants.
const FRACTION_BITS: u32 = 12;
/// Bits dropped after the columns, and after the rows. Each pass makes values √8 times as large as they should be; between
/// the passes there are two more bits of precision.
const AFTER_COLUMNS_BITS: u32 = FRACTION_BITS - 2;
const AFTER_ROWS_BITS: u32 = FRACTION_BITS + 2 + 3;
const HALF_AFTER_COLUMNS: i32 = 1 << (AFTER_COLUMNS_BITS - 1);
/// The middle of the range, 128, is 0 in the coefficients. The 512 are not in the algorithm but in zune-jpeg.
const MIDDLE_AFTER_ROWS: i32 = (128 << AFTER_ROWS_BITS) + (1 << (AFTER_ROWS_BITS - 1)) + 512;

/// The samples of a block, rows from top to bottom, from its dequantized coefficients, frequencies down by rows. `low` says
/// that there are only some in the first [`HALF`] rows and columns.
///
/// The integer algorithm of Loeffler, Ligtenberg and Moschytz (1989) in the form libjpeg calls “islow”, with constants of
/// 12 bits: the same numbers, and so the same samples, as zune-jpeg.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2"))]
pub fn samples(coefficients: &[i32; SIDE * SIDE], low: bool) -> [[u8; SIDE]; SIDE] {
    if low { transformed::<HALF>(coefficients) } else { transformed::<SIDE>(coefficients) }
}

/// The columns by the algorithm, several at a time. The rows, which lie across, by the matrix of the same algorithm: it is
/// linear but for the rounding at its end, also where numbers wrap, as they may in damaged data.
#[inline(always)]
fn transformed<const FREQUENCIES: usize>(coefficients: &[i32; SIDE * SIDE]) -> [[u8; SIDE]; SIDE] {
    let mut columns = [[0; SIDE]; SIDE];
    for x in 0..SIDE {
        let mut column = [0; SIDE];
        for y in 0..FREQUENCIES {
            column[y] = coefficients[y * SIDE + x];
        }
        let column = transformed_once(column);
        for y in 0..SIDE {
            columns[y][x] = column[y].wrapping_add(HALF_AFTER_COLUMNS) >> AFTER_COLUMNS_BITS;
        }
    }
    let mut samples = [[0; SIDE]; SIDE];
    for (samples, column) in samples.iter_mut().zip(&columns) {
        let mut row = [MIDDLE_AFTER_ROWS; SIDE];
        for (value, wave) in column[..FREQUENCIES].iter().zip(&WAVES) {
            for x in 0..SIDE {
                row[x] = row[x].wrapping_add(value.wrapping_mul(wave[x]));
            }
        }
        *samples = row.map(|sample| (sample >> AFTER_ROWS_BITS).clamp(0, 255) as u8);
    }
    samples
}

/// What each frequency alone becomes.
const WAVES: [[i32; SIDE]; SIDE] = {
    let mut waves = [[0; SIDE]; SIDE];
    let mut frequency = 0;
    while frequency < SIDE {
        let mut alone = [0; SIDE];
        alone[frequency] = 1;
        waves[frequency] = transformed_once(alone);
        frequency += 1;
    }
    waves
};

/// The one-dimensional transform without its rounding.
#[inline(always)]
const fn transformed_once(at: [i32; SIDE]) -> [i32; SIDE] {
    let both = times(sum(at[2], at[6]), 0.541_196_100);
    let t2 = sum(both, times(at[6], -1.847_759_065));
    let t3 = sum(both, times(at[2], 0.765_366_865));
    let t0 = sum(at[0], at[4]) << FRACTION_BITS;
    let t1 = at[0].wrapping_sub(at[4]) << FRACTION_BITS;
    let even = [sum(t0, t3), sum(t1, t2), t1.wrapping_sub(t2), t0.wrapping_sub(t3)];

    let (p3, p4) = (sum(at[7], at[3]), sum(at[5], at[1]));
    let p5 = times(sum(p3, p4), 1.175_875_602);
    let p1 = sum(p5, times(sum(at[7], at[1]), -0.899_976_223));
    let p2 = sum(p5, times(sum(at[5], at[3]), -2.562_915_447));
    let (p3, p4) = (times(p3, -1.961_570_560), times(p4, -0.390_180_644));
    let odd = [
        sum(times(at[1], 1.501_321_110), sum(p1, p4)),
        sum(times(at[3], 3.072_711_026), sum(p2, p3)),
        sum(times(at[5], 2.053_119_869), sum(p2, p4)),
        sum(times(at[7], 0.298_631_336), sum(p1, p3)),
    ];
    [
        sum(even[0], odd[0]),
        sum(even[1], odd[1]),
        sum(even[2], odd[2]),
        sum(even[3], odd[3]),
        even[3].wrapping_sub(odd[3]),
        even[2].wrapping_sub(odd[2]),
        even[1].wrapping_sub(odd[1]),
        even[0].wrapping_sub(odd[0]),
    ]
}

#[inline(always)]
const fn sum(a: i32, b: i32) -> i32 {
    a.wrapping_add(b)
}

/// `factor` in fixed point; rounded upwards below zero, as in the original.
#[inline(always)]
const fn times(value: i32, factor: f64) -> i32 {
    value.wrapping_mul((factor * (1 << FRACTION_BITS) as f64 + 0.5) as i32)
}

/// The samples of a block that has but a mean.
pub fn flat(mean_coefficient: i32) -> u8 {
    ((mean_coefficient.wrapping_add(4) >> 3).wrapping_add(128)).clamp(0, 255) as u8
}

#[cfg(test)]
mod tests {
    use std::f64::consts::PI;

    use super::*;

    /// T.81, A.3.3, in floating point.
    fn exact(coefficients: &[i32; 64], x: usize, y: usize) -> f64 {
        let wave = |frequency: usize, at: usize| {
            let scale = if frequency == 0 { 0.5_f64.sqrt() } else { 1.0 };
            scale * ((2 * at + 1) as f64 * frequency as f64 * PI / 16.0).cos()
        };
        let sum: f64 = (0..64).map(|i| f64::from(coefficients[i]) * wave(i % 8, x) * wave(i / 8, y)).sum();
        (0.25 * sum + 128.0).clamp(0.0, 255.0)
    }

    #[test]
    fn samples_are_those_of_the_formula() {
        for seed in 0..200_i32 {
            let (low, size) = (seed % 2 == 0, 1 << (seed % 9));
            let mut coefficients = [0; 64];
            for (i, coefficient) in coefficients.iter_mut().enumerate() {
                if !low || (i % 8 < HALF && i / 8 < HALF) {
                    *coefficient = (seed * 7919 + i as i32 * 104_729) % size;
                }
            }
            coefficients[0] = 8 * (seed - 100);
            for (y, row) in samples(&coefficients, low).iter().enumerate() {
                for (x, &sample) in row.iter().enumerate() {
                    let expected = exact(&coefficients, x, y);
                    // Rounding, and the precision of the constants.
                    assert!((f64::from(sample) - expected).abs() < 0.8, "seed {seed}: {sample} instead of {expected}");
                }
            }
        }
    }

    #[test]
    fn a_block_that_is_but_a_mean_is_flat() {
        for mean in [-100_000, -1025, -1024, -5, -4, 0, 3, 4, 1016, 1020, 100_000] {
            let mut coefficients = [0; 64];
            coefficients[0] = mean;
            assert_eq!(samples(&coefficients, false), [[flat(mean); SIDE]; SIDE], "{mean}");
        }
    }
}
