//! Checks of connections: several at once, and idle ones.

use fatek::command::Code;
use fatek::wire::Frame;

use super::Numbers;
use crate::doctor::check::{Check, Finding, Group, Kind, only_over};
use crate::doctor::exchange::{Answer, Ask, Attempt, Exchange, fit};
use crate::doctor::facts::Facts;
use crate::doctor::line::Medium;
use crate::doctor::request::Requests;

/// Connections that a module has at most.
const MODULE_CONNECTIONS: usize = 8;

pub(super) fn checks(requests: Requests, numbers: &Numbers) -> Vec<Check> {
    let (several, idle) = (numbers.connections, numbers.idle);
    let connections = move |facts: &Facts, done: &[Exchange]| {
        (facts.medium == Medium::Tcp && done.is_empty()).then_some(Ask::Connections(several))
    };
    let text = match several {
        0..=MODULE_CONNECTIONS => format!("{several} connections are served at once"),
        _ => format!("{MODULE_CONNECTIONS} of {several} connections are served at once"),
    };
    let id = (Group::Connections, "several", "protocol 7; facts 4, question 6");
    let several = Check::adaptive(id, text, several, connections, |facts, done| {
        let excuse = only_over(facts.medium, &[Medium::Tcp], "TCP");
        excuse.unwrap_or_else(|| several_answered(facts, done))
    });
    let idle_for = move |facts: &Facts, done: &[Exchange]| {
        (facts.medium == Medium::Tcp && done.is_empty()).then_some(Ask::Idle(idle))
    };
    let text = format!("a connection stays open for {} without a request", humantime::format_duration(idle));
    let id = (Group::Connections, "idle", "facts 4, question 6");
    let idle = Check::adaptive(id, text, 1, idle_for, |facts, done| {
        let excuse = only_over(facts.medium, &[Medium::Tcp], "TCP");
        excuse.unwrap_or_else(|| stays_open(facts, done))
    });
    let [first, second] = [3, 4].map(|n| requests.read(Code::ReadRegisters, n, "R0"));
    let ports = move |facts: &Facts, done: &[Exchange]| {
        (facts.medium == Medium::Udp && done.len() < 3).then(|| Ask::TwoPorts(first.clone(), second.clone()))
    };
    let id = (Group::Connections, "asking-port", "protocol 7; rule of order in docs/DESIGN.md");
    let text = "a reply goes to the port that has asked, not to the last one";
    let asking = Check::adaptive(id, text, 6, ports, |facts, done| {
        let excuse = only_over(facts.medium, &[Medium::Udp], "UDP");
        excuse.unwrap_or_else(|| to_asking_port(facts, done))
    });
    vec![several.needs(&[0x40]), idle.kind(Kind::Idle).needs(&[0x40]), asking.kind(Kind::Load).needs(&[0x46])]
}

fn several_answered(facts: &Facts, done: &[Exchange]) -> Finding {
    let attempts: Vec<_> = done.iter().flat_map(|exchange| &exchange.attempts).collect();
    let answered = attempts.iter().filter(|attempt| is_status(facts, attempt)).count();
    let refused = attempts.iter().filter(|attempt| attempt.closed && !is_status(facts, attempt)).count();
    let all = attempts.len();
    let text = format!("{answered} of {all} are answered");
    let with_refused = || format!("{text}, {refused} refused or closed");
    match (answered, all) {
        (_, 0) => Finding::open("nothing was asked"),
        (_, ..=MODULE_CONNECTIONS) if answered == all => Finding::holds(text),
        (_, ..=MODULE_CONNECTIONS) => Finding::contradicts(with_refused()),
        (MODULE_CONNECTIONS, _) => Finding::holds(with_refused()),
        // No source has another number than 8.
        _ => Finding::open(with_refused()),
    }
}

fn stays_open(facts: &Facts, done: &[Exchange]) -> Finding {
    let attempts: Vec<_> = done.iter().flat_map(|exchange| &exchange.attempts).collect();
    match &attempts[..] {
        [] => Finding::open("nothing was asked"),
        [.., last] if is_status(facts, last) => Finding::holds("the next request was answered"),
        all if all.iter().any(|attempt| attempt.closed) => Finding::contradicts("it was closed"),
        [_, requests @ ..] => Finding::contradicts(format!("{} requests were not answered", requests.len())),
    }
}

/// Returns whether a status was answered.
fn is_status(facts: &Facts, attempt: &Attempt) -> bool {
    attempt.reply(&facts.requests.status(), facts.framing()).is_some()
}

fn to_asking_port(facts: &Facts, done: &[Exchange]) -> Finding {
    let (mut own, mut others, mut asked) = (0, 0, 0);
    for exchange in done {
        let Ask::TwoPorts(first, second) = &exchange.ask else { continue };
        for (attempt, request) in exchange.attempts.iter().zip([first, second]) {
            let is_own = |frame: &Frame| fit(request, frame, facts.framing()) != Answer::None;
            let frames: Vec<bool> = attempt.frames().map(|(_, frame, _)| is_own(frame)).collect();
            asked += 1;
            own += usize::from(frames.contains(&true));
            others += usize::from(frames.contains(&false));
        }
    }
    match (own, others) {
        (_, 1..) => Finding::contradicts(format!("{others} of {asked} went to the other port")),
        // The missing ones may have gone to either port.
        (_, 0) if own < asked => Finding::open(format!("{own} of {asked} are answered")),
        (_, 0) if asked == 0 => Finding::open("nothing was asked"),
        (_, 0) => Finding::holds(format!("{own} of {asked} replies, all to the asking port")),
    }
}
