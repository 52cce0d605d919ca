//! The polling: one [`Poller`] for all PLCs, and a task that takes its samples.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use fatek::poll::{Missed, PollTag, Poller, PollerHandle, Quality, Sample, ScanClass};
use fatek::tag::{Tag, TagType, TagValue};
use fatek::{CallOptions, Link, Pool};
use futures::StreamExt;
use tokio::task::JoinHandle;
use tokio::time::Instant;

use crate::Result;
use crate::options::Options;
use crate::plc;
use crate::tally::Tally;

/// What polls until it is stopped.
pub(crate) struct Pollers {
    handle: PollerHandle,
    consumer: JoinHandle<()>,
}

/// Begins to poll PLCs at these addresses, each at its own moment of the interval, so that the load is flat.
pub(crate) fn start(
    pool: &Pool,
    addresses: impl Iterator<Item = SocketAddr>,
    options: &Options,
    tally: &Arc<Tally>,
) -> Result<Pollers> {
    let poller = Poller::builder().seed(1).build();
    let class = ScanClass::every(options.interval);
    let registers = Tag::new(plc::FIRST, TagType::U16, plc::COUNT)?;
    // The first call waits for its turn to connect, and all others have had theirs.
    let patience = CallOptions::new().call_timeout(options.longest_start());
    let mut stations = Vec::with_capacity(options.plcs as usize);
    for (n, address) in (0..).zip(addresses) {
        let station = pool.station(address, 1)?.with_options(patience);
        poller.station(&station)?.add(class, [PollTag::new(n.to_string(), registers)])?;
        stations.push(Polled { n, link: station.link().clone(), last: None });
    }
    let handle = poller.handle();
    let consumer = Consumer { stations, interval: options.interval, tally: tally.clone() };
    Ok(Pollers { handle, consumer: tokio::spawn(consumer.run(poller)) })
}

impl Pollers {
    pub(crate) fn handle(&self) -> PollerHandle {
        self.handle.clone()
    }

    /// Ends it all.
    pub(crate) async fn stop(self) -> Result<()> {
        self.handle.close().await;
        Ok(self.consumer.await?)
    }
}

/// A PLC, as the consumer of the samples sees it.
struct Polled {
    n: u32,
    link: Link,
    /// When its last good sample was read.
    last: Option<Instant>,
}

struct Consumer {
    stations: Vec<Polled>,
    interval: Duration,
    tally: Arc<Tally>,
}

impl Consumer {
    /// Ends with the poller.
    async fn run(mut self, mut poller: Poller) {
        while let Some(sample) = poller.next().await {
            match sample {
                Ok(sample) => self.take(&sample),
                Err(missed @ Missed { .. }) => self.tally.missed(&missed),
            }
        }
    }

    fn take(&mut self, sample: &Sample) {
        let Some(polled) = sample.name.parse().ok().and_then(|n: usize| self.stations.get_mut(n)) else { return };
        match &sample.quality {
            Quality::Good if sample.values() == plc::values(polled.n).map(TagValue::U16) => {
                let trip = polled.link.stats().stations.round_trip.map(|trip| trip.last);
                self.tally.answered(polled.n, trip.unwrap_or_default());
                let at = sample.at.instant;
                if polled.last.is_some_and(|last| at - last > self.interval + self.interval / 10) {
                    self.tally.late();
                }
                polled.last = Some(at);
            }
            Quality::Good => self.tally.wrong(polled.n, sample.values()),
            other @ (Quality::Stale(_) | Quality::Bad(_) | _) => {
                polled.last = None;
                self.tally.failed(polled.n, other);
            }
        }
    }
}
