//! How well the link uses a line, in exact simulated time: the core on one end, the simulated PLCs on the other, and
//! between them a clock that this file turns.
//!
//! Tokio's timer counts whole milliseconds, which is too coarse for what is measured here.
#![allow(clippy::print_stdout, reason = "the figures are what it is for")]

mod costs;

use std::collections::BTreeMap;
use std::pin::{Pin, pin};
use std::sync::Arc;
use std::task::{Context, Poll, Waker};
use std::time::Duration;

use bytes::{Bytes, BytesMut};
use tokio::time::Instant;
use tokio_util::codec::Decoder;

use super::call::{self, Completion, Spares, Terms};
use super::config::Config;
use super::core::{Core, Step};
use super::in_step::{Proof, Shape};
use super::options::CallOptions;
use super::stats::{Board, StationState};
use super::transport::Connector;
use super::{LinkBuilder, later};
use crate::command::{Command, ReadRegisters, Spelling};
use crate::element::Register;
use crate::error::Error;
use crate::sim::{Bus, Fault, Faults, Line, Output, Plc, Rule, Session};
use crate::wire::{Codec, Framing, Side};

const STATIONS: u8 = 32;
/// How long the PLC takes before it answers.
pub(crate) const TURNAROUND: Duration = Duration::from_millis(5);

/// A line with stations on it, each of which is asked for as many registers as one request can, over and over; or for
/// whatever [`call`](Self::call) asks, one request after the other.
pub(crate) struct World {
    pub(crate) now: Instant,
    core: Core,
    board: Arc<Board>,
    session: Session,
    codec: Codec,
    line: Line,
    pending: Vec<(u8, Completion<ReadRegisters<Register>>)>,
    answered: BTreeMap<u8, u32>,
    /// How long the line and the PLCs were at work.
    busy: Duration,
}

impl World {
    fn new(framing: Framing, baud: u32, dead: &[u8]) -> Self {
        let mut bus = Bus::new();
        for station in 1..=STATIONS {
            bus = bus.with_station(station, Plc::new()).unwrap();
        }
        Self::on(bus, framing, baud, dead)
    }

    /// A line with these stations on it.
    pub(crate) fn on(bus: Bus, framing: Framing, baud: u32, dead: &[u8]) -> Self {
        Self::with(bus, framing, baud, dead, |_| ())
    }

    fn with(bus: Bus, framing: Framing, baud: u32, dead: &[u8], set: impl FnOnce(&mut Config)) -> Self {
        let line = Line::new(baud).response_time(TURNAROUND, TURNAROUND);
        let mut faults = Faults::new(1).line(line);
        for &station in dead {
            faults = faults.rule(Rule::new(Fault::Ignore).station(station));
        }
        let bus = bus.with_faults(faults);
        let conditions = bus.conditions().cloned().unwrap();
        let session = Session::new(bus, conditions, framing);
        // As for a serial line, but for the gap, which is the adapter's.
        let mut config = LinkBuilder::with_connector(Connector::Once(None), framing, "a line").config;
        config.frame_time = line.transmission(1024);
        config.probe_timeout = RESPONSE_TIMEOUT;
        if baud > 0 {
            config.byte_time = line.transmission(1);
        }
        set(&mut config);
        let board = Arc::new(Board::default());
        let core = Core::new(config, board.clone(), 1);
        let codec = Codec::new(framing, Side::Plc);
        let now = Instant::now();
        Self {
            now,
            core,
            board,
            session,
            codec,
            line,
            pending: Vec::new(),
            answered: BTreeMap::new(),
            busy: Duration::ZERO,
        }
    }

    /// Asks every station at all times, for this long.
    fn run(&mut self, time: Duration) {
        self.core.connected(self.now);
        for station in 1..=STATIONS {
            self.ask(station);
        }
        self.run_on(time);
    }

    /// Goes on for this long.
    fn run_on(&mut self, time: Duration) {
        let end = later(self.now, time);
        while self.now < end {
            match self.core.step(self.now) {
                Step::Connect => self.core.connected(self.now),
                Step::Disconnect => unreachable!("there is no idle timeout"),
                Step::Send(_) => self.send(),
                Step::Wait(until) => self.wait(until.unwrap_or(end).min(end)),
            }
            self.collect();
        }
    }

    /// Asks one thing, and turns the clock until the reply is there.
    pub(crate) fn call<C: Command>(&mut self, station: u8, request: C) -> Result<C::Reply, Error> {
        let completion = self.push(station, request);
        self.finish(completion).0
    }

    /// The same for a call that is under way; with its result, what a job must know of it.
    fn finish<C: Command>(&mut self, completion: Completion<C>) -> (Result<C::Reply, Error>, Spelling, Shape, Proof) {
        let mut completion = pin!(completion);
        let mut context = Context::from_waker(Waker::noop());
        loop {
            if let Poll::Ready(result) = completion.as_mut().poll(&mut context) {
                return (result, completion.spelling(), completion.shape(self.codec.framing()), completion.proof());
            }
            match self.core.step(self.now) {
                Step::Connect => self.core.connected(self.now),
                Step::Disconnect => unreachable!("there is no idle timeout"),
                Step::Send(_) => self.send(),
                // A confirmation may need nothing.
                Step::Wait(None) => {}
                Step::Wait(Some(until)) => self.wait(until),
            }
        }
    }

    /// How long so many bytes take on the line.
    pub(crate) fn transmission(&self, bytes: usize) -> Duration {
        self.line.transmission(bytes)
    }

    fn ask(&mut self, station: u8) {
        let completion = self.push(station, ReadRegisters::new(Register::r(0), 64).unwrap());
        self.pending.push((station, completion));
    }

    fn push<C: Command>(&mut self, station: u8, request: C) -> Completion<C> {
        self.push_as(station, request, None, false)
    }

    fn push_as<C: Command>(
        &mut self,
        station: u8,
        request: C,
        confirms: Option<C::Reply>,
        longer: bool,
    ) -> Completion<C> {
        let options = CallOptions::new().call_timeout(Duration::from_secs(3600)).retries(2);
        let terms = Terms {
            station,
            code: C::CODE,
            lane: options.lane(C::CODE.class()),
            deadline: later(self.now, options.call_timeout),
            queued_at: self.now,
            response_timeout: RESPONSE_TIMEOUT,
            options,
            longer,
            confirms: confirms.is_some(),
        };
        let (mut ticket, completion) = call::new(request, confirms, terms, &Spares::default());
        ticket.retries_left = 2;
        self.core.push(ticket, self.now);
        completion
    }

    fn send(&mut self) {
        let bytes = Bytes::copy_from_slice(self.core.outgoing());
        let item = self.codec.decode(&mut BytesMut::from(&bytes[..])).unwrap().unwrap();
        let takes = self.line.transmission(bytes.len());
        self.busy += takes;
        self.session.receive(item, bytes, self.now);
        self.core.sent(self.now + takes);
    }

    /// Turns the clock to the next thing that happens, but not past that time.
    fn wait(&mut self, until: Instant) {
        let due = self.session.due().filter(|&due| due <= until);
        self.now = self.now.max(due.unwrap_or(until));
        while let Some(Output::Bytes(bytes)) = self.session.next_output(self.now) {
            self.busy += self.line.transmission(bytes.len()) + TURNAROUND;
            self.core.incoming().extend_from_slice(&bytes);
            self.core.received(self.now);
        }
    }

    /// Takes the results, and asks again, unless the station is offline: then a call would fail at once.
    fn collect(&mut self) {
        let mut done = Vec::new();
        let mut context = Context::from_waker(Waker::noop());
        self.pending.retain_mut(|(station, completion)| match Pin::new(completion).poll(&mut context) {
            Poll::Pending => true,
            Poll::Ready(result) => {
                done.push((*station, result.is_ok()));
                false
            }
        });
        for (station, ok) in done {
            *self.answered.entry(station).or_default() += u32::from(ok);
            if !matches!(*self.board.watch(station).borrow(), StationState::Offline { .. }) {
                self.ask(station);
            }
        }
    }

    /// Answers of all stations but this one.
    fn answers_but_of(&self, station: Option<u8>) -> u32 {
        self.answered.iter().filter(|(number, _)| Some(**number) != station).map(|(_, count)| count).sum()
    }
}

const RESPONSE_TIMEOUT: Duration = Duration::from_millis(300);

#[test]
fn the_line_is_used_to_98_percent_of_what_bytes_and_turnaround_allow() {
    for framing in [Framing::Ascii, Framing::Binary] {
        for baud in [9600, 115_200] {
            let mut world = World::new(framing, baud, &[]);
            let time = Duration::from_secs(300);
            world.run(time);
            let used = world.busy.as_secs_f64() / time.as_secs_f64();
            println!("{framing}, {baud} baud: the line is used to {:.2} %", 100.0 * used);
            // The last exchange may end behind the time.
            assert!((0.98..1.001).contains(&used), "{framing}, {baud} baud: {used}");
            let (fewest, most) = (world.answered.values().min().unwrap(), world.answered.values().max().unwrap());
            assert!(most - fewest <= 1, "all are served alike: {fewest} to {most}");
        }
    }
}

#[test]
fn one_dead_station_of_32_costs_the_others_less_than_3_percent() {
    for framing in [Framing::Ascii, Framing::Binary] {
        for baud in [9600, 115_200] {
            let time = Duration::from_secs(300);
            let mut healthy = World::new(framing, baud, &[]);
            healthy.run(time);
            let mut sick = World::new(framing, baud, &[7]);
            sick.run(time);
            // With all alive, 31 stations share 31/32 of the line: compare what is theirs.
            let (before, after) = (healthy.answers_but_of(Some(7)), sick.answers_but_of(Some(7)));
            let loss = 1.0 - f64::from(after) / f64::from(before);
            // Without the dead one there is a share more for each of the others; that must not hide what it costs.
            let possible = f64::from(before) * f64::from(STATIONS) / f64::from(STATIONS - 1);
            let loss_of_possible = 1.0 - f64::from(after) / possible;
            println!(
                "{framing}, {baud} baud: the 31 lose {:.2} % of what they had, {:.2} % of what they could have",
                100.0 * loss,
                100.0 * loss_of_possible
            );
            assert!(loss < 0.03, "{framing}, {baud} baud: {loss}");
            assert!(loss_of_possible < 0.03, "{framing}, {baud} baud: {loss_of_possible}");
        }
    }
}

#[test]
fn probes_use_at_most_5_percent_of_the_line_however_many_stations_are_dead() {
    let dead: Vec<u8> = (1..STATIONS).collect();
    let mut world = World::new(Framing::Ascii, 9600, &dead);
    // The first minute is what it takes to find out that they are dead: three timeouts each.
    world.run(Duration::from_secs(60));
    let probes = |world: &World| dead.iter().map(|&station| world.board.station(station).checks).sum::<u64>();
    let before = probes(&world);
    let time = Duration::from_secs(600);
    world.run_on(time);
    let count = probes(&world) - before;
    let used = count as f64 * RESPONSE_TIMEOUT.as_secs_f64() / time.as_secs_f64();
    println!("{count} probes of {} dead stations use {:.2} % of the line", dead.len(), 100.0 * used);
    assert!((0.005..0.05).contains(&used), "{used}");
    assert!(world.answered[&STATIONS] > 0);
}
