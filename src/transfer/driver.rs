//! Sends the requests of a transfer.

use std::time::Duration;

use tokio::time::{Instant, sleep};

use super::meter::Meter;
use super::resume_guard::{OtherStation, ResumeGuard};
use super::step::{Position, Reply, Request, Step, Transfer};
use crate::command::{
    Command, ReadDetailedStatus, ReadDisabled, ReadDiscretes, ReadProgramPage, ReadRegisters, ReadStatus, Value,
    WriteDiscretes, WriteRegisters,
};
use crate::element::Element;
use crate::error::Error;
use crate::progress::Progress;
use crate::station::{JobReply, Outcome, Station, StationJob};
use crate::tag::Tag;

/// A callback for the progress of a transfer.
type OnProgress = Box<dyn FnMut(&Progress) + Send>;

/// How long the PLC has to obey STOP or RUN before it is sent again.
const PAUSE: Duration = Duration::from_millis(100);

/// Drives a transfer over a station, in one or more runs.
#[derive(Default)]
pub(crate) struct Driver {
    guard: ResumeGuard,
    on_progress: Option<OnProgress>,
}

impl Driver {
    pub(crate) fn on_progress(&mut self, callback: impl FnMut(&Progress) + Send + 'static) {
        self.on_progress = Some(Box::new(callback));
    }

    /// Checks the station of a run, before the transfer begins it: see [`ResumeGuard::admit`].
    ///
    /// # Errors
    /// [`OtherStation`]; nothing was sent.
    pub(crate) fn admit(&mut self, station: &Station, bound: bool) -> Result<(), OtherStation> {
        self.guard.admit(station, bound)
    }

    /// Runs the transfer to its end. Cancel-safe: see the invariants of the [module](super).
    ///
    /// # Errors
    /// That of the transfer.
    pub(crate) async fn run<T: Transfer>(&mut self, transfer: &mut T, station: &Station) -> Result<(), T::Failure> {
        let mut job = StationJob::new(station);
        let mut meter = None;
        loop {
            let step = transfer.next()?;
            let (mark, before, began) = (transfer.mark(), transfer.position(), Instant::now());
            let request = match step {
                Step::Done => return Ok(()),
                Step::Confirm => {
                    match job.confirm().await {
                        Ok(None) => transfer.confirmed(Ok(()))?,
                        Ok(Some(mark)) => transfer.rewind(mark),
                        Err(error) => {
                            distrust(transfer, &job, &error);
                            transfer.confirmed(Err(error))?;
                        }
                    }
                    continue;
                }
                Step::Send(request) => request,
            };
            let content_len = request.content_len();
            let (bytes, result) = match send(station, &mut job, mark, request).await {
                Ok(Outcome::Reply(JobReply { reply, count })) => (content_len(count), Ok(reply)),
                Ok(Outcome::Rewind(mark)) => {
                    transfer.rewind(mark);
                    continue;
                }
                Err(error) => (0, Err(error)),
            };
            transfer.keep(job.first_held());
            if let Err(error) = &result {
                distrust(transfer, &job, error);
                let is_over = !matches!(error, Error::Plc { .. } | Error::Duplicates { .. });
                if T::KEEPS_PARTIAL && is_over && matches!(job.confirm().await, Ok(None)) {
                    transfer.keep(None);
                }
            }
            let is_refused_read = result.is_err() && content_len(1) > 0;
            transfer.handle(result)?;
            let after = transfer.position();
            let has_moved = bytes > 0 || is_refused_read && after.done > before.done;
            if let Some(callback) = self.on_progress.as_mut().filter(|_| has_moved && after.total > 0) {
                report(&mut meter, (before, after), bytes, began, callback);
            }
        }
    }
}

/// After too many duplicates, the held replies are not reliable.
fn distrust<T: Transfer>(transfer: &mut T, job: &StationJob<'_, T::Mark>, error: &Error) {
    if let (Error::Duplicates { .. }, Some(mark)) = (error, job.first_held()) {
        transfer.distrust(mark);
    }
}

/// Reports a request that moved content. The first request of a phase counts as part of it.
fn report(
    meter: &mut Option<Meter>,
    (before, after): (Position, Position),
    bytes: usize,
    began: Instant,
    callback: &mut OnProgress,
) {
    let meter = match meter {
        Some(meter) if meter.continues_at(after) => meter,
        other => {
            let done = if before.phase == after.phase { before.done } else { 0 };
            other.insert(Meter::new(Position { done, ..after }, began))
        }
    };
    meter.advance(after, bytes);
    callback(&meter.progress(Instant::now()));
}

type Sent<M, T = Reply> = Result<Outcome<M, T>, Error>;

/// Sends a request: reads of all kinds and writes of elements in the job, all others outside of it.
async fn send<M: Copy>(station: &Station, job: &mut StationJob<'_, M>, mark: M, request: Request) -> Sent<M> {
    match request {
        Request::Status => call(job, mark, ReadStatus, Reply::Status).await,
        Request::DetailedStatus => call(job, mark, ReadDetailedStatus, Reply::DetailedStatus).await,
        Request::Stop => station.stop().await.map(|()| outside_job(Reply::Done)),
        Request::Run => station.run().await.map(|()| outside_job(Reply::Done)),
        Request::Pause => {
            sleep(PAUSE).await;
            Ok(outside_job(Reply::Done))
        }
        Request::ReadPage(page) => call(job, mark, ReadProgramPage::new(page), Reply::Page).await,
        // Not of the job: the page that is read back shows the result of the write.
        Request::WritePage { page, content, timeout } => {
            let patient = timeout.map(|timeout| patient(station, timeout));
            let station = patient.as_ref().unwrap_or(station);
            station.write_program_page(page, &content).await.map(|()| outside_job(Reply::Done))
        }
        Request::Read { range, shorter } => read(job, mark, range, shorter).await,
        Request::ReadDisabled(first, count) if count <= station.request_lengths().most(first.into()) => {
            call(job, mark, ReadDisabled::new(first, count)?, Reply::Disabled).await
        }
        Request::ReadDisabled(first, count) => {
            station.read_disabled(first, count).await.map(|disabled| outside_job(Reply::Disabled(disabled)))
        }
        Request::Write(range, values) => write(job, mark, range, &values).await,
    }
}

fn outside_job<M>(reply: Reply) -> Outcome<M, Reply> {
    Outcome::Reply(JobReply { reply, count: 0 })
}

async fn call<M: Copy, C: Command>(
    job: &mut StationJob<'_, M>,
    mark: M,
    request: C,
    into: impl FnOnce(C::Reply) -> Reply,
) -> Sent<M> {
    Ok(job.call(mark, request, false).await?.map(into))
}

/// The station with this response timeout, and a call timeout that can hold it.
fn patient(station: &Station, timeout: Duration) -> Station {
    let options = station.options().with_response_timeout(timeout);
    let call_timeout = options.call_timeout.max(timeout.saturating_mul(2));
    station.with_options(options.with_call_timeout(call_timeout))
}

/// Reads elements in one request.
async fn read<M: Copy>(job: &mut StationJob<'_, M>, mark: M, range: Tag, shorter: bool) -> Sent<M> {
    fn values(raw: Vec<impl Into<Value>>) -> Reply {
        Reply::Values(raw.into_iter().map(Into::into).collect())
    }
    let count = range.element_count();
    Ok(match range.first() {
        Element::Discrete(first) => job.call(mark, ReadDiscretes::new(first, count)?, shorter).await?.map(values),
        Element::Register(first) => job.call(mark, ReadRegisters::new(first, count)?, shorter).await?.map(values),
        Element::Register32(first) => job.call(mark, ReadRegisters::new(first, count)?, shorter).await?.map(values),
    })
}

/// Writes elements in one request.
async fn write<M: Copy>(job: &mut StationJob<'_, M>, mark: M, range: Tag, values: &[Value]) -> Sent<M> {
    fn raw<T>(values: &[Value], raw: impl Fn(Value) -> Option<T>) -> Vec<T> {
        let raw: Vec<T> = values.iter().filter_map(|&value| raw(value)).collect();
        debug_assert_eq!(raw.len(), values.len(), "the values of a range have its width");
        raw
    }
    Ok(match range.first() {
        Element::Discrete(first) => {
            let bits = raw(values, |value| if let Value::Bit(on) = value { Some(on) } else { None });
            job.call(mark, WriteDiscretes::new(first, bits)?, false).await?.map(|()| Reply::Done)
        }
        Element::Register(first) => {
            let words = raw(values, |value| if let Value::Word(word) = value { Some(word) } else { None });
            job.call(mark, WriteRegisters::new(first, words)?, false).await?.map(|()| Reply::Done)
        }
        Element::Register32(first) => {
            let doubles = raw(values, |value| if let Value::DWord(double) = value { Some(double) } else { None });
            job.call(mark, WriteRegisters::new(first, doubles)?, false).await?.map(|()| Reply::Done)
        }
    })
}
