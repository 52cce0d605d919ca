//! Checks of wrong requests: error codes, and requests that are not answered.

use fatek::command::Code;
use fatek::wire::Frame;

use super::{refusals, replies};
use crate::doctor::check::{Check, Finding, Group, Kind};
use crate::doctor::exchange::{Answer, Ask, Exchange, fit};
use crate::doctor::facts::Facts;
use crate::doctor::request::{Request, Requests, Shape};

/// Station numbers that are seldom in use.
const OTHERS: [u8; 4] = [254, 251, 247, 239];
/// Requests without an answer that show that there is none: one request or reply may be lost.
const SILENCES: usize = 2;

pub(super) fn checks(requests: Requests) -> Vec<Check> {
    let read = |first: &str| requests.read(Code::ReadRegisters, 1, first);
    let refused = |name: &'static str, source, text: &str, request: Request, codes| {
        let check = Check::fixed((Group::Errors, name, source), text, replies([request]), refusals(codes));
        check.kind(Kind::Basic).needs(&[0x46])
    };
    let incomplete = requests.raw(Code::ReadRegisters.into(), requests.count(1), Shape::Any);
    vec![
        refused(
            "bad-address",
            "protocol 4",
            "a register beyond all models is refused with error A",
            read("R65535"),
            &[10],
        ),
        refused("bad-symbol", "protocol 4", "an unknown kind of element is refused with error 4", read("QQ0"), &[4]),
        refused("no-element", "protocol 4", "a read without an element is refused with error 4", incomplete, &[4]),
        refused("bad-word", "protocol 3", "a word of discretes at WM4 is refused with error A", read("WM4"), &[10]),
        unanswered_checksum(requests),
        unanswered_station(requests),
        unanswered_broadcast(requests),
    ]
}

fn unanswered_checksum(requests: Requests) -> Check {
    let request = requests.status();
    let bytes = requests.corrupt(&request.frame);
    let text = "a request with a wrong checksum is not answered";
    let check = Check::fixed(
        (Group::Errors, "bad-checksum", "protocol 4"),
        text,
        vec![Ask::Silence(request, bytes); SILENCES],
        |facts, done| Finding::silence(facts, done, "answered"),
    );
    check.kind(Kind::Basic).silences(SILENCES)
}

/// A request to another station is not answered. A bus may have one with that number, so several are tried.
fn unanswered_station(requests: Requests) -> Check {
    let others = OTHERS.into_iter().filter(move |&other| other != requests.station).take(3);
    let asks: Vec<Ask> = others.map(|station| silent_status(Requests { station, ..requests }, requests)).collect();
    // The number of the next station to ask, and of the requests to it that were not answered.
    let progress = |facts: &Facts, done: &[Exchange]| {
        done.iter().fold((0, 0), |(other, silent), exchange| match answers(facts, exchange) {
            0 => (other, silent + 1),
            _ => (other + 1, 0),
        })
    };
    let next = move |facts: &Facts, done: &[Exchange]| {
        let (other, silent) = progress(facts, done);
        // The first that is silent is enough.
        asks.get(other).filter(|_| silent < SILENCES).cloned()
    };
    let judge = move |facts: &Facts, done: &[Exchange]| {
        let status = facts.requests.status();
        let mut frames = done.iter().flat_map(|exchange| &exchange.attempts).flat_map(|attempt| attempt.frames());
        let is_own =
            |frame: &Frame| frame.station == requests.station && fit(&status, frame, facts.framing()) != Answer::None;
        if frames.any(|(_, frame, _)| is_own(frame)) {
            return Finding::contradicts("answered under its own number");
        }
        match progress(facts, done) {
            (0, 0) => Finding::open("nothing was asked"),
            (others, 0) => Finding::contradicts(format!("{others} other numbers are answered")),
            _ => Finding::holds("not answered"),
        }
    };
    let text = "a request to another station is not answered";
    let most = OTHERS.len() * SILENCES;
    let check = Check::adaptive((Group::Errors, "other-station", "protocol 4"), text, most, next, judge);
    check.usually(SILENCES).kind(Kind::Basic).silences(SILENCES)
}

fn unanswered_broadcast(requests: Requests) -> Check {
    let text = "a read that is sent to all stations (0) is not answered";
    let ask = silent_status(Requests { station: 0, ..requests }, requests);
    let judge = |facts: &Facts, done: &[Exchange]| Finding::silence(facts, done, "answered");
    let id = (Group::Errors, "broadcast", "protocol 5; facts, question 10");
    // All stations of a line receive it: a matter of load.
    Check::fixed(id, text, vec![ask; SILENCES], judge).kind(Kind::Load).silences(SILENCES)
}

/// A status request that is not for the PLC; an answer would be one to it.
fn silent_status(to: Requests, own: Requests) -> Ask {
    let bytes = to.encode(&to.status().frame);
    Ask::Silence(own.status(), bytes)
}

/// The replies to the status request. Others may be late ones to requests before it.
fn answers(facts: &Facts, exchange: &Exchange) -> usize {
    let status = facts.requests.status();
    let frames = exchange.attempts.iter().flat_map(|attempt| attempt.frames());
    frames.filter(|(_, frame, _)| fit(&status, frame, facts.framing()) != Answer::None).count()
}

impl Finding {
    /// Holds if no reply came.
    fn silence(facts: &Facts, done: &[Exchange], otherwise: &str) -> Self {
        match done.iter().map(|exchange| answers(facts, exchange)).sum::<usize>() {
            0 if done.is_empty() => Self::open("nothing was asked"),
            0 => Self::holds(Answer::None.to_string()),
            _ => Self::contradicts(otherwise),
        }
    }
}
