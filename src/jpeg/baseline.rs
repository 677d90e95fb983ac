//! Luma of baseline JPEG, transformed only where it is needed.
//!
//! Frames of a camera are plain: baseline or extended sequential Huffman coding, 8 bits, gray or Y Cb Cr, all components
//! in one scan. This decoder is for those and says [`Refusal::NotPlain`] to anything else. All of the scan is decoded, so
//! that damage anywhere is found, but chroma and blocks nobody needs are passed over several coefficients at a time.

use super::bits::{Bits, REFILLED_BITS};
use super::huffman::{AcTable, BlockTable, DcTable, MAX_SYMBOL_BITS, NoCode, Specification, WINDOW};
use super::idct::{self, SIDE};
use super::unstuff::Scan;
use crate::types::{LumaImage, Tiles};

/// Why a frame was not decoded.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Refusal {
    /// Another decoder is to have a look.
    NotPlain,
    Damaged(Damage),
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum Damage {
    #[error("the image data ends before the image is complete")]
    EndsEarly,
    #[error("an invalid Huffman code in the image data")]
    BadCode,
    #[error("a block with more than 64 coefficients in the image data")]
    BlockTooLong,
}

/// Where the coefficients of a block go, in the order they are coded: T.81, figure A.6.
#[rustfmt::skip]
const ZIGZAG: [u8; 64] = [
     0,  1,  8, 16,  9,  2,  3, 10, 17, 24, 32, 25, 18, 11,  4,  5, 12, 19, 26, 33, 40, 48,
    41, 34, 27, 20, 13,  6,  7, 14, 21, 28, 35, 42, 49, 56, 57, 50, 43, 36, 29, 22, 15, 23,
    30, 37, 44, 51, 58, 59, 52, 45, 38, 31, 39, 46, 53, 60, 61, 54, 47, 55, 62, 63,
];

/// Lookups that can be made before bits are to be refilled, so that any symbol still follows.
const LOOKUPS: u32 = (REFILLED_BITS - MAX_SYMBOL_BITS) / WINDOW + 1;

/// So many coefficients, in the order they are coded, are of the lowest four frequencies across and down.
const LOW: usize = 10;

/// Decodes frames, one after the other: tables are kept for frames that have the same.
#[derive(Debug, Default)]
pub struct Baseline {
    scan: Scan,
    tables: Option<Tables>,
}

/// The Huffman tables of all components.
#[derive(Debug)]
struct Tables {
    specifications: Vec<[Specification; 2]>,
    /// One for each pair of specifications.
    distinct: Vec<ComponentTables>,
    /// The place in `distinct` for each component.
    of_component: Vec<usize>,
}

#[derive(Debug)]
struct ComponentTables {
    dc: DcTable,
    ac: AcTable,
    whole: BlockTable,
}

impl Tables {
    fn new(specifications: Vec<[Specification; 2]>) -> Option<Self> {
        let (mut distinct, mut of_component) = (Vec::new(), Vec::new());
        for (component, pair) in specifications.iter().enumerate() {
            let same = specifications[..component].iter().position(|earlier| earlier == pair);
            of_component.push(match same {
                Some(same) => of_component[same],
                None => {
                    let (dc, ac) = (DcTable::new(&pair[0])?, AcTable::new(&pair[1])?);
                    distinct.push(ComponentTables { whole: BlockTable::new(&dc, &ac), dc, ac });
                    distinct.len() - 1
                }
            });
        }
        Some(Self { specifications, distinct, of_component })
    }

    fn of(&self, component: usize) -> &ComponentTables {
        &self.distinct[self.of_component[component]]
    }
}

/// What the headers say of a plain frame.
#[derive(Debug)]
pub struct Header {
    pub width_px: usize,
    pub height_px: usize,
    /// Blocks of luma in a minimum coded unit, across and down; the other components have one.
    luma_blocks: [usize; 2],
    components: usize,
    /// In the order of the file.
    luma_quantization: [u16; 64],
    specifications: Vec<[Specification; 2]>,
    /// Minimum coded units between restart markers, 0 where there are none.
    restart_interval: usize,
    /// Where the scan begins.
    scan_start: usize,
}

impl Baseline {
    /// Decodes the luma of the frame `header` is of, whose size `image` has. Only what is `needed` of it is written.
    pub fn decode(
        &mut self,
        jpeg: &[u8],
        header: Header,
        needed: Option<&Tiles>,
        image: &mut LumaImage,
    ) -> Result<(), Refusal> {
        let [across, down] = header.luma_blocks;
        let units = [header.width_px.div_ceil(across * SIDE), header.height_px.div_ceil(down * SIDE)];
        let interval = if header.restart_interval == 0 { units[0] * units[1] } else { header.restart_interval };
        let intervals = (units[0] * units[1]).div_ceil(interval);
        if !self.scan.read(&jpeg[header.scan_start..]) || self.scan.intervals() != intervals {
            return Err(Refusal::NotPlain);
        }
        if self.tables.as_ref().is_none_or(|tables| tables.specifications != header.specifications) {
            self.tables = Tables::new(header.specifications);
        }
        let tables = self.tables.as_ref().ok_or(Refusal::NotPlain)?;
        let mut luma = Luma {
            tables: tables.of(0),
            quantization: header.luma_quantization.map(i32::from),
            mean: 0,
            coefficients: [0; 64],
            coded: 0,
        };

        let (mut bits, mut end) = self.scan.interval(0);
        let mut unit = 0;
        for unit_y in 0..units[1] {
            for unit_x in 0..units[0] {
                if unit % interval == 0 && unit > 0 {
                    check_end(&bits, end)?;
                    (bits, end) = self.scan.interval(unit / interval);
                    luma.mean = 0;
                }
                unit += 1;
                let decoded = (|| {
                    for y in unit_y * down..(unit_y + 1) * down {
                        for x in unit_x * across..(unit_x + 1) * across {
                            if needed.is_none_or(|tiles| tiles.contains(x, y)) {
                                luma.decode_block(&mut bits)?;
                                luma.write_block(image, x * SIDE, y * SIDE);
                            } else {
                                luma.pass_over_block(&mut bits)?;
                            }
                        }
                    }
                    for component in 1..header.components {
                        pass_over_block(tables.of(component), &mut bits)?;
                    }
                    Ok(())
                })();
                if let Err(damage) = decoded {
                    check_end(&bits, end)?;
                    return Err(Refusal::Damaged(damage));
                }
            }
            // Beyond the end there are zeros, so that until here nothing worse happens than nonsense.
            check_end(&bits, end)?;
        }
        Ok(())
    }
}

fn check_end(bits: &Bits, end: usize) -> Result<(), Refusal> {
    if bits.position() > end { Err(Refusal::Damaged(Damage::EndsEarly)) } else { Ok(()) }
}

/// Decoding of luma blocks.
struct Luma<'a> {
    tables: &'a ComponentTables,
    /// In the order they are coded.
    quantization: [i32; 64],
    /// The mean of the last block, not dequantized: what the next is coded relative to.
    mean: i32,
    /// Of the last block, dequantized.
    coefficients: [i32; 64],
    /// How many of them, in the order they are coded, there may be.
    coded: usize,
}

impl Luma<'_> {
    #[inline(always)]
    fn decode_block(&mut self, bits: &mut Bits) -> Result<(), Damage> {
        bits.refill();
        self.mean = self.mean.wrapping_add(self.tables.dc.difference(bits)?);
        self.coefficients = [0; 64];
        self.coefficients[0] = self.mean.wrapping_mul(self.quantization[0]);
        let mut next = 1;
        'block: loop {
            bits.refill();
            for _ in 0..LOOKUPS {
                let pair = self.tables.ac.pair(bits);
                // A pair may belong to two blocks; and where nothing fits into the window, it is empty.
                if pair.bits() == 0 || next + usize::from(pair.advance) > 63 {
                    let coefficient = self.tables.ac.coefficient(bits.buffer())?;
                    bits.consume(coefficient.bits);
                    if coefficient.ends {
                        break 'block;
                    }
                    next += coefficient.run;
                    if next > 63 {
                        return Err(Damage::BlockTooLong);
                    }
                    self.set(next, coefficient.value);
                    next += 1;
                    if next == 64 {
                        break 'block;
                    }
                    break;
                }
                for (value, place) in pair.values.into_iter().zip(pair.places) {
                    self.set(next + usize::from(place), i32::from(value));
                }
                next += usize::from(pair.advance);
                bits.consume(pair.bits());
                if pair.ends() {
                    break 'block;
                }
            }
        }
        self.coded = next;
        Ok(())
    }

    #[inline(always)]
    fn set(&mut self, place: usize, value: i32) {
        let place = place % 64;
        self.coefficients[usize::from(ZIGZAG[place]) % 64] = value * self.quantization[place];
    }

    /// Passes over a block but for its mean.
    #[inline(always)]
    fn pass_over_block(&mut self, bits: &mut Bits) -> Result<(), Damage> {
        self.mean = self.mean.wrapping_add(pass_over_block(self.tables, bits)?);
        Ok(())
    }

    /// Writes the last block at (`left`, `top`), as far as it is within the image.
    fn write_block(&self, image: &mut LumaImage, left: usize, top: usize) {
        let rows = match self.coded {
            1 => [[idct::flat(self.coefficients[0]); SIDE]; SIDE],
            coded => idct::samples(&self.coefficients, coded <= LOW),
        };
        for (y, row) in rows.iter().enumerate().take(image.height_px.saturating_sub(top)) {
            let first = (top + y) * image.width_px + left;
            if left + SIDE <= image.width_px {
                image.pixels[first..first + SIDE].copy_from_slice(row);
            } else if left < image.width_px {
                let columns = image.width_px - left;
                image.pixels[first..first + columns].copy_from_slice(&row[..columns]);
            }
        }
    }
}

/// Passes over a block; returns by how much its mean differs from the last.
#[inline(always)]
fn pass_over_block(tables: &ComponentTables, bits: &mut Bits) -> Result<i32, Damage> {
    bits.refill();
    let (difference, skip) = tables.whole.skip(bits);
    if skip.bits() == 0 || skip.advance > 62 {
        let difference = tables.dc.difference(bits)?;
        pass_over_coefficients(&tables.ac, bits, 1)?;
        return Ok(difference);
    }
    bits.consume(skip.bits());
    if !skip.ends() {
        pass_over_coefficients(&tables.ac, bits, 1 + usize::from(skip.advance))?;
    }
    Ok(i32::from(difference))
}

/// Passes over the coefficients from the place `next` on.
#[inline(always)]
fn pass_over_coefficients(table: &AcTable, bits: &mut Bits, mut next: usize) -> Result<(), Damage> {
    loop {
        bits.refill();
        for _ in 0..LOOKUPS {
            let skip = table.skip(bits);
            // As with pairs.
            if skip.bits() == 0 || next + usize::from(skip.advance) > 63 {
                let coefficient = table.coefficient(bits.buffer())?;
                bits.consume(coefficient.bits);
                if coefficient.ends {
                    return Ok(());
                }
                next += coefficient.run + 1;
                match next {
                    ..64 => break,
                    64 => return Ok(()),
                    _ => return Err(Damage::BlockTooLong),
                }
            }
            next += usize::from(skip.advance);
            bits.consume(skip.bits());
            if skip.ends() {
                return Ok(());
            }
        }
    }
}

impl From<NoCode> for Damage {
    fn from(_: NoCode) -> Self {
        Self::BadCode
    }
}

impl Header {
    /// Reads the headers; `None` when the frame is not plain, or not quite right.
    pub fn read(jpeg: &[u8]) -> Option<Self> {
        let mut rest = jpeg.strip_prefix(&[0xFF, 0xD8])?;
        let mut frame: Option<Frame> = None;
        let mut quantization: [Option<[u16; 64]>; 4] = [None; 4];
        let mut huffman: [[Option<Specification>; 4]; 2] = Default::default();
        let mut restart_interval = 0;
        loop {
            let (&[0xFF, marker, high, low], after) = rest.split_first_chunk()? else { return None };
            let length = usize::from(u16::from_be_bytes([high, low])).checked_sub(2)?;
            let (body, after) = after.split_at_checked(length)?;
            rest = after;
            match marker {
                // APP0 and comments. Others can change what the components mean.
                0xE0 | 0xFE => {}
                0xDB => read_quantization(body, &mut quantization)?,
                0xC4 => read_huffman(body, &mut huffman)?,
                0xC0 | 0xC1 if frame.is_none() => frame = Some(Frame::read(body)?),
                0xDD => restart_interval = usize::from(u16::from_be_bytes(body.try_into().ok()?)),
                0xDA => {
                    let frame = frame?;
                    return Some(Self {
                        width_px: frame.width_px,
                        height_px: frame.height_px,
                        luma_blocks: frame.luma_blocks,
                        components: frame.components.len(),
                        luma_quantization: quantization[usize::from(frame.luma_quantization)]?,
                        specifications: frame.read_scan(body, &huffman)?,
                        restart_interval,
                        scan_start: jpeg.len() - rest.len(),
                    });
                }
                _ => return None,
            }
        }
    }
}

/// A frame header, T.81, B.2.2.
struct Frame {
    width_px: usize,
    height_px: usize,
    luma_blocks: [usize; 2],
    luma_quantization: u8,
    /// Their identifiers.
    components: Vec<u8>,
}

impl Frame {
    fn read(body: &[u8]) -> Option<Self> {
        let (&[8, h1, h0, w1, w0, count], components) = body.split_first_chunk()? else { return None };
        let (components, []) = components.as_chunks::<3>() else { return None };
        let identifiers: Vec<u8> = components.iter().map(|component| component[0]).collect();
        if usize::from(count) != components.len() || !matches!(count, 1 | 3) || identifiers == *b"RGB" {
            return None;
        }
        let [_, sampling, luma_quantization] = components[0];
        let chroma_is_coarse = components[1..].iter().all(|&[_, sampling, _]| sampling == 0x11);
        let luma_blocks = match (sampling, count) {
            (0x11, _) => [1, 1],
            (0x21, 3) => [2, 1],
            (0x22, 3) => [2, 2],
            _ => return None,
        };
        let quantizations_exist = components.iter().all(|component| component[2] < 4);
        (chroma_is_coarse && quantizations_exist).then_some(Self {
            width_px: usize::from(u16::from_be_bytes([w1, w0])),
            height_px: usize::from(u16::from_be_bytes([h1, h0])),
            luma_blocks,
            luma_quantization,
            components: identifiers,
        })
    }

    /// The DC and AC tables of every component, from a scan header: T.81, B.2.3.
    fn read_scan(&self, body: &[u8], huffman: &[[Option<Specification>; 4]; 2]) -> Option<Vec<[Specification; 2]>> {
        let (&count, rest) = body.split_first()?;
        let (selectors, rest) = rest.split_at_checked(2 * usize::from(count))?;
        let selectors = selectors.as_chunks::<2>().0;
        let in_order = selectors.iter().map(|&[identifier, _]| identifier).eq(self.components.iter().copied());
        if !in_order || *rest != [0, 63, 0] {
            return None;
        }
        let table = |class: usize, index: u8| huffman[class].get(usize::from(index))?.clone();
        selectors.iter().map(|&[_, tables]| Some([table(0, tables >> 4)?, table(1, tables & 15)?])).collect()
    }
}

/// T.81, B.2.4.1, with 8 bits a step.
fn read_quantization(mut body: &[u8], tables: &mut [Option<[u16; 64]>; 4]) -> Option<()> {
    while let Some((&index, rest)) = body.split_first() {
        let (steps, rest) = rest.split_first_chunk::<64>()?;
        *tables.get_mut(usize::from(index))? = Some(steps.map(u16::from));
        body = rest;
    }
    Some(())
}

/// T.81, B.2.4.2.
fn read_huffman(mut body: &[u8], tables: &mut [[Option<Specification>; 4]; 2]) -> Option<()> {
    while let Some((&class_and_index, rest)) = body.split_first() {
        let (&counts, rest) = rest.split_first_chunk::<16>()?;
        let count: usize = counts.iter().map(|&count| usize::from(count)).sum();
        let (symbols, rest) = rest.split_at_checked(count).filter(|_| count <= 256)?;
        let table = tables.get_mut(usize::from(class_and_index >> 4))?.get_mut(usize::from(class_and_index & 15))?;
        *table = Some(Specification { counts, symbols: symbols.to_vec() });
        body = rest;
    }
    Some(())
}
