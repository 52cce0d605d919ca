//! The task that performs the outputs of the state machine: it owns the disk, and calls the PLCs.

use std::collections::HashMap;
use std::panic::AssertUnwindSafe;
use std::time::Duration;

use fatek::tag::{Assignment, TagValue};
use fatek::{Pool, Station, Tag};
use futures::FutureExt as _;
use tokio::sync::{mpsc, oneshot};
use tokio::task::JoinSet;
use tokio::time::{Instant, sleep_until};

use super::core::{Core, Output, Received, Target, Write, WriteFailure};
use super::pulse::Place;
use super::reply::Reply;
use super::store::{self, Store};
use super::{Now, WallClock};
use crate::registry::{Plcs, PolledPlc, Registry};

/// The time for one request to a PLC: waiting for its turn and for a connection included.
pub(super) const CALL_TIMEOUT: Duration = Duration::from_secs(5);
/// The time that pulses may last after the close. Longer ones are ended early.
const GRACE: Duration = Duration::from_secs(2);
/// The time in which everything has ended after the close.
const CLOSE_TIMEOUT: Duration = Duration::from_secs(4);

/// A message to the task.
#[derive(Debug)]
pub(super) enum Message {
    Command(Received, oneshot::Sender<Reply>),
    Close,
}

/// The result of a call to a PLC.
enum Called {
    Written(u64, Result<(), WriteFailure>),
    Read(u64, Result<Vec<TagValue>, String>),
}

/// The task.
pub(super) struct Driver {
    core: Core,
    registry: Registry,
    pool: Pool,
    store: Store,
    calls: JoinSet<Called>,
    waiting: HashMap<u64, oneshot::Sender<Reply>>,
    next_call: u64,
    clock: Clock,
}

/// The time for the state machine.
#[derive(Clone, Debug)]
pub(super) struct Clock {
    pub(super) start: Instant,
    pub(super) wall: WallClock,
}

impl Clock {
    pub(super) fn now(&self) -> Now {
        Now { run: self.start.elapsed(), wall: self.wall.milliseconds() }
    }
}

impl Driver {
    pub(super) fn new(core: Core, registry: Registry, pool: Pool, store: Store, clock: Clock) -> Self {
        let (calls, waiting) = (JoinSet::new(), HashMap::new());
        Self { core, registry, pool, store, calls, waiting, next_call: 0, clock }
    }

    /// Runs until it was closed and everything has ended, or until all handles are gone.
    pub(super) async fn run(
        mut self,
        mut messages: mpsc::UnboundedReceiver<Message>,
        mut results: mpsc::UnboundedReceiver<store::Result>,
    ) {
        let (mut close_at, mut is_open) = (None, true);
        self.step(|_, _, _| {});
        while is_open || !self.core.is_idle() {
            let tick_at = self.core.next_deadline().map(|at| self.clock.start + at);
            tokio::select! {
                message = messages.recv(), if is_open => match message {
                    Some(Message::Command(received, reply)) => {
                        let call = self.next_call;
                        self.next_call = self.next_call.saturating_add(1);
                        self.waiting.insert(call, reply);
                        self.step(|core, now, plcs| core.arrived(now, plcs, call, received));
                    }
                    message @ (Some(Message::Close) | None) => {
                        // Messages that were sent before still come, and are refused.
                        messages.close();
                        is_open = message.is_some();
                        close_at.get_or_insert_with(|| Instant::now() + CLOSE_TIMEOUT);
                        self.step(|core, now, _| core.close(now, GRACE));
                    }
                },
                Some(called) = self.calls.join_next(), if !self.calls.is_empty() => match called {
                    Ok(Called::Written(token, result)) => {
                        self.step(|core, now, plcs| core.written(now, plcs, token, result));
                    }
                    Ok(Called::Read(token, result)) => self.step(|core, _, _| core.read(token, result)),
                    // No call is aborted, and a panic is a result.
                    Err(error) => debug_assert!(false, "{error}"),
                },
                Some((token, result)) = results.recv() => {
                    self.step(|core, now, plcs| core.stored(now, plcs, token, result));
                }
                () = until(tick_at) => self.step(|core, now, _| core.tick(now)),
                () = until(close_at) => {
                    tracing::warn!("commands did not end within {CLOSE_TIMEOUT:?}: their results are unknown");
                    break;
                }
            }
        }
        let store = self.store;
        let closed = tokio::task::spawn_blocking(move || store.close());
        // Bounded as well: a disk may hang.
        let _ = tokio::time::timeout(CLOSE_TIMEOUT, closed).await;
    }

    /// Hands an event to the state machine and performs its outputs, all with one configuration.
    fn step(&mut self, event: impl FnOnce(&mut Core, Now, &Plcs)) {
        let registry = self.registry.clone();
        let plcs = registry.read();
        event(&mut self.core, self.clock.now(), &plcs);
        while let Some(output) = self.core.poll_output() {
            self.perform(output, &plcs);
        }
    }

    /// The station of a call; an error tells why there is none.
    fn station(&self, target: &Target, plcs: &Plcs) -> Result<Station, String> {
        match target {
            Target::Plc(name) => {
                let polled = plcs.get(name).ok_or_else(|| "the PLC was removed from the configuration".to_owned())?;
                Ok(polled.station.clone())
            }
            Target::Place(Place { endpoint, station, .. }) => {
                let is_there = |polled: &&PolledPlc| {
                    polled.plc.station() == *station && polled.plc.endpoint().to_string() == *endpoint
                };
                match plcs.iter().find(is_there) {
                    Some(polled) => Ok(polled.station.clone()),
                    None => self.pool.station(endpoint.as_str(), *station).map_err(|error| error.to_string()),
                }
            }
        }
    }

    fn perform(&mut self, output: Output, plcs: &Plcs) {
        match output {
            Output::Store { token, changes } => self.store.put(token, changes),
            Output::Reply { call, reply } => {
                if let Some(sender) = self.waiting.remove(&call) {
                    // The call was dropped.
                    let _ = sender.send(reply);
                }
            }
            Output::Write { token, target, write } => {
                let station = self.station(&target, plcs);
                self.calls.spawn(async move { Called::Written(token, written(send(station, write)).await) });
            }
            Output::Read { token, target, tag } => {
                let station = self.station(&target, plcs);
                self.calls.spawn(async move { Called::Read(token, was_read(read(station, tag)).await) });
            }
        }
    }
}

/// Waits until a time; forever without one.
async fn until(at: Option<Instant>) {
    match at {
        Some(at) => sleep_until(at).await,
        None => std::future::pending().await,
    }
}

/// The error of a call that has panicked.
const PANICKED: &str = "the call has failed: this is a fault of the bridge";

/// The result of a write. After a panic it may have been executed, as after any other fault: the command and the
/// pulse that wait for it go on.
async fn written(call: impl Future<Output = Result<(), WriteFailure>>) -> Result<(), WriteFailure> {
    let panicked = |_| Err(WriteFailure { may_have_executed: true, error: PANICKED.to_owned() });
    AssertUnwindSafe(call).catch_unwind().await.unwrap_or_else(panicked)
}

/// The result of a read.
async fn was_read<T>(call: impl Future<Output = Result<T, String>>) -> Result<T, String> {
    AssertUnwindSafe(call).catch_unwind().await.unwrap_or_else(|_| Err(PANICKED.to_owned()))
}

async fn send(station: Result<Station, String>, write: Write) -> Result<(), WriteFailure> {
    let not_sent = |error: String| WriteFailure { may_have_executed: false, error };
    let station = station.map_err(not_sent)?;
    // It may wait for its turn until it is too old.
    let options =
        station.options().with_call_timeout(write.valid_for.min(CALL_TIMEOUT)).with_retry_writes(write.is_end);
    let station = station.with_options(options);
    let written = if write.tag.is_bits_of_register() {
        let states: Vec<bool> = write.values.iter().map(|value| *value == TagValue::Bool(true)).collect();
        station.modify_bits(write.tag, states).await
    } else {
        let assignment = Assignment::new(write.tag, write.values).map_err(|error| not_sent(error.to_string()))?;
        station.write_all([assignment]).await
    };
    written.map_err(|error| WriteFailure { may_have_executed: error.may_have_executed(), error: error.to_string() })
}

async fn read(station: Result<Station, String>, tag: Tag) -> Result<Vec<TagValue>, String> {
    let station = station?;
    let station = station.with_options(station.options().with_call_timeout(CALL_TIMEOUT));
    station.read(tag).await.map_err(|error| error.to_string())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Without the cure no result came, and the lane of the PLC waited for ever.
    #[tokio::test]
    async fn a_call_that_panics_has_a_result() {
        let failure = written(async { panic!("a fault of a call") }).await.unwrap_err();
        assert!(failure.may_have_executed && failure.error == PANICKED, "{failure:?}");
        assert_eq!(was_read::<()>(async { panic!("a fault of a call") }).await, Err(PANICKED.to_owned()));
    }
}
