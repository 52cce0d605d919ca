//! A link, its callers and the other end of its line, in paused time; what happens is told to the [`Spec`].
//!
//! Steps are taken between whole milliseconds, where no timer fires, and each a little earlier within its millisecond than
//! those before it: so no step falls between a deadline that an earlier one has set and its timer, and it is never a matter
//! of chance whether an answer comes in time.

use std::collections::BTreeMap;
use std::future::{Future, pending, poll_fn};
use std::io;
use std::pin::{Pin, pin};
use std::sync::{Arc, Mutex, MutexGuard};
use std::task::{Context, Poll, Waker};
use std::time::Duration;

use fatek::command::{Request, Value};
use fatek::endpoint::InStepSettings;
use fatek::wire::Framing;
use fatek::{CallOptions, Error, Link};
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::task::AbortHandle;
use tokio::time::{Instant, advance, sleep};

use super::op::{Connecting, Kind, Op, Together};
use super::plc::{Plc, Said};
use super::rest::{next_rest, rest, runtime};
use super::spec::Spec;
use super::state::{Call, End, Event, Id, Micros, Rules};
use super::wanted::Wanted;
use super::witness::Mark;
use crate::book::carried;

const MS: Micros = 1000;
/// At 1 s without service a call rises among the lanes; no call lasts so long.
const CALL_TIMEOUT: Micros = 900 * MS;
const CONNECT_TIMEOUT: Micros = 50 * MS;

fn rules(framing: Framing) -> Rules {
    Rules {
        framing,
        timeout: 100 * MS,
        settle: 30 * MS,
        offline_after: 3,
        probe_interval: (50 * MS, 200 * MS),
        probe_pause: 19,
        queue: 3,
        backoff: 40 * MS,
        window: 100 * MS,
        quiet: 150 * MS,
    }
}

/// How many steps a run can have: each takes place at its own microsecond.
pub(crate) const MAX_STEPS: usize = 900;

/// Takes the steps with a new link; says which rule was broken, and where.
pub(crate) fn run(framing: Framing, seed: u64, ops: &[Op]) -> Result<(), String> {
    runtime().map_err(|error| error.to_string())?.block_on(async {
        let mut world = World::new(framing, seed);
        for (number, op) in ops.iter().take(MAX_STEPS).enumerate() {
            let step = world.step(op, MS - 1 - number as Micros).await;
            step.map_err(|broken| format!("step {number}, {op:?}: {broken}\n{}", world.story()))?;
        }
        let end = world.finish().await;
        end.map_err(|broken| format!("at the end: {broken}\n{}", world.story()))
    })
}

struct World {
    framing: Framing,
    rules: Rules,
    link: Link,
    line: Arc<Mutex<Line>>,
    spec: Spec,
    calls: Vec<AbortHandle>,
    /// Each call has another address.
    serial: u16,
    plc: Plc,
    /// The newest call to each station.
    newest: BTreeMap<u8, Vec<u8>>,
    started: Instant,
    told: Vec<(Micros, Event)>,
}

/// What both ends of the line can see.
struct Line {
    started: Instant,
    connecting: Connecting,
    lost: bool,
    fails_on_write: bool,
    incoming: Vec<u8>,
    /// Of each byte of it, the frame that it is a part of.
    marks: Vec<Option<Mark>>,
    reader: Option<Waker>,
    /// What the link has asked.
    asked: Vec<Vec<u8>>,
    /// The number of requests that were asked over earlier connections.
    opened_at: usize,
    events: Vec<(Micros, Event)>,
}

impl Line {
    fn tell(&mut self, event: Event) {
        let at = self.started.elapsed().as_micros();
        self.events.push((Micros::try_from(at).unwrap_or(Micros::MAX), event));
    }

    fn wake(&mut self) {
        if let Some(reader) = self.reader.take() {
            reader.wake();
        }
    }
}

impl World {
    fn new(framing: Framing, seed: u64) -> Self {
        let (rules, started) = (rules(framing), Instant::now());
        let line = Arc::new(Mutex::new(Line {
            started,
            connecting: Connecting::Accepted,
            lost: false,
            fails_on_write: false,
            incoming: Vec::new(),
            marks: Vec::new(),
            reader: None,
            asked: Vec::new(),
            opened_at: 0,
            events: Vec::new(),
        }));
        let micros = Duration::from_micros;
        let opened = line.clone();
        let link = Link::connector_builder("the model's line", framing, move || open(opened.clone()))
            .response_timeout(micros(rules.timeout))
            .call_timeout(micros(CALL_TIMEOUT))
            .connect_timeout(micros(CONNECT_TIMEOUT))
            .connect_backoff(micros(rules.backoff / 4), micros(rules.backoff))
            .probe_interval(micros(rules.probe_interval.0), micros(rules.probe_interval.1))
            .offline_after(rules.offline_after)
            .queue_capacity(rules.queue)
            .in_step(InStepSettings::new().with_window(micros(rules.window)).with_quiet(micros(rules.quiet)))
            .seed(seed)
            .build();
        Self {
            framing,
            rules,
            link,
            line,
            spec: Spec::new(rules),
            calls: Vec::new(),
            serial: 0,
            plc: Plc::new(framing),
            newest: BTreeMap::new(),
            started,
            told: Vec::new(),
        }
    }

    /// Takes a step, so many microseconds past a whole millisecond.
    async fn step(&mut self, op: &Op, past: Micros) -> Result<(), String> {
        // By hand: where time passes by itself, it does so by whole milliseconds.
        advance(Duration::from_micros(past)).await;
        self.act(op);
        self.settle().await?;
        advance(Duration::from_micros(MS - past)).await;
        self.settle().await?;
        if let Op::Wait(ms) = op { self.wait(u64::from(*ms) * MS).await } else { Ok(()) }
    }

    /// Lets time pass, from one whole millisecond to another, and looks whenever there was something to be done.
    async fn wait(&mut self, time: Micros) -> Result<(), String> {
        let mut end = pin!(sleep(Duration::from_micros(time)));
        while poll_fn(|cx| Poll::Ready(end.as_mut().poll(cx))).await.is_pending() {
            next_rest().await;
            if !self.line().events.is_empty() {
                // Nothing was done until now, so nothing had to be.
                self.spec.settled(self.now() - 1)?;
            }
            self.look()?;
        }
        Ok(())
    }

    /// All calls end by their deadlines, and then the link can be closed.
    async fn finish(&mut self) -> Result<(), String> {
        if !self.spec.is_over() {
            self.wait(CALL_TIMEOUT).await?;
        }
        self.link.close().await;
        if self.spec.is_over() { Ok(()) } else { Err("a call has not ended".to_owned()) }
    }

    /// Lets everybody do what there is to be done at this time, and looks at it.
    async fn settle(&mut self) -> Result<(), String> {
        rest().await;
        self.look()
    }

    fn look(&mut self) -> Result<(), String> {
        let events = std::mem::take(&mut self.line().events);
        for (at, event) in events {
            self.told.push((at, event.clone()));
            self.spec.observe(at, event)?;
        }
        self.spec.settled(self.now())
    }

    fn act(&mut self, op: &Op) {
        match op {
            Op::Call { station, kind, patience } => self.call(*station, *kind, *patience),
            Op::Cancel(number) => {
                let live: Vec<Id> = (0..self.calls.len()).filter(|&id| !self.calls[id].is_finished()).collect();
                if let Some(&id) = live.get(usize::from(*number) % live.len().max(1)) {
                    self.calls[id].abort();
                    self.line().tell(Event::Cancelled(id));
                }
            }
            Op::Answer { late, refusal } => self.answer(usize::from(*late), *refusal),
            Op::Spoilt(how) => {
                let spoilt = self.plc.spoilt(self.asked(0), *how);
                self.deliver(&spoilt);
            }
            Op::Noise(bytes) => self.deliver(&[(bytes.clone(), None)]),
            Op::Rest => {
                let rest = std::mem::take(&mut self.plc.held_back);
                self.deliver(&rest);
            }
            Op::Echo => {
                let echo = self.line().asked.last().cloned().unwrap_or_default();
                self.deliver(&[(echo, None)]);
            }
            Op::Copy(back) => {
                let copy = self.plc.copy(usize::from(*back));
                self.deliver(&copy);
            }
            Op::Second(refusal) => {
                let second = self.plc.second(*refusal);
                self.deliver(&second);
            }
            Op::LeftOver { station, refusal } => {
                let call = self.newest.get(station).cloned().unwrap_or_default();
                let opened = self.line().opened_at;
                let left = self.plc.left_over(&call, opened, *refusal);
                self.deliver(&left);
            }
            Op::Broadcasted { station, refusal } => {
                let is_broadcast = |asked: &Vec<u8>| carried(self.framing, asked).station == 0;
                let last = {
                    let line = self.line();
                    line.asked.iter().rposition(is_broadcast).map(|number| (number, line.asked[number].clone()))
                };
                let answer = self.plc.answer(last, *station, *refusal);
                self.deliver(&answer);
            }
            Op::Lacks(which) => self.plc.lacks = *which,
            Op::Together(how) => {
                let (copy, asked) = (self.plc.copy(0), self.asked(0));
                let answer = self.plc.answer_own(asked);
                let frames = match how {
                    Together::CopyFirst => [copy, answer],
                    Together::SecondBehind => [answer, self.plc.second(0)],
                    Together::CopyBehind => [answer, copy],
                };
                self.deliver(&frames.concat());
            }
            Op::AnswerAndLose => {
                self.answer(0, 0);
                self.line().lost = true;
            }
            Op::Wait(_) => {}
            Op::Lose => {
                let mut line = self.line();
                line.lost = true;
                line.wake();
            }
            Op::LoseOnWrite => self.line().fails_on_write = true,
            Op::Connecting(how) => self.line().connecting = *how,
        }
    }

    /// The PLC answers what was asked so many requests ago; or refuses it with this code.
    fn answer(&mut self, late: usize, refusal: u8) {
        let asked = self.asked(late);
        let station = asked.as_ref().map_or(0, |(_, asked)| carried(self.framing, asked).station);
        let answer = self.plc.answer(asked, station, refusal);
        self.deliver(&answer);
    }

    /// What was asked so many requests ago, with its number.
    fn asked(&self, late: usize) -> Option<(usize, Vec<u8>)> {
        let line = self.line();
        let number = line.asked.len().checked_sub(late + 1)?;
        Some((number, line.asked[number].clone()))
    }

    fn call(&mut self, station: u8, kind: Kind, patience: u8) {
        let station = station.max(1);
        self.serial += 1;
        let wanted = Wanted::new(self.framing, kind, self.serial);
        let Wanted { broadcast, lane, sort, .. } = wanted;
        let (retries, again) = (u32::from(patience & 3), patience & 4 != 0);
        let timeout = self.rules.timeout << u32::from(patience >> 3 & 1);
        let allowed = if patience & 16 == 0 { CALL_TIMEOUT } else { 150 * MS };
        let options = CallOptions::new()
            .retries(retries)
            .retry_writes(again)
            .response_timeout(Duration::from_micros(timeout))
            .call_timeout(Duration::from_micros(allowed));
        let number = if broadcast { 0 } else { station };
        let spellings = wanted.spellings(self.framing, number);
        if !broadcast {
            self.newest.insert(station, spellings[0].request.clone());
        }
        let call = Call {
            station: number,
            lane,
            sort,
            spellings,
            words: wanted.words(),
            retries: if lane == 2 || again { retries } else { 0 },
            timeout,
            deadline: self.now() + allowed,
        };
        let id = self.calls.len();
        self.line().tell(Event::Called(id, call));
        let (link, line) = (self.link.clone(), self.line.clone());
        let task = tokio::spawn(async move {
            let end = make(&link, station, wanted, options).await;
            lock(&line).tell(Event::Ended(id, end));
        });
        self.calls.push(task.abort_handle());
    }

    /// Frames of the PLC come, or other bytes, which have no mark.
    fn deliver(&mut self, frames: &[Said]) {
        let mut line = self.line();
        for (bytes, mark) in frames {
            line.incoming.extend(bytes);
            line.marks.extend(std::iter::repeat_n(*mark, bytes.len()));
        }
        line.wake();
    }

    fn now(&self) -> Micros {
        Micros::try_from(self.started.elapsed().as_micros()).unwrap_or(Micros::MAX)
    }

    fn line(&self) -> MutexGuard<'_, Line> {
        lock(&self.line)
    }

    /// The last events, for a failure.
    fn story(&self) -> String {
        let bytes = |bytes: &[u8]| match self.framing {
            Framing::Binary => format!("{bytes:02X?}"),
            _ => bytes.escape_ascii().to_string(),
        };
        let line = |(at, event): &(Micros, Event)| match event {
            Event::Wrote(asked) | Event::WroteInVain(asked) => format!("{at:>9} Wrote {}\n", bytes(asked)),
            Event::Read(came, _) => format!("{at:>9} Read {}\n", bytes(came)),
            Event::Called(id, call) => {
                format!(
                    "{at:>9} Called {id}: {}, until {}, {call:?}\n",
                    bytes(&call.spellings[0].request),
                    call.deadline
                )
            }
            event => format!("{at:>9} {event:?}\n"),
        };
        self.told.iter().map(line).collect()
    }
}

async fn make(link: &Link, station: u8, wanted: Wanted, options: CallOptions) -> End {
    let result = if wanted.broadcast {
        link.broadcast().with_options(options).forward(wanted.request).await.map(|()| Vec::new())
    } else {
        let station = link.station(station).expect("a station").with_options(options);
        match wanted.request {
            Request::ReadRegisters(request) => station.call(request).await,
            Request::ReadProgramPage(request) => station.call(request).await.map(|page| page.words().to_vec()),
            Request::ReadMixed(request) => station.call(request).await.map(words),
            request => station.forward(request).await.map(|_| Vec::new()),
        }
    };
    match result {
        Ok(words) => End::Done(words),
        Err(Error::Plc { error, repeated, .. }) => End::Refused { code: error.into(), repeated },
        Err(Error::Timeout { sent, .. }) => End::Timeout { sent },
        Err(Error::BadReply { sent, .. }) => End::BadReply { sent },
        Err(Error::Offline { sent, .. }) => End::Offline { sent },
        Err(Error::Disconnected { sent, .. }) => End::Disconnected { sent },
        Err(Error::OutOfStep { sent, .. }) => End::OutOfStep { sent },
        Err(Error::Connect { sent: false, .. }) => End::NotConnected,
        Err(Error::QueueFull { .. }) => End::QueueFull,
        Err(error) => panic!("no call of the model can end with {error:?}"),
    }
}

fn words(values: Vec<Value>) -> Vec<u16> {
    let word = |value| if let Value::Word(word) = value { Some(word) } else { None };
    values.into_iter().filter_map(word).collect()
}

/// The link wants a connection.
async fn open(line: Arc<Mutex<Line>>) -> io::Result<Wire> {
    let connecting = {
        let mut line = lock(&line);
        line.tell(Event::Connecting);
        line.connecting
    };
    match connecting {
        Connecting::Accepted => {
            let mut opened = lock(&line);
            (opened.lost, opened.fails_on_write) = (false, false);
            opened.incoming.clear();
            opened.marks.clear();
            opened.opened_at = opened.asked.len();
            opened.tell(Event::Connected);
            drop(opened);
            Ok(Wire { line })
        }
        Connecting::Refused => {
            lock(&line).tell(Event::NotConnected);
            Err(io::ErrorKind::ConnectionRefused.into())
        }
        Connecting::Unanswered => {
            // Told when it is given up.
            let _unanswered = Unanswered(line);
            pending().await
        }
    }
}

struct Unanswered(Arc<Mutex<Line>>);

impl Drop for Unanswered {
    fn drop(&mut self) {
        lock(&self.0).tell(Event::NotConnected);
    }
}

/// The link's end of the line.
struct Wire {
    line: Arc<Mutex<Line>>,
}

impl AsyncRead for Wire {
    fn poll_read(self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        let mut line = lock(&self.line);
        if line.incoming.is_empty() {
            if line.lost {
                line.tell(Event::Lost);
                return Poll::Ready(Ok(()));
            }
            line.reader = Some(cx.waker().clone());
            return Poll::Pending;
        }
        let len = line.incoming.len().min(buf.remaining());
        let read: Vec<u8> = line.incoming.drain(..len).collect();
        buf.put_slice(&read);
        let marks = line.marks.drain(..len).collect();
        line.tell(Event::Read(read, marks));
        Poll::Ready(Ok(()))
    }
}

impl AsyncWrite for Wire {
    fn poll_write(self: Pin<&mut Self>, _: &mut Context<'_>, buf: &[u8]) -> Poll<io::Result<usize>> {
        let mut line = lock(&self.line);
        line.asked.push(buf.to_vec());
        if std::mem::take(&mut line.fails_on_write) {
            line.tell(Event::WroteInVain(buf.to_vec()));
            return Poll::Ready(Err(io::ErrorKind::BrokenPipe.into()));
        }
        line.tell(Event::Wrote(buf.to_vec()));
        Poll::Ready(Ok(buf.len()))
    }

    fn poll_flush(self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<io::Result<()>> {
        Poll::Ready(Ok(()))
    }

    fn poll_shutdown(self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<io::Result<()>> {
        Poll::Ready(Ok(()))
    }
}

fn lock(line: &Mutex<Line>) -> MutexGuard<'_, Line> {
    line.lock().unwrap_or_else(std::sync::PoisonError::into_inner)
}
