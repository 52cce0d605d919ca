//! Progress of a transfer: a bar on a terminal, a line per tenth elsewhere. Its retries after line
//! failures.

use std::path::Path;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use fatek::progress::{Phase, Progress};
use indicatif::{ProgressBar, ProgressDrawTarget};

use crate::output::{Output, complain};
use crate::progress::{Display, style};

/// Shows the progress of one transfer on stderr, unless `--quiet` was given.
#[derive(Clone, Debug)]
pub(crate) struct Reporter(Arc<Mutex<TransferDisplay>>);

impl Reporter {
    pub(crate) fn new(output: &Output) -> Self {
        let display = TransferDisplay { display: Display::new(output), shown: None, bar: None };
        Self(Arc::new(Mutex::new(display)))
    }

    /// Callback for each step of a transfer.
    pub(crate) fn callback(&self) -> impl FnMut(&Progress) + Send + 'static {
        let this = self.clone();
        move |progress| this.lock().show(progress)
    }

    /// Leaves the bar as it is. The next output begins on a new line.
    pub(crate) fn end_line(&self) {
        self.lock().end_line();
    }

    fn lock(&self) -> MutexGuard<'_, TransferDisplay> {
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
struct TransferDisplay {
    display: Display,
    /// Phase and tenth shown last.
    shown: Option<(Phase, usize)>,
    /// Bar of the current phase.
    bar: Option<ProgressBar>,
}

impl TransferDisplay {
    fn show(&mut self, progress: &Progress) {
        match self.display {
            Display::Quiet => {}
            Display::Terminal => self.show_bar(progress),
            Display::Lines if self.shown != Some(tenths(progress)) => complain(format_args!("{progress}")),
            Display::Lines => {}
        }
        self.shown = Some(tenths(progress));
    }

    fn show_bar(&mut self, progress: &Progress) {
        if self.shown.is_some_and(|(phase, _)| phase != progress.phase) {
            self.end_line();
        }
        let (done, total) = (progress.done.min(progress.total) as u64, progress.total as u64);
        match &self.bar {
            Some(bar) => {
                bar.set_message(progress.to_string());
                bar.set_length(total);
                bar.set_position(done);
            }
            None => {
                let bar = ProgressBar::with_draw_target(Some(total), ProgressDrawTarget::stderr())
                    .with_style(style("[{bar:20}] {wide_msg}"))
                    .with_message(progress.to_string())
                    .with_position(done);
                bar.tick();
                self.bar = Some(bar);
            }
        }
    }

    fn end_line(&mut self) {
        if let Some(bar) = self.bar.take() {
            bar.abandon();
            complain(format_args!(""));
        }
    }
}

fn tenths(progress: &Progress) -> (Phase, usize) {
    let tenths = (progress.done.min(progress.total) * 10).checked_div(progress.total).unwrap_or(10);
    (progress.phase, tenths)
}
