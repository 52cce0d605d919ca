//! One [`Poller`] for all PLCs, and the task that consumes its samples.

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
use crate::counters::Counters;
use crate::options::Options;
use crate::plc;

/// Running poller and its consumer.
pub(crate) struct Polling {
    handle: PollerHandle,
    consumer: JoinHandle<()>,
}

/// Starts to poll the PLCs at these addresses. Their cycles are spread over the interval.
pub(crate) fn start(
    pool: &Pool,
    addresses: impl Iterator<Item = SocketAddr>,
    options: &Options,
    counters: &Arc<Counters>,
) -> Result<Polling> {
    let poller = Poller::builder().seed(1).build();
    let class = ScanClass::every(options.interval);
    let registers = Tag::new(plc::FIRST, TagType::U16, plc::COUNT)?;
    // The first call includes the wait for the rate limit of connects.
    let call_options = CallOptions::new().with_call_timeout(options.start_timeout());
    let mut stations = Vec::with_capacity(options.plcs as usize);
    for (n, address) in (0..).zip(addresses) {
        let station = pool.station(address, 1)?.with_options(call_options);
        poller.station(&station)?.add(class, [PollTag::new(n.to_string(), registers)])?;
        stations.push(Polled { n, link: station.link().clone(), last: None });
    }
    let handle = poller.handle();
    let consumer = Consumer { stations, interval: options.interval, counters: counters.clone() };
    Ok(Polling { handle, consumer: tokio::spawn(consumer.run(poller)) })
}

impl Polling {
    pub(crate) fn handle(&self) -> PollerHandle {
        self.handle.clone()
    }

    /// Stops the poller and waits for the consumer.
    pub(crate) async fn stop(self) -> Result<()> {
        self.handle.close().await;
        Ok(self.consumer.await?)
    }
}

/// State of one PLC in the consumer.
struct Polled {
    n: u32,
    link: Link,
    /// Time of the last good sample.
    last: Option<Instant>,
}

struct Consumer {
    stations: Vec<Polled>,
    interval: Duration,
    counters: Arc<Counters>,
}

impl Consumer {
    /// Consumes samples until the poller is closed.
    async fn run(mut self, mut poller: Poller) {
        while let Some(sample) = poller.next().await {
            match sample {
                Ok(sample) => self.consume(&sample),
                Err(missed @ Missed { .. }) => self.counters.missed(&missed),
            }
        }
    }

    fn consume(&mut self, sample: &Sample) {
        let Some(polled) = sample.name.parse().ok().and_then(|n: usize| self.stations.get_mut(n)) else { return };
        match &sample.quality {
            Quality::Good if sample.values() == plc::values(polled.n).map(TagValue::U16) => {
                let round_trip = polled.link.stats().stations.round_trip.map(|times| times.last);
                self.counters.answered(polled.n, round_trip.unwrap_or_default());
                let at = sample.at.instant;
                if polled.last.is_some_and(|last| at - last > self.interval + self.interval / 10) {
                    self.counters.late();
                }
                polled.last = Some(at);
            }
            Quality::Good => self.counters.wrong(polled.n, sample.values()),
            other @ (Quality::Stale(_) | Quality::Bad(_) | _) => {
                polled.last = None;
                self.counters.failed(polled.n, other);
            }
        }
    }
}
