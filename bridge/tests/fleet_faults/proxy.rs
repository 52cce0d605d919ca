//! A proxy on the way of one process to NATS. It cuts the way, delays messages, and repeats them.
//!
//! It knows the process behind each session, since it sees the session made. Messages that it holds or delays are
//! delivered later, also when the process has ended meanwhile, as a network may do.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BinaryHeap};
use std::io;
use std::net::SocketAddr;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::tcp::{ReadHalf, WriteHalf};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{broadcast, watch};
use tokio::task::{JoinHandle, JoinSet};
use tokio::time::{Instant, sleep_until};

use super::frames::{Frame, Frames, Kind};

/// The subjects of the store.
const PREFIX: &str = "$KV.leases.";

/// A moment that matters: a message of a member is on its way to the store.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Moment {
    pub(crate) process: usize,
    pub(crate) act: Act,
}

/// The act of a member.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Act {
    Renew,
    Take,
    Release,
    Fence,
}

/// The sessions that were made, with the number of their process.
pub(crate) type Sessions = Arc<Mutex<BTreeMap<String, usize>>>;

/// One direction of the way.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Direction {
    /// Nothing is delivered.
    pub(crate) is_held: bool,
    /// All messages are late by this time.
    pub(crate) delay: Duration,
    /// Entries of a watch are late by this time more: another server of a cluster sends them.
    pub(crate) entry_delay: Duration,
}

/// The state of the way.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct Way {
    /// To the server.
    pub(crate) up: Direction,
    /// From the server.
    pub(crate) down: Direction,
    /// New connections are closed at once.
    pub(crate) is_refusing: bool,
    /// When it changes, all connections are reset.
    pub(crate) resets: u64,
}

/// The next messages to repeat.
#[derive(Clone, Copy, Debug, Default)]
struct Repeat {
    count: u32,
    /// A copy is late by up to this time.
    later: Duration,
}

struct Shared {
    process: usize,
    server: u16,
    way: watch::Receiver<Way>,
    repeats: [Mutex<Repeat>; 2],
    sessions: Sessions,
    moments: broadcast::Sender<Moment>,
}

/// The proxy. Dropped, it ends all connections.
pub(crate) struct Proxy {
    address: SocketAddr,
    way: watch::Sender<Way>,
    shared: Arc<Shared>,
    task: JoinHandle<()>,
}

impl Proxy {
    /// A proxy of a process for the server at a port of loopback.
    pub(crate) async fn start(
        process: usize,
        server: u16,
        sessions: Sessions,
        moments: broadcast::Sender<Moment>,
    ) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap();
        let (way, state) = watch::channel(Way::default());
        let shared = Arc::new(Shared { process, server, way: state, repeats: Default::default(), sessions, moments });
        let task = tokio::spawn(accept(listener, shared.clone()));
        Self { address, way, shared, task }
    }

    pub(crate) fn url(&self) -> String {
        format!("nats://{}", self.address)
    }

    /// Changes the state of the way.
    pub(crate) fn change(&self, change: impl FnOnce(&mut Way)) {
        self.way.send_modify(change);
    }

    /// Makes all well: held messages are delivered.
    pub(crate) fn heal(&self) {
        self.change(|way| *way = Way { resets: way.resets, ..Way::default() });
        self.shared.repeats.iter().for_each(|repeat| repeat.lock().unwrap().count = 0);
    }

    /// Repeats the next messages in one direction; copies come later by up to this time.
    pub(crate) fn repeat(&self, is_up: bool, count: u32, later: Duration) {
        *self.shared.repeats[usize::from(is_up)].lock().unwrap() = Repeat { count, later };
    }
}

impl Drop for Proxy {
    fn drop(&mut self) {
        self.task.abort();
    }
}

async fn accept(listener: TcpListener, shared: Arc<Shared>) {
    let mut connections = JoinSet::new();
    while let Ok((client, _)) = listener.accept().await {
        while connections.try_join_next().is_some() {}
        connections.spawn(serve(client, shared.clone()));
    }
}

async fn serve(mut client: TcpStream, shared: Arc<Shared>) {
    let mut way = shared.way.clone();
    let resets = way.borrow().resets;
    if way.borrow().is_refusing {
        let _ = client.set_zero_linger();
        return;
    }
    let Ok(mut server) = TcpStream::connect(("127.0.0.1", shared.server)).await else { return };
    let _ = (client.set_nodelay(true), server.set_nodelay(true));
    let is_reset = {
        let ((client_in, client_out), (server_in, server_out)) = (client.split(), server.split());
        // Each direction ends by itself.
        let both = async {
            tokio::join!(pump(client_in, server_out, true, &shared), pump(server_in, client_out, false, &shared))
        };
        tokio::select! {
            _ = both => false,
            changed = way.wait_for(|way| way.resets != resets) => changed.is_ok(),
        }
    };
    if is_reset {
        let _ = (client.set_zero_linger(), server.set_zero_linger());
    }
}

/// The frames of a direction that wait for their time.
#[derive(Default)]
struct Waiting {
    heap: BinaryHeap<Reverse<(Instant, u64)>>,
    frames: BTreeMap<u64, Vec<u8>>,
    next: u64,
    /// The time of the last message, and of the last entry: neither overtakes its own kind.
    last: [Option<Instant>; 2],
}

impl Waiting {
    fn push(&mut self, at: Instant, bytes: Vec<u8>) {
        self.heap.push(Reverse((at, self.next)));
        self.frames.insert(self.next, bytes);
        self.next += 1;
    }

    /// Plans a frame, and the copy of a repeated one.
    fn plan(&mut self, frame: Frame, direction: Direction, repeat: &Mutex<Repeat>) {
        let is_entry = frame.kind == Kind::Entry;
        let delay = direction.delay + if is_entry { direction.entry_delay } else { Duration::ZERO };
        let last = &mut self.last[usize::from(is_entry)];
        let due = (Instant::now() + delay).max(last.unwrap_or_else(Instant::now));
        *last = Some(due);
        let mut repeat = repeat.lock().unwrap();
        if repeat.count > 0 && frame.kind != Kind::Other {
            repeat.count -= 1;
            self.push(due + repeat.later.mul_f64(fastrand::f64()), frame.bytes.clone());
        }
        self.push(due, frame.bytes);
    }

    fn due(&self) -> Option<Instant> {
        self.heap.peek().map(|Reverse((at, _))| *at)
    }

    fn pop(&mut self) -> Option<Vec<u8>> {
        let Reverse((_, number)) = self.heap.pop()?;
        self.frames.remove(&number)
    }
}

async fn pump(mut from: ReadHalf<'_>, mut to: WriteHalf<'_>, is_up: bool, shared: &Shared) -> io::Result<()> {
    let (mut frames, mut waiting, mut is_open) = (Frames::default(), Waiting::default(), true);
    let mut way = shared.way.clone();
    let mut bytes = vec![0; 64 << 10];
    while is_open || waiting.due().is_some() {
        let direction = if is_up { way.borrow_and_update().up } else { way.borrow_and_update().down };
        let due = waiting.due().filter(|_| !direction.is_held);
        tokio::select! {
            read = from.read(&mut bytes), if is_open => {
                let length = read.unwrap_or(0);
                is_open = length > 0;
                frames.push(&bytes[..length]);
                while let Some(frame) = frames.next() {
                    if is_up {
                        shared.note(&frame.kind);
                    }
                    waiting.plan(frame, direction, &shared.repeats[usize::from(is_up)]);
                }
            }
            () = sleep_until(due.unwrap_or_else(Instant::now)), if due.is_some() => {
                if let Some(frame) = waiting.pop() {
                    to.write_all(&frame).await?;
                }
            }
            changed = way.changed() => if changed.is_err() { break },
        }
    }
    to.shutdown().await
}

impl Shared {
    fn note(&self, kind: &Kind) {
        let Kind::Publish { subject, payload } = kind else { return };
        let Some((kind, name)) = subject.strip_prefix(PREFIX).and_then(|key| key.split_once('.')) else { return };
        let act = match kind {
            "w" if payload == b"dead" => Act::Fence,
            "w" => {
                self.sessions.lock().unwrap().entry(name.to_owned()).or_insert(self.process);
                Act::Renew
            }
            "l" if payload.is_empty() => Act::Release,
            "l" => Act::Take,
            _ => return,
        };
        // Without a fault that waits for it, none listens.
        let _ = self.moments.send(Moment { process: self.process, act });
    }
}
