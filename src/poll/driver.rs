//! The task of one station: moves requests, replies and time, and decides nothing.

use std::sync::Arc;

use tokio::sync::Notify;
use tokio::time::{Instant, timeout_at};

use super::device::{Device, Step};
use super::{Sample, Shared, Stamp, Unit};
use crate::error::Error;
use crate::plan::{ReadRequest, Reply};

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
                let Some((result, at)) = answer(shared, unit, &request).await else { return };
                let trip = unit.station.stats().round_trip.map(|trip| trip.last);
                advance(shared, unit, |device, _, samples| device.done(result, at, trip, samples));
            }
        }
    }
}

/// Sends a request, and lets values get old while it is on its way. `None`: the unit was stopped meanwhile.
async fn answer(shared: &Shared, unit: &Unit, request: &ReadRequest) -> Option<(Result<Reply, Error>, Stamp)> {
    // By itself, so that a task that waits for its next cycle, as it does nearly always, has no room for it.
    let mut call = Box::pin(request.timed_call(&unit.station));
    loop {
        let ages_at = unit.with(|device| device.ages_at())?;
        tokio::select! {
            biased;
            (result, at) = &mut call => return Some((result, Stamp::of(at))),
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
