//! A call that is dropped at any point of its life harms nobody: what was not sent is never sent, what was sent is done
//! once, and whoever asks next gets their own answer.
//!
//! Every method is cut off after every number of polls until it ends by itself, and between two polls the rest of the
//! runtime does as little as can be: one task runs once, or a millisecond passes.
#![cfg(feature = "sim")]

use std::collections::BTreeSet;
use std::future::{Future, poll_fn};
use std::task::Poll;
use std::time::Duration;

use fatek::command::{
    BriefStatus, ControlDiscrete, ControlPlc, DetailedStatus, DiscreteControl, LoopBack, ProgramPage,
    ReadDetailedStatus, ReadDisabled, ReadDiscretes, ReadMixed, ReadProgramPage, ReadRegisters, ReadStatus, Request,
    WriteDiscretes, WriteMixed, WriteProgramPage, WriteRegisters,
};
use fatek::sim::{self, Bus, Fault, Faults, Line, Plc, Rule};
use fatek::wire::Framing;
use fatek::{Discrete, Error, Link, LinkState, Register, Register32, Station, Symbol, Value};
use futures::FutureExt;
use futures::future::BoxFuture;
use tokio::runtime::Builder;
use tokio::task::JoinHandle;
use tokio::time::sleep;

const FRAMINGS: [Framing; 2] = [Framing::Ascii, Framing::Binary];

/// How long the connection takes to open, and the PLC to get to a request.
const A_WHILE: Duration = Duration::from_millis(2);
const RESPONSE_TIMEOUT: Duration = Duration::from_millis(10);

/// A call, its reply in words.
type Call = BoxFuture<'static, Result<String, Error>>;

/// A method that sends something, called with other arguments each turn, and of the same shape.
struct Method {
    name: &'static str,
    kind: Kind,
    call: fn(&Link, u16) -> Call,
    request: fn(u16) -> Request,
    reply: fn(u16) -> String,
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Kind {
    Read,
    Write,
    Broadcast,
}

macro_rules! methods {
    ($kind:ident by $handle:expr;
     $(|$n:ident| $name:ident($($argument:expr),*) $(seen as $view:ident)?
        => $request:ident($command:expr), $reply:expr;)*) => {
        vec![$(Method {
            name: stringify!($name),
            kind: Kind::$kind,
            call: |link, $n| {
                let _ = $n; // not all have arguments
                let handle = $handle(link);
                async move {
                    let reply = handle.$name($($argument),*).await?;
                    $(let reply = $view(&reply);)?
                    Ok(format!("{reply:?}"))
                }
                .boxed()
            },
            request: |$n| {
                let _ = $n;
                Request::$request($command)
            },
            reply: |$n| {
                let _ = $n;
                format!("{:?}", $reply)
            },
        }),*]
    };
}

fn reads() -> Vec<Method> {
    // The battery is full until the first turn is over.
    methods! { Read by station;
        |n| read_status() seen as brief => ReadStatus(ReadStatus), n == 2;
        |n| read_detailed_status() seen as detailed => ReadDetailedStatus(ReadDetailedStatus), n == 2;
        |n| read_disabled(x(16 * n), 3)
            => ReadDisabled(ReadDisabled::new(x(16 * n), 3).unwrap()), [n == 1, n == 2, false];
        |n| read_discretes(m(16 * n), 3)
            => ReadDiscretes(ReadDiscretes::new(m(16 * n), 3).unwrap()), [n == 1, n == 2, false];
        |n| read_registers(d(100 * n), 3) => ReadRegisters(ReadRegisters::new(d(100 * n), 3).unwrap()), words(100 * n);
        |n| call(ReadRegisters::new(d(100 * n), 3).unwrap())
            => ReadRegisters(ReadRegisters::new(d(100 * n), 3).unwrap()), words(100 * n);
        |n| read_registers32(dd(100 * n), 1)
            => ReadRegisters32(ReadRegisters::new(dd(100 * n), 1).unwrap()), [double(100 * n)];
        |n| read_mixed(&[d(100 * n).into(), dd(100 * n + 1).into()])
            => ReadMixed(ReadMixed::new([d(100 * n).into(), dd(100 * n + 1).into()]).unwrap()),
            [Value::Word(word(1, 100 * n)), Value::Double(double(100 * n + 1))];
        |n| loop_back(format!("turn {n}")) => LoopBack(LoopBack::new(format!("turn {n}")).unwrap()), ();
        |n| read_program_page(n) seen as first_word => ReadProgramPage(ReadProgramPage::new(n)), n;
    }
}

fn writes() -> Vec<Method> {
    methods! { Write by station;
        |n| run() => ControlPlc(ControlPlc::Run), ();
        |n| stop() => ControlPlc(ControlPlc::Stop), ();
        |n| disable(m(n)) => ControlDiscrete(ControlDiscrete::new(DiscreteControl::Disable, m(n))), ();
        |n| enable(m(n)) => ControlDiscrete(ControlDiscrete::new(DiscreteControl::Enable, m(n))), ();
        |n| set(m(n)) => ControlDiscrete(ControlDiscrete::new(DiscreteControl::Set, m(n))), ();
        |n| reset(m(n)) => ControlDiscrete(ControlDiscrete::new(DiscreteControl::Reset, m(n))), ();
        |n| write_discretes(m(n), &[true; 3]) => WriteDiscretes(WriteDiscretes::new(m(n), [true; 3]).unwrap()), ();
        |n| write_registers(r(n), &[n; 3]) => WriteRegisters(WriteRegisters::new(r(n), [n; 3]).unwrap()), ();
        |n| write_registers32(dr(n), &[n.into()])
            => WriteRegisters32(WriteRegisters::new(dr(n), [n.into()]).unwrap()), ();
        |n| write_mixed(&[(r(n).into(), n.into())])
            => WriteMixed(WriteMixed::new([(r(n).into(), n.into())]).unwrap()), ();
        |n| write_program_page(n, &page(n)) => WriteProgramPage(WriteProgramPage::new(n, page(n))), ();
    }
}

fn broadcasts() -> Vec<Method> {
    methods! { Broadcast by Link::broadcast;
        |n| run() => ControlPlc(ControlPlc::Run), ();
        |n| stop() => ControlPlc(ControlPlc::Stop), ();
        |n| control(DiscreteControl::Set, m(n))
            => ControlDiscrete(ControlDiscrete::new(DiscreteControl::Set, m(n))), ();
        |n| write_discretes(m(n), &[true; 3]) => WriteDiscretes(WriteDiscretes::new(m(n), [true; 3]).unwrap()), ();
        |n| write_registers(r(n), &[n; 3]) => WriteRegisters(WriteRegisters::new(r(n), [n; 3]).unwrap()), ();
        |n| write_registers32(dr(n), &[n.into()])
            => WriteRegisters32(WriteRegisters::new(dr(n), [n.into()]).unwrap()), ();
        |n| write_mixed(&[(r(n).into(), n.into())])
            => WriteMixed(WriteMixed::new([(r(n).into(), n.into())]).unwrap()), ();
    }
}

#[test]
fn every_async_method_is_tested_here() {
    let async_methods = |source: &str| -> BTreeSet<String> {
        let names = source.lines().filter_map(|line| line.trim_start().strip_prefix("pub async fn "));
        names.map(|line| line.split(['(', '<']).next().unwrap().to_owned()).collect()
    };
    let names = |methods: Vec<Method>| methods.iter().map(|method| method.name.to_owned()).collect::<BTreeSet<_>>();
    let of_station = include_str!("../src/station.rs");
    assert_eq!(async_methods(of_station), names(reads().into_iter().chain(writes()).collect()));
    assert_eq!(async_methods(include_str!("../src/station/broadcast.rs")), names(broadcasts()));
    assert_eq!(async_methods(include_str!("../src/link/mod.rs")), ["close".to_owned()].into());
}

#[test]
fn a_call_that_is_dropped_while_the_connection_is_opened_harms_nobody() {
    drop_everywhere(Scene::Opening, &[Stage::Queued, Stage::Connecting]);
}

#[test]
fn a_call_that_is_dropped_behind_another_one_harms_nobody() {
    drop_everywhere(Scene::Busy, &[Stage::Queued]);
}

#[test]
fn a_call_that_is_dropped_before_it_has_a_place_in_the_channel_harms_nobody() {
    drop_everywhere(Scene::Crowded, &[Stage::Queued]);
}

#[test]
fn a_call_to_a_dirty_station_that_is_dropped_before_behind_or_with_the_barrier_harms_nobody() {
    drop_everywhere(Scene::Dirty, &[Stage::Queued, Stage::Checked]);
}

#[test]
fn a_call_that_is_dropped_before_or_between_its_retries_harms_nobody() {
    drop_everywhere(Scene::Unanswered, &[Stage::Queued]);
}

#[test]
fn closing_that_is_dropped_at_any_point_closes_all_the_same_once_it_has_begun() {
    paused(async {
        for framing in FRAMINGS {
            for polls in 0.. {
                let bench = Bench::new(framing);
                let in_flight = bench.read(1, 100);
                sleep(A_WHILE * 3 / 2).await;
                let queued = bench.read(1, 200);
                tick().await;
                let ended = cut_off(closing(&bench.link), polls).await.is_some();
                let next = bench.station().read_registers(d(500), 3).await;
                assert_eq!(in_flight.await.unwrap().unwrap(), words(100));
                if polls == 0 {
                    assert_eq!(queued.await.unwrap().unwrap(), words(200));
                    assert_eq!(next.unwrap(), words(500));
                    continue;
                }
                for result in [queued.await.unwrap(), next] {
                    assert!(matches!(result, Err(Error::Closed { sent: false, .. })), "cut {polls}: {result:?}");
                }
                bench.link.close().await;
                assert!(matches!(bench.link.state(), LinkState::Closed));
                assert_eq!(bench.log_of(&Request::ReadRegisters(ReadRegisters::new(d(200), 3).unwrap())).len(), 0);
                if ended {
                    assert!(polls > 10, "{polls}");
                    break;
                }
            }
        }
    });
}

#[test]
fn closing_that_is_dropped_before_it_has_a_place_in_the_channel_closes_nothing() {
    paused(async {
        for framing in FRAMINGS {
            let bench = Bench::new(framing);
            let crowd = bench.crowd().await;
            assert!(cut_off(closing(&bench.link), 1).await.is_none());
            for call in crowd {
                assert_eq!(call.await.unwrap().unwrap().len(), 3);
            }
            assert_eq!(bench.station().read_registers(d(500), 3).await.unwrap(), words(500));
        }
    });
}

#[test]
fn closing_twice_is_closing_once_whoever_gives_up_waiting() {
    paused(async {
        for polls in 0.. {
            let bench = Bench::new(Framing::Ascii);
            let in_flight = bench.read(1, 100);
            sleep(A_WHILE * 3 / 2).await;
            let mut first = closing(&bench.link);
            assert!(poll_once(&mut first).await.is_pending());
            let ended = cut_off(closing(&bench.link), polls).await.is_some();
            first.await.unwrap();
            assert_eq!(in_flight.await.unwrap().unwrap(), words(100));
            assert!(matches!(bench.link.state(), LinkState::Closed));
            if ended {
                assert!(polls > 10, "{polls}");
                break;
            }
        }
    });
}

/// What stands in the way of the call.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Scene {
    /// The connection is not open yet, and takes a while to be.
    Opening,
    /// Another call to the same station is on the wire.
    Busy,
    /// More calls than fit are on their way to the link's task.
    Crowded,
    /// A read has timed out, and its late reply comes while the barrier is on the wire.
    Dirty,
    /// What is asked first is done, and not answered.
    Unanswered,
}

/// How far a call has come.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Stage {
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

/// Cuts every method off at every point; each must come at least through these stages, and those behind them.
fn drop_everywhere(scene: Scene, stages: &[Stage]) {
    paused(async {
        let mut cuts = 0;
        for framing in FRAMINGS {
            let methods = reads().into_iter().chain(writes()).chain(broadcasts());
            for method in methods.filter(|method| framing == Framing::Ascii || !method.name.contains("program_page")) {
                let mut seen = BTreeSet::new();
                let mut polls = 0;
                while let Some(stage) = cut_and_go_on(scene, framing, &method, polls).await {
                    seen.insert(stage);
                    polls += 1;
                }
                cuts += polls;
                let mut expected = BTreeSet::from_iter(stages.iter().copied());
                match (method.kind, scene) {
                    // It ends when it is sent, and no barrier comes before it.
                    (Kind::Broadcast, _) => expected.retain(|&stage| stage < Stage::Checked),
                    (Kind::Write, Scene::Unanswered) => expected.extend([Stage::Sent, Stage::Executed]),
                    (Kind::Read, Scene::Unanswered) => {
                        expected.extend([Stage::Sent, Stage::Executed, Stage::Checked, Stage::Replied]);
                    }
                    _ => expected.extend([Stage::Sent, Stage::Executed, Stage::Replied]),
                }
                assert!(expected.is_subset(&seen), "{scene:?}, {framing}, {}: only {seen:?}", method.name);
                let at_least = if method.kind == Kind::Broadcast { 2 } else { 10 };
                assert!(polls > at_least, "{scene:?}, {framing}, {}: {polls}", method.name);
            }
        }
        println!("{scene:?}: {cuts} cuts");
    });
}

/// Drops a call after so many polls, and does what must work then. Says how far the call had come; `None` when it had
/// ended by itself.
async fn cut_and_go_on(scene: Scene, framing: Framing, method: &Method, polls: u32) -> Option<Stage> {
    let at = format!("{scene:?}, {framing}, {} after {polls}", method.name);
    let bench = Bench::new(framing);
    let earlier = bench.set(scene).await;
    let before = bench.progress();
    let ended = cut_off((method.call)(&bench.link, 1), polls).await;
    let after = bench.progress();
    let stage = if polls == 0 { Stage::Unpolled } else { bench.stage(&(method.request)(1), before, after) };
    match &ended {
        None => {}
        // Sent, and never answered.
        Some(Err(error)) if scene == Scene::Unanswered && method.kind == Kind::Write => {
            assert!(matches!(error, Error::Timeout { .. }) && error.may_have_executed(), "{at}: {error:?}");
        }
        Some(result) => assert_eq!(result.as_deref().unwrap(), (method.reply)(1), "{at}"),
    }

    // Whatever the dropped call may still bring, the next ones are answered right.
    bench.faults.set_rules([in_two_pieces()]);
    bench.plcs[0].set_battery_low(true);
    if scene == Scene::Crowded {
        earlier.iter().for_each(JoinHandle::abort);
    }
    assert_eq!((method.call)(&bench.link, 2).await.unwrap(), (method.reply)(2), "{at}");
    assert_eq!(bench.station().read_registers(d(500), 3).await.unwrap(), words(500), "{at}");
    for call in earlier {
        if let Ok(result) = call.await {
            assert_eq!(result.unwrap()[1], result_of(scene), "{at}");
        }
    }

    sleep(Duration::from_secs(1)).await;
    assert_done_once(&bench, method, before, after, &at);
    let (station, link) = (bench.station().stats(), bench.link.stats());
    let made_dirty = u64::from(scene == Scene::Dirty);
    if scene != Scene::Unanswered {
        assert_eq!((station.checks, station.timeouts), (made_dirty, made_dirty), "{at}: giving up is no doubt");
    }
    assert_eq!((station.bad_replies, link.connects, link.disconnects, link.garbage_bytes), (0, 1, 0, 0), "{at}");
    ended.is_none().then_some(stage)
}

/// What had been sent by then has arrived, what had not has not, and all of it has been done once.
fn assert_done_once(bench: &Bench, method: &Method, before: Progress, after: Progress, at: &str) {
    let (first, second) = ((method.request)(1), (method.request)(2));
    let (sent, stations): (_, &[u8]) = match method.kind {
        Kind::Broadcast => (after.broadcasts - before.broadcasts, &[1, 2]),
        Kind::Read | Kind::Write => (after.requests - before.requests, &[1]),
    };
    let second_is_first = u64::from(first == second);
    assert_eq!(bench.log_of(&first).len() as u64, sent + second_is_first, "{at}");
    assert_eq!(bench.log_of(&second).len() as u64, 1 + second_is_first * sent, "{at}");
    for &station in stations {
        let applied = |request| bench.faults.log().applied(station, request);
        let expected = if method.kind == Kind::Read { 0 } else { sent + second_is_first };
        assert_eq!(applied(&first), expected, "{at}");
    }
    if method.kind != Kind::Read {
        assert!(sent <= 1, "{at}: sent {sent} times");
    }
}

/// What the second register of an earlier call holds.
fn result_of(scene: Scene) -> u16 {
    word(if scene == Scene::Crowded { 2 } else { 1 }, 301)
}

/// A bus with stations 1 and 2, and a link to it that is not open yet.
struct Bench {
    link: Link,
    plcs: [Plc; 2],
    faults: Faults,
}

/// What the link has done so far, for the first station and for all of them.
#[derive(Clone, Copy)]
struct Progress {
    requests: u64,
    replies: u64,
    /// Requests that may still be answered.
    outstanding: u64,
    checks: u64,
    broadcasts: u64,
}

impl Bench {
    fn new(framing: Framing) -> Self {
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
        let faults = Faults::new(1).line(Line::new(0).turnaround(A_WHILE, A_WHILE)).rule(in_two_pieces());
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
        let link = Link::connector_builder("a bench", framing, slowly).response_timeout(RESPONSE_TIMEOUT).build();
        Self { link, plcs, faults }
    }

    /// Brings about what is to be in the way, and returns the calls that are.
    async fn set(&self, scene: Scene) -> Vec<JoinHandle<Result<Vec<u16>, Error>>> {
        if scene == Scene::Opening {
            return Vec::new();
        }
        if scene == Scene::Crowded {
            return self.crowd().await;
        }
        assert_eq!(self.station().read_registers(d(0), 3).await.unwrap(), words(0));
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

    /// More calls to the second station than fit into the channel; the link's task has not seen them.
    async fn crowd(&self) -> Vec<JoinHandle<Result<Vec<u16>, Error>>> {
        self.link.station(2).unwrap().read_registers(d(300), 3).await.unwrap();
        let before = self.link.stats().stations.requests;
        let calls: Vec<_> = (0..70).map(|_| self.read(2, 300)).collect();
        for _ in &calls {
            tick().await;
        }
        assert_eq!(self.link.stats().stations.requests, before, "nothing has left the channel");
        calls
    }

    fn station(&self) -> Station {
        station(&self.link)
    }

    fn read(&self, station: u8, first: u16) -> JoinHandle<Result<Vec<u16>, Error>> {
        let station = self.link.station(station).unwrap();
        tokio::spawn(async move { station.read_registers(d(first), 3).await })
    }

    fn progress(&self) -> Progress {
        let (station, link) = (self.station().stats(), self.link.stats());
        let outstanding = station.requests - station.replies - station.timeouts;
        let (requests, replies, checks) = (station.requests, station.replies, station.checks);
        Progress { requests, replies, outstanding, checks, broadcasts: link.broadcasts }
    }

    fn stage(&self, request: &Request, before: Progress, after: Progress) -> Stage {
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
    fn log_of(&self, request: &Request) -> Vec<sim::LogEntry> {
        let log = self.faults.log().entries();
        log.into_iter().filter(|entry| entry.request() == Some(request)).collect()
    }
}

/// Polls a call so many times, and each time lets the others make a step. `None`: then it is dropped.
async fn cut_off(mut call: Call, polls: u32) -> Option<Result<String, Error>> {
    for nth in 0..polls {
        if let Poll::Ready(result) = poll_once(&mut call).await {
            return Some(result);
        }
        step(nth).await;
    }
    None
}

async fn poll_once(call: &mut Call) -> Poll<Result<String, Error>> {
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
async fn tick() {
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
fn paused(test: impl Future<Output = ()>) {
    Builder::new_current_thread().enable_all().start_paused(true).event_interval(1).build().unwrap().block_on(test);
}

fn closing(link: &Link) -> Call {
    let link = link.clone();
    async move {
        link.close().await;
        Ok(String::new())
    }
    .boxed()
}

fn station(link: &Link) -> Station {
    link.station(1).unwrap()
}

/// So that a call can be dropped with half of its reply there.
fn in_two_pieces() -> Rule {
    Rule::new(Fault::Split { pieces: 2, pause: Duration::from_millis(1) })
}

/// What a register D of a station holds.
fn word(station: u16, address: u16) -> u16 {
    1000 * station + address
}

/// What three registers D of station 1 hold.
fn words(first: u16) -> [u16; 3] {
    [0, 1, 2].map(|n| word(1, first + n))
}

fn double(first: u16) -> u32 {
    u32::from(word(1, first)) | u32::from(word(1, first + 1)) << 16
}

fn page(n: u16) -> ProgramPage {
    ProgramPage::new([n; 64])
}

fn first_word(page: &ProgramPage) -> u16 {
    page.words()[0]
}

fn brief(status: &BriefStatus) -> bool {
    status.flags().battery_low()
}

fn detailed(status: &DetailedStatus) -> bool {
    status.flags().battery_low()
}

fn d(address: u16) -> Register {
    Register::d(address)
}

fn dd(address: u16) -> Register32 {
    d(address).widened().unwrap()
}

fn r(address: u16) -> Register {
    Register::r(address)
}

fn dr(address: u16) -> Register32 {
    r(address).widened().unwrap()
}

fn m(address: u16) -> Discrete {
    Discrete::new(Symbol::M, address).unwrap()
}

fn x(address: u16) -> Discrete {
    Discrete::new(Symbol::X, address).unwrap()
}
