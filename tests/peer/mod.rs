//! A scripted PLC: the test decides every byte of its replies.
#![allow(dead_code, reason = "each test program uses a part of it")]

use std::collections::BTreeSet;
use std::time::Duration;

use bytes::{Bytes, BytesMut};
use fatek::endpoint::InStepSettings;
use fatek::wire::{Codec, Frame, Framing, Side};
use fatek::{CallOptions, Link, Station};
use tokio::io::{AsyncReadExt, AsyncWriteExt, DuplexStream, duplex};
use tokio::time::timeout;
use tokio_util::codec::{Decoder, Encoder};

/// The PLC's end of a stream.
///
/// Answers the first check of each station and loop-backs without data, which separate two
/// requests. The test answers all other requests.
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

    /// Receives the next request.
    pub(crate) async fn request(&mut self) -> Frame {
        self.request_if_any().await.expect("the client has closed the connection")
    }

    /// Receives the next request; `None` if the client has closed the connection.
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

    /// Receives the next request, checks included; `None` if the client has closed the connection.
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

    /// Answers every request as a healthy PLC, until the client closes the connection.
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

    /// Returns whether the client sends no request for one second.
    pub(crate) async fn hears_nothing(&mut self) -> bool {
        timeout(Duration::from_secs(1), self.request()).await.is_err()
    }

    /// Sends a reply with this data, which begins with the error code.
    pub(crate) async fn reply(&mut self, station: u8, command: u8, data: &str) {
        let mut bytes = BytesMut::new();
        self.encode(station, command, data.to_owned(), &mut bytes);
        self.raw(&bytes).await;
    }

    /// Appends a frame to `bytes`.
    pub(crate) fn encode(&mut self, station: u8, command: u8, data: impl Into<Bytes>, bytes: &mut BytesMut) {
        self.codec.encode(&Frame { station, command, data: data.into() }, bytes).unwrap();
    }

    pub(crate) async fn raw(&mut self, bytes: &[u8]) {
        self.stream.write_all(bytes).await.unwrap();
    }

    /// Answers the next request, which must be a loop-back, with its echo.
    pub(crate) async fn echo(&mut self) {
        let request = self.request().await;
        assert_eq!(request.command, 0x4E, "a suspect station gets a loop-back first");
        let data = String::from_utf8(request.data.to_vec()).unwrap();
        self.reply(request.station, 0x4E, &data).await;
    }
}

pub(crate) fn line() -> (Link, Peer) {
    let (client, plc) = duplex(4096);
    let link = Link::stream_builder(client, Framing::Ascii).in_step(without_duplicates()).build();
    (link, Peer::new(plc))
}

/// Settings of a line that never duplicates a reply: equal requests keep one spelling.
pub(crate) fn without_duplicates() -> InStepSettings {
    InStepSettings::new().with_copies(0).unwrap()
}

pub(crate) fn station(link: &Link) -> Station {
    link.station(1).unwrap()
}

pub(crate) fn once(station: &Station) -> Station {
    station.with_options(CallOptions::new().with_retries(0))
}
