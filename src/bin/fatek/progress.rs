//! How far a long command has come, on stderr: one line that is written over on a terminal, else a line for each event.

use std::fmt;
use std::io::{self, IsTerminal, Write};

use crate::output::{Output, complain};

#[derive(Debug)]
pub(crate) struct Progress {
    mode: Mode,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Mode {
    /// One line, which goes when all is done.
    Line,
    /// Only what has happened.
    Events,
    Quiet,
}

impl Progress {
    pub(crate) fn new(output: &Output) -> Self {
        let mode = match output.quiet {
            true => Mode::Quiet,
            false if io::stderr().is_terminal() => Mode::Line,
            false => Mode::Events,
        };
        Self { mode }
    }

    /// Says where it stands.
    pub(crate) fn stand(&self, text: fmt::Arguments<'_>) {
        if self.mode == Mode::Line {
            let mut stderr = io::stderr().lock();
            let _ = write!(stderr, "\r{CLEAR}{text}").and_then(|()| stderr.flush());
        }
    }

    /// Says that something has happened.
    pub(crate) fn event(&self, text: fmt::Arguments<'_>) {
        if self.mode == Mode::Events {
            complain(text);
        }
    }
}

impl Drop for Progress {
    fn drop(&mut self) {
        if self.mode == Mode::Line {
            let _ = write!(io::stderr().lock(), "\r{CLEAR}");
        }
    }
}

/// Clears the line from the cursor on.
const CLEAR: &str = "\x1b[K";
