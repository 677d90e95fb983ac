use std::{fs::File, io::Read, os::fd::OwnedFd, path::PathBuf};

use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};

use super::*;
use crate::{outputs::test_estimates::localized, types::Geodetic};

const ORIGIN: Geodetic = Geodetic { latitude_deg: 47.0, longitude_deg: 8.0, altitude_m: 400.0 };

/// A pseudo-terminal: what listens, and the port that is written to.
fn listener() -> (File, PathBuf) {
    let master: OwnedFd = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY).expect("opens");
    grantpt(&master).and_then(|()| unlockpt(&master)).expect("is ours");
    rustix::io::ioctl_fionbio(&master, true).expect("sets");
    let port = ptsname(&master, Vec::new()).expect("has a name").into_string().expect("ASCII");
    (master.into(), port.into())
}

fn open(port: PathBuf) -> Result<Line, LinkError> {
    let settings = SerialSettings { port, baud: 38_400, sentences: Sentence::ALL.to_vec(), max_rate_hz: 1.0 };
    Line::open(&settings, NmeaWriter::new(ORIGIN, &settings.sentences))
}

/// At a second each, UTC known.
fn frame(number: u64) -> TimedEstimate {
    let mut timed = localized([number as f64, 0.0]);
    timed.estimate.stamp_ns = number * NS_PER_S;
    timed.utc_ns = Some(1_795_348_800_000_000_000 + (number * NS_PER_S) as i64);
    timed
}

#[test]
fn sentences_arrive_as_they_are() {
    let (mut listener, port) = listener();
    let mut line = open(port).expect("opens");
    let counters = Counters::default();
    for number in 0..20 {
        line.deliver(&frame(number), &counters).expect("takes");
        let mut expected = Vec::new();
        line.writer.write(&frame(number), &mut expected);
        let mut received: Vec<u8> = Vec::new();
        while received.len() < expected.len() {
            let mut buffer = [0; 512];
            if let Ok(count) = listener.read(&mut buffer) {
                received.extend(&buffer[..count]);
            }
        }
        assert_eq!(received, expected);
    }
}

#[test]
fn a_line_that_takes_nothing_is_a_failure_after_a_while() {
    let (_listener, port) = listener();
    let mut line = open(port).expect("opens");
    let counters = Counters::default();
    // The kernel holds some kilobytes; what comes after is waited for on the frames' clock.
    let error = (0..1000).find_map(|number| line.deliver(&frame(number), &counters).err());
    let error = error.expect("takes no thousand").to_string();
    assert!(error.ends_with("has taken nothing for 11 s"), "{error}");
}

#[test]
fn an_unplugged_line_is_a_failure_and_can_be_opened_when_it_is_back() {
    let (plugged, port) = listener();
    let mut line = open(port.clone()).expect("opens");
    let counters = Counters::default();
    line.deliver(&frame(0), &counters).expect("takes");
    drop(plugged);
    let error = line.deliver(&frame(1), &counters).expect_err("has gone").to_string();
    assert!(error.contains("was unplugged"), "{error}");
    drop(line);
    let error = open(port).err().expect("is not there").to_string();
    assert!(error.contains("is not there"), "{error}");
}
