use std::fmt;
use std::time::SystemTime;

use tokio::time::Instant;

use super::reading::{Reading, Step};
use super::{PAGE_BYTES, Program, ProgramAction, ProgramError};
use crate::command::{Command, ReadDetailedStatus, ReadProgramPage, ReadStatus};
use crate::error::Error;
use crate::progress::{Meter, Progress};
use crate::station::{BegunWith, JobReply, OtherStation, Outcome, Station, StationJob};

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

    /// How many pages have been read and confirmed. They are kept when a run fails or is dropped; up to 64 pages that were read
    /// after the last check are not.
    #[must_use]
    pub fn pages_done(&self) -> usize {
        self.reading.pages_done()
    }

    /// Reads what is missing, and gives the program.
    ///
    /// Each request is a read of its own, with the timeouts and retries of the station's
    /// [options](Station::options); [`CallOptions::background`](crate::CallOptions::background) lets all others of the link go
    /// first. A check (4E) after every 64 pages and in the end confirms that no reply was a duplicate out of order; if one was, what
    /// was read since the last check is read again, as often as reads are retried. The future can be dropped at any time.
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
        let mut job = StationJob::new(station);
        let mut meter: Option<Meter> = None;
        loop {
            let (step, mark) = (self.reading.next(), self.reading.mark());
            let rewound = match step {
                Step::Brief => {
                    let brief = job.call(mark, ReadStatus, false).await;
                    take(brief.map_err(failed(ProgramAction::ReadStatus))?, |brief| self.reading.brief(brief))
                }
                Step::Status => {
                    let status = job.call(mark, ReadDetailedStatus, false).await;
                    take(status.map_err(failed(ProgramAction::ReadStatus))?, |status| self.reading.status(status))
                }
                Step::Page(page) => {
                    let began = Instant::now();
                    let content = job.call(mark, ReadProgramPage::new(page), false).await;
                    if let Err(error) = &content {
                        self.reading.confirmed_before(job.first_held());
                        // What was read before is kept if the PLC still confirms it.
                        let duplicates = matches!(error, Error::Duplicates { .. });
                        if !duplicates && matches!(job.confirm().await, Ok(None)) {
                            self.reading.confirmed_before(None);
                        }
                    }
                    let content = content.map_err(failed(ProgramAction::ReadPage(page)))?;
                    let rewound = take(content, |content| self.reading.page(content));
                    if let (None, Some(tell)) = (&rewound, &mut self.on_progress) {
                        report(&mut meter, self.reading.progress(), PAGE_BYTES, began, tell);
                    }
                    rewound
                }
                Step::Confirm => {
                    let rewound = job.confirm().await.map_err(failed(ProgramAction::Confirm))?;
                    if rewound.is_none() {
                        self.reading.confirmed()?;
                    }
                    rewound
                }
                Step::Done => return self.reading.finish(SystemTime::now()),
            };
            match rewound {
                Some(mark) => self.reading.rewind(mark),
                None if step == Step::Confirm => {}
                None => self.reading.confirmed_before(job.first_held()),
            }
        }
    }
}

/// Has a reply taken, or gives the mark to go back to.
fn take<M, T>(outcome: Outcome<M, T>, take: impl FnOnce(T)) -> Option<M> {
    match outcome {
        Outcome::Reply(JobReply { reply, .. }) => {
            take(reply);
            None
        }
        Outcome::Rewind(mark) => Some(mark),
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
