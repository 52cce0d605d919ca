use std::fmt;
use std::time::SystemTime;

use tokio::time::Instant;

use super::reading::{Reading, Step};
use super::{PAGE_BYTES, Program, ProgramAction, ProgramError};
use crate::command::{Command, ReadProgramPage};
use crate::error::Error;
use crate::progress::{Meter, Progress};
use crate::station::{BegunWith, OtherStation, Station};

/// What is told of the progress of a transfer.
pub(super) type OnProgress = Box<dyn FnMut(&Progress) + Send>;

/// The reading of a program that can be interrupted: [`run`](Self::run) goes on where the last run ended.
///
/// The [module's documentation](super#reading) has an example. It keeps the pages that have been read when a run fails or is
/// dropped, and goes on with the same station alone, by number and endpoint.
#[derive(Default)]
#[must_use]
pub struct ReadProgram {
    reading: Reading,
    begun_with: BegunWith,
    on_progress: Option<OnProgress>,
}

impl ReadProgram {
    /// Nothing has been read yet.
    pub fn new() -> Self {
        Self::default()
    }

    /// Reads all pages a second time and compares them: a change of any page in the meantime is [`ProgramError::Changed`].
    pub fn twice(mut self) -> Self {
        self.reading.twice = true;
        self
    }

    /// Called after each page. It must not take long: the PLC waits meanwhile.
    pub fn on_progress(mut self, tell: impl FnMut(&Progress) + Send + 'static) -> Self {
        self.on_progress = Some(Box::new(tell));
        self
    }

    /// How many pages have been read and are kept.
    #[must_use]
    pub fn pages_done(&self) -> usize {
        self.reading.pages_done()
    }

    /// Reads what is missing, and gives the program.
    ///
    /// Each request is a read of its own, with the timeouts and retries of the station's
    /// [options](Station::options); [`CallOptions::background`](crate::CallOptions::background) lets all others of the link go
    /// first. The future can be dropped at any time.
    ///
    /// # Errors
    /// - [`ProgramError::Call`] when a request fails: run it again to go on;
    /// - [`ProgramError::OtherStation`] when pages have been read from another one; nothing is sent;
    /// - [`ProgramError::Invalid`] when page 0 is no header, or one for another size than 53 says;
    /// - [`ProgramError::Changed`] when the program was changed meanwhile. Nothing is kept then.
    pub async fn run(&mut self, station: &Station) -> Result<Program, ProgramError> {
        let failed = |action| move |source| ProgramError::Call { action, source };
        in_framing(station).map_err(failed(ProgramAction::ReadPage(0)))?;
        let same = self.begun_with.go_on(station, self.pages_done() > 0);
        same.map_err(|OtherStation { begun, station }| ProgramError::OtherStation { begun, station })?;
        self.reading.begin();
        let mut meter: Option<Meter> = None;
        loop {
            let step = self.reading.next();
            match step {
                Step::Brief => {
                    let brief = station.read_status().await;
                    self.reading.brief(brief.map_err(failed(ProgramAction::ReadStatus))?);
                }
                Step::Status => {
                    let status = station.read_detailed_status().await;
                    self.reading.status(status.map_err(failed(ProgramAction::ReadStatus))?)?;
                }
                Step::Page(page) => {
                    let began = Instant::now();
                    let content = station.read_program_page(page).await;
                    self.reading.page(content.map_err(failed(ProgramAction::ReadPage(page)))?)?;
                    if let Some(tell) = &mut self.on_progress {
                        report(&mut meter, self.reading.progress(), PAGE_BYTES, began, tell);
                    }
                }
                Step::Done => return self.reading.finish(SystemTime::now()),
            }
        }
    }
}

impl fmt::Debug for ReadProgram {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("ReadProgram").field("pages_done", &self.pages_done()).finish_non_exhaustive()
    }
}

/// That there are programs in the framing of the link: nothing is sent otherwise.
pub(super) fn in_framing(station: &Station) -> Result<(), Error> {
    Ok(ReadProgramPage::new(0).check(station.link().framing())?)
}

/// Tells how far it has come, by a step that has moved so many bytes.
pub(super) fn report(
    meter: &mut Option<Meter>,
    (phase, done, total): (crate::progress::Phase, usize, usize),
    bytes: usize,
    began: Instant,
    tell: &mut OnProgress,
) {
    // The step that begins a phase belongs to it, and so does its time.
    let meter = match meter {
        Some(known) if known.phase() == phase => known,
        other => other.insert(Meter::new(phase, total, done.saturating_sub(1), began)),
    };
    meter.advance(done, total, bytes);
    tell(&meter.progress(Instant::now()));
}
