//! Handling of the frames of clients.
//!
//! | frame | to the bus | to the client |
//! |---|---|---|
//! | good request | request in the framing of the bus | reply or error code, in the framing of the client |
//! | good request, no reply | reads up to three times; nothing while the station is offline | nothing |
//! | request that no PLC can read | nothing | error code of a PLC for it: 2, 4 or A |
//! | request without form in the framing of the bus | nothing | error 4, "the command cannot be executed" |
//! | address past the last one of the framing of the bus | nothing | error A, "illegal address" |
//! | write or control command, in read-only mode | nothing | error 3 in ASCII, 4 in binary |
//! | broadcast that writes or controls | request, unless in read-only mode | nothing |
//! | any other broadcast | nothing | nothing |
//! | request to a station not served | nothing | nothing |
//!
//! Requests without form in a framing: program pages (4F, 50) in binary; loop-backs with
//! unprintable bytes in ASCII; and the few mixed lists (48, 49) that are ambiguous in binary, which
//! are refused from binary clients, too. `M10000` has an address in binary and none in ASCII.
//!
//! Error 3 is "write prohibited": in the manual, of a ROM pack. The binary framing has no such
//! code, so error 4 is used. A blocked broadcast has no reply: its sender would take one for the
//! reply to its next request.
//!
//! Requests are encoded anew, not copied: hexadecimal digits become upper-case, and a program page
//! has its error digit even if the PLC omits it.

use std::ops::RangeInclusive;
use std::sync::{Mutex, MutexGuard, PoisonError};

use bytes::BytesMut;
use fatek::command::{Class, Request, encode_refusal};
use fatek::wire::{Frame, Framing};
use fatek::{Error, ErrorCode, Link};

/// Bus shared by all clients: one link, with its queue and its station health.
pub(crate) struct Proxy {
    link: Link,
    rules: Rules,
    counts: Mutex<Counts>,
}

/// Rules for requests of clients.
#[derive(Clone, Debug)]
pub(crate) struct Rules {
    /// Stations served; 0: broadcasts.
    pub(crate) stations: RangeInclusive<u8>,
    /// `true` if only reads are allowed.
    pub(crate) read_only: bool,
}

/// Number of requests by outcome.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Counts {
    /// Executed: the PLC has replied.
    pub(crate) done: u64,
    /// Refused by the PLC with an error code.
    pub(crate) refused: u64,
    /// No reply: timeout, station offline, or no connection to the bus.
    pub(crate) silent: u64,
    /// Sent as broadcast.
    pub(crate) broadcast: u64,
    /// Blocked by read-only mode.
    pub(crate) held_back: u64,
    /// Refused by the gateway: malformed, or without form in the framing of the bus.
    pub(crate) faulty: u64,
    /// Ignored: for a station not served, or a broadcast that only reads.
    pub(crate) ignored: u64,
}

/// Outcome of one request.
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

    /// Handles a frame of a client and appends the reply to `reply`, if there is one.
    pub(crate) async fn answer(&self, frame: &Frame, framing: Framing, reply: &mut BytesMut) {
        let outcome = self.forward(frame, framing, reply).await;
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
            tracing::warn!(station, command, "blocked by read-only mode");
        } else {
            tracing::debug!(station, command, ?outcome, "request");
        }
    }

    async fn forward(&self, frame: &Frame, framing: Framing, reply: &mut BytesMut) -> Outcome {
        // 255 is not a station.
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
            Err(Error::Invalid(fault)) => Outcome::Faulty(fault.error_code()),
            Err(Error::Plc { error, .. }) => Outcome::Refused(error),
            // No error code fits: as on the bus, the client sees a timeout.
            Err(error) => {
                tracing::debug!(%error, "no reply");
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

/// Error code of read-only mode.
fn write_prohibited(framing: Framing) -> ErrorCode {
    match framing {
        Framing::Ascii => ErrorCode::WriteProhibited,
        Framing::Binary | _ => ErrorCode::IllegalFormat,
    }
}
