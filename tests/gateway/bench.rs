//! A simulated bus, the gateway in front of it, and clients that know no better than to take the next frame for their
//! reply.

use std::io;
use std::sync::Arc;
use std::time::Duration;

use bytes::BytesMut;
use fatek::command::{Command, ReplyError, decode_reply, encode_request};
use fatek::sim::{self, Bus, Faults, Plc};
use fatek::wire::{Codec, Framing, Side};
use fatek::{CallOptions, Discrete, Link, Register, Symbol};
use tokio::io::{AsyncReadExt, AsyncWriteExt, DuplexStream, duplex};
use tokio::sync::watch;
use tokio::task::JoinHandle;
use tokio::time::timeout;
use tokio_util::codec::Decoder;

use crate::proxy::{Proxy, Rules};
use crate::server::{DisconnectReason, Limits, serve_client};

/// How many PLCs there are, from 1 on.
pub(crate) const STATIONS: u8 = 8;

/// How many registers `D` and discretes `M` of each nobody writes.
pub(crate) const READ_ONLY: u16 = 256;

pub(crate) const RESPONSE_TIMEOUT: Duration = Duration::from_millis(100);
pub(crate) const PATIENCE: Duration = Duration::from_secs(2);
pub(crate) const LIMITS: Limits = Limits { clients: 64, idle: Duration::from_secs(60) };

pub(crate) const OPEN: Rules = Rules { stations: 0..=254, read_only: false };
pub(crate) const LOCKED: Rules = Rules { stations: 0..=254, read_only: true };

pub(crate) struct Bench {
    pub(crate) proxy: Arc<Proxy>,
    pub(crate) plcs: Vec<Plc>,
    pub(crate) faults: Faults,
    stopping: watch::Sender<()>,
    patience: Duration,
}

impl Bench {
    /// A bus where all is well.
    pub(crate) fn new(framing: Framing, rules: Rules) -> Self {
        Self::with_faults(framing, rules, Faults::new(0), PATIENCE)
    }

    pub(crate) fn with_faults(framing: Framing, rules: Rules, faults: Faults, patience: Duration) -> Self {
        let plcs: Vec<_> = (1..=STATIONS).map(plc).collect();
        let connector = sim::connector(bus(&plcs).with_faults(faults.clone()), framing);
        let link = Link::connector_builder("the bus", framing, connector)
            .options(CallOptions::new().response_timeout(RESPONSE_TIMEOUT).call_timeout(patience))
            .seed(1)
            .build();
        let proxy = Arc::new(Proxy::new(link, rules));
        Self { proxy, plcs, faults, stopping: watch::channel(()).0, patience }
    }

    pub(crate) fn client(&self, framing: Framing) -> Client {
        self.client_with(framing, 4096).0
    }

    /// A client whose connection holds so many bytes each way, and what becomes of it at the gateway.
    pub(crate) fn client_with(
        &self,
        framing: Framing,
        buffer: usize,
    ) -> (Client, JoinHandle<io::Result<DisconnectReason>>) {
        let (near, far) = duplex(buffer);
        let (proxy, stopped) = (Arc::clone(&self.proxy), self.stopping.subscribe());
        let serving = tokio::spawn(async move { serve_client(far, &proxy, LIMITS, stopped).await });
        (Client::new(near, framing, self.patience + Duration::from_millis(50)), serving)
    }

    /// Tells the clients' tasks to end.
    pub(crate) fn stop(self) -> Arc<Proxy> {
        self.proxy
    }
}

/// A bus without faults.
pub(crate) fn bus(plcs: &[Plc]) -> Bus {
    (1..).zip(plcs).fold(Bus::new(), |bus, (station, plc)| bus.with_station(station, plc.clone()).unwrap())
}

pub(crate) fn plc(station: u8) -> Plc {
    let plc = Plc::new();
    for address in 0..READ_ONLY {
        plc.write(Register::d(address), word(station, address)).unwrap();
        plc.write(m(address), bit(station, address)).unwrap();
    }
    plc
}

/// What the registers `D` hold that nobody writes: their station and their address.
pub(crate) fn word(station: u8, address: u16) -> u16 {
    u16::from(station) << 8 | address
}

/// What the discretes `M` hold that nobody writes.
pub(crate) fn bit(station: u8, address: u16) -> bool {
    (u32::from(station) * 7 + u32::from(address) * 13) % 5 < 2
}

pub(crate) fn m(address: u16) -> Discrete {
    Discrete::new(Symbol::M, address).unwrap()
}

/// Why a client has no answer.
#[derive(Debug)]
pub(crate) enum Unanswered {
    Silence,
    /// An error code, or no reply to its request at all.
    Reply(ReplyError),
}

/// A client: one request, and what comes next is its reply.
pub(crate) struct Client {
    stream: DuplexStream,
    framing: Framing,
    codec: Codec,
    received: BytesMut,
    patience: Duration,
}

impl Client {
    pub(crate) fn new(stream: DuplexStream, framing: Framing, patience: Duration) -> Self {
        let codec = Codec::new(framing, Side::Client);
        Self { stream, framing, codec, received: BytesMut::new(), patience }
    }

    pub(crate) async fn send(&mut self, bytes: &[u8]) {
        assert!(self.try_send(bytes).await, "the gateway has hung up");
    }

    /// Says whether the gateway is still there to take it all.
    pub(crate) async fn try_send(&mut self, bytes: &[u8]) -> bool {
        self.stream.write_all(bytes).await.is_ok()
    }

    /// The bytes of the next reply. `None`: none has come in time.
    pub(crate) async fn reply(&mut self) -> Option<BytesMut> {
        let patience = self.patience;
        timeout(patience, self.next_frame()).await.ok()
    }

    /// The bytes up to the end of the next frame.
    async fn next_frame(&mut self) -> BytesMut {
        loop {
            let before = self.received.clone();
            if self.codec.decode(&mut self.received).unwrap().is_some() {
                let len = before.len() - self.received.len();
                return before[..len].into();
            }
            assert_ne!(self.stream.read_buf(&mut self.received).await.unwrap(), 0, "the gateway has hung up");
        }
    }

    /// Sends these bytes, and returns the ones that come for an answer.
    pub(crate) async fn exchange(&mut self, bytes: &[u8]) -> Option<BytesMut> {
        self.send(bytes).await;
        self.reply().await
    }

    /// Asks a station something.
    ///
    /// Panics on a frame from another station or to another command: that is not even a reply.
    pub(crate) async fn ask<C: Command>(&mut self, station: u8, request: &C) -> Result<C::Reply, Unanswered> {
        let mut bytes = BytesMut::new();
        encode_request(request, self.framing, station, &mut bytes).unwrap();
        let mut reply = self.exchange(&bytes).await.ok_or(Unanswered::Silence)?;
        let frame = Codec::new(self.framing, Side::Client).decode(&mut reply).unwrap().unwrap().frame().unwrap();
        assert_eq!((frame.station, frame.command), (station, C::CODE.into()), "{request:?}");
        decode_reply(request, self.framing, &frame.data).map_err(Unanswered::Reply)
    }

    /// Whether the gateway has closed the connection.
    pub(crate) async fn is_closed(&mut self) -> bool {
        timeout(self.patience, self.stream.read_buf(&mut self.received)).await.is_ok_and(|read| read.unwrap() == 0)
    }
}
