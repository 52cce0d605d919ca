//! A line with one roaming duplicate: a copy of an earlier reply that comes just before the reply
//! to a later request.
#![allow(dead_code, reason = "each test program uses a part of it")]

use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use fatek::sim::{self, Bus};
use fatek::wire::Framing;
use fatek::{CallOptions, Link, Station};
use tokio::io::{AsyncRead, AsyncReadExt, AsyncWriteExt, DuplexStream, duplex};
use tokio::time::sleep;

/// Number of earlier replies that may be copied.
const MAX_AGE: usize = 3;

/// A station behind a line with a roaming duplicate.
pub(crate) struct RoamingLine {
    pub(crate) station: Station,
    copies: Arc<AtomicUsize>,
}

impl RoamingLine {
    /// Connects to the bus. The duplicate comes at request `from` or later, checks not counted.
    ///
    /// It precedes the first reply that has the shape of one of the last [`MAX_AGE`] replies, with
    /// other content.
    pub(crate) fn new(bus: Bus, from: usize) -> Self {
        let (client, line) = duplex(65_536);
        let copies = Arc::new(AtomicUsize::new(0));
        tokio::spawn(relay(line, bus, from, copies.clone()));
        let link = Link::stream_builder(client, Framing::Ascii).response_timeout(Duration::from_millis(200)).build();
        Self { station: link.station(1).unwrap().with_options(CallOptions::new()), copies }
    }

    /// Number of copies sent: 0 or 1.
    pub(crate) fn copies(&self) -> usize {
        self.copies.load(Ordering::Relaxed)
    }
}

async fn relay(mut client: DuplexStream, bus: Bus, from: usize, copies: Arc<AtomicUsize>) {
    let mut plc = sim::connector(bus, Framing::Ascii)().await.unwrap();
    let (mut count, mut replies) = (0, VecDeque::new());
    while let Some(request) = frame(&mut client).await {
        plc.write_all(&request).await.unwrap();
        let Some(reply) = frame(&mut plc).await else { return };
        let is_check = request[3..5] == *b"4E";
        count += usize::from(!is_check);
        let is_ambiguous = |copy: &&Vec<u8>| copy.len() == reply.len() && copy[..5] == reply[..5] && **copy != reply;
        let copy = replies.iter().find(is_ambiguous).filter(|_| count >= from && copies.load(Ordering::Relaxed) == 0);
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
            replies.push_back(reply);
            if replies.len() > MAX_AGE {
                replies.pop_front();
            }
        }
    }
}

/// Reads one ASCII frame.
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
