//! Position estimates to whoever listens: JSON lines on stdout, NMEA 0183 over TCP, UDP and serial lines.
//!
//! ```text
//!              ┌─► inbox ─► thread: JSON lines ─► stdout
//! estimate ────┼─► inbox ─► thread: sentences ─► TCP clients
//!              ├─► inbox ─► thread: sentences ─► UDP
//!              └─► inbox ─► thread: sentences ─► serial line
//! ```
//!
//! | module | what it is for |
//! |---|---|
//! | [`json_lines`], [`nmea`] | an estimate as text |
//! | `text` | numbers and times as text |
//! | `inbox`, `rate` | between the localizer, which never waits, and an output's thread |
//! | `worker` | the thread: delivers, opens again what has failed |
//! | `stdout`, `tcp`, `udp`, `serial` | where the text goes |
//! | `unsent` | bytes that were not taken yet |
//! | `settings` | the table `[outputs]` |
//!
//! Every output has a thread and memory of its own and may be slow, fail and come back without the others or the
//! localizer noticing. What an output cannot take in time is lost to it, oldest first and whole lines only, and counted.
//! To record estimates is the recording's: see [`Encoder::estimate`](crate::recording::recorder::Encoder::estimate).

// The same estimates on every computer.
#![cfg_attr(not(test), deny(clippy::disallowed_methods))]

mod inbox;
pub mod json_lines;
pub mod nmea;
mod rate;
mod serial;
mod settings;
mod stdout;
mod tcp;
#[cfg(test)]
mod test_estimates;
mod text;
mod udp;
mod unsent;
mod worker;

use std::{
    io,
    sync::{Arc, atomic::Ordering},
    thread::{self, JoinHandle},
    time::{Duration, Instant},
};

use tracing::warn;

use self::{
    inbox::Inbox,
    nmea::NmeaWriter,
    rate::RateLimit,
    serial::Line,
    stdout::JsonLines,
    tcp::Server,
    udp::Datagrams,
    worker::{Counters, Link, LinkError},
};
pub use self::{
    nmea::Sentence,
    settings::{Address, SerialSettings, Settings, StdoutSettings, TcpSettings, UdpSettings},
};
use crate::types::{Geodetic, PositionEstimate};

/// An estimate and when that was.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TimedEstimate {
    pub estimate: PositionEstimate,
    /// UTC of the exposure, since 1970; `None` while it is not known.
    pub utc_ns: Option<i64>,
}

/// What is waited for at the end at most: an output may be stuck.
const FINISH_LIMIT: Duration = Duration::from_secs(1);

#[derive(Debug, thiserror::Error)]
pub enum OutputError {
    #[error("the map does not say where on Earth it is, so NMEA has no position to send: remove outputs.nmea_*")]
    NoOrigin,
    #[error("cannot start the thread of output {name}")]
    NoThread { name: String, source: io::Error },
}

/// What became of the estimates of one output, since the start.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct OutputReport {
    pub name: String,
    /// Taken, or offered to all clients there were.
    pub delivered: u64,
    /// Lost: not open, or so late that they gave way to newer ones.
    pub lost: u64,
    /// Sentences or lines that were lost to a slow client.
    pub skipped: u64,
    /// Clients that came, and those that were sent away: refused, gone or stuck.
    pub clients: u64,
    pub disconnected: u64,
    /// It ended before it was told to.
    pub has_ended: bool,
}

/// The outputs, running.
#[derive(Debug, Default)]
pub struct Outputs {
    outputs: Vec<Output>,
}

#[derive(Debug)]
struct Output {
    name: Arc<str>,
    inbox: Arc<Inbox>,
    counters: Arc<Counters>,
    thread: JoinHandle<()>,
}

impl Outputs {
    /// Starts a thread for each. What cannot be opened now, such as a line that is not plugged in, is tried again.
    ///
    /// `origin`: of the map.
    pub fn start(settings: &Settings, origin: Option<Geodetic>) -> Result<Self, OutputError> {
        let mut outputs = Self::default();
        if let Some(stdout) = &settings.stdout {
            outputs.add("stdout".into(), stdout.max_rate_hz, move || JsonLines::on_stdout(origin))?;
        }
        if !settings.has_nmea() {
            return Ok(outputs);
        }
        let origin = origin.ok_or(OutputError::NoOrigin)?;
        for tcp in settings.nmea_tcp.iter().cloned() {
            let name: Arc<str> = format!("NMEA on TCP {}", tcp.listen.0).into();
            let writer = NmeaWriter::new(origin, &tcp.sentences);
            let server_name = name.clone();
            outputs.add(name, tcp.max_rate_hz, move || Server::open(&tcp, writer.clone(), &server_name))?;
        }
        for udp in settings.nmea_udp.iter().cloned() {
            let name = format!("NMEA to UDP {}", udp.target.0);
            let writer = NmeaWriter::new(origin, &udp.sentences);
            outputs.add(name.into(), udp.max_rate_hz, move || Datagrams::open(&udp, writer.clone()))?;
        }
        for serial in settings.nmea_serial.iter().cloned() {
            let name = format!("NMEA on {}", serial.port.display());
            let writer = NmeaWriter::new(origin, &serial.sentences);
            outputs.add(name.into(), Some(serial.max_rate_hz), move || Line::open(&serial, writer.clone()))?;
        }
        Ok(outputs)
    }

    fn add<L: Link>(
        &mut self,
        name: Arc<str>,
        max_rate_hz: Option<f64>,
        open: impl FnMut() -> Result<L, LinkError> + Send + 'static,
    ) -> Result<(), OutputError> {
        let inbox = Arc::new(Inbox::new(RateLimit::new(max_rate_hz)));
        let counters = Arc::<Counters>::default();
        let thread = thread::Builder::new().name("output".into()).spawn({
            let (name, inbox, counters) = (name.clone(), inbox.clone(), counters.clone());
            move || worker::run(name, open, &inbox, &counters)
        });
        let thread = thread.map_err(|source| OutputError::NoThread { name: name.to_string(), source })?;
        self.outputs.push(Output { name, inbox, counters, thread });
        Ok(())
    }

    /// Sends an estimate to all. Never waits for any of them, and allocates nothing.
    ///
    /// `utc_ns`: of the exposure, since 1970; `None` while UTC is not known.
    pub fn send(&self, estimate: &PositionEstimate, utc_ns: Option<i64>) {
        let timed = TimedEstimate { estimate: *estimate, utc_ns };
        self.outputs.iter().for_each(|output| output.inbox.push(&timed));
    }

    /// How each is doing.
    pub fn reports(&self) -> Vec<OutputReport> {
        self.outputs.iter().map(Output::report).collect()
    }

    /// Sends what still waits, then ends. An output that is stuck is left behind after a second.
    pub fn finish(self) -> Vec<OutputReport> {
        let before = self.reports();
        self.close();
        let deadline = Instant::now() + FINISH_LIMIT;
        let is_running = |output: &Output| !output.thread.is_finished();
        while self.outputs.iter().any(is_running) && Instant::now() < deadline {
            thread::sleep(Duration::from_millis(2));
        }
        for output in self.outputs.iter().filter(|output| is_running(output)) {
            warn!(output = &*output.name, "output is stuck, what it had not sent is lost");
        }
        let ended = before.into_iter().map(|report| report.has_ended);
        self.reports().into_iter().zip(ended).map(|(report, has_ended)| OutputReport { has_ended, ..report }).collect()
    }

    fn close(&self) {
        self.outputs.iter().for_each(|output| output.inbox.close());
    }
}

impl Drop for Outputs {
    fn drop(&mut self) {
        self.close();
    }
}

impl Output {
    fn report(&self) -> OutputReport {
        let Counters { delivered, lost, clients, disconnected, skipped } = &*self.counters;
        OutputReport {
            name: self.name.to_string(),
            delivered: delivered.load(Ordering::Relaxed),
            lost: lost.load(Ordering::Relaxed) + self.inbox.dropped(),
            skipped: skipped.load(Ordering::Relaxed),
            clients: clients.load(Ordering::Relaxed),
            disconnected: disconnected.load(Ordering::Relaxed),
            has_ended: self.thread.is_finished(),
        }
    }
}
