//! One request on the wire, and the matching of received frames.
//!
//! ```text
//!          begin             reply that matches: Replied
//!   idle ─────────▶ awaiting ────────────────────────────▶ idle
//!                      │  ▲     end (timeout, corruption, lost connection)
//!                      └──┘
//!            anything else is an event, and the wait goes on
//! ```
//!
//! Invariants:
//! - At most one request is on the wire.
//! - Bytes received before a request was sent are never its reply.
//! - A reply is given to a call only if station, command and exact shape match the request.
//! - The echo of a request, as some RS-485 adapters send it, is never its reply.
//!
//! # Echoes
//!
//! In the ASCII framing a request looks like a reply, and the true reply to a loop-back or to STOP
//! *is* its request. So before such a request is sent it must be known whether the line echoes.
//! [`LineEcho::Unknown`] is settled by a status request (40), whose reply cannot equal it. If the
//! request itself comes back, the line echoes. If the reply comes, and less noise than half the
//! request, it does not. On a line that echoes, the first copy of a request is its echo, and only a
//! later frame can be its reply. A copy that cannot be a reply proves an echo at any time, also
//! where none was expected.

use std::time::Duration;

use bytes::{Buf, BytesMut};
use tokio::time::Instant;

use super::buffer;
use super::call::PendingCall;
use super::in_step::{self, Reply, Shape};
use super::options::EchoMode;
use crate::command::{self, Command, LoopBack, ReadDetailedStatus, ReadStatus};
use crate::error::ErrorCode;
use crate::hex;
use crate::wire::{Codec, Discard, FieldError, Found, FoundFrame, Framing, Side, fingerprint};

/// A request that is sent on the wire.
#[derive(Debug)]
pub(crate) enum Outgoing {
    /// The request of a call.
    Call(PendingCall),
    /// A request of the link itself, and the call that waits for it, if any. `nonce`: of a check with one.
    /// The loop-back is made of it where it is needed: each link has the place of a request, and such checks
    /// are rare.
    Link { station: u8, request: LinkRequest, nonce: u64, call: Option<PendingCall> },
}

/// A request that the link itself sends to a station.
#[derive(Debug)]
pub(crate) enum LinkRequest {
    /// A check between two requests.
    Check(in_step::Check),
    /// A status request, to learn whether the line echoes. Its reply proves nothing else.
    EchoTest,
}

impl Outgoing {
    pub(crate) fn station(&self) -> u8 {
        match self {
            Self::Call(call) => call.station,
            Self::Link { station, .. } => *station,
        }
    }

    /// The call that is on the wire, or that waits for the link's own request.
    pub(crate) fn call(&self) -> Option<&PendingCall> {
        match self {
            Self::Call(call) => Some(call),
            Self::Link { call, .. } => call.as_ref(),
        }
    }

    /// Returns that call.
    pub(crate) fn into_call(self) -> Option<PendingCall> {
        match self {
            Self::Call(call) => Some(call),
            Self::Link { call, .. } => call,
        }
    }

    /// Appends the request as a frame. Returns the shape of its positive reply. A call was checked when it
    /// was made, and both framings have all requests of the link.
    fn encode(&self, framing: Framing, tx: &mut BytesMut) -> Shape {
        let station = self.station();
        match self {
            Self::Call(call) => call.slot.encode(call.spelling, framing, station, tx),
            Self::Link { request, nonce, .. } => match request {
                LinkRequest::Check(check @ (in_step::Check::Nonce | in_step::Check::Empty)) => {
                    let data = loop_back(*check, *nonce);
                    command::encode_spelled(&data, data.plain(), framing, station, tx);
                    Shape { code: LoopBack::CODE, size: data.reply_size(data.plain(), framing) }
                }
                LinkRequest::Check(in_step::Check::Status) | LinkRequest::EchoTest => {
                    command::encode_spelled(&ReadStatus, ReadStatus.plain(), framing, station, tx);
                    in_step::Check::STATUS
                }
                LinkRequest::Check(in_step::Check::Detail) => {
                    command::encode_spelled(&ReadDetailedStatus, ReadDetailedStatus.plain(), framing, station, tx);
                    in_step::Check::DETAIL
                }
            },
        }
    }

    /// Decodes the data of a frame with the right station and command. If it is the reply, positive
    /// or a refusal, a call holds its result. Returns the error code of a refusal.
    fn try_complete(&self, framing: Framing, data: &[u8], now: Instant) -> Result<Option<ErrorCode>, FieldError> {
        match self {
            Self::Call(call) => call.slot.try_complete(framing, call.station, data, now),
            Self::Link { request, nonce, .. } => match request {
                LinkRequest::Check(check @ (in_step::Check::Nonce | in_step::Check::Empty)) => {
                    command::refusal_in(command::decode_reply(&loop_back(*check, *nonce), framing, data))
                }
                LinkRequest::Check(in_step::Check::Status) | LinkRequest::EchoTest => {
                    command::refusal_in(command::decode_reply(&ReadStatus, framing, data))
                }
                LinkRequest::Check(in_step::Check::Detail) => {
                    command::refusal_in(command::decode_reply(&ReadDetailedStatus, framing, data))
                }
            },
        }
    }
}

/// The loop-back of a check that has one: with a nonce, or empty.
fn loop_back(check: in_step::Check, nonce: u64) -> LoopBack {
    match check {
        in_step::Check::Nonce => LoopBack::nonce(nonce),
        in_step::Check::Empty | in_step::Check::Status | in_step::Check::Detail => LoopBack::empty(),
    }
}

/// A request on the wire.
#[derive(Debug)]
pub(crate) struct Active {
    pub(crate) outgoing: Outgoing,
    /// When writing it began.
    pub(crate) began: Instant,
    /// When its last bit was sent.
    pub(crate) sent: Option<Instant>,
    /// When the reply is given up.
    pub(crate) deadline: Instant,
    /// The time from `sent` to the deadline, unless the deadline was moved.
    pub(crate) response_timeout: Duration,
    /// The request of this call was sent before.
    pub(crate) repeats: bool,
    /// The error in the last frame that came instead of the reply.
    pub(crate) fault: Option<String>,
    /// Shape of the positive reply.
    pub(crate) shape: Shape,
    /// The reply, until all frames that came with it are handled.
    pub(crate) reply: Option<Reply>,
    /// The error code of the reply.
    pub(crate) refusal: Option<ErrorCode>,
    /// Another frame of the station, not a duplicate, came after the reply in the same read.
    pub(crate) followed: bool,
    /// A duplicate of the reply came in the same read.
    pub(crate) copied: bool,
    /// The line's byte count before the reply.
    pub(crate) bytes_before: u64,
    /// `true` if the echo of the request has come.
    echoed: bool,
    /// Number of received bytes that were part of no frame.
    discarded: usize,
}

/// Knowledge of whether the line echoes sent frames.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum LineEcho {
    Unknown,
    Absent,
    Present,
}

/// An event in the received bytes.
#[derive(Debug)]
pub(crate) enum Event {
    /// The reply has come. It is held until all frames that came with it are handled.
    Replied,
    /// The echo of the request has come.
    Echoed,
    /// A duplicate of the held reply came with it.
    Duplicate { station: u8 },
    /// A good frame that does not answer the request on the wire.
    Stray { station: u8, command: u8, fingerprint: u64 },
    /// Bytes that are part of no frame.
    Noise { reason: Discard, bytes: usize },
}

/// A good frame in the receive buffer.
struct ReceivedFrame<'a> {
    station: u8,
    command: u8,
    data: &'a [u8],
}

#[derive(Debug)]
pub(crate) struct Exchange {
    codec: Codec,
    /// Received bytes that are not decoded yet.
    pub(crate) received: BytesMut,
    active: Option<Active>,
    /// The encoded request, until it is written.
    request: BytesMut,
    /// Length of the last request.
    request_len: usize,
    mode: EchoMode,
    echo: LineEcho,
    /// The station whose reply to a status request has shown that the line does not echo. If its
    /// request comes back after all, that reply was a late one.
    learned_from: Option<u8>,
    /// Number of bytes of frames on the line so far.
    line_bytes: u64,
    /// The fingerprint of the frame that an echo of the request would be.
    request_fingerprint: u64,
}

impl Exchange {
    pub(crate) fn new(framing: Framing, mode: EchoMode) -> Self {
        let codec = Codec::new(framing, Side::Client);
        let mut exchange = Self {
            codec,
            received: BytesMut::new(),
            active: None,
            request: BytesMut::new(),
            request_len: 0,
            mode,
            echo: LineEcho::Absent,
            learned_from: None,
            line_bytes: 0,
            request_fingerprint: 0,
        };
        exchange.reconnected();
        exchange
    }

    pub(crate) fn framing(&self) -> Framing {
        self.codec.framing()
    }

    /// Returns whether a status request must show first whether the line echoes.
    pub(crate) fn must_learn_echo(&self) -> bool {
        self.echo == LineEcho::Unknown
    }

    /// Number of bytes of frames on the line so far, in both directions.
    pub(crate) fn line_bytes(&self) -> u64 {
        self.line_bytes
    }

    pub(crate) fn active(&self) -> Option<&Active> {
        self.active.as_ref()
    }

    /// The encoded request; empty once it is written.
    pub(crate) fn request(&self) -> &[u8] {
        &self.request
    }

    /// Begins an exchange. `repeats`: its call was sent before. Its request must be written before `by`.
    /// Returns the number of bytes received before the exchange, which are dropped.
    #[inline]
    pub(crate) fn begin(
        &mut self,
        (outgoing, repeats): (Outgoing, bool),
        response_timeout: Duration,
        now: Instant,
        by: Instant,
    ) -> usize {
        let mut request = buffer::borrow();
        let shape = outgoing.encode(self.framing(), &mut request);
        self.request_len = request.len();
        self.request_fingerprint = echo_fingerprint(self.framing(), &request);
        self.request = request;
        self.on_the_line(self.request_len);
        let stale = self.forget();
        self.active = Some(Active {
            shape,
            reply: None,
            refusal: None,
            followed: false,
            copied: false,
            bytes_before: self.line_bytes,
            outgoing,
            began: now,
            sent: None,
            deadline: by,
            response_timeout,
            repeats,
            fault: None,
            echoed: false,
            discarded: 0,
        });
        stale
    }

    /// Notes that the request was sent at `at`, and sets the deadline of its reply.
    #[inline]
    pub(crate) fn sent(&mut self, at: Instant, deadline: Instant) {
        self.written();
        if let Some(active) = &mut self.active {
            active.sent = Some(at);
            active.deadline = deadline;
        }
    }

    /// Gives the request's buffer back.
    fn written(&mut self) {
        if self.request.capacity() > 0 {
            buffer::give_back(std::mem::take(&mut self.request));
        }
    }

    /// Moves the deadline of the reply.
    pub(crate) fn expect_until(&mut self, deadline: Instant) {
        if let Some(active) = &mut self.active {
            active.deadline = deadline;
        }
    }

    /// Ends the exchange. Frames that would have answered it are strays from now on.
    #[inline]
    pub(crate) fn end(&mut self) -> Option<Active> {
        self.written();
        self.active.take()
    }

    /// Ends the exchange of a request of which nothing was written.
    pub(crate) fn withdraw(&mut self) -> Option<Active> {
        let unsent = u64::try_from(self.request_len).unwrap_or(u64::MAX);
        self.line_bytes = self.line_bytes.saturating_sub(unsent);
        self.end()
    }

    /// Ends the exchange without a reply.
    pub(crate) fn give_up(&mut self) -> Option<Active> {
        let active = self.end()?;
        let is_check = matches!(active.outgoing, Outgoing::Link { request: LinkRequest::Check(..), .. });
        if is_check && active.echoed && self.mode != EchoMode::On {
            // The echo may have been the reply: the line may no longer echo.
            self.echo = LineEcho::Unknown;
        }
        Some(active)
    }

    /// Drops undecoded bytes, as after a lost connection. Returns their number.
    pub(crate) fn forget(&mut self) -> usize {
        let len = self.received.len();
        if len > 0 {
            self.received = BytesMut::new();
        }
        self.codec.reset();
        len
    }

    /// Resets the state for a new connection, which may be over another adapter.
    pub(crate) fn reconnected(&mut self) {
        self.forget();
        self.learned_from = None;
        self.echo = match self.mode {
            // The binary framing marks an echo by its header.
            _ if self.framing() == Framing::Binary => LineEcho::Absent,
            // An echo that was found on the last connection may be on this one, too.
            EchoMode::Off if self.echo != LineEcho::Absent => LineEcho::Unknown,
            EchoMode::Off => LineEcho::Absent,
            EchoMode::On => LineEcho::Present,
            EchoMode::Auto => LineEcho::Unknown,
        };
    }

    /// Decodes the next event at `now`. `None`: more bytes are needed.
    pub(crate) fn next_event(&mut self, now: Instant) -> Option<Event> {
        if self.received.is_empty() {
            return None;
        }
        let Found { len, content } = self.codec.find(&self.received)?;
        // The bytes are lent to `classify`, not copied.
        let mut received = std::mem::take(&mut self.received);
        let event = match content {
            Ok(FoundFrame { station, command, data }) => {
                let data = received.get(data).unwrap_or_default();
                self.classify(&ReceivedFrame { station, command, data }, now)
            }
            Err(reason) => self.discarded(reason, received.get(..len).unwrap_or_default()),
        };
        if len < received.len() {
            received.advance(len);
        } else {
            received.clear();
        }
        self.received = received;
        Some(event)
    }

    fn discarded(&mut self, reason: Discard, bytes: &[u8]) -> Event {
        tracing::trace!(%reason, bytes = %bytes.escape_ascii(), "discarded");
        if let Some(active) = &mut self.active {
            active.discarded = active.discarded.saturating_add(bytes.len());
            if may_contain_reply(reason) {
                active.fault = Some(reason.to_string());
            }
        }
        Event::Noise { reason, bytes: bytes.len() }
    }

    /// As [`next_event`](Self::next_event) on a line that has fallen silent: an incomplete frame is
    /// none, and another frame may follow behind its beginning.
    pub(crate) fn next_event_in_silence(&mut self, now: Instant) -> Option<Event> {
        loop {
            match self.next_event(now) {
                Some(event) => return Some(event),
                None if self.received.is_empty() || self.framing() == Framing::Ascii => break,
                None => self.codec.skip_partial(),
            }
        }
        if self.received.is_empty() {
            // The memory of an incomplete frame, which was exactly as much: no link keeps a buffer.
            self.received = BytesMut::new();
        } else if let Some(active) = &mut self.active {
            active.fault = Some("an incomplete frame".to_owned());
        }
        None
    }

    fn on_the_line(&mut self, bytes: usize) {
        self.line_bytes = self.line_bytes.saturating_add(u64::try_from(bytes).unwrap_or(u64::MAX));
    }

    fn classify(&mut self, frame: &ReceivedFrame<'_>, now: Instant) -> Event {
        let (station, command, data) = (frame.station, frame.command, frame.data.escape_ascii());
        tracing::trace!(station, command, %data, "received");
        let framing = self.framing();
        self.on_the_line(frame.data.len().saturating_add(framing.frame_overhead()));
        let fingerprint = fingerprint(frame.command, frame.data);
        let stray = Event::Stray { station: frame.station, command: frame.command, fingerprint };
        if self.is_late_echo(frame) {
            tracing::warn!("the line echoes requests: the status reply that showed otherwise was a late one");
            self.echo = LineEcho::Present;
            self.learned_from = None;
            return Event::Echoed;
        }
        let Some(active) = &mut self.active else { return stray };
        let own = frame.station == active.outgoing.station();
        let fits = own && frame.command == u8::from(active.shape.code);
        if let Some(reply) = &active.reply {
            if own && reply.fingerprint == fingerprint {
                active.copied = true;
                return Event::Duplicate { station: frame.station };
            }
            active.followed |= own;
            return stray;
        }
        // In the binary framing an echo is not decoded as a frame.
        let copy = framing == Framing::Ascii && own && !active.echoed && fingerprint == self.request_fingerprint;
        let learning = matches!(active.outgoing, Outgoing::Link { request: LinkRequest::EchoTest, .. });
        if copy && (self.echo == LineEcho::Present || learning) {
            return self.echoed();
        }
        let fault = if !own {
            None
        } else if !fits {
            Some(format!("a reply to command {:02X}", frame.command))
        } else {
            match active.outgoing.try_complete(framing, frame.data, now) {
                Ok(refusal) => {
                    active.reply = Some(Reply { shape: active.shape, refused: refusal.is_some(), fingerprint });
                    active.refusal = refusal;
                    // A garbled echo is noise, and nearly as long as the request.
                    let quiet = active.discarded.saturating_mul(2) < self.request_len;
                    if learning && quiet && self.echo == LineEcho::Unknown {
                        self.echo = LineEcho::Absent;
                        self.learned_from = Some(frame.station);
                    }
                    return Event::Replied;
                }
                Err(mismatch) => Some(mismatch.to_string()),
            }
        };
        if copy && fault.is_some() {
            tracing::warn!("the line echoes requests: echoes are expected from now on");
            return self.echoed();
        }
        active.fault = fault.or(active.fault.take());
        stray
    }

    /// Returns whether a frame is the status request that seemed to show that the line does not
    /// echo. No reply to 40 is empty.
    fn is_late_echo(&self, frame: &ReceivedFrame<'_>) -> bool {
        let request = frame.command == u8::from(ReadStatus::CODE) && frame.data.is_empty();
        request && self.framing() == Framing::Ascii && self.learned_from == Some(frame.station)
    }

    /// Notes that the line echoes. The reply is still to come.
    fn echoed(&mut self) -> Event {
        self.echo = LineEcho::Present;
        if let Some(active) = &mut self.active {
            active.echoed = true;
        }
        Event::Echoed
    }
}

/// Returns whether bytes discarded for this reason may have been a frame, and thus the reply.
pub(crate) fn may_contain_reply(reason: Discard) -> bool {
    match reason {
        Discard::BadChecksum | Discard::Malformed | Discard::Truncated | Discard::TooLong => true,
        Discard::Garbage | Discard::WrongSide => false,
    }
}

/// The fingerprint of the frame that an echo of the request would be.
fn echo_fingerprint(framing: Framing, request: &[u8]) -> u64 {
    // Only an ASCII request looks like a reply: STX, station, command, data, LRC, ETX.
    match (framing, request) {
        (Framing::Ascii, [_, _, _, high, low, data @ .., _, _, _]) => fingerprint(hex::byte([*high, *low]), data),
        (Framing::Ascii | Framing::Binary, _) => 0,
    }
}
