//! Diagnostics on stderr: for people on a terminal, with a status line below them; for the journal elsewhere.
//!
//! systemd reads the priority in front of a line (`<4>`) and adds the time itself.

use std::{
    fmt,
    io::{self, IsTerminal, Write},
    sync::{Mutex, MutexGuard, PoisonError},
};

use tracing::{Event, Level, Subscriber};
use tracing_subscriber::{
    EnvFilter,
    fmt::{FmtContext, FormatEvent, FormatFields, MakeWriter, format::Writer},
    registry::LookupSpan,
};

/// What stands in the last line of the terminal.
static STATUS_LINE: Mutex<String> = Mutex::new(String::new());
/// Carriage return, and clear to the end of the line.
const CLEAR_LINE: &str = "\r\x1b[K";

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

/// Replaces the status line. Elsewhere than on a terminal there is none.
pub fn show_status(text: &str) {
    if io::stderr().is_terminal() {
        let mut line = lock();
        *line = text.to_owned();
        let _ = write!(io::stderr().lock(), "{CLEAR_LINE}{line}");
    }
}

/// Takes the status line away.
pub fn clear_status() {
    show_status("");
}

fn lock() -> MutexGuard<'static, String> {
    STATUS_LINE.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Stderr that keeps the status line at the bottom.
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
        let line = lock();
        let mut stderr = io::stderr().lock();
        if line.is_empty() {
            stderr.write_all(text)?;
        } else {
            stderr.write_all(CLEAR_LINE.as_bytes())?;
            stderr.write_all(text)?;
            stderr.write_all(line.as_bytes())?;
        }
        Ok(text.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        io::stderr().flush()
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
