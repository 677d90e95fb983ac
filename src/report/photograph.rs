//! Frames as they are shown: the donut in colour, and the panorama as the method sees it.

use image::imageops::FilterType;
use image::{GrayImage, RgbImage};
use realfft::num_complex::Complex;

use super::chart::picture::{gray_jpeg_address, rgb_jpeg_address};
use crate::features::{Describer, Descriptor};
use crate::jpeg::{JpegError, LumaDecoder};
use crate::panorama::{GRAY_SIZE, Panorama, UnwrapTable, WIDE_COLUMNS, WIDE_ROWS};
use crate::types::DonutCalibration;

/// Side of the shown donut \[px\].
const DONUT_SIDE_PX: u32 = 320;

/// One frame, ready to be put into a page.
#[derive(Debug, Clone)]
pub struct Photograph {
    /// The donut, cut out and made smaller.
    pub donut: String,
    /// Where the rims are in it: centre, inner and outer radius, as shares of its side.
    pub rims: [f64; 4],
    /// 512 × 128.
    pub panorama: String,
    /// The f\[a, b\] of the paper, and its FFT properties.
    pub gray: Vec<f32>,
    pub fft: Vec<f32>,
}

impl Photograph {
    /// Of a frame as it was recorded, every column turned so that the panorama begins to the east if its yaw is known.
    pub fn of(
        jpeg: &[u8],
        donut: &DonutCalibration,
        table: &UnwrapTable,
        yaw_rad: Option<f64>,
    ) -> Result<Self, JpegError> {
        let mut decoder = LumaDecoder::new();
        let luma = decoder.decode(jpeg)?;
        let mut panorama = Panorama::zeros();
        let turned = yaw_rad.map_or(0, |yaw_rad| table.columns_to_east(yaw_rad));
        // What the properties are of is the panorama as it is; to be compared by eye, all look the same way.
        table.unwrap_into(luma, 0, &mut panorama);
        let gray = panorama.gray.clone();
        let mut fft = Describer::room_for(&[Descriptor::Fft]);
        Describer::new().describe(&[Descriptor::Fft], &panorama, &mut fft);
        table.unwrap_into(luma, turned, &mut panorama);
        let wide: Vec<u8> = panorama.wide.iter().map(|&value| value.round() as u8).collect();
        let (width, height) = (luma.width_px as u32, luma.height_px as u32);
        // A frame that only our decoder can read is shown in gray.
        let whole = match image::load_from_memory_with_format(jpeg, image::ImageFormat::Jpeg) {
            Ok(image) => image.to_rgb8(),
            Err(_) => {
                let gray = GrayImage::from_raw(width, height, luma.pixels.clone()).unwrap_or_default();
                image::DynamicImage::ImageLuma8(gray).to_rgb8()
            }
        };
        let (cut, rims) = cut_out(&whole, donut);
        Ok(Self {
            donut: rgb_jpeg_address(&cut),
            rims,
            panorama: gray_jpeg_address(&wide, WIDE_COLUMNS, WIDE_ROWS),
            gray,
            fft: fft.concat(),
        })
    }
}

/// A square about the donut with a margin, as far as the image goes, at [`DONUT_SIDE_PX`].
fn cut_out(whole: &RgbImage, donut: &DonutCalibration) -> (RgbImage, [f64; 4]) {
    let side = (2.16 * donut.outer_radius_px).round().max(1.0);
    let (left, top) = ((donut.center_x_px - 0.5 * side).round(), (donut.center_y_px - 0.5 * side).round());
    let mut cut = RgbImage::new(side as u32, side as u32);
    image::imageops::replace(&mut cut, whole, -(left as i64), -(top as i64));
    let small = image::imageops::resize(&cut, DONUT_SIDE_PX, DONUT_SIDE_PX, FilterType::Triangle);
    let share = |px: f64| px / side;
    let center = [share(donut.center_x_px - left + 0.5), share(donut.center_y_px - top + 0.5)];
    (small, [center[0], center[1], share(donut.inner_radius_px), share(donut.outer_radius_px)])
}

/// log₁₀ |F(p, l)| of a 128 × 128 image, the zero frequency in the middle: Do et al. (2015), section 2 and figure 1 (d).
pub fn log_spectrum(gray: &[f32]) -> Vec<f32> {
    let n = GRAY_SIZE;
    let fft = rustfft::FftPlanner::<f32>::new().plan_fft_forward(n);
    let mut values: Vec<Complex<f32>> = gray.iter().map(|&value| Complex::new(value, 0.0)).collect();
    let transposed = |values: &[Complex<f32>]| -> Vec<_> { (0..n * n).map(|i| values[i % n * n + i / n]).collect() };
    values.chunks_exact_mut(n).for_each(|row| fft.process(row));
    values = transposed(&values);
    values.chunks_exact_mut(n).for_each(|row| fft.process(row));
    values = transposed(&values);
    let half = n / 2;
    (0..n * n)
        .map(|i| {
            let (row, column) = ((i / n + half) % n, (i % n + half) % n);
            values[row * n + column].norm().max(1e-3).log10()
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_spectrum_has_its_peaks_where_the_image_s_waves_are() {
        // Three waves a width, five a height.
        let tau = std::f32::consts::TAU / GRAY_SIZE as f32;
        let gray: Vec<f32> = (0..GRAY_SIZE * GRAY_SIZE)
            .map(|i| {
                let (a, b) = ((i / GRAY_SIZE) as f32, (i % GRAY_SIZE) as f32);
                100.0 + 50.0 * (tau * (5.0 * a + 3.0 * b)).cos()
            })
            .collect();
        let spectrum = log_spectrum(&gray);
        let at = |row: usize, column: usize| f64::from(spectrum[row * GRAY_SIZE + column]);
        let pixels = (GRAY_SIZE * GRAY_SIZE) as f64;
        assert!((at(64, 64) - (100.0 * pixels).log10()).abs() < 1e-3);
        for (row, column) in [(69, 67), (59, 61)] {
            assert!((at(row, column) - (25.0 * pixels).log10()).abs() < 1e-3, "{}", at(row, column));
        }
        assert!(at(67, 69) < 1.0);
    }
}
