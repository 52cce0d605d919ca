//! Makes a call over a link: from the request to its result.

use std::future::Future;
use std::io;
use std::sync::Arc;

use tokio::runtime::{Handle, Id, TryCurrentError};
use tokio::task::{consume_budget, yield_now};
use tokio::time::Instant;
use tracing::Instrument;
use tracing::level_filters::LevelFilter;

use super::call::{self, CallMeta, Sending};
use super::in_step::{Proof, Shape};
use super::options::CallOptions;
use super::state::LinkState;
use super::{Link, later};
use crate::command::{Command, Spelling};
use crate::error::{Error, Rounded};

impl Link {
    /// Makes a call, and waits for its result.
    pub(crate) fn submit<C: Command>(
        &self,
        station: u8,
        request: C,
        purpose: Purpose,
        options: &CallOptions,
    ) -> impl Future<Output = CallOutcome<C::Reply>> {
        self.submit_with(station, request, purpose, options, Option::take)
    }

    /// Makes a call, and waits for its result; `take` takes the reply, where it was decoded.
    // The request is moved on before the first await: this future is part of the caller's, of which
    // there may be thousands.
    pub(crate) async fn submit_with<C: Command, T>(
        &self,
        station: u8,
        request: C,
        purpose: Purpose,
        options: &CallOptions,
        take: impl FnOnce(&mut Option<C::Reply>) -> Option<T>,
    ) -> CallOutcome<T> {
        let queued_at = Instant::now();
        let deadline = later(queued_at, options.call_timeout);
        let checked = request.check(self.framing()).map_err(Error::from);
        let runtime = match checked.and_then(|()| self.prepare()) {
            Ok(runtime) => runtime,
            Err(error) => return CallOutcome::none(Err(error), request.plain()),
        };
        let meta = CallMeta {
            station,
            code: C::CODE,
            lane: options.lane(C::CODE.class()),
            deadline,
            queued_at,
            confirms: purpose == Purpose::Confirm,
        };
        let sending = Sending {
            response_timeout: options.response_timeout.unwrap_or(self.inner.config.response_timeout),
            adaptive: options.adaptive,
            part: purpose == Purpose::Part,
        };
        let in_job = matches!(purpose, Purpose::InJob | Purpose::Part);
        let (call, mut future) = call::new(request, meta, sending, options);
        future.set_timer(deadline, runtime);
        // Lasts until the call has ended.
        let span = spans_are_on()
            .then(|| tracing::debug_span!("call", link = %self.inner.name, station, command = C::CODE.name()));
        // Work for the link may also serve calls of others, so it runs in the link's span.
        if spans_are_on() {
            self.span().in_scope(|| self.inner.shared.submit(call));
        } else {
            self.inner.shared.submit(call);
        }
        // The runtime of the task may have ended just before.
        if !self.inner.shared.is_started(false)
            && let Err(error) = self.start()
        {
            return CallOutcome::none(Err(error), future.spelling());
        }
        // A call may be ready at once: a broadcast is done when it is written. Other tasks must run
        // all the same.
        consume_budget().await;
        let mut ended = future.ended_by(deadline).await;
        // This process may have been stopped until now, with the reply in the socket: the runtime
        // looks for events, and then the link's task reads it.
        for _ in 0..LOOKS_AT_DEADLINE {
            if ended {
                break;
            }
            yield_now().await;
            ended = future.has_ended();
        }
        drop(span);
        let spelling = future.spelling();
        let result = if ended {
            future.take_result(take)
        } else {
            future.abandon();
            Err(future.unanswered(queued_at.elapsed()))
        };
        let mut outcome = CallOutcome {
            result,
            replied_at: future.replied_at(),
            spelling,
            shape: if in_job { future.shape(self.framing()) } else { Shape { code: spelling.code, size: 0 } },
            proof: future.proof(),
        };
        if outcome.result.is_err() {
            outcome.result = outcome.result.map_err(|error| self.explain(error, deadline));
        }
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

/// Purpose of a call.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Purpose {
    /// A single request, or a broadcast.
    Whole,
    /// A request of a [`job`](super::job).
    InJob,
    /// A request of a longer read or write, which is a job. A spelling may leave elements to the
    /// next one.
    Part,
    /// The confirmation of earlier results. The request itself is never sent.
    Confirm,
}

/// The result of a call, and what its reply has shown.
pub(crate) struct CallOutcome<T> {
    pub(crate) result: Result<T, Error>,
    /// When the reply came, if there was one.
    pub(crate) replied_at: Option<Instant>,
    /// The spelling that was sent.
    pub(crate) spelling: Spelling,
    /// Shape of the positive reply, within a job.
    pub(crate) shape: Shape,
    /// The station's proof when the reply was taken.
    pub(crate) proof: Proof,
}

impl<T> CallOutcome<T> {
    fn none(result: Result<T, Error>, spelling: Spelling) -> Self {
        Self {
            result,
            replied_at: None,
            spelling,
            shape: Shape { code: spelling.code, size: 0 },
            proof: Proof::default(),
        }
    }
}
