//! Checks of wrong requests: error codes, and requests that are not answered.

use fatek::command::Code;

use super::{refusals, replies};
use crate::doctor::check::{Check, Finding, Group, Kind};
use crate::doctor::exchange::{Answer, Ask, Exchange};
use crate::doctor::facts::Facts;
use crate::doctor::request::{Request, Requests, Shape};

/// Station numbers that are seldom in use.
const OTHERS: [u8; 4] = [254, 251, 247, 239];

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
        vec![Ask::Silence(request, bytes)],
        |_, done| Finding::silence(done, "answered"),
    );
    check.kind(Kind::Basic).silences(1)
}

/// A request to another station is not answered. A bus may have one with that number, so several are tried.
fn unanswered_station(requests: Requests) -> Check {
    let others = OTHERS.into_iter().filter(move |&other| other != requests.station).take(3);
    let asks: Vec<Ask> = others.map(|station| silent_status(Requests { station, ..requests }, requests)).collect();
    let next = move |_: &Facts, done: &[Exchange]| {
        // The first that is silent is enough.
        let is_silent = done.last().is_some_and(|exchange| arrivals(exchange) == 0);
        asks.get(done.len()).filter(|_| !is_silent).cloned()
    };
    let judge = move |_: &Facts, done: &[Exchange]| {
        let under_own = done.iter().flat_map(|exchange| &exchange.attempts).flat_map(|attempt| attempt.frames());
        if under_own.into_iter().any(|(_, frame, _)| frame.station == requests.station) {
            return Finding::contradicts("answered under its own number");
        }
        match done.iter().all(|exchange| arrivals(exchange) > 0) {
            true if !done.is_empty() => Finding::contradicts(format!("{} other numbers are answered", done.len())),
            true | false => Finding::holds("not answered"),
        }
    };
    let text = "a request to another station is not answered";
    let check = Check::adaptive((Group::Errors, "other-station", "protocol 4"), text, 3, next, judge);
    check.kind(Kind::Basic).silences(1)
}

fn unanswered_broadcast(requests: Requests) -> Check {
    let text = "a read that is sent to all stations (0) is not answered";
    let ask = silent_status(Requests { station: 0, ..requests }, requests);
    let judge = |_: &Facts, done: &[Exchange]| Finding::silence(done, "answered");
    Check::fixed((Group::Errors, "broadcast", "protocol 5; facts, question 10"), text, vec![ask], judge).silences(1)
}

/// A status request that is not for the PLC; an answer would be one to it.
fn silent_status(to: Requests, own: Requests) -> Ask {
    let bytes = to.encode(&to.status().frame);
    Ask::Silence(own.status(), bytes)
}

fn arrivals(exchange: &Exchange) -> usize {
    exchange.attempts.iter().flat_map(|attempt| attempt.frames()).count()
}

impl Finding {
    /// Holds if no frame came.
    fn silence(done: &[Exchange], otherwise: &str) -> Self {
        match done.iter().map(arrivals).sum::<usize>() {
            0 if done.is_empty() => Self::open("nothing was asked"),
            0 => Self::holds(Answer::None.to_string()),
            _ => Self::contradicts(otherwise),
        }
    }
}
