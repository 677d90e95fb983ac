//! Diagnostics on stderr: for people on a terminal, with a status line below them; for the journal elsewhere.
//!
//! systemd reads the priority in front of a line (`<4>`) and adds the time itself.

use std::{
    fmt,
    io::{self, IsTerminal, Write},
    sync::{
        OnceLock,
        mpsc::{self, Receiver, SyncSender},
    },
    thread,
    time::Duration,
};

use tracing::{Event, Level, Subscriber};
use tracing_subscriber::{
    EnvFilter,
    fmt::{FmtContext, FormatEvent, FormatFields, MakeWriter, format::Writer},
    registry::LookupSpan,
};

/// Lines on their way to stderr. When nobody reads them, as behind a stalled connection, lines are left out: a recording
/// never waits for its diagnostics, nor does it end because nobody wants them.
const QUEUED_LINES: usize = 256;
/// At the end, what is queued has this long to be written.
const LAST_LINES: Duration = Duration::from_millis(300);
/// Carriage return, and clear to the end of the line.
const CLEAR_LINE: &str = "\r\x1b[K";

static STDERR: OnceLock<SyncSender<Line>> = OnceLock::new();

enum Line {
    Text(Vec<u8>),
    /// What stands in the last line of the terminal from now on.
    Status(String),
    Flush(SyncSender<()>),
}

/// Sends a line to the thread that writes; there is one from the first line on.
fn send(line: Line) {
    let sender = STDERR.get_or_init(|| {
        let (sender, lines) = mpsc::sync_channel(QUEUED_LINES);
        // Without the thread nothing is written, and nothing else happens.
        let _ = thread::Builder::new().name("journal".into()).spawn(move || write_lines(&lines));
        sender
    });
    let _ = sender.try_send(line);
}

/// Whatever happens to stderr is ignored: there is nobody left to tell.
fn write_lines(lines: &Receiver<Line>) {
    let mut status = String::new();
    for line in lines {
        let mut stderr = io::stderr().lock();
        let _ = match line {
            Line::Text(text) if status.is_empty() => stderr.write_all(&text),
            Line::Text(text) => stderr.write_all(&[CLEAR_LINE.as_bytes(), text.as_slice(), status.as_bytes()].concat()),
            Line::Status(text) => {
                status = text;
                write!(stderr, "{CLEAR_LINE}{status}")
            }
            Line::Flush(done) => {
                let _ = done.try_send(());
                stderr.flush()
            }
        };
    }
}

/// Starts diagnostics: `info` and above, or what `RUST_LOG` asks for.
pub fn start() {
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new("info"));
    let builder = tracing_subscriber::fmt().with_env_filter(filter).with_writer(Stderr);
    // A second start, as in tests that run several commands, keeps the first.
    let _ = if io::stderr().is_terminal() {
        builder.compact().with_target(false).try_init()
    } else {
        builder.with_ansi(false).event_format(Journal).try_init()
    };
}

/// Replaces the status line, and hands it back. Elsewhere than on a terminal there is none.
pub fn show_status(text: String) -> String {
    if io::stderr().is_terminal() {
        send(Line::Status(text.clone()));
    }
    text
}

/// Takes the status line away and waits a moment for what is queued.
pub fn finish() {
    show_status(String::new());
    let (done, written) = mpsc::sync_channel(1);
    send(Line::Flush(done));
    let _ = written.recv_timeout(LAST_LINES);
}

/// Stderr with the status line at the bottom.
struct Stderr;

impl<'a> MakeWriter<'a> for Stderr {
    type Writer = Self;

    fn make_writer(&'a self) -> Self {
        Self
    }
}

impl Write for Stderr {
    /// `text` is whole lines: the subscriber writes one event at a time.
    fn write(&mut self, text: &[u8]) -> io::Result<usize> {
        send(Line::Text(text.to_owned()));
        Ok(text.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// `<priority>message field=value`.
struct Journal;

impl<S, N> FormatEvent<S, N> for Journal
where
    S: Subscriber + for<'a> LookupSpan<'a>,
    N: for<'a> FormatFields<'a> + 'static,
{
    fn format_event(&self, context: &FmtContext<'_, S, N>, mut out: Writer<'_>, event: &Event<'_>) -> fmt::Result {
        if std::env::var_os("JOURNAL_STREAM").is_some() {
            write!(out, "<{}>", priority(*event.metadata().level()))?;
        } else {
            write!(out, "{:5} ", event.metadata().level())?;
        }
        context.format_fields(out.by_ref(), event)?;
        writeln!(out)
    }
}

/// Of syslog (RFC 5424, table 2): error 3, warning 4, informational 6, debug 7.
fn priority(level: Level) -> u8 {
    match level {
        Level::ERROR => 3,
        Level::WARN => 4,
        Level::INFO => 6,
        Level::DEBUG | Level::TRACE => 7,
    }
}
