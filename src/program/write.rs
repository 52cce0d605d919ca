use std::fmt;
use std::time::Duration;

use tokio::time::{Instant, sleep};

use super::read::{OnProgress, in_framing, report};
use super::writing::{Goal, Mark, Step, Told, Writing};
use super::{PAGE_BYTES, Program, ProgramError, WriteProgramError, WriteState};
use crate::command::{Command, ReadDetailedStatus, ReadProgramPage, ReadStatus};
use crate::error::Error;
use crate::progress::Progress;
use crate::station::{BegunWith, JobReply, OtherStation, Outcome, Station, StationJob};

/// How a program is written.
///
/// The defaults: a PLC that runs is refused; only pages that differ are written; what was written is read back; the PLC is
/// left stopped.
///
/// ```
/// use std::time::Duration;
/// use fatek::program::WriteOptions;
///
/// let options = WriteOptions::new().stop_first().run_again().page_timeout(Duration::from_secs(5));
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct WriteOptions {
    pub(super) stop_first: bool,
    pub(super) run_again: bool,
    pub(super) all_pages: bool,
    pub(super) verify_all: bool,
    pub(super) attempts: u32,
    pub(super) page_timeout: Option<Duration>,
}

impl WriteOptions {
    /// The defaults.
    #[must_use]
    pub fn new() -> Self {
        Self {
            stop_first: false,
            run_again: false,
            all_pages: false,
            verify_all: false,
            attempts: 3,
            page_timeout: None,
        }
    }

    /// Stops the PLC if it runs and a page is to be written, and confirms by its status that it has stopped. Without this a PLC that
    /// runs is [`ProgramError::Running`](super::ProgramError::Running), before anything is written.
    #[must_use]
    pub fn stop_first(mut self) -> Self {
        self.stop_first = true;
        self
    }

    /// Runs the PLC when all is written, if it ran before, and confirms that by its status.
    #[must_use]
    pub fn run_again(mut self) -> Self {
        self.run_again = true;
        self
    }

    /// Writes all pages, not only those that differ. None is read before it is written, then; a
    /// further run of the same [`WriteProgram`] compares all, and does not write again those that an earlier one has written.
    #[must_use]
    pub fn all_pages(mut self) -> Self {
        self.all_pages = true;
        self
    }

    /// Reads all pages once more in the end, also those that were not written, and compares them.
    #[must_use]
    pub fn verify_all(mut self) -> Self {
        self.verify_all = true;
        self
    }

    /// How often a page is written before it is given up, when its write had no answer or it reads back as something else.
    /// Default: 3; at least 1.
    #[must_use]
    pub fn attempts(mut self, attempts: u32) -> Self {
        self.attempts = attempts.max(1);
        self
    }

    /// How long the PLC has to answer the write of a page. Default: as long as for any other request of the station. A PLC
    /// that keeps its program in flash memory may take longer.
    #[must_use]
    pub fn page_timeout(mut self, timeout: Duration) -> Self {
        self.page_timeout = Some(timeout);
        self
    }
}

impl Default for WriteOptions {
    fn default() -> Self {
        Self::new()
    }
}

/// What was done to write a program, by the run that has ended well and those before it. All its pages are the PLC's now.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct WriteReport {
    /// The pages that this run has written, in this order; each was read back.
    pub written: Vec<u16>,
    /// The other pages that earlier runs of the same [`WriteProgram`] have written, and that were as they should be when they were
    /// read back.
    pub written_before: Vec<u16>,
    /// How many pages there are.
    pub pages: u16,
    /// Whether the PLC was running and has been stopped, by this run or an earlier one of the same [`WriteProgram`].
    pub was_stopped: bool,
    /// Whether the PLC runs now.
    pub running: bool,
}

/// The writing of a program that can be repeated until it is done.
///
/// Each [run](Self::run) compares all pages first, so it writes those only that an earlier one has not. Unlike a new
/// `WriteProgram` it remembers that the PLC ran before it was stopped. So until a run has ended well, it goes on with the station
/// that it was begun with, by number and endpoint, and with no other.
#[must_use]
pub struct WriteProgram {
    writing: Writing,
    begun_with: BegunWith,
    on_progress: Option<OnProgress>,
}

/// How long the PLC gets to stop or to run before it is told again.
const PAUSE: Duration = Duration::from_millis(100);

impl WriteProgram {
    /// This program is to be written.
    pub fn new(program: &Program, options: WriteOptions) -> Self {
        Self { writing: Writing::new(program.clone(), options), begun_with: BegunWith::default(), on_progress: None }
    }

    /// Called after each page that was read or written. It must not take long: the PLC waits meanwhile.
    pub fn on_progress(mut self, tell: impl FnMut(&Progress) + Send + 'static) -> Self {
        self.on_progress = Some(Box::new(tell));
        self
    }

    /// Finds out which pages differ, and changes nothing.
    ///
    /// # Errors
    /// As for [`run`](Self::run); whether the PLC runs or has a memory card is no matter here.
    pub async fn compare(&mut self, station: &Station) -> Result<Vec<u16>, WriteProgramError> {
        self.go(station, Goal::Compare).await?;
        Ok(self.state().unwritten)
    }

    /// Finds out which pages [`run`](Self::run) would write with these options, and changes nothing.
    ///
    /// # Errors
    /// As for [`run`](Self::run), as far as that reads: what it would refuse before anything is changed is refused here, too.
    pub async fn dry_run(&mut self, station: &Station) -> Result<Vec<u16>, WriteProgramError> {
        self.go(station, Goal::DryRun).await?;
        Ok(self.state().unwritten)
    }

    /// Writes the program, as the [module's documentation](super#writing) says.
    ///
    /// The future can be dropped at any time. The PLC is then as after a failure: if it was stopped, it stays so; see
    /// [`state`](Self::state).
    ///
    /// # Errors
    /// [`WriteProgramError`], which tells why, which pages are written and which are not, and whether the PLC runs. Its
    /// [`source`](WriteProgramError::source) is
    /// - [`OtherStation`](super::ProgramError::OtherStation) before anything is sent;
    /// - [`SizeMisfit`](super::ProgramError::SizeMisfit), [`KindMisfit`](super::ProgramError::KindMisfit),
    ///   [`MemoryCard`](super::ProgramError::MemoryCard) and [`Running`](super::ProgramError::Running) before anything is
    ///   changed;
    /// - [`Call`](super::ProgramError::Call) when a request fails: run it again when the PLC is there again;
    /// - [`StillRunning`](super::ProgramError::StillRunning), [`NotTaken`](super::ProgramError::NotTaken),
    ///   [`SetRunning`](super::ProgramError::SetRunning) and [`Differs`](super::ProgramError::Differs) when the PLC, or
    ///   somebody else, does not do as it should;
    /// - [`RunRefused`](super::ProgramError::RunRefused) and [`NotRunning`](super::ProgramError::NotRunning) when the program
    ///   is written, and the PLC does not run it.
    pub async fn run(&mut self, station: &Station) -> Result<WriteReport, WriteProgramError> {
        self.go(station, Goal::Write).await?;
        Ok(self.writing.report())
    }

    /// How far the last run has come, even one that was dropped.
    #[must_use]
    pub fn state(&self) -> WriteState {
        self.writing.state()
    }

    async fn go(&mut self, station: &Station, goal: Goal) -> Result<(), WriteProgramError> {
        let same = self.begun_with.go_on(station, self.writing.is_bound());
        same.map_err(|OtherStation { begun, station }| WriteProgramError {
            source: Box::new(ProgramError::OtherStation { begun, station }),
            state: Box::new(self.state()),
        })?;
        self.writing.begin(goal);
        if let Err(error) = in_framing(station) {
            self.writing.told(Err(error));
        }
        let patient = self.patient(station);
        let mut job = StationJob::new(station);
        let mut meter = None;
        loop {
            let began = Instant::now();
            let (step, mark) = (self.writing.next(), self.writing.mark());
            let told = match step {
                Step::Done => return Ok(()),
                Step::Failed => return Err(self.writing.failure()),
                Step::Confirm => {
                    let confirmed = job.confirm().await;
                    self.distrust(confirmed.as_ref().err(), job.first_held());
                    self.writing.confirmed(confirmed);
                    continue;
                }
                Step::Write(page) => match self.writing.program().page(page) {
                    Some(content) => patient.write_program_page(page, content).await.map(|()| Told::Done),
                    None => Ok(Told::Done),
                },
                step => match ask(station, &mut job, mark, step).await {
                    Ok(Outcome::Reply(JobReply { reply, .. })) => Ok(reply),
                    Ok(Outcome::Rewind(mark)) => {
                        self.writing.rewind(mark);
                        continue;
                    }
                    Err(error) => Err(error),
                },
            };
            let moved = told.is_ok() && matches!(step, Step::Read(_) | Step::Write(_));
            self.distrust(told.as_ref().err(), job.first_held());
            self.writing.told(told);
            let progress = self.writing.progress();
            // Where all pages are written there is nothing to compare: the header alone is read.
            let counts = moved && progress.2 > 0;
            if let Some(tell) = self.on_progress.as_mut().filter(|_| counts) {
                report(&mut meter, progress, PAGE_BYTES, began, tell);
            }
        }
    }

    /// After too many duplicates what is held is not good.
    fn distrust(&mut self, error: Option<&Error>, first_held: Option<Mark>) {
        if matches!(error, Some(Error::Duplicates { .. })) {
            self.writing.distrust(first_held);
        }
    }

    /// The station, as it is asked to write a page.
    fn patient(&self, station: &Station) -> Station {
        let Some(timeout) = self.writing.options().page_timeout else { return station.clone() };
        let options = station.options().response_timeout(timeout);
        // The whole call must be able to hold it.
        let call_timeout = options.call_timeout.max(timeout.saturating_mul(2));
        station.with_options(options.call_timeout(call_timeout))
    }
}

async fn ask(
    station: &Station,
    job: &mut StationJob<'_, Mark>,
    mark: Mark,
    step: Step,
) -> Result<Outcome<Mark, Told>, Error> {
    let done = Outcome::Reply(JobReply { reply: Told::Done, count: 0 });
    Ok(match step {
        Step::Status => read(job, mark, ReadDetailedStatus, Told::Status).await?,
        Step::Flags => read(job, mark, ReadStatus, |status| Told::Flags(status.flags())).await?,
        Step::Read(page) => read(job, mark, ReadProgramPage::new(page), Told::Page).await?,
        Step::Stop => {
            station.stop().await?;
            done
        }
        Step::Run => {
            station.run().await?;
            done
        }
        Step::Pause => {
            sleep(PAUSE).await;
            done
        }
        Step::Write(_) | Step::Confirm | Step::Done | Step::Failed => done,
    })
}

async fn read<C: Command>(
    job: &mut StationJob<'_, Mark>,
    mark: Mark,
    request: C,
    told: impl FnOnce(C::Reply) -> Told,
) -> Result<Outcome<Mark, Told>, Error> {
    Ok(job.call(mark, request, false).await?.map(told))
}

impl fmt::Debug for WriteProgram {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("WriteProgram")
            .field("program", self.writing.program())
            .field("options", self.writing.options())
            .finish_non_exhaustive()
    }
}
