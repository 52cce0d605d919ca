//! The log on stderr: a line for each event.
//!
//! In the journal of systemd a line begins with its priority, and has no time: the journal adds that.

use std::io::{self, Write};

use tracing::{Level, Metadata};
use tracing_subscriber::EnvFilter;
use tracing_subscriber::fmt::MakeWriter;

use super::args::{LogArgs, LogFormat};
use crate::printable::printable;

/// Starts the log.
///
/// # Errors
/// The rule that the filter breaks.
pub(super) fn start(args: &LogArgs) -> Result<(), String> {
    let filter = EnvFilter::try_new(&args.log_filter).map_err(|error| error.to_string())?;
    let is_journal = is_journal();
    let builder = tracing_subscriber::fmt().with_env_filter(filter).with_ansi(false);
    match (args.log_format, is_journal) {
        (LogFormat::Text, true) => builder.without_time().with_level(false).with_writer(Stderr { is_journal }).init(),
        (LogFormat::Text, false) => builder.with_writer(Stderr { is_journal }).init(),
        (LogFormat::Json, _) => builder.json().flatten_event(true).with_writer(io::stderr).init(),
    }
    Ok(())
}

/// Returns whether stderr is the stream that systemd has connected with its journal.
fn is_journal() -> bool {
    let Ok(stream) = std::env::var("JOURNAL_STREAM") else { return false };
    let Ok(stderr) = rustix::fs::fstat(io::stderr()) else { return false };
    stream == format!("{}:{}", stderr.st_dev, stderr.st_ino)
}

/// Makes writers of lines on stderr.
#[derive(Debug)]
struct Stderr {
    is_journal: bool,
}

/// Writes one event as one line: control characters are escaped, so that no text makes a line of its own.
struct Line {
    prefix: &'static str,
}

impl<'w> MakeWriter<'w> for Stderr {
    type Writer = Line;

    fn make_writer(&'w self) -> Line {
        Line { prefix: "" }
    }

    fn make_writer_for(&'w self, event: &Metadata<'_>) -> Line {
        Line { prefix: if self.is_journal { priority(event.level()) } else { "" } }
    }
}

/// The priority of syslog, as sd-daemon(3) writes it.
fn priority(level: &Level) -> &'static str {
    match *level {
        Level::ERROR => "<3>",
        Level::WARN => "<4>",
        Level::INFO => "<6>",
        _ => "<7>",
    }
}

impl Write for Line {
    fn write(&mut self, event: &[u8]) -> io::Result<usize> {
        let line = line(self.prefix, &String::from_utf8_lossy(event));
        io::stderr().lock().write_all(line.as_bytes()).map(|()| event.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        io::stderr().lock().flush()
    }
}

fn line(prefix: &str, event: &str) -> String {
    format!("{prefix}{}\n", printable(event.trim_end_matches('\n')))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_event_is_one_line_without_control_characters() {
        assert_eq!(line("", "WARN a\n"), "WARN a\n");
        assert_eq!(line("<4>", "a\nERROR b\u{1b}[2J\n"), "<4>a\\nERROR b\\u{1b}[2J\n");
        assert_eq!(priority(&Level::TRACE), "<7>");
    }
}
