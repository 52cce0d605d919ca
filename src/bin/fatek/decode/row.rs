//! Entries of a conversation as texts.

use std::time::Duration;

use super::explain::explain;
use super::spaced;
use super::split::pieces;
use crate::conversation::{Answer, Direction, Entry, Exchange, Found, Outcome, StrayReply, Timestamp, Verdict};

/// Short description of an entry.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Mark {
    Ok,
    Refused,
    NoReply,
    Retried,
    Broadcast,
    WrongReply,
    Ambiguous,
    Doubled,
    Late,
    Unexpected,
    Bad,
    Missing,
}

impl Mark {
    pub(super) fn as_str(self) -> &'static str {
        match self {
            Self::Ok => "ok",
            Self::Refused => "refused",
            Self::NoReply => "no reply",
            Self::Retried => "retried",
            Self::Broadcast => "broadcast",
            Self::WrongReply => "wrong reply",
            Self::Ambiguous => "ambiguous",
            Self::Doubled => "doubled",
            Self::Late => "late",
            Self::Unexpected => "unexpected",
            Self::Bad => "bad",
            Self::Missing => "missing",
        }
    }
}

/// An entry as texts.
#[derive(Debug)]
pub(super) struct Row {
    pub(super) connection: u64,
    pub(super) at: Timestamp,
    pub(super) round_trip: Option<Duration>,
    pub(super) station: Option<u8>,
    pub(super) attempt: Option<u32>,
    pub(super) mark: Mark,
    pub(super) request: Option<String>,
    pub(super) reply: Option<String>,
    pub(super) request_bytes: Option<String>,
    pub(super) reply_bytes: Option<String>,
    pub(super) faults: Vec<String>,
}

impl Row {
    pub(super) fn new(entry: &Entry) -> Self {
        let row = Self {
            connection: entry.connection,
            at: entry.at,
            round_trip: None,
            station: None,
            attempt: None,
            mark: Mark::Ok,
            request: None,
            reply: None,
            request_bytes: None,
            reply_bytes: None,
            faults: Vec::new(),
        };
        match &entry.found {
            Found::Exchange(exchange) => row.exchange(exchange),
            Found::Stray { reply, why } => {
                let (mark, text) = match why {
                    StrayReply::Doubled => (Mark::Doubled, reply.text()),
                    StrayReply::Late(after) => (Mark::Late, format!("{} ({} ms)", reply.text(), millis(*after))),
                    StrayReply::Unexpected => (Mark::Unexpected, reply.text()),
                };
                let station = Some(reply.frame.station);
                Self { mark, station, reply: Some(text), reply_bytes: Some(spaced(&reply.bytes)), ..row }
            }
            Found::Bad { direction, bytes, framing } => {
                let explained = pieces(bytes, Some(*framing)).into_iter().map(|piece| explain(&piece));
                let faults = explained.flat_map(|explanation| explanation.faults).collect();
                let text = if bytes.len() == 1 { "1 byte".to_owned() } else { format!("{} bytes", bytes.len()) };
                Self { faults, ..row.one_way(Mark::Bad, *direction, text, Some(spaced(bytes))) }
            }
            Found::Missing { direction, count } => {
                let text = if *count == 1 { "1 byte".to_owned() } else { format!("{count} bytes") };
                row.one_way(Mark::Missing, *direction, text, None)
            }
        }
    }

    /// Bytes of one direction, which are no frame.
    fn one_way(self, mark: Mark, direction: Direction, text: String, bytes: Option<String>) -> Self {
        let text = Some(format!("{text} {direction}"));
        match direction {
            Direction::ToPlc => Self { mark, request: text, request_bytes: bytes, ..self },
            Direction::FromPlc => Self { mark, reply: text, reply_bytes: bytes, ..self },
        }
    }

    fn exchange(self, exchange: &Exchange) -> Self {
        let row = Self {
            station: Some(exchange.request.frame.station),
            attempt: Some(exchange.attempt),
            request: Some(exchange.text()),
            request_bytes: Some(spaced(&exchange.request.bytes)),
            faults: exchange.decoded.as_ref().err().map(|rule| format!("request: {rule}")).into_iter().collect(),
            ..self
        };
        let answer = match &exchange.outcome {
            Outcome::Answered(answer) => answer,
            Outcome::Unanswered => return Self { mark: Mark::NoReply, ..row },
            Outcome::Retried => return Self { mark: Mark::Retried, ..row },
            Outcome::Broadcast => return Self { mark: Mark::Broadcast, ..row },
        };
        let Answer { round_trip, reply, verdict, is_ambiguous } = answer;
        let mut faults = row.faults;
        let (mark, text) = match verdict {
            Verdict::Values(values) => (Mark::Ok, values.clone()),
            Verdict::Refused(code) => (Mark::Refused, code.to_string()),
            Verdict::Unknown => (Mark::Ok, reply.text()),
            Verdict::Mismatch(rule) => {
                faults.push(format!("reply: {rule}"));
                (Mark::WrongReply, reply.text())
            }
        };
        let mark = if *is_ambiguous && mark != Mark::WrongReply { Mark::Ambiguous } else { mark };
        let (round_trip, reply_bytes) = (Some(*round_trip), Some(spaced(&reply.bytes)));
        Self { mark, round_trip, reply: Some(text), reply_bytes, faults, ..row }
    }

    /// Request and reply as one text for people.
    pub(super) fn text(&self) -> String {
        let retry = match self.attempt {
            Some(attempt @ 2..) => format!("attempt {attempt}: "),
            Some(_) | None => String::new(),
        };
        let mark =
            if self.mark == Mark::Ok { String::new() } else { format!("{}: ", self.mark.as_str().to_uppercase()) };
        let parts = [self.request.as_deref(), self.reply.as_deref()];
        let parts: Vec<&str> = parts.into_iter().flatten().collect();
        format!("{mark}{retry}{}", parts.join(": "))
    }
}

/// Milliseconds with three decimals.
pub(super) fn millis(time: Duration) -> String {
    format!("{:.3}", time.as_secs_f64() * 1e3)
}
