//! Simulated PLCs, each at its own endpoint, that can be stopped and restarted; counts their
//! connections.
//!
//! Connections answer without tasks, so all tasks and heap belong to the links.
#![allow(clippy::wildcard_enum_match_arm, reason = "tests name the variants they expect")]
#![allow(dead_code, reason = "each test program uses a part of it")]

use std::io;
use std::pin::Pin;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::task::{Context, Poll, Waker};
use std::time::Duration;

use bytes::{Buf, BytesMut};
use fatek::pool::PoolBuilder;
use fatek::sim::{Bus, Plc};
use fatek::wire::{Codec, Framing, Side};
use fatek::{Endpoint, Pool, register};
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::time::{Instant, sleep};
use tokio_util::codec::Decoder;

/// How a PLC behaves. A new mode keeps the connections, unless the PLC is [killed](Plant::kill).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Mode {
    Answers,
    /// Answers, with 512 bytes of noise before each reply.
    Noisy,
    /// Answers as soon as the mode changes.
    Delayed,
    /// Accepts connections and never answers.
    Silent,
    /// Refuses connections.
    Refuses,
    /// Neither accepts nor refuses connections, like a PLC without power.
    PoweredOff,
}

#[derive(Clone)]
pub(crate) struct Plant {
    framing: Framing,
    ports: Arc<[Mutex<Port>]>,
    counts: Arc<Counts>,
    /// Time until a connection is opened or refused.
    connect_time: Duration,
}

/// Server side of one PLC.
struct Port {
    bus: Bus,
    mode: Mode,
    /// Number of kills. Connections opened before the last one are lost.
    kills: u32,
    waiting: Option<Waker>,
}

#[derive(Default)]
struct Counts {
    attempts: Mutex<Vec<Instant>>,
    opening: AtomicUsize,
    most_opening: AtomicUsize,
    open: AtomicUsize,
}

impl Plant {
    /// Creates `plcs` PLCs, each with its number in R0.
    pub(crate) fn new(plcs: usize, framing: Framing, connect_time: Duration) -> Self {
        let port = |n| {
            let plc = Plc::new();
            plc.write(register!("R0"), u16::try_from(n).unwrap()).unwrap();
            let bus = Bus::new().with_station(1, plc).unwrap();
            Mutex::new(Port { bus, mode: Mode::Answers, kills: 0, waiting: None })
        };
        Self { framing, ports: (0..plcs).map(port).collect(), counts: Arc::default(), connect_time }
    }

    pub(crate) fn pool(&self) -> PoolBuilder {
        let plant = self.clone();
        Pool::builder().seed(1).connector(move |endpoint| plant.clone().connect(endpoint))
    }

    pub(crate) fn endpoint(&self, n: usize) -> Endpoint {
        // The TCP port is the number of the PLC.
        Endpoint::tcp("plant", u16::try_from(n).unwrap()).with_framing(self.framing)
    }

    pub(crate) fn set(&self, n: usize, mode: Mode) {
        let mut port = self.ports[n].lock().unwrap();
        port.mode = mode;
        port.wake();
    }

    /// Closes all connections of a PLC and sets its mode.
    pub(crate) fn kill(&self, n: usize, mode: Mode) {
        let mut port = self.ports[n].lock().unwrap();
        port.mode = mode;
        port.kills += 1;
        port.wake();
    }

    /// Start time of each connection attempt.
    pub(crate) fn attempts(&self) -> Vec<Instant> {
        self.counts.attempts.lock().unwrap().clone()
    }

    pub(crate) fn most_opening(&self) -> usize {
        self.counts.most_opening.load(Ordering::SeqCst)
    }

    /// Connections that clients hold, including lost ones that are not dropped yet.
    pub(crate) fn open(&self) -> usize {
        self.counts.open.load(Ordering::SeqCst)
    }

    async fn connect(self, endpoint: Endpoint) -> io::Result<Connection> {
        let n = match endpoint.transport() {
            fatek::endpoint::Transport::Tcp { port, .. } => usize::from(*port),
            _ => panic!("{endpoint} is not an endpoint of this plant"),
        };
        self.counts.attempts.lock().unwrap().push(Instant::now());
        let opening = Opening::new(&self.counts);
        sleep(self.connect_time).await;
        let (mode, kills) = {
            let port = self.ports[n].lock().unwrap();
            (port.mode, port.kills)
        };
        match mode {
            Mode::Refuses => return Err(io::ErrorKind::ConnectionRefused.into()),
            Mode::PoweredOff => std::future::pending().await,
            _ => drop(opening),
        }
        self.counts.open.fetch_add(1, Ordering::SeqCst);
        Ok(Connection { plant: self, n, kills, replies: BytesMut::new() })
    }
}

impl Port {
    fn wake(&mut self) {
        if let Some(waiting) = self.waiting.take() {
            waiting.wake();
        }
    }
}

/// Counts a connection attempt in progress.
struct Opening {
    counts: Arc<Counts>,
}

impl Opening {
    fn new(counts: &Arc<Counts>) -> Self {
        let opening = counts.opening.fetch_add(1, Ordering::SeqCst) + 1;
        counts.most_opening.fetch_max(opening, Ordering::SeqCst);
        Self { counts: counts.clone() }
    }
}

impl Drop for Opening {
    fn drop(&mut self) {
        self.counts.opening.fetch_sub(1, Ordering::SeqCst);
    }
}

/// Client side of a connection to a PLC.
pub(crate) struct Connection {
    plant: Plant,
    n: usize,
    /// Number of kills of the PLC when the connection was opened.
    kills: u32,
    replies: BytesMut,
}

impl AsyncRead for Connection {
    fn poll_read(self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        let this = self.get_mut();
        let mut port = this.plant.ports[this.n].lock().unwrap();
        if port.kills != this.kills {
            return Poll::Ready(Ok(()));
        }
        if this.replies.is_empty() || port.mode == Mode::Delayed {
            port.waiting = Some(cx.waker().clone());
            return Poll::Pending;
        }
        let len = this.replies.len().min(buf.remaining());
        buf.put_slice(&this.replies[..len]);
        this.replies.advance(len);
        if this.replies.is_empty() {
            this.replies = BytesMut::new();
        }
        Poll::Ready(Ok(()))
    }
}

impl AsyncWrite for Connection {
    fn poll_write(self: Pin<&mut Self>, _: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        let this = self.get_mut();
        let port = this.plant.ports[this.n].lock().unwrap();
        if port.kills != this.kills {
            return Poll::Ready(Err(io::ErrorKind::BrokenPipe.into()));
        }
        if port.mode == Mode::Noisy {
            this.replies.extend_from_slice(&[b'?'; 512]);
        }
        if port.mode != Mode::Silent {
            // A write holds whole requests, and the reader is polled after each write.
            let mut codec = Codec::new(this.plant.framing, Side::Plc);
            let mut request = BytesMut::from(bytes);
            while let Some(received) = codec.decode(&mut request)? {
                port.bus.answer(&received, this.plant.framing, &mut this.replies);
            }
        }
        Poll::Ready(Ok(bytes.len()))
    }

    fn poll_flush(self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<io::Result<()>> {
        Poll::Ready(Ok(()))
    }

    fn poll_shutdown(self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<io::Result<()>> {
        Poll::Ready(Ok(()))
    }
}

impl Drop for Connection {
    fn drop(&mut self) {
        // The reader is gone.
        self.plant.ports[self.n].lock().unwrap().waiting = None;
        self.plant.counts.open.fetch_sub(1, Ordering::SeqCst);
    }
}
