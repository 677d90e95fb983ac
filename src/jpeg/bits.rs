//! The bits of a scan.

/// Bits there are at least after a refill.
pub const REFILLED_BITS: u32 = 56;

/// Reads bits, highest first.
#[derive(Debug, Clone, Copy)]
pub struct Bits<'a> {
    bytes: &'a [u8],
    /// The next bits, from the highest on.
    buffer: u64,
    /// How many of them are there; below are some of `bytes[next..]` already.
    count: u32,
    next: usize,
}

impl<'a> Bits<'a> {
    /// Starts at byte `start`. Beyond the end of `bytes` there are zeros.
    pub fn at(bytes: &'a [u8], start: usize) -> Self {
        Self { bytes, buffer: 0, count: 0, next: start }
    }

    /// Makes at least [`REFILLED_BITS`] available.
    #[inline(always)]
    pub fn refill(&mut self) {
        let word = self.bytes.get(self.next..self.next + 8).map_or([0; 8], |bytes| bytes.try_into().expect("8 bytes"));
        self.buffer |= u64::from_be_bytes(word) >> self.count;
        self.next += (63 - self.count as usize) / 8;
        self.count |= REFILLED_BITS;
    }

    /// The next bits, in the highest places.
    #[inline(always)]
    pub fn buffer(&self) -> u64 {
        self.buffer
    }

    /// The next `count` bits, of 1..=[`REFILLED_BITS`].
    #[inline(always)]
    pub fn peek(&self, count: u32) -> usize {
        (self.buffer >> (64 - count)) as usize
    }

    /// Passes over `count` bits that [`refill`](Self::refill) has made available.
    #[inline(always)]
    pub fn consume(&mut self, count: u32) {
        self.buffer <<= count;
        self.count -= count;
    }

    /// Bits consumed, from the first of `bytes` on.
    pub fn position(&self) -> usize {
        8 * self.next - self.count as usize
    }
}
