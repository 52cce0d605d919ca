//! The steps of client, line and PLC.

use std::fmt;

use super::client::{Ablation, Client, StepOutcome, Wrong};
use super::frame::{Frame, NONCES};
use super::jobs::ModelJob;
use super::requests::Name;
use super::state::{Asked, BROADCASTS, COPIES, LATE, LOSS, ModelState, Out, RECONNECTS};
use crate::command::{Code, CommandSet, Spelling};
use crate::link::in_step::{Check, Choice, Declared, InStep, LongestReads, Shape, Spelled};

/// The faults of a line and a PLC, and the calls of the client.
#[derive(Clone, Copy, Debug)]
pub(super) struct Faults {
    pub(super) name: &'static str,
    pub(super) copies: u8,
    /// Duplicates are answers to a request that a bridge has repeated. They may differ; those of a
    /// page only in being refused.
    pub(super) again: bool,
    /// Duplicates roam: they come at any moment of the next exchanges.
    pub(super) roam: bool,
    pub(super) loss: u8,
    /// Number of replies later than the timeout.
    pub(super) late: u8,
    /// Number of replies to earlier processes that are on their way at the start.
    pub(super) left: usize,
    /// Number of broadcasts that are answered.
    pub(super) broadcasts: u8,
    /// Number of lost connections. Frames on their way come over the next one.
    pub(super) reconnects: u8,
    pub(super) loopback: LoopBack,
    pub(super) calls: &'static [Name],
    /// A refused spelling may be a command that the device lacks.
    pub(super) lacks: bool,
    /// A job of several of these requests.
    pub(super) job: Option<Name>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum LoopBack {
    Known,
    Refused,
    AtTimes,
    /// Not answered, and declared so; the status may be refused.
    Unanswered,
}

/// Number of exchanges in which a roaming duplicate may come.
const LIFE: u8 = 3;

/// Receives a step: its name, the state after it, and a wrong result.
pub(super) type Sink<'a> = dyn FnMut(fmt::Arguments<'_>, ModelState, Option<Wrong>) + 'a;

/// The initial states.
pub(super) fn starts(faults: &Faults, client: &Client) -> Vec<ModelState> {
    let shape = |name| client.request(name).shape(client.request(name).plain());
    let mut shapes: Vec<_> = faults.calls.iter().map(|&name| Frame::of(shape(name), 0)).collect();
    shapes.push(Frame::refusal(shape(Name::Read).code));
    let (echo, refusal) = (Frame::of(Shape { code: Code::LoopBack, size: NONCES }, 0), Frame::refusal(Code::LoopBack));
    shapes.extend(match faults.loopback {
        LoopBack::Known => vec![echo],
        LoopBack::Refused => vec![refusal],
        LoopBack::AtTimes => vec![echo, refusal],
        LoopBack::Unanswered => vec![Frame::of(Check::STATUS, 0), Frame::refusal(Code::ReadStatus)],
    });
    let mut queues = vec![vec![]];
    let mut longest = queues.clone();
    for _ in 0..faults.left {
        let longer = |queue: &Vec<Frame>| shapes.iter().map(|&last| [&queue[..], &[last]].concat()).collect::<Vec<_>>();
        longest = longest.iter().flat_map(longer).collect();
        queues.extend(longest.iter().cloned());
    }
    let mut in_step = InStep::new();
    if client.ablation == Ablation::Suspicion {
        in_step.suspect = None;
    }
    if faults.loopback == LoopBack::Unanswered {
        let mut unanswered = CommandSet::NONE;
        unanswered.insert(Code::LoopBack);
        in_step.declare(Declared { refused: CommandSet::NONE, unanswered, longest: LongestReads::ANY });
    }
    let budget = [faults.copies, faults.loss, faults.late, faults.broadcasts, faults.reconnects];
    let start = |channel| ModelState {
        in_step: in_step.clone(),
        out: None,
        channel,
        roaming: Vec::new(),
        budget,
        wrong: 0,
        job: faults.job.map(ModelJob::new),
    };
    queues.into_iter().map(start).collect()
}

/// All steps from a state.
pub(super) fn steps(faults: &Faults, client: &Client, s: &ModelState, sink: &mut Sink<'_>) {
    if s.out.is_some() || client.ablation != Ablation::ReadFirst {
        arrivals(client, s, sink);
    }
    if let Some(mut after) = s.spends(RECONNECTS) {
        after.ends();
        after.in_step.connected();
        sink(format_args!("the connection is lost, and another is opened"), after, None);
    }
    match &s.out {
        Some(out) => {
            let awaited = s.channel.iter().any(|frame| frame.own);
            let after = if awaited { s.spends(LATE) } else { Some(s.clone()) };
            if let Some(mut after) = after {
                after.ends();
                give(client.timed_out(&after, out), format_args!("    the request"), sink);
            }
        }
        None => idle(faults, client, s, sink),
    }
}

fn give(outcomes: Vec<StepOutcome>, before: fmt::Arguments<'_>, sink: &mut Sink<'_>) {
    for (label, after, wrong) in outcomes {
        sink(format_args!("{before} {label}"), after, wrong);
    }
}

fn arrivals(client: &Client, s: &ModelState, sink: &mut Sink<'_>) {
    for count in 1..=s.channel.len().min(3) {
        let (now, later) = s.channel.split_at(count);
        let mut rest = s.clone();
        rest.channel = later.to_vec();
        let copies = now.iter().filter(|frame| frame.roams);
        rest.roaming.extend(copies.map(|&frame| (Frame { roams: false, copy: true, ..frame }, LIFE)));
        match now {
            [frame] => give(client.receive(&rest, now), format_args!("    comes {frame}:"), sink),
            [reply, behind @ ..] if s.out.as_ref().is_some_and(|out| reply.fits(out.shape)) => {
                let behind = behind.iter().map(Frame::to_string).collect::<Vec<_>>().join("; ");
                give(
                    client.receive(&rest, now),
                    format_args!("    comes {reply}, and in the same read {behind}:"),
                    sink,
                );
            }
            _ => {}
        }
    }
    for place in 0..s.roaming.len() {
        let mut rest = s.clone();
        let (frame, _) = rest.roaming.remove(place);
        give(client.receive(&rest, &[frame]), format_args!("    comes the roaming copy {frame}:"), sink);
    }
}

fn idle(faults: &Faults, client: &Client, s: &ModelState, sink: &mut Sink<'_>) {
    let mut chosen = Vec::new();
    for &name in faults.calls {
        for plain in [false, true] {
            let mut after = s.clone();
            let choice = client.choose(&mut after.in_step, name, plain);
            let next = (Some(name).filter(|_| matches!(choice, Choice::Send(_))), choice, false, false);
            if !chosen.contains(&next) {
                chosen.push(next);
                go_out(faults, client, after, next, sink);
            }
        }
    }
    if let Some(job) = &s.job {
        let mut after = s.clone();
        if !job.must_confirm() {
            for plain in [false, true] {
                let choice = client.choose(&mut after.in_step, job.name, plain);
                go_out(faults, client, after.clone(), (Some(job.name), choice, true, false), sink);
            }
        } else if let Some(choice) = client.confirm(&mut after.in_step) {
            go_out(faults, client, after, (None, choice, true, true), sink);
        } else {
            let wrong = after.job.as_mut().is_some_and(|job| job.confirmed(&mut after.in_step));
            sink(format_args!("the job is confirmed without a check"), after, wrong.then_some(Wrong::InJob));
        }
    }
    // The duplicate of the reply taken last is one of these, or has come. Where duplicates roam,
    // the window must also be longer than the response time: else the true reply to a request that
    // a duplicate has answered comes after it.
    if s.roaming.is_empty() && !s.channel.iter().any(|frame| frame.copy || faults.roam) {
        let mut after = s.clone();
        client.window_passes(&mut after.in_step);
        sink(format_args!("the copy window passes"), after, None);
    }
    if let Some(spent) = s.spends(BROADCASTS) {
        for name in [Name::Write, Name::Run] {
            let shape = client.request(name).shape(client.request(name).plain());
            for answer in [Frame::of(shape, 0), Frame::refusal(shape.code)] {
                let mut after = spent.clone();
                after.channel.push(answer);
                client.broadcast(&mut after.in_step, shape.code);
                sink(format_args!("a broadcast of {name:?} is answered: {answer}"), after, None);
            }
        }
    }
}

/// The next transmission: a call or none, the choice, whether for the job, whether to confirm.
type NextSend = (Option<Name>, Choice, bool, bool);

/// All possible answers of PLC and line to a request.
fn go_out(
    faults: &Faults,
    client: &Client,
    mut s: ModelState,
    (name, choice, in_job, confirms): NextSend,
    sink: &mut Sink<'_>,
) {
    let out = match choice {
        Choice::Silence(_) => {
            if s.channel.is_empty() && s.roaming.is_empty() {
                let mut after = s.clone();
                client.is_silent(&mut after.in_step);
                sink(format_args!("silence, until all has come"), after, None);
            }
            return sink(format_args!("silence begins"), s, None);
        }
        Choice::Send(spelling) => {
            let name = name.unwrap();
            let shape = client.request(name).shape(spelling);
            Out { asked: Asked::Call(name), spelling, shape, in_job }
        }
        Choice::Check(check, _) => {
            let shape = match check {
                // A number that no other nonce has before they are renamed.
                Check::Nonce => Shape { code: Code::LoopBack, size: NONCES + fresh(client) },
                Check::Empty => Check::EMPTY,
                Check::Status => Check::STATUS,
                Check::Detail => Check::DETAIL,
            };
            let spelling = Spelling::new(shape.code, 0);
            Out { asked: Asked::Check { check, confirms }, spelling, shape, in_job }
        }
    };
    s.roaming.retain_mut(|(_, life)| {
        let lives = *life > 0;
        *life = life.saturating_sub(1);
        lives
    });
    s.out = Some(out.clone());
    let answers = answers(faults, &out);
    let what = format!("{:?} {:X}/{} goes out", out.asked, u8::from(out.shape.code), out.shape.size);
    for &answer in &answers {
        let mut after = s.clone();
        after.channel.push(answer);
        sink(format_args!("{what}: {answer}"), after, None);
        // The other answers that a duplicate may be.
        let is_page = out.shape.code == Code::ReadProgramPage;
        let others: Vec<_> = answers
            .iter()
            .filter(|&&other| other == answer || faults.again && (other.refused || answer.refused || !is_page))
            .collect();
        for count in 1..=if faults.roam { s.budget[COPIES].min(1) } else { s.budget[COPIES] } {
            for &&other in &others {
                let mut after = s.clone();
                after.budget[COPIES] -= count;
                after.channel.push(Frame { roams: faults.roam, ..answer });
                if !faults.roam {
                    after.channel.extend((0..count).map(|_| Frame { copy: true, ..other }));
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

fn fresh(client: &Client) -> u32 {
    if client.ablation == Ablation::FreshNonce { 0 } else { 100 }
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
            LoopBack::Unanswered => vec![],
        },
        Asked::Check { .. } if faults.loopback == LoopBack::Unanswered => vec![positive(0), refusal],
        Asked::Check { .. } => vec![positive(0)],
    }
}
