//! A piece of a damaged file in memory.

use std::io::{self, Read, Seek, SeekFrom};

/// What a disk loses at once: a write of a file system block may be torn, a sector is written or not.
pub(super) const SECTOR_BYTES: u64 = 512;
/// Read at once, and kept behind what was asked for.
const READ_BYTES: usize = 1 << 20;
/// What is given up at once where the disk cannot read.
const BAD_BLOCK_BYTES: usize = 4096;

/// Random access to a file through one buffer. What the disk cannot read is zeros.
pub(super) struct Window<'a, R: Read + Seek> {
    file: R,
    pub size: u64,
    /// Offset of the buffer's first byte.
    start: u64,
    buffer: Vec<u8>,
    /// Called before every read from the file; an error ends the recovery.
    before_read: &'a mut dyn FnMut() -> io::Result<()>,
    pub unreadable_bytes: u64,
}

impl<'a, R: Read + Seek> Window<'a, R> {
    pub fn new(mut file: R, before_read: &'a mut dyn FnMut() -> io::Result<()>) -> io::Result<Self> {
        let size = file.seek(SeekFrom::End(0))?;
        Ok(Self { file, size, start: 0, buffer: Vec::new(), before_read, unreadable_bytes: 0 })
    }

    /// `length` bytes from `offset`, fewer at the end of the file.
    pub fn get(&mut self, offset: u64, length: u64) -> io::Result<&[u8]> {
        let end = offset.saturating_add(length).min(self.size);
        let offset = offset.min(end);
        let have = self.start..self.start + self.buffer.len() as u64;
        if offset < have.start || end > have.end {
            self.load(offset, end)?;
        }
        let from = (offset - self.start) as usize;
        Ok(&self.buffer[from..from + (end - offset) as usize])
    }

    /// The first piece of `length` bytes or less from `offset`, without more reading than one piece.
    pub fn piece(&mut self, offset: u64) -> io::Result<&[u8]> {
        self.get(offset, (READ_BYTES / 2) as u64)
    }

    fn load(&mut self, offset: u64, end: u64) -> io::Result<()> {
        (self.before_read)()?;
        // Whole blocks, so that the damage check sees all of the first sector.
        let start = offset - offset % BAD_BLOCK_BYTES as u64;
        let wanted = ((end - start) as usize).max(READ_BYTES).min((self.size - start) as usize);
        self.buffer.clear();
        self.buffer.resize(wanted, 0);
        self.start = start;
        self.file.seek(SeekFrom::Start(start))?;
        if self.file.read_exact(&mut self.buffer).is_ok() {
            return Ok(());
        }
        for (index, block) in self.buffer.chunks_mut(BAD_BLOCK_BYTES).enumerate() {
            self.file.seek(SeekFrom::Start(start + (index * BAD_BLOCK_BYTES) as u64))?;
            if self.file.read_exact(block).is_err() {
                block.fill(0);
                self.unreadable_bytes += block.len() as u64;
            }
        }
        Ok(())
    }

    /// Whether a sector that the range touches holds nothing but zeros: it never reached the disk.
    pub fn touches_zero_sector(&mut self, offset: u64, length: u64) -> io::Result<bool> {
        let first = offset - offset % SECTOR_BYTES;
        let end = offset.saturating_add(length).next_multiple_of(SECTOR_BYTES);
        let bytes = self.get(first, end - first)?;
        Ok(bytes.chunks(SECTOR_BYTES as usize).any(|sector| sector.iter().all(|&byte| byte == 0)))
    }
}

#[cfg(test)]
mod tests {
    use std::io::Cursor;

    use super::*;

    /// A disk with one bad sector.
    struct Scratched(Cursor<Vec<u8>>);

    impl Read for Scratched {
        fn read(&mut self, into: &mut [u8]) -> io::Result<usize> {
            let at = self.0.position();
            if at <= 5000 && at + into.len() as u64 > 5000 {
                return Err(io::Error::other("bad sector"));
            }
            self.0.read(into)
        }
    }

    impl Seek for Scratched {
        fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
            self.0.seek(to)
        }
    }

    #[test]
    fn what_the_disk_cannot_read_is_zeros() {
        let mut nothing = || Ok(());
        let mut window = Window::new(Scratched(Cursor::new(vec![7; 10_000])), &mut nothing).expect("opens");
        let bytes = window.get(4000, 6000).expect("reads");
        assert_eq!((bytes[95], bytes[96], bytes[4191], bytes[4192]), (7, 0, 0, 7));
        assert_eq!(window.unreadable_bytes, 4096);
        assert!(!window.touches_zero_sector(3000, 1000).expect("reads"));
        assert!(window.touches_zero_sector(3000, 1200).expect("reads"), "only its last bytes lie in it");
    }
}
