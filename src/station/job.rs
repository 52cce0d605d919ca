//! Sending the requests of a job: see [`Job`].

use super::Station;
use crate::command::{Command, LoopBack};
use crate::error::Error;
use crate::link::job::{Job, JobProgress};
use crate::link::{CallOutcome, Purpose};

/// A job on a station.
pub(crate) struct StationJob<'s, M> {
    station: &'s Station,
    job: Job<M>,
    /// The mark of the first result that was given up.
    given_up: Option<M>,
}

/// The result of a request of a job.
#[derive(Debug)]
pub(crate) enum Outcome<M, T> {
    /// Its reply, which is held until the job is confirmed.
    Reply(JobReply<T>),
    /// The requests from this mark on are to be repeated.
    Rewind(M),
}

/// The reply to a request of a job.
#[derive(Debug)]
pub(crate) struct JobReply<T> {
    pub(crate) reply: T,
    /// Elements of the request that was sent: fewer than asked for, if it is part of a longer read or write.
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
    /// A job that rewinds as often as a read of the station is retried.
    pub(crate) fn new(station: &'s Station) -> Self {
        Self { station, job: Job::new(station.options.retries), given_up: None }
    }

    /// A job of writes. They are not repeated, so the first rewind ends it.
    pub(crate) fn of_writes(station: &'s Station) -> Self {
        Self { station, job: Job::new(1), given_up: None }
    }

    pub(crate) fn station(&self) -> &'s Station {
        self.station
    }

    /// The mark of the first result that is not confirmed. It and later ones are lost if the job ends now.
    pub(crate) fn first_held(&self) -> Option<M> {
        self.given_up.or(self.job.first_held())
    }

    /// Sends the request at this mark. `longer`: it may leave elements to the next request.
    ///
    /// # Errors
    /// As for every method of [`Station`]; [`Error::Duplicates`] if the job was rewound too often. A
    /// refusal is confirmed before it is returned.
    pub(crate) async fn call<C: Command>(
        &mut self,
        mark: M,
        request: C,
        longer: bool,
    ) -> Result<Outcome<M, C::Reply>, Error> {
        let purpose = if longer { Purpose::Part } else { Purpose::Whole };
        let CallOutcome { result, spelling, shape, proof, .. } = self.station.submit(request, purpose).await;
        let result = match result {
            Ok(reply) => Ok(reply),
            Err(error @ Error::Plc { .. }) => Err(error),
            Err(error) => return Err(error),
        };
        let mut progress = self.job.answered(mark, shape, proof);
        if result.is_err() && matches!(progress, JobProgress::Go) {
            progress = self.job.confirmed(self.check().await?);
        }
        match self.rewound(progress)? {
            Some(first) => Ok(Outcome::Rewind(first)),
            None => result.map(|reply| Outcome::Reply(JobReply { reply, count: spelling.count.into() })),
        }
    }

    /// Ends a job of requests of one user: as [`confirm`](Self::confirm), unless the last exchange has
    /// shown that no copy is left over within the job.
    ///
    /// # Errors
    /// As for [`confirm`](Self::confirm).
    pub(crate) async fn end(&mut self) -> Result<Option<M>, Error> {
        if self.job.must_confirm() { self.confirm().await } else { Ok(None) }
    }

    /// Confirms all held results; `Some`: requests from this mark on are to be repeated.
    ///
    /// # Errors
    /// As for every method of [`Station`]; [`Error::Duplicates`] if the job was rewound too often. Then
    /// the [held](Self::first_held) results are not reliable.
    pub(crate) async fn confirm(&mut self) -> Result<Option<M>, Error> {
        if self.job.first_held().is_none() {
            return Ok(None);
        }
        let progress = self.job.confirmed(self.check().await?);
        self.rewound(progress)
    }

    async fn check(&self) -> Result<crate::link::Proof, Error> {
        let answered = self.station.submit(LoopBack::empty(), Purpose::Confirm).await;
        answered.result.map(|()| answered.proof)
    }

    /// The mark to go back to, if there is one.
    fn rewound(&mut self, progress: JobProgress<M>) -> Result<Option<M>, Error> {
        let (first, is_over) = match progress {
            JobProgress::Go => return Ok(None),
            JobProgress::Rewind(first) => (first, false),
            JobProgress::Failed(first) => (first, true),
        };
        let number = self.station.number;
        self.station.link.shared_stats().count_repeated_job(number);
        if is_over {
            self.given_up = Some(first);
            return Err(Error::Duplicates { station: number, sent: true });
        }
        tracing::debug!(station = number, "unexpected frame within a job: its requests are repeated");
        Ok(Some(first))
    }
}
