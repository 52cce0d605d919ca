//! A line to a PLC in memory, for tests of the driver and of the state that it shares.

use std::collections::VecDeque;
use std::io;
use std::pin::Pin;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::task::{Context, Poll, Waker};

use bytes::BytesMut;
use futures::future::FutureExt;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio_util::codec::{Decoder, Encoder};

use super::builder::LinkBuilder;
use super::connector::Connector;
use crate::transport::BoxIo;
use crate::wire::{Codec, Frame, Framing, Side};

/// A PLC that answers at once. At its first broadcast it repeats its last reply, with the old
/// value.
#[derive(Default)]
pub(super) struct Plc {
    /// Bytes that the link has not read.
    pub(super) received: VecDeque<u8>,
    reader: Option<Waker>,
    /// Number of reads that brought bytes.
    pub(super) reads: usize,
    pub(super) value: u16,
    pub(super) answered: Vec<u8>,
    pub(super) broadcasts: u32,
    /// `true` if it takes no bytes.
    pub(super) stuck: bool,
    /// `true` if it takes requests and answers none.
    pub(super) silent: bool,
    /// Number of requests that came while a repeated reply was unread.
    pub(super) unread: u32,
    /// Called once, while a request is being written.
    pub(super) during_write: Option<Box<dyn FnOnce() + Send>>,
}

#[derive(Clone, Default)]
pub(super) struct Line(Arc<Mutex<Plc>>);

impl Line {
    pub(super) fn plc(&self) -> MutexGuard<'_, Plc> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Settings of a link over this line, for any number of connections.
    pub(super) fn builder(&self, wakes_reader: bool) -> LinkBuilder {
        let line = self.clone();
        let open = Box::new(move || futures::future::ready(Ok(Box::new(line.clone()) as BoxIo)).boxed());
        LinkBuilder::with_connector(Connector::Custom { open, wakes_reader }, Framing::Ascii, "a line in memory")
    }
}

impl Plc {
    fn handle(&mut self, request: &Frame) {
        self.unread += u32::from(!self.received.is_empty());
        if request.station == 0 {
            self.broadcasts += 1;
            self.value = 2;
            if self.broadcasts == 1 {
                let again = self.answered.clone();
                self.send(&again);
            }
            return;
        }
        if self.silent {
            return;
        }
        let data = match request.command {
            0x46 | 0x48 => format!("0{:04X}", self.value).into(),
            _ => request.data.clone(),
        };
        let mut answer = BytesMut::new();
        let frame = Frame { station: request.station, command: request.command, data };
        Codec::new(Framing::Ascii, Side::Plc).encode(&frame, &mut answer).expect("the codec does not fail");
        self.answered = answer.to_vec();
        self.send(&answer);
    }

    /// Sends bytes, and wakes the reader.
    pub(super) fn send(&mut self, bytes: &[u8]) {
        self.received.extend(bytes);
        if let Some(reader) = self.reader.take() {
            reader.wake();
        }
    }
}

impl AsyncRead for Line {
    fn poll_read(self: Pin<&mut Self>, cx: &mut Context<'_>, into: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        let mut plc = self.plc();
        if plc.received.is_empty() {
            plc.reader = Some(cx.waker().clone());
            return Poll::Pending;
        }
        plc.reads += 1;
        let len = plc.received.len().min(into.remaining());
        into.put_slice(&plc.received.drain(..len).collect::<Vec<u8>>());
        Poll::Ready(Ok(()))
    }
}

impl AsyncWrite for Line {
    fn poll_write(self: Pin<&mut Self>, _: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        if self.plc().stuck {
            return Poll::Pending;
        }
        let during_write = self.plc().during_write.take();
        if let Some(call) = during_write {
            call();
        }
        let request = Codec::new(Framing::Ascii, Side::Plc).decode(&mut BytesMut::from(bytes));
        self.plc().handle(&request.expect("no I/O").and_then(|item| item.frame()).expect("a request is written whole"));
        Poll::Ready(Ok(bytes.len()))
    }

    fn poll_flush(self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<io::Result<()>> {
        Poll::Ready(Ok(()))
    }

    fn poll_shutdown(self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<io::Result<()>> {
        Poll::Ready(Ok(()))
    }
}
