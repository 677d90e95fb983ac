//! Reads the markers of a JPEG frame without decoding it: ITU-T T.81, annex B.
//!
//! Webcams send "MJPEG": JPEG frames that may leave out the Huffman tables (DHT), because all use the same ones, those of
//! annex K.3. Recordings always hold complete images, so that any program can open them.

use std::{borrow::Cow, sync::LazyLock};

/// What the headers of an image say.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct JpegInfo {
    pub width_px: usize,
    pub height_px: usize,
    /// 1 grey, 3 colour.
    pub components: u8,
    /// False for an MJPEG frame that relies on the standard tables.
    pub has_huffman_tables: bool,
}

#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum MarkerError {
    #[error("the file is empty")]
    Empty,
    #[error("not a JPEG image but {found}; expected it to start with the bytes FF D8")]
    NotJpeg { found: &'static str },
    #[error("truncated or damaged: {what} at byte {offset}")]
    BadHeader { what: &'static str, offset: usize },
    #[error(
        "truncated: the last bytes are {found}, expected the end marker FF D9 (trailing zeros are allowed); copy the file again"
    )]
    NoEnd { found: String },
    #[error(
        "unsupported kind of JPEG: {what}; convert it to a baseline or progressive JPEG, for example `magick IN OUT.jpg`"
    )]
    Unsupported { what: &'static str },
    #[error("image of {width_px} x {height_px} px; at most {} million pixels are accepted", MAX_PIXELS / 1_000_000)]
    TooLarge { width_px: usize, height_px: usize },
}

/// No camera of ours has more; a forged header could claim 4 billion.
pub const MAX_PIXELS: usize = 64_000_000;

const SOI: u8 = 0xD8;
const EOI: u8 = 0xD9;
const SOS: u8 = 0xDA;
const DHT: u8 = 0xC4;

/// Checks the frame's outline: start marker, sound header segments with a size, a scan, end marker.
///
/// The entropy-coded data is not looked at. Fill bytes and unknown segments are skipped; zeros after the end marker
/// are allowed, as some cameras pad their frames.
pub fn scan(jpeg: &[u8]) -> Result<JpegInfo, MarkerError> {
    walk(jpeg).map(|(info, _)| info)
}

/// The frame with the standard Huffman tables inserted before its scan if it has none; otherwise unchanged.
pub fn with_huffman_tables(jpeg: &[u8]) -> Result<Cow<'_, [u8]>, MarkerError> {
    let (info, scan_offset) = walk(jpeg)?;
    if info.has_huffman_tables {
        return Ok(Cow::Borrowed(jpeg));
    }
    let (header, scan) = jpeg.split_at(scan_offset);
    Ok(Cow::Owned([header, standard_huffman_segment(), scan].concat()))
}

/// The headers of a whole image, and the offset of the first SOS marker.
fn walk(jpeg: &[u8]) -> Result<(JpegInfo, usize), MarkerError> {
    let header = scan_header(jpeg)?;
    check_end(jpeg)?;
    Ok(header)
}

/// What the headers say, and the offset of the marker that begins the image data (SOS); missing tables belong before it.
///
/// What follows that marker is not looked at: the image may be cut off.
pub fn scan_header(jpeg: &[u8]) -> Result<(JpegInfo, usize), MarkerError> {
    if jpeg.is_empty() {
        return Err(MarkerError::Empty);
    }
    if !jpeg.starts_with(&[0xFF, SOI]) {
        return Err(MarkerError::NotJpeg { found: kind_of(jpeg) });
    }
    let mut frame = None;
    let mut has_huffman_tables = false;
    let mut offset = 2;
    loop {
        let marker_offset = offset;
        let bad = |what| MarkerError::BadHeader { what, offset: marker_offset };
        if jpeg.get(offset) != Some(&0xFF) {
            return Err(bad(if offset >= jpeg.len() { "the header ends" } else { "no marker where one must be" }));
        }
        while jpeg.get(offset) == Some(&0xFF) {
            offset += 1;
        }
        let marker = *jpeg.get(offset).ok_or_else(|| bad("the header ends"))?;
        offset += 1;
        match marker {
            0x01 | 0xD0..=0xD7 => continue,
            SOI => return Err(bad("a second start marker")),
            EOI => return Err(bad("an end marker before any image data")),
            0x00 => return Err(bad("a stuffed byte in the header")),
            _ => {}
        }
        let length = match jpeg.get(offset..offset + 2) {
            Some(&[high, low]) => usize::from(u16::from_be_bytes([high, low])),
            _ => return Err(bad("the header ends")),
        };
        if length < 2 {
            return Err(bad("a segment shorter than its own length field"));
        }
        let body = jpeg.get(offset + 2..offset + length).ok_or_else(|| bad("a segment longer than the file"))?;
        match marker {
            SOS => {
                let (width_px, height_px, components) = frame.ok_or_else(|| bad("image data before the image size"))?;
                return Ok((JpegInfo { width_px, height_px, components, has_huffman_tables }, marker_offset));
            }
            DHT => has_huffman_tables = true,
            0xC0..=0xC2 if frame.is_some() => return Err(bad("a second image size")),
            0xC0..=0xC2 => frame = Some(frame_size(body, marker_offset)?),
            0xC9..=0xCB | 0xCD..=0xCF => return Err(MarkerError::Unsupported { what: "arithmetic coding" }),
            0xC3 | 0xC5..=0xC7 => return Err(MarkerError::Unsupported { what: "lossless or hierarchical" }),
            _ => {}
        }
        offset += length;
    }
}

/// Width, height \[px\] and components of a SOF segment.
fn frame_size(body: &[u8], offset: usize) -> Result<(usize, usize, u8), MarkerError> {
    let &[precision_bits, h1, h0, w1, w0, components, ..] = body else {
        return Err(MarkerError::BadHeader { what: "an image size cut short", offset });
    };
    let (width_px, height_px) = (usize::from(u16::from_be_bytes([w1, w0])), usize::from(u16::from_be_bytes([h1, h0])));
    if precision_bits != 8 {
        return Err(MarkerError::Unsupported { what: "not 8 bits a sample" });
    }
    if !matches!(components, 1 | 3) {
        return Err(MarkerError::Unsupported { what: "neither grey nor colour of three components" });
    }
    if width_px == 0 || height_px == 0 {
        return Err(MarkerError::BadHeader { what: "an image without pixels", offset });
    }
    if width_px * height_px > MAX_PIXELS {
        return Err(MarkerError::TooLarge { width_px, height_px });
    }
    Ok((width_px, height_px, components))
}

fn check_end(jpeg: &[u8]) -> Result<(), MarkerError> {
    let length = jpeg.iter().rposition(|&byte| byte != 0).map_or(0, |last| last + 1);
    match jpeg[..length] {
        [.., 0xFF, EOI] => Ok(()),
        [.., a, b] => Err(MarkerError::NoEnd { found: format!("{a:02X} {b:02X}") }),
        _ => Err(MarkerError::NoEnd { found: "missing".into() }),
    }
}

/// What a file that is no JPEG most likely is.
fn kind_of(bytes: &[u8]) -> &'static str {
    let kinds: [(&[u8], &str); 5] = [
        (b"\x89PNG", "PNG (convert it with `magick IN.png -quality 95 OUT.jpg`)"),
        (b"GIF8", "GIF"),
        (b"RIFF", "RIFF (WebP or AVI)"),
        (b"BM", "BMP"),
        (b"II*\0", "TIFF"),
    ];
    let zeros = bytes.iter().all(|&byte| byte == 0);
    let unknown = if zeros { "nothing but zeros" } else { "something else" };
    kinds.iter().find(|(magic, _)| bytes.starts_with(magic)).map_or(unknown, |(_, kind)| kind)
}

/// DHT with the four tables of T.81 annex K.3 (K.3 to K.6), which MJPEG implies.
pub fn standard_huffman_segment() -> &'static [u8] {
    static SEGMENT: LazyLock<Vec<u8>> = LazyLock::new(build_standard_huffman_segment);
    &SEGMENT
}

fn build_standard_huffman_segment() -> Vec<u8> {
    let tables: [(u8, &[u8; 16], &[u8]); 4] = [
        (0x00, &DC_LUMA_COUNTS, &DC_VALUES),
        (0x10, &AC_LUMA_COUNTS, &AC_LUMA_VALUES),
        (0x01, &DC_CHROMA_COUNTS, &DC_VALUES),
        (0x11, &AC_CHROMA_COUNTS, &AC_CHROMA_VALUES),
    ];
    let mut body = Vec::new();
    for (class_and_id, counts, values) in tables {
        body.push(class_and_id);
        body.extend_from_slice(counts);
        body.extend_from_slice(values);
    }
    let length = (body.len() + 2) as u16;
    [&[0xFF, DHT], length.to_be_bytes().as_slice(), &body].concat()
}

/// Codes of each length 1..=16, table K.3; the values are the categories 0..=11.
const DC_LUMA_COUNTS: [u8; 16] = [0, 1, 5, 1, 1, 1, 1, 1, 1, 0, 0, 0, 0, 0, 0, 0];
/// Table K.4.
const DC_CHROMA_COUNTS: [u8; 16] = [0, 3, 1, 1, 1, 1, 1, 1, 1, 1, 1, 0, 0, 0, 0, 0];
const DC_VALUES: [u8; 12] = [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11];
/// Table K.5.
const AC_LUMA_COUNTS: [u8; 16] = [0, 2, 1, 3, 3, 2, 4, 3, 5, 5, 4, 4, 0, 0, 1, 0x7D];
#[rustfmt::skip]
const AC_LUMA_VALUES: [u8; 162] = [
    0x01, 0x02, 0x03, 0x00, 0x04, 0x11, 0x05, 0x12, 0x21, 0x31, 0x41, 0x06, 0x13, 0x51, 0x61, 0x07, 0x22, 0x71,
    0x14, 0x32, 0x81, 0x91, 0xA1, 0x08, 0x23, 0x42, 0xB1, 0xC1, 0x15, 0x52, 0xD1, 0xF0, 0x24, 0x33, 0x62, 0x72,
    0x82, 0x09, 0x0A, 0x16, 0x17, 0x18, 0x19, 0x1A, 0x25, 0x26, 0x27, 0x28, 0x29, 0x2A, 0x34, 0x35, 0x36, 0x37,
    0x38, 0x39, 0x3A, 0x43, 0x44, 0x45, 0x46, 0x47, 0x48, 0x49, 0x4A, 0x53, 0x54, 0x55, 0x56, 0x57, 0x58, 0x59,
    0x5A, 0x63, 0x64, 0x65, 0x66, 0x67, 0x68, 0x69, 0x6A, 0x73, 0x74, 0x75, 0x76, 0x77, 0x78, 0x79, 0x7A, 0x83,
    0x84, 0x85, 0x86, 0x87, 0x88, 0x89, 0x8A, 0x92, 0x93, 0x94, 0x95, 0x96, 0x97, 0x98, 0x99, 0x9A, 0xA2, 0xA3,
    0xA4, 0xA5, 0xA6, 0xA7, 0xA8, 0xA9, 0xAA, 0xB2, 0xB3, 0xB4, 0xB5, 0xB6, 0xB7, 0xB8, 0xB9, 0xBA, 0xC2, 0xC3,
    0xC4, 0xC5, 0xC6, 0xC7, 0xC8, 0xC9, 0xCA, 0xD2, 0xD3, 0xD4, 0xD5, 0xD6, 0xD7, 0xD8, 0xD9, 0xDA, 0xE1, 0xE2,
    0xE3, 0xE4, 0xE5, 0xE6, 0xE7, 0xE8, 0xE9, 0xEA, 0xF1, 0xF2, 0xF3, 0xF4, 0xF5, 0xF6, 0xF7, 0xF8, 0xF9, 0xFA,
];
/// Table K.6.
const AC_CHROMA_COUNTS: [u8; 16] = [0, 2, 1, 2, 4, 4, 3, 4, 7, 5, 4, 4, 0, 1, 2, 0x77];
#[rustfmt::skip]
const AC_CHROMA_VALUES: [u8; 162] = [
    0x00, 0x01, 0x02, 0x03, 0x11, 0x04, 0x05, 0x21, 0x31, 0x06, 0x12, 0x41, 0x51, 0x07, 0x61, 0x71, 0x13, 0x22,
    0x32, 0x81, 0x08, 0x14, 0x42, 0x91, 0xA1, 0xB1, 0xC1, 0x09, 0x23, 0x33, 0x52, 0xF0, 0x15, 0x62, 0x72, 0xD1,
    0x0A, 0x16, 0x24, 0x34, 0xE1, 0x25, 0xF1, 0x17, 0x18, 0x19, 0x1A, 0x26, 0x27, 0x28, 0x29, 0x2A, 0x35, 0x36,
    0x37, 0x38, 0x39, 0x3A, 0x43, 0x44, 0x45, 0x46, 0x47, 0x48, 0x49, 0x4A, 0x53, 0x54, 0x55, 0x56, 0x57, 0x58,
    0x59, 0x5A, 0x63, 0x64, 0x65, 0x66, 0x67, 0x68, 0x69, 0x6A, 0x73, 0x74, 0x75, 0x76, 0x77, 0x78, 0x79, 0x7A,
    0x82, 0x83, 0x84, 0x85, 0x86, 0x87, 0x88, 0x89, 0x8A, 0x92, 0x93, 0x94, 0x95, 0x96, 0x97, 0x98, 0x99, 0x9A,
    0xA2, 0xA3, 0xA4, 0xA5, 0xA6, 0xA7, 0xA8, 0xA9, 0xAA, 0xB2, 0xB3, 0xB4, 0xB5, 0xB6, 0xB7, 0xB8, 0xB9, 0xBA,
    0xC2, 0xC3, 0xC4, 0xC5, 0xC6, 0xC7, 0xC8, 0xC9, 0xCA, 0xD2, 0xD3, 0xD4, 0xD5, 0xD6, 0xD7, 0xD8, 0xD9, 0xDA,
    0xE2, 0xE3, 0xE4, 0xE5, 0xE6, 0xE7, 0xE8, 0xE9, 0xEA, 0xF2, 0xF3, 0xF4, 0xF5, 0xF6, 0xF7, 0xF8, 0xF9, 0xFA,
];

#[cfg(test)]
mod tests {
    use super::*;

    /// A grey picture of 16 x 8 px, encoded by the `image` crate, which writes the standard tables.
    fn picture() -> Vec<u8> {
        let pixels: Vec<u8> = (0..16 * 8).map(|i| (i * 37 % 251) as u8).collect();
        let mut jpeg = Vec::new();
        image::codecs::jpeg::JpegEncoder::new_with_quality(&mut jpeg, 90)
            .encode(&pixels, 16, 8, image::ExtendedColorType::L8)
            .expect("encodes");
        jpeg
    }

    /// The same frame as a webcam without tables would send it.
    fn without_huffman_tables(jpeg: &[u8]) -> Vec<u8> {
        let mut bare = jpeg.to_vec();
        while let Some(at) = bare.windows(2).position(|pair| pair == [0xFF, DHT]) {
            let length = usize::from(u16::from_be_bytes([bare[at + 2], bare[at + 3]]));
            bare.drain(at..at + 2 + length);
        }
        bare
    }

    #[test]
    fn size_and_tables_are_found() {
        let info = JpegInfo { width_px: 16, height_px: 8, components: 1, has_huffman_tables: true };
        assert_eq!(scan(&picture()), Ok(info));
        let padded = [picture(), vec![0; 300]].concat();
        assert_eq!(scan(&padded), Ok(info), "trailing zeros are allowed");
    }

    #[test]
    fn inserted_tables_decode_to_the_same_pixels() {
        let whole = picture();
        let bare = without_huffman_tables(&whole);
        assert!(!scan(&bare).expect("sound").has_huffman_tables);
        let mended = with_huffman_tables(&bare).expect("sound");
        let decode = |bytes: &[u8]| image::load_from_memory(bytes).expect("decodes").to_luma8();
        assert_eq!(decode(&mended), decode(&whole));
        assert!(matches!(with_huffman_tables(&whole), Ok(Cow::Borrowed(_))), "complete frames stay as they are");
    }

    #[test]
    fn standard_tables_have_the_length_of_annex_k() {
        // 2 marker + 2 length + 4 x 17 + 12 + 162 + 12 + 162.
        assert_eq!(standard_huffman_segment().len(), 420);
        for (counts, values) in
            [(DC_LUMA_COUNTS, 12), (DC_CHROMA_COUNTS, 12), (AC_LUMA_COUNTS, 162), (AC_CHROMA_COUNTS, 162)]
        {
            assert_eq!(counts.iter().map(|&n| usize::from(n)).sum::<usize>(), values);
        }
    }

    #[test]
    fn every_truncation_is_an_error_and_never_a_panic() {
        let jpeg = picture();
        for length in 0..jpeg.len() {
            assert!(scan(&jpeg[..length]).is_err(), "cut to {length} bytes");
        }
    }

    #[test]
    fn what_is_wrong_is_named() {
        let huge = {
            let mut jpeg = picture();
            let sof = jpeg.windows(2).position(|pair| pair == [0xFF, 0xC0]).expect("has a size");
            jpeg[sof + 5..sof + 9].copy_from_slice(&[0xFF; 4]);
            jpeg
        };
        let table: [(&str, Vec<u8>, &str); 5] = [
            ("nothing", vec![], "empty"),
            ("PNG", b"\x89PNG\r\n".to_vec(), "PNG (convert"),
            ("zeros", vec![0; 100], "zeros"),
            ("cut", picture()[..picture().len() - 2].to_vec(), "truncated"),
            ("huge", huge, "65535 x 65535"),
        ];
        for (name, bytes, expected) in table {
            let message = scan(&bytes).expect_err(name).to_string();
            assert!(message.contains(expected), "{name}: {message}");
        }
    }

    proptest::proptest! {
        #[test]
        fn no_bytes_panic(bytes in proptest::collection::vec(proptest::num::u8::ANY, 0..600), flip in 0usize..600) {
            let _ = scan(&bytes);
            let mut jpeg = picture();
            let at = flip % jpeg.len();
            jpeg[at] ^= bytes.first().copied().unwrap_or(1);
            let _ = with_huffman_tables(&jpeg);
        }
    }
}
