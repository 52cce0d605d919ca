//! Test rig: a [`StationPoller`] with a fake PLC, in simulated time.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use tokio::time::Instant;

use crate::command::{Code, Value};
use crate::element::{Element, Symbol, Width};
use crate::error::{Error, ErrorCode};
use crate::link::{Proof, Shape};
use crate::plan::{CostModel, Limits, ReadRequest, Reply};
use crate::poll::context::StationParams;
use crate::poll::schedule::{LineSchedule, PollerSchedule};
use crate::poll::station_poller::{PollStep, ReadOutcome, StationPoller};
use crate::poll::{PollError, PollTag, Sample, ScanClass, Stamp, TagId};
use crate::random::Random;
use crate::tag::Tag;
use crate::wire::Framing;

pub(super) fn ms(milliseconds: u64) -> Duration {
    Duration::from_millis(milliseconds)
}

pub(super) fn tag(text: &str) -> Tag {
    text.parse().unwrap()
}

pub(super) fn tags(texts: &[&str]) -> Vec<PollTag> {
    texts.iter().map(|text| PollTag::from(tag(text))).collect()
}

pub(super) struct TestRig {
    pub(super) poller: StationPoller,
    pub(super) plc: FakePlc,
    pub(super) now: Instant,
    pub(super) start: Instant,
    pub(super) samples: Vec<Sample>,
    /// The number of samples that [`new_samples`](Self::new_samples) has returned.
    seen: usize,
    next_id: u64,
    answers: u32,
    /// Cycles that dropped results because of duplicates.
    pub(super) repeated: u32,
}

/// A PLC whose memory changes with each request, so that a value identifies its request.
pub(super) struct FakePlc {
    pub(super) refused: BTreeSet<(Symbol, u16)>,
    pub(super) refuses_all: bool,
    pub(super) mixed: bool,
    /// `false` if it refuses words of discretes.
    pub(super) words: bool,
    /// It refuses words of the discretes with this symbol.
    pub(super) refuses_words_of: Option<Symbol>,
    /// The error code of refused words and mixed reads.
    pub(super) code: ErrorCode,
    pub(super) max_mixed: usize,
    /// The error code of requests that are too long.
    pub(super) length_code: ErrorCode,
    pub(super) max_registers: usize,
    pub(super) max_points: usize,
    pub(super) silent: bool,
    /// Requests that read this have no reply.
    pub(super) ignored: Option<(Symbol, u16)>,
    pub(super) response_time: Duration,
    pub(super) timeout: Duration,
    /// `true` if the memory is constant.
    pub(super) frozen: bool,
    pub(super) requests: Vec<(Instant, ReadRequest)>,
    /// The version of the memory at the time of each reply.
    pub(super) epochs: BTreeMap<Instant, u64>,
    /// `true` if all replies have the same shape; otherwise each has a distinct one.
    pub(super) one_shape: bool,
    /// From this request on, counted from 1, one reply is a roaming duplicate.
    ///
    /// It is the reply two requests before, if that has the same shape. The true reply comes as a
    /// stray before the next reply.
    pub(super) roams_at: Option<usize>,
    /// The number of roaming duplicates.
    pub(super) roamed: usize,
    /// `true` if a stray comes before the next reply.
    pub(super) stray_due: bool,
    last: Vec<(ReadRequest, Reply)>,
    pub(super) checks: u32,
    proof: Proof,
}

impl Default for FakePlc {
    fn default() -> Self {
        Self {
            refused: BTreeSet::new(),
            refuses_all: false,
            mixed: true,
            words: true,
            refuses_words_of: None,
            code: ErrorCode::IllegalFormat,
            max_mixed: 64,
            length_code: ErrorCode::IllegalAddress,
            max_registers: 64,
            max_points: 256,
            silent: false,
            ignored: None,
            response_time: ms(5),
            timeout: ms(300),
            frozen: false,
            requests: Vec::new(),
            epochs: BTreeMap::new(),
            one_shape: false,
            roams_at: None,
            roamed: 0,
            stray_due: false,
            last: Vec::new(),
            checks: 0,
            proof: Proof::default(),
        }
    }
}

/// The 16-bit cells of an element.
pub(super) fn cells(element: Element) -> Vec<(Symbol, u16)> {
    match element {
        Element::Register32(e) if !element.is_counter_of_32_bits() => {
            let low = e.symbol().halved();
            vec![(low, e.address()), (low, e.address() + low.step())]
        }
        other => vec![(other.symbol(), other.address())],
    }
}

fn word(epoch: u64, (symbol, address): (Symbol, u16)) -> u16 {
    let smallest = symbol.area().smallest();
    if smallest.width() == Width::Bit && symbol != smallest {
        return (0..16).map(|bit| (word(epoch, (smallest, address + bit)) & 1) << bit).sum();
    }
    let seed = epoch << 32 | u64::from(address) << 8 | symbol as u64;
    u16::try_from(Random::new(seed).next() & 0xFFFF).unwrap()
}

pub(super) fn value(epoch: u64, element: Element) -> Value {
    let words: Vec<u16> = cells(element).into_iter().map(|cell| word(epoch, cell)).collect();
    match element.width() {
        Width::Bit => Value::Bit(words[0] & 1 == 1),
        Width::Word => Value::Word(words[0]),
        Width::DWord => Value::DWord(u32::from(words.get(1).copied().unwrap_or(7)) << 16 | u32::from(words[0])),
    }
}

pub(super) fn elements(request: &ReadRequest) -> Vec<Element> {
    let run = |first: Element, count: usize| (0..count).map(|n| first.nth(n).unwrap()).collect();
    match request {
        ReadRequest::Discretes(r) => run(r.first().into(), r.count()),
        ReadRequest::Registers(r) => run(r.first().into(), r.count()),
        ReadRequest::Registers32(r) => run(r.first().into(), r.count()),
        ReadRequest::Mixed(r) => r.elements().to_vec(),
    }
}

impl FakePlc {
    fn takes(&self, request: &ReadRequest) -> Result<(), ErrorCode> {
        let elements = elements(request);
        let fits = match request {
            ReadRequest::Discretes(r) => r.count() <= self.max_points,
            ReadRequest::Registers(r) => r.count() <= self.max_registers,
            ReadRequest::Registers32(r) => r.count() * 2 <= self.max_registers,
            ReadRequest::Mixed(_) if !self.mixed => return Err(self.code),
            ReadRequest::Mixed(r) => r.elements().iter().map(|e| e.width().units()).sum::<usize>() <= self.max_mixed,
        };
        let lacks = |element: &Element| cells(*element).into_iter().any(|(symbol, _)| self.lacks_words(symbol));
        if elements.iter().any(lacks) {
            return Err(self.code);
        }
        if !fits {
            return Err(self.length_code);
        }
        let refused = elements.into_iter().flat_map(cells).any(|cell| self.refuses_cell(cell));
        if refused || self.refuses_all { Err(ErrorCode::IllegalAddress) } else { Ok(()) }
    }

    /// Returns the reply and how long it takes.
    fn reply_to(&mut self, at: Instant, request: &ReadRequest) -> (Result<Reply, Error>, Duration) {
        self.requests.push((at, request.clone()));
        let code = Code::ReadRegisters;
        let silent = self.ignored.is_some_and(|cell| elements(request).into_iter().flat_map(cells).any(|c| c == cell));
        if self.silent || silent {
            let error = Error::timeout(1, code, self.timeout, true);
            return (Err(error), self.timeout);
        }
        if let Err(error) = self.takes(request) {
            return (Err(Error::Plc { station: 1, code, error, repeated: false }), self.response_time);
        }
        let epoch = if self.frozen { 0 } else { self.requests.len() as u64 };
        self.epochs.insert(at + self.response_time, epoch);
        let values: Vec<Value> = elements(request).into_iter().map(|element| value(epoch, element)).collect();
        let bits = |value: &Value| if let Value::Bit(on) = value { *on } else { panic!("{value:?}") };
        let words = |value: &Value| if let Value::Word(word) = value { *word } else { panic!("{value:?}") };
        let dwords = |value: &Value| if let Value::DWord(double) = value { *double } else { panic!("{value:?}") };
        let reply = match request {
            ReadRequest::Discretes(_) => Reply::Bits(values.iter().map(bits).collect()),
            ReadRequest::Registers(_) => Reply::Words(values.iter().map(words).collect()),
            ReadRequest::Registers32(_) => Reply::DWords(values.iter().map(dwords).collect()),
            ReadRequest::Mixed(_) => Reply::Mixed(values),
        };
        self.last.push((request.clone(), reply.clone()));
        let fits = |copied: &ReadRequest| {
            std::mem::discriminant(copied) == std::mem::discriminant(request)
                && elements(copied).len() == elements(request).len()
        };
        let copy = self.last.iter().rev().nth(2).filter(|(copied, _)| fits(copied));
        if let (Some((_, copy)), true) = (copy, self.roams_at.is_some_and(|at| self.requests.len() >= at)) {
            (self.roams_at, self.stray_due) = (None, true);
            self.roamed += 1;
            return (Ok(copy.clone()), self.response_time);
        }
        (Ok(reply), self.response_time)
    }

    /// Returns the result of a check, which takes no time.
    fn check(&mut self) -> (Result<Proof, Error>, Duration) {
        self.checks += 1;
        if self.silent {
            let code = Code::LoopBack;
            return (Err(Error::timeout(1, code, self.timeout, true)), self.timeout);
        }
        self.stray();
        self.proof.proofs += 1;
        (Ok(self.proof), Duration::ZERO)
    }

    /// Lets a stray arrive that is due.
    fn stray(&mut self) {
        self.proof.doubts += u32::from(std::mem::take(&mut self.stray_due));
    }

    /// Returns whether it refuses a request for this tag alone.
    pub(super) fn refuses(&self, tag: Tag) -> bool {
        tag.elements().flat_map(cells).any(|cell| self.refuses_cell(cell))
    }

    fn lacks_words(&self, symbol: Symbol) -> bool {
        let smallest = symbol.area().smallest();
        let is_word = smallest.width() == Width::Bit && symbol != smallest;
        is_word && (!self.words || self.refuses_words_of == Some(smallest))
    }

    /// A word is refused with any of its discretes.
    fn refuses_cell(&self, (symbol, address): (Symbol, u16)) -> bool {
        let smallest = symbol.area().smallest();
        let is_word = smallest.width() == Width::Bit && symbol != smallest;
        let has_refused = |bit| self.refused.contains(&(smallest, address.saturating_add(bit)));
        self.refused.contains(&(symbol, address)) || is_word && (self.lacks_words(symbol) || (0..16).any(has_refused))
    }
}

/// The schedule of a line with one station.
pub(super) fn line(epoch: Instant) -> Arc<LineSchedule> {
    Arc::new(LineSchedule::new(Arc::new(PollerSchedule::new(epoch))))
}

impl TestRig {
    pub(super) fn new(seed: u64) -> Self {
        Self::with_limits(seed, Limits::new())
    }

    pub(super) fn with_limits(seed: u64, limits: Limits) -> Self {
        let start = Instant::now();
        Self {
            poller: StationPoller::new(
                StationParams { station: 1, retries: 2 },
                (Arc::new(limits), CostModel::network(Framing::Ascii, ms(5))),
                line(start),
                seed,
                Arc::default(),
            ),
            plc: FakePlc::default(),
            now: start,
            start,
            samples: Vec::new(),
            seen: 0,
            next_id: 1,
            answers: 0,
            repeated: 0,
        }
    }

    pub(super) fn stamp(&self) -> Stamp {
        let time = SystemTime::UNIX_EPOCH + self.now.duration_since(self.start);
        Stamp { instant: self.now, time }
    }

    pub(super) fn try_add(
        &mut self,
        class: ScanClass,
        tags: Vec<PollTag>,
        one_scan: bool,
    ) -> Result<Vec<TagId>, PollError> {
        let first = self.next_id;
        self.next_id += tags.len() as u64;
        let ids: Vec<TagId> = (first..self.next_id).map(TagId).collect();
        let tags = ids.iter().copied().zip(tags).collect();
        self.poller.add(class, tags, one_scan, self.stamp())?;
        Ok(ids)
    }

    pub(super) fn add(&mut self, class: ScanClass, texts: &[&str]) -> Vec<TagId> {
        self.try_add(class, tags(texts), false).unwrap()
    }

    /// Takes one step: request, check or wait. Returns `false` if nothing is due before `end`.
    pub(super) fn step(&mut self, end: Instant) -> bool {
        let mut samples = Vec::new();
        let step = self.poller.next_step(self.stamp(), &mut samples);
        self.samples.append(&mut samples);
        match step {
            PollStep::Read(request) => {
                self.plc.stray();
                let (result, takes) = self.plc.reply_to(self.now, &request);
                self.wait(takes, &mut samples);
                self.answer(result, Some(takes), &mut samples);
                self.samples.append(&mut samples);
                true
            }
            PollStep::Confirm => {
                self.confirm(&mut samples);
                self.samples.append(&mut samples);
                true
            }
            PollStep::Wait(until) => {
                let until = until.filter(|until| *until <= end);
                assert!(until.is_none_or(|until| until > self.now), "waits for a time in the past: {until:?}");
                self.now = until.unwrap_or(end.max(self.now));
                until.is_some()
            }
        }
    }

    /// Ends the request in flight with this result.
    pub(super) fn answer(
        &mut self,
        result: Result<Reply, Error>,
        round_trip: Option<Duration>,
        samples: &mut Vec<Sample>,
    ) {
        self.answers += 1;
        let size = if self.plc.one_shape { 0 } else { self.answers };
        let shape = Shape { code: Code::ReadRegisters, size };
        let outcome = ReadOutcome { result, at: self.stamp(), round_trip, shape, proof: self.plc.proof };
        self.repeated += u32::from(self.poller.handle_read(outcome, samples));
    }

    /// Ends the check in flight.
    pub(super) fn confirm(&mut self, samples: &mut Vec<Sample>) {
        let (result, takes) = self.plc.check();
        self.wait(takes, samples);
        let now = self.stamp();
        self.repeated += u32::from(self.poller.handle_check(result, now, samples));
    }

    /// Returns the request that is due now, if any. Ends the checks before it.
    pub(super) fn request(&mut self, samples: &mut Vec<Sample>) -> Option<ReadRequest> {
        loop {
            match self.poller.next_step(self.stamp(), samples) {
                PollStep::Read(request) => return Some(*request),
                PollStep::Confirm => self.confirm(samples),
                PollStep::Wait(_) => return None,
            }
        }
    }

    /// Waits for a reply and ages the tags meanwhile, as the driver does.
    fn wait(&mut self, takes: Duration, samples: &mut Vec<Sample>) {
        let done = self.now + takes;
        while let Some(at) = self.poller.next_aging().filter(|at| *at < done) {
            self.now = self.now.max(at);
            self.poller.age(self.stamp(), samples);
        }
        self.now = done;
    }

    pub(super) fn run_until(&mut self, end: Instant) {
        while self.now <= end && self.step(end) {}
    }

    pub(super) fn run(&mut self, by: Duration) {
        self.run_until(self.now + by);
    }

    /// Returns the samples since the previous call.
    pub(super) fn new_samples(&mut self) -> Vec<Sample> {
        let samples = self.samples[self.seen..].to_vec();
        self.seen = self.samples.len();
        samples
    }

    /// Returns the requests since the previous call.
    pub(super) fn take_requests(&mut self) -> Vec<ReadRequest> {
        std::mem::take(&mut self.plc.requests).into_iter().map(|(_, request)| request).collect()
    }

    /// Returns the current sample of a tag. Keeps the samples that the call makes.
    pub(super) fn latest(&mut self, id: TagId) -> Sample {
        let now = self.stamp();
        self.poller.sample(id, now, &mut self.samples).expect("the tag is polled")
    }
}
