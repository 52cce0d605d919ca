use std::io;
use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use bytes::{Bytes, BytesMut};
use tokio::net::{ToSocketAddrs, UdpSocket};
use tokio::sync::oneshot;
use tokio::task::JoinHandle;
use tokio::time::{self, Instant};
use tokio_util::codec::Decoder;
use tracing::debug;

use super::session::sleep_until_due;
use super::{FRAME_TIMEOUT, SHUTDOWN_TIMEOUT};
use crate::sim::Bus;
use crate::sim::fault::{Conditions, Faults, Output, Session};
use crate::wire::{Codec, Framing, Side};

/// A UDP server for a [`Bus`], as an Ethernet module or a serial device server.
///
/// A datagram holds whole frames. Each reply is a datagram to the sender of its request, or, after
/// [`answer_last_sender`](Self::answer_last_sender), to the sender of the latest request.
///
/// Differences of [faults](crate::sim::fault) over UDP:
///
/// - [`Fault::Refuse`](crate::sim::Fault::Refuse) has no effect.
/// - [`Fault::Disconnect`](crate::sim::Fault::Disconnect) loses the request or its reply; there is
///   no connection to close.
/// - The pieces of a reply are separate datagrams.
/// - A request from another address than the last one counts as a new connection for
///   [`Faults::left_over`].
///
/// Dropping it closes the socket; [`shutdown`](Self::shutdown) also waits for that.
///
/// ```
/// use fatek::sim::{Bus, Plc, UdpServer};
/// use fatek::wire::Framing;
/// use tokio::net::UdpSocket;
///
/// # #[tokio::main(flavor = "current_thread")]
/// # async fn main() -> Result<(), Box<dyn std::error::Error>> {
/// let bus = Bus::new().with_station(1, Plc::new())?;
/// let server = UdpServer::bind("127.0.0.1:0", bus, Framing::Ascii).await?;
///
/// let client = UdpSocket::bind("127.0.0.1:0").await?;
/// client.send_to(b"\x0201411F9\x03", server.local_addr()).await?; // RUN to station 1
/// let mut reply = [0; 9];
/// client.recv(&mut reply).await?;
/// assert_eq!(&reply, b"\x0201410F8\x03");
///
/// server.shutdown().await;
/// # Ok(())
/// # }
/// ```
#[derive(Debug)]
pub struct UdpServer {
    local_addr: SocketAddr,
    to_last_sender: Arc<AtomicBool>,
    from_other_port: Arc<AtomicBool>,
    /// Stops the task when dropped.
    stop: oneshot::Sender<()>,
    task: JoinHandle<()>,
}

impl UdpServer {
    /// Listens on an address, such as `127.0.0.1:0` for any free local port.
    ///
    /// # Errors
    /// The address cannot be bound.
    pub async fn bind(address: impl ToSocketAddrs, bus: Bus, framing: Framing) -> io::Result<Self> {
        let socket = UdpSocket::bind(address).await?;
        let local_addr = socket.local_addr()?;
        let to_last_sender = Arc::new(AtomicBool::new(false));
        let (stop, stopped) = oneshot::channel();
        let from_other_port = Arc::new(AtomicBool::new(false));
        let flags = (to_last_sender.clone(), from_other_port.clone());
        let task = tokio::spawn(serve_datagrams(socket, bus, framing, flags, stopped));
        Ok(Self { local_addr, to_last_sender, from_other_port, stop, task })
    }

    /// The address it listens on.
    #[must_use]
    pub fn local_addr(&self) -> SocketAddr {
        self.local_addr
    }

    /// Sets whether replies go to the sender of the latest request, as from serial device servers.
    ///
    /// Default: `false`, each reply goes to the sender of its request.
    pub fn answer_last_sender(&self, answer: bool) {
        self.to_last_sender.store(answer, Ordering::Relaxed);
    }

    /// Sets whether replies come from another port than the one that was asked, a new one each.
    ///
    /// Default: `false`.
    pub fn answer_from_other_port(&self, answer: bool) {
        self.from_other_port.store(answer, Ordering::Relaxed);
    }

    /// Closes the socket, and returns when that is done.
    ///
    /// Requests that have arrived are answered first, within one second.
    pub async fn shutdown(self) {
        drop(self.stop);
        if let Err(error) = self.task.await {
            debug!(%error, "the task of the simulated PLC failed");
        }
    }
}

/// Sends from a new port of the same address.
async fn send_from_other_port(socket: &UdpSocket, bytes: &[u8], to: SocketAddr) -> io::Result<usize> {
    let other = UdpSocket::bind((socket.local_addr()?.ip(), 0)).await?;
    other.send_to(bytes, to).await
}

/// Serves datagrams until it is stopped.
async fn serve_datagrams(
    socket: UdpSocket,
    bus: Bus,
    framing: Framing,
    (to_last_sender, from_other_port): (Arc<AtomicBool>, Arc<AtomicBool>),
    mut stopped: oneshot::Receiver<()>,
) {
    let conditions = bus.conditions().cloned();
    let conditions = conditions.unwrap_or_else(|| Conditions::new(Faults::new(0).log_capacity(0).journal_capacity(0)));
    let mut session = Session::of_datagrams(bus, conditions, framing);
    let mut last_sender = None;
    let mut buffer = vec![0; MAX_DATAGRAM_LEN];
    // Set when it is stopped: the time at which it ends, with or without replies that are due.
    let mut end_at: Option<Instant> = None;
    loop {
        match session.next_addressed_output(Instant::now()) {
            Some((to, Output::Bytes(bytes))) => {
                let to = to.filter(|_| !to_last_sender.load(Ordering::Relaxed)).or(last_sender);
                if let Some(to) = to {
                    let result = match from_other_port.load(Ordering::Relaxed) {
                        true => send_from_other_port(&socket, &bytes, to).await,
                        false => socket.send_to(&bytes, to).await,
                    };
                    debug!(%to, ?result, "sent");
                }
                continue;
            }
            Some((_, Output::Close)) => continue,
            None => {}
        }
        let due = session.due();
        if end_at.is_some_and(|end_at| due.is_none() || Instant::now() >= end_at) {
            return;
        }
        tokio::select! {
            biased;
            _ = &mut stopped, if end_at.is_none() => {
                end_at = Some(Instant::now() + SHUTDOWN_TIMEOUT);
                while session.has_room()
                    && let Ok((len, from)) = socket.try_recv_from(&mut buffer)
                {
                    receive_datagram(&mut session, &buffer[..len], from, framing);
                }
            }
            () = sleep_until_due(due.into_iter().chain(end_at).min()) => {}
            received = socket.recv_from(&mut buffer), if session.has_room() && end_at.is_none() => match received {
                Ok((len, from)) => {
                    if last_sender.replace(from) != Some(from) {
                        session.change_client(Instant::now());
                    }
                    receive_datagram(&mut session, &buffer[..len], from, framing);
                }
                Err(error) => {
                    // For instance an ICMP error for an earlier datagram.
                    debug!(%error, "cannot receive");
                    time::sleep(FRAME_TIMEOUT).await;
                }
            },
        }
    }
}

/// Above the length of any datagram.
const MAX_DATAGRAM_LEN: usize = 65_536;

fn receive_datagram(session: &mut Session, datagram: &[u8], from: SocketAddr, framing: Framing) {
    let now = Instant::now();
    let mut codec = Codec::new(framing, Side::Plc);
    let mut rest = BytesMut::from(datagram);
    let mut bytes = Bytes::copy_from_slice(datagram);
    while let Ok(Some(item)) = codec.decode_eof(&mut rest) {
        // The codec only removes bytes, so `rest` is not longer than `bytes`.
        let of_item = bytes.split_to(bytes.len() - rest.len());
        session.receive_from(item, of_item, Some(from), now);
    }
}
