//! Serves recorded replies over TCP, UDP or a serial port.

use std::collections::BTreeSet;
use std::io;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use bytes::{Bytes, BytesMut};
use fatek::command::Request;
use fatek::wire::{Codec, Frame, Framing, Received, Side};
use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt};
use tokio::net::{TcpListener, UdpSocket};
use tokio::sync::Semaphore;
use tokio::task::JoinSet;
use tokio::time;
use tokio_util::codec::{Decoder, Encoder};

use super::answers::{Answers, RecordedReply, ServedReply};
use crate::args::TimingArg;
use crate::failure::Failure;
use crate::listen::{Listener, MAX_DATAGRAM_LEN, accept, receive};
use crate::output::complain;

/// Connections at a time. Further ones wait.
const MAX_CONNECTIONS: usize = 64;

/// Different requests without a recorded reply that are reported.
const MAX_REPORTED: usize = 1000;

/// Longest pause within a frame.
const FRAME_TIMEOUT: Duration = Duration::from_millis(100);

/// The replies and their use, for all connections.
#[derive(Clone, Debug)]
pub(super) struct Service {
    shared: Arc<Mutex<Shared>>,
    framing: Framing,
    timing: TimingArg,
}

#[derive(Debug)]
struct Shared {
    answers: Answers,
    answered: u64,
    unknown: u64,
    reported: BTreeSet<String>,
}

impl Service {
    pub(super) fn new(answers: Answers, framing: Framing, timing: TimingArg) -> Self {
        let shared = Shared { answers, answered: 0, unknown: 0, reported: BTreeSet::new() };
        Self { shared: Arc::new(Mutex::new(shared)), framing, timing }
    }

    pub(super) fn summary(&self) -> String {
        let shared = self.shared();
        format!("{} requests answered, {} without a recorded reply", shared.answered, shared.unknown)
    }

    /// Serves until the listener fails.
    pub(super) async fn serve(&self, listener: Listener) -> Failure {
        match listener {
            Listener::Tcp(listener) => self.serve_connections(&listener).await,
            Listener::Udp(socket) => self.serve_datagrams(&socket).await,
            Listener::Serial(port, _) => {
                let error = self.serve_stream(port).await.err();
                let error = error.unwrap_or_else(|| io::ErrorKind::UnexpectedEof.into());
                Failure::Listen { url: "the serial port".to_owned(), error }
            }
        }
    }

    async fn serve_connections(&self, listener: &TcpListener) -> Failure {
        let places = Arc::new(Semaphore::new(MAX_CONNECTIONS));
        let mut serving = JoinSet::new();
        loop {
            // The semaphore is never closed.
            let permit = places.clone().acquire_owned().await;
            let (stream, client) = accept(listener).await;
            while serving.try_join_next().is_some() {}
            let service = self.clone();
            serving.spawn(async move {
                let _permit = permit;
                let ended = service.serve_stream(stream).await;
                tracing::debug!(%client, ?ended, "the connection has ended");
            });
        }
    }

    async fn serve_stream(&self, mut stream: impl AsyncRead + AsyncWrite + Unpin) -> io::Result<()> {
        let mut codec = Codec::new(self.framing, Side::Plc);
        let mut received = BytesMut::new();
        loop {
            let has_begun = !received.is_empty();
            let read = stream.read_buf(&mut received);
            let len = if !has_begun {
                Some(read.await?)
            } else {
                time::timeout(FRAME_TIMEOUT, read).await.ok().transpose()?
            };
            if len == Some(0) {
                return Ok(());
            }
            loop {
                // The rest of an incomplete frame does not come after a pause.
                let item =
                    if len.is_none() { codec.decode_eof(&mut received)? } else { codec.decode(&mut received)? };
                let Some(item) = item else { break };
                for reply in self.replies(item).await {
                    stream.write_all(&reply).await?;
                }
            }
        }
    }

    async fn serve_datagrams(&self, socket: &UdpSocket) -> Failure {
        let mut buffer = vec![0; MAX_DATAGRAM_LEN];
        loop {
            let (len, client) = receive(socket, &mut buffer).await;
            let mut codec = Codec::new(self.framing, Side::Plc);
            let mut datagram = BytesMut::from(buffer.get(..len).unwrap_or_default());
            while let Ok(Some(item)) = codec.decode_eof(&mut datagram) {
                for reply in self.replies(item).await {
                    // A reply that cannot be sent is one that the network loses.
                    let _ = socket.send_to(&reply, client).await;
                }
            }
        }
    }

    /// The replies to an item, at their time. No PLC answers a bad frame.
    async fn replies(&self, item: Received) -> Vec<Bytes> {
        let Received::Frame(request) = item else { return Vec::new() };
        let reply = self.shared().answers.reply(&request);
        let RecordedReply { round_trip, bytes } = match reply {
            ServedReply::Recorded(recorded) => recorded,
            ServedReply::Echo => RecordedReply { round_trip: Duration::ZERO, bytes: vec![self.echo(&request)] },
            ServedReply::Unknown => {
                self.report(&request);
                return Vec::new();
            }
        };
        self.shared().answered += 1;
        if self.timing == TimingArg::Recorded {
            time::sleep(round_trip).await;
        }
        bytes
    }

    fn echo(&self, request: &Frame) -> Bytes {
        let mut bytes = BytesMut::new();
        let encoded = Codec::new(self.framing, Side::Plc).encode(request, &mut bytes);
        tracing::trace!(?encoded, "echo");
        bytes.freeze()
    }

    /// Reports each request without a recorded reply once.
    fn report(&self, request: &Frame) {
        let text = Request::decode(request, self.framing);
        let text = text.map_or_else(|_| request.to_string(), |text| format!("station {}: {text}", request.station));
        let mut shared = self.shared();
        shared.unknown += 1;
        if shared.reported.len() < MAX_REPORTED && shared.reported.insert(text.clone()) {
            drop(shared);
            complain(format_args!("no recorded reply: {text}"));
        }
    }

    fn shared(&self) -> MutexGuard<'_, Shared> {
        self.shared.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
