//! Huffman codes of baseline JPEG as tables that resolve several symbols at a time.
//!
//! Every table is looked up with the next [`WINDOW`] bits. What does not fit in them is decoded symbol by symbol.

use super::bits::Bits;

/// Bits a table is looked up with. More resolve more at a time, but the tables should stay in the fastest cache.
pub const WINDOW: u32 = 11;
const ENTRIES: usize = 1 << WINDOW;
/// No code is longer.
const MAX_CODE_BITS: u32 = 16;

/// A code with the value that follows it.
pub const MAX_SYMBOL_BITS: u32 = MAX_CODE_BITS + 15;

/// The bits that come next are not a code.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct NoCode;

/// A table as the file has it: ITU-T T.81, B.2.4.2.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Specification {
    /// Number of codes of each length 1..=16.
    counts: [u8; 16],
    /// Symbols in the order of their codes; zeros behind the last.
    symbols: [u8; 256],
}

impl Specification {
    /// `None` where there are not as many symbols as codes, or more than 256.
    pub fn new(counts: [u8; 16], symbols: &[u8]) -> Option<Self> {
        let count: usize = counts.iter().map(|&count| usize::from(count)).sum();
        let mut padded = [0; 256];
        padded.get_mut(..count).filter(|_| symbols.len() == count)?.copy_from_slice(symbols);
        Some(Self { counts, symbols: padded })
    }
}

/// Canonical decoding, T.81, F.2.2.3: any code, one at a time.
#[derive(Debug, Clone)]
struct Canonical {
    /// One more than the greatest code of each length, in the highest of 16 bits; rising.
    end: [u32; MAX_CODE_BITS as usize],
    /// What to add to a code of each length to have its place among the symbols.
    offset: [i32; MAX_CODE_BITS as usize],
    symbols: [u8; 256],
}

/// A symbol with its code.
#[derive(Debug, Clone, Copy)]
struct Symbol {
    value: u8,
    code_bits: u32,
}

impl Symbol {
    /// Bits that follow the code and hold the value: the low half of a symbol of either kind.
    fn value_bits(self) -> u32 {
        u32::from(self.value & 15)
    }

    fn bits(self) -> u32 {
        self.code_bits + self.value_bits()
    }
}

impl Canonical {
    /// `None` for counts that are no prefix code, or one that uses the code of ones alone.
    fn new(specification: &Specification) -> Option<Self> {
        let (mut end, mut offset) = ([0; 16], [0; 16]);
        let (mut code, mut place) = (0_u32, 0_u32);
        for (i, &count) in specification.counts.iter().enumerate() {
            let length = i as u32 + 1;
            offset[i] = place as i32 - code as i32;
            code += u32::from(count);
            place += u32::from(count);
            if count > 0 && code >= 1 << length {
                return None;
            }
            end[i] = code << (MAX_CODE_BITS - length);
            code <<= 1;
        }
        Some(Self { end, offset, symbols: specification.symbols })
    }

    /// The symbol whose code the highest of the 64 `bits` begin with.
    fn symbol(&self, bits: u64) -> Option<Symbol> {
        let next = (bits >> (64 - MAX_CODE_BITS)) as u32;
        let i = self.end.iter().position(|&end| next < end)?;
        let code_bits = i as u32 + 1;
        let place = (next >> (MAX_CODE_BITS - code_bits)) as i32 + self.offset[i];
        let value = *self.symbols.get(usize::try_from(place).ok()?)?;
        Some(Symbol { value, code_bits })
    }
}

/// The value of a coefficient or DC difference: the first `count` of the 64 `bits`, T.81, F.2.2.1, figure F.12 (EXTEND).
#[inline(always)]
fn extended(bits: u64, count: u32) -> i32 {
    if count == 0 {
        return 0;
    }
    let value = (bits >> (64 - count)) as i32;
    if value < 1 << (count - 1) { value + 1 - (1 << count) } else { value }
}

/// DC differences.
#[derive(Debug)]
pub struct DcTable {
    canonical: Canonical,
    /// Difference << 8 | bits, 0 where they do not fit.
    entries: Box<[i32; ENTRIES]>,
}

impl DcTable {
    pub fn new(specification: &Specification) -> Option<Self> {
        let canonical = Canonical::new(specification)?;
        if specification.symbols.iter().any(|&symbol| symbol > 15) {
            return None;
        }
        let mut entries = Box::new([0; ENTRIES]);
        for (window, entry) in entries.iter_mut().enumerate() {
            let bits = (window as u64) << (64 - WINDOW);
            if let Some(symbol) = canonical.symbol(bits).filter(|symbol| symbol.bits() <= WINDOW) {
                *entry = extended(bits << symbol.code_bits, symbol.value_bits()) << 8 | symbol.bits() as i32;
            }
        }
        Some(Self { canonical, entries })
    }

    /// Reads a difference. Needs 31 bits.
    #[inline(always)]
    pub fn difference(&self, bits: &mut Bits) -> Result<i32, NoCode> {
        let entry = self.entries[bits.peek(WINDOW)];
        let (difference, length) =
            if entry != 0 { (entry >> 8, entry as u32 & 0xFF) } else { self.long(bits.buffer())? };
        bits.consume(length);
        Ok(difference)
    }

    /// The difference the 64 `bits` begin with, and its length.
    #[cold]
    fn long(&self, bits: u64) -> Result<(i32, u32), NoCode> {
        let symbol = self.canonical.symbol(bits).ok_or(NoCode)?;
        Ok((extended(bits << symbol.code_bits, symbol.value_bits()), symbol.bits()))
    }
}

/// AC coefficients.
#[derive(Debug)]
pub struct AcTable {
    canonical: Canonical,
    /// Up to two coefficients, see [`Pair`].
    pairs: Box<[Pair; ENTRIES]>,
    /// As many coefficients as fit, without their values.
    skips: Box<[Skip; ENTRIES]>,
}

/// Up to two coefficients and the end of the block, in one lookup.
#[derive(Debug, Clone, Copy, Default)]
#[repr(align(8))]
pub struct Pair {
    pub values: [i16; 2],
    /// Where they go, relative to the next place. The second goes anywhere later where there is only one: its value is 0.
    pub places: [u8; 2],
    /// Bits in the lower half, 0 where not even one fits; in the upper whether the block ends here.
    bits_and_end: u8,
    /// Places passed.
    pub advance: u8,
}

impl Pair {
    #[inline(always)]
    pub fn bits(self) -> u32 {
        u32::from(self.bits_and_end & 0x7F)
    }

    #[inline(always)]
    pub fn ends(self) -> bool {
        self.bits_and_end & 0x80 != 0
    }
}

/// Several coefficients passed over.
#[derive(Debug, Clone, Copy, Default)]
pub struct Skip {
    /// As in [`Pair`].
    bits_and_end: u8,
    pub advance: u8,
}

impl Skip {
    #[inline(always)]
    pub fn bits(self) -> u32 {
        u32::from(self.bits_and_end & 0x7F)
    }

    #[inline(always)]
    pub fn ends(self) -> bool {
        self.bits_and_end & 0x80 != 0
    }
}

/// One coefficient, or the end of the block, or 16 zeros.
pub struct Coefficient {
    pub bits: u32,
    pub value: i32,
    /// Zeros before it.
    pub run: usize,
    pub ends: bool,
}

impl AcTable {
    pub fn new(specification: &Specification) -> Option<Self> {
        let canonical = Canonical::new(specification)?;
        let (mut pairs, mut skips) = (Box::new([Pair::default(); ENTRIES]), Box::new([Skip::default(); ENTRIES]));
        for window in 0..ENTRIES {
            let bits = (window as u64) << (64 - WINDOW);
            pairs[window] = pair(&canonical, bits);
            skips[window] = skip(&canonical, bits, 0);
        }
        Some(Self { canonical, pairs, skips })
    }

    /// What the next bits begin with.
    #[inline(always)]
    pub fn pair(&self, bits: &Bits) -> Pair {
        self.pairs[bits.peek(WINDOW)]
    }

    #[inline(always)]
    pub fn skip(&self, bits: &Bits) -> Skip {
        self.skips[bits.peek(WINDOW)]
    }

    /// What the 64 `bits` begin with.
    #[cold]
    pub fn coefficient(&self, bits: u64) -> Result<Coefficient, NoCode> {
        let symbol = self.canonical.symbol(bits).ok_or(NoCode)?;
        let value = extended(bits << symbol.code_bits, symbol.value_bits());
        let run = usize::from(symbol.value >> 4);
        Ok(Coefficient { bits: symbol.bits(), value, run, ends: symbol.value_bits() == 0 && run != 15 })
    }
}

/// Whole blocks passed over, but for the DC difference.
#[derive(Debug)]
pub struct BlockTable {
    entries: Box<[(i16, Skip); ENTRIES]>,
}

impl BlockTable {
    pub fn new(dc: &DcTable, ac: &AcTable) -> Self {
        let mut entries = Box::new([Default::default(); ENTRIES]);
        for (window, entry) in entries.iter_mut().enumerate() {
            let bits = (window as u64) << (64 - WINDOW);
            if let Some(symbol) = dc.canonical.symbol(bits).filter(|symbol| symbol.bits() <= WINDOW) {
                let difference = extended(bits << symbol.code_bits, symbol.value_bits()) as i16;
                *entry = (difference, skip(&ac.canonical, bits, symbol.bits()));
            }
        }
        Self { entries }
    }

    /// The difference, and as many coefficients as fit.
    #[inline(always)]
    pub fn skip(&self, bits: &Bits) -> (i16, Skip) {
        self.entries[bits.peek(WINDOW)]
    }
}

fn pair(canonical: &Canonical, bits: u64) -> Pair {
    let mut pair = Pair::default();
    let (mut used, mut coefficients) = (0, 0);
    while let Some(symbol) = canonical.symbol(bits << used).filter(|symbol| used + symbol.bits() <= WINDOW) {
        let run = symbol.value >> 4;
        if symbol.value_bits() == 0 {
            if run == 15 {
                // Sixteen zeros; they are few, and the slow way does for them.
                break;
            }
            pair.bits_and_end = (used + symbol.bits()) as u8 | 0x80;
            return pair;
        }
        if coefficients == 2 {
            break;
        }
        pair.values[coefficients] = extended(bits << (used + symbol.code_bits), symbol.value_bits()) as i16;
        pair.places[coefficients] = pair.advance + run;
        pair.advance += run + 1;
        if coefficients == 0 {
            pair.places[1] = pair.advance;
        }
        coefficients += 1;
        used += symbol.bits();
        pair.bits_and_end = used as u8;
    }
    pair
}

/// Passes over symbols from the `used` first bits on.
fn skip(canonical: &Canonical, bits: u64, mut used: u32) -> Skip {
    let mut advance = 0;
    while let Some(symbol) = canonical.symbol(bits << used).filter(|symbol| used + symbol.bits() <= WINDOW) {
        let run = symbol.value >> 4;
        if symbol.value_bits() == 0 && run != 15 {
            return Skip { bits_and_end: (used + symbol.bits()) as u8 | 0x80, advance };
        }
        used += symbol.bits();
        advance += run + 1;
    }
    Skip { bits_and_end: used as u8, advance }
}
