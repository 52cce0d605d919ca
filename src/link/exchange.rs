//! One request on the wire, and the matching of what comes back.
//!
//! ```text
//!          begin             reply that matches: Replied
//!   idle ─────────▶ awaiting ────────────────────────────▶ idle
//!                      │  ▲     loop-back refused: Refused
//!                      └──┘     end (timeout, corruption, lost connection)
//!            anything else is an event, and the wait goes on
//! ```
//!
//! What must always hold:
//! - at most one request is on the wire;
//! - what was received before a request was sent is never its reply;
//! - a reply is given to a call only if station, command and exact shape are those it asks for.

use bytes::BytesMut;
use tokio::time::Instant;
use tokio_util::codec::Decoder;

use super::call::Ticket;
use crate::command::{self, Code, LoopBack, ReplyError};
use crate::wire::{Codec, Discard, Frame, Framing, Received, Side};

/// What is on the wire.
#[derive(Debug)]
pub(crate) enum Goal {
    /// A call's request.
    Call(Ticket),
    /// The loop-back that must come back before anything of a dirty station is believed; then, if there is one, the
    /// call that it is for.
    Barrier { station: u8, nonce: LoopBack, call: Option<Ticket> },
}

impl Goal {
    pub(crate) fn station(&self) -> u8 {
        match self {
            Self::Call(ticket) => ticket.station,
            Self::Barrier { station, .. } => *station,
        }
    }

    fn code(&self) -> Code {
        match self {
            Self::Call(ticket) => ticket.code,
            Self::Barrier { .. } => Code::LoopBack,
        }
    }
}

/// A request that waits for its reply.
#[derive(Debug)]
pub(crate) struct Active {
    pub(crate) goal: Goal,
    /// When its sending began.
    pub(crate) began: Instant,
    /// When no reply is expected any more.
    pub(crate) deadline: Instant,
    /// Whether the deadline leaves the station the whole response timeout.
    pub(crate) patient: bool,
    /// What was wrong with the last thing that came instead of the reply.
    pub(crate) fault: Option<String>,
    /// Whether a frame of this very station came that was not its reply: there may be more behind it.
    pub(crate) doubtful: bool,
}

/// What the received bytes amount to.
#[derive(Debug)]
pub(crate) enum Event {
    /// The reply has come, and the call has it.
    Replied(Active),
    /// The station refused the loop-back.
    Refused(Active),
    /// A good frame that is no reply to what is on the wire.
    Stray { station: u8 },
    /// Bytes that are no frame.
    Noise(Discard),
}

#[derive(Debug)]
pub(crate) struct Exchange {
    codec: Codec,
    /// What has been received and not yet been understood.
    pub(crate) received: BytesMut,
    active: Option<Active>,
}

impl Exchange {
    pub(crate) fn new(framing: Framing) -> Self {
        Self { codec: Codec::new(framing, Side::Client), received: BytesMut::new(), active: None }
    }

    pub(crate) fn framing(&self) -> Framing {
        self.codec.framing()
    }

    pub(crate) fn active(&self) -> Option<&Active> {
        self.active.as_ref()
    }

    /// Puts a request on the wire: appends it to `tx`.
    ///
    /// What has been received so far came before it, and is forgotten; the number of such bytes is returned. `None`: it
    /// cannot be sent in this framing, and its call has failed.
    pub(crate) fn begin(&mut self, goal: Goal, now: Instant, deadline: Instant, tx: &mut BytesMut) -> Option<usize> {
        let encoded = match &goal {
            Goal::Call(ticket) => ticket.call.encode(self.framing(), ticket.station, tx),
            Goal::Barrier { station, nonce, .. } => command::encode_request(nonce, self.framing(), *station, tx),
        };
        if let Err(invalid) = encoded {
            if let Goal::Call(ticket) | Goal::Barrier { call: Some(ticket), .. } = &goal {
                ticket.call.fail(invalid.into());
            }
            return None;
        }
        let stale = self.forget();
        self.active = Some(Active { goal, began: now, deadline, patient: false, fault: None, doubtful: false });
        Some(stale)
    }

    /// Sets when the reply is given up.
    pub(crate) fn expect_until(&mut self, deadline: Instant, patient: bool) {
        if let Some(active) = &mut self.active {
            active.deadline = deadline;
            active.patient = patient;
        }
    }

    /// Takes what is on the wire off it; what comes of it later is stray.
    pub(crate) fn end(&mut self) -> Option<Active> {
        self.active.take()
    }

    /// Forgets what has been received, as after a lost connection; says how many bytes that were.
    pub(crate) fn forget(&mut self) -> usize {
        let len = self.received.len();
        self.received.clear();
        self.codec.reset();
        len
    }

    /// Understands the next thing that has been received. `None`: more bytes are needed.
    pub(crate) fn next_event(&mut self) -> Option<Event> {
        // The codecs do no I/O, so they have no errors.
        let event = match self.codec.decode(&mut self.received).ok().flatten()? {
            Received::Frame(frame) => self.classify(frame),
            Received::Discarded { reason, bytes } => {
                tracing::trace!(%reason, bytes = %bytes.escape_ascii(), "discarded");
                if let (Some(active), true) = (&mut self.active, reason != Discard::Garbage) {
                    active.fault = Some(reason.to_string());
                }
                Event::Noise(reason)
            }
        };
        Some(event)
    }

    /// As [`next_event`](Self::next_event), when the line has fallen silent: what looked like the beginning of a frame
    /// is none, and a frame may stand behind it.
    pub(crate) fn next_event_in_silence(&mut self) -> Option<Event> {
        loop {
            match self.next_event() {
                Some(event) => return Some(event),
                None if self.received.is_empty() || self.framing() == Framing::Ascii => return None,
                None => self.codec.skip_partial(),
            }
        }
    }

    fn classify(&mut self, frame: Frame) -> Event {
        tracing::trace!(station = frame.station, command = frame.command, data = %frame.data.escape_ascii(), "received");
        let framing = self.framing();
        let Some(mut active) = self.active.take() else {
            return Event::Stray { station: frame.station };
        };
        let station = active.goal.station();
        if frame.station != station {
            self.active = Some(active);
            return Event::Stray { station: frame.station };
        }
        if frame.command != u8::from(active.goal.code()) {
            active.fault = Some(format!("a reply to command {:02X}", frame.command));
            active.doubtful = true;
            self.active = Some(active);
            return Event::Stray { station };
        }
        let verdict = match &active.goal {
            Goal::Call(ticket) => ticket.call.offer(framing, station, &frame.data).map(|_| true),
            Goal::Barrier { nonce, .. } => match command::decode_reply(nonce, framing, &frame.data) {
                Ok(()) => Ok(true),
                Err(ReplyError::Plc(_)) => Ok(false),
                Err(ReplyError::Mismatch(mismatch)) => Err(mismatch),
            },
        };
        match verdict {
            Ok(true) => Event::Replied(active),
            Ok(false) => Event::Refused(active),
            Err(mismatch) => {
                active.fault = Some(mismatch.to_string());
                active.doubtful = true;
                self.active = Some(active);
                Event::Stray { station }
            }
        }
    }
}
