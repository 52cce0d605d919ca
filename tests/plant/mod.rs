//! PLCs in memory, each at an endpoint of its own, which can be killed and started again; and a count of what is connected
//! to them. Their connections answer by themselves, so the tasks and the heap are those of the links alone.
#![allow(clippy::wildcard_enum_match_arm, reason = "tests name the variants they expect")]
#![allow(dead_code, reason = "each test program uses its own part of it")]

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

/// What a PLC does. When it changes, so does nothing else: connections stay, unless it [dies](Plant::kill).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Mode {
    Answers,
    /// Answers, and sends half a kilobyte of noise before each reply.
    Babbles,
    /// Answers as soon as it is in another mode.
    Hesitates,
    /// Accepts connections and says nothing.
    IsMute,
    /// Refuses connections.
    Refuses,
    /// Neither accepts connections nor refuses them, as what is switched off.
    IsOff,
}

#[derive(Clone)]
pub(crate) struct Plant {
    framing: Framing,
    ports: Arc<[Mutex<Port>]>,
    counts: Arc<Counts>,
    /// How long a connection takes to be opened, or to be refused.
    takes: Duration,
}

/// The end of a PLC that others connect to.
struct Port {
    bus: Bus,
    mode: Mode,
    /// How often it was killed. A connection to one of its earlier lives is lost.
    deaths: u32,
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
    /// So many PLCs, each with its number in R0.
    pub(crate) fn new(plcs: usize, framing: Framing, takes: Duration) -> Self {
        let port = |n| {
            let plc = Plc::new();
            plc.write(register!("R0"), u16::try_from(n).unwrap()).unwrap();
            let bus = Bus::new().with_station(1, plc).unwrap();
            Mutex::new(Port { bus, mode: Mode::Answers, deaths: 0, waiting: None })
        };
        Self { framing, ports: (0..plcs).map(port).collect(), counts: Arc::default(), takes }
    }

    pub(crate) fn pool(&self) -> PoolBuilder {
        let plant = self.clone();
        Pool::builder().seed(1).connector(move |endpoint| plant.clone().connect(endpoint))
    }

    pub(crate) fn endpoint(&self, n: usize) -> Endpoint {
        // The port tells which PLC it is.
        Endpoint::tcp("plant", u16::try_from(n).unwrap()).with_framing(self.framing)
    }

    pub(crate) fn set(&self, n: usize, mode: Mode) {
        let mut port = self.ports[n].lock().unwrap();
        port.mode = mode;
        port.wake();
    }

    /// Its connections are lost, and from now on it is in this mode.
    pub(crate) fn kill(&self, n: usize, mode: Mode) {
        let mut port = self.ports[n].lock().unwrap();
        port.mode = mode;
        port.deaths += 1;
        port.wake();
    }

    /// When each attempt to connect began.
    pub(crate) fn attempts(&self) -> Vec<Instant> {
        self.counts.attempts.lock().unwrap().clone()
    }

    pub(crate) fn most_opening(&self) -> usize {
        self.counts.most_opening.load(Ordering::SeqCst)
    }

    /// How many connections the clients hold, the lost ones among them that they have not dropped.
    pub(crate) fn open(&self) -> usize {
        self.counts.open.load(Ordering::SeqCst)
    }

    async fn connect(self, endpoint: Endpoint) -> io::Result<Wire> {
        let n = match endpoint.transport() {
            fatek::endpoint::Transport::Tcp { port, .. } => usize::from(*port),
            _ => panic!("{endpoint} is not of this plant"),
        };
        self.counts.attempts.lock().unwrap().push(Instant::now());
        let opening = Opening::new(&self.counts);
        sleep(self.takes).await;
        let (mode, deaths) = {
            let port = self.ports[n].lock().unwrap();
            (port.mode, port.deaths)
        };
        match mode {
            Mode::Refuses => return Err(io::ErrorKind::ConnectionRefused.into()),
            Mode::IsOff => std::future::pending().await,
            _ => drop(opening),
        }
        self.counts.open.fetch_add(1, Ordering::SeqCst);
        Ok(Wire { plant: self, n, deaths, replies: BytesMut::new() })
    }
}

impl Port {
    fn wake(&mut self) {
        if let Some(waiting) = self.waiting.take() {
            waiting.wake();
        }
    }
}

/// A connection that is being opened.
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

/// A connection to a PLC.
pub(crate) struct Wire {
    plant: Plant,
    n: usize,
    /// How often the PLC had been killed when it was opened.
    deaths: u32,
    replies: BytesMut,
}

impl AsyncRead for Wire {
    fn poll_read(self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        let this = self.get_mut();
        let mut port = this.plant.ports[this.n].lock().unwrap();
        if port.deaths != this.deaths {
            return Poll::Ready(Ok(()));
        }
        if this.replies.is_empty() || port.mode == Mode::Hesitates {
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

impl AsyncWrite for Wire {
    fn poll_write(self: Pin<&mut Self>, _: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        let this = self.get_mut();
        let port = this.plant.ports[this.n].lock().unwrap();
        if port.deaths != this.deaths {
            return Poll::Ready(Err(io::ErrorKind::BrokenPipe.into()));
        }
        if port.mode == Mode::Babbles {
            this.replies.extend_from_slice(&[b'?'; 512]);
        }
        if port.mode != Mode::IsMute {
            // Requests are written whole, and whoever reads is polled after it has written.
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

impl Drop for Wire {
    fn drop(&mut self) {
        // Nobody waits for it any more.
        self.plant.ports[self.n].lock().unwrap().waiting = None;
        self.plant.counts.open.fetch_sub(1, Ordering::SeqCst);
    }
}
