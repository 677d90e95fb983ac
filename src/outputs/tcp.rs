//! Sentences for whoever connects.
//!
//! A client that does not read is not waited for: little is buffered for it, and what does not fit any more gives way to
//! newer sentences, whole ones only. When it has taken nothing for [`PATIENCE_NS`] it is disconnected.

use std::{
    io::{ErrorKind, Read},
    net::{SocketAddr, TcpListener, TcpStream},
    sync::Arc,
};

use rustix::net::sockopt::set_socket_send_buffer_size;
use tracing::{info, warn};

use super::{
    TimedEstimate,
    nmea::{MAX_SENTENCE_BYTES, NmeaWriter, Sentence},
    settings::TcpSettings,
    unsent::Unsent,
    worker::{Counters, Link, LinkError, Trouble, count},
};
use crate::types::NS_PER_S;

/// A client that took nothing for so long, by the frames' stamps, has gone or hangs.
const PATIENCE_NS: u64 = 10 * NS_PER_S;

/// What the kernel holds for a client \[bytes\]; it doubles this. Its own choice grows to megabytes: minutes of positions
/// that are no longer true when they are read.
const SEND_BUFFER_BYTES: usize = 8 << 10;

/// What we hold beside it: the sentences of some ten estimates.
const UNSENT_BYTES: usize = 10 * Sentence::ALL.len() * MAX_SENTENCE_BYTES;

pub(super) struct Server {
    listener: TcpListener,
    writer: NmeaWriter,
    max_clients: usize,
    clients: Vec<Client>,
    /// The sentences of one estimate.
    sentences: Vec<u8>,
    /// Of accepting.
    trouble: Trouble,
    is_refusing: bool,
}

struct Client {
    stream: TcpStream,
    peer: SocketAddr,
    unsent: Unsent,
    /// Stamp of the first estimate since it last took something.
    waiting_since_ns: Option<u64>,
}

impl Server {
    pub fn open(settings: &TcpSettings, writer: NmeaWriter, name: &Arc<str>) -> Result<Self, LinkError> {
        let listener = TcpListener::bind(settings.listen.0);
        let listener = listener.and_then(|listener| listener.set_nonblocking(true).map(|()| listener));
        let listener = listener.map_err(|error| LinkError::Failed(format!("cannot listen: {error}")))?;
        Ok(Self {
            listener,
            writer,
            max_clients: settings.max_clients,
            clients: Vec::with_capacity(settings.max_clients),
            sentences: Vec::with_capacity(Sentence::ALL.len() * MAX_SENTENCE_BYTES),
            trouble: Trouble::new(name.clone()),
            is_refusing: false,
        })
    }

    /// Lets in who waits outside.
    fn accept(&mut self, counters: &Counters) {
        loop {
            match self.listener.accept() {
                Ok((_, peer)) if self.clients.len() >= self.max_clients => {
                    count(&counters.disconnected, 1);
                    if !std::mem::replace(&mut self.is_refusing, true) {
                        warn!(%peer, max_clients = self.max_clients, "NMEA client refused, there are too many");
                    }
                }
                Ok((stream, peer)) => match Client::new(stream, peer) {
                    Ok(client) => {
                        info!(%peer, "NMEA client connected");
                        count(&counters.clients, 1);
                        self.clients.push(client);
                    }
                    Err(error) => info!(%peer, %error, "NMEA client left at once"),
                },
                Err(error) if error.kind() == ErrorKind::WouldBlock => break self.trouble.mended(),
                Err(error) if matches!(error.kind(), ErrorKind::Interrupted | ErrorKind::ConnectionAborted) => {}
                // No descriptors or no memory left: those who are connected are served.
                Err(error) => break self.trouble.failed(&error),
            }
        }
    }

    /// Serves each client, and parts with those that `serve` has no good word for.
    fn serve(&mut self, counters: &Counters, mut serve: impl FnMut(&mut Client) -> Result<(), String>) {
        self.clients.retain_mut(|client| match serve(client) {
            Ok(()) => true,
            Err(reason) => {
                info!(peer = %client.peer, reason, "NMEA client disconnected");
                count(&counters.disconnected, 1);
                false
            }
        });
        self.is_refusing &= self.clients.len() >= self.max_clients;
    }
}

impl Link for Server {
    fn deliver(&mut self, timed: &TimedEstimate, counters: &Counters) -> Result<(), LinkError> {
        self.accept(counters);
        let mut sentences = std::mem::take(&mut self.sentences);
        sentences.clear();
        self.writer.write(timed, &mut sentences);
        self.serve(counters, |client| client.push(&sentences, timed.estimate.stamp_ns, counters));
        self.sentences = sentences;
        Ok(())
    }

    fn look_after(&mut self, counters: &Counters) -> Result<(), LinkError> {
        self.accept(counters);
        self.serve(counters, Client::flush);
        Ok(())
    }
}

impl Client {
    fn new(stream: TcpStream, peer: SocketAddr) -> std::io::Result<Self> {
        stream.set_nonblocking(true)?;
        stream.set_nodelay(true)?;
        set_socket_send_buffer_size(&stream, SEND_BUFFER_BYTES)?;
        Ok(Self { stream, peer, unsent: Unsent::new(UNSENT_BYTES), waiting_since_ns: None })
    }

    fn push(&mut self, sentences: &[u8], stamp_ns: u64, counters: &Counters) -> Result<(), String> {
        count(&counters.skipped, self.unsent.push(sentences) as u64);
        self.flush()?;
        if self.unsent.is_empty() {
            return Ok(());
        }
        let since_ns = *self.waiting_since_ns.get_or_insert(stamp_ns);
        if stamp_ns.saturating_sub(since_ns) > PATIENCE_NS {
            return Err(format!("has taken nothing for {} s", PATIENCE_NS / NS_PER_S));
        }
        Ok(())
    }

    fn flush(&mut self) -> Result<(), String> {
        self.discard_input()?;
        let sent = self.unsent.send(&mut self.stream).map_err(|error| error.to_string())?;
        if sent > 0 || self.unsent.is_empty() {
            self.waiting_since_ns = None;
        }
        Ok(())
    }

    /// What clients say, such as gpsd's probing, is of no interest. One that has nothing more to say may still listen.
    fn discard_input(&mut self) -> Result<(), String> {
        const AT_ONCE: usize = 8;
        let mut buffer = [0; 512];
        for _ in 0..AT_ONCE {
            match self.stream.read(&mut buffer) {
                Ok(0) => break,
                Ok(_) => {}
                Err(error) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::Interrupted) => break,
                Err(error) => return Err(error.to_string()),
            }
        }
        Ok(())
    }
}

#[cfg(test)]
#[path = "tcp_tests.rs"]
mod tests;
