//! Faults of the store that end the fleet: all members must stop, and say why.

use std::path::Path;
use std::time::{Duration, Instant};

use async_nats::jetstream;
use tokio::task::block_in_place;
use tokio::time::sleep;

use super::campaign::Round;
use super::fleet::{Fleet, id_of};
use super::plan::LEASE;
use super::recorder::STREAM;

/// The exit status of a bridge whose store was deleted or set back.
const STORE_STATUS: i32 = 3;
/// The begin of the reason. A member may find out by revisions, too, that a store was made again.
const WHY: &str = "fleet: the store was ";
/// The time from the loss of the store to the last request, beside the lease: the way of a request.
const MARGIN: Duration = Duration::from_millis(50);

/// Deletes the store, and makes it again.
///
/// # Errors
/// A member went on, or ended without saying why.
pub(crate) async fn delete(fleet: &Fleet, round: Round, again: Duration) -> Result<(), String> {
    let client = fleet.server.lock().await.client().await;
    jetstream::new(client).delete_stream(STREAM).await.unwrap();
    let deleted = Instant::now();
    sleep(again).await;
    fleet.make_store().await;
    fleet.recorder.lock().await.resume(true).await;
    let ended = all_end(fleet, round, None).await;
    let last = fleet.plcs.last().into_iter().flatten().max();
    if let Some(after) =
        last.map(|last| last.saturating_duration_since(deleted)).filter(|after| *after > LEASE + MARGIN)
    {
        return Err(format!("a request came {after:?} after the store was deleted"));
    }
    ended
}

/// Sets the store back by a time. `is_fresh`: the member is killed, and started again with the older store, of which
/// it knows no other state: it may go on.
///
/// # Errors
/// A member went on, or ended without saying why.
pub(crate) async fn set_back(
    fleet: &Fleet,
    round: Round,
    member: usize,
    (by, down): (Duration, Duration),
    is_fresh: bool,
) -> Result<(), String> {
    let older = fleet.folder().join("older");
    let _ = std::fs::remove_dir_all(&older);
    fleet.server.lock().await.kill();
    copy(&fleet.data(), &older);
    block_in_place(|| fleet.server.blocking_lock().run());
    fleet.recorder.lock().await.resume(false).await;
    sleep(by).await;
    if is_fresh && let Some(process) = &mut *fleet.members[member].lock().await {
        block_in_place(|| process.kill());
    }
    // All entries so far are recorded, but for those of the last moment.
    fleet.record().await;
    fleet.server.lock().await.kill();
    std::fs::remove_dir_all(fleet.data()).unwrap();
    std::fs::rename(&older, fleet.data()).unwrap();
    sleep(down).await;
    block_in_place(|| fleet.server.blocking_lock().run());
    if is_fresh {
        fleet.retire(member).await;
        fleet.start(member).await;
    }
    fleet.recorder.lock().await.resume(true).await;
    all_end(fleet, round, is_fresh.then_some(member)).await
}

/// Waits until all members but one have ended, and ends that one.
async fn all_end(fleet: &Fleet, round: Round, fresh: Option<usize>) -> Result<(), String> {
    let mut problem = Ok(());
    for member in (0..round.members).filter(|member| Some(*member) != fresh) {
        let mut place = fleet.members[member].lock().await;
        let Some(process) = place.as_mut() else { continue };
        let status = process.wait().await;
        // Another thread reads it.
        let begin = Instant::now();
        while !process.log().contains(WHY) && begin.elapsed() < LEASE * 4 {
            sleep(Duration::from_millis(5)).await;
        }
        let log = process.log();
        if status.and_then(|status| status.code()) != Some(STORE_STATUS) || !log.contains(WHY) {
            let tail: Vec<&str> = log.lines().rev().take(8).collect();
            problem = Err(format!("{} ended by {status:?}, its log backwards: {tail:#?}", id_of(member)));
            block_in_place(|| process.kill());
        }
        drop(place);
        fleet.retire(member).await;
    }
    if let Some(member) = fresh {
        let begin = Instant::now();
        let polled = fleet.polled_after(begin).await;
        if let Some(process) = &mut *fleet.members[member].lock().await {
            if let Some(status) = process.ended() {
                problem = Err(format!("{} knew no newer state, and ended: {status}\n{}", id_of(member), process.log()));
            } else if let Err(silent) = polled {
                problem = Err(format!("{} goes on alone: {silent}", id_of(member)));
            }
            block_in_place(|| process.kill());
        }
        fleet.retire(member).await;
    }
    problem
}

fn copy(from: &Path, to: &Path) {
    std::fs::create_dir_all(to).unwrap();
    for entry in std::fs::read_dir(from).unwrap() {
        let entry = entry.unwrap();
        let target = to.join(entry.file_name());
        if entry.file_type().unwrap().is_dir() {
            copy(&entry.path(), &target);
        } else {
            std::fs::copy(entry.path(), target).unwrap();
        }
    }
}
