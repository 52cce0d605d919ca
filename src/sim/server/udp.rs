use std::io;
use std::net::SocketAddr;
use std::pin::pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use bytes::{Bytes, BytesMut};
use futures::future;
use tokio::net::{ToSocketAddrs, UdpSocket};
use tokio::sync::oneshot;
use tokio::task::JoinHandle;
use tokio::time::{self, Instant};
use tokio_util::codec::Decoder;
use tracing::debug;

use super::SILENCE;
use super::converse::pause;
use crate::sim::Bus;
use crate::sim::fault::{Conditions, Conversation, Faults, Output};
use crate::wire::{Codec, Framing, Side};

/// A [`Bus`] behind a UDP port, as behind an Ethernet module or a serial device server.
///
/// A datagram has whole frames. Each reply is a datagram of its own to the address that asked, or, after
/// [`answer_last_sender`](Self::answer_last_sender), to the address of the latest request.
///
/// Of the [faults](crate::sim::fault), [`Fault::Refuse`](crate::sim::Fault::Refuse) does nothing here, and
/// [`Fault::Disconnect`](crate::sim::Fault::Disconnect) only has a request or its reply lost: there is no connection to
/// close. Pieces of a reply are datagrams. A request from another address than the one before counts as a new connection
/// for [`Faults::left_over`].
///
/// Dropping it stops it, soon; [`shutdown`](Self::shutdown) waits until that is done.
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
/// client.send_to(b"\x0201411F9\x03", server.local_addr()).await?; // station 1, run!
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
    /// Closes when this server is dropped, and that stops the task.
    stop: oneshot::Sender<()>,
    task: JoinHandle<()>,
}

impl UdpServer {
    /// Listens on an address, such as `127.0.0.1:0` for any free port of this machine.
    ///
    /// # Errors
    /// Those of binding the address.
    pub async fn bind(address: impl ToSocketAddrs, bus: Bus, framing: Framing) -> io::Result<Self> {
        let socket = UdpSocket::bind(address).await?;
        let local_addr = socket.local_addr()?;
        let to_last_sender = Arc::new(AtomicBool::new(false));
        let (stop, stopped) = oneshot::channel();
        let serving = serve_datagrams(socket, bus, framing, to_last_sender.clone());
        let task = tokio::spawn(async move {
            let serving = pin!(serving);
            future::select(serving, stopped).await;
        });
        Ok(Self { local_addr, to_last_sender, stop, task })
    }

    /// Returns the address it listens on.
    #[must_use]
    pub fn local_addr(&self) -> SocketAddr {
        self.local_addr
    }

    /// Sends replies to the address of the latest request, as serial device servers do, or to the one that asked.
    pub fn answer_last_sender(&self, answer: bool) {
        self.to_last_sender.store(answer, Ordering::Relaxed);
    }

    /// Closes the socket, and returns when that is done.
    pub async fn shutdown(self) {
        drop(self.stop);
        if let Err(error) = self.task.await {
            debug!(%error, "the task of the simulated PLC failed");
        }
    }
}

/// Never ends.
async fn serve_datagrams(socket: UdpSocket, bus: Bus, framing: Framing, to_last_sender: Arc<AtomicBool>) {
    let conditions = bus.conditions().cloned();
    let conditions = conditions.unwrap_or_else(|| Conditions::new(Faults::new(0).log_capacity(0).journal_capacity(0)));
    let mut conversation = Conversation::of_datagrams(bus, conditions, framing);
    let mut last_sender = None;
    let mut buffer = vec![0; MAX_DATAGRAM_LEN];
    loop {
        match conversation.next_to(Instant::now()) {
            Some((to, Output::Bytes(bytes))) => {
                let to = to.filter(|_| !to_last_sender.load(Ordering::Relaxed)).or(last_sender);
                if let Some(to) = to {
                    let result = socket.send_to(&bytes, to).await;
                    debug!(%to, ?result, "sent");
                }
                continue;
            }
            Some((_, Output::Close)) => continue,
            None => {}
        }
        let due = conversation.due();
        tokio::select! {
            biased;
            () = pause(due) => {}
            received = socket.recv_from(&mut buffer), if conversation.has_room() => match received {
                Ok((len, from)) => {
                    if last_sender.replace(from) != Some(from) {
                        conversation.change_client(Instant::now());
                    }
                    hear(&mut conversation, buffer.get(..len).unwrap_or_default(), from, framing);
                }
                Err(error) => {
                    // Such as one that an earlier datagram could not be delivered.
                    debug!(%error, "cannot receive");
                    time::sleep(SILENCE).await;
                }
            },
        }
    }
}

/// More than a datagram can have.
const MAX_DATAGRAM_LEN: usize = 65_536;

fn hear(conversation: &mut Conversation, datagram: &[u8], from: SocketAddr, framing: Framing) {
    let now = Instant::now();
    let mut codec = Codec::new(framing, Side::Plc);
    let mut rest = BytesMut::from(datagram);
    let mut bytes = Bytes::copy_from_slice(datagram);
    while let Ok(Some(item)) = codec.decode_eof(&mut rest) {
        let of_item = bytes.split_to(bytes.len().saturating_sub(rest.len()));
        conversation.hear_from(item, of_item, Some(from), now);
    }
}
