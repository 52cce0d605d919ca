//! Progress of a transfer: a bar on a terminal, a line per tenth elsewhere. Its retries after line
//! failures.

use std::fmt;
use std::path::Path;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use fatek::file::PlcDifference;
use fatek::progress::{Phase, Progress};
use indicatif::{ProgressBar, ProgressDrawTarget};

use crate::output::{Output, complain};
use crate::printable::excerpt;
use crate::progress::{Display, style};

/// Shows the progress of one transfer on stderr, unless `--quiet` was given.
#[derive(Debug)]
pub(crate) struct Reporter<'o> {
    output: &'o Output,
    display: Arc<Mutex<TransferDisplay>>,
}

impl<'o> Reporter<'o> {
    pub(crate) fn new(output: &'o Output) -> Self {
        let display = TransferDisplay { display: Display::new(output), shown: None, bar: None };
        Self { output, display: Arc::new(Mutex::new(display)) }
    }

    /// Callback for each step of a transfer.
    pub(crate) fn callback(&self) -> impl FnMut(&Progress) + Send + use<> {
        let display = self.display.clone();
        move |progress| lock(&display).show(progress)
    }

    /// Waits for a transfer. The bar stays, and the next output begins on a new line.
    pub(crate) async fn until_end<T>(&self, transfer: impl Future<Output = T>) -> T {
        let ended = transfer.await;
        lock(&self.display).end_line();
        ended
    }

    /// Prints a message below the bar, unless `--quiet` was given.
    pub(crate) fn remark(&self, text: fmt::Arguments<'_>) {
        lock(&self.display).end_line();
        self.output.remark(text);
    }
}

fn lock(display: &Mutex<TransferDisplay>) -> MutexGuard<'_, TransferDisplay> {
    display.lock().unwrap_or_else(PoisonError::into_inner)
}

/// The consequence for a PLC that runs, for a prompt. `run`: it is started again.
pub(crate) fn stops(run: bool) -> &'static str {
    if run {
        " The PLC is stopped first and started again afterwards."
    } else {
        " The PLC is stopped first and stays stopped."
    }
}

/// The consequence for a PLC that runs, for a dry run.
pub(crate) fn would_stop(run: bool) -> &'static str {
    if run { "; the PLC runs, and would be stopped and started again" } else { "; the PLC runs, and would be stopped" }
}

/// The name of a file on one line, shortened if it is very long.
pub(crate) fn shown(file: &Path) -> String {
    excerpt(&file.to_string_lossy()).to_string()
}

/// Differences between the PLC of a file and the PLC of the command, for a sentence.
pub(crate) fn listed(differences: &[PlcDifference]) -> String {
    differences.iter().map(ToString::to_string).collect::<Vec<_>>().join(", ")
}

/// A warning that a file is of another PLC, if there are differences.
pub(crate) fn warn_of_other_plc(file: &Path, differences: &[PlcDifference]) {
    if !differences.is_empty() {
        complain(format_args!("warning: {} is of another PLC: {}", shown(file), listed(differences)));
    }
}

/// The same for a prompt.
pub(crate) fn other_plc(differences: &[PlcDifference]) -> String {
    if differences.is_empty() { String::new() } else { format!(" It is of ANOTHER PLC: {}.", listed(differences)) }
}

/// A file of a newer version may have fields that are ignored here.
pub(crate) fn warn_of_unknown_fields(file: &Path, fields: &[String]) {
    if !fields.is_empty() {
        let (file, fields) = (shown(file), fields.join(", "));
        let fields = excerpt(&fields);
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
