//! Luma of baseline JPEG, transformed only where it is needed.
//!
//! Frames of a camera are plain: baseline or extended sequential Huffman coding, 8 bits, gray or Y Cb Cr, all components
//! in one scan. This decoder is for those and says [`Refusal::NotPlain`] to anything else. All of the scan is decoded, so
//! that damage anywhere is found, but chroma and blocks nobody needs are passed over several coefficients at a time.

use super::bits::{Bits, REFILLED_BITS};
use super::header::{Header, Specifications};
use super::huffman::{AcTable, BlockTable, DcTable, MAX_SYMBOL_BITS, NoCode, WINDOW};
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
    specifications: Specifications,
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
    fn new(specifications: Specifications) -> Option<Self> {
        let (mut distinct, mut of_component) = (Vec::new(), Vec::new());
        for (component, pair) in specifications.iter().flatten().enumerate() {
            let same = specifications[..component].iter().flatten().position(|earlier| earlier == pair);
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
        let (mut index, mut left) = (0, interval);
        for y in 0..units[1] {
            for x in 0..units[0] {
                if left == 0 {
                    check_end(&bits, end)?;
                    (index, left) = (index + 1, interval);
                    (bits, end) = self.scan.interval(index);
                    luma.mean = 0;
                }
                left -= 1;
                let mut decoded = luma.decode_unit(&mut bits, [x, y], header.luma_blocks, needed, image);
                for component in 1..header.components {
                    decoded = decoded.and_then(|()| pass_over_block(tables.of(component), &mut bits).map(|_| ()));
                }
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
    /// Decodes the luma of the minimum coded unit at (`x`, `y`), of `across` × `down` blocks, and writes what is needed.
    #[inline(always)]
    fn decode_unit(
        &mut self,
        bits: &mut Bits,
        [x, y]: [usize; 2],
        [across, down]: [usize; 2],
        needed: Option<&Tiles>,
        image: &mut LumaImage,
    ) -> Result<(), Damage> {
        for y in y * down..(y + 1) * down {
            for x in x * across..(x + 1) * across {
                if needed.is_none_or(|tiles| tiles.contains(x, y)) {
                    self.decode_block(bits)?;
                    self.write_block(image, x * SIDE, y * SIDE);
                } else {
                    self.mean = self.mean.wrapping_add(pass_over_block(self.tables, bits)?);
                }
            }
        }
        Ok(())
    }

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
