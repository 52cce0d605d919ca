//! Connections of a server: their idle time, and their orderly end.

use std::io;
use std::pin::Pin;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::task::{Context, Poll, ready};
use std::time::Duration;

use futures::task::AtomicWaker;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::time::Instant;

/// Handle to a [`Connection`], for the server.
#[derive(Clone, Debug)]
pub(super) struct ConnectionHandle(Arc<State>);

#[derive(Debug)]
struct State {
    /// Time of the last byte received or sent.
    active_at: Mutex<Instant>,
    closing: AtomicBool,
    reader: AtomicWaker,
}

impl ConnectionHandle {
    pub(super) fn new() -> Self {
        let active_at = Mutex::new(Instant::now());
        Self(Arc::new(State { active_at, closing: AtomicBool::new(false), reader: AtomicWaker::new() }))
    }

    /// Time since the last byte in either direction.
    pub(super) fn idle_time(&self) -> Duration {
        self.0.active_at.lock().unwrap_or_else(PoisonError::into_inner).elapsed()
    }

    /// Ends the input after the bytes that have arrived. The requests in them are still answered.
    pub(super) fn close(&self) {
        self.0.closing.store(true, Ordering::Release);
        self.0.reader.wake();
    }

    pub(super) fn is_closing(&self) -> bool {
        self.0.closing.load(Ordering::Acquire)
    }

    fn note_activity(&self) {
        *self.0.active_at.lock().unwrap_or_else(PoisonError::into_inner) = Instant::now();
    }
}

/// A stream whose activity is recorded, and whose input its [handle](ConnectionHandle) can end.
#[derive(Debug)]
pub(super) struct Connection<S> {
    stream: S,
    handle: ConnectionHandle,
}

impl<S> Connection<S> {
    pub(super) fn new(stream: S, handle: ConnectionHandle) -> Self {
        Self { stream, handle }
    }
}

impl<S: AsyncRead + Unpin> AsyncRead for Connection<S> {
    fn poll_read(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        // Registered before the flag is read, so that no close is missed.
        self.handle.0.reader.register(cx.waker());
        match Pin::new(&mut self.stream).poll_read(cx, buf) {
            Poll::Pending if self.handle.is_closing() => Poll::Ready(Ok(())),
            Poll::Pending => Poll::Pending,
            Poll::Ready(result) => {
                self.handle.note_activity();
                Poll::Ready(result)
            }
        }
    }
}

impl<S: AsyncWrite + Unpin> AsyncWrite for Connection<S> {
    fn poll_write(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &[u8]) -> Poll<io::Result<usize>> {
        let result = ready!(Pin::new(&mut self.stream).poll_write(cx, buf));
        self.handle.note_activity();
        Poll::Ready(result)
    }

    fn poll_flush(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_flush(cx)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(cx)
    }
}
