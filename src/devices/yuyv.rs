//! YUYV 4:2:2 -> JPEG, for cameras (or rates) without MJPG.
//!
//! Two pixels are four bytes, Y0 Cb Y1 Cr; lines may be padded. JPEG stores the same 4:2:2 chroma, so that nothing is
//! resampled. V4L2 says that such a frame has "limited range" (Y 16..=235, Cb and Cr 16..=240: ITU-R BT.601) unless the
//! driver says otherwise, and JPEG has full range (JFIF 1.02), so that levels are stretched on the way.

use jpeg_encoder::{Encoder, ImageBuffer, JpegColorType, SamplingFactor};

use super::mjpeg::MARKED_BY_DRIVER;

/// The driver delivered fewer bytes than an image has; the rest is grey.
pub const INCOMPLETE: &str = "incomplete image";

/// What was agreed on with the camera.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct YuyvFormat {
    pub width_px: u32,
    pub height_px: u32,
    /// From one line to the next; 0 for lines without padding.
    pub bytes_per_line: u32,
    /// Black is 0 and white 255, instead of 16 and 235.
    pub full_range: bool,
}

/// Encodes the frames of one camera.
#[derive(Debug)]
pub struct YuyvEncoder {
    width_px: u16,
    height_px: u16,
    bytes_per_line: usize,
    luma_levels: [u8; 256],
    chroma_levels: [u8; 256],
    quality: u8,
}

impl YuyvEncoder {
    /// `quality` is that of JPEG, 1..=100.
    ///
    /// # Errors
    /// When no such image exists.
    pub fn new(format: YuyvFormat, quality: u8) -> Result<Self, String> {
        let YuyvFormat { width_px, height_px, bytes_per_line, full_range } = format;
        let side = |name: &str, value: u32| match u16::try_from(value) {
            Ok(side) if side > 0 => Ok(side),
            _ => Err(format!("YUYV frames with a {name} of {value} px, expected 1..=65535")),
        };
        let (width, height) = (side("width", width_px)?, side("height", height_px)?);
        if !width.is_multiple_of(2) {
            return Err(format!("YUYV frames with a width of {width} px, which is odd"));
        }
        let least = usize::from(width) * 2;
        let bytes_per_line = if bytes_per_line == 0 { least } else { bytes_per_line as usize };
        if bytes_per_line < least {
            return Err(format!("YUYV lines of {bytes_per_line} bytes, expected at least {least} for {width} px"));
        }
        // 16 + 219 steps of luma and 128 ± 112 of chroma, BT.601; both become 255 steps.
        let stretch = |zero: f64, steps: f64, origin: f64| {
            std::array::from_fn(|level| {
                ((level as f64 - zero) * 255.0 / steps + origin).round().clamp(0.0, 255.0) as u8
            })
        };
        let identity = std::array::from_fn(|level| level as u8);
        Ok(Self {
            width_px: width,
            height_px: height,
            bytes_per_line,
            luma_levels: if full_range { identity } else { stretch(16.0, 219.0, 0.0) },
            chroma_levels: if full_range { identity } else { stretch(128.0, 224.0, 128.0) },
            quality,
        })
    }

    /// Bytes of a whole frame; the last line need not be padded.
    pub fn frame_bytes(&self) -> usize {
        self.bytes_per_line * (usize::from(self.height_px) - 1) + usize::from(self.width_px) * 2
    }

    /// Encodes `frame`, which is filled up with grey if it is too short, into the empty `jpeg`; returns why the image
    /// may not be used, if it may not.
    pub fn encode(&self, frame: &mut Vec<u8>, marked_by_driver: bool, jpeg: &mut Vec<u8>) -> Option<&'static str> {
        let complete = frame.len() >= self.frame_bytes();
        if !complete {
            frame.resize(self.frame_bytes(), 128);
        }
        let mut encoder = Encoder::new(&mut *jpeg, self.quality);
        encoder.set_sampling_factor(SamplingFactor::F_2_1);
        let encoded = encoder.encode_image(YuyvImage { encoder: self, frame });
        match encoded {
            _ if marked_by_driver => Some(MARKED_BY_DRIVER),
            _ if !complete => Some(INCOMPLETE),
            // Sizes are checked and a vector takes every byte.
            Err(_) => Some("not encoded"),
            Ok(()) => None,
        }
    }
}

struct YuyvImage<'a> {
    encoder: &'a YuyvEncoder,
    frame: &'a [u8],
}

impl ImageBuffer for YuyvImage<'_> {
    fn get_jpeg_color_type(&self) -> JpegColorType {
        JpegColorType::Ycbcr
    }

    fn width(&self) -> u16 {
        self.encoder.width_px
    }

    fn height(&self) -> u16 {
        self.encoder.height_px
    }

    /// Chroma is given to both pixels of a pair; the encoder takes that of the first.
    fn fill_buffers(&self, y: u16, buffers: &mut [Vec<u8>; 4]) {
        let YuyvEncoder { luma_levels, chroma_levels, .. } = self.encoder;
        let start = usize::from(y) * self.encoder.bytes_per_line;
        let line = &self.frame[start..start + usize::from(self.encoder.width_px) * 2];
        let [luma, cb, cr, _] = buffers;
        for pair in line.as_chunks::<4>().0 {
            let [y0, b, y1, r] = pair.map(usize::from);
            luma.extend_from_slice(&[luma_levels[y0], luma_levels[y1]]);
            cb.extend_from_slice(&[chroma_levels[b]; 2]);
            cr.extend_from_slice(&[chroma_levels[r]; 2]);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::jpeg::{LumaDecoder, scan};

    const FORMAT: YuyvFormat = YuyvFormat { width_px: 48, height_px: 40, bytes_per_line: 112, full_range: false };

    /// Luma rises to the right, Cb downwards, Cr is 90; the padding of the lines is white noise to whoever reads it.
    fn ramp() -> Vec<u8> {
        let mut frame = Vec::new();
        for row in 0..40_u32 {
            for pair in 0..24 {
                let luma = |column: u32| (16 + column * 4) as u8;
                frame.extend_from_slice(&[luma(pair * 2), (60 + row * 3) as u8, luma(pair * 2 + 1), 90]);
            }
            frame.extend((0..16).map(|i| (i * 97 + row * 31) as u8));
        }
        frame
    }

    #[test]
    fn levels_are_those_of_jfif() {
        let mut jpeg = Vec::new();
        let encoder = YuyvEncoder::new(FORMAT, 95).expect("a possible format");
        assert_eq!(encoder.encode(&mut ramp(), false, &mut jpeg), None);
        assert!(scan(&jpeg).is_ok_and(|info| (info.width_px, info.height_px) == (48, 40)));
        let mut decoder = LumaDecoder::new();
        let luma = decoder.decode(&jpeg).expect("a whole image");
        let rgb = image::load_from_memory(&jpeg).expect("a whole image").to_rgb8();
        for (x, y) in [(2_u32, 2_u32), (24, 20), (45, 37)] {
            let [y0, cb, cr] = [f64::from(16 + x * 4), f64::from(60 + y * 3), 90.0];
            let stretched = (y0 - 16.0) * 255.0 / 219.0;
            let found = f64::from(luma.pixels[(y * 48 + x) as usize]);
            assert!((found - stretched).abs() <= 4.0, "luma at {x} {y}: {found} instead of {stretched}");
            // BT.601 to RGB for limited range.
            let red = 1.164 * (y0 - 16.0) + 1.596 * (cr - 128.0);
            let blue = 1.164 * (y0 - 16.0) + 2.017 * (cb - 128.0);
            for (name, found, expected) in
                [("red", rgb.get_pixel(x, y)[0], red), ("blue", rgb.get_pixel(x, y)[2], blue)]
            {
                // Quantization at quality 95, and chroma shared by two pixels and smoothed by the decoder.
                let off = (f64::from(found) - expected.clamp(0.0, 255.0)).abs();
                assert!(off <= 12.0, "{name} at {x} {y}: {found} instead of {expected}");
            }
        }
    }

    #[test]
    fn full_range_is_not_stretched() {
        let mut jpeg = Vec::new();
        let encoder = YuyvEncoder::new(YuyvFormat { full_range: true, ..FORMAT }, 95).expect("a possible format");
        encoder.encode(&mut ramp(), false, &mut jpeg);
        let mut decoder = LumaDecoder::new();
        let luma = decoder.decode(&jpeg).expect("a whole image");
        assert!(luma.pixels[20 * 48 + 24].abs_diff(16 + 24 * 4) <= 3);
    }

    #[test]
    fn a_short_frame_is_encoded_and_flagged() {
        let encoder = YuyvEncoder::new(FORMAT, 90).expect("a possible format");
        for length in [1, 111, 112, 2000, encoder.frame_bytes() - 1] {
            let mut jpeg = Vec::new();
            assert_eq!(encoder.encode(&mut ramp()[..length].to_vec(), false, &mut jpeg), Some(INCOMPLETE), "{length}");
            assert!(scan(&jpeg).is_ok(), "{length}");
        }
        let mut unpadded = ramp()[..encoder.frame_bytes()].to_vec();
        assert_eq!(encoder.encode(&mut unpadded, false, &mut Vec::new()), None, "the last line has no padding");
        assert_eq!(encoder.encode(&mut ramp(), true, &mut Vec::new()), Some(MARKED_BY_DRIVER));
    }

    #[test]
    fn impossible_formats_are_refused() {
        for (format, expected) in [
            (YuyvFormat { width_px: 47, ..FORMAT }, "odd"),
            (YuyvFormat { width_px: 0, ..FORMAT }, "width of 0"),
            (YuyvFormat { height_px: 70_000, ..FORMAT }, "height of 70000"),
            (YuyvFormat { bytes_per_line: 90, ..FORMAT }, "lines of 90 bytes"),
        ] {
            let error = YuyvEncoder::new(format, 90).expect_err(expected);
            assert!(error.contains(expected), "{error}");
        }
    }
}
