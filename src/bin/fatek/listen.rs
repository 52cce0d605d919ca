//! Listening for clients over TCP, UDP or a serial port, for `record` and `replay`.

use std::net::SocketAddr;
use std::time::Duration;

use fatek::Endpoint;
use fatek::endpoint::{EndpointStream, SerialSettings};
use fatek::wire::Framing;
use tokio::net::{TcpListener, TcpStream, UdpSocket};
use tokio::time;

use crate::failure::Failure;
use crate::printable::excerpt;
use crate::sim::{Place, PlaceKind};

/// Pause after a connection that could not be accepted, for instance for want of descriptors.
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);

/// Longest datagram.
pub(crate) const MAX_DATAGRAM_LEN: usize = 65_536;

#[derive(Debug)]
pub(crate) enum Listener {
    Tcp(TcpListener),
    Udp(UdpSocket),
    Serial(EndpointStream, SerialSettings),
}

impl Listener {
    /// Listens on the URL of `--listen`. Returns also the URL with the port in use.
    pub(crate) async fn bind(url: &str, framing: Framing) -> Result<(Self, String), Failure> {
        let (kind, own_framing) = Place::parse(url, framing)?.into_parts();
        if own_framing != framing {
            let rule = format!("the framing of the conversation is {framing}");
            return Err(Failure::Usage(format!("cannot listen on `{}`: {rule}", excerpt(url))));
        }
        let listener = match kind {
            PlaceKind::Tcp(address) => TcpListener::bind(address).await.map(Self::Tcp),
            PlaceKind::Udp(address) => UdpSocket::bind(address).await.map(Self::Udp),
            PlaceKind::Serial(path, settings) => {
                let endpoint = Endpoint::serial(path).with_framing(framing).with_serial(settings);
                endpoint.map_err(Failure::usage)?.open().await.map(|port| Self::Serial(port, settings))
            }
        };
        let failed = |error| Failure::Listen { url: url.to_owned(), error };
        let listener = listener.map_err(failed)?;
        let url = match &listener {
            Self::Tcp(listener) => format!("tcp://{}", listener.local_addr().map_err(failed)?),
            Self::Udp(socket) => format!("udp://{}", socket.local_addr().map_err(failed)?),
            Self::Serial(..) => url.to_owned(),
        };
        Ok((listener, url))
    }
}

/// Accepts the next connection, with the address of its client.
pub(crate) async fn accept(listener: &TcpListener) -> (TcpStream, String) {
    loop {
        match listener.accept().await {
            Ok((stream, client)) => {
                // Frames are small, and a client waits for each.
                let _ = stream.set_nodelay(true);
                return (stream, client.to_string());
            }
            Err(error) => {
                tracing::debug!(%error, "cannot accept");
                time::sleep(ACCEPT_PAUSE).await;
            }
        }
    }
}

/// Receives the next datagram, with its sender. An error is that of an earlier one, such as a port that
/// is closed.
pub(crate) async fn receive(socket: &UdpSocket, buffer: &mut [u8]) -> (usize, SocketAddr) {
    loop {
        match socket.recv_from(buffer).await {
            Ok(received) => return received,
            Err(error) => {
                tracing::debug!(%error, "cannot receive");
                time::sleep(ACCEPT_PAUSE).await;
            }
        }
    }
}
