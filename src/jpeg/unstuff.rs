//! The data of a scan without what marks it off.

use super::bits::Bits;

/// Entropy-coded data without stuffed zeros and restart markers: T.81, B.1.1.5.
#[derive(Debug, Default)]
pub struct Scan {
    bytes: Vec<u8>,
    /// Where each restart interval ends; the next one begins there.
    ends: Vec<usize>,
}

/// Zeros that follow the data: reading may run ahead of it.
const PADDING: usize = 8;

impl Scan {
    /// Reads up to the end marker. False where another marker comes first, or none.
    pub fn read(&mut self, mut data: &[u8]) -> bool {
        self.bytes.clear();
        self.ends.clear();
        self.bytes.reserve(data.len() + PADDING);
        while let Some(ones) = position_of_ones(data) {
            // Any number of such bytes may precede a marker.
            let Some(more) = data[ones + 1..].iter().position(|&byte| byte != 0xFF) else { break };
            let code = data[ones + 1 + more];
            match code {
                // Stuffed: the byte of ones is data.
                0 if more == 0 => self.bytes.extend_from_slice(&data[..=ones]),
                0xD0..=0xD7 | 0xD9 => {
                    self.bytes.extend_from_slice(&data[..ones]);
                    self.ends.push(self.bytes.len());
                    if code == 0xD9 {
                        self.bytes.extend([0; PADDING]);
                        return true;
                    }
                }
                _ => break,
            }
            data = &data[ones + more + 2..];
        }
        false
    }

    /// Number of restart intervals: one more than there are markers.
    pub fn intervals(&self) -> usize {
        self.ends.len()
    }

    /// The bits of an interval, and the position where they end.
    ///
    /// # Panics
    /// When there is no such interval.
    pub fn interval(&self, index: usize) -> (Bits<'_>, usize) {
        let start = if index == 0 { 0 } else { self.ends[index - 1] };
        (Bits::at(&self.bytes, start), 8 * self.ends[index])
    }
}

/// The place of the first byte 0xFF.
fn position_of_ones(data: &[u8]) -> Option<usize> {
    // Whole chunks without a branch a byte: few have one.
    const CHUNK: usize = 32;
    let without = |chunk: &[u8; CHUNK]| !chunk.iter().fold(false, |any, &byte| any | (byte == 0xFF));
    let passed = CHUNK * data.as_chunks::<CHUNK>().0.iter().take_while(|&chunk| without(chunk)).count();
    data[passed..].iter().position(|&byte| byte == 0xFF).map(|position| passed + position)
}
