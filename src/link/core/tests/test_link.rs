//! A core without its driver: the test does what the driver does, and sets the clock.

use std::pin::pin;
use std::sync::Arc;
use std::task::{Context, Poll, Waker};
use std::time::Duration;

use bytes::BytesMut;
use tokio::time::Instant;

use super::super::{Action, Core};
use crate::command::{self, Code, Command, ReadRegisters, WriteRegisters};
use crate::element::Register;
use crate::error::Error;
use crate::link::call::{self, CallFuture, CallMeta, Sending};
use crate::link::config::Config;
use crate::link::connector::Connector;
use crate::link::in_step::InStep;
use crate::link::options::CallOptions;
use crate::link::stats::{LinkStats, SharedStats, StationState, StationStats};
use crate::link::{LinkBuilder, later};
use crate::wire::{FieldWriter as _, Framing, Side, ascii, binary};

pub(super) const MS: Duration = Duration::from_millis(1);
pub(super) const TIMEOUT: Duration = Duration::from_millis(100);

/// A core without its driver.
pub(super) struct TestLink {
    pub(super) core: Core,
    stats: Arc<SharedStats>,
    framing: Framing,
    pub(super) now: Instant,
    /// The bytes sent last.
    pub(super) sent: Vec<u8>,
}

type Read = ReadRegisters<Register>;

pub(super) fn read(count: usize) -> Read {
    ReadRegisters::new(Register::r(0), count).unwrap()
}

pub(super) fn write() -> WriteRegisters<Register> {
    WriteRegisters::new(Register::r(0), [1]).unwrap()
}

pub(super) fn result<C: Command>(future: &mut CallFuture<C>) -> Option<Result<C::Reply, Error>> {
    match pin!(future).poll(&mut Context::from_waker(Waker::noop())) {
        Poll::Ready(result) => Some(result),
        Poll::Pending => None,
    }
}

impl TestLink {
    pub(super) fn new(framing: Framing) -> Self {
        Self::with(framing, |_| ())
    }

    /// A link with its connection open.
    pub(super) fn with(framing: Framing, set: impl FnOnce(&mut Config)) -> Self {
        let mut config = LinkBuilder::with_connector(Connector::Once(None), framing, "desk").config;
        config.response_timeout = TIMEOUT;
        config.mute_timeout = None;
        config.in_step = config.in_step.with_quiet(TIMEOUT);
        set(&mut config);
        let stats = Arc::new(SharedStats::default());
        let mut link = Self {
            core: Core::new(config.into(), "desk".into(), stats.clone(), 1),
            stats,
            framing,
            now: Instant::now(),
            sent: Vec::new(),
        };
        link.core.connected(link.now);
        link.put_in_step();
        link
    }

    /// Puts the stations of these tests in step, as if an exchange of another command had been the
    /// last.
    pub(super) fn put_in_step(&mut self) {
        for station in [1, 2, 9] {
            self.core.stations.with_in_step(station, |in_step| *in_step = InStep::trusted());
        }
    }

    pub(super) fn call<C: Command>(&mut self, station: u8, request: C) -> CallFuture<C> {
        self.call_with(station, request, CallOptions::new())
    }

    pub(super) fn call_with<C: Command>(&mut self, station: u8, request: C, options: CallOptions) -> CallFuture<C> {
        let meta = CallMeta {
            station,
            code: C::CODE,
            lane: options.lane(C::CODE.class()),
            deadline: later(self.now, options.call_timeout),
            queued_at: self.now,
            confirms: false,
            plain: request.plain(),
        };
        let response_timeout = options.response_timeout.unwrap_or(TIMEOUT);
        let sending = Sending { response_timeout, adaptive: options.adaptive, part: false };
        let (call, future) = call::new(request, meta, sending, &options);
        self.core.push(call, self.now);
        future
    }

    pub(super) fn next_action(&mut self) -> Action {
        match self.core.next_action(self.now) {
            // All data were read.
            Action::ReadAgain => self.core.next_action(self.now),
            action => action,
        }
    }

    /// Sends the next request and returns its command. Fails the test if nothing is to be sent.
    pub(super) fn expect_send(&mut self) -> Code {
        let action = self.next_action();
        assert!(matches!(action, Action::Send(_)), "{action:?}");
        self.sent = self.core.request_bytes().to_vec();
        self.core.sent(self.now);
        let code = match self.framing {
            Framing::Ascii => u8::from_str_radix(str::from_utf8(&self.sent[3..5]).unwrap(), 16).unwrap(),
            Framing::Binary => self.sent[5],
        };
        Code::from_u8(code).unwrap()
    }

    pub(super) fn advance(&mut self, time: Duration) {
        self.now += time;
    }

    pub(super) fn receive(&mut self, bytes: &[u8]) {
        self.core.receive_buffer().extend_from_slice(bytes);
        self.core.received(self.now);
    }

    /// Receives a frame from a PLC with this data.
    pub(super) fn receive_frame(&mut self, station: u8, command: u8, data: &[u8]) {
        let mut frame = BytesMut::new();
        match self.framing {
            Framing::Ascii => ascii::emit(&mut frame, station, command, |fields| fields.raw(data)),
            Framing::Binary => binary::emit(&mut frame, Side::Plc, station, command, |fields| fields.raw(data)),
        }
        self.receive(&frame);
    }

    pub(super) fn receive_reply<C: Command>(&mut self, station: u8, request: &C, reply: &C::Reply) {
        let mut frame = BytesMut::new();
        command::encode_reply(request, Ok(reply), self.framing, station, &mut frame);
        self.receive(&frame);
    }

    /// Receives the bytes sent last.
    pub(super) fn receive_echo(&mut self) {
        let request = self.sent.clone();
        self.receive(&request);
    }

    pub(super) fn stats(&self) -> LinkStats {
        self.stats.link_stats()
    }

    pub(super) fn station_stats(&self, station: u8) -> StationStats {
        self.stats.station_stats(station)
    }

    pub(super) fn station_state(&self, station: u8) -> StationState {
        *self.stats.watch_state(station).borrow()
    }
}
