//! Makes a call over a link: from the request to its result.

use std::future::Future;
use std::io;
use std::sync::Arc;

use tokio::runtime::{Handle, Id, TryCurrentError};
use tokio::task::{consume_budget, yield_now};
use tokio::time::Instant;
use tracing::Instrument;
use tracing::level_filters::LevelFilter;

use super::call::{self, CallFuture, CallMeta, Sending};
use super::in_step::{Proof, Shape};
use super::options::CallOptions;
use super::state::LinkState;
use super::{Link, later};
use crate::command::{Command, Spelling};
use crate::error::{Error, Rounded};

impl Link {
    /// Makes a call of a single request, and waits for its result; `take` takes the reply, where it was
    /// decoded.
    pub(crate) fn call<C: Command, T>(
        &self,
        station: u8,
        request: C,
        options: &CallOptions,
        take: impl FnOnce(&mut Option<C::Reply>) -> Option<T>,
    ) -> impl Future<Output = Result<T, Error>> {
        self.submit_with((station, request), Purpose::Whole, options, take, |result, _| result)
    }

    /// Makes a call, and waits for its result and for what its reply has shown.
    pub(crate) fn submit<C: Command>(
        &self,
        station: u8,
        request: C,
        purpose: Purpose,
        options: &CallOptions,
    ) -> impl Future<Output = CallOutcome<C::Reply>> {
        let (plain, framing) = (request.plain(), self.framing());
        self.submit_with((station, request), purpose, options, Option::take, move |result, ended| {
            let spelling = ended.as_ref().map_or(plain, |ended| ended.call.spelling());
            CallOutcome {
                result,
                spelling,
                replied_at: ended.as_ref().and_then(|ended| ended.replied_at),
                shape: ended.as_ref().map_or(Shape { code: plain.code, size: 0 }, |ended| ended.call.shape(framing)),
                proof: ended.map_or(Proof::default(), |ended| ended.call.proof()),
            }
        })
    }

    /// Makes a call, and waits for its result. `take` takes the reply, where it was decoded; `outcome`
    /// makes the output from the result and from the call, unless that was not made or no task runs.
    // The request is moved on before the first await: this future is part of the caller's, of which
    // there may be thousands.
    async fn submit_with<C: Command, T, R>(
        &self,
        (station, request): (u8, C),
        purpose: Purpose,
        options: &CallOptions,
        take: impl FnOnce(&mut Option<C::Reply>) -> Option<T>,
        outcome: impl FnOnce(Result<T, Error>, Option<EndedCall<'_, C>>) -> R,
    ) -> R {
        let queued_at = Instant::now();
        let deadline = later(queued_at, options.call_timeout);
        let checked = request.check(self.framing()).map_err(Error::from);
        let runtime = match checked.and_then(|()| self.prepare()) {
            Ok(runtime) => runtime,
            Err(error) => return outcome(Err(error), None),
        };
        let meta = CallMeta {
            station,
            code: C::CODE,
            lane: options.lane(C::CODE.class()),
            deadline,
            queued_at,
            confirms: purpose == Purpose::Confirm,
            plain: request.plain(),
        };
        let sending = Sending {
            response_timeout: options.response_timeout.unwrap_or(self.inner.config.response_timeout),
            adaptive: options.adaptive,
            part: purpose == Purpose::Part,
        };
        let (call, mut future) = call::new(request, meta, sending, options);
        future.set_timer(deadline, runtime);
        // Lasts until the call has ended.
        let span = spans_are_on()
            .then(|| tracing::debug_span!("call", link = %self.inner.name, station, command = C::CODE.name()));
        // Work for the link may also serve calls of others, so it runs in the link's span.
        if span.is_some() {
            self.span().in_scope(|| self.inner.shared.submit(call));
        } else {
            self.inner.shared.submit(call);
        }
        // The runtime of the task may have ended just before.
        if !self.inner.shared.is_started(false)
            && let Err(error) = self.start()
        {
            return outcome(Err(error), None);
        }
        // A call may be ready at once: a broadcast is done when it is written. Other tasks must run
        // all the same.
        consume_budget().await;
        let ended = future.ended_by(deadline).await || ends_late(&future).await;
        drop(span);
        let (mut result, replied_at) = if ended {
            future.take_result(take)
        } else {
            future.abandon();
            (Err(future.unanswered(queued_at.elapsed())), None)
        };
        if result.is_err() {
            result = result.map_err(|error| self.explain(error, deadline));
        }
        let outcome = outcome(result, Some(EndedCall { call: &future, replied_at }));
        future.recycle();
        outcome
    }

    /// Replaces a timeout by the connection's error if the call waited for the connection until its
    /// deadline.
    fn explain(&self, error: Error, deadline: Instant) -> Error {
        let Error::Timeout { after, sent, .. } = error else { return error };
        // Before its deadline a call times out because its station is silent, not because of the
        // connection.
        if Instant::now() < deadline {
            return error;
        }
        let still = |doing: &str| {
            Arc::new(io::Error::new(io::ErrorKind::TimedOut, format!("still {doing} after {}", Rounded(after))))
        };
        let source = match self.inner.state.get() {
            LinkState::Down { error } => error,
            LinkState::Connecting => still("connecting"),
            LinkState::Waiting => still("waiting for other connections to be opened"),
            LinkState::Idle | LinkState::Up | LinkState::Closed => return error,
        };
        Error::Connect { endpoint: self.inner.name.to_string(), source, sent }
    }

    /// Starts the task if it does not run. Returns the caller's runtime.
    ///
    /// # Errors
    /// [`Error::Connect`]: the caller is in no runtime. A started task does not need it, but the timer of a
    /// call does.
    fn prepare(&self) -> Result<Id, Error> {
        let runtime = Handle::try_current().map_err(|error| self.no_runtime(error))?.id();
        if !self.inner.shared.is_started(false) {
            self.start()?;
        }
        Ok(runtime)
    }

    /// Starts the task with the first call, and with the first one after its runtime has ended.
    fn start(&self) -> Result<(), Error> {
        // Fails before the task is taken, so that a caller without a runtime does not use it up.
        let runtime = Handle::try_current().map_err(|error| self.no_runtime(error))?;
        if !self.inner.shared.is_started(false) && !self.inner.shared.is_started(true) {
            let (task, span) = (self.inner.shared.clone().run(), self.span());
            if span.is_none() {
                runtime.spawn(task);
            } else {
                runtime.spawn(task.instrument(span));
            }
        }
        Ok(())
    }

    /// The span of events that concern the link; its task and its callers emit them.
    fn span(&self) -> tracing::Span {
        tracing::debug_span!(parent: None, "link", name = %self.inner.name)
    }

    fn no_runtime(&self, error: TryCurrentError) -> Error {
        self.connect_error(Arc::new(io::Error::other(error)))
    }

    fn connect_error(&self, source: Arc<io::Error>) -> Error {
        Error::Connect { endpoint: self.inner.name.to_string(), source, sent: false }
    }
}

/// Returns whether a subscriber may want the spans of calls. Mostly none does, and to make and enter
/// two spans in vain costs a call more than this. With the feature `log` of `tracing` and no subscriber,
/// events are logged and these spans are not.
fn spans_are_on() -> bool {
    LevelFilter::current() >= LevelFilter::DEBUG
}

/// How often the runtime looks for events after the deadline of a call: once for the caller, and
/// once more for the link's task.
const LOOKS_AT_DEADLINE: u32 = 3;

/// Waits a little longer for a call whose deadline has passed; returns whether it has ended. This process
/// may have been stopped until now, with the reply in the socket: the runtime looks for events, and then
/// the link's task reads it.
#[cold]
async fn ends_late<C: Command>(call: &CallFuture<C>) -> bool {
    for _ in 0..LOOKS_AT_DEADLINE {
        yield_now().await;
        if call.has_ended() {
            return true;
        }
    }
    false
}

/// Purpose of a call.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Purpose {
    /// A single request, a broadcast, or a request of a [`job`](super::job).
    Whole,
    /// A request of a longer read or write, which is a job. A spelling may leave elements to the
    /// next one.
    Part,
    /// The confirmation of earlier results. The request itself is never sent.
    Confirm,
}

/// The result of a call, and what its reply has shown, as a job needs it.
pub(crate) struct CallOutcome<T> {
    pub(crate) result: Result<T, Error>,
    /// When the reply came, if there was one.
    pub(crate) replied_at: Option<Instant>,
    /// The spelling that was sent.
    pub(crate) spelling: Spelling,
    /// Shape of the positive reply to that spelling; of size 0 if no call was made.
    pub(crate) shape: Shape,
    /// The station's proof when the reply was taken.
    pub(crate) proof: Proof,
}

/// A call that has ended, for its output.
struct EndedCall<'a, C: Command> {
    call: &'a CallFuture<C>,
    /// When the reply came, if there was one.
    replied_at: Option<Instant>,
}
