//! Passing of datagrams between clients and the PLC, each as it is.

use std::collections::HashMap;
use std::io;
use std::net::SocketAddr;
use std::sync::Arc;

use bytes::Bytes;
use fatek::Endpoint;
use fatek::endpoint::Transport;
use tokio::net::{UdpSocket, lookup_host};
use tokio::task::JoinSet;

use super::MAX_CONNECTIONS;
use super::writer::RecordingWriter;
use crate::conversation::{Change, Direction};
use crate::failure::Failure;
use crate::listen::{MAX_DATAGRAM_LEN, receive};
use crate::output::complain;
use crate::traffic::TrafficFailure;

/// The socket of one client towards the PLC.
struct Client {
    number: u64,
    socket: Arc<UdpSocket>,
    task: tokio::task::AbortHandle,
    /// Number of its last datagram.
    used: u64,
}

/// Address of a PLC over UDP; `None` over others.
pub(super) async fn resolve(endpoint: &Endpoint) -> Result<Option<SocketAddr>, Failure> {
    let Transport::Udp { host, port, .. } = endpoint.transport() else { return Ok(None) };
    let address = lookup_host((host.as_str(), *port)).await.map_err(|error| failed(endpoint, error))?.next();
    address.map(Some).ok_or_else(|| failed(endpoint, io::ErrorKind::NotFound.into()))
}

fn failed(endpoint: &Endpoint, error: io::Error) -> Failure {
    TrafficFailure::NotConnected { url: endpoint.to_string(), error }.into()
}

/// Passes datagrams until it is dropped. Each address of a client has a socket of its own, so that each
/// reply reaches its client.
pub(super) async fn pass(
    socket: UdpSocket,
    plc: Option<SocketAddr>,
    endpoint: &Endpoint,
    writer: &RecordingWriter,
) -> Result<(), Failure> {
    let plc = plc.ok_or_else(|| failed(endpoint, io::ErrorKind::Unsupported.into()))?;
    let socket = Arc::new(socket);
    let mut clients: HashMap<SocketAddr, Client> = HashMap::new();
    let mut replies = JoinSet::new();
    let mut buffer = vec![0; MAX_DATAGRAM_LEN];
    let mut datagrams = 0_u64;
    loop {
        datagrams += 1;
        let (len, from) = receive(&socket, &mut buffer).await;
        let bytes = buffer.get(..len).unwrap_or_default();
        if !clients.contains_key(&from) {
            if clients.len() >= MAX_CONNECTIONS
                && let Some(oldest) = clients.iter().min_by_key(|(_, client)| client.used).map(|(&from, _)| from)
                && let Some(client) = clients.remove(&oldest)
            {
                client.task.abort();
                writer.record(client.number, &Change::Close);
            }
            let own = match own_socket(plc).await {
                Ok(own) => Arc::new(own),
                // The client sends again, and the others go on.
                Err(error) => {
                    complain(format_args!("udp {from} > {endpoint}: cannot connect: {error}"));
                    continue;
                }
            };
            let number = writer.open(format!("udp {from} > {endpoint}"));
            let task = replies.spawn(pass_replies(own.clone(), socket.clone(), from, number, writer.clone()));
            clients.insert(from, Client { number, socket: own, task, used: datagrams });
        }
        let Some(client) = clients.get_mut(&from) else { continue };
        client.used = datagrams;
        record(writer, client.number, Direction::ToPlc, bytes);
        // A datagram that is lost is one that the network loses.
        let _ = client.socket.send(bytes).await;
    }
}

/// A socket towards the PLC.
async fn own_socket(plc: SocketAddr) -> io::Result<UdpSocket> {
    let any: SocketAddr = if plc.is_ipv4() { ([0; 4], 0).into() } else { ([0; 16], 0).into() };
    let own = UdpSocket::bind(any).await?;
    own.connect(plc).await?;
    Ok(own)
}

async fn pass_replies(
    plc: Arc<UdpSocket>,
    socket: Arc<UdpSocket>,
    client: SocketAddr,
    number: u64,
    writer: RecordingWriter,
) {
    let mut buffer = vec![0; MAX_DATAGRAM_LEN];
    loop {
        let (len, _) = receive(&plc, &mut buffer).await;
        let bytes = buffer.get(..len).unwrap_or_default();
        record(&writer, number, Direction::FromPlc, bytes);
        let _ = socket.send_to(bytes, client).await;
    }
}

fn record(writer: &RecordingWriter, number: u64, direction: Direction, bytes: &[u8]) {
    let bytes = Bytes::copy_from_slice(bytes);
    writer.record(number, &Change::Bytes { direction, bytes, is_datagram: true });
}
