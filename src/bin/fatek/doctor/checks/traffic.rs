//! Checks of all traffic of an examination: they send nothing of their own.

use std::time::Duration;

use fatek::command::Code;
use fatek::wire::{Discard, Frame, Framing};

use crate::doctor::check::{Check, Finding, Group, only_over};
use crate::doctor::exchange::{Answer, Arrival, Ask, Attempt, Exchange, Item, fit};
use crate::doctor::facts::Facts;
use crate::doctor::line::Medium;
use crate::doctor::request::{Request, Requests, Shape};

/// The wait of an Ethernet module for its PLC.
const MODULE_TIMEOUT: Duration = Duration::from_millis(300);
/// The pause within a frame that a link of this crate waits for.
const LONGEST_PAUSE: Duration = Duration::from_millis(100);

pub(super) fn checks(requests: Requests) -> Vec<Check> {
    let mut checks = framing();
    checks.extend(replies());
    checks.extend(times_and_connections());
    if requests.framing == Framing::Ascii {
        let text = "replies have upper-case hexadecimal digits";
        checks.push(passive(Group::Framing, "upper-case", "protocol 1", text, |facts| {
            let asked = asked(facts).filter(|(request, _)| request.shape != Shape::Echo);
            let is_lower: Vec<bool> = asked
                .flat_map(|(_, attempt)| attempt.frames())
                .map(|(_, _, bytes)| bytes.iter().any(u8::is_ascii_lowercase))
                .collect();
            finding(&is_lower, "replies", "have lower-case digits")
        }));
    }
    checks
}

/// Checks of everything that came.
fn framing() -> Vec<Check> {
    let is_bad = |arrival: &Arrival| match arrival.item {
        Item::Noise(Discard::Garbage | Discard::WrongSide, _) => false,
        Item::Noise(..) => true,
        Item::Frame(..) | Item::Echo(_) => false,
    };
    let is_garbage = |arrival: &Arrival| matches!(arrival.item, Item::Noise(Discard::Garbage, _));
    let is_echo = |arrival: &Arrival| matches!(arrival.item, Item::Echo(_) | Item::Noise(Discard::WrongSide, _));
    let check = |name, source, text, fault: fn(&Arrival) -> bool, effect: &'static str| {
        passive(Group::Framing, name, source, text, move |facts| {
            let faults: Vec<bool> = arrivals(facts).map(fault).collect();
            finding(&faults, "items", effect)
        })
    };
    let good = "each reply is a whole frame with a good checksum";
    vec![
        check("frames", "protocol 1 and 2", good, is_bad, "are bad frames"),
        check("no-noise", "protocol 7", "no bytes come outside of frames", is_garbage, "are stray bytes"),
        check("no-echo", "protocol 7", "the line does not send back requests", is_echo, "are requests"),
    ]
}

/// Checks of replies, each with its request.
fn replies() -> Vec<Check> {
    vec![
        passive(
            Group::Framing,
            "own-station",
            "protocol 1 and 7",
            "replies have the station of their request",
            |facts| {
                let frames = asked(facts).flat_map(|(_, attempt)| attempt.frames());
                let others: Vec<bool> = frames.map(|(_, frame, _)| frame.station != facts.requests.station).collect();
                finding(&others, "replies", "have another station")
            },
        ),
        passive(Group::Framing, "own-command", "protocol 1", "replies have the command of their request", |facts| {
            let is_other = |(request, frame): (&Request, &Frame)| frame.command != request.frame.command;
            finding(&awaited(facts).map(is_other).collect::<Vec<_>>(), "replies", "have another command")
        }),
        passive(
            Group::Framing,
            "own-length",
            "protocol 5",
            "replies have the length that their request asks for",
            |facts| {
                let has_length = |(request, frame): &(&Request, &Frame)| {
                    matches!(request.shape, Shape::Len(_)) && frame.command == request.frame.command
                };
                let is_other = |(request, frame)| fit(request, frame, facts.framing()) == Answer::None;
                let others: Vec<bool> = awaited(facts).filter(has_length).map(is_other).collect();
                finding(&others, "replies", "have another length")
            },
        ),
        passive(Group::Framing, "error-alone", "protocol 1 and 2", "an error code is followed by no data", |facts| {
            let is_refusal = |(request, frame): &(&Request, &Frame)| {
                matches!(fit(request, frame, facts.framing()), Answer::Refused(_))
            };
            let has_data = |(_, frame): (&Request, &Frame)| frame.data.len() > 1;
            let with_data: Vec<bool> = awaited(facts).filter(is_refusal).map(has_data).collect();
            finding(&with_data, "refusals", "have data")
        }),
        passive(Group::Framing, "digits", "protocol 1 and 2", "values have digits, and states are 0 or 1", digits),
        passive(Group::Order, "once", "protocol 7", "each reply comes once", once),
        passive(Group::Order, "answered", "protocol 7", "each request is answered at the first attempt", |facts| {
            // A request that is never answered is a matter of its own check.
            let is_read = |exchange: &&Exchange| matches!(exchange.ask, Ask::Reply(_));
            let exchanges = facts.log.iter().filter(is_read).filter(|e| e.answer(facts.framing()) != Answer::None);
            let is_lost = |attempt: &Attempt| attempt.arrivals.is_empty() && !attempt.closed;
            let lost: Vec<bool> = exchanges.map(|exchange| exchange.attempts.iter().any(is_lost)).collect();
            finding(&lost, "requests", "were sent again")
        }),
        passive(Group::Order, "in-time", "protocol 7", "no reply comes after the response timeout", |facts| {
            let is_late = |(request, attempt): (&Request, &Attempt)| {
                let fits = |frame: &Frame| fit(request, frame, facts.framing()) != Answer::None;
                let came = attempt.frames().any(|(arrival, frame, _)| arrival.unawaited && fits(frame));
                came && attempt.reply(request, facts.framing()).is_none()
            };
            finding(&asked(facts).map(is_late).collect::<Vec<_>>(), "requests", "were answered late")
        }),
    ]
}

fn times_and_connections() -> Vec<Check> {
    let over_udp = |name, source, text, fault: fn(&Arrival) -> bool, effect: &'static str| {
        passive(Group::Connections, name, source, text, move |facts| {
            let faults: Vec<bool> = arrivals(facts).map(fault).collect();
            let excuse = only_over(facts.medium, &[Medium::Udp], "UDP");
            excuse.unwrap_or_else(|| finding(&faults, "replies", effect))
        })
    };
    let is_split = |arrival: &Arrival| arrival.pieces > 1;
    let is_from_other = |arrival: &Arrival| arrival.other_port;
    let own_port = "replies come from the port that was asked";
    vec![
        passive(Group::Timing, "module-timeout", "protocol 7", "the PLC answers within 300 ms", |facts| {
            let times = facts.log.iter().filter_map(|exchange| exchange.response_time(facts.framing()));
            finding(&times.map(|time| time > MODULE_TIMEOUT).collect::<Vec<_>>(), "short replies", "took longer")
        }),
        passive(
            Group::Timing,
            "pause-in-frame",
            "docs/DESIGN.md",
            "no reply has a pause of more than 100 ms",
            |facts| {
                let longest = arrivals(facts).map(|arrival| arrival.pause).max().unwrap_or_default();
                let text = format!("longest pause {:.1} ms", longest.as_secs_f64() * 1e3);
                if longest > LONGEST_PAUSE { Finding::contradicts(text) } else { Finding::holds(text) }
            },
        ),
        passive(Group::Connections, "stays-open", "protocol 7", "a connection stays open after a reply", |facts| {
            let exchanges = facts.log.iter().filter(|e| !matches!(e.ask, Ask::Connections(_) | Ask::Idle(_)));
            let closed: Vec<bool> = exchanges.flat_map(|e| &e.attempts).map(|attempt| attempt.closed).collect();
            let excuse = only_over(facts.medium, &[Medium::Tcp], "TCP");
            excuse.unwrap_or_else(|| finding(&closed, "requests", "ended with a closed connection"))
        }),
        over_udp("one-datagram", "protocol 7", "a datagram has one frame", is_split, "are in several datagrams"),
        over_udp("own-port", "facts, question 6", own_port, is_from_other, "come from another port"),
    ]
}

/// The finding by the faults of these things.
fn finding(faults: &[bool], things: &str, effect: &str) -> Finding {
    Finding::unless(faults.iter().filter(|fault| **fault).count(), faults.len(), things, effect)
}

/// The awaited frames, each with the request that it came to.
fn awaited(facts: &Facts) -> impl Iterator<Item = (&Request, &Frame)> {
    asked(facts).flat_map(|(request, attempt)| {
        let awaited = attempt.frames().filter(|(arrival, ..)| !arrival.unawaited);
        awaited.map(move |(_, frame, _)| (request, frame))
    })
}

fn passive(
    group: Group,
    name: &'static str,
    source: &'static str,
    text: &str,
    judge: impl Fn(&Facts) -> Finding + 'static,
) -> Check {
    Check::passive((group, name, source), text, judge)
}

/// Everything that came.
fn arrivals(facts: &Facts) -> impl Iterator<Item = &Arrival> {
    facts.log.iter().flat_map(|exchange| &exchange.attempts).flat_map(|attempt| &attempt.arrivals)
}

/// The attempts of requests that a reply is awaited to.
fn asked(facts: &Facts) -> impl Iterator<Item = (&Request, &Attempt)> {
    let asked = facts.log.iter().filter(|exchange| !matches!(exchange.ask, Ask::Silence(..)));
    asked
        .filter_map(|exchange| Some((exchange.ask.request()?, &exchange.attempts)))
        .flat_map(|(request, attempts)| attempts.iter().map(move |attempt| (request, attempt)))
}

/// Values of digits that are none, and states that are neither 0 nor 1.
fn digits(facts: &Facts) -> Finding {
    let is_ascii = facts.framing() == Framing::Ascii;
    let is_bad = |(request, frame): (&Request, &Frame)| {
        let Shape::Len(_) = request.shape else { return None };
        let Answer::Data(data) = fit(request, frame, facts.framing()) else { return None };
        let states = [Code::ReadDiscretes, Code::ReadDisabled].map(u8::from);
        let is_good = |byte: &u8| match (states.contains(&request.frame.command), is_ascii) {
            (true, true) => matches!(byte, b'0' | b'1'),
            (true, false) => *byte <= 1,
            (false, true) => byte.is_ascii_hexdigit(),
            (false, false) => true,
        };
        Some(!data.iter().all(is_good))
    };
    finding(&awaited(facts).filter_map(is_bad).collect::<Vec<_>>(), "replies", "have other characters")
}

/// Frames that are equal to the one before them, which the request does not ask for twice.
fn once(facts: &Facts) -> Finding {
    let (mut replies, mut twice) = (0, 0);
    for (request, attempt) in asked(facts) {
        let mut frames = attempt.frames().map(|(_, frame, _)| frame);
        let Some(reply) = frames.find(|frame| fit(request, frame, facts.framing()) != Answer::None) else { continue };
        replies += 1;
        twice += usize::from(frames.any(|frame| frame == reply));
    }
    Finding::unless(twice, replies, "replies", "came twice")
}
