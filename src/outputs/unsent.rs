//! Bytes on their way into something that may not take them all at once.

use std::io::{self, ErrorKind, Write};

/// Whole lines, the first of which may be partly sent. A line once begun is sent to its end; a line not yet begun can
/// be given up for newer ones, so that whoever listens never gets a torn one.
#[derive(Debug)]
pub(super) struct Unsent {
    bytes: Vec<u8>,
    /// How many of them have been sent.
    sent: usize,
    /// The first byte not yet sent is in the middle of a line.
    is_torn: bool,
    capacity: usize,
}

impl Unsent {
    pub fn new(capacity: usize) -> Self {
        Self { bytes: Vec::with_capacity(capacity), sent: 0, is_torn: false, capacity }
    }

    pub fn is_empty(&self) -> bool {
        self.bytes.is_empty()
    }

    /// Appends whole lines. Where there is no room, all lines not yet begun are given up; returns how many. Together with
    /// the rest of one line, `lines` must fit.
    pub fn push(&mut self, lines: &[u8]) -> usize {
        let mut given_up = 0;
        if self.bytes.len() - self.sent + lines.len() > self.capacity {
            let rest = self.rest_of_line();
            given_up = self.bytes[self.sent + rest..].iter().filter(|&&byte| byte == b'\n').count();
            self.bytes.truncate(self.sent + rest);
        }
        self.bytes.drain(..self.sent);
        self.sent = 0;
        self.bytes.extend(lines);
        given_up
    }

    /// Bytes of the line that is partly sent.
    fn rest_of_line(&self) -> usize {
        if !self.is_torn {
            return 0;
        }
        let rest = &self.bytes[self.sent..];
        rest.iter().position(|&byte| byte == b'\n').map_or(rest.len(), |end| end + 1)
    }

    /// Sends what is taken without waiting. Returns how much that was.
    pub fn send(&mut self, out: &mut impl Write) -> io::Result<usize> {
        let before = self.sent;
        while self.sent < self.bytes.len() {
            match out.write(&self.bytes[self.sent..]) {
                Ok(0) => return Err(ErrorKind::WriteZero.into()),
                Ok(count) => {
                    self.sent += count;
                    self.is_torn = self.bytes[self.sent - 1] != b'\n';
                }
                Err(error) if error.kind() == ErrorKind::Interrupted => {}
                Err(error) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut) => break,
                Err(error) => return Err(error),
            }
        }
        let count = self.sent - before;
        if self.sent == self.bytes.len() {
            self.bytes.clear();
            self.sent = 0;
        }
        Ok(count)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// Takes so many bytes, then would block.
    struct Narrow {
        taken: Vec<u8>,
        room: usize,
    }

    impl Write for Narrow {
        fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
            let count = bytes.len().min(self.room);
            if count == 0 {
                return Err(ErrorKind::WouldBlock.into());
            }
            self.taken.extend(&bytes[..count]);
            self.room -= count;
            Ok(count)
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    proptest! {
        #[test]
        fn whatever_is_taken_when_lines_arrive_whole_and_in_order(rooms in prop::collection::vec(0..13_usize, 1..300)) {
            const CAPACITY: usize = 64;
            let mut unsent = Unsent::new(CAPACITY);
            let address = unsent.bytes.as_ptr();
            let mut out = Narrow { taken: Vec::new(), room: 0 };
            let mut given_up = 0;
            for (number, room) in rooms.iter().enumerate() {
                given_up += unsent.push(format!("a{number}\nb{number}\n").as_bytes());
                prop_assert_eq!(unsent.bytes.as_ptr(), address, "no more memory than at the start");
                out.room = *room;
                unsent.send(&mut out).expect("takes or not");
            }
            out.room = usize::MAX;
            unsent.send(&mut out).expect("takes");
            prop_assert!(unsent.is_empty());
            let text = String::from_utf8(out.taken).expect("ASCII");
            let lines: Vec<(usize, &str)> =
                text.lines().map(|line| (line[1..].parse().expect("a whole number"), &line[..1])).collect();
            prop_assert!(lines.is_sorted() && lines.windows(2).all(|pair| pair[0] != pair[1]), "{text}");
            prop_assert_eq!(lines.len() + given_up, 2 * rooms.len());
            prop_assert_eq!(lines.last(), Some(&(rooms.len() - 1, "b")), "the newest is there");
            // Lines of 3 to 5 bytes, two a round, and on average 6 bytes are taken.
            prop_assert!(rooms.len() < 100 || given_up > 0);
        }
    }
}
