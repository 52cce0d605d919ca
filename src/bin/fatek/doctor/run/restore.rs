//! Restores the element that a check has written and not restored.

use std::time::Duration;

use tokio::time::timeout;

use super::Runner;
use crate::doctor::check::Undo;
use crate::doctor::exchange::{Answer, Ask, Exchange};
use crate::doctor::line::Connect;
use crate::doctor::request::Request;

/// Longest time of restoring an element: a process that a signal has ended has two seconds.
const UNDO_TIMEOUT: Duration = Duration::from_millis(1500);
/// Attempts: the connection may have a reply in progress, or be lost.
const UNDO_ATTEMPTS: usize = 2;

impl<C: Connect> Runner<'_, C> {
    /// Restores the element that a check has written, if it was not. The error is a write that was not confirmed.
    ///
    /// A write is confirmed by its reply, unless another value is read back.
    pub(crate) async fn undo(&mut self) -> Result<(), Undo> {
        let current = self.current.take();
        let current = current.and_then(|(place, done)| (self.checks.get(place)?.undo)(&self.facts, &done));
        let Some(undo) = current.or_else(|| self.unrestored.take()) else { return Ok(()) };
        let mut is_restored = false;
        let restoring = async {
            for _ in 0..UNDO_ATTEMPTS {
                let (_, is_written) = self.once(&undo.request, Ask::Once).await;
                is_restored = is_written;
                let (value, _) = self.once(&undo.read, Ask::Reply).await;
                is_restored = value.map_or(is_written, |value| value == undo.value);
                if is_restored {
                    return;
                }
            }
        };
        // At the timeout stands the result so far.
        let _ = timeout(UNDO_TIMEOUT, restoring).await;
        if is_restored { Ok(()) } else { Err(undo) }
    }

    /// Sends a request once. Returns the value that it reads, and whether it was executed.
    async fn once(&mut self, request: &Request, ask: fn(Request) -> Ask) -> (Option<u16>, bool) {
        let bytes = self.facts.requests.encode(&request.frame);
        let Ok(attempt) = self.attempt(request, bytes).await else { return (None, false) };
        let exchange = Exchange { ask: ask(request.clone()), attempts: vec![attempt] };
        let answer = exchange.answer(self.facts.framing());
        (self.facts.requests.value(request, answer), matches!(answer, Answer::Data(_)))
    }
}
