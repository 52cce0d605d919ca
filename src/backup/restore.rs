//! Writing a backup back.

use std::fmt;

use tokio::time::{Duration, Instant, sleep};

use super::restoring::{Goal, Reply, Restoring, State, Step};
use super::take::{OnProgress, content_len, fetch};
use super::{Backup, RestoreError, RestoreFailure, RestoreReport};
use crate::command::{MAX_POINTS, ReadDisabled, ReadStatus, Value, WriteDiscretes, WriteRegisters};
use crate::element::Element;
use crate::error::Error;
use crate::progress::{Meter, Progress};
use crate::station::{BegunWith, JobReply, OtherStation, Outcome, Station, StationJob};
use crate::tag::Tag;

/// How a backup is restored.
///
/// The defaults: a PLC that runs goes on running; only elements that differ are written; forced discretes stay as they are.
///
/// ```
/// use fatek::backup::RestoreOptions;
///
/// let options = RestoreOptions::new().stop_first().run_again();
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct RestoreOptions {
    pub(super) if_running: IfRunning,
    pub(super) run_again: bool,
    pub(super) write_forced: bool,
    pub(super) bridge: usize,
    pub(super) attempts: u32,
}

/// What becomes of a PLC that runs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum IfRunning {
    GoOn,
    Refuse,
    Stop,
}

impl RestoreOptions {
    /// The defaults.
    #[must_use]
    pub fn new() -> Self {
        Self { if_running: IfRunning::GoOn, run_again: false, write_forced: false, bridge: 0, attempts: 3 }
    }

    /// Stops the PLC if it runs and something is to be written, and confirms by its status that it has stopped. What is written
    /// is what differs then. Without this a running program may overwrite what is restored.
    ///
    /// If somebody runs it again meanwhile, that is [`RestoreFailure::SetRunning`](RestoreFailure::SetRunning). One that is run and
    /// stopped again between two looks, which are made just before the first write and in the end, is not noticed.
    #[must_use]
    pub fn stop_first(self) -> Self {
        Self { if_running: IfRunning::Stop, ..self }
    }

    /// A PLC that runs is [`RestoreFailure::Running`](RestoreFailure::Running), before anything is written, and one that is set
    /// running later is [`RestoreFailure::SetRunning`](RestoreFailure::SetRunning). It is looked at as with
    /// [`stop_first`](Self::stop_first).
    #[must_use]
    pub fn require_stopped(self) -> Self {
        Self { if_running: IfRunning::Refuse, ..self }
    }

    /// With [`stop_first`](Self::stop_first): runs the PLC when all is restored, if it ran before, and confirms that by its
    /// status.
    #[must_use]
    pub fn run_again(self) -> Self {
        Self { run_again: true, ..self }
    }

    /// Writes discretes that are disabled, too: their forced state becomes that of the backup.
    #[must_use]
    pub fn write_forced(self) -> Self {
        Self { write_forced: true, ..self }
    }

    /// Writes up to so many equal elements of the backup that stand between two that differ, where both are then one request.
    /// Default: 0. With more there are fewer requests, and what a running program changes in between is overwritten.
    #[must_use]
    pub fn bridge(self, elements: usize) -> Self {
        Self { bridge: elements, ..self }
    }

    /// How often a write, RUN or STOP is tried before it is given up, when there was no answer and what has become of it was
    /// looked at. Default: 3; at least 1.
    #[must_use]
    pub fn attempts(self, attempts: u32) -> Self {
        Self { attempts: attempts.max(1), ..self }
    }
}

impl Default for RestoreOptions {
    fn default() -> Self {
        Self::new()
    }
}

/// The restoring of a backup that can be repeated until it is done.
///
/// Each [run](Self::run) compares all elements first, so it writes those only that an earlier one has not. Unlike a new
/// `Restore` it remembers, until a run succeeds, that the PLC ran before it was stopped; and if it was, it goes on with the station
/// that it was begun with, by number and endpoint, and with no other.
#[must_use]
pub struct Restore {
    restoring: Restoring,
    begun_with: BegunWith,
    on_progress: Option<OnProgress>,
}

/// How long the PLC gets to stop or to run before it is told again.
const PAUSE: Duration = Duration::from_millis(100);

impl Restore {
    /// This backup is to be restored.
    pub fn new(backup: &Backup, options: RestoreOptions) -> Self {
        Self { restoring: Restoring::new(backup, options), begun_with: BegunWith::default(), on_progress: None }
    }

    /// Called after each request that has read or written; the steps are elements. It must not take long: the PLC waits
    /// meanwhile.
    pub fn on_progress(mut self, tell: impl FnMut(&Progress) + Send + 'static) -> Self {
        self.on_progress = Some(Box::new(tell));
        self
    }

    /// Finds out what would be written, and changes nothing: see [`RestoreReport::differences`] and
    /// [`to_write`](RestoreReport::to_write). What is never written is compared, too: see
    /// [`left_out_differences`](RestoreReport::left_out_differences); where the PLC refuses to give it,
    /// [`refused`](RestoreReport::refused) has it, and that is no failure. Whether the PLC runs is asked first, if
    /// that matters to the options, and [`require_stopped`](RestoreOptions::require_stopped) refuses it here, too.
    ///
    /// # Errors
    /// As for [`run`](Self::run), as far as that reads.
    pub async fn compare(&mut self, station: &Station) -> Result<RestoreReport, RestoreError> {
        self.go(station, Goal::Compare).await
    }

    /// Restores the backup, as the [module's documentation](super#what-is-restored) says.
    ///
    /// The future can be dropped at any time. What was written is then written, and if the PLC was stopped, it stays so; see
    /// [`report`](Self::report).
    ///
    /// # Errors
    /// [`RestoreError`], which tells why, what is written and what is not, and whether the PLC runs. Its
    /// [`source`](RestoreError::source) is
    /// - [`OtherStation`](RestoreFailure::OtherStation) before anything is sent;
    /// - [`Running`](RestoreFailure::Running) and [`NotThere`](RestoreFailure::NotThere) before anything is
    ///   written;
    /// - [`Call`](RestoreFailure::Call) when a request fails: run it again when the PLC is there again;
    /// - [`Differs`](RestoreFailure::Differs) when something was written and not all holds;
    /// - [`SetRunning`](RestoreFailure::SetRunning) when somebody has set the PLC running, though it was to stand still;
    /// - [`StillRunning`](RestoreFailure::StillRunning) and [`NotRunning`](RestoreFailure::NotRunning) when the
    ///   PLC does not do as it is told.
    pub async fn run(&mut self, station: &Station) -> Result<RestoreReport, RestoreError> {
        self.go(station, Goal::Restore).await
    }

    /// How far the last run has come, even one that was dropped.
    #[must_use]
    pub fn report(&self) -> RestoreReport {
        self.restoring.report()
    }

    async fn go(&mut self, station: &Station, goal: Goal) -> Result<RestoreReport, RestoreError> {
        let same = self.begun_with.go_on(station, self.restoring.is_bound());
        same.map_err(|OtherStation { begun, station }| self.failed(RestoreFailure::OtherStation { begun, station }))?;
        self.restoring.begin(goal);
        let mut job = StationJob::new(station);
        let mut meter: Option<Meter> = None;
        loop {
            let began = Instant::now();
            let step = self.restoring.next();
            let step = step.map_err(|source| self.failed(source))?;
            let (mark, shorter) = (self.restoring.mark(), self.restoring.takes_shorter());
            let (bytes, handled) = match step {
                Step::Done => return Ok(self.restoring.report()),
                Step::Confirm => {
                    let confirmed = job.confirm().await;
                    (0, self.restoring.confirmed(confirmed))
                }
                step => {
                    let range = match &step {
                        Step::Read(chunk) => Some(chunk.range),
                        Step::Write(range, _) => Some(*range),
                        _ => None,
                    };
                    match ask(station, &mut job, mark, shorter, step).await {
                        Ok(Outcome::Reply(JobReply { reply, count })) => {
                            let bytes = range.map_or(0, |range| content_len(range, count));
                            (bytes, self.restoring.handle(Ok(reply)))
                        }
                        Ok(Outcome::Rewind(mark)) => {
                            self.restoring.rewind(mark);
                            (0, Ok(()))
                        }
                        Err(error) => (0, self.restoring.handle(Err(error))),
                    }
                }
            };
            handled.map_err(|source| self.failed(source))?;
            if let Some(tell) = self.on_progress.as_mut().filter(|_| bytes > 0) {
                let (phase, done, total) = self.restoring.progress();
                // The request that begins a phase belongs to it, and so does its time.
                let meter = match &mut meter {
                    // A PLC that has been stopped is compared again, from the beginning.
                    Some(known) if known.phase() == phase && known.done() < done => known,
                    other => other.insert(Meter::new(phase, total, 0, began)),
                };
                meter.advance(done, total, bytes);
                tell(&meter.progress(Instant::now()));
            }
        }
    }

    fn failed(&self, source: RestoreFailure) -> RestoreError {
        RestoreError { source, report: Box::new(self.report()) }
    }
}

impl fmt::Debug for Restore {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Restore").field("restoring", &self.restoring).finish_non_exhaustive()
    }
}

type Asked<T> = Result<Outcome<State, T>, Error>;

async fn ask(
    station: &Station,
    job: &mut StationJob<'_, State>,
    mark: State,
    shorter: bool,
    step: Step,
) -> Asked<Reply> {
    let done = |reply| Outcome::Reply(JobReply { reply, count: 0 });
    Ok(match step {
        Step::Status => job.call(mark, ReadStatus, false).await?.map(|status| Reply::Running(status.flags().running())),
        Step::Stop => {
            station.stop().await?;
            done(Reply::Done)
        }
        Step::Run => {
            station.run().await?;
            done(Reply::Done)
        }
        Step::Pause => {
            sleep(PAUSE).await;
            done(Reply::Done)
        }
        Step::Read(chunk) => fetch(job, mark, chunk, shorter).await?.map(Reply::Values),
        Step::ReadForced(first, count) if count <= MAX_POINTS => {
            job.call(mark, ReadDisabled::new(first, count)?, false).await?.map(Reply::Forced)
        }
        // A job of its own.
        Step::ReadForced(first, count) => done(Reply::Forced(station.read_disabled(first, count).await?)),
        Step::Write(range, values) => store(job, mark, range, &values).await?.map(|()| Reply::Done),
        Step::Confirm | Step::Done => done(Reply::Done),
    })
}

/// Writes these elements in one request.
async fn store(job: &mut StationJob<'_, State>, mark: State, range: Tag, values: &[Value]) -> Asked<()> {
    match range.first() {
        Element::Discrete(first) => {
            let bits = values.iter().filter_map(|value| if let Value::Bit(on) = *value { Some(on) } else { None });
            job.call(mark, WriteDiscretes::new(first, bits.collect::<Vec<_>>())?, false).await
        }
        Element::Register(first) => {
            let words =
                values.iter().filter_map(|value| if let Value::Word(word) = *value { Some(word) } else { None });
            job.call(mark, WriteRegisters::new(first, words.collect::<Vec<_>>())?, false).await
        }
        Element::Register32(first) => {
            let doubles =
                values.iter().filter_map(|value| if let Value::DWord(double) = *value { Some(double) } else { None });
            job.call(mark, WriteRegisters::new(first, doubles.collect::<Vec<_>>())?, false).await
        }
    }
}
