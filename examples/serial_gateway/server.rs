//! Clients: their connections and limits, and the decoding of their requests.
//!
//! The requests of a client are handled one at a time, in order of arrival. During a request at
//! most one frame more is read from that client, so its own connection has the backpressure. The
//! gateway buffers one frame per client and direction.
//!
//! A client that closes its connection is noticed during its request. A request that still waits
//! for the bus is then not sent: no client would take the reply.
//!
//! A new client above the limit ([`Limits::clients`]) takes the place of the client that is idle
//! longest, if that has been idle for [`Limits::make_room_after`]. Otherwise it is disconnected.
//!
//! A client is disconnected
//! - when it makes room for a new one;
//! - after no request, or no read of a reply, for the idle timeout ([`Limits::idle`]);
//! - after too much noise ([`MAX_NOISE`]).

use std::collections::HashMap;
use std::future::Future;
use std::io;
use std::pin::pin;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use bytes::{Buf, BytesMut};
use fatek::wire::{Codec, Frame, Framing, MAX_FRAME_LEN, Received, Side, ascii, binary};
use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt};
use tokio::net::TcpListener;
use tokio::sync::watch;
use tokio::task::{AbortHandle, JoinSet};
use tokio::time::{Instant, sleep, timeout, timeout_at};
use tokio_util::codec::Decoder;

use crate::proxy::Proxy;

/// Limits of clients.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Limits {
    /// Limit of connected clients.
    pub(crate) clients: usize,
    /// Idle timeout: time without a request, and time to accept a reply.
    pub(crate) idle: Duration,
    /// Time without a request after which a client makes room for a new one.
    pub(crate) make_room_after: Duration,
}

/// Limit of noise bytes between two requests.
pub(crate) const MAX_NOISE: usize = 16 * 1024;

/// Longest gap within a frame.
const MAX_GAP: Duration = Duration::from_secs(1);

/// Time for clients to accept their last replies.
const SHUTDOWN_TIMEOUT: Duration = Duration::from_secs(1);

/// Serves clients until `stop`. Then completes the request on the wire, closes the link, and
/// returns.
pub(crate) async fn serve(listener: TcpListener, proxy: Arc<Proxy>, limits: Limits, stop: impl Future<Output = ()>) {
    let mut clients = JoinSet::new();
    let mut places = Places(HashMap::new());
    let mut stop = pin!(stop);
    let mut accepted_clients = 0_u64;
    loop {
        tokio::select! {
            () = &mut stop => break,
            Some(_) = clients.join_next() => places.0.retain(|_, place| !place.task.is_finished()),
            accepted = listener.accept() => match accepted {
                Ok((_, peer)) if places.0.len() >= limits.clients && !places.make_room(limits.make_room_after) => {
                    tracing::debug!(%peer, "client limit reached");
                }
                Ok((stream, peer)) => {
                    // A reply is one small segment that must not be delayed.
                    let _ = stream.set_nodelay(true);
                    let (proxy, activity) = (Arc::clone(&proxy), Activity::default());
                    let (leave, stopped) = watch::channel(());
                    let shared = activity.clone();
                    let task = clients.spawn(async move {
                        tracing::info!(%peer, "connected");
                        match serve_client(stream, &proxy, limits, &activity, stopped).await {
                            Ok(reason) => tracing::info!(%peer, ?reason, "disconnected"),
                            Err(error) => tracing::info!(%peer, %error, "disconnected"),
                        }
                    });
                    accepted_clients += 1;
                    places.0.insert(accepted_clients, Place { leave, activity: shared, task });
                }
                Err(error) => {
                    // A temporary error, such as too many open files.
                    tracing::warn!(%error, "cannot accept");
                    sleep(Duration::from_millis(100)).await;
                }
            }
        }
    }
    drop(listener);
    drop(places);
    // The request on the wire is completed, queued ones fail.
    proxy.link().close().await;
    let _ = timeout(SHUTDOWN_TIMEOUT, async { while clients.join_next().await.is_some() {} }).await;
    clients.shutdown().await;
}

/// Connected clients by their numbers, in the order of arrival.
struct Places(HashMap<u64, Place>);

struct Place {
    /// A message makes the client leave for a new one; dropping it, since the gateway stops.
    leave: watch::Sender<()>,
    activity: Activity,
    task: AbortHandle,
}

impl Places {
    /// Disconnects the client that is idle longest, if that has been idle for this time.
    fn make_room(&mut self, after: Duration) -> bool {
        let idle = self.0.iter().filter_map(|(id, place)| Some((place.activity.idle_time()?, *id)));
        match idle.max_by_key(|(idle, _)| *idle) {
            Some((idle, id)) if idle >= after => self.0.remove(&id).is_some_and(|place| place.leave.send(()).is_ok()),
            Some(_) | None => false,
        }
    }
}

/// Activity of a client, shared with the task that accepts clients.
#[derive(Clone, Debug)]
pub(crate) struct Activity {
    /// End of its last request; `None` during a request.
    idle_since: Arc<Mutex<Option<Instant>>>,
}

impl Default for Activity {
    fn default() -> Self {
        Self { idle_since: Arc::new(Mutex::new(Some(Instant::now()))) }
    }
}

impl Activity {
    fn set(&self, idle_since: Option<Instant>) {
        *self.idle_since.lock().unwrap_or_else(PoisonError::into_inner) = idle_since;
    }

    /// Time since its last request; `None` during a request.
    fn idle_time(&self) -> Option<Duration> {
        self.idle_since.lock().unwrap_or_else(PoisonError::into_inner).map(|since| since.elapsed())
    }
}

/// Reason for the end of a connection.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum DisconnectReason {
    /// The client has closed the connection.
    ClosedByClient,
    /// No request within the idle timeout.
    Idle,
    /// Reply not accepted within the idle timeout.
    NotReading,
    /// Too many bytes that are not requests.
    Noise,
    /// Idle longest when a new client connected at the limit.
    MadeRoom,
    /// The gateway was stopped.
    Stopped,
}

/// Serves one client until it disconnects, breaks a limit, or `stopped` has a message or no sender.
pub(crate) async fn serve_client(
    mut stream: impl AsyncRead + AsyncWrite + Unpin,
    proxy: &Proxy,
    limits: Limits,
    activity: &Activity,
    mut stopped: watch::Receiver<()>,
) -> io::Result<DisconnectReason> {
    let mut requests = Requests::new();
    let mut reply = BytesMut::with_capacity(MAX_FRAME_LEN);
    let mut deadline = Instant::now() + limits.idle;
    loop {
        while let Some((frame, framing)) = requests.next()? {
            activity.set(None);
            tokio::select! {
                biased;
                () = proxy.answer(&frame, framing, &mut reply) => {}
                closed = closed(&mut stream, &mut requests.received) => {
                    return closed.map(|()| DisconnectReason::ClosedByClient);
                }
            }
            match timeout(limits.idle, stream.write_all(&reply)).await {
                Ok(written) => written?,
                Err(_) => return Ok(DisconnectReason::NotReading),
            }
            reply.clear();
            deadline = Instant::now() + limits.idle;
            activity.set(Some(Instant::now()));
        }
        if requests.noise > MAX_NOISE {
            return Ok(DisconnectReason::Noise);
        }
        // Checked here, because `timeout_at` does not expire while bytes are available.
        if Instant::now() >= deadline {
            return Ok(DisconnectReason::Idle);
        }
        let until = if requests.received.is_empty() { deadline } else { deadline.min(Instant::now() + MAX_GAP) };
        tokio::select! {
            made_room = stopped.changed() => {
                return Ok(made_room.map_or(DisconnectReason::Stopped, |()| DisconnectReason::MadeRoom));
            }
            read = timeout_at(until, stream.read_buf(&mut requests.received)) => {
                requests.silence = read.is_err();
                if let Ok(len) = read
                    && len? == 0
                {
                    return Ok(DisconnectReason::ClosedByClient);
                }
            }
        }
    }
}

/// Reads ahead, at most a frame, until the client closes the connection.
async fn closed(stream: &mut (impl AsyncRead + Unpin), received: &mut BytesMut) -> io::Result<()> {
    while received.len() < MAX_FRAME_LEN {
        if stream.read_buf(received).await? == 0 {
            return Ok(());
        }
    }
    std::future::pending().await
}

/// Decoder of requests.
struct Requests {
    received: BytesMut,
    /// Codec of the client's framing, set by its first byte.
    codec: Option<Codec>,
    /// `true` if the last read timed out: an incomplete frame is then discarded.
    silence: bool,
    /// Bytes outside requests since the last request.
    noise: usize,
}

impl Requests {
    fn new() -> Self {
        Self { received: BytesMut::with_capacity(MAX_FRAME_LEN), codec: None, silence: false, noise: 0 }
    }

    /// Returns the next request, or `None` if more bytes are needed.
    ///
    /// A frame with a bad checksum counts as noise: no PLC replies to it.
    fn next(&mut self) -> io::Result<Option<(Frame, Framing)>> {
        let codec = match &mut self.codec {
            Some(codec) => codec,
            None => {
                let begin = self.received.iter().position(|&byte| framing_by_first_byte(byte).is_some());
                let noise = begin.unwrap_or(self.received.len());
                self.received.advance(noise);
                self.noise += noise;
                let framing = self.received.first().and_then(|&byte| framing_by_first_byte(byte));
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

fn framing_by_first_byte(byte: u8) -> Option<Framing> {
    match byte {
        ascii::STX => Some(Framing::Ascii),
        binary::QUERY => Some(Framing::Binary),
        _ => None,
    }
}
