//! Runs the steps of a case: a link, its callers and the other end of its line, in paused time. The
//! [`Spec`] checks each event.
//!
//! Steps happen between whole milliseconds, where no timer fires. Each step is a little earlier
//! within its millisecond than the one before. So no step falls between a deadline set by an
//! earlier step and its timer, and races between answers and timeouts are deterministic.

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

use super::calls::PlannedCall;
use super::idle::{idle, next_idle, runtime};
use super::op::{CallKind, Coalesced, ConnectOutcome, Op};
use super::oracle::Mark;
use super::plc::{Chunk, Plc};
use super::spec::Spec;
use super::state::{Call, CallResult, Event, Id, LinkSettings, Micros};
use crate::reference::frame_content;

const MS: Micros = 1000;
/// A call rises among the lanes after 1 s without service; no call lasts that long.
const CALL_TIMEOUT: Micros = 900 * MS;
const CONNECT_TIMEOUT: Micros = 50 * MS;

fn settings(framing: Framing) -> LinkSettings {
    LinkSettings {
        framing,
        timeout: 100 * MS,
        settle: 30 * MS,
        byte_timeout: 100 * MS,
        slow_frame: 8000 * MS,
        offline_after: 3,
        probe_interval: (50 * MS, 200 * MS),
        probe_pause: 19,
        queue: 3,
        backoff: 40 * MS,
        window: 100 * MS,
        quiet: 150 * MS,
        mute: 1000 * MS,
    }
}

/// Maximum number of steps: each happens at its own microsecond.
pub(crate) const MAX_STEPS: usize = 900;

/// Runs a case with a new link. The error names the broken rule and the step.
pub(crate) fn run(framing: Framing, seed: u64, ops: &[Op]) -> Result<(), String> {
    runtime().map_err(|error| error.to_string())?.block_on(async {
        let mut harness = Harness::new(framing, seed);
        for (number, op) in ops.iter().take(MAX_STEPS).enumerate() {
            let offset = MS - 1 - number as Micros;
            let step = harness.step(op, offset).await;
            step.map_err(|broken| format!("step {number}, {op:?}: {broken}\n{}", harness.event_log()))?;
        }
        let end = harness.finish().await;
        end.map_err(|broken| format!("at the end: {broken}\n{}", harness.event_log()))
    })
}

struct Harness {
    framing: Framing,
    settings: LinkSettings,
    link: Link,
    line: Arc<Mutex<SharedLine>>,
    spec: Spec,
    calls: Vec<AbortHandle>,
    /// Number of calls so far; each has its own address.
    serial: u16,
    plc: Plc,
    /// Request of the newest call to each station.
    newest: BTreeMap<u8, Vec<u8>>,
    started: Instant,
    history: Vec<(Micros, Event)>,
}

/// State that both ends of the line share.
struct SharedLine {
    started: Instant,
    connecting: ConnectOutcome,
    lost: bool,
    fails_on_write: bool,
    incoming: Vec<u8>,
    /// For each byte of `incoming`, the mark of its frame.
    marks: Vec<Option<Mark>>,
    reader: Option<Waker>,
    /// Requests of the link.
    requests: Vec<Vec<u8>>,
    /// Number of requests that earlier connections carried.
    opened_at: usize,
    events: Vec<(Micros, Event)>,
}

impl SharedLine {
    fn record(&mut self, event: Event) {
        let at = self.started.elapsed().as_micros();
        self.events.push((Micros::try_from(at).unwrap_or(Micros::MAX), event));
    }

    fn wake(&mut self) {
        if let Some(reader) = self.reader.take() {
            reader.wake();
        }
    }
}

impl Harness {
    fn new(framing: Framing, seed: u64) -> Self {
        let (settings, started) = (settings(framing), Instant::now());
        let line = Arc::new(Mutex::new(SharedLine {
            started,
            connecting: ConnectOutcome::Accepted,
            lost: false,
            fails_on_write: false,
            incoming: Vec::new(),
            marks: Vec::new(),
            reader: None,
            requests: Vec::new(),
            opened_at: 0,
            events: Vec::new(),
        }));
        let micros = Duration::from_micros;
        let opened = line.clone();
        let link = Link::connector_builder("the model's line", framing, move || open(opened.clone()))
            .response_timeout(micros(settings.timeout))
            .call_timeout(micros(CALL_TIMEOUT))
            .connect_timeout(micros(CONNECT_TIMEOUT))
            .connect_backoff(micros(settings.backoff / 4), micros(settings.backoff))
            .probe_interval(micros(settings.probe_interval.0), micros(settings.probe_interval.1))
            .offline_after(settings.offline_after)
            .mute_timeout(micros(settings.mute))
            .queue_capacity(settings.queue)
            .in_step(InStepSettings::new().with_window(micros(settings.window)).with_quiet(micros(settings.quiet)))
            .seed(seed)
            .build();
        Self {
            framing,
            settings,
            link,
            line,
            spec: Spec::new(settings),
            calls: Vec::new(),
            serial: 0,
            plc: Plc::new(framing),
            newest: BTreeMap::new(),
            started,
            history: Vec::new(),
        }
    }

    /// Runs a step `past` microseconds after a whole millisecond.
    async fn step(&mut self, op: &Op, past: Micros) -> Result<(), String> {
        // Advances by hand: time passes by itself only in whole milliseconds.
        advance(Duration::from_micros(past)).await;
        self.perform(op);
        self.run_until_idle().await?;
        advance(Duration::from_micros(MS - past)).await;
        self.run_until_idle().await?;
        if let Op::Wait(ms) = op { self.wait(u64::from(*ms) * MS).await } else { Ok(()) }
    }

    /// Lets time pass in whole milliseconds, and checks the events whenever a task has run.
    async fn wait(&mut self, time: Micros) -> Result<(), String> {
        let mut end = pin!(sleep(Duration::from_micros(time)));
        while poll_fn(|cx| Poll::Ready(end.as_mut().poll(cx))).await.is_pending() {
            next_idle().await;
            if !self.line().events.is_empty() {
                // No task ran until now, so nothing was due.
                self.spec.check_progress(self.now() - 1)?;
            }
            self.check()?;
        }
        Ok(())
    }

    /// Waits until all calls have ended by their deadlines, and closes the link.
    async fn finish(&mut self) -> Result<(), String> {
        if !self.spec.all_ended() {
            self.wait(CALL_TIMEOUT).await?;
        }
        self.link.close().await;
        if self.spec.all_ended() { Ok(()) } else { Err("a call has not ended".to_owned()) }
    }

    /// Runs all tasks at the current time, and checks their events.
    async fn run_until_idle(&mut self) -> Result<(), String> {
        idle().await;
        self.check()
    }

    fn check(&mut self) -> Result<(), String> {
        let events = std::mem::take(&mut self.line().events);
        for (at, event) in events {
            self.history.push((at, event.clone()));
            self.spec.observe(at, event)?;
        }
        self.spec.check_progress(self.now())
    }

    fn perform(&mut self, op: &Op) {
        match op {
            Op::Call { station, kind, option_bits } => self.call(*station, *kind, *option_bits),
            Op::Cancel(number) => {
                let live: Vec<Id> = (0..self.calls.len()).filter(|&id| !self.calls[id].is_finished()).collect();
                if let Some(&id) = live.get(usize::from(*number) % live.len().max(1)) {
                    self.calls[id].abort();
                    self.line().record(Event::Cancelled(id));
                }
            }
            Op::Answer { late, refusal } => self.answer(usize::from(*late), *refusal),
            Op::Corrupt(how) => {
                let corrupted = self.plc.corrupted(self.recent_request(0), *how);
                self.deliver(&corrupted);
            }
            Op::Noise(bytes) => self.deliver(&[(bytes.clone(), None)]),
            Op::Release => {
                let held_back = std::mem::take(&mut self.plc.held_back);
                self.deliver(&held_back);
            }
            Op::Echo => {
                let echo = self.line().requests.last().cloned().unwrap_or_default();
                self.deliver(&[(echo, None)]);
            }
            Op::Copy(back) => {
                let copy = self.plc.copy(usize::from(*back));
                self.deliver(&copy);
            }
            Op::SecondAnswer(refusal) => {
                let second_answer = self.plc.second_answer(*refusal);
                self.deliver(&second_answer);
            }
            Op::LeftOver { station, refusal } => {
                let call = self.newest.get(station).cloned().unwrap_or_default();
                let opened = self.line().opened_at;
                let left = self.plc.left_over(&call, opened, *refusal);
                self.deliver(&left);
            }
            Op::AnswerBroadcast { station, refusal } => {
                let is_broadcast = |request: &Vec<u8>| frame_content(self.framing, request).station == 0;
                let last = {
                    let line = self.line();
                    line.requests.iter().rposition(is_broadcast).map(|number| (number, line.requests[number].clone()))
                };
                let answer = self.plc.answer(last, *station, *refusal);
                self.deliver(&answer);
            }
            Op::Unsupported(which) => self.plc.unsupported = *which,
            Op::Coalesced(how) => {
                let (copy, request) = (self.plc.copy(0), self.recent_request(0));
                let answer = self.plc.answer_own(request);
                let frames = match how {
                    Coalesced::CopyFirst => [copy, answer],
                    Coalesced::SecondBehind => [answer, self.plc.second_answer(0)],
                    Coalesced::CopyBehind => [answer, copy],
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

    /// Answers the request `late` requests ago, or refuses it with this code.
    fn answer(&mut self, late: usize, refusal: u8) {
        let request = self.recent_request(late);
        let station = request.as_ref().map_or(0, |(_, request)| frame_content(self.framing, request).station);
        let answer = self.plc.answer(request, station, refusal);
        self.deliver(&answer);
    }

    /// The request `late` requests ago, with its number.
    fn recent_request(&self, late: usize) -> Option<(usize, Vec<u8>)> {
        let line = self.line();
        let number = line.requests.len().checked_sub(late + 1)?;
        Some((number, line.requests[number].clone()))
    }

    fn call(&mut self, station: u8, kind: CallKind, option_bits: u8) {
        let station = station.max(1);
        self.serial += 1;
        let planned = PlannedCall::new(self.framing, kind, self.serial);
        let PlannedCall { broadcast, lane, class, .. } = planned;
        let (retries, retry_writes) = (u32::from(option_bits & 3), option_bits & 4 != 0);
        let timeout = self.settings.timeout << u32::from(option_bits >> 3 & 1);
        let call_timeout = if option_bits & 16 == 0 { CALL_TIMEOUT } else { 150 * MS };
        let options = CallOptions::new()
            .with_retries(retries)
            .with_retry_writes(retry_writes)
            .with_response_timeout(Duration::from_micros(timeout))
            .with_call_timeout(Duration::from_micros(call_timeout));
        let number = if broadcast { 0 } else { station };
        let spellings = planned.spellings(self.framing, number);
        if !broadcast {
            self.newest.insert(station, spellings[0].request.clone());
        }
        let call = Call {
            station: number,
            lane,
            class,
            spellings,
            words: planned.words(),
            retries: if lane == 2 || retry_writes { retries } else { 0 },
            check_retries: if lane == 2 || retry_writes { 0 } else { retries },
            timeout,
            deadline: self.now() + call_timeout,
        };
        let id = self.calls.len();
        self.line().record(Event::Called(id, call));
        let (link, line) = (self.link.clone(), self.line.clone());
        let task = tokio::spawn(async move {
            let end = call_link(&link, station, planned, options).await;
            lock(&line).record(Event::Ended(id, end));
        });
        self.calls.push(task.abort_handle());
    }

    /// Delivers frames of the PLC, or bytes without a mark.
    fn deliver(&mut self, frames: &[Chunk]) {
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

    fn line(&self) -> MutexGuard<'_, SharedLine> {
        lock(&self.line)
    }

    /// All events so far, for a failure message.
    fn event_log(&self) -> String {
        let bytes = |bytes: &[u8]| match self.framing {
            Framing::Binary => format!("{bytes:02X?}"),
            _ => bytes.escape_ascii().to_string(),
        };
        let line = |(at, event): &(Micros, Event)| match event {
            Event::Wrote(request) | Event::WroteInVain(request) => format!("{at:>9} Wrote {}\n", bytes(request)),
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
        self.history.iter().map(line).collect()
    }
}

async fn call_link(link: &Link, station: u8, planned: PlannedCall, options: CallOptions) -> CallResult {
    let result = if planned.broadcast {
        link.broadcast().with_options(options).forward(planned.request).await.map(|()| Vec::new())
    } else {
        let station = link.station(station).expect("a station").with_options(options);
        match planned.request {
            Request::ReadRegisters(request) => station.call(request).await,
            Request::ReadProgramPage(request) => station.call(request).await.map(|page| page.words().to_vec()),
            Request::ReadMixed(request) => station.call(request).await.map(words),
            request => station.forward(request).await.map(|_| Vec::new()),
        }
    };
    match result {
        Ok(words) => CallResult::Done(words),
        Err(Error::Plc { error, repeated, .. }) => CallResult::Refused { code: error.into(), repeated },
        Err(Error::Timeout { sent, .. }) => CallResult::Timeout { sent },
        Err(Error::BadReply { sent, .. }) => CallResult::BadReply { sent },
        Err(Error::Offline { sent, .. }) => CallResult::Offline { sent },
        Err(Error::Disconnected { sent, .. }) => CallResult::Disconnected { sent },
        Err(Error::OutOfStep { sent, .. }) => CallResult::OutOfStep { sent },
        Err(Error::Connect { sent, .. }) => CallResult::NotConnected { sent },
        Err(Error::QueueFull { .. }) => CallResult::QueueFull,
        Err(error) => panic!("no call of the model can end with {error:?}"),
    }
}

fn words(values: Vec<Value>) -> Vec<u16> {
    let word = |value| if let Value::Word(word) = value { Some(word) } else { None };
    values.into_iter().filter_map(word).collect()
}

/// Opens a connection for the link.
async fn open(line: Arc<Mutex<SharedLine>>) -> io::Result<LinkStream> {
    let connecting = {
        let mut line = lock(&line);
        line.record(Event::Connecting);
        line.connecting
    };
    match connecting {
        ConnectOutcome::Accepted => {
            let mut opened = lock(&line);
            (opened.lost, opened.fails_on_write) = (false, false);
            opened.incoming.clear();
            opened.marks.clear();
            opened.opened_at = opened.requests.len();
            opened.record(Event::Connected);
            drop(opened);
            Ok(LinkStream { line })
        }
        ConnectOutcome::Refused => {
            lock(&line).record(Event::NotConnected);
            Err(io::ErrorKind::ConnectionRefused.into())
        }
        ConnectOutcome::Unanswered => {
            // The event is recorded when the link gives up.
            let _unanswered = Unanswered(line);
            pending().await
        }
    }
}

struct Unanswered(Arc<Mutex<SharedLine>>);

impl Drop for Unanswered {
    fn drop(&mut self) {
        lock(&self.0).record(Event::NotConnected);
    }
}

/// Client end of the line.
struct LinkStream {
    line: Arc<Mutex<SharedLine>>,
}

impl Drop for LinkStream {
    fn drop(&mut self) {
        lock(&self.line).record(Event::Dropped);
    }
}

impl AsyncRead for LinkStream {
    fn poll_read(self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        let mut line = lock(&self.line);
        if line.incoming.is_empty() {
            if line.lost {
                line.record(Event::Lost);
                return Poll::Ready(Ok(()));
            }
            line.reader = Some(cx.waker().clone());
            return Poll::Pending;
        }
        let len = line.incoming.len().min(buf.remaining());
        let read: Vec<u8> = line.incoming.drain(..len).collect();
        buf.put_slice(&read);
        let marks = line.marks.drain(..len).collect();
        line.record(Event::Read(read, marks));
        Poll::Ready(Ok(()))
    }
}

impl AsyncWrite for LinkStream {
    fn poll_write(self: Pin<&mut Self>, _: &mut Context<'_>, buf: &[u8]) -> Poll<io::Result<usize>> {
        let mut line = lock(&self.line);
        line.requests.push(buf.to_vec());
        if std::mem::take(&mut line.fails_on_write) {
            line.record(Event::WroteInVain(buf.to_vec()));
            return Poll::Ready(Err(io::ErrorKind::BrokenPipe.into()));
        }
        line.record(Event::Wrote(buf.to_vec()));
        Poll::Ready(Ok(buf.len()))
    }

    fn poll_flush(self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<io::Result<()>> {
        Poll::Ready(Ok(()))
    }

    fn poll_shutdown(self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<io::Result<()>> {
        Poll::Ready(Ok(()))
    }
}

fn lock(line: &Mutex<SharedLine>) -> MutexGuard<'_, SharedLine> {
    line.lock().unwrap_or_else(std::sync::PoisonError::into_inner)
}
