//! The send gate: a permission that a link asks for immediately before it sends.
//!
//! ```text
//!                        gate                             gate
//! call waits ──link is idle──▶ connect, if needed ──▶ each write ──▶ bytes to the operating system
//!                 │ closed                               │ closed
//!                 ▼                                      ▼
//!        all waiting calls fail         no byte left: the call fails, the connection stays
//!                                       a part left:  the call fails in doubt, the connection is closed
//! ```
//!
//! The driver asks; the core ends the calls. `Driver::poll_write` is the only place that writes, so it
//! asks in one place for all requests: those of calls, checks, probes, retries and broadcasts.
//!
//! Invariants:
//! - No byte of a request is written unless the gate was open immediately before.
//! - The rest of a request whose gate closed within it is never written.
//! - Nothing waits for a gate to open: waiting calls fail, and offline stations are not probed.

use std::fmt;
use std::sync::Arc;

/// A permission that a link asks for immediately before it sends.
///
/// For programs that must not send at certain times: redundant masters of which one is active, leases,
/// locks for maintenance. A link without a gate sends at any time. Clones are the same gate, so one gate
/// may serve many links.
///
/// The gate is asked before each write of bytes of a request to the operating system, on each transport:
/// for the requests of calls, their retries, broadcasts, and the [checks](crate::StationStats::checks)
/// and probes of the link itself. It is also asked before a connection is opened.
///
/// While it is closed, no byte is sent and no connection is begun. One that is being opened goes on:
///
/// - Calls fail with [`Error::GateClosed`](crate::Error::GateClosed), without retries, and so do the calls
///   that wait. A [`Poller`](crate::Poller) has the error as the reason of its samples.
/// - If the gate closes within a request of which a part was written, the rest is not sent, and the
///   connection is closed. The error then says that the request may have been executed.
/// - The reply to a request that was sent before is still taken.
/// - An open connection stays open; [`Link::close`](crate::Link::close) and
///   [`Pool::close_endpoint`](crate::Pool::close_endpoint) close it.
/// - Stations that were offline become [unknown](crate::StationState::Unknown) and are not probed.
///
/// When it is open again, the next call is sent. Nothing waits for that.
///
/// # Limits
///
/// The gate decides when bytes are handed to the operating system. They reach the PLC later: a TCP
/// connection repeats lost segments, and a serial port transmits at its baud rate. The process can also
/// be stopped between the question and the write. For a stream of the program's own, the gate is asked
/// before each write and each flush, and not within one. A lease therefore needs a gate that closes early
/// enough before its end.
///
/// # Examples
///
/// One of two redundant masters:
///
/// ```
/// # #[tokio::main(flavor = "current_thread")]
/// # async fn main() -> Result<(), Box<dyn std::error::Error>> {
/// use std::sync::Arc;
/// use std::sync::atomic::{AtomicBool, Ordering};
/// use fatek::sim::{self, Bus, Plc};
/// use fatek::{Error, Link, register, wire::Framing};
///
/// let is_active = Arc::new(AtomicBool::new(true));
/// let gate = {
///     let is_active = is_active.clone();
///     move || is_active.load(Ordering::Acquire)
/// };
/// let bus = Bus::new().with_station(1, Plc::new())?;
/// let connector = sim::connector(bus, Framing::Ascii);
/// let link = Link::connector_builder("press 3", Framing::Ascii, connector).send_gate(gate).build();
/// let station = link.station(1)?;
/// station.write_registers(register!("R0"), &[7]).await?;
///
/// is_active.store(false, Ordering::Release);
/// let error = station.write_registers(register!("R0"), &[8]).await.unwrap_err();
/// assert!(matches!(error, Error::GateClosed { .. }) && !error.may_have_executed());
/// # Ok(())
/// # }
/// ```
#[derive(Clone)]
pub struct SendGate {
    /// A thin pointer: each link has room for one.
    is_open: Arc<Box<IsOpen>>,
}

type IsOpen = dyn Fn() -> bool + Send + Sync;

impl SendGate {
    /// Makes a gate that is open while this function returns `true`.
    ///
    /// The link calls it on its task and on the tasks of its callers, with a lock held: it must return
    /// at once, must not use the link, and must not panic. A panic ends the link, as one of a transport.
    #[must_use]
    pub fn new(is_open: impl Fn() -> bool + Send + Sync + 'static) -> Self {
        Self { is_open: Arc::new(Box::new(is_open)) }
    }

    /// Returns whether the gate is open now.
    #[must_use]
    pub fn is_open(&self) -> bool {
        (self.is_open)()
    }

    /// Returns a gate that is open while both are.
    #[must_use]
    pub fn and(self, other: Self) -> Self {
        Self::new(move || self.is_open() && other.is_open())
    }
}

/// As [`SendGate::new`].
impl<F: Fn() -> bool + Send + Sync + 'static> From<F> for SendGate {
    fn from(is_open: F) -> Self {
        Self::new(is_open)
    }
}

impl fmt::Debug for SendGate {
    /// Does not ask: that may have an effect.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("SendGate")
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicU32, Ordering};

    use super::*;

    #[test]
    fn two_gates_are_open_only_together() {
        let bits = Arc::new(AtomicU32::new(0));
        let bit = |mask: u32| {
            let bits = bits.clone();
            SendGate::new(move || bits.load(Ordering::Relaxed) & mask != 0)
        };
        let both = bit(1).and(bit(2));
        let open = (0..4).map(|set| {
            bits.store(set, Ordering::Relaxed);
            both.clone().is_open()
        });
        assert_eq!(open.collect::<Vec<_>>(), [false, false, false, true]);
    }

    #[test]
    fn a_link_has_room_for_a_pointer_only() {
        assert_eq!(size_of::<Option<SendGate>>(), size_of::<usize>());
    }
}
