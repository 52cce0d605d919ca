//! The task of one station: passes requests, replies and time to [`StationPoller`], which decides.

use std::sync::Arc;

use tokio::sync::Notify;
use tokio::time::{Instant, timeout_at};

use super::shared::{PollerShared, StationShared};
use super::station_poller::{PollStep, ReadOutcome, StationPoller};
use super::{Sample, Stamp};
use crate::command::LoopBack;
use crate::link::{CallOutcome, Purpose};

/// Stops polling when the task ends for any reason, so that a dead station does not look polled.
struct StopOnDrop {
    shared: Arc<PollerShared>,
    station: Arc<StationShared>,
    /// The task has ended by itself, and not with its runtime.
    finished: bool,
}

impl Drop for StopOnDrop {
    fn drop(&mut self) {
        self.shared.stop(&self.station);
        if !self.finished {
            self.shared.close_if_nothing_is_polled();
        }
    }
}

/// Polls a station until it is stopped.
pub(super) async fn run(shared: Arc<PollerShared>, station: Arc<StationShared>) {
    let mut guard = StopOnDrop { shared, station, finished: false };
    poll_until_stopped(&guard.shared, &guard.station).await;
    guard.finished = true;
}

async fn poll_until_stopped(shared: &PollerShared, station: &StationShared) {
    loop {
        let step = advance(shared, station, StationPoller::next_step);
        let repeated = match step {
            None => return,
            Some(PollStep::Wait(until)) => {
                changed_or_at(&station.changed, until).await;
                continue;
            }
            Some(PollStep::Read(request)) => {
                let read = request.call_in_cycle(&station.handle);
                let Some(answered) = wait_for(shared, station, read).await else { return };
                let CallOutcome { result, replied_at: at, shape, proof, .. } = answered;
                let round_trip = station.handle.stats().round_trip.map(|round_trip| round_trip.last);
                let at = Stamp::of(at.unwrap_or_else(Instant::now));
                let outcome = ReadOutcome { result, at, round_trip, shape, proof };
                advance(shared, station, |poller, _, samples| poller.handle_read(outcome, samples))
            }
            Some(PollStep::Confirm) => {
                let check = station.handle.submit(LoopBack::empty(), Purpose::Confirm);
                let Some(CallOutcome { result, proof, .. }) = wait_for(shared, station, check).await else { return };
                let result = result.map(|()| proof);
                advance(shared, station, |poller, now, samples| poller.handle_check(result, now, samples))
            }
        };
        for learned in station.with(StationPoller::take_learned).into_iter().flatten() {
            station.handle.link().learn_capability(station.handle.number(), learned);
        }
        if repeated == Some(true) {
            let number = station.handle.number();
            tracing::debug!(station = number, "unexpected frame within a poll cycle: its values are dropped");
            station.handle.link().shared_stats().count_repeated_job(number);
        }
    }
}

/// Waits for a call and ages the tags meanwhile; `None` if polling was stopped.
async fn wait_for<T>(shared: &PollerShared, station: &StationShared, call: impl Future<Output = T>) -> Option<T> {
    // Boxed to keep the task small: nearly always it waits for its next cycle, without a call.
    let mut call = Box::pin(call);
    loop {
        let next_aging = station.with(|poller| poller.next_aging())?;
        tokio::select! {
            biased;
            answered = &mut call => return Some(answered),
            () = changed_or_at(&station.changed, next_aging) => advance(shared, station, StationPoller::age)?,
        }
    }
}

/// Runs `act` on the poller now and queues its samples; `None` if polling was stopped.
fn advance<T>(
    shared: &PollerShared,
    station: &StationShared,
    act: impl FnOnce(&mut StationPoller, Stamp, &mut Vec<Sample>) -> T,
) -> Option<T> {
    station.with(|poller| shared.queue_samples(|samples| act(poller, Stamp::now(), samples)))
}

async fn changed_or_at(changed: &Notify, at: Option<Instant>) {
    let Some(at) = at else { return changed.notified().await };
    // The caller evaluates the state in either case.
    let _ = timeout_at(at, changed.notified()).await;
}
