//! The headers of plain frames.

use super::huffman::Specification;

/// What the headers say of a plain frame.
#[derive(Debug)]
pub struct Header {
    pub width_px: usize,
    pub height_px: usize,
    /// Blocks of luma in a minimum coded unit, across and down; the other components have one.
    pub luma_blocks: [usize; 2],
    pub components: usize,
    /// In the order of the file.
    pub luma_quantization: [u16; 64],
    /// The DC and AC tables of the first `components`.
    pub specifications: Specifications,
    /// Minimum coded units between restart markers, 0 where there are none.
    pub restart_interval: usize,
    /// Where the scan begins.
    pub scan_start: usize,
}

/// One component after the other; `None` behind the last.
pub type Specifications = [Option<[Specification; 2]>; MAX_COMPONENTS];

const MAX_COMPONENTS: usize = 3;

impl Header {
    /// Reads the headers; `None` when the frame is not plain, or not quite right.
    pub fn read(jpeg: &[u8]) -> Option<Self> {
        let mut rest = jpeg.strip_prefix(&[0xFF, 0xD8])?;
        let mut frame: Option<Frame> = None;
        let mut quantization: [Option<[u16; 64]>; 4] = [None; 4];
        let mut huffman = [[None; 4]; 2];
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
                        components: frame.components().len(),
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
    /// Number of components, and their identifiers.
    count: usize,
    identifiers: [u8; MAX_COMPONENTS],
}

impl Frame {
    fn read(body: &[u8]) -> Option<Self> {
        let (&[8, h1, h0, w1, w0, count], components) = body.split_first_chunk()? else { return None };
        let (components, []) = components.as_chunks::<3>() else { return None };
        if usize::from(count) != components.len() || !matches!(count, 1 | 3) {
            return None;
        }
        let mut identifiers = [0; MAX_COMPONENTS];
        identifiers.iter_mut().zip(components).for_each(|(identifier, component)| *identifier = component[0]);
        if identifiers == *b"RGB" {
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
            count: usize::from(count),
            identifiers,
        })
    }

    /// Identifiers.
    fn components(&self) -> &[u8] {
        &self.identifiers[..self.count]
    }

    /// The DC and AC tables of every component, from a scan header: T.81, B.2.3.
    fn read_scan(&self, body: &[u8], huffman: &[[Option<Specification>; 4]; 2]) -> Option<Specifications> {
        let (&count, rest) = body.split_first()?;
        let (selectors, rest) = rest.split_at_checked(2 * usize::from(count))?;
        let selectors = selectors.as_chunks::<2>().0;
        let in_order = selectors.iter().map(|&[identifier, _]| identifier).eq(self.components().iter().copied());
        if !in_order || *rest != [0, 63, 0] {
            return None;
        }
        let table = |class: usize, index: u8| *huffman[class].get(usize::from(index))?;
        let mut specifications = [None; MAX_COMPONENTS];
        for (specification, &[_, tables]) in specifications.iter_mut().zip(selectors) {
            *specification = Some([table(0, tables >> 4)?, table(1, tables & 15)?]);
        }
        Some(specifications)
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
        let (symbols, rest) = rest.split_at_checked(count)?;
        let table = tables.get_mut(usize::from(class_and_index >> 4))?.get_mut(usize::from(class_and_index & 15))?;
        *table = Some(Specification::new(counts, symbols)?);
        body = rest;
    }
    Some(())
}
