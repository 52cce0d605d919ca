//! Writes the request of the core. The only place that writes to a connection, and so the one that asks
//! the send gate.

use std::io;
use std::pin::Pin;
use std::task::{Context, Poll, ready};

use tokio::io::AsyncWrite as _;
use tokio::time::Instant;

use super::{Clock, Driver};
use crate::link::later;
use crate::link::send_gate::SendGate;

/// A request that is being written.
#[derive(Debug)]
pub(super) struct Writing {
    /// Number of bytes written.
    pub(super) written: usize,
    /// When all must be written.
    pub(super) by: Instant,
}

/// Why a request was not written, or not whole.
#[derive(Debug)]
pub(super) enum Unwritten {
    /// The send gate is closed. `partly`: a part of the request was written before.
    GateClosed { partly: bool },
    /// The connection is lost.
    Lost(io::Error),
}

impl Driver {
    /// Continues to write the request. Ready when it is written and flushed, or has failed.
    ///
    /// The only place that writes: the send gate is asked here, with nothing in between.
    pub(super) fn poll_write(&mut self, cx: &mut Context<'_>) -> Poll<Result<(), Unwritten>> {
        let Some(writing) = &mut self.writing else { return Poll::Ready(Ok(())) };
        let Some(io) = &mut self.io else {
            self.writing = None;
            return Poll::Ready(Err(Unwritten::Lost(io::ErrorKind::NotConnected.into())));
        };
        let may_send = || self.send_gate.as_ref().is_none_or(SendGate::is_open);
        let result = loop {
            match self.core.request_bytes().get(writing.written..) {
                Some(rest) if !rest.is_empty() => {
                    if !may_send() {
                        break Err(Unwritten::GateClosed { partly: writing.written > 0 });
                    }
                    match ready!(Pin::new(&mut *io).poll_write(cx, rest)) {
                        Ok(0) => break Err(Unwritten::Lost(io::ErrorKind::WriteZero.into())),
                        // A stream that claims more than it was given has written all of it.
                        Ok(written) => writing.written = writing.written.saturating_add(written),
                        Err(error) => break Err(Unwritten::Lost(error)),
                    }
                }
                // Flushing a serial port blocks the thread until the last bit is sent.
                _ if self.core.config().line.is_some() => break Ok(()),
                // A user's stream may have kept the bytes until now. The crate's own have sent them.
                _ if !self.connector.wakes_reader() && !may_send() => {
                    break Err(Unwritten::GateClosed { partly: true });
                }
                _ => break ready!(Pin::new(&mut *io).poll_flush(cx)).map_err(Unwritten::Lost),
            }
        };
        self.writing = None;
        Poll::Ready(result)
    }

    /// Returns whether the send gate, if there is one, is open.
    pub(super) fn may_send(&self) -> bool {
        self.send_gate.as_ref().is_none_or(SendGate::is_open)
    }

    /// Handles a request that the send gate has held back, or the rest of it.
    pub(super) fn gate_closed(&mut self, partly: bool, now: Instant) {
        self.core.gate_closed(partly, now);
        if partly {
            let closed = "the send gate closed while a request was being written";
            self.connection_lost(io::Error::other(closed), now);
        }
    }

    /// When the bytes just written leave the machine.
    ///
    /// On a serial line they follow those written before. A socket takes them at once, and the
    /// clock need not be read for it. A user's stream may take long within a write or a flush.
    pub(super) fn transmitted_at(&mut self, clock: &mut Clock) -> Instant {
        let Some(line) = self.core.config().line else {
            return if self.connector.wakes_reader() { clock.now() } else { clock.look() };
        };
        let now = clock.look();
        let begins = self.sent_until.map_or(now, |until| until.max(now));
        let ends = later(begins, line.transmission(self.core.request_bytes().len()));
        self.sent_until = Some(ends);
        ends
    }
}
