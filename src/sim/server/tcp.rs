//! Server over TCP.

use std::io;
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use tokio::net::{TcpListener, TcpStream, ToSocketAddrs};
use tokio::sync::oneshot;
use tokio::task::{AbortHandle, JoinHandle, JoinSet};
use tokio::time;
use tracing::debug;

use super::connection::{Connection, ConnectionHandle};
use super::{FRAME_TIMEOUT, SHUTDOWN_TIMEOUT, serve};
use crate::endpoint::Endpoint;
use crate::sim::fault::Faults;
use crate::sim::{Bus, Plc};
use crate::wire::Framing;

/// Maximum number of connections of a [`Server`]. A further one takes the place of the connection
/// that is idle longest, after [`Server::make_room_after`], or waits until one ends.
pub const MAX_CONNECTIONS: usize = 64;

/// Default of [`Server::make_room_after`].
const MAKE_ROOM_AFTER: Duration = Duration::from_secs(5);

/// A TCP server for a [`Bus`], as an Ethernet module.
///
/// Dropping it closes the port and all connections; [`shutdown`](Self::shutdown) also waits for
/// that. The [module](crate::sim) has an example.
#[derive(Debug)]
pub struct Server {
    local_addr: SocketAddr,
    framing: Framing,
    faults: Option<Faults>,
    make_room_after: Arc<Mutex<Duration>>,
    /// Stops the task when dropped.
    stop: oneshot::Sender<()>,
    task: JoinHandle<()>,
}

impl Server {
    /// Listens on an address, such as `127.0.0.1:0` for any free local port.
    ///
    /// Each connection is served as by [`serve`], at most [`MAX_CONNECTIONS`] at a time.
    ///
    /// # Errors
    /// The address cannot be bound.
    pub async fn bind(address: impl ToSocketAddrs, bus: Bus, framing: Framing) -> io::Result<Self> {
        let listener = TcpListener::bind(address).await?;
        let local_addr = listener.local_addr()?;
        let faults = bus.faults().cloned();
        let make_room_after = Arc::new(Mutex::new(MAKE_ROOM_AFTER));
        let connections = Connections::new(bus, framing, make_room_after.clone());
        let (stop, stopped) = oneshot::channel();
        let task = tokio::spawn(serve_until(stopped, listener, connections));
        Ok(Self { local_addr, framing, faults, make_room_after, stop, task })
    }

    /// The address it listens on.
    #[must_use]
    pub fn local_addr(&self) -> SocketAddr {
        self.local_addr
    }

    /// The endpoint of a client on this machine, with the framing of the server.
    ///
    /// For a server on all addresses of the machine, such as `0.0.0.0:500`, it is the loopback
    /// address.
    #[must_use]
    pub fn endpoint(&self) -> Endpoint {
        let mut address = self.local_addr;
        match address.ip() {
            IpAddr::V4(ip) if ip.is_unspecified() => address.set_ip(Ipv4Addr::LOCALHOST.into()),
            IpAddr::V6(ip) if ip.is_unspecified() => address.set_ip(Ipv6Addr::LOCALHOST.into()),
            IpAddr::V4(_) | IpAddr::V6(_) => {}
        }
        Endpoint::from(address).with_framing(self.framing)
    }

    /// The faults of the bus, with its log; `None` for a bus without.
    #[must_use]
    pub fn faults(&self) -> Option<&Faults> {
        self.faults.as_ref()
    }

    /// Sets the idle time after which a connection makes room for a new one. That is the time
    /// since the last byte in either direction.
    ///
    /// At the limit of connections, the one that is idle longest is closed if it has been idle for
    /// this time. Otherwise the new one waits. Default: 5 s.
    pub fn make_room_after(&self, idle: Duration) {
        *self.make_room_after.lock().unwrap_or_else(PoisonError::into_inner) = idle;
    }

    /// Closes the port and all connections, and returns when that is done.
    ///
    /// Requests that have arrived are answered first, within one second.
    pub async fn shutdown(self) {
        drop(self.stop);
        if let Err(error) = self.task.await {
            debug!(%error, "the task of the simulated PLC failed");
        }
    }
}

impl Plc {
    /// Serves this PLC over TCP, as station 1 in the ASCII framing.
    ///
    /// The address is such as `127.0.0.1:0`, for any free local port. The server has
    /// [faults](Server::faults) without rules, and with a log.
    ///
    /// ```
    /// use fatek::sim::{Change, Plc};
    /// use fatek::{Link, register};
    ///
    /// # #[tokio::main(flavor = "current_thread")]
    /// # async fn main() -> Result<(), Box<dyn std::error::Error>> {
    /// let server = Plc::new().serve("127.0.0.1:0").await?;
    /// let station = Link::new(server.endpoint()).station(1)?;
    /// station.write_registers(register!("R0"), &[7]).await?;
    ///
    /// let log = server.faults().unwrap().log();
    /// assert_eq!(log.changes(1), [Change::value(register!("R0"), 7_u16)]);
    /// # Ok(())
    /// # }
    /// ```
    ///
    /// Dropping the server closes the port and all connections. For another framing or station
    /// number, and for several stations, use a [`Bus`] and [`Server::bind`].
    ///
    /// Cancel-safe: a dropped call closes the port.
    ///
    /// # Errors
    /// The address cannot be bound.
    pub async fn serve(&self, address: impl ToSocketAddrs) -> io::Result<Server> {
        let bus = Bus::of_one(self.clone()).with_faults(Faults::new(0));
        Server::bind(address, bus, Framing::Ascii).await
    }
}

async fn serve_until(mut stopped: oneshot::Receiver<()>, listener: TcpListener, mut connections: Connections) {
    tokio::select! {
        biased;
        _ = &mut stopped => {}
        () = accept(&listener, &mut connections) => {}
    }
    // The port is closed first: a client can reconnect as soon as its connection ends.
    drop(listener);
    connections.close_all().await;
}

/// Accepts connections. Never returns.
async fn accept(listener: &TcpListener, connections: &mut Connections) {
    loop {
        match listener.accept().await {
            Ok((_, peer)) if connections.bus.faults().is_some_and(Faults::refuse_connection) => {
                debug!(%peer, "refused")
            }
            Ok((stream, peer)) => {
                connections.make_room().await;
                connections.serve(stream, peer);
            }
            Err(error) => {
                // For instance too many open files. The pause prevents a busy loop.
                debug!(%error, "cannot accept");
                time::sleep(FRAME_TIMEOUT).await;
            }
        }
    }
}

/// The connections of a server. Dropping it closes them.
struct Connections {
    bus: Bus,
    framing: Framing,
    make_room_after: Arc<Mutex<Duration>>,
    tasks: JoinSet<()>,
    /// Handles of the tasks, also of those that have just ended.
    handles: Vec<(ConnectionHandle, AbortHandle)>,
}

impl Connections {
    fn new(bus: Bus, framing: Framing, make_room_after: Arc<Mutex<Duration>>) -> Self {
        Self { bus, framing, make_room_after, tasks: JoinSet::new(), handles: Vec::new() }
    }

    fn serve(&mut self, stream: TcpStream, peer: SocketAddr) {
        debug!(%peer, "accepted");
        // A reply is one small segment: without this, Nagle's algorithm delays it.
        let _ = stream.set_nodelay(true);
        let handle = ConnectionHandle::new();
        let serving = serve(Connection::new(stream, handle.clone()), self.bus.clone(), self.framing);
        let task = self.tasks.spawn(async move {
            let result = serving.await;
            debug!(%peer, ?result, "closed");
        });
        self.handles.push((handle, task));
    }

    /// Waits until a connection is free. Closes the one that is idle longest when it may.
    async fn make_room(&mut self) {
        while self.tasks.try_join_next().is_some() {}
        self.forget_ended();
        while self.tasks.len() >= MAX_CONNECTIONS {
            let after = *self.make_room_after.lock().unwrap_or_else(PoisonError::into_inner);
            let longest = self.handles.iter().max_by_key(|(handle, _)| handle.idle_time()).cloned();
            let Some((handle, task)) = longest else { return };
            let left = after.saturating_sub(handle.idle_time());
            if left.is_zero() {
                if handle.is_closing() {
                    // Its client does not read the last reply, or a fault delays it.
                    task.abort();
                }
                handle.close();
            }
            let wait = if left.is_zero() { FRAME_TIMEOUT } else { left.min(FRAME_TIMEOUT) };
            let _ = time::timeout(wait, self.tasks.join_next()).await;
            self.forget_ended();
        }
    }

    fn forget_ended(&mut self) {
        self.handles.retain(|(_, task)| !task.is_finished());
    }

    /// Answers the requests that have arrived, and closes all connections.
    async fn close_all(mut self) {
        self.handles.iter().for_each(|(handle, _)| handle.close());
        let ended = async { while self.tasks.join_next().await.is_some() {} };
        let _ = time::timeout(SHUTDOWN_TIMEOUT, ended).await;
        self.tasks.shutdown().await;
    }
}
