//! Injects the faults.

use std::time::{Duration, Instant};

use fatek_bridge::fleet::OrderError;
use tokio::task::block_in_place;
use tokio::time::{sleep, timeout};

use super::campaign::Round;
use super::fleet::Fleet;
use super::plan::{CutEnd, Fault, LEASE, Planned};
use super::proxy::Way;
use super::store::{delete, set_back};

/// The longest wait for an act.
const WAIT: Duration = LEASE;

/// Injects a fault at its moment, and ends it. Returns `false` if its member had no process, or another fault of
/// its kind.
///
/// # Errors
/// A rule beside the requests was broken.
pub(crate) async fn inject(fleet: &Fleet, round: Round, planned: &Planned) -> Result<bool, String> {
    wait_for(fleet, planned).await;
    let member = planned.member;
    match &planned.fault {
        Fault::Kill { again } => {
            {
                let Some(process) = &mut *fleet.members[member].lock().await else { return Ok(false) };
                block_in_place(|| process.kill());
            }
            restart(fleet, member, *again).await;
        }
        Fault::Terminate { again } => {
            let Some(number) = fleet.number(member).await else { return Ok(false) };
            terminate(fleet, member, number).await?;
            if fleet.number(member).await == Some(number) {
                restart(fleet, member, *again).await;
            }
        }
        Fault::Stop { time } => {
            let number = {
                let Some(process) = &mut *fleet.members[member].lock().await else { return Ok(false) };
                if !process.stop() {
                    return Ok(false);
                }
                process.number
            };
            sleep(*time).await;
            if let Some(process) = &mut *fleet.members[member].lock().await
                && process.number == number
            {
                process.resume();
            }
        }
        Fault::Cut { time, up, down, end } => {
            let begins = |way: &mut Way| match end {
                CutEnd::Delivered | CutEnd::ResetLate => (way.up.is_held, way.down.is_held) = (*up, *down),
                CutEnd::Refused => (way.is_refusing, way.resets) = (true, way.resets + 1),
            };
            let ends = |way: &mut Way| {
                way.resets += u64::from(*end == CutEnd::ResetLate);
                (way.up.is_held, way.down.is_held, way.is_refusing) = (false, false, false);
            };
            return Ok(on_way(fleet, member, *time, begins, ends).await);
        }
        Fault::Delay { time, up, down, entries } => {
            let begins = |way: &mut Way| {
                (way.up.delay, way.down.delay, way.down.entry_delay) = (*up, *down, *entries);
            };
            let ends = |way: &mut Way| {
                let zero = Duration::ZERO;
                (way.up.delay, way.down.delay, way.down.entry_delay) = (zero, zero, zero);
            };
            return Ok(on_way(fleet, member, *time, begins, ends).await);
        }
        Fault::Repeat { is_up, count, later } => {
            let Some(process) = &*fleet.members[member].lock().await else { return Ok(false) };
            process.proxy.repeat(*is_up, *count, *later);
        }
        Fault::Move { link } => {
            let is_given = order(fleet.move_link(*link, Some(member))).await;
            sleep(LEASE).await;
            until_given(|| fleet.move_link(*link, None)).await?;
            return Ok(is_given);
        }
        Fault::Drain { time } => {
            let is_given = order(fleet.drain(member, true)).await;
            sleep(*time).await;
            until_given(|| fleet.drain(member, false)).await?;
            return Ok(is_given);
        }
        Fault::Clock { step } => {
            if super::member::faketime().is_none() {
                return Ok(false);
            }
            let Some(process) = &*fleet.members[member].lock().await else { return Ok(false) };
            process.step_clock(*step);
        }
        Fault::Server { down } => {
            fleet.server.lock().await.kill();
            sleep(*down).await;
            block_in_place(|| fleet.server.blocking_lock().run());
            #[cfg(feature = "naive-fleet")]
            if let Some(expiry) = &fleet.expiry {
                expiry.step(LEASE.mul_f64(2.0 * fastrand::f64()));
            }
            fleet.recorder.lock().await.resume(false).await;
        }
        Fault::Delete { again } => delete(fleet, round, *again).await?,
        Fault::SetBack { by, down, is_fresh } => set_back(fleet, round, member, (*by, *down), *is_fresh).await?,
    }
    Ok(true)
}

/// Waits for the moment of a fault. Acts may fail to come.
async fn wait_for(fleet: &Fleet, planned: &Planned) {
    if let Some(act) = planned.moment.act {
        let mut moments = fleet.moments.subscribe();
        let number = fleet.number(planned.member).await;
        let coming = async {
            loop {
                match moments.recv().await {
                    Ok(moment) => {
                        let is_of = !planned.moment.is_own || Some(moment.process) == number;
                        if moment.act == act && is_of {
                            return;
                        }
                    }
                    Err(tokio::sync::broadcast::error::RecvError::Lagged(_)) => {}
                    Err(tokio::sync::broadcast::error::RecvError::Closed) => return,
                }
            }
        };
        let _ = timeout(WAIT, coming).await;
    }
    sleep(planned.moment.after).await;
}

/// Starts a member again after a time.
async fn restart(fleet: &Fleet, member: usize, again: Duration) {
    fleet.retire(member).await;
    sleep(again).await;
    fleet.start(member).await;
}

/// Lets a process leave, if it is still that of its member.
async fn terminate(fleet: &Fleet, member: usize, number: usize) -> Result<(), String> {
    let begin = Instant::now();
    let mut is_sent = false;
    while begin.elapsed() < Duration::from_secs(30) {
        let mut place = fleet.members[member].lock().await;
        let Some(process) = place.as_mut().filter(|process| process.number == number) else { return Ok(()) };
        if !std::mem::replace(&mut is_sent, true) {
            process.terminate();
        }
        if let Some(status) = process.ended() {
            // It may have been killed by another fault.
            return if status.success() || status.code().is_none() {
                Ok(())
            } else {
                Err(format!("it left: {status}"))
            };
        }
        drop(place);
        sleep(Duration::from_millis(5)).await;
    }
    Err("it does not end after SIGTERM".to_owned())
}

/// Changes the way of a member for a time. Returns `false` if the member has no process.
async fn on_way(
    fleet: &Fleet,
    member: usize,
    time: Duration,
    begins: impl FnOnce(&mut Way),
    ends: impl FnOnce(&mut Way),
) -> bool {
    let number = {
        let Some(process) = &*fleet.members[member].lock().await else { return false };
        process.proxy.change(begins);
        process.number
    };
    sleep(time).await;
    // The way of a process that has ended is healed at the end of the round.
    if let Some(process) = &*fleet.members[member].lock().await
        && process.number == number
    {
        process.proxy.change(ends);
    }
    true
}

/// Gives an order, if the server answers soon.
async fn order(giving: impl Future<Output = Result<(), OrderError>>) -> bool {
    timeout(LEASE * 2, giving).await.is_ok_and(|given| given.is_ok())
}

/// Takes an order back.
async fn until_given<F: Future<Output = Result<(), OrderError>>>(give: impl Fn() -> F) -> Result<(), String> {
    let begin = Instant::now();
    while begin.elapsed() < Duration::from_secs(30) {
        if order(give()).await {
            return Ok(());
        }
        sleep(LEASE / 5).await;
    }
    Err("the server takes no order".to_owned())
}
