//! Measures how well the link uses a line, in exact simulated time: the core on one end, simulated
//! PLCs on the other, and a simulated clock.
//!
//! Tokio's timer counts whole milliseconds, which is too coarse here.
#![allow(clippy::print_stdout, reason = "prints figures")]

mod costs;
mod gaps;

use std::collections::BTreeMap;
use std::pin::{Pin, pin};
use std::sync::Arc;
use std::task::{Context, Poll, Waker};
use std::time::Duration;

use bytes::{Bytes, BytesMut};
use tokio::time::Instant;
use tokio_util::codec::Decoder;

use super::call::{self, CallFuture, CallMeta, Sending};
use super::config::Config;
use super::connector::Connector;
use super::core::{Action, Core};
use super::in_step::{Proof, Shape};
use super::options::CallOptions;
use super::stats::{SharedStats, StationState};
use super::{LinkBuilder, Purpose, later};
use crate::command::{Command, ReadRegisters, Spelling};
use crate::element::Register;
use crate::error::Error;
use crate::sim::{Bus, Fault, Faults, Line, Output, Plc, Rule, Session};
use crate::wire::{Codec, Framing, Side};

const STATIONS: u8 = 32;
/// The response time of the PLCs.
pub(crate) const RESPONSE_TIME: Duration = Duration::from_millis(5);

/// A line with stations. [`run`](Self::run) keeps a read of 64 registers pending at each of them;
/// [`call`](Self::call) makes one call.
pub(crate) struct World {
    pub(crate) now: Instant,
    core: Core,
    stats: Arc<SharedStats>,
    session: Session,
    codec: Codec,
    line: Line,
    pending: Vec<(u8, CallFuture<ReadRegisters<Register>>)>,
    answered: BTreeMap<u8, u32>,
    /// How long the line and the PLCs were busy.
    busy: Duration,
    /// Number of stations, and of registers in each of their reads.
    stations: u8,
    registers: usize,
    /// The next reply of this station is lost.
    loses_reply_of: Option<u8>,
    /// When each station was answered last, and the longest time between two of its replies.
    answered_at: BTreeMap<u8, Instant>,
    longest_gaps: BTreeMap<u8, Duration>,
}

impl World {
    fn new(framing: Framing, baud: u32, dead: &[u8]) -> Self {
        let mut bus = Bus::new();
        for station in 1..=STATIONS {
            bus = bus.with_station(station, Plc::new()).unwrap();
        }
        Self::on(bus, framing, baud, dead)
    }

    /// A line with these stations.
    pub(crate) fn on(bus: Bus, framing: Framing, baud: u32, dead: &[u8]) -> Self {
        Self::with(bus, framing, baud, dead, |_| ())
    }

    fn with(bus: Bus, framing: Framing, baud: u32, dead: &[u8], set: impl FnOnce(&mut Config)) -> Self {
        Self::on_line(bus, framing, Line::new(baud).response_time(RESPONSE_TIME, RESPONSE_TIME), dead, set)
    }

    fn on_line(bus: Bus, framing: Framing, line: Line, dead: &[u8], set: impl FnOnce(&mut Config)) -> Self {
        let mut faults = Faults::new(1).line(line);
        for &station in dead {
            faults = faults.rule(Rule::new(Fault::Ignore).station(station));
        }
        let bus = bus.with_faults(faults);
        let conditions = bus.conditions().cloned().unwrap();
        let session = Session::new(bus, conditions, framing);
        // As for a serial line, except for the frame gap, which is that of the adapter.
        let mut config = LinkBuilder::with_connector(Connector::Once(None), framing, "a line").config;
        config.frame_time = line.transmission(1024);
        config.response_timeout = RESPONSE_TIMEOUT;
        config.mute_timeout = None;
        if !line.transmission(1).is_zero() {
            config.byte_time = line.transmission(1);
        }
        set(&mut config);
        let stats = Arc::new(SharedStats::default());
        let core = Core::new(config.into(), "a line".into(), stats.clone(), 1);
        let codec = Codec::new(framing, Side::Plc);
        let now = Instant::now();
        Self {
            now,
            core,
            stats,
            session,
            codec,
            line,
            pending: Vec::new(),
            answered: BTreeMap::new(),
            busy: Duration::ZERO,
            stations: STATIONS,
            registers: 64,
            loses_reply_of: None,
            answered_at: BTreeMap::new(),
            longest_gaps: BTreeMap::new(),
        }
    }

    /// Keeps a read pending at every station for this time.
    fn run(&mut self, time: Duration) {
        self.core.connected(self.now);
        for station in 1..=self.stations {
            self.ask(station);
        }
        self.run_on(time);
    }

    /// Continues for this time.
    fn run_on(&mut self, time: Duration) {
        let end = later(self.now, time);
        while self.now < end {
            match self.core.next_action(self.now) {
                Action::Connect => self.core.connected(self.now),
                Action::Disconnect | Action::Replace(_) => unreachable!("there is no idle timeout, nor a mute one"),
                Action::ReadAgain => {}
                Action::Send(_) => self.send(),
                Action::Wait(until) => self.wait(until.unwrap_or(end).min(end)),
            }
            self.collect();
        }
    }

    /// Makes a call, and advances the clock until it has ended.
    pub(crate) fn call<C: Command>(&mut self, station: u8, request: C) -> Result<C::Reply, Error> {
        let future = self.push(station, request);
        self.finish(future).0
    }

    /// Advances the clock until a call has ended. Returns its result, and what a job needs of it.
    fn finish<C: Command>(&mut self, future: CallFuture<C>) -> (Result<C::Reply, Error>, Spelling, Shape, Proof) {
        let mut future = pin!(future);
        let mut context = Context::from_waker(Waker::noop());
        loop {
            if let Poll::Ready(result) = future.as_mut().poll(&mut context) {
                return (result, future.spelling(), future.shape(self.codec.framing()), future.proof());
            }
            match self.core.next_action(self.now) {
                Action::Connect => self.core.connected(self.now),
                Action::Disconnect | Action::Replace(_) => unreachable!("there is no idle timeout, nor a mute one"),
                Action::ReadAgain => {}
                Action::Send(_) => self.send(),
                // A confirmation may need no check.
                Action::Wait(None) => {}
                Action::Wait(Some(until)) => self.wait(until),
            }
        }
    }

    /// Transmission time of a number of bytes.
    pub(crate) fn transmission(&self, bytes: usize) -> Duration {
        self.line.transmission(bytes)
    }

    fn ask(&mut self, station: u8) {
        let future = self.push(station, ReadRegisters::new(Register::r(0), self.registers).unwrap());
        self.pending.push((station, future));
    }

    fn push<C: Command>(&mut self, station: u8, request: C) -> CallFuture<C> {
        self.push_as(station, request, Purpose::Whole)
    }

    fn push_as<C: Command>(&mut self, station: u8, request: C, purpose: Purpose) -> CallFuture<C> {
        let options = CallOptions::new().with_call_timeout(Duration::from_secs(3600)).with_retries(2);
        let meta = CallMeta {
            station,
            code: C::CODE,
            lane: options.lane(C::CODE.class()),
            deadline: later(self.now, options.call_timeout),
            queued_at: self.now,
            confirms: purpose == Purpose::Confirm,
            plain: request.plain(),
        };
        let sending =
            Sending { response_timeout: RESPONSE_TIMEOUT, adaptive: options.adaptive, part: purpose == Purpose::Part };
        let (mut call, future) = call::new(request, meta, sending, &options);
        call.retries_left = 2;
        self.core.push(call, self.now);
        future
    }

    fn send(&mut self) {
        let bytes = Bytes::copy_from_slice(self.core.request_bytes());
        let item = self.codec.decode(&mut BytesMut::from(&bytes[..])).unwrap().unwrap();
        let takes = self.line.transmission(bytes.len());
        self.busy += takes;
        self.session.receive(item, bytes, self.now);
        self.core.sent(self.now + takes);
    }

    /// Advances the clock to the next event, but not beyond `until`.
    fn wait(&mut self, until: Instant) {
        let due = self.session.due().filter(|&due| due <= until);
        self.now = self.now.max(due.unwrap_or(until));
        while let Some(Output::Bytes(bytes)) = self.session.next_output(self.now) {
            self.busy += self.line.transmission(bytes.len()) + RESPONSE_TIME;
            let station = str::from_utf8(bytes.get(1..3).unwrap_or_default()).ok();
            let station = station.and_then(|digits| u8::from_str_radix(digits, 16).ok());
            if self.loses_reply_of.is_some() && station == self.loses_reply_of {
                self.loses_reply_of = None;
                continue;
            }
            self.core.receive_buffer().extend_from_slice(&bytes);
            self.core.received(self.now);
        }
    }

    /// Takes the results and makes the next reads, except at offline stations, where a call fails
    /// at once.
    fn collect(&mut self) {
        let mut done = Vec::new();
        let mut context = Context::from_waker(Waker::noop());
        self.pending.retain_mut(|(station, future)| match Pin::new(future).poll(&mut context) {
            Poll::Pending => true,
            Poll::Ready(result) => {
                done.push((*station, result.is_ok()));
                false
            }
        });
        for (station, ok) in done {
            *self.answered.entry(station).or_default() += u32::from(ok);
            if ok && let Some(before) = self.answered_at.insert(station, self.now) {
                let gap = self.longest_gaps.entry(station).or_default();
                *gap = (*gap).max(self.now.duration_since(before));
            }
            if !matches!(*self.stats.watch_state(station).borrow(), StationState::Offline { .. }) {
                self.ask(station);
            }
        }
    }

    /// Number of replies of all stations but this one.
    fn answers_but_of(&self, station: Option<u8>) -> u32 {
        self.answered.iter().filter(|(number, _)| Some(**number) != station).map(|(_, count)| count).sum()
    }
}

const RESPONSE_TIMEOUT: Duration = Duration::from_millis(300);

#[test]
fn the_line_and_the_plcs_are_busy_98_percent_of_the_time() {
    for framing in [Framing::Ascii, Framing::Binary] {
        for baud in [9600, 115_200] {
            let mut world = World::new(framing, baud, &[]);
            let time = Duration::from_secs(300);
            world.run(time);
            let used = world.busy.as_secs_f64() / time.as_secs_f64();
            println!("{framing}, {baud} baud: the line is busy {:.2} % of the time", 100.0 * used);
            // The last exchange may end after the time.
            assert!((0.98..1.001).contains(&used), "{framing}, {baud} baud: {used}");
            let load = world.stats.link_stats().bus_time.as_secs_f64() / time.as_secs_f64();
            assert!((used - load).abs() < 0.001, "{framing}, {baud} baud: {used} is counted as {load}");
            let (fewest, most) = (world.answered.values().min().unwrap(), world.answered.values().max().unwrap());
            assert!(most - fewest <= 1, "stations were served unequally: {fewest} to {most}");
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
            // With all alive, 31 stations share 31/32 of the line: compare their part.
            let (before, after) = (healthy.answers_but_of(Some(7)), sick.answers_but_of(Some(7)));
            let loss = 1.0 - f64::from(after) / f64::from(before);
            // Without the dead station the others could have its share, too; that must not hide its
            // cost.
            let possible = f64::from(before) * f64::from(STATIONS) / f64::from(STATIONS - 1);
            let loss_of_possible = 1.0 - f64::from(after) / possible;
            println!(
                "{framing}, {baud} baud: the 31 lose {:.2} % of their replies, {:.2} % of those possible without it",
                100.0 * loss,
                100.0 * loss_of_possible
            );
            assert!(loss < 0.03, "{framing}, {baud} baud: {loss}");
            assert!(loss_of_possible < 0.03, "{framing}, {baud} baud: {loss_of_possible}");
        }
    }
}

#[test]
fn probes_of_31_dead_stations_use_at_most_5_percent_of_the_line() {
    let dead: Vec<u8> = (1..STATIONS).collect();
    let mut world = World::new(Framing::Ascii, 9600, &dead);
    // The first minute includes the three timeouts after which each is offline.
    world.run(Duration::from_secs(60));
    let probes = |world: &World| dead.iter().map(|&station| world.stats.station_stats(station).checks).sum::<u64>();
    let before = probes(&world);
    let time = Duration::from_secs(600);
    world.run_on(time);
    let count = probes(&world) - before;
    let used = count as f64 * RESPONSE_TIMEOUT.as_secs_f64() / time.as_secs_f64();
    println!("{count} probes of {} dead stations use {:.2} % of the line", dead.len(), 100.0 * used);
    assert!((0.005..0.05).contains(&used), "{used}");
    assert!(world.answered[&STATIONS] > 0);
}

/// Every station is read without a pause, and one reply is lost once.
///
/// Before: the station paid for the timeout with its next turns. Its calls failed after their
/// deadline of 10 s, and a poller had no good sample of it for 35 s.
#[test]
fn a_station_that_lost_one_reply_is_read_again_within_about_one_round() {
    for (registers, baud) in [(1, 9600), (64, 9600), (1, 115_200), (64, 115_200)] {
        let mut bus = Bus::new();
        for station in 1..STATIONS {
            bus = bus.with_station(station, Plc::new()).unwrap();
        }
        let mut world = World::on(bus, Framing::Ascii, baud, &[]);
        world.registers = registers;
        world.stations = STATIONS - 1;
        world.run(Duration::from_secs(30));
        // The time of a round, and the longest time between two replies of a station in it.
        world.longest_gaps.clear();
        world.run_on(Duration::from_secs(30));
        let round = world.longest_gaps.values().copied().max().unwrap();
        world.loses_reply_of = Some(7);
        world.longest_gaps.clear();
        world.run_on(Duration::from_secs(60));
        assert_eq!(world.loses_reply_of, None, "a reply was lost");
        let gap = world.longest_gaps[&7];
        println!("{registers} registers, {baud} baud: round {round:?}, without a reply for {gap:?}");
        // The round in which it was lost, the timeout, and the round until it is next.
        assert!(
            gap <= round * 3 + RESPONSE_TIMEOUT * 2,
            "{registers} registers, {baud} baud: {gap:?}, round {round:?}"
        );
        let others =
            world.longest_gaps.iter().filter(|(station, _)| **station != 7).map(|(_, gap)| *gap).max().unwrap();
        assert!(others <= round + RESPONSE_TIMEOUT * 2, "{others:?}");
    }
}
