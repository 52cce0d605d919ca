//! The requests of a job, sent one after the other: see [`Job`].

use super::Station;
use crate::command::{Command, LoopBack};
use crate::error::Error;
use crate::link::job::{Job, JobProgress};
use crate::link::{CallOutcome, Purpose};

/// A job on a station.
pub(crate) struct StationJob<'s, M> {
    station: &'s Station,
    job: Job<M>,
    /// Where the results begin that were given up.
    given_up: Option<M>,
}

/// What came of a request of a job.
#[derive(Debug)]
pub(crate) enum Outcome<M, T> {
    /// Its reply, which is held: it is good once the job is confirmed.
    Reply(JobReply<T>),
    /// The results from this mark on are to be asked for again.
    Rewind(M),
}

/// The reply to a request of a job.
#[derive(Debug)]
pub(crate) struct JobReply<T> {
    pub(crate) reply: T,
    /// Elements that were named: fewer than the request has, if it was a part of a longer read or write.
    pub(crate) count: usize,
}

impl<M, T> Outcome<M, T> {
    pub(crate) fn map<U>(self, into: impl FnOnce(T) -> U) -> Outcome<M, U> {
        match self {
            Self::Reply(JobReply { reply, count }) => Outcome::Reply(JobReply { reply: into(reply), count }),
            Self::Rewind(mark) => Outcome::Rewind(mark),
        }
    }
}

impl<'s, M: Copy> StationJob<'s, M> {
    /// A job that asks again as often as a read of the station is retried.
    pub(crate) fn new(station: &'s Station) -> Self {
        Self { station, job: Job::new(station.options.retries), given_up: None }
    }

    /// A job of writes. They are not repeated, so the first rewind is the end.
    pub(crate) fn of_writes(station: &'s Station) -> Self {
        Self { station, job: Job::new(1), given_up: None }
    }

    /// The first result that is not confirmed: those from there on are not to be used if the job ends now.
    pub(crate) fn first_held(&self) -> Option<M> {
        self.given_up.or(self.job.first_held())
    }

    /// Sends a request that stands at this mark. `longer`: it may leave elements to the next request.
    ///
    /// # Errors
    /// As for every method of [`Station`]; [`Error::OutOfStep`] when the job has been rewound too often. A refusal of a read is
    /// confirmed before it is given out.
    pub(crate) async fn call<C: Command>(
        &mut self,
        mark: M,
        request: C,
        longer: bool,
    ) -> Result<Outcome<M, C::Reply>, Error> {
        let purpose = if longer { Purpose::Part } else { Purpose::InJob };
        let CallOutcome { result, spelling, shape, proof, .. } = self.station.submit(request, purpose).await;
        let refused = match result {
            Ok(reply) => {
                return Ok(match self.job.answered(mark, shape, proof) {
                    JobProgress::Go => Outcome::Reply(JobReply { reply, count: spelling.count.into() }),
                    progress @ (JobProgress::Rewind(_) | JobProgress::Failed(_)) => {
                        Outcome::Rewind(self.rewound(progress, mark)?)
                    }
                });
            }
            Err(error @ Error::Plc { .. }) => error,
            Err(error) => return Err(error),
        };
        let progress = match self.job.answered(mark, shape, proof) {
            JobProgress::Go => self.job.confirmed(self.check().await?),
            progress @ (JobProgress::Rewind(_) | JobProgress::Failed(_)) => progress,
        };
        match progress {
            JobProgress::Go => Err(refused),
            progress @ (JobProgress::Rewind(_) | JobProgress::Failed(_)) => {
                Ok(Outcome::Rewind(self.rewound(progress, mark)?))
            }
        }
    }

    /// Ends a job of requests of one user: as [`confirm`](Self::confirm), but not if the last exchange has shown that no copy is
    /// left over within the job.
    pub(crate) async fn end(&mut self) -> Result<Option<M>, Error> {
        if self.job.must_confirm() { self.confirm().await } else { Ok(None) }
    }

    /// Confirms all results that are held; `Some`: those from this mark on are to be asked for again.
    ///
    /// # Errors
    /// As for every method of [`Station`]; [`Error::OutOfStep`] when the job has been rewound too often. Then the results that
    /// are [held](Self::first_held) are not good.
    pub(crate) async fn confirm(&mut self) -> Result<Option<M>, Error> {
        let Some(first) = self.job.first_held() else { return Ok(None) };
        let proof = self.check().await?;
        match self.job.confirmed(proof) {
            JobProgress::Go => Ok(None),
            progress @ (JobProgress::Rewind(_) | JobProgress::Failed(_)) => self.rewound(progress, first).map(Some),
        }
    }

    async fn check(&self) -> Result<crate::link::Proof, Error> {
        let answered = self.station.submit(LoopBack::empty(), Purpose::Confirm(())).await;
        answered.result.map(|()| answered.proof)
    }

    fn rewound(&mut self, progress: JobProgress<M>, mark: M) -> Result<M, Error> {
        let number = self.station.number;
        self.station.link.shared_stats().count_repeated_job(number);
        match progress {
            JobProgress::Go => Ok(mark),
            JobProgress::Rewind(first) => {
                tracing::debug!(
                    station = number,
                    "an unexpected frame came within a job: its results are asked for again"
                );
                Ok(first)
            }
            JobProgress::Failed(first) => {
                self.given_up = Some(first);
                Err(Error::Duplicates { station: number, sent: true })
            }
        }
    }
}
