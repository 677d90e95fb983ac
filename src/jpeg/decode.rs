//! Luma-only decoding: the chroma planes are never transformed.

use zune_jpeg::JpegDecoder;
use zune_jpeg::zune_core::bytestream::ZCursor;
use zune_jpeg::zune_core::colorspace::ColorSpace;
use zune_jpeg::zune_core::options::DecoderOptions;

use crate::types::LumaImage;

/// Larger images are refused: no camera of ours makes them, and a forged header could claim any size.
pub const MAX_SIDE_PX: usize = 8192;

#[derive(Debug, thiserror::Error)]
pub enum JpegError {
    #[error("not a whole JPEG image: {0}")]
    Damaged(String),
    #[error("image of {width_px} x {height_px}: smaller than {} x {} px", MIN_SIDE_PX, MIN_SIDE_PX)]
    TooSmall { width_px: usize, height_px: usize },
}

/// Below this no donut can be unwrapped.
const MIN_SIDE_PX: usize = 16;

/// Decodes JPEG frames into one luma buffer that is used again for the next.
#[derive(Debug, Default)]
pub struct LumaDecoder {
    image: LumaImage,
}

impl LumaDecoder {
    pub fn new() -> Self {
        Self::default()
    }

    /// The luma (Y of JFIF, 0..=255) of a baseline or progressive JPEG.
    ///
    /// # Errors
    /// When the data is cut off or damaged, or larger than [`MAX_SIDE_PX`] on a side.
    pub fn decode(&mut self, jpeg: &[u8]) -> Result<&LumaImage, JpegError> {
        let damaged = |error: &dyn std::fmt::Display| JpegError::Damaged(error.to_string());
        // The decoder accepts a scan that ends a few blocks early; the end marker tells.
        if !trim_zeros(jpeg).ends_with(&[0xFF, 0xD9]) {
            return Err(JpegError::Damaged("the end marker is missing: the file was cut off".into()));
        }
        let options = DecoderOptions::new_fast()
            .set_strict_mode(true)
            .set_max_width(MAX_SIDE_PX)
            .set_max_height(MAX_SIDE_PX)
            .jpeg_set_out_colorspace(ColorSpace::Luma);
        let mut decoder = JpegDecoder::new_with_options(ZCursor::new(jpeg), options);
        decoder.decode_headers().map_err(|error| damaged(&error))?;
        let (width_px, height_px) = decoder.dimensions().ok_or_else(|| damaged(&"no image size"))?;
        if width_px < MIN_SIDE_PX || height_px < MIN_SIDE_PX {
            return Err(JpegError::TooSmall { width_px, height_px });
        }
        let size = decoder.output_buffer_size().ok_or_else(|| damaged(&"no image size"))?;
        self.image.width_px = width_px;
        self.image.height_px = height_px;
        self.image.pixels.resize(size, 0);
        decoder.decode_into(&mut self.image.pixels).map_err(|error| damaged(&error))?;
        Ok(&self.image)
    }
}

/// Cameras pad their frames with zeros.
fn trim_zeros(bytes: &[u8]) -> &[u8] {
    &bytes[..bytes.iter().rposition(|&byte| byte != 0).map_or(0, |last| last + 1)]
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::codecs::jpeg::JpegEncoder;

    fn picture() -> Vec<u8> {
        let mut jpeg = Vec::new();
        let rgb: Vec<u8> =
            (0..64 * 48).flat_map(|i| [(i % 64 * 4) as u8, (i / 64 * 5) as u8, (i % 7 * 30) as u8]).collect();
        JpegEncoder::new_with_quality(&mut jpeg, 90)
            .encode(&rgb, 64, 48, image::ExtendedColorType::Rgb8)
            .expect("encoding into memory");
        jpeg
    }

    #[test]
    fn luma_equals_the_gray_of_another_decoder() {
        let jpeg = picture();
        let mut decoder = LumaDecoder::new();
        let luma = decoder.decode(&jpeg).expect("a whole JPEG");
        let rgb = image::load_from_memory(&jpeg).expect("a whole JPEG").to_rgb8();
        assert_eq!((luma.width_px, luma.height_px), (64, 48));
        let worst = luma
            .pixels
            .iter()
            .zip(rgb.pixels())
            .map(|(&y, p)| {
                let gray = 0.299 * f64::from(p[0]) + 0.587 * f64::from(p[1]) + 0.114 * f64::from(p[2]);
                (f64::from(y) - gray).abs()
            })
            .fold(0.0, f64::max);
        // Two roundings to 8 bits, and clipping of saturated colours.
        assert!(worst < 8.0, "differs by {worst}");
    }

    #[test]
    fn a_cut_frame_is_an_error_at_every_length() {
        let jpeg = picture();
        let mut decoder = LumaDecoder::new();
        for length in 0..jpeg.len() - 2 {
            assert!(decoder.decode(&jpeg[..length]).is_err(), "{length} of {} bytes were accepted", jpeg.len());
        }
    }
}
