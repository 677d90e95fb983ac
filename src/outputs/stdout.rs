//! JSON lines on stdout, or whatever can be written to.
//!
//! A reader that is slow or hangs holds up this output's thread and nothing else. One that has gone ends the output.

use std::{
    fs::File,
    io::{self, ErrorKind, Write},
};

use super::{
    TimedEstimate,
    json_lines::{MAX_LINE_BYTES, write_line},
    unsent::Unsent,
    worker::{Counters, Link, LinkError, count},
};
use crate::types::{Geodetic, LocalFrame};

/// For a stdout that does not wait: what we hold for it.
const UNSENT_BYTES: usize = 32 * MAX_LINE_BYTES;

pub(super) struct JsonLines<W> {
    out: W,
    map_frame: Option<LocalFrame>,
    line: Vec<u8>,
    unsent: Unsent,
}

impl JsonLines<File> {
    /// A descriptor of its own: while it waits, nobody else who writes to stdout does.
    pub fn on_stdout(origin: Option<Geodetic>) -> Result<Self, LinkError> {
        let descriptor = rustix::io::dup(rustix::stdio::stdout());
        let descriptor = descriptor.map_err(|error| LinkError::Failed(format!("cannot be opened: {error}")))?;
        Ok(Self::new(File::from(descriptor), origin))
    }
}

impl<W: Write> JsonLines<W> {
    pub fn new(out: W, origin: Option<Geodetic>) -> Self {
        let map_frame = origin.map(LocalFrame::new);
        let line = Vec::with_capacity(MAX_LINE_BYTES);
        Self { out, map_frame, line, unsent: Unsent::new(UNSENT_BYTES) }
    }

    fn send(&mut self) -> Result<(), LinkError> {
        let sent = self.unsent.send(&mut self.out);
        sent.map(drop).map_err(|error: io::Error| match error.kind() {
            ErrorKind::BrokenPipe => LinkError::Ended("nobody reads it any more".into()),
            _ => LinkError::Failed(error.to_string()),
        })
    }
}

impl<W: Write> Link for JsonLines<W> {
    fn deliver(&mut self, timed: &TimedEstimate, counters: &Counters) -> Result<(), LinkError> {
        self.line.clear();
        write_line(timed, self.map_frame.as_ref(), &mut self.line);
        count(&counters.skipped, self.unsent.push(&self.line) as u64);
        self.send()
    }

    fn look_after(&mut self, _counters: &Counters) -> Result<(), LinkError> {
        self.send()
    }
}

#[cfg(test)]
mod tests {
    use std::{
        io::{BufRead, BufReader},
        thread,
    };

    use super::*;
    use crate::outputs::{inbox::Inbox, rate::RateLimit, test_estimates::unknown, worker};

    fn numbered(sequence: u32) -> TimedEstimate {
        let mut timed = unknown();
        timed.estimate.sequence = sequence;
        timed
    }

    /// The frame's number of a whole line.
    fn number(line: &str) -> u32 {
        let object: serde_json::Value = serde_json::from_str(line).expect("a whole line");
        object["sequence"].as_u64().and_then(|number| number.try_into().ok()).expect("a number")
    }

    #[test]
    fn a_reader_that_hangs_holds_up_nobody_and_then_gets_whole_lines() {
        const FRAMES: u32 = 10_000;
        let (reader, writer) = io::pipe().expect("a pipe");
        let (inbox, counters) = (Inbox::new(RateLimit::new(None)), Counters::default());
        let mut link = Some(JsonLines::new(writer, None));
        thread::scope(|scope| {
            let open = || link.take().ok_or_else(|| LinkError::Failed("twice".into()));
            scope.spawn(|| worker::run("test".into(), open, &inbox, &counters));
            (0..FRAMES).for_each(|sequence| inbox.push(&numbered(sequence)));
            inbox.close();
            let numbers: Vec<u32> = BufReader::new(reader).lines().map(|line| number(&line.expect("read"))).collect();
            assert!(numbers.is_sorted() && numbers.last() == Some(&(FRAMES - 1)), "{:?}", numbers.last());
            // A pipe holds 64 KiB.
            assert!(inbox.dropped() > u64::from(FRAMES / 2), "{}", inbox.dropped());
            assert_eq!(numbers.len() as u64 + inbox.dropped(), u64::from(FRAMES));
        });
    }

    #[test]
    fn a_reader_that_has_gone_ends_it() {
        let (reader, writer) = io::pipe().expect("a pipe");
        let mut lines = JsonLines::new(writer, None);
        let counters = Counters::default();
        lines.deliver(&unknown(), &counters).expect("is read");
        drop(reader);
        let error = lines.deliver(&unknown(), &counters).expect_err("is not read");
        assert!(matches!(error, LinkError::Ended(_)), "{error}");
    }

    #[test]
    fn a_stdout_that_does_not_wait_gets_whole_lines() {
        let (reader, writer) = io::pipe().expect("a pipe");
        rustix::io::ioctl_fionbio(&writer, true).expect("sets");
        rustix::io::ioctl_fionbio(&reader, true).expect("sets");
        let mut lines = JsonLines::new(writer, None);
        let counters = Counters::default();
        for sequence in 0..10_000 {
            lines.deliver(&numbered(sequence), &counters).expect("takes or not");
        }
        let mut text = Vec::new();
        let mut buffer = [0; 4096];
        while let Ok(count) = rustix::io::read(&reader, &mut buffer) {
            text.extend(&buffer[..count]);
            lines.look_after(&counters).expect("takes");
        }
        let text = String::from_utf8(text).expect("ASCII");
        let numbers: Vec<u32> = text.lines().map(number).collect();
        assert!(numbers.is_sorted() && numbers.len() < 10_000 && text.ends_with('\n'));
        assert_eq!(numbers.last(), Some(&9_999), "the newest is there");
    }
}
