//! The task of one station: moves requests, replies and time, and decides nothing.

use std::sync::Arc;

use tokio::sync::Notify;
use tokio::time::{Instant, sleep_until};

use super::device::Step;
use super::{Shared, Stamp, Unit};
use crate::error::Error;
use crate::plan::{ReadRequest, Reply};
use crate::station::Station;

/// Polls until the poller or the unit is closed.
pub(super) async fn run(shared: Arc<Shared>, unit: Arc<Unit>, station: Station) {
    let poll = async {
        let mut samples = Vec::new();
        loop {
            let Some(step) = unit.with(|device| {
                let step = device.next(Stamp::now(), &mut samples);
                // Under the same lock as the removal of tags, so that nothing of a tag comes after it.
                shared.queue.push(&mut samples);
                step
            }) else {
                return;
            };
            match step {
                Step::Wait(until) => changed_or_at(&unit.changed, until).await,
                Step::Read(request) => {
                    let (result, at) = answer(&shared, &unit, &station, &request).await;
                    let trip = station.stats().round_trip.map(|trip| trip.last);
                    unit.with(|device| {
                        device.done(result, at, trip, &mut samples);
                        shared.queue.push(&mut samples);
                    });
                }
            }
        }
    };
    tokio::select! {
        biased;
        () = shared.closing.cancelled() => {}
        () = unit.stopping.cancelled() => {}
        () = poll => {}
    }
}

/// Sends a request, and lets values get old while it is on its way.
async fn answer(
    shared: &Shared,
    unit: &Unit,
    station: &Station,
    request: &ReadRequest,
) -> (Result<Reply, Error>, Stamp) {
    let call = request.timed_call(station);
    tokio::pin!(call);
    loop {
        let ages_at = unit.with(|device| device.ages_at()).flatten();
        tokio::select! {
            biased;
            (result, at) = &mut call => return (result, Stamp::of(at)),
            () = changed_or_at(&unit.changed, ages_at) => {
                let mut samples = Vec::new();
                unit.with(|device| {
                    device.age(Stamp::now(), &mut samples);
                    shared.queue.push(&mut samples);
                });
            }
        }
    }
}

async fn changed_or_at(changed: &Notify, at: Option<Instant>) {
    match at {
        Some(at) => tokio::select! {
            () = changed.notified() => {}
            () = sleep_until(at) => {}
        },
        None => changed.notified().await,
    }
}
