//! Checks of all traffic of an examination: they send nothing of their own.

use std::time::Duration;

use fatek::wire::{Discard, Framing};

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
    let mut checks = vec![
        passive(
            Group::Framing,
            "frames",
            "protocol 1 and 2",
            "each reply is a whole frame with a good checksum",
            |facts| {
                let is_bad = |arrival: &&Arrival| matches!(&arrival.item, Item::Noise(reason, _) if !matches!(reason, Discard::Garbage | Discard::WrongSide));
                let bad = arrivals(facts).filter(is_bad).count();
                Finding::unless(bad, arrivals(facts).count(), "replies", "are no good frames")
            },
        ),
        passive(Group::Framing, "no-noise", "protocol 7", "no bytes come outside of frames", |facts| {
            let is_noise = |arrival: &&Arrival| matches!(&arrival.item, Item::Noise(Discard::Garbage, _));
            Finding::unless(
                arrivals(facts).filter(is_noise).count(),
                arrivals(facts).count(),
                "items",
                "are stray bytes",
            )
        }),
        passive(Group::Framing, "no-echo", "protocol 7", "the line does not send back requests", |facts| {
            let is_echo =
                |arrival: &&Arrival| matches!(&arrival.item, Item::Echo(_) | Item::Noise(Discard::WrongSide, _));
            Finding::unless(arrivals(facts).filter(is_echo).count(), arrivals(facts).count(), "items", "are requests")
        }),
        passive(
            Group::Framing,
            "own-station",
            "protocol 1 and 7",
            "replies have the station of their request",
            |facts| {
                let frames: Vec<u8> =
                    asked(facts).flat_map(|(_, a)| a.frames()).map(|(_, frame, _)| frame.station).collect();
                let others = frames.iter().filter(|station| **station != facts.requests.station).count();
                Finding::unless(others, frames.len(), "replies", "have another station")
            },
        ),
        passive(Group::Framing, "own-command", "protocol 1", "replies have the command of their request", |facts| {
            let awaited = || {
                asked(facts).flat_map(|(request, attempt)| {
                    attempt
                        .frames()
                        .filter(|(a, ..)| !a.unawaited)
                        .map(move |(_, frame, _)| frame.command == request.frame.command)
                })
            };
            Finding::unless(awaited().filter(|own| !own).count(), awaited().count(), "replies", "have another command")
        }),
        passive(
            Group::Framing,
            "own-length",
            "protocol 5",
            "replies have the length that their request asks for",
            |facts| {
                let known = |request: &Request| matches!(request.shape, Shape::Len(_));
                let frames = || {
                    asked(facts).filter(|(request, _)| known(request)).flat_map(|(request, attempt)| {
                        attempt
                            .frames()
                            .filter(|(a, f, _)| !a.unawaited && f.command == request.frame.command)
                            .map(move |(_, frame, _)| fit(request, frame, facts.framing()) != Answer::None)
                    })
                };
                Finding::unless(
                    frames().filter(|fits| !fits).count(),
                    frames().count(),
                    "replies",
                    "have another length",
                )
            },
        ),
        passive(Group::Framing, "error-alone", "protocol 1 and 2", "an error code is followed by no data", |facts| {
            let refusals = || {
                asked(facts).flat_map(|(request, attempt)| {
                    attempt
                        .frames()
                        .filter(move |(_, frame, _)| matches!(fit(request, frame, facts.framing()), Answer::Refused(_)))
                })
            };
            let with_data = refusals().filter(|(_, frame, _)| frame.data.len() > 1).count();
            Finding::unless(with_data, refusals().count(), "refusals", "have data")
        }),
        passive(Group::Order, "once", "protocol 7", "each reply comes once", once),
        passive(Group::Order, "answered", "protocol 7", "each request is answered at the first attempt", |facts| {
            // A request that is never answered is a matter of its own check.
            let repeated = |exchange: &&Exchange| exchange.answer(facts.framing()) != Answer::None;
            let exchanges =
                || facts.log.iter().filter(|exchange| matches!(exchange.ask, Ask::Reply(_))).filter(repeated);
            let lost = exchanges().flat_map(|e| &e.attempts).filter(|a| a.arrivals.is_empty() && !a.closed).count();
            Finding::unless(lost, exchanges().count(), "requests", "were sent again")
        }),
        passive(Group::Order, "in-time", "protocol 7", "no reply comes after the response timeout", |facts| {
            let late = |(request, attempt): &(&Request, &Attempt)| {
                let fits = |(arrival, frame, _): &(&Arrival, &_, _)| {
                    arrival.unawaited && fit(request, frame, facts.framing()) != Answer::None
                };
                attempt.reply(request, facts.framing()).is_none() && attempt.frames().any(|frame| fits(&frame))
            };
            Finding::unless(asked(facts).filter(late).count(), asked(facts).count(), "requests", "were answered late")
        }),
        passive(Group::Timing, "module-timeout", "protocol 7", "the PLC answers within 300 ms", |facts| {
            let times: Vec<Duration> = facts.log.iter().filter_map(|e| e.response_time(facts.framing())).collect();
            let slow = times.iter().filter(|time| **time > MODULE_TIMEOUT).count();
            Finding::unless(slow, times.len(), "short replies", "took longer")
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
            let excuse = only_over(facts.medium, &[Medium::Tcp], "TCP");
            let attempts = || {
                facts
                    .log
                    .iter()
                    .filter(|e| !matches!(e.ask, Ask::Connections(_) | Ask::Idle(_)))
                    .flat_map(|exchange| &exchange.attempts)
            };
            let closed = || attempts().filter(|attempt| attempt.closed).count();
            excuse.unwrap_or_else(|| {
                Finding::unless(closed(), attempts().count(), "requests", "ended with a closed connection")
            })
        }),
        passive(Group::Connections, "one-datagram", "protocol 7", "a datagram has one frame", |facts| {
            let excuse = only_over(facts.medium, &[Medium::Udp], "UDP");
            let split = || arrivals(facts).filter(|arrival| arrival.pieces > 1).count();
            excuse.unwrap_or_else(|| {
                Finding::unless(split(), arrivals(facts).count(), "replies", "are in several datagrams")
            })
        }),
        passive(
            Group::Connections,
            "own-port",
            "facts, question 6",
            "replies come from the port that was asked",
            |facts| {
                let excuse = only_over(facts.medium, &[Medium::Udp], "UDP");
                let others = || arrivals(facts).filter(|arrival| arrival.other_port).count();
                excuse.unwrap_or_else(|| {
                    Finding::unless(others(), arrivals(facts).count(), "replies", "come from another port")
                })
            },
        ),
    ];
    if requests.framing == Framing::Ascii {
        let text = "replies have upper-case hexadecimal digits";
        checks.push(passive(Group::Framing, "upper-case", "protocol 1", text, |facts| {
            let frames =
                || asked(facts).filter(|(request, _)| request.shape != Shape::Echo).flat_map(|(_, a)| a.frames());
            let lower = frames().filter(|(_, _, bytes)| bytes.iter().any(u8::is_ascii_lowercase)).count();
            Finding::unless(lower, frames().count(), "replies", "have lower-case digits")
        }));
    }
    checks
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
