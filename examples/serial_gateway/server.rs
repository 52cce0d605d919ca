//! The clients: who comes in, how long each may stay, and how their bytes become requests.
//!
//! A client's requests are answered one after the other, in the order in which they came. While one is under way nothing
//! more is read from that client, so one that sends faster than the bus can answer fills the buffers of its own connection
//! and no other. What the gateway holds for a client is a frame each way.
//!
//! A client is sent away when
//! - it is one too many ([`Limits::clients`]);
//! - it has sent no request for too long, or does not take its replies ([`Limits::idle`]);
//! - it sends nothing but noise ([`MAX_NOISE`]).

use std::future::Future;
use std::io;
use std::pin::pin;
use std::sync::Arc;
use std::time::Duration;

use bytes::{Buf, BytesMut};
use fatek::wire::{Codec, Frame, Framing, MAX_FRAME_LEN, Received, Side, ascii, binary};
use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt};
use tokio::net::TcpListener;
use tokio::sync::watch;
use tokio::task::JoinSet;
use tokio::time::{Instant, sleep, timeout, timeout_at};
use tokio_util::codec::Decoder;

use crate::proxy::Proxy;

/// What clients may do.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Limits {
    /// How many there may be at a time.
    pub(crate) clients: usize,
    /// How long one may go without a request, and how long it may take to accept a reply.
    pub(crate) idle: Duration,
}

/// How many bytes that are no request may come before the next one.
pub(crate) const MAX_NOISE: usize = 16 * 1024;

/// How long a frame may pause in its middle.
const PAUSE: Duration = Duration::from_secs(1);

/// How long clients have to take their last replies.
const FAREWELL: Duration = Duration::from_secs(1);

/// Serves everybody who connects, until `stop`; then ends what is under way, closes the link, and returns.
pub(crate) async fn serve(listener: TcpListener, proxy: Arc<Proxy>, limits: Limits, stop: impl Future<Output = ()>) {
    let (stopping, stopped) = watch::channel(());
    let mut clients = JoinSet::new();
    let mut stop = pin!(stop);
    loop {
        tokio::select! {
            () = &mut stop => break,
            Some(_) = clients.join_next() => {}
            accepted = listener.accept() => match accepted {
                Ok((_, peer)) if clients.len() >= limits.clients => tracing::debug!(%peer, "one too many"),
                Ok((stream, peer)) => {
                    // A reply is one small segment, and the client waits for it.
                    let _ = stream.set_nodelay(true);
                    let (proxy, stopped) = (Arc::clone(&proxy), stopped.clone());
                    clients.spawn(async move {
                        tracing::info!(%peer, "connected");
                        match serve_client(stream, &proxy, limits, stopped).await {
                            Ok(parting) => tracing::info!(%peer, ?parting, "gone"),
                            Err(error) => tracing::info!(%peer, %error, "gone"),
                        }
                    });
                }
                Err(error) => {
                    // Such as too many open files: it takes a moment to pass.
                    tracing::warn!(%error, "cannot accept");
                    sleep(Duration::from_millis(100)).await;
                }
            }
        }
    }
    drop(listener);
    drop(stopping);
    // What is on the wire is still answered; what waits for its turn is not.
    proxy.link().close().await;
    let _ = timeout(FAREWELL, async { while clients.join_next().await.is_some() {} }).await;
    clients.shutdown().await;
}

/// Why a client is served no more.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Parting {
    /// It has closed the connection.
    HungUp,
    /// It has sent no request for too long.
    Idle,
    /// It does not take its replies.
    NotReading,
    /// It sends something else.
    Noise,
    /// The gateway stops.
    Stopped,
}

/// Serves one client, until it goes, is sent away, or the sender of `stopped` is gone.
pub(crate) async fn serve_client(
    mut stream: impl AsyncRead + AsyncWrite + Unpin,
    proxy: &Proxy,
    limits: Limits,
    mut stopped: watch::Receiver<()>,
) -> io::Result<Parting> {
    let mut requests = Requests::new();
    let mut reply = BytesMut::with_capacity(MAX_FRAME_LEN);
    let mut deadline = Instant::now() + limits.idle;
    loop {
        while let Some((frame, framing)) = requests.next()? {
            proxy.answer(&frame, framing, &mut reply).await;
            match timeout(limits.idle, stream.write_all(&reply)).await {
                Ok(written) => written?,
                Err(_) => return Ok(Parting::NotReading),
            }
            reply.clear();
            deadline = Instant::now() + limits.idle;
        }
        if requests.noise > MAX_NOISE {
            return Ok(Parting::Noise);
        }
        // Asked for by name: as long as there are bytes, a timeout does not strike.
        if Instant::now() >= deadline {
            return Ok(Parting::Idle);
        }
        let until = if requests.received.is_empty() { deadline } else { deadline.min(Instant::now() + PAUSE) };
        tokio::select! {
            _ = stopped.changed() => return Ok(Parting::Stopped),
            read = timeout_at(until, stream.read_buf(&mut requests.received)) => {
                requests.silence = read.is_err();
                if let Ok(len) = read
                    && len? == 0
                {
                    return Ok(Parting::HungUp);
                }
            }
        }
    }
}

/// From bytes to requests.
struct Requests {
    received: BytesMut,
    /// That of the framing that the client speaks, which its first byte has told.
    codec: Option<Codec>,
    /// The line has fallen silent: what has begun and not ended never will.
    silence: bool,
    /// How many bytes were no request, since the last one.
    noise: usize,
}

impl Requests {
    fn new() -> Self {
        Self { received: BytesMut::with_capacity(MAX_FRAME_LEN), codec: None, silence: false, noise: 0 }
    }

    /// The next request; `None`: more bytes are needed.
    ///
    /// A frame with a bad checksum is noise, and no PLC answers noise.
    fn next(&mut self) -> io::Result<Option<(Frame, Framing)>> {
        let codec = match &mut self.codec {
            Some(codec) => codec,
            None => {
                let begin = self.received.iter().position(|&byte| framing_that_begins_with(byte).is_some());
                let noise = begin.unwrap_or(self.received.len());
                self.received.advance(noise);
                self.noise += noise;
                let framing = self.received.first().and_then(|&byte| framing_that_begins_with(byte));
                let Some(framing) = framing else { return Ok(None) };
                self.codec.insert(Codec::new(framing, Side::Plc))
            }
        };
        loop {
            let received = &mut self.received;
            match if self.silence { codec.decode_eof(received)? } else { codec.decode(received)? } {
                Some(Received::Frame(frame)) => {
                    self.noise = 0;
                    return Ok(Some((frame, codec.framing())));
                }
                Some(Received::Discarded { bytes, .. }) => self.noise += bytes.len(),
                _ => return Ok(None),
            }
        }
    }
}

fn framing_that_begins_with(byte: u8) -> Option<Framing> {
    match byte {
        ascii::STX => Some(Framing::Ascii),
        binary::QUERY => Some(Framing::Binary),
        _ => None,
    }
}
