//! A proxy in front of a real broker that records the batches which the broker has acknowledged: those are its
//! responsibility, also if it forgets them when it is killed.

use std::collections::HashMap;
use std::net::SocketAddr;
use std::sync::{Arc, Mutex};

use serde_json::Value;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::tcp::{OwnedReadHalf, OwnedWriteHalf};
use tokio::net::{TcpListener, TcpStream};
use tokio::task::JoinHandle;

const PUBLISH: u8 = 3;
const PUBACK: u8 = 4;

/// The proxy.
pub struct Proxy {
    address: SocketAddr,
    taken: Arc<Mutex<Vec<(String, Value)>>>,
    task: JoinHandle<()>,
}

/// The batches of a connection that have no acknowledgement yet, by packet id.
type Open = Arc<Mutex<HashMap<u16, (String, Value)>>>;

impl Proxy {
    /// A proxy for the broker at a port of loopback.
    pub async fn start(port: u16) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap();
        let taken = Arc::new(Mutex::new(Vec::new()));
        let record = taken.clone();
        let task = tokio::spawn(async move {
            while let Ok((client, _)) = listener.accept().await {
                // Without a broker the connection is closed.
                let Ok(server) = TcpStream::connect(("127.0.0.1", port)).await else { continue };
                let (open, record) = (Open::default(), record.clone());
                let ((from_client, to_client), (from_server, to_server)) = (client.into_split(), server.into_split());
                let published = open.clone();
                tokio::spawn(forward(from_client, to_server, move |kind, body| publish(kind, body, &published)));
                tokio::spawn(forward(from_server, to_client, move |kind, body| {
                    let id = body.get(..2).map(|id| u16::from_be_bytes([id[0], id[1]]));
                    if kind >> 4 != PUBACK || body.get(2).is_some_and(|reason| *reason >= 0x80) {
                        return;
                    }
                    if let Some(batch) = id.and_then(|id| open.lock().unwrap().remove(&id)) {
                        record.lock().unwrap().push(batch);
                    }
                }));
            }
        });
        Self { address, taken, task }
    }

    pub fn url(&self) -> String {
        format!("mqtt://{}", self.address)
    }

    /// PLC and content of the batches that the broker has acknowledged, in this order.
    pub fn taken(&self) -> Vec<(String, Value)> {
        self.taken.lock().unwrap().clone()
    }
}

impl Drop for Proxy {
    fn drop(&mut self) {
        self.task.abort();
    }
}

fn publish(kind: u8, body: &[u8], open: &Open) {
    if kind >> 4 != PUBLISH {
        return;
    }
    let topic_end = 2 + usize::from(u16::from_be_bytes([body[0], body[1]]));
    let topic = std::str::from_utf8(&body[2..topic_end]).unwrap();
    let Some(plc) = topic.strip_suffix("/data").and_then(|start| start.rsplit('/').next()) else { return };
    let id = u16::from_be_bytes([body[topic_end], body[topic_end + 1]]);
    // A batch has no properties.
    assert_eq!(body[topic_end + 2], 0, "properties");
    let batch = serde_json::from_slice(&body[topic_end + 3..]).unwrap();
    open.lock().unwrap().insert(id, (plc.to_owned(), batch));
}

/// Forwards bytes, and shows each packet after it was forwarded.
async fn forward(mut from: OwnedReadHalf, mut to: OwnedWriteHalf, mut show: impl FnMut(u8, &[u8])) {
    let mut buffer = Vec::new();
    let mut bytes = vec![0; 64 << 10];
    while let Ok(len @ 1..) = from.read(&mut bytes).await {
        buffer.extend_from_slice(&bytes[..len]);
        while let Some((header, body)) = frame(&buffer) {
            show(buffer[0], &buffer[header..header + body]);
            buffer.drain(..header + body);
        }
        if to.write_all(&bytes[..len]).await.is_err() {
            return;
        }
    }
}

/// The lengths of the header and of the body of the first packet, if it is complete.
fn frame(buffer: &[u8]) -> Option<(usize, usize)> {
    let mut body = 0;
    for (at, byte) in buffer.get(1..)?.iter().take(4).enumerate() {
        body |= usize::from(byte & 0x7F) << (7 * at);
        if byte & 0x80 == 0 {
            return (buffer.len() >= at + 2 + body).then_some((at + 2, body));
        }
    }
    None
}
