use std::{
    io::{BufRead, BufReader, Read},
    net::Shutdown,
    sync::atomic::Ordering,
    time::Duration,
};

use super::*;
use crate::{
    outputs::{Address, test_estimates::localized},
    types::Geodetic,
};

const ORIGIN: Geodetic = Geodetic { latitude_deg: 47.0, longitude_deg: 8.0, altitude_m: 400.0 };
const START_UTC_NS: i64 = 1_795_348_800_000_000_000;
const FRAME_NS: u64 = NS_PER_S / 10;

fn server(max_clients: usize) -> (Server, SocketAddr) {
    // Port 0, which a configuration may not say, is one that is free.
    let listen = Address(([127, 0, 0, 1], 0).into());
    let settings = TcpSettings { listen, max_clients, sentences: Sentence::ALL.to_vec(), max_rate_hz: None };
    let writer = NmeaWriter::new(ORIGIN, &settings.sentences);
    let server = Server::open(&settings, writer, &"test".into()).expect("opens");
    let address = server.listener.local_addr().expect("bound");
    (server, address)
}

/// Connects and is let in.
fn connect(server: &mut Server, address: SocketAddr, counters: &Counters) -> TcpStream {
    let before = server.clients.len();
    let stream = TcpStream::connect(address).expect("connects");
    stream.set_read_timeout(Some(Duration::from_secs(20))).expect("sets");
    while server.clients.len() == before {
        server.accept(counters);
    }
    stream
}

/// The estimate of a frame: each has its own time.
fn frame(number: u64) -> TimedEstimate {
    let mut timed = localized([number as f64 * 0.01, 0.0]);
    timed.estimate.stamp_ns = number * FRAME_NS;
    timed.utc_ns = Some(START_UTC_NS + (number * FRAME_NS) as i64);
    timed
}

fn sentences(number: u64) -> Vec<u8> {
    let mut expected = Vec::new();
    NmeaWriter::new(ORIGIN, &Sentence::ALL).write(&frame(number), &mut expected);
    expected
}

fn is_whole(line: &str) -> bool {
    let content = line.strip_prefix('$').and_then(|line| line.strip_suffix("\r\n"));
    let Some((content, sum)) = content.and_then(|content| content.split_once('*')) else { return false };
    u8::from_str_radix(sum, 16) == Ok(crate::gnss::xor(content.as_bytes()))
}

#[test]
fn who_does_not_read_holds_up_nobody_and_is_sent_away() {
    let (mut server, address) = server(8);
    let counters = Counters::default();
    let silent = connect(&mut server, address, &counters);
    let reading = connect(&mut server, address, &counters);
    let mut reader = BufReader::new(reading);
    for number in 0..10_000 {
        server.deliver(&frame(number), &counters).expect("goes on");
        // All five at once: nothing was put off for the other's sake.
        for expected in sentences(number).split_inclusive(|&byte| byte == b'\n') {
            let mut line = Vec::new();
            reader.read_until(b'\n', &mut line).expect("arrives");
            assert_eq!(line, expected, "{number}");
        }
    }
    assert_eq!(server.clients.len(), 1, "the one that hangs is gone");
    assert_eq!(counters.disconnected.load(Ordering::Relaxed), 1);
    drop(silent);
}

#[test]
fn a_slow_client_gets_whole_sentences_and_the_newest() {
    let (mut server, address) = server(8);
    let counters = Counters::default();
    let mut slow = connect(&mut server, address, &counters);
    // Its own kernel would hold megabytes for it.
    rustix::net::sockopt::set_socket_recv_buffer_size(&slow, 8 << 10).expect("sets");
    let mut text = Vec::new();
    const FRAMES: u64 = 3_000;
    for number in 0..FRAMES {
        // All at one moment, or the kernel's own pauses would count as silence.
        let mut timed = frame(number);
        timed.estimate.stamp_ns = 0;
        server.deliver(&timed, &counters).expect("goes on");
        // Less than a sentence a frame.
        let mut buffer = [0; 50];
        let count = slow.read(&mut buffer).expect("is connected");
        text.extend(&buffer[..count]);
    }
    assert_eq!(server.clients.len(), 1, "slow is not dead");
    slow.set_nonblocking(true).expect("sets");
    let mut buffer = [0; 4096];
    while !text.ends_with(&sentences(FRAMES - 1)) {
        server.look_after(&counters).expect("goes on");
        if let Ok(count) = slow.read(&mut buffer) {
            text.extend(&buffer[..count]);
        }
    }
    let text = String::from_utf8(text).expect("ASCII");
    let lines: Vec<&str> = text.split_inclusive('\n').collect();
    assert!(lines.iter().all(|line| is_whole(line)), "none is torn");
    let skipped = counters.skipped.load(Ordering::Relaxed);
    assert_eq!(lines.len() as u64 + skipped, FRAMES * Sentence::ALL.len() as u64);
    assert!(skipped > FRAMES, "{skipped}");
}

#[test]
fn one_too_many_is_refused_and_let_in_when_there_is_room() {
    let (mut server, address) = server(1);
    let counters = Counters::default();
    let first = connect(&mut server, address, &counters);
    let mut refused = TcpStream::connect(address).expect("connects");
    while counters.disconnected.load(Ordering::Relaxed) == 0 {
        server.look_after(&counters).expect("goes on");
    }
    assert!(matches!(refused.read(&mut [0; 10]), Ok(0) | Err(_)), "is told at once");
    drop(first);
    let mut number = 0;
    while !server.clients.is_empty() {
        server.deliver(&frame(number), &counters).expect("goes on");
        number += 1;
    }
    connect(&mut server, address, &counters);
}

#[test]
fn who_has_nothing_more_to_say_may_listen_and_what_is_said_is_ignored() {
    let (mut server, address) = server(1);
    let counters = Counters::default();
    let mut client = connect(&mut server, address, &counters);
    std::io::Write::write_all(&mut client, &[b'x'; 10_000]).expect("is taken");
    client.shutdown(Shutdown::Write).expect("half closes");
    for number in 0..100 {
        server.deliver(&frame(number), &counters).expect("goes on");
    }
    let mut received = vec![0; sentences(0).len()];
    client.read_exact(&mut received).expect("arrives");
    assert_eq!(received, sentences(0));
}

#[test]
fn a_port_that_is_in_use_is_a_failure_to_be_tried_again() {
    let (_server, address) = server(1);
    let settings =
        TcpSettings { listen: Address(address), max_clients: 1, sentences: vec![Sentence::Rmc], max_rate_hz: None };
    let writer = NmeaWriter::new(ORIGIN, &settings.sentences);
    let error = Server::open(&settings, writer, &"test".into()).err().expect("is in use");
    assert!(matches!(&error, LinkError::Failed(what) if what.contains("cannot listen")), "{error}");
}
