//! Test bench: a simulated bus, the gateway before it, and clients that take the next frame for
//! their reply.

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
use crate::server::{Activity, DisconnectReason, Limits, serve_client};

/// Number of PLCs, from station 1 on.
pub(crate) const STATIONS: u8 = 8;

/// Number of registers `D` and discretes `M` of each station that are only read.
pub(crate) const READ_ONLY: u16 = 256;

pub(crate) const RESPONSE_TIMEOUT: Duration = Duration::from_millis(100);
pub(crate) const CALL_TIMEOUT: Duration = Duration::from_secs(2);
pub(crate) const LIMITS: Limits =
    Limits { clients: 64, idle: Duration::from_secs(60), make_room_after: Duration::from_secs(5) };

pub(crate) const UNRESTRICTED: Rules = Rules { stations: 0..=254, read_only: false };
pub(crate) const READ_ONLY_MODE: Rules = Rules { stations: 0..=254, read_only: true };

pub(crate) struct Bench {
    pub(crate) proxy: Arc<Proxy>,
    pub(crate) plcs: Vec<Plc>,
    pub(crate) faults: Faults,
    stopping: watch::Sender<()>,
    call_timeout: Duration,
}

impl Bench {
    /// A bus without faults.
    pub(crate) fn new(framing: Framing, rules: Rules) -> Self {
        Self::with_faults(framing, rules, Faults::new(0), CALL_TIMEOUT)
    }

    pub(crate) fn with_faults(framing: Framing, rules: Rules, faults: Faults, call_timeout: Duration) -> Self {
        let plcs: Vec<_> = (1..=STATIONS).map(plc).collect();
        let connector = sim::connector(bus(&plcs).with_faults(faults.clone()), framing);
        let link = Link::connector_builder("the bus", framing, connector)
            .options(CallOptions::new().with_response_timeout(RESPONSE_TIMEOUT).with_call_timeout(call_timeout))
            .seed(1)
            .build();
        let proxy = Arc::new(Proxy::new(link, rules));
        Self { proxy, plcs, faults, stopping: watch::channel(()).0, call_timeout }
    }

    pub(crate) fn client(&self, framing: Framing) -> Client {
        self.client_with(framing, 4096).0
    }

    /// Connects a client with buffers of this size. Also returns the gateway's task for it.
    pub(crate) fn client_with(
        &self,
        framing: Framing,
        buffer: usize,
    ) -> (Client, JoinHandle<io::Result<DisconnectReason>>) {
        let (near, far) = duplex(buffer);
        let (proxy, stopped) = (Arc::clone(&self.proxy), self.stopping.subscribe());
        let serving =
            tokio::spawn(async move { serve_client(far, &proxy, LIMITS, &Activity::default(), stopped).await });
        (Client::new(near, framing, self.call_timeout + Duration::from_millis(50)), serving)
    }

    /// Stops the clients' tasks.
    pub(crate) fn stop(self) -> Arc<Proxy> {
        self.proxy
    }
}

/// A bus of these PLCs, without faults.
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

/// Content of a read-only register `D`: its station and address.
pub(crate) fn word(station: u8, address: u16) -> u16 {
    u16::from(station) << 8 | address
}

/// Content of a read-only discrete `M`.
pub(crate) fn bit(station: u8, address: u16) -> bool {
    (u32::from(station) * 7 + u32::from(address) * 13) % 5 < 2
}

pub(crate) fn m(address: u16) -> Discrete {
    Discrete::new(Symbol::M, address).unwrap()
}

/// Reason why a client has no result.
#[derive(Debug)]
pub(crate) enum Unanswered {
    Silence,
    /// An error code, or a frame that is no reply to the request.
    Reply(ReplyError),
}

/// A simple client: it takes the next frame for the reply to its request.
pub(crate) struct Client {
    stream: DuplexStream,
    framing: Framing,
    codec: Codec,
    received: BytesMut,
    call_timeout: Duration,
}

impl Client {
    pub(crate) fn new(stream: DuplexStream, framing: Framing, call_timeout: Duration) -> Self {
        let codec = Codec::new(framing, Side::Client);
        Self { stream, framing, codec, received: BytesMut::new(), call_timeout }
    }

    pub(crate) async fn send(&mut self, bytes: &[u8]) {
        assert!(self.try_send(bytes).await, "the gateway has closed the connection");
    }

    /// Sends bytes; `false` if the gateway has closed the connection.
    pub(crate) async fn try_send(&mut self, bytes: &[u8]) -> bool {
        self.stream.write_all(bytes).await.is_ok()
    }

    /// Bytes of the next reply; `None` if it does not come in time.
    pub(crate) async fn reply(&mut self) -> Option<BytesMut> {
        let call_timeout = self.call_timeout;
        timeout(call_timeout, self.next_frame()).await.ok()
    }

    /// Bytes up to the end of the next frame.
    async fn next_frame(&mut self) -> BytesMut {
        loop {
            let before = self.received.clone();
            if self.codec.decode(&mut self.received).unwrap().is_some() {
                let len = before.len() - self.received.len();
                return before[..len].into();
            }
            assert_ne!(
                self.stream.read_buf(&mut self.received).await.unwrap(),
                0,
                "the gateway has closed the connection"
            );
        }
    }

    /// Sends a request and receives the reply, as bytes.
    pub(crate) async fn exchange(&mut self, bytes: &[u8]) -> Option<BytesMut> {
        self.send(bytes).await;
        self.reply().await
    }

    /// Makes a typed call.
    ///
    /// Panics on a frame of another station or command.
    pub(crate) async fn call<C: Command>(&mut self, station: u8, request: &C) -> Result<C::Reply, Unanswered> {
        let mut bytes = BytesMut::new();
        encode_request(request, self.framing, station, &mut bytes).unwrap();
        let mut reply = self.exchange(&bytes).await.ok_or(Unanswered::Silence)?;
        let frame = Codec::new(self.framing, Side::Client).decode(&mut reply).unwrap().unwrap().frame().unwrap();
        assert_eq!((frame.station, frame.command), (station, C::CODE.into()), "{request:?}");
        decode_reply(request, self.framing, &frame.data).map_err(Unanswered::Reply)
    }

    /// Returns whether the gateway has closed the connection.
    pub(crate) async fn is_closed(&mut self) -> bool {
        timeout(self.call_timeout, self.stream.read_buf(&mut self.received)).await.is_ok_and(|read| read.unwrap() == 0)
    }
}
