//! Audits: all calls are paused, and memory and journal of all PLCs of a line are compared with the
//! expected contents.
//!
//! A PLC executes requests in order. After its reply to the last request, all earlier ones have
//! been executed or never will be.

use std::time::Duration;

use fatek::CallOptions;
use fatek::command::Request;
use futures::future::join_all;
use tokio::time::{Instant, sleep, timeout};
use tokio_util::sync::CancellationToken;

use crate::Result;
use crate::counters::count;
use crate::layout::{self, Kind, Place};
use crate::line::{self, Line};

/// Time without a reply after which a call counts as hung.
pub(crate) const HANG: Duration = Duration::from_secs(60);

/// Audits a line periodically until `stop`.
pub(crate) async fn run(line: &Line, interval: Duration, stop: CancellationToken) -> Result<()> {
    loop {
        tokio::select! {
            () = stop.cancelled() => return Ok(()),
            () = sleep(interval) => {}
        }
        audit(line).await?;
    }
}

/// Audits a line once.
pub(crate) async fn audit(line: &Line) -> Result<()> {
    let Ok(_calls_paused) = timeout(2 * HANG, line.calls.write()).await else {
        line.wrong(0, "the calls under way have not ended");
        return Ok(());
    };
    // Requests of dropped guest calls may still arrive on other connections.
    sleep(Duration::from_millis(300)).await;
    let all = 0..line.stations.len();
    if join_all(all.clone().map(|n| settle(line, n))).await.contains(&false) {
        return Ok(());
    }
    for n in all {
        check_memory(line, n)?;
        if !layout::constants_are_whole(line.plc(n)?, line.number, n)? {
            line.wrong(n, "constants were overwritten");
        }
    }
    check_journal(line)?;
    count(&line.counters.audits, 1);
    Ok(())
}

/// Waits until a station has executed all its requests. Returns false after a timeout.
async fn settle(line: &Line, n: usize) -> bool {
    let began = Instant::now();
    let options = CallOptions::new().with_response_timeout(line::RESPONSE_TIMEOUT);
    while began.elapsed() < HANG {
        let Ok(station) = line.link.station(line.stations[n]) else { break };
        match timeout(HANG, station.with_options(options).read_status()).await {
            Ok(Ok(_)) => return true,
            Ok(Err(_)) => sleep(Duration::from_millis(50)).await,
            Err(_) => break,
        }
    }
    line.wrong(n, &format!("no reply for {:?}: {:?}", began.elapsed(), line.link.stats()));
    false
}

/// Checks that the memory has every confirmed write.
fn check_memory(line: &Line, n: usize) -> Result<()> {
    let plc = line.plc(n)?;
    let now = Instant::now();
    for owner in 0..line.owners {
        for kind in Kind::ALL {
            let place = Place { station: n, owner, kind };
            // RUN or STOP belongs to one owner per PLC.
            if kind == Kind::Running && owner != n % line.callers {
                continue;
            }
            let value = place.read(plc)?;
            let checked = line.expected().check(place, value, now);
            match checked {
                Ok(()) => line.expected().holds(place, value, now),
                Err(error) => line.wrong(n, &format!("memory: {error}")),
            }
        }
    }
    Ok(())
}

/// Checks that no write was executed more often than called, and no control command less often than
/// confirmed.
fn check_journal(line: &Line) -> Result<()> {
    let log = line.faults.log();
    if log.unjournaled() > 0 {
        return Err("the journal is too small for the writes between two audits".into());
    }
    let mut expected = line.expected();
    let mut errors = Vec::new();
    let mut check = |n: usize, request: &Request, times: u64, (least, most): (u64, Option<u64>)| {
        if times < least || most.is_some_and(|most| times > most) {
            let most = most.map_or("any".to_owned(), |most| most.to_string());
            errors.push((n, format!("{request:?} was executed {times} times, expected {least} to {most}")));
        }
    };
    for applied in log.repeated() {
        let n = line.stations.iter().position(|&number| number == applied.station);
        let n = n.ok_or("an unknown station has executed a request")?;
        check(n, &applied.request, applied.times, expected.executions(n, &applied.request));
    }
    for (n, request) in expected.controls() {
        check(*n, request, log.applied(line.stations[*n], request), expected.executions(*n, request));
    }
    expected.forget_executions();
    drop(expected);
    count(&line.counters.writes, log.writes() as usize);
    log.clear();
    for (n, text) in errors {
        line.wrong(n, &text);
    }
    Ok(())
}
