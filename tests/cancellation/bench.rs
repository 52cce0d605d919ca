//! Fixture of the cancellation tests: a bus, a link, the obstacles that delay a call, and the means
//! to cancel it.

use std::future::{Future, poll_fn};
use std::task::Poll;
use std::time::Duration;

use fatek::command::{ControlDiscrete, DiscreteControl, Request};
use fatek::endpoint::InStepSettings;
use fatek::sim::{self, Bus, Fault, Faults, Line, Plc, Rule};
use fatek::wire::Framing;
use fatek::{Error, Link, LinkState, Station};
use futures::FutureExt;
use futures::future::BoxFuture;
use tokio::runtime::Builder;
use tokio::task::JoinHandle;
use tokio::time::sleep;

use crate::elements::{d, m, page, word, words, x};

/// Time to open a connection, and response time of the PLC.
pub(crate) const DELAY: Duration = Duration::from_millis(2);
pub(crate) const RESPONSE_TIMEOUT: Duration = Duration::from_millis(10);

/// A call; its result is the debug text of the reply.
pub(crate) type Call = BoxFuture<'static, Result<String, Error>>;

/// Cause of a delay of the call.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Obstacle {
    /// The connection is being opened.
    Opening,
    /// Another call to the same station is in flight.
    Busy,
    /// Many calls to the other station are queued, and one is in flight.
    Crowded,
    /// A read has timed out. Its late reply comes while the check is in flight.
    SuspectStation,
    /// The next request is executed, but its reply is lost.
    Unanswered,
}

/// How far a call has proceeded.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Stage {
    Unpolled,
    /// Polled, not sent.
    Queued,
    Connecting,
    /// The check is, or was, in flight.
    Checked,
    Sent,
    /// Executed by the PLC, with the reply on the way.
    Executed,
    /// The reply has arrived, and the caller has not been polled yet.
    Replied,
}

/// A bus with stations 1 and 2, and a link that is not open yet.
pub(crate) struct Bench {
    pub(crate) link: Link,
    pub(crate) plcs: [Plc; 2],
    pub(crate) faults: Faults,
}

/// Counters of station 1 and of the link.
#[derive(Clone, Copy)]
pub(crate) struct Counters {
    pub(crate) requests: u64,
    pub(crate) replies: u64,
    /// Requests without reply or timeout.
    pub(crate) outstanding: u64,
    pub(crate) checks: u64,
    pub(crate) broadcasts: u64,
}

impl Bench {
    pub(crate) fn new(framing: Framing) -> Self {
        let plcs = [Plc::new(), Plc::new()];
        for (station, plc) in (1..).zip(&plcs) {
            for address in [0, 100, 200, 300, 500].into_iter().flat_map(|first| first..first + 4) {
                plc.write(d(address), word(station, address)).unwrap();
            }
        }
        let plc = &plcs[0];
        for n in [1, 2] {
            let nth = 17 * n - 1; // the first of the first three, the second of the second three
            plc.execute(&ControlDiscrete::new(DiscreteControl::Disable, x(nth))).unwrap();
            plc.write(m(nth), true).unwrap();
            plc.set_page(n, page(n)).unwrap();
        }
        let faults = Faults::new(1).line(Line::new(0).response_time(DELAY, DELAY)).rule(in_two_pieces());
        let [first, second] = plcs.clone();
        let bus = Bus::new().with_station(1, first).unwrap().with_station(2, second).unwrap();
        let mut connect = sim::connector(bus.with_faults(faults.clone()), framing);
        let slowly = move || {
            let connected = connect();
            async move {
                sleep(DELAY).await;
                connected.await
            }
        };
        // Each request has one spelling, so that its arrivals can be counted.
        let in_step = InStepSettings::new().with_copies(0).unwrap();
        let builder = Link::connector_builder("a bench", framing, slowly).in_step(in_step);
        let link = builder.response_timeout(RESPONSE_TIMEOUT).build();
        Self { link, plcs, faults }
    }

    /// Sets up the obstacle, and returns the calls that it needs.
    pub(crate) async fn set_up(&self, obstacle: Obstacle) -> Vec<JoinHandle<Result<Vec<u16>, Error>>> {
        if obstacle == Obstacle::Opening {
            return Vec::new();
        }
        // The first check of the station is done here.
        assert_eq!(self.station().read_registers(d(0), 3).await.unwrap(), words(0));
        if obstacle == Obstacle::Crowded {
            return self.queue_many_calls().await;
        }
        match obstacle {
            Obstacle::Busy => {
                let call = self.read(1, 300);
                sleep(DELAY / 2).await;
                vec![call]
            }
            Obstacle::SuspectStation => {
                let late = Fault::Delay { min: RESPONSE_TIMEOUT, max: RESPONSE_TIMEOUT };
                self.faults.add_rule(Rule::new(late).times(1));
                let once = self.station().with_options(self.station().options().with_retries(0));
                assert!(matches!(once.read_registers(d(0), 3).await, Err(Error::Timeout { .. })));
                Vec::new()
            }
            _ => {
                self.faults.add_rule(Rule::new(Fault::DropReply).times(1));
                Vec::new()
            }
        }
    }

    /// Queues many calls to station 2, one of them in flight.
    pub(crate) async fn queue_many_calls(&self) -> Vec<JoinHandle<Result<Vec<u16>, Error>>> {
        self.link.station(2).unwrap().read_registers(d(300), 3).await.unwrap();
        let before = self.link.stats().stations.requests;
        let calls: Vec<_> = (0..70).map(|_| self.read(2, 300)).collect();
        for _ in &calls {
            tick().await;
        }
        assert_eq!(self.link.stats().stations.requests, before + 1, "one is in flight");
        calls
    }

    pub(crate) fn station(&self) -> Station {
        station(&self.link)
    }

    pub(crate) fn read(&self, station: u8, first: u16) -> JoinHandle<Result<Vec<u16>, Error>> {
        let station = self.link.station(station).unwrap();
        tokio::spawn(async move { station.read_registers(d(first), 3).await })
    }

    pub(crate) fn counters(&self) -> Counters {
        let (station, link) = (self.station().stats(), self.link.stats());
        let outstanding = station.requests - station.replies - station.timeouts;
        let (requests, replies, checks) = (station.requests, station.replies, station.checks);
        Counters { requests, replies, outstanding, checks, broadcasts: link.broadcasts }
    }

    pub(crate) fn stage(&self, request: &Request, before: Counters, after: Counters) -> Stage {
        let is_sent = after.requests > before.requests || after.broadcasts > before.broadcasts;
        match self.link.state() {
            _ if is_sent && after.outstanding == 0 && after.replies > before.replies => Stage::Replied,
            _ if after.checks > before.checks && after.outstanding == 0 => Stage::Checked,
            _ if self.log_of(request).iter().any(|entry| entry.executed) => Stage::Executed,
            _ if is_sent => Stage::Sent,
            LinkState::Connecting => Stage::Connecting,
            _ => Stage::Queued,
        }
    }

    /// Arrivals of a request at any station.
    pub(crate) fn log_of(&self, request: &Request) -> Vec<sim::LogEntry> {
        let log = self.faults.log().entries();
        log.into_iter().filter(|entry| entry.request() == Some(request)).collect()
    }
}

/// Polls a call `polls` times, with one step of the other tasks after each. Then drops it and
/// returns `None`.
pub(crate) async fn cancel_after(mut call: Call, polls: u32) -> Option<Result<String, Error>> {
    for nth in 0..polls {
        if let Poll::Ready(result) = poll_once(&mut call).await {
            return Some(result);
        }
        step(nth).await;
    }
    None
}

pub(crate) async fn poll_once(call: &mut Call) -> Poll<Result<String, Error>> {
    poll_fn(|cx| Poll::Ready(call.as_mut().poll(cx))).await
}

/// Lets the other tasks proceed: not at all after the first poll, so that the call is still on its
/// way to the link's task; later by one task, or every fourth time by a millisecond.
async fn step(nth: u32) {
    match nth {
        0 => {}
        nth if nth % 4 == 0 => sleep(Duration::from_millis(1)).await,
        _ => tick().await,
    }
}

/// Runs one other task once; needs the runtime of [`paused`].
pub(crate) async fn tick() {
    let mut is_over = false;
    poll_fn(|cx| {
        if is_over {
            return Poll::Ready(());
        }
        is_over = true;
        cx.waker().wake_by_ref();
        Poll::Pending
    })
    .await;
}

/// Runs a test with a paused clock, in a runtime that polls one task at a time.
pub(crate) fn paused(test: impl Future<Output = ()>) {
    Builder::new_current_thread().enable_all().start_paused(true).event_interval(1).build().unwrap().block_on(test);
}

pub(crate) fn close_call(link: &Link) -> Call {
    let link = link.clone();
    async move {
        link.close().await;
        Ok(String::new())
    }
    .boxed()
}

pub(crate) fn station(link: &Link) -> Station {
    link.station(1).unwrap()
}

/// Splits replies, so that a call can be dropped between the halves.
pub(crate) fn in_two_pieces() -> Rule {
    Rule::new(Fault::Split { pieces: 2, pause: Duration::from_millis(1) })
}
