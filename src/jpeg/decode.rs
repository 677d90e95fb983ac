//! JPEG frame → luma: the frames cameras make by [`Baseline`], all others by zune-jpeg.

use zune_jpeg::JpegDecoder;
use zune_jpeg::zune_core::bytestream::ZCursor;
use zune_jpeg::zune_core::colorspace::ColorSpace;
use zune_jpeg::zune_core::options::DecoderOptions;

use super::baseline::{Baseline, Refusal};
use super::header::Header;
use crate::types::{LumaImage, Tiles};

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
    baseline: Baseline,
    image: LumaImage,
}

impl LumaDecoder {
    pub fn new() -> Self {
        Self::default()
    }

    /// The luma (Y of JFIF, 0..=255) of a baseline or progressive JPEG.
    ///
    /// # Errors
    /// When the data is cut off or damaged, or larger than [`MAX_SIDE_PX`] on a side. Baseline frames are refused also
    /// where other decoders make up what is missing: when the data ends before the last block, or a block does not end.
    pub fn decode(&mut self, jpeg: &[u8]) -> Result<&LumaImage, JpegError> {
        self.decode_where(jpeg, None)
    }

    /// As [`decode`](Self::decode), but pixels outside the tiles `needed` may be anything. It takes about half the time
    /// when a third is needed. Damage is found wherever it is: all of the data is still decoded, but not transformed.
    ///
    /// # Errors
    /// As [`decode`](Self::decode).
    pub fn decode_needed(&mut self, jpeg: &[u8], needed: &Tiles) -> Result<&LumaImage, JpegError> {
        self.decode_where(jpeg, Some(needed))
    }

    fn decode_where(&mut self, jpeg: &[u8], needed: Option<&Tiles>) -> Result<&LumaImage, JpegError> {
        if !trim_zeros(jpeg).ends_with(&[0xFF, 0xD9]) {
            return Err(JpegError::Damaged("the end marker is missing: the file was cut off".into()));
        }
        match self.decode_plain(jpeg, needed) {
            Ok(()) => {}
            Err(Refusal::NotPlain) => self.decode_any(jpeg)?,
            Err(Refusal::Damaged(damage)) => return Err(JpegError::Damaged(damage.to_string())),
        }
        Ok(&self.image)
    }

    fn decode_plain(&mut self, jpeg: &[u8], needed: Option<&Tiles>) -> Result<(), Refusal> {
        let sides = MIN_SIDE_PX..=MAX_SIDE_PX;
        let header = Header::read(jpeg)
            .filter(|header| sides.contains(&header.width_px) && sides.contains(&header.height_px))
            .ok_or(Refusal::NotPlain)?;
        self.resize(header.width_px, header.height_px);
        self.baseline.decode(jpeg, header, needed, &mut self.image)
    }

    fn decode_any(&mut self, jpeg: &[u8]) -> Result<(), JpegError> {
        let damaged = |error: &dyn std::fmt::Display| JpegError::Damaged(error.to_string());
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
        self.resize(width_px, height_px);
        decoder.decode_into(&mut self.image.pixels).map_err(|error| damaged(&error))
    }

    fn resize(&mut self, width_px: usize, height_px: usize) {
        self.image.width_px = width_px;
        self.image.height_px = height_px;
        self.image.pixels.resize(width_px * height_px, 0);
    }
}

/// Cameras pad their frames with zeros.
fn trim_zeros(bytes: &[u8]) -> &[u8] {
    &bytes[..bytes.iter().rposition(|&byte| byte != 0).map_or(0, |last| last + 1)]
}

#[cfg(test)]
mod tests {
    use image::codecs::jpeg::JpegEncoder;
    use jpeg_encoder::{ColorType, Encoder, SamplingFactor};
    use proptest::prelude::*;

    use super::*;
    use crate::jpeg::baseline::Damage;

    fn picture() -> Vec<u8> {
        let mut jpeg = Vec::new();
        let rgb: Vec<u8> =
            (0..64 * 48).flat_map(|i| [(i % 64 * 4) as u8, (i / 64 * 5) as u8, (i % 7 * 30) as u8]).collect();
        JpegEncoder::new_with_quality(&mut jpeg, 90)
            .encode(&rgb, 64, 48, image::ExtendedColorType::Rgb8)
            .expect("encoding into memory");
        jpeg
    }

    /// Waves, flat parts and noise.
    fn encoded(width_px: u16, height_px: u16, color: ColorType, set: impl Fn(&mut Encoder<&mut Vec<u8>>)) -> Vec<u8> {
        let channels = if color == ColorType::Luma { 1 } else { 3 };
        let sample = |i: usize| {
            let (x, y, c) = (i / channels % usize::from(width_px), i / channels / usize::from(width_px), i % channels);
            let noise = (i.wrapping_mul(2_654_435_761) >> 7) % 256;
            match (x / 16 + y / 16) % 3 {
                0 => (40 * c + 90) as u8,
                1 => (128.0 + 100.0 * (x as f64 * 0.3 + c as f64).sin() * (y as f64 * 0.2).cos()) as u8,
                _ => noise as u8,
            }
        };
        let samples: Vec<u8> = (0..usize::from(width_px) * usize::from(height_px) * channels).map(sample).collect();
        let mut jpeg = Vec::new();
        let mut encoder = Encoder::new(&mut jpeg, 85);
        set(&mut encoder);
        encoder.encode(&samples, width_px, height_px, color).expect("encoding into memory");
        jpeg
    }

    /// What zune-jpeg makes of it.
    fn by_the_other(jpeg: &[u8]) -> Result<LumaImage, JpegError> {
        let mut decoder = LumaDecoder::new();
        if !trim_zeros(jpeg).ends_with(&[0xFF, 0xD9]) {
            return Err(JpegError::Damaged("cut off".into()));
        }
        decoder.decode_any(jpeg)?;
        Ok(decoder.image)
    }

    fn is_plain(jpeg: &[u8]) -> bool {
        LumaDecoder::new().decode_plain(jpeg, None).is_ok()
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
    fn every_kind_of_frame_is_decoded_to_the_same_pixels() {
        use SamplingFactor as S;
        let mut decoder = LumaDecoder::new();
        for (width_px, height_px) in [(64, 48), (16, 16), (17, 33), (131, 75), (40, 16)] {
            for (sampling, plain) in
                [(S::F_1_1, true), (S::F_2_1, true), (S::F_2_2, true), (S::F_1_2, false), (S::F_4_1, false)]
            {
                for restart_interval in [0, 1, 3, 4] {
                    let jpeg = encoded(width_px, height_px, ColorType::Rgb, |encoder| {
                        encoder.set_sampling_factor(sampling);
                        encoder.set_restart_interval(restart_interval);
                    });
                    let name = format!("{width_px} x {height_px} {sampling:?} {restart_interval}");
                    assert_eq!(is_plain(&jpeg), plain, "{name}");
                    let expected = by_the_other(&jpeg).expect("a whole JPEG");
                    assert!(*decoder.decode(&jpeg).expect("a whole JPEG") == expected, "{name}");
                }
            }
            for optimized in [false, true] {
                let gray = encoded(width_px, height_px, ColorType::Luma, |encoder| {
                    encoder.set_optimized_huffman_tables(optimized);
                });
                assert!(is_plain(&gray));
                assert!(*decoder.decode(&gray).expect("a whole JPEG") == by_the_other(&gray).expect("a whole JPEG"));
            }
            let progressive = encoded(width_px, height_px, ColorType::Rgb, |encoder| encoder.set_progressive(true));
            assert!(!is_plain(&progressive));
            decoder.decode(&progressive).expect("a whole JPEG");
        }
    }

    #[test]
    fn frames_of_the_data_sets_are_the_same_where_they_are_needed() {
        let mut decoder = LumaDecoder::new();
        for set in ["drive", "drive-day2", "corridor", "courtyard"] {
            let folder = format!("{}/tests/data/{set}/images", env!("CARGO_MANIFEST_DIR"));
            for file in std::fs::read_dir(folder).expect("there are images") {
                let jpeg = std::fs::read(file.expect("a file").path()).expect("readable");
                assert!(is_plain(&jpeg));
                let expected = by_the_other(&jpeg).expect("a whole JPEG");
                assert!(*decoder.decode(&jpeg).expect("a whole JPEG") == expected);
                let mut needed = Tiles::none(expected.width_px, expected.height_px);
                (0..expected.height_px).step_by(5).for_each(|y| needed.add_pixel(y * 37 % expected.width_px, y));
                decoder.image.pixels.fill(0);
                let image = decoder.decode_needed(&jpeg, &needed).expect("a whole JPEG");
                for (i, (found, expected)) in image.pixels.iter().zip(&expected.pixels).enumerate() {
                    let (x, y) = (i % image.width_px, i / image.width_px);
                    assert!(found == expected || !needed.contains(x / 8, y / 8), "pixel {x}, {y}");
                }
            }
        }
    }

    #[test]
    fn a_cut_frame_is_an_error_at_every_length() {
        let jpeg = picture();
        let mut decoder = LumaDecoder::new();
        for length in 0..jpeg.len() - 2 {
            assert!(decoder.decode(&jpeg[..length]).is_err(), "{length} of {} bytes were accepted", jpeg.len());
        }
    }

    #[test]
    fn a_cut_frame_is_an_error_also_with_an_end_marker() {
        let jpeg = encoded(64, 48, ColorType::Luma, |_| {});
        let scan = jpeg.windows(2).position(|pair| pair == [0xFF, 0xDA]).expect("there is a scan") + 10;
        let mut decoder = LumaDecoder::new();
        for length in scan..jpeg.len() - 3 {
            let cut = [&jpeg[..length], &[0xFF, 0xD9]].concat();
            let error = decoder.decode(&cut).map(|_| ()).expect_err("the last blocks are missing").to_string();
            assert!(error.contains("ends before"), "{length}: {error}");
        }
    }

    /// Decodes what has become of a frame by both; refuses more than the other only for the reasons that are documented.
    fn agree(jpeg: &[u8]) -> Result<(), TestCaseError> {
        let (mut decoder, other) = (LumaDecoder::new(), by_the_other(jpeg));
        match (decoder.decode(jpeg), other) {
            (Ok(image), Ok(other)) => prop_assert!(*image == other, "other pixels"),
            (Ok(_), Err(error)) => prop_assert!(false, "accepted what zune-jpeg refuses: {error}"),
            (Err(error), Ok(_)) => {
                let damages = [Damage::EndsEarly, Damage::BlockTooLong].map(|damage| damage.to_string());
                let documented = matches!(&error, JpegError::Damaged(text) if damages.contains(text));
                prop_assert!(documented, "refused what zune-jpeg accepts: {error}");
            }
            (Err(_), Err(_)) => {}
        }
        Ok(())
    }

    proptest! {
        #![proptest_config(ProptestConfig { cases: 400, ..ProptestConfig::default() })]

        #[test]
        fn damaged_frames_are_refused_by_both_or_decoded_alike(
            kind in 0..5_usize,
            flips in proptest::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 0..4),
            cut in proptest::option::of((any::<prop::sample::Index>(), any::<prop::sample::Index>())),
        ) {
            let mut jpeg = match kind {
                0 => picture(),
                1 => encoded(40, 24, ColorType::Luma, |_| {}),
                2 => encoded(33, 31, ColorType::Rgb, |encoder| encoder.set_sampling_factor(SamplingFactor::F_2_2)),
                3 => encoded(48, 32, ColorType::Rgb, |encoder| encoder.set_restart_interval(3)),
                _ => encoded(40, 24, ColorType::Luma, |encoder| encoder.set_optimized_huffman_tables(true)),
            };
            for (place, value) in flips {
                let place = place.index(jpeg.len());
                jpeg[place] = value;
            }
            if let Some((a, b)) = cut {
                let (a, b) = (a.index(jpeg.len()), b.index(jpeg.len()));
                jpeg.drain(a.min(b)..a.max(b));
            }
            agree(&jpeg)?;
        }

        #[test]
        fn damaged_image_data_is_refused_by_both_or_decoded_alike(
            flips in proptest::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..6),
        ) {
            let mut jpeg = encoded(64, 64, ColorType::Rgb, |encoder| encoder.set_sampling_factor(SamplingFactor::F_2_2));
            let scan = jpeg.windows(2).position(|pair| pair == [0xFF, 0xDA]).expect("there is a scan") + 14;
            for (place, value) in flips {
                let place = scan + place.index(jpeg.len() - scan - 2);
                jpeg[place] = value;
            }
            agree(&jpeg)?;
        }

        #[test]
        fn no_bytes_panic(bytes in proptest::collection::vec(any::<u8>(), 0..300), keep in 0..700_usize) {
            let whole = encoded(24, 24, ColorType::Luma, |_| {});
            let jpeg = [&whole[..keep.min(whole.len())], &bytes, &[0xFF, 0xD9]].concat();
            let _ = LumaDecoder::new().decode(&jpeg);
        }
    }
}
