//! The requests of a recording in their order, with the replies.

use std::time::Duration;

use bytes::Bytes;
use fatek::command::ReplyError;
use fatek::wire::{Frame, Framing};

use crate::conversation::{Entry, Exchange, Found, Outcome, SeenFrame, Timestamp};

/// The requests to send. Those that the client sent again are in it once.
#[derive(Debug)]
pub(super) struct Script {
    pub(super) steps: Vec<ScriptedRequest>,
}

/// A request to send, with its recorded reply.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct ScriptedRequest {
    pub(super) at: Timestamp,
    exchange: Exchange,
}

impl Script {
    /// The requests of this framing, in order of their times.
    pub(super) fn new(recorded: &[Entry], framing: Framing) -> Self {
        let mut steps: Vec<ScriptedRequest> =
            recorded.iter().filter_map(|entry| ScriptedRequest::new(entry, framing)).collect();
        // Stable: entries of one connection are in the order of their replies.
        steps.sort_by_key(|step| step.at);
        Self { steps }
    }

    /// Longest pause between two requests in the recording.
    pub(super) fn longest_pause(&self) -> Duration {
        let pauses =
            self.steps.iter().zip(self.steps.iter().skip(1)).map(|(before, step)| step.at.saturating_sub(before.at));
        pauses.max().unwrap_or_default()
    }
}

impl ScriptedRequest {
    fn new(entry: &Entry, framing: Framing) -> Option<Self> {
        let exchange = exchange(entry).filter(|exchange| exchange.request.framing == framing)?;
        let is_sent = exchange.outcome != Outcome::Retried;
        is_sent.then(|| Self { at: entry.at, exchange: exchange.clone() })
    }

    pub(super) fn request(&self) -> &SeenFrame {
        &self.exchange.request
    }

    pub(super) fn station(&self) -> u8 {
        self.exchange.request.frame.station
    }

    /// The request as a text.
    pub(super) fn text(&self) -> String {
        self.exchange.text()
    }

    pub(super) fn may_write(&self) -> bool {
        self.exchange.may_write()
    }

    pub(super) fn is_broadcast(&self) -> bool {
        self.exchange.outcome == Outcome::Broadcast
    }

    /// Returns whether a frame is a reply to the request: of its station and command, and with data of
    /// its form, unless the request is unknown.
    pub(super) fn is_reply(&self, reply: &Frame, framing: Framing) -> bool {
        let request = &self.exchange.request.frame;
        (reply.station, reply.command) == (request.station, request.command)
            && self
                .exchange
                .decoded
                .as_ref()
                .map_or(true, |request| matches!(request.decode_reply(reply, framing), Ok(_) | Err(ReplyError::Plc(_))))
    }

    fn reply(&self) -> Option<&Frame> {
        match &self.exchange.outcome {
            Outcome::Answered(answer) => Some(&answer.reply.frame),
            Outcome::Unanswered | Outcome::Retried | Outcome::Broadcast => None,
        }
    }

    /// The recorded reply and this one as texts, if they differ. Nothing replies to a broadcast.
    pub(super) fn difference(&self, reply: Option<&Frame>) -> Option<[String; 2]> {
        let recorded = self.reply();
        if self.is_broadcast() || recorded == reply {
            return None;
        }
        let seen = |frame: &Frame| {
            let (frame, bytes) = (frame.clone(), Bytes::new());
            SeenFrame { frame, bytes, framing: self.exchange.request.framing }
        };
        let texts = |text: &dyn Fn(SeenFrame) -> String| {
            [recorded, reply].map(|reply| reply.map_or_else(|| "no reply".to_owned(), |frame| text(seen(frame))))
        };
        let values = texts(&|seen| self.exchange.text_of_reply(&seen));
        // Of a long list, a text has the first values only.
        let [first, second] = &values;
        Some(if first == second { texts(&|seen| format!("\"{}\"", seen.frame.data.escape_ascii())) } else { values })
    }
}

pub(super) fn exchange(entry: &Entry) -> Option<&Exchange> {
    match &entry.found {
        Found::Exchange(exchange) => Some(exchange),
        Found::Stray { .. } | Found::Bad { .. } | Found::Missing { .. } => None,
    }
}

/// Framing of the first request.
pub(super) fn framing(recorded: &[Entry]) -> Option<Framing> {
    recorded.iter().find_map(exchange).map(|exchange| exchange.request.framing)
}
