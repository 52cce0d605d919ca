//! A bus, a link to it, and what can be in the way of a call; and how a call is cut off.

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

use crate::memory::{d, m, page, word, words, x};

/// How long the connection takes to open, and the PLC to get to a request.
pub(crate) const A_WHILE: Duration = Duration::from_millis(2);
pub(crate) const RESPONSE_TIMEOUT: Duration = Duration::from_millis(10);

/// A call, its reply in words.
pub(crate) type Call = BoxFuture<'static, Result<String, Error>>;

/// What stands in the way of the call.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Scene {
    /// The connection is not open yet, and takes a while to be.
    Opening,
    /// Another call to the same station is on the wire.
    Busy,
    /// Many calls to the other station wait, and one of them is on the wire.
    Crowded,
    /// A read has timed out, and its late reply comes while the barrier is on the wire.
    Dirty,
    /// What is asked first is done, and not answered.
    Unanswered,
}

/// How far a call has come.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Stage {
    Unpolled,
    /// Polled, but not sent.
    Queued,
    Connecting,
    /// The barrier is, or has been, on the wire.
    Checked,
    Sent,
    /// The PLC has done it, and its reply is on the way.
    Executed,
    /// The reply has come, and nobody has looked at it yet.
    Replied,
}

/// A bus with stations 1 and 2, and a link to it that is not open yet.
pub(crate) struct Bench {
    pub(crate) link: Link,
    pub(crate) plcs: [Plc; 2],
    pub(crate) faults: Faults,
}

/// What the link has done so far, for the first station and for all of them.
#[derive(Clone, Copy)]
pub(crate) struct Progress {
    pub(crate) requests: u64,
    pub(crate) replies: u64,
    /// Requests that may still be answered.
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
        let faults = Faults::new(1).line(Line::new(0).response_time(A_WHILE, A_WHILE)).rule(in_two_pieces());
        let [first, second] = plcs.clone();
        let bus = Bus::new().with_station(1, first).unwrap().with_station(2, second).unwrap();
        let mut connect = sim::connector(bus.with_faults(faults.clone()), framing);
        let slowly = move || {
            let connected = connect();
            async move {
                sleep(A_WHILE).await;
                connected.await
            }
        };
        // Requests are spelt as themselves, so that their arrivals can be counted.
        let in_step = InStepSettings::new().with_copies(0).unwrap();
        let builder = Link::connector_builder("a bench", framing, slowly).in_step(in_step);
        let link = builder.response_timeout(RESPONSE_TIMEOUT).build();
        Self { link, plcs, faults }
    }

    /// Brings about what is to be in the way, and returns the calls that are.
    pub(crate) async fn set(&self, scene: Scene) -> Vec<JoinHandle<Result<Vec<u16>, Error>>> {
        if scene == Scene::Opening {
            return Vec::new();
        }
        // The check that a station gets first is not in its way any more.
        assert_eq!(self.station().read_registers(d(0), 3).await.unwrap(), words(0));
        if scene == Scene::Crowded {
            return self.crowd().await;
        }
        match scene {
            Scene::Busy => {
                let call = self.read(1, 300);
                sleep(A_WHILE / 2).await;
                vec![call]
            }
            Scene::Dirty => {
                let late = Fault::Delay { min: RESPONSE_TIMEOUT, max: RESPONSE_TIMEOUT };
                self.faults.add_rule(Rule::new(late).times(1));
                let once = self.station().with_options(self.station().options().retries(0));
                assert!(matches!(once.read_registers(d(0), 3).await, Err(Error::Timeout { .. })));
                Vec::new()
            }
            _ => {
                self.faults.add_rule(Rule::new(Fault::DropReply).times(1));
                Vec::new()
            }
        }
    }

    /// Many calls to the second station, of which one is on the wire.
    pub(crate) async fn crowd(&self) -> Vec<JoinHandle<Result<Vec<u16>, Error>>> {
        self.link.station(2).unwrap().read_registers(d(300), 3).await.unwrap();
        let before = self.link.stats().stations.requests;
        let calls: Vec<_> = (0..70).map(|_| self.read(2, 300)).collect();
        for _ in &calls {
            tick().await;
        }
        assert_eq!(self.link.stats().stations.requests, before + 1, "one is on the wire");
        calls
    }

    pub(crate) fn station(&self) -> Station {
        station(&self.link)
    }

    pub(crate) fn read(&self, station: u8, first: u16) -> JoinHandle<Result<Vec<u16>, Error>> {
        let station = self.link.station(station).unwrap();
        tokio::spawn(async move { station.read_registers(d(first), 3).await })
    }

    pub(crate) fn progress(&self) -> Progress {
        let (station, link) = (self.station().stats(), self.link.stats());
        let outstanding = station.requests - station.replies - station.timeouts;
        let (requests, replies, checks) = (station.requests, station.replies, station.checks);
        Progress { requests, replies, outstanding, checks, broadcasts: link.broadcasts }
    }

    pub(crate) fn stage(&self, request: &Request, before: Progress, after: Progress) -> Stage {
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

    /// The arrivals of a request, whomever it was for.
    pub(crate) fn log_of(&self, request: &Request) -> Vec<sim::LogEntry> {
        let log = self.faults.log().entries();
        log.into_iter().filter(|entry| entry.request() == Some(request)).collect()
    }
}

/// Polls a call so many times, and each time lets the others make a step. `None`: then it is dropped.
pub(crate) async fn cut_off(mut call: Call, polls: u32) -> Option<Result<String, Error>> {
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

/// First nothing, so that the call is still on its way to the link's task; then three tasks run once each, and then a
/// millisecond passes.
async fn step(nth: u32) {
    match nth {
        0 => {}
        nth if nth % 4 == 0 => sleep(Duration::from_millis(1)).await,
        _ => tick().await,
    }
}

/// Has one other task run once, which it does only in the runtime of [`paused`].
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

/// Runs a test with a paused clock, and not more than one other task before it is its turn again.
pub(crate) fn paused(test: impl Future<Output = ()>) {
    Builder::new_current_thread().enable_all().start_paused(true).event_interval(1).build().unwrap().block_on(test);
}

pub(crate) fn closing(link: &Link) -> Call {
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

/// So that a call can be dropped with half of its reply there.
pub(crate) fn in_two_pieces() -> Rule {
    Rule::new(Fault::Split { pieces: 2, pause: Duration::from_millis(1) })
}
