//! Runs the checks of an examination: sends their requests one at a time at a bounded rate, and keeps the line in
//! step by loop-backs.

mod connections;
mod restore;

use std::io;
use std::time::Duration;

use bytes::Bytes;
use tokio::time::{Instant, sleep_until, timeout_at};

use super::check::{Check, Choice, Finding, Kind, Undo};
use super::exchange::{Answer, Arrival, Ask, Attempt, Exchange, Item, fit};
use super::facts::Facts;
use super::line::{Connect, Medium, Receiver};
use super::request::{Request, Requests, joined};

/// Attempts of a request that only reads.
const ATTEMPTS: usize = 3;
/// Silence behind several requests, in which late replies and duplicates are expected.
const SETTLE: Duration = Duration::from_millis(100);
/// Silence behind each reply, in which a duplicate of it comes (protocol 7: after 0 to 20 ms).
pub(crate) const DUPLICATE: Duration = Duration::from_millis(25);
/// Connections that are opened one after the other without an answer before the PLC counts as lost.
const RECONNECTS: usize = 3;

/// Times of an examination.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Pace {
    /// Response timeout.
    pub(crate) timeout: Duration,
    /// From the beginning of one request to that of the next.
    pub(crate) interval: Duration,
}

/// Reason why an examination ends early.
#[derive(Debug)]
pub(crate) enum End {
    /// No answer to any request.
    Silent,
    /// No connection.
    Lost(io::Error),
}

/// A finding with the exchanges that it rests on.
#[derive(Debug)]
pub(crate) struct Examined {
    pub(crate) finding: Finding,
    pub(crate) exchanges: Vec<Exchange>,
}

/// An examination, with its results so far.
pub(crate) struct Runner<'c, C> {
    connector: C,
    line: Option<Receiver>,
    pub(crate) facts: Facts,
    checks: &'c [Check],
    choice: Choice,
    pace: Pace,
    /// The results, by the order of the checks.
    pub(crate) examined: Vec<Option<Examined>>,
    /// The check in progress, with its exchanges so far.
    current: Option<(usize, Vec<Exchange>)>,
    /// The element that a check has written and could not restore.
    unrestored: Option<Undo>,
    /// When the next request may be sent.
    next_at: Option<Instant>,
    /// The number of requests so far.
    pub(crate) sent: usize,
    nonce: u32,
}

impl<'c, C: Connect> Runner<'c, C> {
    pub(crate) fn new(connector: C, requests: Requests, checks: &'c [Check], choice: Choice, pace: Pace) -> Self {
        let facts = Facts::new(requests, connector.medium());
        let examined = checks.iter().map(|_| None).collect();
        // Loop-backs of an earlier examination may still be on their way.
        let nonce = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).map_or(0, |t| t.subsec_nanos());
        Self {
            connector,
            line: None,
            facts,
            checks,
            choice,
            pace,
            examined,
            current: None,
            unrestored: None,
            next_at: None,
            sent: 0,
            nonce,
        }
    }

    /// Runs all checks. `show` is called before each, with its place.
    ///
    /// Cancel-safe: the results so far are kept; [`undo`](Self::undo) restores the element that was written.
    pub(crate) async fn run(&mut self, show: impl Fn(usize, &Check)) -> Result<(), End> {
        self.line().await?;
        self.is_alive().await?.then_some(()).ok_or(End::Silent)?;
        for phase in [false, true] {
            // Checks of all traffic are judged last.
            for (place, check) in self.checks.iter().enumerate().filter(|(_, c)| (c.kind == Kind::Passive) == phase) {
                show(place, check);
                let unrestored = self.unrestored.as_ref().filter(|_| check.kind == Kind::Write);
                let reason = check
                    .left_out(self.choice)
                    .map(str::to_owned)
                    .or_else(|| check.lacking(&self.facts))
                    .or_else(|| unrestored.map(|_| "not examined: the element was not restored".to_owned()));
                if let Some(reason) = reason {
                    self.examined[place] = Some(Examined { finding: Finding::open(reason), exchanges: Vec::new() });
                    continue;
                }
                self.examine(place, check).await?;
            }
        }
        Ok(())
    }

    async fn examine(&mut self, place: usize, check: &Check) -> Result<(), End> {
        self.current = Some((place, Vec::new()));
        let mut asked = 0;
        while let Some(ask) = self.next(check) {
            asked += ask.requests();
            debug_assert!(asked <= check.requests, "{check:?} asks more than {}", check.requests);
            if asked > check.requests {
                break;
            }
            let exchange = self.exchange(ask).await?;
            self.facts.note(exchange.clone());
            if let Some((_, done)) = &mut self.current {
                done.push(exchange);
            }
        }
        let Some((_, exchanges)) = self.current.take() else { return Ok(()) };
        self.unrestored = self.unrestored.take().or_else(|| (check.undo)(&self.facts, &exchanges));
        let finding = (check.judge)(&self.facts, &exchanges);
        self.examined[place] = Some(Examined { finding, exchanges });
        Ok(())
    }

    fn next(&self, check: &Check) -> Option<Ask> {
        let (_, done) = self.current.as_ref()?;
        (check.next)(&self.facts, done)
    }

    /// The open connection; opens one if there is none.
    async fn line(&mut self) -> Result<&mut Receiver, End> {
        let mut failure = None;
        if self.line.is_none() {
            for _ in 0..RECONNECTS {
                match self.connector.open().await {
                    Ok(wire) => {
                        self.line = Some(Receiver::new(wire, self.facts.framing()));
                        break;
                    }
                    Err(error) => failure = Some(error),
                }
                tokio::time::sleep(SETTLE).await;
            }
        }
        let none = || End::Lost(failure.unwrap_or_else(|| io::ErrorKind::NotConnected.into()));
        self.line.as_mut().ok_or_else(none)
    }

    async fn exchange(&mut self, ask: Ask) -> Result<Exchange, End> {
        let mut attempts = Vec::new();
        match &ask {
            Ask::Reply(request) | Ask::Once(request) | Ask::Sync(request) => {
                let bytes = self.facts.requests.encode(&request.frame);
                let most = if let Ask::Once(_) = ask { 1 } else { ATTEMPTS };
                for _ in 0..most {
                    let mut attempt = self.attempt(request, bytes.clone()).await?;
                    let is_answered = attempt.reply(request, self.facts.framing()).is_some();
                    if !is_answered {
                        self.separate(&mut attempt).await?;
                    }
                    attempts.push(attempt);
                    if is_answered {
                        break;
                    }
                }
            }
            Ask::Silence(request, bytes) => {
                let mut attempt = self.attempt(request, bytes.clone()).await?;
                self.separate(&mut attempt).await?;
                attempts.push(attempt);
            }
            Ask::Burst(requests) => {
                let mut attempt = self.burst(requests).await?;
                self.separate(&mut attempt).await?;
                attempts.push(attempt);
            }
            Ask::Load(requests) => {
                attempts = self.load(requests).await?;
                if let Some(last) = attempts.last_mut() {
                    self.separate(last).await?;
                }
            }
            Ask::Connections(connections) => attempts = self.connections(*connections).await?,
            Ask::Idle(time) => attempts = self.idle(*time).await?,
            Ask::TwoPorts(first, second) => attempts = self.two_ports(first, second).await?,
        }
        Ok(Exchange { ask, attempts })
    }

    /// Sends a request, and waits for a frame that fits it. Then listens until the next request may be sent, and at
    /// least for a duplicate of the reply.
    async fn attempt(&mut self, request: &Request, bytes: Bytes) -> Result<Attempt, End> {
        let (mut attempt, sent_at) = self.ask(request, bytes).await?;
        let duplicate = Instant::now() + DUPLICATE;
        let until = self.next_at.map_or(duplicate, |next_at| next_at.max(duplicate));
        self.listen(&mut attempt, until, sent_at).await;
        Ok(attempt)
    }

    /// Sends a request, and waits for a frame that fits it. Returns also when it was sent.
    async fn ask(&mut self, request: &Request, bytes: Bytes) -> Result<(Attempt, Instant), End> {
        let framing = self.facts.framing();
        let mut attempt = Attempt { sent: bytes.clone(), ..Attempt::default() };
        let Some((sent_at, deadline)) = self.send(&[bytes], &mut attempt).await? else {
            return Ok((attempt, Instant::now()));
        };
        self.receive(&mut attempt, sent_at, deadline, |attempt| attempt.reply(request, framing).is_some()).await;
        Ok((attempt, sent_at))
    }

    /// Sends requests together, and waits for as many frames.
    async fn burst(&mut self, requests: &[Request]) -> Result<Attempt, End> {
        let parts: Vec<Bytes> = requests.iter().map(|request| self.facts.requests.encode(&request.frame)).collect();
        let mut attempt = Attempt { sent: joined(&parts), ..Attempt::default() };
        let datagrams = if self.facts.medium == Medium::Udp { parts } else { vec![attempt.sent.clone()] };
        let Some((sent_at, deadline)) = self.send(&datagrams, &mut attempt).await? else { return Ok(attempt) };
        self.receive(&mut attempt, sent_at, deadline, |attempt| attempt.frames().count() >= requests.len()).await;
        // A late reply or a duplicate may follow.
        self.listen(&mut attempt, Instant::now() + SETTLE, sent_at).await;
        Ok(attempt)
    }

    /// Sends requests one at a time, each as soon as the reply to the one before it has come.
    async fn load(&mut self, requests: &[Request]) -> Result<Vec<Attempt>, End> {
        let mut attempts = Vec::new();
        for request in requests {
            let bytes = self.facts.requests.encode(&request.frame);
            // No pause, and nothing is received between a reply and the next request.
            self.next_at = self.next_at.filter(|_| attempts.is_empty());
            attempts.push(self.ask(request, bytes).await?.0);
        }
        self.next_at = Some(Instant::now() + self.pace.interval);
        if let Some(last) = attempts.last_mut() {
            self.listen(last, Instant::now() + SETTLE, Instant::now()).await;
        }
        Ok(attempts)
    }

    /// Sends at the time of the next request. Returns `None` if the connection was closed before.
    async fn send(&mut self, parts: &[Bytes], attempt: &mut Attempt) -> Result<Option<(Instant, Instant)>, End> {
        if let Some(next_at) = self.next_at {
            sleep_until(next_at).await;
        }
        let len = parts.iter().map(Bytes::len).sum();
        let (transmission, longest) = (self.connector.transmission(len), self.connector.transmission(520));
        self.next_at = Some(Instant::now() + self.pace.interval);
        self.sent += parts.len();
        let line = self.line().await?;
        for part in parts {
            if line.wire.send(part).await.is_err() {
                attempt.closed = true;
                self.line = None;
                return Ok(None);
            }
        }
        let sent_at = Instant::now() + transmission;
        Ok(Some((sent_at, sent_at + longest + self.pace.timeout)))
    }

    /// Receives until the deadline, until it is enough, or until the connection is closed.
    async fn receive(
        &mut self,
        attempt: &mut Attempt,
        sent_at: Instant,
        deadline: Instant,
        is_enough: impl Fn(&Attempt) -> bool,
    ) {
        let sent = attempt.sent.clone();
        while !is_enough(attempt) {
            let Some(line) = &mut self.line else { return };
            // The reply to a loop-back is its request: only a line that is known to echo sends it twice.
            let has_echo = |attempt: &Attempt| attempt.arrivals.iter().any(|a| matches!(a.item, Item::Echo(_)));
            let may_be_reply = is_loop_back(&sent, self.facts.framing()) && !self.facts.echoes;
            let echo: &[u8] = if may_be_reply || has_echo(attempt) { &[] } else { &sent };
            match timeout_at(deadline, line.receive(sent_at, echo)).await {
                Ok(Ok(Some(arrivals))) => {
                    attempt.arrivals.extend(arrivals);
                    self.facts.echoes |= has_echo(attempt);
                }
                Ok(Ok(None) | Err(_)) => {
                    attempt.closed = true;
                    self.line = None;
                }
                Err(_) => {
                    attempt.arrivals.extend(line.give_up(sent_at, &[]).unwrap_or_default());
                    return;
                }
            }
        }
    }

    /// Receives until this time. Nothing is awaited.
    async fn listen(&mut self, attempt: &mut Attempt, until: Instant, sent_at: Instant) {
        let awaited = attempt.arrivals.len();
        let mut behind = Attempt { sent: attempt.sent.clone(), ..Attempt::default() };
        while let Some(line) = &mut self.line {
            match timeout_at(until, line.receive(sent_at, &[])).await {
                Ok(Ok(Some(arrivals))) => behind.arrivals.extend(arrivals),
                Ok(Ok(None) | Err(_)) => {
                    attempt.closed = true;
                    self.line = None;
                }
                Err(_) => break,
            }
        }
        sleep_until(until).await;
        debug_assert_eq!(attempt.arrivals.len(), awaited);
        attempt.arrivals.extend(unawaited(behind.arrivals));
    }

    /// Separates the replies to an attempt from those to the next one, by the echo of a loop-back, or by silence.
    async fn separate(&mut self, attempt: &mut Attempt) -> Result<(), End> {
        let framing = self.facts.framing();
        if self.facts.has_command(0x4E) != Some(false) {
            for _ in 0..ATTEMPTS {
                self.nonce = self.nonce.wrapping_add(1);
                let request = self.facts.requests.loop_back(format!("{:08X}", self.nonce));
                let bytes = self.facts.requests.encode(&request.frame);
                let mut sync = self.attempt(&request, bytes).await?;
                let echoed = sync.arrivals.iter().position(|arrival| match &arrival.item {
                    Item::Frame(frame, _) => fit(&request, frame, framing) != Answer::None,
                    Item::Echo(_) | Item::Noise(..) => false,
                });
                // Frames before the echo were sent by the PLC before it.
                let before = sync.arrivals.drain(..echoed.unwrap_or(0)).collect();
                attempt.arrivals.extend(unawaited(before));
                self.facts.note(Exchange { ask: Ask::Sync(request), attempts: vec![sync] });
                if echoed.is_some() {
                    return Ok(());
                }
            }
        } else {
            self.listen(attempt, Instant::now() + self.pace.timeout, Instant::now()).await;
        }
        if self.is_alive().await? { Ok(()) } else { Err(End::Silent) }
    }

    /// Returns whether the PLC answers at all: the status, or else a register or a loop-back.
    async fn is_alive(&mut self) -> Result<bool, End> {
        let requests = self.facts.requests;
        let register = requests.read(fatek::command::Code::ReadRegisters, 1, "R0");
        for request in [requests.status(), register, requests.loop_back("alive")] {
            let bytes = requests.encode(&request.frame);
            for _ in 0..ATTEMPTS {
                let attempt = self.attempt(&request, bytes.clone()).await?;
                let is_answered = attempt.frames().next().is_some();
                self.facts.note(Exchange { ask: Ask::Sync(request.clone()), attempts: vec![attempt] });
                if is_answered {
                    return Ok(true);
                }
            }
        }
        Ok(false)
    }
}

fn unawaited(arrivals: Vec<Arrival>) -> impl Iterator<Item = Arrival> {
    arrivals.into_iter().map(|arrival| Arrival { unawaited: true, ..arrival })
}

/// Returns whether an encoded request is a loop-back in the ASCII framing, whose reply is its request.
fn is_loop_back(sent: &[u8], framing: fatek::Framing) -> bool {
    framing == fatek::Framing::Ascii && sent.get(3..5) == Some(b"4E")
}
