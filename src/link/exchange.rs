//! One request on the wire, and the matching of what comes back.
//!
//! ```text
//!          begin             reply that matches: Replied
//!   idle ─────────▶ awaiting ────────────────────────────▶ idle
//!                      │  ▲     end (timeout, corruption, lost connection)
//!                      └──┘
//!            anything else is an event, and the wait goes on
//! ```
//!
//! What must always hold:
//! - at most one request is on the wire;
//! - what was received before a request was sent is never its reply;
//! - a reply is given to a call only if station, command and exact shape are those it asks for;
//! - the echo of a request, as an RS-485 adapter may send it, is never its reply.
//!
//! # Echoes
//!
//! In the ASCII framing a request looks like any frame, and the right reply to a loop-back or to STOP *is* its request. So
//! it must be known whether the line echoes before such a request is sent. [`Echo::Unknown`] is settled by a status request
//! (40), whose reply cannot equal it: if the request itself comes back, the line echoes; if the reply comes, and no more
//! noise than a stray byte, it does not. Once the line echoes, the first copy of a request is its echo, and only what comes
//! after it can be its reply. A copy that cannot be a reply proves an echo at any time, also where none was expected.

use bytes::BytesMut;
use tokio::time::Instant;
use tokio_util::codec::Decoder;

use super::buffer;
use super::call::Ticket;
use super::in_step::{self, Reply, Shape};
use super::options::EchoMode;
use crate::command::{self, Command, LoopBack, ReadDetailedStatus, ReadStatus, ReplyError};
use crate::error::ErrorCode;
use crate::hex;
use crate::wire::{Codec, Discard, FieldError, Frame, Framing, Received, Side};

/// What is on the wire.
#[derive(Debug)]
pub(crate) enum Goal {
    /// A call's request.
    Call(Ticket),
    /// A request of the link itself; then, if there is one, the call that it is for.
    Check { station: u8, check: Check, call: Option<Ticket> },
}

/// What the link itself asks a station.
#[derive(Debug)]
pub(crate) enum Check {
    /// What stands between two requests, with its loop-back if it is one.
    Separate(in_step::Check, LoopBack),
    /// The status, to learn whether the line echoes. Its reply proves nothing else.
    Echo,
}

impl Goal {
    pub(crate) fn station(&self) -> u8 {
        match self {
            Self::Call(ticket) => ticket.station,
            Self::Check { station, .. } => *station,
        }
    }

    /// The call that is on the wire, or waits for the check that is.
    pub(crate) fn call(&self) -> Option<&Ticket> {
        match self {
            Self::Call(ticket) => Some(ticket),
            Self::Check { call, .. } => call.as_ref(),
        }
    }

    /// The same, taken.
    pub(crate) fn into_call(self) -> Option<Ticket> {
        match self {
            Self::Call(ticket) => Some(ticket),
            Self::Check { call, .. } => call,
        }
    }

    /// The shape of the positive reply.
    pub(crate) fn shape(&self, framing: Framing) -> Shape {
        match self {
            Self::Call(ticket) => ticket.call.shape(ticket.call.spelling(), framing),
            Self::Check { check, .. } => match check {
                Check::Separate(in_step::Check::Nonce | in_step::Check::Empty, data) => {
                    Shape { code: LoopBack::CODE, size: data.reply_size(data.plain(), framing) }
                }
                Check::Separate(in_step::Check::Status, _) | Check::Echo => in_step::Check::STATUS,
                Check::Separate(in_step::Check::Detail, _) => in_step::Check::DETAIL,
            },
        }
    }

    fn encode(&self, framing: Framing, tx: &mut BytesMut) -> Result<(), command::InvalidRequest> {
        let station = self.station();
        match self {
            Self::Call(ticket) => ticket.call.encode(framing, station, tx),
            Self::Check { check, .. } => match check {
                Check::Separate(in_step::Check::Nonce | in_step::Check::Empty, data) => {
                    command::encode_request(data, framing, station, tx)
                }
                Check::Separate(in_step::Check::Status, _) | Check::Echo => {
                    command::encode_request(&ReadStatus, framing, station, tx)
                }
                Check::Separate(in_step::Check::Detail, _) => {
                    command::encode_request(&ReadDetailedStatus, framing, station, tx)
                }
            },
        }
    }

    /// Offers the data of a frame with the right station and command; it is held if it is the reply, which may be a refusal.
    fn offer(&self, framing: Framing, data: &[u8], now: Instant) -> Result<Option<ErrorCode>, FieldError> {
        match self {
            Self::Call(ticket) => ticket.call.offer(framing, ticket.station, data, now),
            Self::Check { check, .. } => match check {
                Check::Separate(in_step::Check::Nonce | in_step::Check::Empty, echo) => {
                    verdict(command::decode_reply(echo, framing, data))
                }
                Check::Separate(in_step::Check::Status, _) | Check::Echo => {
                    verdict(command::decode_reply(&ReadStatus, framing, data))
                }
                Check::Separate(in_step::Check::Detail, _) => {
                    verdict(command::decode_reply(&ReadDetailedStatus, framing, data))
                }
            },
        }
    }
}

fn verdict<T>(reply: Result<T, ReplyError>) -> Result<Option<ErrorCode>, FieldError> {
    match reply {
        Ok(_) => Ok(None),
        Err(ReplyError::Plc(refusal)) => Ok(Some(refusal)),
        Err(ReplyError::Mismatch(mismatch)) => Err(mismatch),
    }
}

/// A request that waits for its reply.
#[derive(Debug)]
pub(crate) struct Active {
    pub(crate) goal: Goal,
    /// When its sending began.
    pub(crate) began: Instant,
    /// When its last bit was sent.
    pub(crate) sent: Option<Instant>,
    /// When no reply is expected any more.
    pub(crate) deadline: Instant,
    /// Whether the deadline leaves the station the whole response timeout.
    pub(crate) patient: bool,
    /// What was wrong with the last thing that came instead of the reply.
    pub(crate) fault: Option<String>,
    /// The shape of its positive reply.
    pub(crate) shape: Shape,
    /// The reply, until all that came with it is understood.
    pub(crate) reply: Option<Reply>,
    /// The error code of the reply.
    pub(crate) refusal: Option<ErrorCode>,
    /// Behind the reply came another frame of the station in the same read, and no copy.
    pub(crate) followed: bool,
    /// A copy of the reply came in the same read.
    pub(crate) copied: bool,
    /// Bytes on the line before the reply.
    pub(crate) bytes_before: u64,
    /// Whether the request itself has come back.
    echoed: bool,
    /// How many bytes came that were no frame.
    discarded: usize,
}

/// Whether the line echoes what is sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Echo {
    Unknown,
    Absent,
    Present,
}

/// What the received bytes amount to.
#[derive(Debug)]
pub(crate) enum Event {
    /// The reply has come, and is held until all that came with it is understood.
    Replied,
    /// The request itself has come back.
    Echoed,
    /// A copy of the reply that is held came with it.
    Copy { station: u8 },
    /// A good frame that is no reply to what is on the wire.
    Stray { station: u8, command: u8, fingerprint: u64 },
    /// Bytes that are no frame.
    Noise { reason: Discard, bytes: usize },
}

#[derive(Debug)]
pub(crate) struct Exchange {
    codec: Codec,
    /// What has been received and not yet been understood.
    pub(crate) received: BytesMut,
    active: Option<Active>,
    /// The request, until it is written.
    request: BytesMut,
    /// How long it is, or was.
    request_len: usize,
    mode: EchoMode,
    echo: Echo,
    /// The station whose reply to a status request has shown that the line does not echo. If its request comes back after all,
    /// the reply was a late one.
    learned_from: Option<u8>,
    /// Bytes of frames on the line so far.
    line_bytes: u64,
    /// The content of the request, as a frame would have it that is its echo.
    request_print: u64,
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
            echo: Echo::Absent,
            learned_from: None,
            line_bytes: 0,
            request_print: 0,
        };
        exchange.reconnected();
        exchange
    }

    pub(crate) fn framing(&self) -> Framing {
        self.codec.framing()
    }

    /// Whether it must be learned first whether the line echoes.
    pub(crate) fn must_learn_echo(&self) -> bool {
        self.echo == Echo::Unknown
    }

    /// Bytes of frames on the line so far, in both directions.
    pub(crate) fn line_bytes(&self) -> u64 {
        self.line_bytes
    }

    pub(crate) fn active(&self) -> Option<&Active> {
        self.active.as_ref()
    }

    /// The request on the wire, as it is sent; nothing once it is.
    pub(crate) fn request(&self) -> &[u8] {
        &self.request
    }

    /// Puts a request on the wire.
    ///
    /// What has been received so far came before it, and is forgotten; the number of such bytes is returned. `None`: it
    /// cannot be sent in this framing, and its call has failed.
    pub(crate) fn begin(&mut self, goal: Goal, now: Instant, deadline: Instant) -> Option<usize> {
        let mut request = buffer::borrow();
        if let Err(invalid) = goal.encode(self.framing(), &mut request) {
            if let Some(ticket) = goal.call() {
                ticket.call.fail(invalid.into());
            }
            return None;
        }
        self.request_len = request.len();
        self.request_print = print_of_echo(self.framing(), &request);
        self.request = request;
        self.on_the_line(self.request_len);
        let stale = self.forget();
        let shape = goal.shape(self.framing());
        self.active = Some(Active {
            shape,
            reply: None,
            refusal: None,
            followed: false,
            copied: false,
            bytes_before: self.line_bytes,
            goal,
            began: now,
            sent: None,
            deadline,
            patient: false,
            fault: None,
            echoed: false,
            discarded: 0,
        });
        Some(stale)
    }

    /// The request has been sent, at this time; its reply is given up at that one.
    pub(crate) fn sent(&mut self, at: Instant, deadline: Instant, patient: bool) {
        self.written();
        if let Some(active) = &mut self.active {
            active.sent = Some(at);
            active.deadline = deadline;
            active.patient = patient;
        }
    }

    /// The bytes of the request are not needed any more.
    fn written(&mut self) {
        if self.request.capacity() > 0 {
            buffer::give_back(std::mem::take(&mut self.request));
        }
    }

    /// Moves the time when the reply is given up.
    pub(crate) fn expect_until(&mut self, deadline: Instant) {
        if let Some(active) = &mut self.active {
            active.deadline = deadline;
        }
    }

    /// Takes what is on the wire off it; what comes of it later is stray.
    pub(crate) fn end(&mut self) -> Option<Active> {
        self.written();
        self.active.take()
    }

    /// The same, when no reply has come.
    pub(crate) fn give_up(&mut self) -> Option<Active> {
        let active = self.end()?;
        let barrier = matches!(active.goal, Goal::Check { check: Check::Separate(..), .. });
        if barrier && active.echoed && self.mode != EchoMode::On {
            // Perhaps that was the reply, and the line does not echo any more.
            self.echo = Echo::Unknown;
        }
        Some(active)
    }

    /// Forgets what has been received, as after a lost connection; says how many bytes that were.
    pub(crate) fn forget(&mut self) -> usize {
        let len = self.received.len();
        if len > 0 {
            self.received = BytesMut::new();
        }
        self.codec.reset();
        len
    }

    /// There is a new connection, perhaps over another adapter.
    pub(crate) fn reconnected(&mut self) {
        self.forget();
        self.learned_from = None;
        self.echo = match self.mode {
            // The binary framing marks an echo by its header.
            _ if self.framing() == Framing::Binary => Echo::Absent,
            // What was found out about the last line may be true of this one: better ask.
            EchoMode::Off if self.echo != Echo::Absent => Echo::Unknown,
            EchoMode::Off => Echo::Absent,
            EchoMode::On => Echo::Present,
            EchoMode::Auto => Echo::Unknown,
        };
    }

    /// Understands the next thing that has been received, at `now`. `None`: more bytes are needed.
    pub(crate) fn next_event(&mut self, now: Instant) -> Option<Event> {
        if self.received.is_empty() {
            return None;
        }
        // The codecs do no I/O, so they have no errors.
        Some(match self.codec.decode(&mut self.received).ok().flatten()? {
            Received::Frame(frame) => self.classify(&frame, now),
            Received::Discarded { reason, bytes } => {
                tracing::trace!(%reason, bytes = %bytes.escape_ascii(), "discarded");
                if let Some(active) = &mut self.active {
                    active.discarded = active.discarded.saturating_add(bytes.len());
                    if spoils(reason) {
                        active.fault = Some(reason.to_string());
                    }
                }
                Event::Noise { reason, bytes: bytes.len() }
            }
        })
    }

    /// As [`next_event`](Self::next_event), when the line has fallen silent: what looked like the beginning of a frame
    /// is none, and a frame may stand behind it.
    pub(crate) fn next_event_in_silence(&mut self, now: Instant) -> Option<Event> {
        loop {
            match self.next_event(now) {
                Some(event) => return Some(event),
                None if self.received.is_empty() || self.framing() == Framing::Ascii => break,
                None => self.codec.skip_partial(),
            }
        }
        if let (Some(active), false) = (&mut self.active, self.received.is_empty()) {
            active.fault = Some("an incomplete frame".to_owned());
        }
        None
    }

    fn on_the_line(&mut self, bytes: usize) {
        self.line_bytes = self.line_bytes.saturating_add(u64::try_from(bytes).unwrap_or(u64::MAX));
    }

    fn classify(&mut self, frame: &Frame, now: Instant) -> Event {
        tracing::trace!(station = frame.station, command = frame.command, data = %frame.data.escape_ascii(), "received");
        let framing = self.framing();
        self.on_the_line(frame.data.len().saturating_add(framing.frame_overhead()));
        let fingerprint = in_step::fingerprint(frame.command, &frame.data);
        let stray = Event::Stray { station: frame.station, command: frame.command, fingerprint };
        if self.is_late_echo(frame) {
            tracing::warn!(
                "the line sends back what is sent on it: the reply that seemed to show the contrary was a late one"
            );
            self.echo = Echo::Present;
            self.learned_from = None;
            return Event::Echoed;
        }
        let Some(active) = &mut self.active else { return stray };
        let own = frame.station == active.goal.station();
        let fits = own && frame.command == u8::from(active.shape.code);
        if let Some(reply) = &active.reply {
            if own && reply.fingerprint == fingerprint {
                active.copied = true;
                return Event::Copy { station: frame.station };
            }
            active.followed |= own;
            return stray;
        }
        // In the binary framing an echo is not even a frame.
        let copy = framing == Framing::Ascii && own && !active.echoed && fingerprint == self.request_print;
        let learning = matches!(active.goal, Goal::Check { check: Check::Echo, .. });
        if copy && (self.echo == Echo::Present || learning) {
            return self.echoed();
        }
        let fault = if !own {
            None
        } else if !fits {
            Some(format!("a reply to command {:02X}", frame.command))
        } else {
            match active.goal.offer(framing, &frame.data, now) {
                Ok(refusal) => {
                    active.reply = Some(Reply { shape: active.shape, refused: refusal.is_some(), fingerprint });
                    active.refusal = refusal;
                    // An echo that was garbled is noise, and nearly as long as the request.
                    let quiet = active.discarded.saturating_mul(2) < self.request_len;
                    if learning && quiet && self.echo == Echo::Unknown {
                        self.echo = Echo::Absent;
                        self.learned_from = Some(frame.station);
                    }
                    return Event::Replied;
                }
                Err(mismatch) => Some(mismatch.to_string()),
            }
        };
        if copy && fault.is_some() {
            tracing::warn!("the line sends back what is sent on it; from now on that is expected");
            return self.echoed();
        }
        active.fault = fault.or(active.fault.take());
        stray
    }

    /// Whether a frame is the status request by which it was learned that the line does not echo: no reply to 40 is empty.
    fn is_late_echo(&self, frame: &Frame) -> bool {
        let request = frame.command == u8::from(ReadStatus::CODE) && frame.data.is_empty();
        request && self.framing() == Framing::Ascii && self.learned_from == Some(frame.station)
    }

    /// The request itself has come back, so the line echoes; the reply is still to come.
    fn echoed(&mut self) -> Event {
        self.echo = Echo::Present;
        if let Some(active) = &mut self.active {
            active.echoed = true;
        }
        Event::Echoed
    }
}

/// Whether a frame, and perhaps the reply, was lost with such bytes.
pub(crate) fn spoils(reason: Discard) -> bool {
    matches!(reason, Discard::BadChecksum | Discard::Malformed | Discard::Truncated | Discard::TooLong)
}

/// The fingerprint of the frame that the echo of a request is.
fn print_of_echo(framing: Framing, request: &[u8]) -> u64 {
    // Only in the ASCII framing a request looks like a reply: STX, station, command, data, LRC, ETX.
    let content = request.get(3..request.len().saturating_sub(3)).filter(|_| framing == Framing::Ascii);
    let Some(([high, low], data)) = content.and_then(<[u8]>::split_first_chunk) else { return 0 };
    in_step::fingerprint(hex::byte([*high, *low]), data)
}
