//! What becomes of a frame that a client sends.
//!
//! | the frame | the bus | the client gets |
//! |---|---|---|
//! | a good request | is asked, in the bus's own framing | the reply, or the PLC's error code, in the client's framing |
//! | the same, and nobody answers | is asked, reads up to three times; not at all while the station is offline | nothing, as on the bus itself |
//! | a request that no PLC can read | hears nothing | the error code that a PLC has for it: 2, 4 or A |
//! | one that the bus's framing cannot carry | hears nothing | error 4, "the command cannot be executed" |
//! | a write or control command, in read-only mode | hears nothing | error 3 in ASCII, 4 in binary |
//! | a broadcast that writes or controls | obeys it, unless in read-only mode | nothing: nobody answers a broadcast |
//! | any other broadcast | hears nothing | nothing |
//! | for a station that is not served | hears nothing | nothing |
//!
//! What a framing cannot carry: program pages (4F, 50) in binary; loop-backs with unprintable bytes in ASCII; and the few
//! mixed lists (48, 49) that can be read in two ways in binary, in which the gateway takes none from its clients either.
//!
//! Error 3 says "write prohibited". That is what read-only mode is, though the manual means a ROM pack by it; the binary
//! framing does not have it, so that 4 must do. A broadcast that is held back is only counted: its sender expects no
//! answer, and would take one for the reply to its next request.
//!
//! What is sent on is what was understood, not the bytes: hexadecimal digits become upper-case, and a program page has its
//! error digit even where the PLC leaves it out.

use std::ops::RangeInclusive;
use std::sync::{Mutex, MutexGuard, PoisonError};

use bytes::BytesMut;
use fatek::command::{Class, Request, encode_refusal};
use fatek::wire::{Frame, Framing};
use fatek::{Error, ErrorCode, Link};

/// One bus, for all clients. All of them share its link, and with it the order of requests and what is known of each
/// station.
pub(crate) struct Proxy {
    link: Link,
    rules: Rules,
    counts: Mutex<Counts>,
}

/// What is let through.
#[derive(Clone, Debug)]
pub(crate) struct Rules {
    /// The stations that are served; broadcasts are if 0 is among them.
    pub(crate) stations: RangeInclusive<u8>,
    /// Only what changes nothing.
    pub(crate) read_only: bool,
}

/// What the requests came to, one of these each.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Counts {
    /// Answered by a PLC: done.
    pub(crate) done: u64,
    /// Answered by a PLC: an error.
    pub(crate) refused: u64,
    /// Not answered by the PLC: no reply, or the station is offline, or there is no connection to the bus.
    pub(crate) silent: u64,
    /// Sent to all.
    pub(crate) broadcast: u64,
    /// Held back in read-only mode.
    pub(crate) held_back: u64,
    /// Answered by an error of the gateway's own: not to be read, or not to be sent in the bus's framing.
    pub(crate) faulty: u64,
    /// For a station that is not served, or a broadcast that nobody would answer.
    pub(crate) ignored: u64,
}

/// The same as an event.
#[derive(Clone, Copy, Debug)]
enum Outcome {
    Done,
    Refused(ErrorCode),
    Silent,
    Broadcast,
    HeldBack,
    Faulty(ErrorCode),
    Ignored,
}

const BROADCAST: u8 = 0;

impl Proxy {
    pub(crate) fn new(link: Link, rules: Rules) -> Self {
        Self { link, rules, counts: Mutex::default() }
    }

    pub(crate) fn link(&self) -> &Link {
        &self.link
    }

    pub(crate) fn counts(&self) -> Counts {
        *self.lock()
    }

    /// Does what a frame asks, and appends the reply, if there is one.
    pub(crate) async fn answer(&self, frame: &Frame, framing: Framing, reply: &mut BytesMut) {
        let outcome = self.pass_on(frame, framing, reply).await;
        let refusal = match outcome {
            Outcome::Refused(error) | Outcome::Faulty(error) => Some(error),
            Outcome::HeldBack if frame.station != BROADCAST => Some(write_prohibited(framing)),
            Outcome::HeldBack | Outcome::Done | Outcome::Silent | Outcome::Broadcast | Outcome::Ignored => None,
        };
        if let Some(error) = refusal {
            encode_refusal(frame.command, error, framing, frame.station, reply);
        }
        self.lock().note(outcome);
        let (station, command) = (frame.station, format_args!("{:02X}", frame.command));
        if matches!(outcome, Outcome::HeldBack) {
            tracing::warn!(station, command, "held back");
        } else {
            tracing::debug!(station, command, ?outcome, "request");
        }
    }

    async fn pass_on(&self, frame: &Frame, framing: Framing, reply: &mut BytesMut) -> Outcome {
        // 255 is no station.
        if frame.station == u8::MAX || !self.rules.stations.contains(&frame.station) {
            return Outcome::Ignored;
        }
        let request = match Request::decode(frame, framing) {
            Ok(request) => request,
            Err(_) if frame.station == BROADCAST => return Outcome::Ignored,
            Err(fault) => return Outcome::Faulty(fault.error_code()),
        };
        if self.rules.read_only && request.code().class() != Class::Read {
            return Outcome::HeldBack;
        }
        let result = match self.link.station(frame.station) {
            Ok(station) => station.forward(request).await.map(|answer| {
                answer.encode(framing, frame.station, reply);
                Outcome::Done
            }),
            Err(_) => self.link.broadcast().forward(request).await.map(|()| Outcome::Broadcast),
        };
        match result {
            Ok(outcome) => outcome,
            Err(Error::Invalid(_)) if frame.station == BROADCAST => Outcome::Ignored,
            Err(Error::Invalid(_)) => Outcome::Faulty(ErrorCode::IllegalFormat),
            Err(Error::Plc { error, .. }) => Outcome::Refused(error),
            // Whatever it was, nothing is known that could be told.
            Err(error) => {
                tracing::debug!(%error, "no answer");
                Outcome::Silent
            }
        }
    }

    fn lock(&self) -> MutexGuard<'_, Counts> {
        self.counts.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Counts {
    fn note(&mut self, outcome: Outcome) {
        let count = match outcome {
            Outcome::Done => &mut self.done,
            Outcome::Refused(_) => &mut self.refused,
            Outcome::Silent => &mut self.silent,
            Outcome::Broadcast => &mut self.broadcast,
            Outcome::HeldBack => &mut self.held_back,
            Outcome::Faulty(_) => &mut self.faulty,
            Outcome::Ignored => &mut self.ignored,
        };
        *count += 1;
    }
}

/// What read-only mode answers to everything that is not only read.
fn write_prohibited(framing: Framing) -> ErrorCode {
    match framing {
        Framing::Ascii => ErrorCode::WriteProhibited,
        Framing::Binary | _ => ErrorCode::IllegalFormat,
    }
}
