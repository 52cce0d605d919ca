//! The callers: call after call, with pauses. Some use the link of their line; guests come by a pool to one line after the
//! other, so that its links come and go.

use std::sync::Arc;
use std::time::Duration;

use fatek::{CallOptions, Pool, Station};
use tokio::time::{Instant, sleep, timeout};
use tokio_util::sync::CancellationToken;

use crate::Result;
use crate::calls::Call;
use crate::dice::Dice;
use crate::line::{self, Line, OFTEN_LATE};
use crate::tally::count;

/// How much later than its deadline a call may end: it must end, but the machine has other things to do.
const GRACE: Duration = Duration::from_secs(30);

pub(crate) struct Caller {
    /// The lines that are asked.
    pub(crate) lines: Vec<Arc<Line>>,
    pub(crate) way: Way,
    /// Which caller of each line it is.
    pub(crate) number: usize,
    /// The mean pause between two calls.
    pub(crate) pause: Duration,
    pub(crate) dice: Dice,
}

/// How a caller gets its stations.
pub(crate) enum Way {
    /// Of the link of the line.
    Link,
    /// Of a pool.
    Pool(Pool),
}

impl Way {
    /// A small one, whose links are soon forgotten and soon idle.
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
    /// Calls until it is stopped.
    pub(crate) async fn run(mut self, stop: CancellationToken) -> Result<()> {
        while !stop.is_cancelled() {
            self.wait(&stop).await;
            let line = self.lines[self.dice.below(self.lines.len())].clone();
            let _no_audit = line.calls.read().await;
            self.call(&line).await?;
        }
        if let Way::Pool(pool) = self.way {
            pool.close().await;
        }
        Ok(())
    }

    async fn wait(&mut self, stop: &CancellationToken) {
        let pause = self.dice.millis(0, 2 * self.pause.as_millis() as usize + 1);
        let pause = match &self.way {
            // Long enough for the links to fall idle.
            Way::Pool(_) if self.dice.percent(5) => pause + Duration::from_secs(1),
            Way::Link | Way::Pool(_) => pause,
        };
        tokio::select! {
            () = stop.cancelled() => {}
            () = sleep(pause) => {}
        }
        if matches!(self.way, Way::Pool(_)) && self.dice.percent(1) {
            let seed = self.dice.roll();
            if let Way::Pool(old) = std::mem::replace(&mut self.way, Way::pool(seed)) {
                old.close().await;
            }
        }
    }

    async fn call(&mut self, line: &Line) -> Result<()> {
        // What is often late is asked most, so that a late reply can do harm.
        let n = if self.dice.percent(40) { self.dice.below(OFTEN_LATE) } else { self.dice.below(line.stations.len()) };
        let n = n.min(line.stations.len() - 1);
        let (options, deadline) = self.options();
        let station = self.way.station(line, n)?.with_options(options);
        let dice = self.dice.fork(n as u64);
        let call = Call { line, n, station, caller: self.number, dice };
        let patience = match self.dice.percent(3) {
            true => self.dice.millis(0, 60),
            // A read of many registers is two calls.
            false => 2 * deadline + GRACE,
        };
        count(&line.tally.calls, 1);
        let began = Instant::now();
        match timeout(patience, call.make()).await {
            Ok(ended) => match ended? {
                Ok(()) => count(&line.tally.confirmed, 1),
                Err(error) => line.tally.failed(&error),
            },
            Err(_) if patience > GRACE => line.wrong(n, &format!("a call has not ended after {:?}", began.elapsed())),
            Err(_) => count(&line.tally.cancelled, 1),
        }
        Ok(())
    }

    /// Options at random, and the deadline among them.
    fn options(&mut self) -> (CallOptions, Duration) {
        let deadline = self.dice.millis(500, 4_000);
        let options = CallOptions::new()
            .response_timeout(line::RESPONSE_TIMEOUT)
            .call_timeout(deadline)
            .retries(self.dice.below(4) as u32)
            .background(self.dice.percent(30));
        let adaptive = self.dice.percent(20);
        (if adaptive { options.adaptive_timeout(Duration::from_millis(50)) } else { options }, deadline)
    }
}
