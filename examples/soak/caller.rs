//! Callers, which make calls with random pauses. Guests reach the lines by a pool, whose links open
//! and close.

use std::sync::Arc;
use std::time::Duration;

use fatek::{CallOptions, Pool, Station};
use tokio::time::{Instant, sleep, timeout};
use tokio_util::sync::CancellationToken;

use crate::Result;
use crate::calls::Call;
use crate::counters::count;
use crate::line::{self, Line, OFTEN_LATE};
use crate::rng::Rng;

/// Tolerance of call deadlines, for a busy machine.
const GRACE: Duration = Duration::from_secs(30);

pub(crate) struct Caller {
    /// Lines that are called.
    pub(crate) lines: Vec<Arc<Line>>,
    pub(crate) access: Access,
    /// Number of the caller on each line.
    pub(crate) number: usize,
    /// Mean pause between two calls.
    pub(crate) pause: Duration,
    pub(crate) rng: Rng,
}

/// Source of the stations of a caller.
pub(crate) enum Access {
    /// Link of the line.
    Link,
    /// Pool of its own.
    Pool(Pool),
}

impl Access {
    /// Pool with few links and a short idle timeout.
    pub(crate) fn pool(seed: u64) -> Self {
        let pool = Pool::builder().max_endpoints(2).idle_timeout(Duration::from_millis(700)).seed(seed);
        Self::Pool(pool.links(line::configure).build())
    }

    fn station(&self, line: &Line, n: usize) -> Result<Station> {
        let number = line.stations[n];
        match self {
            Self::Link => Ok(line.link.station(number)?),
            Self::Pool(pool) => Ok(pool.station(line.endpoint.clone(), number)?),
        }
    }
}

impl Caller {
    /// Makes calls until `stop`.
    pub(crate) async fn run(mut self, stop: CancellationToken) -> Result<()> {
        while !stop.is_cancelled() {
            self.wait(&stop).await;
            let line = self.lines[self.rng.below(self.lines.len())].clone();
            let _no_audit = line.calls.read().await;
            self.call(&line).await?;
        }
        if let Access::Pool(pool) = self.access {
            pool.close().await;
        }
        Ok(())
    }

    async fn wait(&mut self, stop: &CancellationToken) {
        let pause = self.rng.millis(0, 2 * self.pause.as_millis() as usize + 1);
        let pause = match &self.access {
            // Longer than the idle timeout of the links.
            Access::Pool(_) if self.rng.percent(5) => pause + Duration::from_secs(1),
            Access::Link | Access::Pool(_) => pause,
        };
        tokio::select! {
            () = stop.cancelled() => {}
            () = sleep(pause) => {}
        }
        if matches!(self.access, Access::Pool(_)) && self.rng.percent(1) {
            let seed = self.rng.next_u64();
            if let Access::Pool(old) = std::mem::replace(&mut self.access, Access::pool(seed)) {
                old.close().await;
            }
        }
    }

    async fn call(&mut self, line: &Line) -> Result<()> {
        // Stations with many late replies are called most.
        let n = if self.rng.percent(40) { self.rng.below(OFTEN_LATE) } else { self.rng.below(line.stations.len()) };
        let n = n.min(line.stations.len() - 1);
        let (options, deadline) = self.options();
        let station = self.access.station(line, n)?.with_options(options);
        let rng = self.rng.fork(n as u64);
        let call = Call { line, n, station, caller: self.number, rng };
        let limit = match self.rng.percent(3) {
            // The call is dropped.
            true => self.rng.millis(0, 60),
            // A read of more than 64 registers is two calls.
            false => 2 * deadline + GRACE,
        };
        count(&line.counters.calls, 1);
        let began = Instant::now();
        match timeout(limit, call.make()).await {
            Ok(ended) => match ended? {
                Ok(()) => count(&line.counters.confirmed, 1),
                Err(error) => line.counters.failed(&error),
            },
            Err(_) if limit > GRACE => line.wrong(n, &format!("a call did not end after {:?}", began.elapsed())),
            Err(_) => count(&line.counters.cancelled, 1),
        }
        Ok(())
    }

    /// Returns random options, and their deadline.
    fn options(&mut self) -> (CallOptions, Duration) {
        let deadline = self.rng.millis(500, 4_000);
        let options = CallOptions::new()
            .with_response_timeout(line::RESPONSE_TIMEOUT)
            .with_call_timeout(deadline)
            .with_retries(self.rng.below(4) as u32)
            .with_background(self.rng.percent(30));
        let adaptive = self.rng.percent(20);
        (if adaptive { options.with_adaptive_timeout(Duration::from_millis(50)) } else { options }, deadline)
    }
}
