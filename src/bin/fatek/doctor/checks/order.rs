//! Checks of order: requests close behind each other.

use bytes::Bytes;
use fatek::command::Code;

use crate::doctor::check::{Check, Finding, Group, Kind};
use crate::doctor::exchange::{Ask, Attempt, Exchange};
use crate::doctor::facts::Facts;
use crate::doctor::line::Medium;
use crate::doctor::request::{Request, Requests, Shape};

/// Requests that are sent together, at most.
const TOGETHER: u16 = 3;

pub(super) fn checks(requests: Requests, load: usize) -> Vec<Check> {
    let burst = move |first: u16| {
        let sizes = (0..TOGETHER).map(|n| (first + n) % 5 + 1);
        sizes.map(|n| requests.read(Code::ReadRegisters, n, "R8")).collect::<Vec<_>>()
    };
    let rounds = load.div_ceil(usize::from(TOGETHER));
    let in_order = move |facts: &Facts, done: &[Exchange]| {
        // A line for one direction at a time takes no second request.
        let next = u16::try_from(done.len()).ok().filter(|_| done.len() < rounds && takes_several(facts))?;
        Some(Ask::Burst(burst(next)))
    };
    let judge_order = |facts: &Facts, done: &[Exchange]| {
        if takes_several(facts) { order_of_bursts(done) } else { Finding::open(ONE_DIRECTION) }
    };
    let text = "requests that are sent together are answered in their order";
    let id = (Group::Order, "in-order", "protocol 7; rule of order in docs/DESIGN.md");
    let order = Check::adaptive(id, text, rounds * usize::from(TOGETHER), in_order, judge_order);

    let nonces = ["AAAA1111", "BBBB2222", "CCCC3333", "DDDD4444"];
    let abandoned = move |facts: &Facts, done: &[Exchange]| {
        let nonce = nonces.get(done.len()).filter(|_| takes_several(facts))?;
        let read = requests.read(Code::ReadRegisters, 7, "R16");
        Some(Ask::Burst(vec![read, requests.loop_back(*nonce)]))
    };
    let judge_abandoned = |facts: &Facts, done: &[Exchange]| {
        if takes_several(facts) { echo_is_last(done) } else { Finding::open(ONE_DIRECTION) }
    };
    let text = "behind the echo of a loop-back comes no reply to a request before it";
    let id = (Group::Order, "echo-is-last", "protocol 7; rule of order in docs/DESIGN.md");
    let in_step = Check::adaptive(id, text, 2 * nonces.len(), abandoned, judge_abandoned);
    // Each reply has another length than those before it, so that a late one shows.
    let sizes = (0..2 * load).map(|n| u16::try_from(n % 5 + 1).unwrap_or(1));
    let reads = sizes.map(|n| requests.read(Code::ReadRegisters, n, "R24")).collect();
    let text = "requests without a pause between them are each answered once";
    let id = (Group::Order, "without-pause", "protocol 7; rule of order in docs/DESIGN.md");
    let without_pause = Check::fixed(id, text, vec![Ask::Load(reads)], answered_once).kind(Kind::Load).needs(&[0x46]);
    vec![without_pause, order.kind(Kind::Load).needs(&[0x46]), in_step.kind(Kind::Load).needs(&[0x46, 0x4E])]
}

/// The reason why a line is not examined.
const ONE_DIRECTION: &str = "not examined: a line for one direction at a time";

/// Returns whether the line takes a request while the PLC works on another one.
fn takes_several(facts: &Facts) -> bool {
    facts.medium != Medium::Serial && !facts.echoes
}

/// The places of the requests that the replies belong to, in the order of the replies.
///
/// Each request of a burst asks for a length of its own.
fn places(requests: &[Request], attempt: &Attempt) -> Vec<usize> {
    let fits = |data: &Bytes, command: u8, request: &Request| {
        request.frame.command == command
            && match request.shape {
                Shape::Len(len) => data.len() == len + ERROR_CODE,
                Shape::Echo => *data == request.frame.data,
                Shape::AtLeast(_) | Shape::Page | Shape::Any => false,
            }
    };
    let place = |(_, frame, _): (_, &fatek::wire::Frame, _)| {
        requests.iter().position(|request| fits(&frame.data, frame.command, request))
    };
    attempt.frames().filter_map(place).collect()
}

/// Characters or bytes of an error code.
const ERROR_CODE: usize = 1;

fn bursts(done: &[Exchange]) -> impl Iterator<Item = (&[Request], &Attempt)> {
    done.iter().filter_map(|exchange| match &exchange.ask {
        Ask::Burst(requests) => Some((&requests[..], exchange.attempts.first()?)),
        Ask::Load(_)
        | Ask::Reply(_)
        | Ask::Once(_)
        | Ask::Silence(..)
        | Ask::Connections(_)
        | Ask::Idle(_)
        | Ask::TwoPorts(..)
        | Ask::Sync(_) => None,
    })
}

fn answered_once(facts: &Facts, done: &[Exchange]) -> Finding {
    let Some((Ask::Load(requests), attempts)) = done.first().map(|exchange| (&exchange.ask, &exchange.attempts)) else {
        return Finding::open("nothing was asked");
    };
    let answered =
        requests.iter().zip(attempts).filter(|(request, a)| a.reply(request, facts.framing()).is_some()).count();
    let frames: usize = attempts.iter().map(|attempt| attempt.frames().count()).sum();
    match (requests.len() - answered, frames.saturating_sub(answered)) {
        (0, 0) => Finding::holds(format!("{answered} requests")),
        (lost, others) => Finding::contradicts(format!(
            "of {} requests {lost} without a reply; {others} other frames",
            requests.len()
        )),
    }
}

fn order_of_bursts(done: &[Exchange]) -> Finding {
    let (mut answered, mut asked, mut reversed) = (0, 0, 0);
    for (requests, attempt) in bursts(done) {
        // A duplicate may come behind the next reply.
        let mut first = Vec::new();
        places(requests, attempt).into_iter().for_each(|place| {
            if !first.contains(&place) {
                first.push(place);
            }
        });
        let places = first;
        reversed += usize::from(!places.is_sorted());
        (answered, asked) = (answered + places.len(), asked + requests.len());
    }
    match (reversed, answered) {
        (1.., _) => Finding::contradicts(format!("{reversed} of {} times in another order", done.len())),
        (0, 0) => Finding::open("none of them was answered"),
        (0, _) if answered < asked => {
            Finding::contradicts(format!("{answered} of {asked} are answered, in their order"))
        }
        (0, _) => Finding::holds(format!("{asked} requests, {} at a time", asked / done.len().max(1))),
    }
}

fn echo_is_last(done: &[Exchange]) -> Finding {
    let (mut echoes, mut reads, mut behind) = (0, 0, 0);
    for (requests, attempt) in bursts(done) {
        let places = places(requests, attempt);
        let echo = places.iter().position(|&place| place == 1);
        echoes += usize::from(echo.is_some());
        reads += usize::from(places.contains(&0));
        behind += usize::from(echo.is_some_and(|echo| places.iter().skip(echo).any(|&place| place == 0)));
    }
    match (behind, echoes) {
        (1.., _) => Finding::contradicts(format!("{behind} of {} times a reply came behind the echo", done.len())),
        (0, echoes) if echoes < done.len() => {
            Finding::contradicts(format!("{echoes} of {} loop-backs close behind a read are answered", done.len()))
        }
        // A reply that did not come may come behind the echo.
        (0, _) if reads < done.len() => Finding::open(format!("{reads} of {} reads are answered", done.len())),
        (0, _) => Finding::holds(format!("{echoes} loop-backs close behind a read")),
    }
}
