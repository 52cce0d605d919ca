//! The polling: a task for each PLC, which reads its registers at a fixed interval.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use fatek::{CallOptions, Pool, Station};
use tokio::sync::watch;
use tokio::task::JoinSet;
use tokio::time::{Instant, sleep_until};

use crate::Result;
use crate::options::Options;
use crate::plc;
use crate::tally::Tally;

/// Tasks that poll until they are stopped.
pub(crate) struct Pollers {
    tasks: JoinSet<()>,
    stop: watch::Sender<bool>,
}

/// Begins to poll PLCs at these addresses, each at its own moment of the interval, so that the load is flat.
pub(crate) fn start(
    pool: &Pool,
    addresses: impl Iterator<Item = SocketAddr>,
    options: &Options,
    tally: &Arc<Tally>,
) -> Result<Pollers> {
    let (stop, stopped) = watch::channel(false);
    let mut tasks = JoinSet::new();
    let began = Instant::now();
    // The first call waits for its turn to connect, and all others have had theirs.
    let patience = CallOptions::new().call_timeout(options.longest_start());
    for (n, address) in (0..).zip(addresses) {
        let station = pool.station(address, 1)?;
        let first_at = began + options.interval.mul_f64(phase(n));
        let poller = Poller { n, station, interval: options.interval, tally: tally.clone() };
        let mut stopped = stopped.clone();
        tasks.spawn(async move {
            tokio::select! {
                () = poller.run(first_at, patience) => {}
                _ = stopped.wait_for(|stop| *stop) => {}
            }
        });
    }
    Ok(Pollers { tasks, stop })
}

impl Pollers {
    /// Ends them all.
    pub(crate) async fn stop(self) {
        self.stop.send_replace(true);
        self.tasks.join_all().await;
    }
}

struct Poller {
    n: u32,
    station: Station,
    interval: Duration,
    tally: Arc<Tally>,
}

impl Poller {
    /// Never ends.
    async fn run(self, first_at: Instant, patience: CallOptions) {
        let mut due = first_at;
        sleep_until(due).await;
        self.poll(&self.station.with_options(patience)).await;
        // Connecting has taken its time, which is nobody's fault.
        due += self.interval * self.intervals_since(due);
        loop {
            due += self.interval;
            let skipped = self.intervals_since(due);
            self.tally.overrun(skipped);
            due += self.interval * skipped;
            sleep_until(due).await;
            if due.elapsed() > self.interval / 10 {
                self.tally.late();
            }
            self.poll(&self.station).await;
        }
    }

    /// How many polls should have begun since then, and not at that time, if it is past.
    fn intervals_since(&self, due: Instant) -> u32 {
        let intervals = due.elapsed().as_nanos().div_ceil(self.interval.as_nanos());
        u32::try_from(intervals).unwrap_or(u32::MAX)
    }

    async fn poll(&self, station: &Station) {
        let began = Instant::now();
        match station.read_registers(plc::FIRST, plc::COUNT).await {
            Ok(values) if values == plc::values(self.n) => self.tally.answered(self.n, began.elapsed()),
            Ok(values) => self.tally.wrong(self.n, &values),
            Err(error) => self.tally.failed(self.n, &error),
        }
    }
}

/// Where in the interval PLC `n` is polled, from 0 to 1: scattered, and the same in every run.
fn phase(n: u32) -> f64 {
    f64::from(n.wrapping_mul(0x9E37_79B9)) / f64::from(u32::MAX)
}
