//! The task of one station: moves requests, replies and time, and decides nothing.

use std::sync::Arc;

use tokio::sync::Notify;
use tokio::time::{Instant, timeout_at};

use super::device::{Answer, Device, Step};
use super::{Sample, Shared, Stamp, Unit};
use crate::command::LoopBack;
use crate::link::{CallOutcome, Purpose};

/// Ends the unit with the task, whatever ends it: what is not polled any more must not pass for being so.
struct Ending(Arc<Shared>, Arc<Unit>);

impl Drop for Ending {
    fn drop(&mut self) {
        self.0.end(&self.1);
    }
}

/// Polls until the unit is stopped.
pub(super) async fn run(shared: Arc<Shared>, unit: Arc<Unit>) {
    let ending = Ending(shared, unit);
    let Ending(shared, unit) = &ending;
    loop {
        let step = advance(shared, unit, Device::next);
        match step {
            None => return,
            Some(Step::Wait(until)) => changed_or_at(&unit.changed, until).await,
            Some(Step::Read(request)) => {
                let Some(answered) = answer(shared, unit, request.call_in_cycle(&unit.station)).await else { return };
                let CallOutcome { result, replied_at: at, shape, proof, .. } = answered;
                let trip = unit.station.stats().round_trip.map(|trip| trip.last);
                let at = Stamp::of(at.unwrap_or_else(Instant::now));
                let answer = Answer { result, at, trip, shape, proof };
                let repeated = advance(shared, unit, |device, _, samples| device.done(answer, samples));
                count_repeated(unit, repeated);
            }
            Some(Step::Confirm) => {
                let check = unit.station.submit(LoopBack::empty(), Purpose::Confirm(()));
                let Some(CallOutcome { result, proof, .. }) = answer(shared, unit, check).await else { return };
                let result = result.map(|()| proof);
                let repeated = advance(shared, unit, |device, now, samples| device.confirmed(result, now, samples));
                count_repeated(unit, repeated);
            }
        }
    }
}

fn count_repeated(unit: &Unit, repeated: Option<bool>) {
    if repeated == Some(true) {
        tracing::debug!(
            station = unit.station.number(),
            "an unexpected frame came within a cycle: its values are dropped"
        );
        unit.station.link().shared_stats().count_repeated_job(unit.station.number());
    }
}

/// Waits for an answer, and lets values get old meanwhile. `None`: the unit was stopped.
async fn answer<T>(shared: &Shared, unit: &Unit, call: impl Future<Output = T>) -> Option<T> {
    // By itself, so that a task that waits for its next cycle, as it does nearly always, has no room for it.
    let mut call = Box::pin(call);
    loop {
        let ages_at = unit.with(|device| device.ages_at())?;
        tokio::select! {
            biased;
            answered = &mut call => return Some(answered),
            () = changed_or_at(&unit.changed, ages_at) => advance(shared, unit, Device::age)?,
        }
    }
}

/// Lets the device do something now, and gives its samples away. `None`: it has been stopped.
fn advance<T>(shared: &Shared, unit: &Unit, act: impl FnOnce(&mut Device, Stamp, &mut Vec<Sample>) -> T) -> Option<T> {
    unit.with(|device| shared.give(|samples| act(device, Stamp::now(), samples)))
}

async fn changed_or_at(changed: &Notify, at: Option<Instant>) {
    let Some(at) = at else { return changed.notified().await };
    // It does not matter which of the two it was.
    let _ = timeout_at(at, changed.notified()).await;
}
