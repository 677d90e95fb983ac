//! Frames as a webcam sends them -> JPEG images that open everywhere.
//!
//! "MJPEG" is JPEG with habits: Huffman tables left out because all frames use the same, zeros after the end to fill a
//! USB packet, a few bytes too many. The Logitech C310 does all of it. A frame is mended where nothing of the image is
//! touched; where something is missing it is kept as it came and marked, so that nobody localizes on it.
//!
//! | what arrives | what becomes of it | damage |
//! |---|---|---|
//! | no Huffman tables | the standard ones are inserted | |
//! | zeros after the end marker | removed | |
//! | up to [`MAX_STRAY_BYTES`] bytes before the start or after the end marker | removed, counted | |
//! | the driver's error flag | mended as far as it goes | [`MARKED_BY_DRIVER`] |
//! | no start marker | kept | [`NO_START`] |
//! | headers that make no sense | kept | [`BAD_HEADER`] |
//! | another size than was agreed on | mended | [`WRONG_SIZE`] |
//! | no end marker | kept, with tables | [`NO_END`] |
//! | restart markers that skip a number | mended | [`RESTART_GAP`] |
//! | a marker that cannot be there, more stray bytes | kept, with tables | [`STRAY_DATA`] |
//!
//! What only decoding shows, such as a few bytes too many before a restart marker, passes here.

use crate::jpeg::{scan_header, standard_huffman_segment};

pub const MARKED_BY_DRIVER: &str = "marked damaged by the driver";
pub const NO_START: &str = "no start marker";
pub const BAD_HEADER: &str = "damaged header";
pub const WRONG_SIZE: &str = "wrong image size";
pub const NO_END: &str = "no end marker";
pub const RESTART_GAP: &str = "a piece is missing inside the image";
pub const STRAY_DATA: &str = "stray data inside the image";

/// More than this around a whole image is no sloppiness but the piece of another frame \[bytes\].
pub const MAX_STRAY_BYTES: usize = 1024;

/// What had to be done to the frames so far.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Counts {
    pub frames: u64,
    /// Without Huffman tables.
    pub tables_inserted: u64,
    /// With bytes that belong to no image, before or after it.
    pub stray_bytes_removed: u64,
    pub damaged: u64,
}

/// Mends the frames of one camera, in place.
#[derive(Debug)]
pub struct MjpegMender {
    width_px: usize,
    height_px: usize,
    counts: Counts,
}

impl MjpegMender {
    /// For frames of the size that was agreed on with the camera.
    pub fn new(width_px: u32, height_px: u32) -> Self {
        Self { width_px: width_px as usize, height_px: height_px as usize, counts: Counts::default() }
    }

    pub fn counts(&self) -> Counts {
        self.counts
    }

    /// Makes one frame a complete JPEG image; returns why it may not be used, if it may not.
    ///
    /// Allocates nothing once `frame` has the capacity for the tables.
    pub fn mend(&mut self, frame: &mut Vec<u8>, marked_by_driver: bool) -> Option<&'static str> {
        self.counts.frames += 1;
        let found = self.mend_outline(frame);
        let damage = if marked_by_driver { Some(MARKED_BY_DRIVER) } else { found.err() };
        self.counts.damaged += u64::from(damage.is_some());
        damage
    }

    fn mend_outline(&mut self, frame: &mut Vec<u8>) -> Result<(), &'static str> {
        let start = frame.windows(3).position(|bytes| bytes == [0xFF, SOI, 0xFF]).ok_or(NO_START)?;
        if start > MAX_STRAY_BYTES {
            return Err(NO_START);
        }
        let (info, scan_offset) = scan_header(&frame[start..]).map_err(|_| BAD_HEADER)?;
        let data = walk_image_data(frame, start + scan_offset);
        let mut trimmed = start > 0;
        let mut flaw = data.flaw;
        if let Some(end) = data.end {
            let stray_bytes = frame[end..].iter().rposition(|&byte| byte != 0).map_or(0, |last| last + 1);
            if stray_bytes <= MAX_STRAY_BYTES {
                trimmed |= stray_bytes > 0;
                frame.truncate(end);
            } else {
                flaw = Some(STRAY_DATA);
            }
        }
        if !info.has_huffman_tables {
            let at = start + scan_offset;
            frame.splice(at..at, standard_huffman_segment().iter().copied());
            self.counts.tables_inserted += 1;
        }
        frame.drain(..start);
        self.counts.stray_bytes_removed += u64::from(trimmed);
        match flaw {
            _ if (info.width_px, info.height_px) != (self.width_px, self.height_px) => Err(WRONG_SIZE),
            _ if data.end.is_none() => Err(NO_END),
            Some(flaw) => Err(flaw),
            None => Ok(()),
        }
    }
}

const SOI: u8 = 0xD8;
const EOI: u8 = 0xD9;
const SOS: u8 = 0xDA;

struct ImageData {
    /// Just after the first end marker.
    end: Option<usize>,
    flaw: Option<&'static str>,
}

/// Follows the markers from the first SOS to the end. In entropy-coded data a byte FF is followed by 00 or is a marker
/// (ITU-T T.81, B.1.1.5), so that this needs no decoding.
fn walk_image_data(jpeg: &[u8], scan_offset: usize) -> ImageData {
    let mut flaw = None;
    let mut next_restart = 0;
    let mut offset = scan_offset;
    while let Some(found) = jpeg.get(offset..).and_then(|rest| rest.iter().position(|&byte| byte == 0xFF)) {
        let at = offset + found;
        let Some(&marker) = jpeg.get(at + 1) else { break };
        offset = match marker {
            0x00 => at + 2,
            // Any number of fill bytes may stand before a marker.
            0xFF => at + 1,
            EOI => return ImageData { end: Some(at + 2), flaw },
            0xD0..=0xD7 => {
                let number = marker - 0xD0;
                if number != next_restart {
                    flaw.get_or_insert(RESTART_GAP);
                }
                next_restart = (number + 1) % 8;
                at + 2
            }
            // Tables and headers between the scans of an image that has several, line count, comment.
            0xC4 | SOS | 0xDB..=0xDD | 0xFE => {
                if marker == SOS {
                    next_restart = 0;
                }
                match jpeg.get(at + 2..at + 4) {
                    Some(&[high, low]) => at + 2 + usize::from(u16::from_be_bytes([high, low])).max(2),
                    _ => break,
                }
            }
            _ => {
                flaw.get_or_insert(STRAY_DATA);
                at + 2
            }
        };
    }
    ImageData { end: None, flaw }
}

#[cfg(test)]
mod tests {
    use jpeg_encoder::{ColorType, Encoder, SamplingFactor};

    use super::*;
    use crate::jpeg::LumaDecoder;

    const WIDTH_PX: u32 = 64;
    const HEIGHT_PX: u32 = 48;

    /// A busy picture, with a restart marker after every fourth block, as the C310 sends them.
    fn picture() -> Vec<u8> {
        let rgb: Vec<u8> = (0..WIDTH_PX * HEIGHT_PX * 3).map(|i| (i * 7919 % 251) as u8).collect();
        let mut jpeg = Vec::new();
        let mut encoder = Encoder::new(&mut jpeg, 90);
        encoder.set_sampling_factor(SamplingFactor::F_2_1);
        encoder.set_restart_interval(4);
        encoder.encode(&rgb, WIDTH_PX as u16, HEIGHT_PX as u16, ColorType::Rgb).expect("encodes");
        jpeg
    }

    fn without_tables(mut jpeg: Vec<u8>) -> Vec<u8> {
        while let Some(at) = jpeg.windows(2).position(|pair| pair == [0xFF, 0xC4]) {
            let length = usize::from(u16::from_be_bytes([jpeg[at + 2], jpeg[at + 3]]));
            jpeg.drain(at..at + 2 + length);
        }
        jpeg
    }

    fn luma(jpeg: &[u8]) -> Vec<u8> {
        LumaDecoder::new().decode(jpeg).expect("a whole image").pixels.clone()
    }

    fn marker(jpeg: &[u8], code: u8) -> usize {
        jpeg.windows(2).position(|pair| pair == [0xFF, code]).expect("has the marker")
    }

    #[test]
    fn sloppy_frames_become_whole_images_with_the_same_pixels() {
        let whole = picture();
        let bare = without_tables(whole.clone());
        let table: [(&str, Vec<u8>); 7] = [
            ("as it should be", whole.clone()),
            ("no tables", bare.clone()),
            ("padding", [whole.as_slice(), &[0; 2000]].concat()),
            ("two bytes after the end", [whole.as_slice(), &[0x13, 0x37]].concat()),
            ("garbage and padding after the end", [whole.as_slice(), &[0xFF; 100], &[0; 500]].concat()),
            ("garbage before the start", [&[0xFF, 0x00, 0x11], whole.as_slice()].concat()),
            ("everything at once", [&[9; 40], bare.as_slice(), &[7; 40], &[0; 512]].concat()),
        ];
        for (name, mut frame) in table {
            let damage = MjpegMender::new(WIDTH_PX, HEIGHT_PX).mend(&mut frame, false);
            assert_eq!(damage, None, "{name}");
            assert!(frame.starts_with(&[0xFF, SOI]) && frame.ends_with(&[0xFF, EOI]), "{name}");
            assert_eq!(luma(&frame), luma(&whole), "{name}");
        }
    }

    #[test]
    fn damage_is_named_and_the_frame_is_kept() {
        let whole = picture();
        let cut = whole[..whole.len() * 6 / 10].to_vec();
        let restart = marker(&whole, 0xD2);
        let missing_piece = [&whole[..restart], &whole[marker(&whole, 0xD4)..]].concat();
        let glued = [&whole[..restart], &whole].concat();
        let early_end = [&whole[..restart], &[0xFF, EOI], &whole[restart..]].concat();
        let mut other_size = whole.clone();
        let size_at = marker(&whole, 0xC0) + 5;
        other_size[size_at..size_at + 4].copy_from_slice(&[0, 24, 0, 32]);
        let mut bad_header = whole.clone();
        bad_header[20] = 0;
        let table: [(&str, Vec<u8>, bool, &str); 10] = [
            ("cut off", cut, false, NO_END),
            ("end marker missing", whole[..whole.len() - 2].to_vec(), false, NO_END),
            ("a piece lost", missing_piece, false, RESTART_GAP),
            ("two frames in one", glued, false, STRAY_DATA),
            ("an end in the middle", early_end, false, STRAY_DATA),
            ("smaller", other_size, false, WRONG_SIZE),
            ("no picture", vec![0x55; 4000], false, NO_START),
            ("zeros", vec![0; 4000], false, NO_START),
            ("header", bad_header, false, BAD_HEADER),
            ("marked", whole.clone(), true, MARKED_BY_DRIVER),
        ];
        let mut mender = MjpegMender::new(WIDTH_PX, HEIGHT_PX);
        for (name, mut frame, marked, expected) in table {
            assert_eq!(mender.mend(&mut frame, marked), Some(expected), "{name}");
            assert!(!frame.is_empty(), "{name}");
        }
        assert_eq!(mender.counts().damaged, 10);
    }

    #[test]
    fn a_damaged_frame_still_gets_its_tables() {
        let bare = without_tables(picture());
        let mut frame = bare[..bare.len() - 40].to_vec();
        let mut mender = MjpegMender::new(WIDTH_PX, HEIGHT_PX);
        assert_eq!(mender.mend(&mut frame, false), Some(NO_END));
        assert!(scan_header(&frame).expect("sound headers").0.has_huffman_tables);
        assert_eq!(mender.counts().tables_inserted, 1);
    }

    #[test]
    fn a_buffer_that_is_used_again_does_not_grow() {
        let bare = without_tables(picture());
        let mut mender = MjpegMender::new(WIDTH_PX, HEIGHT_PX);
        let mut frame = Vec::new();
        let mut mend = |frame: &mut Vec<u8>| {
            frame.clear();
            frame.extend_from_slice(&bare);
            assert_eq!(mender.mend(frame, false), None);
            (frame.as_ptr(), frame.capacity())
        };
        let first = mend(&mut frame);
        for _ in 0..10 {
            assert_eq!(mend(&mut frame), first);
        }
    }

    /// What libjpeg calls "extraneous bytes before marker" and the C310 sends every now and then.
    #[test]
    fn bytes_too_many_before_a_restart_marker_do_no_harm() {
        let whole = picture();
        let at = marker(&whole, 0xD3);
        let mut frame = [&whole[..at], &[0x12, 0x34], &whole[at..]].concat();
        assert_eq!(MjpegMender::new(WIDTH_PX, HEIGHT_PX).mend(&mut frame, false), None);
        assert_eq!(luma(&frame), luma(&whole));
    }

    proptest::proptest! {
        #[test]
        fn no_bytes_panic(bytes in proptest::collection::vec(proptest::num::u8::ANY, 0..800), at in 0usize..4000, cut in 0usize..4000) {
            let mut mender = MjpegMender::new(WIDTH_PX, HEIGHT_PX);
            mender.mend(&mut bytes.clone(), false);
            let mut frame = picture();
            let at = at % frame.len();
            frame.splice(at..at, bytes.iter().copied().take(8));
            frame.truncate(frame.len() - cut % frame.len());
            mender.mend(&mut frame, false);
        }
    }
}
