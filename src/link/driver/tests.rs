//! The driver on a stream of the crate's own, which wakes its reader whenever it has data.

use std::collections::VecDeque;
use std::io;
use std::pin::Pin;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::task::{Context, Poll, Waker};
use std::time::Duration;

use bytes::BytesMut;
use futures::future::{FutureExt, join_all};
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::time::Instant;
use tokio_util::codec::{Decoder, Encoder};

use crate::link::builder::LinkBuilder;
use crate::link::connector::Connector;
use crate::transport::BoxIo;
use crate::wire::{Codec, Frame, Framing, Side};
use crate::{CallOptions, Error, Link, register};

/// A PLC that answers at once. At its first broadcast it repeats its last reply, with the old
/// value.
#[derive(Default)]
struct Plc {
    received: VecDeque<u8>,
    reader: Option<Waker>,
    value: u16,
    answered: Vec<u8>,
    broadcasts: u32,
    /// `true` if it takes no bytes.
    stuck: bool,
    /// Number of requests that came while a repeated reply was unread.
    unread: u32,
}

#[derive(Clone, Default)]
struct Line(Arc<Mutex<Plc>>);

impl Line {
    fn plc(&self) -> MutexGuard<'_, Plc> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn link(&self) -> Link {
        let line = self.clone();
        let open = Box::new(move || futures::future::ready(Ok(Box::new(line.clone()) as BoxIo)).boxed());
        LinkBuilder::with_connector(
            Connector::Custom { open, wakes_reader: true },
            Framing::Ascii,
            "a line that wakes its reader",
        )
        .build()
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

    fn send(&mut self, bytes: &[u8]) {
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
        into.put_slice(&plc.received.drain(..).collect::<Vec<u8>>());
        Poll::Ready(Ok(()))
    }
}

impl AsyncWrite for Line {
    fn poll_write(self: Pin<&mut Self>, _: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        if self.plc().stuck {
            return Poll::Pending;
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

#[tokio::test(start_paused = true)]
async fn a_reply_repeated_during_broadcasts_is_not_the_next_reads() {
    let line = Line::default();
    line.plc().value = 1;
    let link = line.link();
    let station = link.station(1).expect("a station");
    assert_eq!(station.read_registers(register!("R0"), 1).await.expect("it answers"), [1]);
    // All of them wait for the first read, and are then sent in one go.
    let (all, first) = (link.broadcast(), station.read_registers(register!("R0"), 1));
    let casts = join_all((0..20).map(|_| all.write_registers(register!("R0"), &[2])));
    let (first, casts, second) = tokio::join!(first, casts, station.read_registers(register!("R0"), 1));
    assert_eq!(first.expect("it answers"), [1]);
    assert!(casts.iter().all(Result::is_ok) && line.plc().broadcasts == 20);
    assert_eq!(second.expect("it answers"), [2]);
    assert_eq!(line.plc().unread, 0, "received data were read before the next request");
    assert_eq!(station.stats().duplicates, 1);
}

#[tokio::test(start_paused = true)]
async fn an_unwritable_request_costs_the_connection_at_its_timeout() {
    let line = Line::default();
    let link = line.link();
    let timeout = Duration::from_millis(700);
    let options = CallOptions::new().with_retries(0).with_response_timeout(timeout);
    let station = link.station(1).expect("a station").with_options(options);
    assert_eq!(station.read_registers(register!("R0"), 1).await.expect("it answers"), [0]);
    line.plc().stuck = true;
    let began = Instant::now();
    let error = station.read_registers(register!("R0"), 1).await.expect_err("it does not get there");
    assert!(matches!(error, Error::Disconnected { sent: true, .. }), "{error:?}");
    assert!(error.to_string().ends_with(": the request was not written in time"), "{error}");
    assert!(std::error::Error::source(&error).is_none(), "the text has the cause already");
    let took = began.elapsed();
    assert!((timeout..timeout * 2).contains(&took), "{took:?}");
    line.plc().stuck = false;
    assert_eq!(station.read_registers(register!("R0"), 1).await.expect("over the next one"), [0]);
    assert_eq!((link.stats().connects, link.stats().disconnects), (2, 1));
}
