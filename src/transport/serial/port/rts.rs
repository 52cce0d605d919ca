//! The lines DTR and RTS of a serial port, and RTS as the direction of an RS-485 driver.
//!
//! States of a [`SwitchedPort`]: receiving (RTS at rest), and sending until an instant. A write
//! sets RTS before its first byte, and extends the instant by its transmission time. A thread of
//! the port sets RTS back: the timers of the runtime are too coarse, and its tasks may be late.
//!
//! Invariants:
//! - No byte is written while RTS is at rest.
//! - RTS is not set back before all bytes are transmitted, as far as the operating system shows.
//! - A port that is dropped has RTS at rest. The operating system switches it off after that.

use std::io;
use std::pin::Pin;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::task::{Context, Poll};
use std::thread;
use std::time::{Duration, Instant};

use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};

use crate::link::Line;
use crate::settings::{Rts, SerialSettings};

/// The operations of a serial port besides reading and writing.
pub(in crate::transport) trait ControlLines {
    fn set_dtr(&mut self, on: bool) -> io::Result<()>;
    fn set_rts(&mut self, on: bool) -> io::Result<()>;
    /// The number of written bytes that the operating system has not passed on.
    fn unsent(&self) -> io::Result<u32>;
    /// Discards these bytes.
    fn discard_unsent(&self) -> io::Result<()>;
}

/// The level of RTS while sending.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum WhileSending {
    On,
    Off,
}

/// How RTS is switched.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Switching {
    while_sending: WhileSending,
    byte_time: Duration,
}

impl Switching {
    fn level(self, sending: bool) -> bool {
        sending == (self.while_sending == WhileSending::On)
    }
}

/// Sets the lines of a port that was just opened. `driver_mode` sets the RS-485 mode of its driver, or
/// ends one that was set before, and returns whether there is one now. Returns how RTS is switched,
/// unless it is constant or the driver switches it.
pub(super) fn set_lines(
    port: &mut impl ControlLines,
    settings: SerialSettings,
    driver_mode: impl FnOnce(Option<WhileSending>) -> io::Result<bool>,
) -> io::Result<Option<Switching>> {
    if let Some(on) = settings.dtr() {
        port.set_dtr(on).map_err(|error| cannot_set("DTR", &error))?;
    }
    let while_sending = match settings.rts() {
        Rts::Unchanged => return Ok(None),
        constant @ (Rts::On | Rts::Off) => {
            driver_mode(None).map_err(|error| cannot_set("RTS", &error))?;
            port.set_rts(constant == Rts::On).map_err(|error| cannot_set("RTS", &error))?;
            return Ok(None);
        }
        Rts::OnWhileSending => WhileSending::On,
        Rts::OffWhileSending => WhileSending::Off,
    };
    if driver_mode(Some(while_sending)).map_err(|error| cannot_set("RTS", &error))? {
        tracing::debug!("RS-485: the driver switches RTS");
        return Ok(None);
    }
    tracing::debug!("RS-485: the driver has no such mode, so RTS is switched by transmission times");
    let switching = Switching { while_sending, byte_time: Line::from(settings).transmission(1) };
    port.set_rts(switching.level(false)).map_err(|error| cannot_set("RTS", &error))?;
    Ok(Some(switching))
}

/// The instant `time` after `at`, or `at` beyond the range of the clock, which no write reaches.
fn later(at: Instant, time: Duration) -> Instant {
    at.checked_add(time).unwrap_or(at)
}

fn cannot_set(line: &str, error: &io::Error) -> io::Error {
    io::Error::new(error.kind(), format!("the line {line} of the port cannot be set: {error}"))
}

/// Time between two questions whether bytes are unsent.
const UNSENT_INTERVAL: Duration = Duration::from_micros(200);

/// Time after the computed end of transmission for which unsent bytes are waited for. More are not
/// transmitted at all, as by an adapter that was unplugged.
const LONGEST_UNSENT: Duration = Duration::from_secs(1);

/// Number of bytes that the hardware of a port holds at most, which the operating system counts as
/// sent.
const HARDWARE_BUFFER: u32 = 64;

/// A port whose RTS is switched for each transmission.
#[derive(Debug)]
pub(in crate::transport) struct SwitchedPort<P: ControlLines> {
    shared: Arc<Shared<P>>,
}

#[derive(Debug)]
struct Shared<P> {
    state: Mutex<State<P>>,
    /// A transmission has begun, or the port is closed.
    changed: Condvar,
    switching: Switching,
}

#[derive(Debug)]
struct State<P> {
    /// `None` once it is closed.
    port: Option<P>,
    /// The end of the transmission; `None` while RTS is at rest.
    sending_until: Option<Instant>,
    /// Bytes were unsent after that time: the port is late, and its hardware may still hold bytes.
    is_late: bool,
}

impl<P> Shared<P> {
    fn lock(&self) -> MutexGuard<'_, State<P>> {
        // No code that can panic leaves the state half changed.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl<P: ControlLines + Send + 'static> SwitchedPort<P> {
    pub(super) fn new(port: P, switching: Switching) -> io::Result<Self> {
        let state = Mutex::new(State { port: Some(port), sending_until: None, is_late: false });
        let shared = Arc::new(Shared { state, changed: Condvar::new(), switching });
        let of_thread = shared.clone();
        thread::Builder::new().name("fatek-rs485".to_owned()).spawn(move || of_thread.set_back())?;
        Ok(Self { shared })
    }
}

impl<P: ControlLines> Shared<P> {
    /// Sets RTS back after each transmission, until the port is closed.
    fn set_back(&self) {
        let mut state = self.lock();
        loop {
            let State { port: Some(port), sending_until, is_late } = &mut *state else { return };
            let now = Instant::now();
            let wait = match *sending_until {
                None => None,
                Some(until) if now < until => Some(until.saturating_duration_since(now)),
                // Without an answer, the computed time is all there is.
                Some(until) if now < later(until, LONGEST_UNSENT) && port.unsent().is_ok_and(|bytes| bytes > 0) => {
                    *is_late = true;
                    Some(UNSENT_INTERVAL)
                }
                Some(_) if std::mem::take(is_late) => Some(self.switching.byte_time.saturating_mul(HARDWARE_BUFFER)),
                Some(_) => {
                    *sending_until = None;
                    if let Err(error) = port.set_rts(self.switching.level(false)) {
                        // The next write fails as well, and its error is reported.
                        tracing::warn!(%error, "RS-485: RTS cannot be set back");
                    }
                    continue;
                }
            };
            state = match wait {
                None => self.changed.wait(state).unwrap_or_else(PoisonError::into_inner),
                Some(time) => self.changed.wait_timeout(state, time).unwrap_or_else(PoisonError::into_inner).0,
            };
        }
    }
}

impl<P: ControlLines + AsyncRead + Unpin> SwitchedPort<P> {
    pub(super) fn poll_read(&mut self, cx: &mut Context<'_>, buf: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        match &mut self.shared.lock().port {
            Some(port) => Pin::new(port).poll_read(cx, buf),
            None => Poll::Ready(Ok(())),
        }
    }
}

impl<P: ControlLines + AsyncWrite + Unpin> SwitchedPort<P> {
    pub(super) fn poll_write(&mut self, cx: &mut Context<'_>, buf: &[u8]) -> Poll<io::Result<usize>> {
        let mut state = self.shared.lock();
        let State { port: Some(port), sending_until, .. } = &mut *state else {
            return Poll::Ready(Err(io::ErrorKind::BrokenPipe.into()));
        };
        let switching = self.shared.switching;
        if sending_until.is_none() {
            port.set_rts(switching.level(true)).map_err(|error| cannot_set("RTS", &error))?;
        }
        let written = Pin::new(port).poll_write(cx, buf);
        let now = Instant::now();
        let bytes = match &written {
            Poll::Ready(Ok(bytes)) => u32::try_from(*bytes).unwrap_or(u32::MAX),
            Poll::Ready(Err(_)) | Poll::Pending => 0,
        };
        // A further character: the port begins a little after the write.
        let begins = sending_until.unwrap_or(now).max(later(now, switching.byte_time));
        *sending_until = Some(later(begins, switching.byte_time.saturating_mul(bytes)));
        self.shared.changed.notify_one();
        written
    }
}

impl<P: ControlLines> Drop for SwitchedPort<P> {
    fn drop(&mut self) {
        let mut state = self.shared.lock();
        if let Some(mut port) = state.port.take() {
            // As for other ports, the errors of an unplugged port are ignored.
            let _ = port.discard_unsent();
            let _ = port.set_rts(self.shared.switching.level(false));
        }
        self.shared.changed.notify_one();
    }
}

#[cfg(test)]
mod tests;
