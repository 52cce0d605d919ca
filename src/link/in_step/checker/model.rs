//! The states and steps of client, line and PLC.

use std::fmt;

use super::driver::{Driver, Outcome, Without, Wrong};
use super::jobs::Held;
use super::requests::Name;
use crate::command::{Code, Spelling};
use crate::link::in_step::codes::Codes;
use crate::link::in_step::{Check, Choice, InStep, Proof, Shape, Spelled, Why};

/// What a line and a PLC may do, and what is asked of it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Faults {
    pub(super) name: &'static str,
    pub(super) copies: u8,
    /// Copies answer a request that a bridge has asked again: they may differ, those of a page in being refused only.
    pub(super) again: bool,
    /// Copies come at any moment of the next exchanges.
    pub(super) roam: bool,
    pub(super) loss: u8,
    /// Replies later than the timeout.
    pub(super) late: u8,
    /// Replies to earlier processes, on their way at the start.
    pub(super) left: usize,
    /// Broadcasts that are answered.
    pub(super) broadcasts: u8,
    /// Connections that are lost; what is on its way comes over the next.
    pub(super) reconnects: u8,
    pub(super) loopback: LoopBack,
    pub(super) calls: &'static [Name],
    /// A refused spelling may be a command that the device lacks.
    pub(super) lacks: bool,
    /// Several of these are a job.
    pub(super) job: Option<Name>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum LoopBack {
    Known,
    Refused,
    AtTimes,
}

/// Exchanges in which a roaming copy may come.
const LIFE: u8 = 3;

/// Sizes from here on are nonces.
const NONCES: u32 = 1000;

#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(super) struct Frame {
    pub(super) code: Code,
    /// Of a positive reply.
    size: u32,
    pub(super) refused: bool,
    body: u8,
    /// It answers the request on the wire.
    pub(super) own: bool,
    copy: bool,
    /// A copy of it will come at any moment of the next exchanges.
    roams: bool,
}

impl Frame {
    fn of(shape: Shape, body: u8) -> Self {
        Self { code: shape.code, size: shape.size, refused: false, body, own: false, copy: false, roams: false }
    }

    fn refusal(code: Code) -> Self {
        Self { refused: true, ..Self::of(Shape { code, size: 0 }, 0) }
    }

    pub(super) fn fits(&self, shape: Shape) -> bool {
        self.code == shape.code && (self.refused || self.size == shape.size)
    }

    /// As [`fingerprint`](crate::link::in_step::fingerprint), but so that a nonce can be renamed in it.
    pub(super) fn fingerprint(&self) -> u64 {
        u64::from(u8::from(self.code)) << 40
            | u64::from(self.size) << 8
            | u64::from(self.body) << 1
            | u64::from(self.refused)
    }
}

impl fmt::Display for Frame {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let own = if self.own { "" } else { ", another's" };
        let copy = if self.copy { ", a copy" } else { "" };
        match self.refused {
            true => write!(f, "{:X} refused{own}{copy}", u8::from(self.code)),
            false => write!(f, "{:X}/{} {}{own}{copy}", u8::from(self.code), self.size, self.body),
        }
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(super) enum Asked {
    Call(Name),
    Check { check: Check, confirms: bool },
}

/// The request on the wire.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub(super) struct Out {
    pub(super) asked: Asked,
    pub(super) spelling: Spelling,
    pub(super) shape: Shape,
    /// Sent for the job.
    pub(super) in_job: bool,
}

#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub(super) struct State {
    pub(super) known: InStep,
    pub(super) out: Option<Out>,
    /// Frames on their way, in order.
    chan: Vec<Frame>,
    /// Copies that roam, and the exchanges that they have left.
    bag: Vec<(Frame, u8)>,
    /// Copies, losses, late replies, broadcasts, reconnects.
    budget: [u8; 5],
    /// Wrong results so far.
    pub(super) wrong: u8,
    pub(super) job: Option<Held>,
}

const COPIES: usize = 0;
const LOSS: usize = 1;
const LATE: usize = 2;
const BROADCASTS: usize = 3;
const RECONNECTS: usize = 4;

/// Takes a step: its name, the state after it, and a wrong result.
pub(super) type Sink<'a> = dyn FnMut(fmt::Arguments<'_>, State, Option<Wrong>) + 'a;

impl State {
    /// The exchange is over: what is on its way answers no request on the wire.
    pub(super) fn ends(&mut self) {
        self.out = None;
        self.chan.iter_mut().for_each(|frame| frame.own = false);
        self.bag.iter_mut().for_each(|(frame, _)| frame.own = false);
    }

    pub(super) fn on_its_way(&self) -> impl Iterator<Item = &Frame> {
        self.chan.iter()
    }

    fn spends(&self, what: usize) -> Option<Self> {
        let mut after = self.clone();
        after.budget[what] = self.budget[what].checked_sub(1)?;
        Some(after)
    }

    /// Replaces what makes equal states differ: reasons, the numbers of nonces, and counters that no job looks at.
    pub(super) fn canonical(mut self) -> Self {
        let known = &mut self.known;
        known.silent_since = None;
        known.suspect = known.suspect.map(|_| Why::Connected);
        if self.job.is_none() {
            (known.timed_out, known.proof) = (Codes::NONE, Proof::default());
        }
        known.proof.proofs = known.proof.proofs.min(1);
        known.proof.doubts = known.proof.doubts.min(1);
        self.rename_nonces();
        self
    }

    fn rename_nonces(&mut self) {
        let mut names = Vec::new();
        let mut size = |size: &mut u32| {
            if *size >= NONCES {
                let name = names.iter().position(|name| name == size).unwrap_or_else(|| {
                    names.push(*size);
                    names.len() - 1
                });
                *size = NONCES + u32::try_from(name).unwrap();
            }
        };
        if let Some(out) = &mut self.out {
            size(&mut out.shape.size);
        }
        self.chan.iter_mut().chain(self.bag.iter_mut().map(|(frame, _)| frame)).for_each(|frame| size(&mut frame.size));
        let mut fingerprint = |fingerprint: &mut u64| {
            let mut renamed = u32::try_from(*fingerprint >> 8 & 0xFFFF_FFFF).unwrap();
            size(&mut renamed);
            *fingerprint = *fingerprint & !(0xFFFF_FFFF << 8) | u64::from(renamed) << 8;
        };
        let known = &mut self.known;
        known.last.iter_mut().for_each(&mut fingerprint);
        for taken in known.taken.iter_mut().chain(&mut known.older) {
            taken.fingerprint.iter_mut().for_each(&mut fingerprint);
        }
        known.taken.iter_mut().chain(&mut known.older).for_each(|taken| size(&mut taken.shape.size));
    }
}

/// The states in which a client may start.
pub(super) fn starts(faults: &Faults, driver: &Driver) -> Vec<State> {
    let shape = |name| driver.request(name).shape(driver.request(name).plain());
    let mut shapes: Vec<_> = faults.calls.iter().map(|&name| Frame::of(shape(name), 0)).collect();
    shapes.push(Frame::refusal(shape(Name::Read).code));
    if faults.loopback != LoopBack::Refused {
        shapes.push(Frame::of(Shape { code: Code::LoopBack, size: NONCES }, 0));
    }
    if faults.loopback != LoopBack::Known {
        shapes.push(Frame::refusal(Code::LoopBack));
    }
    let mut queues = vec![vec![]];
    let mut longest = queues.clone();
    for _ in 0..faults.left {
        let longer = |queue: &Vec<Frame>| shapes.iter().map(|&last| [&queue[..], &[last]].concat()).collect::<Vec<_>>();
        longest = longest.iter().flat_map(longer).collect();
        queues.extend(longest.iter().cloned());
    }
    let mut known = InStep::new();
    if driver.without == Without::Suspicion {
        known.suspect = None;
    }
    let budget = [faults.copies, faults.loss, faults.late, faults.broadcasts, faults.reconnects];
    let start = |chan| State {
        known: known.clone(),
        out: None,
        chan,
        bag: Vec::new(),
        budget,
        wrong: 0,
        job: faults.job.map(Held::new),
    };
    queues.into_iter().map(start).collect()
}

/// All steps from a state.
pub(super) fn steps(faults: &Faults, driver: &Driver, s: &State, sink: &mut Sink<'_>) {
    if s.out.is_some() || driver.without != Without::ReadFirst {
        arrivals(driver, s, sink);
    }
    if let Some(mut after) = s.spends(RECONNECTS) {
        after.ends();
        after.known.connected();
        sink(format_args!("the connection is lost, and another is opened"), after, None);
    }
    match &s.out {
        Some(out) => {
            let awaited = s.chan.iter().any(|frame| frame.own);
            let after = if awaited { s.spends(LATE) } else { Some(s.clone()) };
            if let Some(mut after) = after {
                after.ends();
                give(driver.timed_out(&after, out), format_args!("    the request"), sink);
            }
        }
        None => idle(faults, driver, s, sink),
    }
}

fn give(outcomes: Vec<Outcome>, before: fmt::Arguments<'_>, sink: &mut Sink<'_>) {
    for (label, after, wrong) in outcomes {
        sink(format_args!("{before} {label}"), after, wrong);
    }
}

fn arrivals(driver: &Driver, s: &State, sink: &mut Sink<'_>) {
    for count in 1..=s.chan.len().min(3) {
        let (now, later) = s.chan.split_at(count);
        let mut rest = s.clone();
        rest.chan = later.to_vec();
        let copies = now.iter().filter(|frame| frame.roams);
        rest.bag.extend(copies.map(|&frame| (Frame { roams: false, copy: true, ..frame }, LIFE)));
        match now {
            [frame] => give(driver.hears(&rest, now), format_args!("    comes {frame}:"), sink),
            [reply, behind @ ..] if s.out.as_ref().is_some_and(|out| reply.fits(out.shape)) => {
                let behind = behind.iter().map(Frame::to_string).collect::<Vec<_>>().join("; ");
                give(driver.hears(&rest, now), format_args!("    comes {reply}, and in the same read {behind}:"), sink);
            }
            _ => {}
        }
    }
    for place in 0..s.bag.len() {
        let mut rest = s.clone();
        let (frame, _) = rest.bag.remove(place);
        give(driver.hears(&rest, &[frame]), format_args!("    comes the roaming copy {frame}:"), sink);
    }
}

fn idle(faults: &Faults, driver: &Driver, s: &State, sink: &mut Sink<'_>) {
    let mut chosen = Vec::new();
    for &name in faults.calls {
        for plain in [false, true] {
            let mut after = s.clone();
            let choice = driver.choose(&mut after.known, name, plain);
            let next = (Some(name).filter(|_| matches!(choice, Choice::Send(_))), choice, false, false);
            if !chosen.contains(&next) {
                chosen.push(next);
                go_out(faults, driver, after, next, sink);
            }
        }
    }
    if let Some(job) = &s.job {
        let mut after = s.clone();
        if !job.must_confirm() {
            for plain in [false, true] {
                let choice = driver.choose(&mut after.known, job.name, plain);
                go_out(faults, driver, after.clone(), (Some(job.name), choice, true, false), sink);
            }
        } else if let Some(choice) = driver.confirm(&mut after.known) {
            go_out(faults, driver, after, (None, choice, true, true), sink);
        } else {
            let wrong = after.job.as_mut().is_some_and(|job| job.confirmed(&mut after.known));
            sink(format_args!("the job is confirmed without a check"), after, wrong.then_some(Wrong::InJob));
        }
    }
    // The copy of the reply taken last is one of these, or has come. Where copies roam, the window must also be longer than
    // the PLC takes: else the true reply to a request that a copy has answered comes after it.
    if s.bag.is_empty() && !s.chan.iter().any(|frame| frame.copy || faults.roam) {
        let mut after = s.clone();
        driver.window_passes(&mut after.known);
        sink(format_args!("the copy window passes"), after, None);
    }
    if let Some(spent) = s.spends(BROADCASTS) {
        for name in [Name::Write, Name::Run] {
            let shape = driver.request(name).shape(driver.request(name).plain());
            for answer in [Frame::of(shape, 0), Frame::refusal(shape.code)] {
                let mut after = spent.clone();
                after.chan.push(answer);
                driver.broadcast(&mut after.known, shape.code);
                sink(format_args!("a broadcast of {name:?} is answered: {answer}"), after, None);
            }
        }
    }
}

/// What goes out: a call or none, the choice, whether for the job, and whether to confirm it.
type Next = (Option<Name>, Choice, bool, bool);

/// All that the PLC and the line may make of a request.
fn go_out(faults: &Faults, driver: &Driver, mut s: State, (name, choice, in_job, confirms): Next, sink: &mut Sink<'_>) {
    let out = match choice {
        Choice::Silence(_) => {
            if s.chan.is_empty() && s.bag.is_empty() {
                let mut after = s.clone();
                driver.is_silent(&mut after.known);
                sink(format_args!("silence, until all has come"), after, None);
            }
            return sink(format_args!("silence begins"), s, None);
        }
        Choice::Send(spelling) => {
            let name = name.unwrap();
            let shape = driver.request(name).shape(spelling);
            Out { asked: Asked::Call(name), spelling, shape, in_job }
        }
        Choice::Check(check, _) => {
            let shape = match check {
                // A number that no other nonce has before they are renamed.
                Check::Nonce => Shape { code: Code::LoopBack, size: NONCES + fresh(driver) },
                Check::Empty => Check::EMPTY,
                Check::Status => Check::STATUS,
                Check::Detail => Check::DETAIL,
            };
            let spelling = Spelling::new(shape.code, 0);
            Out { asked: Asked::Check { check, confirms }, spelling, shape, in_job }
        }
    };
    s.bag.retain_mut(|(_, life)| {
        let lives = *life > 0;
        *life = life.saturating_sub(1);
        lives
    });
    s.out = Some(out.clone());
    let answers = answers(faults, &out);
    let what = format!("{:?} {:X}/{} goes out", out.asked, u8::from(out.shape.code), out.shape.size);
    for &answer in &answers {
        let mut after = s.clone();
        after.chan.push(answer);
        sink(format_args!("{what}: {answer}"), after, None);
        // The other answers that a copy may be.
        let is_page = out.shape.code == Code::ReadProgramPage;
        let others: Vec<_> = answers
            .iter()
            .filter(|&&other| other == answer || faults.again && (other.refused || answer.refused || !is_page))
            .collect();
        for count in 1..=if faults.roam { s.budget[COPIES].min(1) } else { s.budget[COPIES] } {
            for &&other in &others {
                let mut after = s.clone();
                after.budget[COPIES] -= count;
                after.chan.push(Frame { roams: faults.roam, ..answer });
                if !faults.roam {
                    after.chan.extend((0..count).map(|_| Frame { copy: true, ..other }));
                }
                sink(format_args!("{what}: {answer}, then {count} x {other}, roaming: {}", faults.roam), after, None);
                if faults.roam {
                    break;
                }
            }
        }
    }
    if let Some(after) = s.spends(LOSS) {
        sink(format_args!("{what}, and its reply is lost"), after, None);
    }
}

fn fresh(driver: &Driver) -> u32 {
    if driver.without == Without::FreshNonce { 0 } else { 100 }
}

fn answers(faults: &Faults, out: &Out) -> Vec<Frame> {
    let own = |frame| Frame { own: true, ..frame };
    let (positive, refusal) = (|body| own(Frame::of(out.shape, body)), own(Frame::refusal(out.shape.code)));
    match out.asked {
        Asked::Call(Name::Read) if faults.roam => vec![positive(0), positive(1), refusal],
        Asked::Call(Name::Page) => vec![positive(0), positive(1), refusal],
        Asked::Call(_) => vec![positive(0), refusal],
        Asked::Check { check: Check::Nonce | Check::Empty, .. } => match faults.loopback {
            LoopBack::Known => vec![positive(0)],
            LoopBack::Refused => vec![refusal],
            LoopBack::AtTimes => vec![positive(0), refusal],
        },
        Asked::Check { .. } => vec![positive(0)],
    }
}
