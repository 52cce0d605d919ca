//! Sends the requests of a plan.

use super::fallback::{Fallback, is_refusal};
use super::reply::ReplyWords;
use super::{Plan, PlanReadings};
use crate::capabilities::Refused;
use crate::error::Error;
use crate::station::{JobReply, Outcome, Station, StationJob};

/// The result of a request of the plan.
pub(super) struct RequestResult<E> {
    pub(super) reply: Result<ReplyWords, E>,
    /// The plans in place of a refused request, each with the results of its requests.
    pub(super) fallbacks: Vec<(Fallback, Vec<Result<ReplyWords, E>>)>,
}

impl<E> From<Result<ReplyWords, E>> for RequestResult<E> {
    fn from(reply: Result<ReplyWords, E>) -> Self {
        Self { reply, fallbacks: Vec::new() }
    }
}

impl<E> RequestResult<E> {
    /// Returns whether other requests have read its values.
    fn is_read_by_others(&self) -> bool {
        let mut replies = self.fallbacks.iter().flat_map(|(_, replies)| replies).peekable();
        replies.peek().is_some() && replies.all(Result::is_ok)
    }
}

/// A result, or the request from which on the job is repeated.
type Progress<T> = Result<T, usize>;

impl Plan {
    /// Sends the requests in turn and returns their replies.
    ///
    /// After a failed request the others are sent all the same: its tags have the error, the others
    /// their values. Without a connection ([`Error::Connect`]), or behind a closed gate
    /// ([`Error::GateClosed`]), the others are not tried. If the PLC refuses a request with
    /// [words of discretes](super::PlannedRequest::has_words_of_discretes), or a mixed read that it does not
    /// know, the values are read by others in the same call; silence is not a refusal. The station's
    /// [capabilities](Station::capabilities) have the refusal then, for the plans made after that.
    ///
    /// A check at the end confirms several requests; they are repeated if a duplicate of a reply came
    /// out of order. After as many repetitions from one request on as a read has retries, the rest has
    /// [`Error::Duplicates`], and is not sent. Cancel-safe: the requests only read.
    pub async fn read(&self, station: &Station) -> PlanReadings<'_, Error> {
        let mut job = StationJob::new(station);
        let mut results: Vec<RequestResult<Error>> = Vec::with_capacity(self.requests.len());
        // The job counts the repetitions since its last proof. The requests in place of a refused one have
        // one mark, and may be proven in part each time.
        let (mut farthest, mut repeats_left) = (None, 0);
        loop {
            let progress = if results.len() < self.requests.len() {
                match self.read_request(results.len(), &mut job, &mut results).await {
                    Ok(result) => {
                        let is_cut_off =
                            |error: &&Error| error.is_connect() || matches!(error, Error::GateClosed { .. });
                        let cut_off = result.reply.as_ref().err().filter(is_cut_off).cloned();
                        results.push(result);
                        if let Some(error) = cut_off {
                            // The results before are confirmed, or fail, as after all requests.
                            results.resize_with(self.requests.len(), || Err(error.clone()).into());
                        }
                        continue;
                    }
                    Err(confirmed) => Ok(Some(confirmed)),
                }
            } else {
                job.end().await
            };
            match progress {
                Ok(None) => return PlanReadings::with_fallbacks(self, results),
                Ok(Some(confirmed)) => {
                    results.truncate(confirmed);
                    if farthest.is_none_or(|farthest| confirmed > farthest) {
                        (farthest, repeats_left) = (Some(confirmed), station.options().retries);
                    }
                    let Some(left) = repeats_left.checked_sub(1) else {
                        let error = Error::Duplicates { station: station.number(), sent: true };
                        results.resize_with(self.requests.len(), || Err(error.clone()).into());
                        return PlanReadings::with_fallbacks(self, results);
                    };
                    repeats_left = left;
                }
                Err(error) => {
                    fail_from(&mut results, job.first_held(), &error);
                    return PlanReadings::with_fallbacks(self, results);
                }
            }
        }
    }

    /// Reads one request, or the values of it without words of discretes.
    async fn read_request(
        &self,
        request: usize,
        job: &mut StationJob<'_, usize>,
        before: &mut [RequestResult<Error>],
    ) -> Progress<RequestResult<Error>> {
        let reply = self.call(request, request, job, before).await?;
        let fallbacks = match &reply {
            Err(error) if is_refusal(error) => self.fallbacks(request, error),
            Ok(_) | Err(_) => Vec::new(),
        };
        let mut result = RequestResult::from(reply);
        for fallback in fallbacks {
            tracing::debug!(request, "refused: its values are read by other requests");
            let mut replies = Vec::with_capacity(fallback.plan.requests.len());
            for n in 0..fallback.plan.requests.len() {
                let reply = fallback.plan.call(n, request, job, before).await?;
                if let Err(error @ Error::Duplicates { .. }) = &reply {
                    // The replies since the last proof are not reliable.
                    return Ok(Err(error.clone()).into());
                }
                replies.push(reply);
            }
            result.fallbacks.push((fallback, replies));
        }
        if let Some(planned) = self.requests.get(request)
            && result.is_read_by_others()
        {
            // With words, these may be the reason: a plan without them shows if it is the command.
            let learned = match planned.has_words_of_discretes() {
                true => Refused::Words(planned.word_areas),
                false => Refused::MixedReads,
            };
            job.station().link().learn_capability(job.station().number(), learned);
        }
        Ok(result)
    }

    /// Sends one request at this mark of the job.
    async fn call(
        &self,
        request: usize,
        mark: usize,
        job: &mut StationJob<'_, usize>,
        before: &mut [RequestResult<Error>],
    ) -> Progress<Result<ReplyWords, Error>> {
        // The callers count through the requests.
        let Some(planned) = self.requests.get(request) else { return Err(mark) };
        match planned.request.call_in_job(job, mark).await {
            Ok(Outcome::Reply(JobReply { reply, .. })) => Ok(Ok(reply.into())),
            Ok(Outcome::Rewind(confirmed)) => Err(confirmed),
            Err(error @ Error::Duplicates { .. }) => {
                fail_from(before, job.first_held(), &error);
                Ok(Err(error))
            }
            Err(error) => Ok(Err(error)),
        }
    }
}

/// Replaces the results from `first` on, which are not confirmed, by an error.
fn fail_from(results: &mut [RequestResult<Error>], first: Option<usize>, error: &Error) {
    for result in results.iter_mut().skip(first.unwrap_or(usize::MAX)) {
        *result = Err(error.clone()).into();
    }
}
