//! Sentences on a serial line.
//!
//! The configuration asks for no more than the line carries, so nothing piles up in front of it. A line that is unplugged
//! is opened again when it is back.

use std::io::{self, Write};

use super::{
    TimedEstimate,
    nmea::{MAX_SENTENCE_BYTES, NmeaWriter, Sentence},
    settings::SerialSettings,
    unsent::Unsent,
    worker::{Counters, Link, LinkError, count},
};
use crate::{
    devices::{
        DeviceError,
        gnss_serial::{Tty, line_error},
    },
    types::NS_PER_S,
};

/// A line that took nothing for so long, by the frames' stamps, is opened again.
const PATIENCE_NS: u64 = 10 * NS_PER_S;

const ESTIMATE_BYTES: usize = Sentence::ALL.len() * MAX_SENTENCE_BYTES;

pub(super) struct Line {
    port: Port,
    device: String,
    writer: NmeaWriter,
    sentences: Vec<u8>,
    /// Of the estimate before, at most.
    unsent: Unsent,
    waiting_since_ns: Option<u64>,
}

impl Line {
    pub fn open(settings: &SerialSettings, writer: NmeaWriter) -> Result<Self, LinkError> {
        let device = settings.port.display().to_string();
        let tty = Tty::open(&settings.port, settings.baud).map_err(failed)?;
        rustix::io::ioctl_fionbio(tty.fd(), true).map_err(|error| failed(line_error(device.clone(), error.into())))?;
        Ok(Self {
            port: Port(tty),
            device,
            writer,
            sentences: Vec::with_capacity(ESTIMATE_BYTES),
            unsent: Unsent::new(2 * ESTIMATE_BYTES),
            waiting_since_ns: None,
        })
    }

    fn send(&mut self) -> Result<(), LinkError> {
        let sent = self.unsent.send(&mut self.port).map_err(|error| failed(line_error(self.device.clone(), error)))?;
        if sent > 0 || self.unsent.is_empty() {
            self.waiting_since_ns = None;
        }
        Ok(())
    }
}

impl Link for Line {
    fn deliver(&mut self, timed: &TimedEstimate, counters: &Counters) -> Result<(), LinkError> {
        self.sentences.clear();
        self.writer.write(timed, &mut self.sentences);
        count(&counters.skipped, self.unsent.push(&self.sentences) as u64);
        self.send()?;
        if !self.unsent.is_empty() {
            let stamp_ns = timed.estimate.stamp_ns;
            let silence_ns = stamp_ns.saturating_sub(*self.waiting_since_ns.get_or_insert(stamp_ns));
            if silence_ns > PATIENCE_NS {
                return Err(failed(DeviceError::TimedOut {
                    device: self.device.clone(),
                    silence_s: silence_ns as f64 / NS_PER_S as f64,
                }));
            }
        }
        Ok(())
    }

    fn look_after(&mut self, _counters: &Counters) -> Result<(), LinkError> {
        self.send()
    }
}

fn failed(error: DeviceError) -> LinkError {
    LinkError::Failed(match error {
        DeviceError::TimedOut { device, silence_s } => format!("{device} has taken nothing for {silence_s:.0} s"),
        DeviceError::Io { device, source } => format!("{device}: {source}"),
        other => other.to_string(),
    })
}

/// Written to without waiting.
struct Port(Tty);

impl Write for Port {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        Ok(rustix::io::write(self.0.fd(), bytes)?)
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

#[cfg(test)]
#[path = "serial_tests.rs"]
mod tests;
