//! A link without its driver: the test does what the driver does, and turns the clock.

use std::pin::pin;
use std::sync::Arc;
use std::task::{Context, Poll, Waker};
use std::time::Duration;

use bytes::BytesMut;
use tokio::time::Instant;

use super::super::{Core, Step};
use crate::command::{self, Code, Command, ReadRegisters, WriteRegisters};
use crate::element::Register;
use crate::error::Error;
use crate::link::call::{self, Completion, Spares, Terms};
use crate::link::config::Config;
use crate::link::in_step::InStep;
use crate::link::options::CallOptions;
use crate::link::stats::{Board, LinkStats, StationStats};
use crate::link::transport::Connector;
use crate::link::{LinkBuilder, later};
use crate::wire::{FieldWriter as _, Framing, Side, ascii, binary};

pub(super) const MS: Duration = Duration::from_millis(1);
pub(super) const TIMEOUT: Duration = Duration::from_millis(100);

/// A link without its driver.
pub(super) struct Desk {
    pub(super) core: Core,
    board: Arc<Board>,
    framing: Framing,
    pub(super) now: Instant,
    /// What was sent last.
    pub(super) sent: Vec<u8>,
}

type Read = ReadRegisters<Register>;

pub(super) fn read(count: usize) -> Read {
    ReadRegisters::new(Register::r(0), count).unwrap()
}

pub(super) fn write() -> WriteRegisters<Register> {
    WriteRegisters::new(Register::r(0), [1]).unwrap()
}

pub(super) fn result<C: Command>(completion: &mut Completion<C>) -> Option<Result<C::Reply, Error>> {
    match pin!(completion).poll(&mut Context::from_waker(Waker::noop())) {
        Poll::Ready(result) => Some(result),
        Poll::Pending => None,
    }
}

impl Desk {
    pub(super) fn new(framing: Framing) -> Self {
        Self::with(framing, |_| ())
    }

    /// With its connection open.
    pub(super) fn with(framing: Framing, set: impl FnOnce(&mut Config)) -> Self {
        let mut config = LinkBuilder::with_connector(Connector::Once(None), framing, "desk").config;
        config.probe_timeout = TIMEOUT;
        config.in_step = config.in_step.with_quiet(TIMEOUT);
        set(&mut config);
        let board = Arc::new(Board::default());
        let mut desk =
            Self { core: Core::new(config, board.clone(), 1), board, framing, now: Instant::now(), sent: Vec::new() };
        desk.core.connected(desk.now);
        desk.trust();
        desk
    }

    /// Puts the stations of these tests in step, as if an exchange of another command had been the last.
    pub(super) fn trust(&mut self) {
        for station in [1, 2, 9] {
            self.core.stations.with_in_step(station, |known| *known = InStep::trusted());
        }
    }

    pub(super) fn ask<C: Command>(&mut self, station: u8, request: C) -> Completion<C> {
        self.ask_with(station, request, CallOptions::new())
    }

    pub(super) fn ask_with<C: Command>(&mut self, station: u8, request: C, options: CallOptions) -> Completion<C> {
        let terms = Terms {
            station,
            code: C::CODE,
            lane: options.lane(C::CODE.class()),
            deadline: later(self.now, options.call_timeout),
            queued_at: self.now,
            response_timeout: options.response_timeout.unwrap_or(TIMEOUT),
            options,
            longer: false,
            confirms: false,
        };
        let (ticket, completion) = call::new(request, None, terms, &Spares::default());
        self.core.push(ticket, self.now);
        completion
    }

    pub(super) fn step(&mut self) -> Step {
        self.core.step(self.now)
    }

    /// What is sent now; the test fails if it is nothing.
    pub(super) fn sends(&mut self) -> Code {
        let step = self.step();
        assert!(matches!(step, Step::Send(_)), "{step:?}");
        self.sent = self.core.outgoing().to_vec();
        self.core.sent(self.now);
        let code = match self.framing {
            Framing::Ascii => u8::from_str_radix(str::from_utf8(&self.sent[3..5]).unwrap(), 16).unwrap(),
            Framing::Binary => self.sent[5],
        };
        Code::from_u8(code).unwrap()
    }

    pub(super) fn passes(&mut self, time: Duration) {
        self.now += time;
    }

    pub(super) fn hears(&mut self, bytes: &[u8]) {
        self.core.incoming().extend_from_slice(bytes);
        self.core.received(self.now);
    }

    /// A frame from a PLC with this data.
    pub(super) fn hears_frame(&mut self, station: u8, command: u8, data: &[u8]) {
        let mut frame = BytesMut::new();
        match self.framing {
            Framing::Ascii => ascii::emit(&mut frame, station, command, |fields| fields.raw(data)),
            Framing::Binary => binary::emit(&mut frame, Side::Plc, station, command, |fields| fields.raw(data)),
        }
        self.hears(&frame);
    }

    pub(super) fn hears_reply<C: Command>(&mut self, station: u8, request: &C, reply: &C::Reply) {
        let mut frame = BytesMut::new();
        command::encode_reply(request, Ok(reply), self.framing, station, &mut frame);
        self.hears(&frame);
    }

    /// The station sends back what was sent last.
    pub(super) fn hears_echo(&mut self) {
        let request = self.sent.clone();
        self.hears(&request);
    }

    pub(super) fn stats(&self) -> LinkStats {
        self.board.link()
    }

    pub(super) fn stats_of(&self, station: u8) -> StationStats {
        self.board.station(station)
    }
}
