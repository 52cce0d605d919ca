//! The audits: from time to time nobody calls, and the memory and the journal of all PLCs of a line are compared with what
//! they must hold.
//!
//! A PLC works its requests off in order. So when it has answered a request that was sent after all others, it has executed
//! those, or never will.

use std::time::Duration;

use fatek::CallOptions;
use fatek::command::Request;
use futures::future::join_all;
use tokio::time::{Instant, sleep, timeout};
use tokio_util::sync::CancellationToken;

use crate::Result;
use crate::layout::{self, Kind, Place};
use crate::line::{self, Line};
use crate::tally::count;

/// What has no answer after this is hung.
pub(crate) const HANG: Duration = Duration::from_secs(60);

/// Audits until it is stopped.
pub(crate) async fn run(line: &Line, every: Duration, stop: CancellationToken) -> Result<()> {
    loop {
        tokio::select! {
            () = stop.cancelled() => return Ok(()),
            () = sleep(every) => {}
        }
        audit(line).await?;
    }
}

/// One audit.
pub(crate) async fn audit(line: &Line) -> Result<()> {
    let Ok(_nobody_calls) = timeout(2 * HANG, line.calls.write()).await else {
        line.wrong(0, "the calls under way have not ended");
        return Ok(());
    };
    // What a guest has just sent and given up comes by another connection.
    sleep(Duration::from_millis(300)).await;
    let all = 0..line.stations.len();
    if join_all(all.clone().map(|n| settle(line, n))).await.contains(&false) {
        return Ok(());
    }
    for n in all {
        memory(line, n)?;
        if !layout::constants_are_whole(line.plc(n)?, line.number, n)? {
            line.wrong(n, "somebody has written to the constants");
        }
    }
    journal(line)?;
    count(&line.tally.audits, 1);
    Ok(())
}

/// Waits until a station has done all that it was asked; says whether it has.
async fn settle(line: &Line, n: usize) -> bool {
    let began = Instant::now();
    let options = CallOptions::new().response_timeout(line::RESPONSE_TIMEOUT);
    while began.elapsed() < HANG {
        let Ok(station) = line.link.station(line.stations[n]) else { break };
        match timeout(HANG, station.with_options(options).read_status()).await {
            Ok(Ok(_)) => return true,
            Ok(Err(_)) => sleep(Duration::from_millis(50)).await,
            Err(_) => break,
        }
    }
    line.wrong(n, &format!("it has not answered for {:?}: {:?}", began.elapsed(), line.link.stats()));
    false
}

/// Every acknowledged write must be there.
fn memory(line: &Line, n: usize) -> Result<()> {
    let plc = line.plc(n)?;
    let now = Instant::now();
    for owner in 0..line.owners {
        for kind in Kind::ALL {
            let place = Place { station: n, owner, kind };
            // A PLC runs or not, whoever it was.
            if kind == Kind::Running && owner != n % line.callers {
                continue;
            }
            let value = place.read(plc)?;
            let checked = line.shadow().check(place, value, now);
            match checked {
                Ok(()) => line.shadow().holds(place, value, now),
                Err(wrong) => line.wrong(n, &format!("its memory: {wrong}")),
            }
        }
    }
    Ok(())
}

/// No write may have been executed more often than it was called for, and no control command less often than confirmed.
fn journal(line: &Line) -> Result<()> {
    let log = line.faults.log();
    if log.unjournaled() > 0 {
        return Err("more writes between two audits than the journal has room for".into());
    }
    let mut shadow = line.shadow();
    let mut wrong = Vec::new();
    let mut judge = |n: usize, request: &Request, times: u64, (least, most): (u64, Option<u64>)| {
        if times < least || most.is_some_and(|most| times > most) {
            let most = most.map_or("any".to_owned(), |most| most.to_string());
            wrong.push((n, format!("{request:?} was executed {times} times, not {least} to {most}")));
        }
    };
    for applied in log.repeated() {
        let n = line.stations.iter().position(|&number| number == applied.station);
        let n = n.ok_or("only stations that are there execute requests")?;
        judge(n, &applied.request, applied.times, shadow.executions(n, &applied.request));
    }
    for (n, request) in shadow.controls() {
        judge(*n, request, log.applied(line.stations[*n], request), shadow.executions(*n, request));
    }
    shadow.forget_executions();
    drop(shadow);
    count(&line.tally.writes, log.writes() as usize);
    log.clear();
    for (n, text) in wrong {
        line.wrong(n, &text);
    }
    Ok(())
}
