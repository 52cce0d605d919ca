//! The PLC's end of a line, for tests that decide every byte.
#![allow(dead_code, reason = "each test program uses its own part of it")]

use std::collections::BTreeSet;
use std::time::Duration;

use bytes::{Bytes, BytesMut};
use fatek::wire::{Codec, Frame, Framing, Side};
use fatek::{CallOptions, Link, Station};
use tokio::io::{AsyncReadExt, AsyncWriteExt, DuplexStream, duplex};
use tokio::time::timeout;
use tokio_util::codec::{Decoder, Encoder};

/// The PLC's end of a line. It answers by itself the check that each station gets first, and loop-backs without data, which
/// separate two requests; the test answers the rest.
pub(crate) struct Peer {
    pub(crate) stream: DuplexStream,
    codec: Codec,
    pub(crate) received: BytesMut,
    /// Stations whose first check has been answered.
    checked: BTreeSet<u8>,
}

impl Peer {
    pub(crate) fn new(stream: DuplexStream) -> Self {
        Self {
            stream,
            codec: Codec::new(Framing::Ascii, Side::Plc),
            received: BytesMut::new(),
            checked: BTreeSet::new(),
        }
    }

    /// The next request.
    pub(crate) async fn request(&mut self) -> Frame {
        self.request_if_any().await.expect("the client has hung up")
    }

    /// The next request, unless the client has hung up.
    pub(crate) async fn request_if_any(&mut self) -> Option<Frame> {
        loop {
            let request = self.any_request().await?;
            let first = request.station != 0 && !self.checked.contains(&request.station);
            if request.command == 0x4E && (first || request.data.is_empty()) {
                self.checked.insert(request.station);
                let mut bytes = BytesMut::new();
                self.encode(request.station, 0x4E, request.data, &mut bytes);
                self.raw(&bytes).await;
                continue;
            }
            return Some(request);
        }
    }

    /// The next request, be it a check, unless the client has hung up.
    pub(crate) async fn any_request(&mut self) -> Option<Frame> {
        loop {
            if let Some(frame) = self.codec.decode(&mut self.received).unwrap().and_then(|item| item.frame()) {
                return Some(frame);
            }
            if self.stream.read_buf(&mut self.received).await.unwrap() == 0 {
                return None;
            }
        }
    }

    /// Answers everything as a healthy PLC would, until the client hangs up.
    pub(crate) async fn serve(mut self) {
        while let Some(request) = self.request_if_any().await {
            match request.command {
                0x4E => {
                    let data = String::from_utf8(request.data.to_vec()).unwrap();
                    self.reply(request.station, 0x4E, &data).await;
                }
                0x40 => self.reply(request.station, 0x40, "0010000").await,
                command => self.reply(request.station, command, "0").await,
            }
        }
    }

    /// Whether the client sends nothing for a second.
    pub(crate) async fn hears_nothing(&mut self) -> bool {
        timeout(Duration::from_secs(1), self.request()).await.is_err()
    }

    /// Answers with this data, error digit included.
    pub(crate) async fn reply(&mut self, station: u8, command: u8, data: &str) {
        let mut bytes = BytesMut::new();
        self.encode(station, command, data.to_owned(), &mut bytes);
        self.raw(&bytes).await;
    }

    /// Appends a frame.
    pub(crate) fn encode(&mut self, station: u8, command: u8, data: impl Into<Bytes>, bytes: &mut BytesMut) {
        self.codec.encode(&Frame { station, command, data: data.into() }, bytes).unwrap();
    }

    pub(crate) async fn raw(&mut self, bytes: &[u8]) {
        self.stream.write_all(bytes).await.unwrap();
    }

    /// Echoes the loop-back that must come now.
    pub(crate) async fn echo(&mut self) {
        let request = self.request().await;
        assert_eq!(request.command, 0x4E, "a dirty station must first echo a loop-back");
        let data = String::from_utf8(request.data.to_vec()).unwrap();
        self.reply(request.station, 0x4E, &data).await;
    }
}

pub(crate) fn line() -> (Link, Peer) {
    let (client, plc) = duplex(4096);
    let link = Link::from_stream(client, Framing::Ascii);
    (link, Peer::new(plc))
}

pub(crate) fn station(link: &Link) -> Station {
    link.station(1).unwrap()
}

pub(crate) fn once(station: &Station) -> Station {
    station.with_options(CallOptions::new().retries(0))
}
