//! Plays bytes into a pseudo-terminal, so that the real serial driver can read them: simulated and replayed receivers.
//!
//! A pseudo-terminal is a pair: the *player* writes to one end, the driver opens the other by its path as if it were a
//! serial port. It has no speed: how fast bytes come is up to the player.

use std::{
    io,
    os::{fd::OwnedFd, unix::fs::symlink},
    path::{Path, PathBuf},
    time::Duration,
};

use rustix::{
    event::{PollFd, PollFlags, Timespec, poll},
    fs::{Mode, OFlags},
    io::Errno,
    pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt},
    termios::{OptionalActions, tcgetattr, tcsetattr},
};

use super::{Stop, wait_until};
use crate::types::Clock;

/// Bytes, and when the last of them is on the line.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TimedBytes {
    /// On the clock that they were simulated or recorded with.
    pub at_ns: u64,
    pub bytes: Vec<u8>,
}

/// How time goes by in a simulation or a replay.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Pace {
    /// Bytes are written when the clock says that they are due.
    Clock,
    /// As fast as they are read.
    AsRead,
}

/// One end of a pseudo-terminal. Dropping it is unplugging the device.
#[derive(Debug)]
pub struct Pty {
    master: OwnedFd,
    /// The device that the driver opens.
    device: PathBuf,
    /// A name for it that stays the same when it is plugged in again, as in `/dev/serial/by-id`.
    link: Option<PathBuf>,
}

/// What became of the bytes played.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Played {
    pub written_bytes: u64,
    /// Bytes that nobody was there to read, or did not read in time.
    pub lost_bytes: u64,
}

/// How long a wait takes before `stop` is looked at again.
const LOOK_AT_STOP: Duration = Duration::from_millis(20);

impl Pty {
    /// Makes a pseudo-terminal; `link` is made to point to it, and taken away when it is dropped.
    pub fn open(link: Option<&Path>) -> io::Result<Self> {
        let master = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC)?;
        grantpt(&master)?;
        unlockpt(&master)?;
        rustix::io::ioctl_fionbio(&master, true)?;
        let name = ptsname(&master, Vec::new())?;
        let device = PathBuf::from(name.into_string().map_err(io::Error::other)?);
        let pty = Self { master, device, link: link.map(Path::to_owned) };
        {
            // Raw before the driver opens it, or what is written until then would be echoed and held back for a line end.
            // Opened and closed, it is known to have nobody at the other end.
            let flags = OFlags::RDWR | OFlags::NOCTTY | OFlags::CLOEXEC;
            let other_end = rustix::fs::open(&pty.device, flags, Mode::empty())?;
            let mut attributes = tcgetattr(&other_end)?;
            attributes.make_raw();
            tcsetattr(&other_end, OptionalActions::Now, &attributes)?;
        }
        if let Some(link) = &pty.link {
            let beside = link.with_extension("new");
            let _ = std::fs::remove_file(&beside);
            symlink(&pty.device, &beside)?;
            std::fs::rename(&beside, link)?;
        }
        Ok(pty)
    }

    /// What the driver is to open.
    pub fn path(&self) -> &Path {
        self.link.as_deref().unwrap_or(&self.device)
    }

    /// Plays until the end or until told to stop. At a clock's pace bytes are lost, as on a real line, when nobody has the
    /// port open or its buffer is full.
    pub fn play(
        &self,
        bytes: impl IntoIterator<Item = TimedBytes>,
        pace: Pace,
        clock: &dyn Clock,
        stop: &Stop,
    ) -> io::Result<Played> {
        let mut played = Played::default();
        for TimedBytes { at_ns, bytes } in bytes {
            if pace == Pace::Clock && wait_until(at_ns, clock, stop) {
                break;
            }
            let written = self.write(&bytes, pace == Pace::AsRead, stop)?;
            played.written_bytes += written as u64;
            if stop.is_stopped() {
                break;
            }
            played.lost_bytes += (bytes.len() - written) as u64;
        }
        Ok(played)
    }

    /// Writes what fits, or with `all` everything unless told to stop. Returns how many bytes were written.
    fn write(&self, bytes: &[u8], all: bool, stop: &Stop) -> io::Result<usize> {
        let mut written = 0;
        while written < bytes.len() && !stop.is_stopped() {
            if self.is_read()? {
                match rustix::io::write(&self.master, &bytes[written..]) {
                    Ok(count) => {
                        written += count;
                        continue;
                    }
                    Err(Errno::AGAIN | Errno::INTR) => {}
                    Err(error) => return Err(error.into()),
                }
            } else {
                if !all {
                    break;
                }
                // A hang-up is there at once, so it cannot be waited for.
                stop.wait(LOOK_AT_STOP);
                continue;
            }
            if !all {
                break;
            }
            self.poll(PollFlags::OUT, LOOK_AT_STOP)?;
        }
        Ok(written)
    }

    /// Whether somebody has the other end open.
    pub fn is_read(&self) -> io::Result<bool> {
        Ok(!self.poll(PollFlags::empty(), Duration::ZERO)?.contains(PollFlags::HUP))
    }

    fn poll(&self, events: PollFlags, at_most: Duration) -> io::Result<PollFlags> {
        let timeout = Timespec::try_from(at_most).map_err(io::Error::other)?;
        let mut fds = [PollFd::new(&self.master, events)];
        match poll(&mut fds, Some(&timeout)) {
            Ok(_) => Ok(fds[0].revents()),
            Err(Errno::INTR) => Ok(PollFlags::empty()),
            Err(error) => Err(error.into()),
        }
    }
}

impl Drop for Pty {
    fn drop(&mut self) {
        if let Some(link) = &self.link
            && std::fs::read_link(link).is_ok_and(|device| device == self.device)
        {
            let _ = std::fs::remove_file(link);
        }
    }
}

/// What a receiver set to `read_baud` makes of bytes sent back to back at `sent_baud`: 8 data bits, no parity, sampled in
/// the middle of each bit; a byte whose stop bit is low is dropped, as Linux does.
pub fn received_at_rate(bytes: &[u8], sent_baud: u32, read_baud: u32) -> Vec<u8> {
    const BITS: u64 = 10;
    // Time is counted in 1 / (sent_baud × read_baud × 2) s: a bit sent lasts 2 read_baud, half a bit read sent_baud.
    let (sent_bit, half_read_bit) = (2 * u64::from(read_baud), u64::from(sent_baud));
    let end = bytes.len() as u64 * BITS * sent_bit;
    let level = |at: u64| {
        let bit = at / sent_bit;
        let Some(&byte) = bytes.get((bit / BITS) as usize) else { return true };
        match bit % BITS {
            0 => false,
            9 => true,
            data_bit => byte >> (data_bit - 1) & 1 == 1,
        }
    };
    // The receiver looks for a start bit 16 times a bit.
    let step = (half_read_bit / 8).max(1);
    let mut received = Vec::new();
    let mut at = 0;
    while at < end {
        if level(at) {
            at += step;
            continue;
        }
        let middle_of = |bit: u64| at + (2 * bit + 1) * half_read_bit;
        let byte = (1..=8).fold(0, |byte: u8, bit| byte >> 1 | u8::from(level(middle_of(bit))) << 7);
        let stop_at = middle_of(9);
        at = stop_at;
        if level(stop_at) {
            received.push(byte);
        } else {
            while at < end && !level(at) {
                at += step;
            }
        }
    }
    received
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_right_rate_gives_the_bytes_and_a_wrong_one_does_not() {
        let bytes: Vec<u8> = (0..=255).collect();
        for baud in [4_800, 115_200, 921_600] {
            assert_eq!(received_at_rate(&bytes, baud, baud), bytes);
            // A crystal that is 2 % off is still understood.
            assert_eq!(received_at_rate(&bytes, baud, baud / 50 * 51), bytes);
            assert_ne!(received_at_rate(&bytes, baud, baud / 2), bytes);
            assert_ne!(received_at_rate(&bytes, baud, baud * 2), bytes);
        }
    }
}
