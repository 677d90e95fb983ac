//! Sentences as datagrams: those of one estimate together, so that none comes in front of another.

use std::{io::ErrorKind, net::UdpSocket};

use super::{
    TimedEstimate,
    nmea::{MAX_SENTENCE_BYTES, NmeaWriter, Sentence},
    settings::UdpSettings,
    worker::{Counters, Link, LinkError, count},
};

pub(super) struct Datagrams {
    socket: UdpSocket,
    settings: UdpSettings,
    writer: NmeaWriter,
    datagram: Vec<u8>,
}

impl Datagrams {
    pub fn open(settings: &UdpSettings, writer: NmeaWriter) -> Result<Self, LinkError> {
        let prepare = || {
            // Not connected: that nobody listens at the target is then no error.
            let socket = UdpSocket::bind(settings.local())?;
            socket.set_nonblocking(true)?;
            if settings.target.0.is_ipv4() {
                socket.set_broadcast(true)?;
            }
            Ok(socket)
        };
        let socket = prepare().map_err(|error: std::io::Error| LinkError::Failed(error.to_string()))?;
        let datagram = Vec::with_capacity(Sentence::ALL.len() * MAX_SENTENCE_BYTES);
        Ok(Self { socket, settings: settings.clone(), writer, datagram })
    }
}

impl Link for Datagrams {
    fn deliver(&mut self, timed: &TimedEstimate, counters: &Counters) -> Result<(), LinkError> {
        self.datagram.clear();
        self.writer.write(timed, &mut self.datagram);
        if self.datagram.is_empty() {
            return Ok(());
        }
        match self.socket.send_to(&self.datagram, self.settings.target.0) {
            Ok(_) => Ok(()),
            // The network is slower than the camera.
            Err(error) if error.kind() == ErrorKind::WouldBlock => {
                count(&counters.skipped, 1);
                Ok(())
            }
            Err(error) => Err(LinkError::Failed(format!("cannot send: {error}"))),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        outputs::{Address, test_estimates::localized},
        types::Geodetic,
    };

    #[test]
    fn the_sentences_of_an_estimate_are_one_datagram() {
        let receiver = UdpSocket::bind("127.0.0.1:0").expect("binds");
        receiver.set_read_timeout(Some(std::time::Duration::from_secs(10))).expect("sets");
        let target = Address(receiver.local_addr().expect("bound"));
        let settings = UdpSettings { target, sentences: Sentence::ALL.to_vec(), max_rate_hz: None };
        let origin = Geodetic { latitude_deg: 47.0, longitude_deg: 8.0, altitude_m: 400.0 };
        let writer = NmeaWriter::new(origin, &settings.sentences);
        let mut timed = localized([1.0, 2.0]);
        timed.utc_ns = Some(1_795_348_800_200_000_000);
        let mut expected = Vec::new();
        writer.write(&timed, &mut expected);

        let mut datagrams = Datagrams::open(&settings, writer).expect("opens");
        datagrams.deliver(&timed, &Counters::default()).expect("sends");
        let mut received = [0; 1500];
        let length = receiver.recv(&mut received).expect("arrives");
        assert_eq!(received[..length], expected);
        assert_eq!(expected.iter().filter(|&&byte| byte == b'\n').count(), 5);

        // Nobody listens any more: not our fault, and not noticed.
        drop(receiver);
        for _ in 0..3 {
            datagrams.deliver(&timed, &Counters::default()).expect("sends");
        }
    }
}
