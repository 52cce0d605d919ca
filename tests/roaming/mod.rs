//! A line that lets one copy of a reply roam: it comes when a later request is out, just before the true reply to that.
#![allow(dead_code, reason = "each test program uses its own part of it")]

use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use fatek::sim::{self, Bus};
use fatek::wire::Framing;
use fatek::{CallOptions, Link, Station};
use tokio::io::{AsyncRead, AsyncReadExt, AsyncWriteExt, DuplexStream, duplex};
use tokio::time::sleep;

/// How many exchanges before the reply may be of which a copy comes.
const BACK: usize = 3;

/// A station of a PLC behind such a line.
pub(crate) struct Roaming {
    pub(crate) station: Station,
    copies: Arc<AtomicUsize>,
}

impl Roaming {
    /// From this request on, checks not counted, the first reply to which an earlier one has an equal shape and another content
    /// comes behind a copy of that.
    pub(crate) fn new(bus: Bus, from: usize) -> Self {
        let (client, line) = duplex(65_536);
        let copies = Arc::new(AtomicUsize::new(0));
        tokio::spawn(carry(line, bus, from, copies.clone()));
        let link = Link::stream_builder(client, Framing::Ascii).response_timeout(Duration::from_millis(200)).build();
        Self { station: link.station(1).unwrap().with_options(CallOptions::new()), copies }
    }

    /// The copies that came: none or one.
    pub(crate) fn copies(&self) -> usize {
        self.copies.load(Ordering::Relaxed)
    }
}

async fn carry(mut client: DuplexStream, bus: Bus, from: usize, copies: Arc<AtomicUsize>) {
    let mut plc = sim::connector(bus, Framing::Ascii)().await.unwrap();
    let (mut count, mut before) = (0, VecDeque::new());
    while let Some(request) = frame(&mut client).await {
        plc.write_all(&request).await.unwrap();
        let Some(reply) = frame(&mut plc).await else { return };
        let is_check = request[3..5] == *b"4E";
        count += usize::from(!is_check);
        let fits = |copy: &&Vec<u8>| copy.len() == reply.len() && copy[..5] == reply[..5] && **copy != reply;
        let copy = before.iter().find(fits).filter(|_| count >= from && copies.load(Ordering::Relaxed) == 0);
        if let (Some(copy), false) = (copy, is_check) {
            copies.fetch_add(1, Ordering::Relaxed);
            if client.write_all(copy).await.is_err() {
                return;
            }
            sleep(Duration::from_millis(1)).await;
        }
        if client.write_all(&reply).await.is_err() {
            return;
        }
        if !is_check {
            before.push_back(reply);
            if before.len() > BACK {
                before.pop_front();
            }
        }
    }
}

/// A frame, as bytes.
async fn frame(stream: &mut (impl AsyncRead + Unpin)) -> Option<Vec<u8>> {
    const ETX: u8 = 3;
    let mut bytes = Vec::new();
    loop {
        let byte = stream.read_u8().await.ok()?;
        bytes.push(byte);
        if byte == ETX {
            return Some(bytes);
        }
    }
}
