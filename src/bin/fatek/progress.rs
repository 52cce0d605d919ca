//! Progress of long commands on stderr: one line that is redrawn on a terminal, a line per event
//! elsewhere.

use std::fmt;

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};

use crate::output::{Output, complain};

/// Template of the status line. The cursor goes back two columns: the `^C` that a terminal prints there
/// must not begin a new line, which would leave the status behind.
const STATUS_TEMPLATE: &str = "{wide_msg}  \u{1b}[2D";

/// Kind of display, by `--quiet` and by the terminal.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Display {
    Terminal,
    Lines,
    Quiet,
}

impl Display {
    pub(crate) fn new(output: &Output) -> Self {
        match output.quiet {
            true => Self::Quiet,
            // Also for a terminal that cannot move the cursor.
            false if ProgressDrawTarget::stderr().is_hidden() => Self::Lines,
            false => Self::Terminal,
        }
    }
}

/// Status of a command without a known amount of work, cleared at its end.
#[derive(Debug)]
pub(crate) struct StatusLine {
    display: Display,
    line: ProgressBar,
}

impl StatusLine {
    pub(crate) fn new(output: &Output) -> Self {
        let display = Display::new(output);
        let line = match display {
            Display::Terminal => ProgressBar::with_draw_target(None, ProgressDrawTarget::stderr()),
            Display::Lines | Display::Quiet => ProgressBar::hidden(),
        };
        Self { display, line: line.with_style(style(STATUS_TEMPLATE)) }
    }

    /// Shows the current status, on a terminal only.
    pub(crate) fn show(&self, text: fmt::Arguments<'_>) {
        if self.display == Display::Terminal {
            self.line.set_message(text.to_string());
        }
    }

    /// Reports an event, unless there is a terminal.
    pub(crate) fn event(&self, text: fmt::Arguments<'_>) {
        if self.display == Display::Lines {
            complain(text);
        }
    }
}

impl Drop for StatusLine {
    fn drop(&mut self) {
        self.line.finish_and_clear();
    }
}

/// Style of this template; the default style if it has an error.
pub(crate) fn style(template: &str) -> ProgressStyle {
    let style = ProgressStyle::with_template(template);
    debug_assert!(style.is_ok(), "bad template {template}");
    style.unwrap_or_else(|_| ProgressStyle::default_bar()).progress_chars("#>-")
}
