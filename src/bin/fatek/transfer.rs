//! How far a transfer has come: a bar on a terminal, a line now and then elsewhere.

use std::io::{self, IsTerminal, Write};
use std::path::Path;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use fatek::progress::{Phase, Progress};

use crate::output::{Output, complain};

/// Shows the progress of one transfer on stderr, unless `--quiet` was given.
#[derive(Clone, Debug)]
pub(crate) struct Reporter(Arc<Mutex<Display>>);

impl Reporter {
    pub(crate) fn new(output: &Output) -> Self {
        Self(Arc::new(Mutex::new(Display::new(output))))
    }

    /// What a transfer calls after each of its steps.
    pub(crate) fn callback(&self) -> impl FnMut(&Progress) + Send + 'static {
        let this = self.clone();
        move |progress| this.lock().show(progress)
    }

    /// What is said next begins in a line of its own.
    pub(crate) fn end_line(&self) {
        self.lock().end_line();
    }

    fn lock(&self) -> MutexGuard<'_, Display> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// A file of a newer version may have fields that are ignored here.
pub(crate) fn warn_of_unknown_fields(file: &Path, fields: &[String]) {
    if !fields.is_empty() {
        let (file, fields) = (file.display(), fields.join(", "));
        complain(format_args!("warning: {file} has a newer format version; unknown fields are ignored: {fields}"));
    }
}

#[derive(Debug)]
struct Display {
    style: Style,
    /// What was shown last: the phase, and how many tenths of it.
    shown: Option<(Phase, usize)>,
    /// Whether the cursor stands behind a bar.
    behind_bar: bool,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Style {
    Bar,
    Lines,
    Nothing,
}

/// How many characters the bar has.
const WIDTH: usize = 30;

impl Display {
    fn new(output: &Output) -> Self {
        let style = match (output.quiet, io::stderr().is_terminal()) {
            (true, _) => Style::Nothing,
            (false, true) => Style::Bar,
            (false, false) => Style::Lines,
        };
        Self { style, shown: None, behind_bar: false }
    }

    fn show(&mut self, progress: &Progress) {
        match self.style {
            Style::Nothing => {}
            Style::Bar => {
                if self.shown.is_some_and(|(phase, _)| phase != progress.phase) {
                    self.end_line();
                }
                let bar = bar(part(progress.done, progress.total, WIDTH));
                let _ = write!(io::stderr().lock(), "\r{bar} {progress}\x1B[K");
                self.behind_bar = true;
            }
            // A log has no use for every step.
            Style::Lines if self.shown != Some(tenths(progress)) => complain(format_args!("{progress}")),
            Style::Lines => {}
        }
        self.shown = Some(tenths(progress));
    }

    fn end_line(&mut self) {
        if std::mem::take(&mut self.behind_bar) {
            complain(format_args!(""));
        }
    }
}

fn tenths(progress: &Progress) -> (Phase, usize) {
    (progress.phase, part(progress.done, progress.total, 10))
}

fn bar(full: usize) -> String {
    format!("[{}{}]", "#".repeat(full), "-".repeat(WIDTH - full))
}

/// How much of `whole` is done.
fn part(done: usize, total: usize, whole: usize) -> usize {
    (done.min(total) * whole).checked_div(total).unwrap_or(whole)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_bar_is_as_full_as_what_is_done() {
        let full =
            [(0, 207), (100, 207), (206, 207), (207, 207), (9, 8), (0, 0)].map(|(done, total)| part(done, total, 30));
        assert_eq!(full, [0, 14, 29, 30, 30, 30]);
        assert_eq!(bar(14), "[##############----------------]");
    }
}
