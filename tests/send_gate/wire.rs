//! A gate that closes at a set moment, and a stream that takes requests piece by piece and records
//! all that comes after that.

use std::io;
use std::pin::Pin;
use std::sync::{Arc, Mutex, MutexGuard};
use std::task::{Context, Poll, ready};
use std::time::Duration;

use bytes::BytesMut;
use fatek::SendGate;
use fatek::wire::{Codec, Framing, Side};
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::time::{Instant, Sleep, sleep};
use tokio_util::codec::Decoder;

use crate::rng::Rng;

/// When the gate closes, apart from [`Wire::close`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Closing {
    /// Never by itself.
    Never,
    /// The question of this number, from 1, is the first one with the answer no.
    AtQuestion(u64),
    /// After this number of bytes, from 1, has been taken, also within a request.
    AfterByte(u64),
}

/// The wire of a link and its gate. Clones are the same one.
#[derive(Clone)]
pub(crate) struct Wire(Arc<Mutex<State>>);

struct State {
    rng: Rng,
    framing: Framing,
    closing: Closing,
    is_open: bool,
    /// Takes each request whole and at once.
    is_quick: bool,
    closed_at: Option<Instant>,
    /// The gate closed within a request.
    closed_within: bool,
    /// The request that is being taken is incomplete.
    is_within: bool,
    all: Count,
    /// Since the gate closed.
    after: Count,
}

/// Numbers of events.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Count {
    /// Times that the gate was asked.
    pub(crate) questions: u64,
    pub(crate) connects: u64,
    pub(crate) bytes: u64,
    /// Whole requests.
    pub(crate) requests: u64,
}

impl Wire {
    pub(crate) fn new(seed: u64, framing: Framing, closing: Closing) -> Self {
        Self(Arc::new(Mutex::new(State {
            rng: Rng(seed),
            framing,
            closing,
            is_open: true,
            is_quick: false,
            closed_at: None,
            closed_within: false,
            is_within: false,
            all: Count::default(),
            after: Count::default(),
        })))
    }

    /// Takes each request whole and at once.
    pub(crate) fn quick(self) -> Self {
        self.state().is_quick = true;
        self
    }

    pub(crate) fn gate(&self) -> SendGate {
        let wire = self.clone();
        SendGate::new(move || wire.state().ask())
    }

    pub(crate) fn close(&self) {
        self.state().close();
    }

    /// Opens the gate for good.
    pub(crate) fn open(&self) {
        let mut state = self.state();
        (state.is_open, state.closing) = (true, Closing::Never);
    }

    pub(crate) fn closed_at(&self) -> Option<Instant> {
        self.state().closed_at
    }

    /// Returns whether the gate closed within a request.
    pub(crate) fn closed_within(&self) -> bool {
        self.state().closed_within
    }

    pub(crate) fn all(&self) -> Count {
        self.state().all
    }

    /// The events while the gate was closed.
    pub(crate) fn after(&self) -> Count {
        self.state().after
    }

    /// Opens a connection. Its beginning counts.
    pub(crate) fn connect<S, F: Future<Output = io::Result<S>>>(
        &self,
        opening: F,
    ) -> impl Future<Output = io::Result<Recorded<S>>> + use<S, F> {
        let wire = self.clone();
        wire.state().count(|count| count.connects += 1);
        async move { Ok(wire.record(opening.await?)) }
    }

    /// A stream whose writes are recorded.
    pub(crate) fn record<S>(&self, inner: S) -> Recorded<S> {
        let mut state = self.state();
        state.is_within = false;
        let codec = Codec::new(state.framing, Side::Plc);
        drop(state);
        Recorded { inner, wire: self.clone(), codec, taken: BytesMut::new(), pause: None, paused: false }
    }

    fn state(&self) -> MutexGuard<'_, State> {
        self.0.lock().unwrap()
    }
}

impl State {
    fn ask(&mut self) -> bool {
        self.count(|count| count.questions += 1);
        if self.closing == Closing::AtQuestion(self.all.questions) {
            self.close();
        }
        self.is_open
    }

    fn close(&mut self) {
        if self.closed_at.is_none() {
            self.closed_at = Some(Instant::now());
            self.closed_within = self.is_within;
        }
        self.is_open = false;
    }

    fn count(&mut self, count: impl Fn(&mut Count)) {
        count(&mut self.all);
        if !self.is_open {
            count(&mut self.after);
        }
    }

    /// The number of these bytes that are taken by the next write.
    fn takes(&mut self, len: usize) -> usize {
        let drawn = if self.is_quick || self.rng.percent(50) { len } else { 1 + self.rng.index(len.min(6)) };
        match self.closing {
            Closing::AfterByte(last) if last > self.all.bytes => {
                drawn.min(usize::try_from(last - self.all.bytes).unwrap_or(usize::MAX))
            }
            Closing::Never | Closing::AtQuestion(_) | Closing::AfterByte(_) => drawn,
        }
    }

    /// Notes that bytes were taken, the last of these numbers of requests.
    fn took(&mut self, bytes: u64, requests: u64, is_within: bool) {
        self.count(|count| {
            count.bytes += bytes;
            count.requests += requests;
        });
        self.is_within = is_within;
        if matches!(self.closing, Closing::AfterByte(last) if self.all.bytes >= last) {
            self.close();
        }
    }
}

/// A stream to a PLC.
pub(crate) struct Recorded<S> {
    inner: S,
    wire: Wire,
    codec: Codec,
    /// The beginning of a request.
    taken: BytesMut,
    /// Nothing is taken before this has passed.
    pause: Option<Pin<Box<Sleep>>>,
    /// The pause before this write has passed.
    paused: bool,
}

impl<S: AsyncWrite + Unpin> AsyncWrite for Recorded<S> {
    fn poll_write(mut self: Pin<&mut Self>, cx: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        let this = &mut *self;
        if !std::mem::replace(&mut this.paused, true) {
            let mut state = this.wire.state();
            let pauses = !state.is_quick && state.rng.percent(25);
            this.pause = pauses.then(|| Box::pin(sleep(Duration::from_millis(state.rng.below(40)))));
        }
        if let Some(pause) = &mut this.pause {
            ready!(pause.as_mut().poll(cx));
            this.pause = None;
        }
        let len = this.wire.state().takes(bytes.len());
        let len = ready!(Pin::new(&mut this.inner).poll_write(cx, &bytes[..len]))?;
        this.paused = false;
        this.taken.extend_from_slice(&bytes[..len]);
        let mut requests = 0;
        while let Some(item) = this.codec.decode(&mut this.taken)? {
            requests += u64::from(item.frame().is_some());
        }
        this.wire.state().took(len as u64, requests, !this.taken.is_empty());
        Poll::Ready(Ok(len))
    }

    fn poll_flush(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.inner).poll_flush(cx)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.inner).poll_shutdown(cx)
    }
}

impl<S: AsyncRead + Unpin> AsyncRead for Recorded<S> {
    fn poll_read(mut self: Pin<&mut Self>, cx: &mut Context<'_>, into: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.inner).poll_read(cx, into)
    }
}
