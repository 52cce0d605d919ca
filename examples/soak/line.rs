//! One line: its PLCs, their faults and their server, and the link to them.

use std::path::PathBuf;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use fatek::command::Code;
use fatek::endpoint::SerialSettings;
use fatek::sim::{self, Bus, DisconnectAt, Fault, Faults, Model, Plc, Rule};
use fatek::wire::Framing;
use fatek::{Endpoint, ErrorCode, Link, LinkBuilder};
use tokio::sync::RwLock;

use crate::Result;
use crate::counters::Counters;
use crate::expected::ExpectedMemory;
use crate::layout::{self, Kind, Place};
use crate::options::Options;
use crate::rng::Rng;
use crate::server::PlcServer;

/// Transport of a line.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Transport {
    Tcp,
    Serial,
    Udp,
}

/// Transport and framing of the lines, in turn.
const KINDS: [(Transport, Framing); 6] = [
    (Transport::Tcp, Framing::Ascii),
    (Transport::Tcp, Framing::Binary),
    (Transport::Serial, Framing::Ascii),
    (Transport::Serial, Framing::Binary),
    (Transport::Udp, Framing::Ascii),
    (Transport::Udp, Framing::Binary),
];

/// `true` if there are serial ports, which are pseudo-terminals. macOS refuses their baud rate.
const HAS_SERIAL: bool = cfg!(all(target_os = "linux", feature = "serial"));

pub(crate) struct Line {
    pub(crate) number: usize,
    pub(crate) transport: Transport,
    pub(crate) framing: Framing,
    /// Number of callers, and of callers and guests; each owns its cells.
    pub(crate) callers: usize,
    pub(crate) owners: usize,
    /// Station numbers.
    pub(crate) stations: Vec<u8>,
    pub(crate) bus: Bus,
    pub(crate) faults: Faults,
    pub(crate) endpoint: Endpoint,
    pub(crate) link: Link,
    pub(crate) counters: Counters,
    /// Held for reading by each call, for writing by an audit.
    pub(crate) calls: RwLock<()>,
    expected: Mutex<ExpectedMemory>,
}

impl Line {
    /// Returns the line, and the server of its PLCs.
    pub(crate) async fn new(number: usize, options: &Options) -> Result<(Self, PlcServer)> {
        let mut rng = Rng::new(options.seed ^ (number as u64) << 32);
        let stations = options.stations;
        let (transport, framing) = match KINDS[number % KINDS.len()] {
            (Transport::Serial, framing) if !HAS_SERIAL => (Transport::Tcp, framing),
            kind => kind,
        };
        let numbers: Vec<u8> =
            (1..=stations as u8).map(|n| if n == stations as u8 { n + MISNUMBERED } else { n }).collect();
        let faults = faults(&numbers, transport, framing, rng.next_u64());
        let mut bus = Bus::new();
        for (station, &station_number) in numbers.iter().enumerate() {
            let plc = Plc::with_model(Model::largest().pages_while_running(true));
            layout::prepare_constants(&plc, number, station)?;
            for owner in 0..options.callers + options.guests {
                for kind in Kind::ALL {
                    Place { station, owner, kind }.prepare(&plc, number)?;
                }
            }
            bus = bus.with_station(station_number, plc)?;
        }
        let bus = bus.with_faults(faults.clone());
        let server = match transport {
            Transport::Tcp => PlcServer::tcp(bus.clone(), framing).await?,
            Transport::Udp => PlcServer::udp(bus.clone(), framing).await?,
            Transport::Serial => PlcServer::serial(bus.clone(), framing, path_of_port(number))?,
        };
        let endpoint = match transport {
            Transport::Tcp => Endpoint::from(server.address()?).with_framing(framing),
            Transport::Udp => Endpoint::udp("127.0.0.1", server.address()?.port()).with_framing(framing),
            Transport::Serial => {
                let port = path_of_port(number);
                let settings = SerialSettings::new(framing).with_baud(115_200)?;
                let path = port.to_str().ok_or("the path of the port is not UTF-8")?;
                Endpoint::serial(path).with_framing(framing).with_serial(settings)?
            }
        };
        let link = configure(Link::builder(endpoint.clone())).seed(rng.next_u64()).build();
        let line = Self {
            number,
            transport,
            framing,
            callers: options.callers,
            owners: options.callers + options.guests,
            stations: numbers,
            bus,
            faults,
            endpoint,
            link,
            counters: Counters::default(),
            calls: RwLock::new(()),
            expected: Mutex::new(ExpectedMemory::new(number, options.stations, options.callers + options.guests)),
        };
        Ok((line, server))
    }

    pub(crate) fn expected(&self) -> MutexGuard<'_, ExpectedMemory> {
        self.expected.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(crate) fn plc(&self, station: usize) -> Result<&Plc> {
        Ok(self.bus.plc(self.stations[station]).ok_or("the station has no PLC")?)
    }

    pub(crate) fn name(&self) -> String {
        format!("line {} ({:?}, {})", self.number, self.transport, self.framing)
    }

    /// Reports a wrong value or a wrong write, with the last requests to that station.
    pub(crate) fn wrong(&self, station: usize, error: &str) {
        let number = self.stations[station];
        let mut text = format!("{}, station {number}: {error}", self.name());
        let entries = self.faults.log().entries();
        let latest = entries.iter().rev().filter(|entry| entry.station() == Some(number)).take(6);
        for entry in latest.collect::<Vec<_>>().into_iter().rev() {
            let ago = entry.at.elapsed();
            let (executed, faults) = (entry.executed, &entry.faults);
            let answer = entry.answer.as_deref().unwrap_or_default().escape_ascii().to_string();
            let request = format!("{:?}", entry.request());
            text += &format!(
                "\n    {ago:.1?} ago: {request:.300}; executed: {executed}, {faults:?}, answer: {answer:.200}"
            );
        }
        self.counters.wrong(text);
    }
}

/// Settings of all links. The short timeouts cause many late replies.
pub(crate) fn configure(link: LinkBuilder) -> LinkBuilder {
    link.response_timeout(RESPONSE_TIMEOUT)
        .connect_backoff(Duration::from_millis(20), Duration::from_millis(500))
        .probe_interval(Duration::from_millis(50), Duration::from_millis(500))
}

pub(crate) const RESPONSE_TIMEOUT: Duration = Duration::from_millis(200);

/// Offset of the number of the last station, which sometimes replies with a wrong number.
///
/// The wrong number is that of no station: a reply that is late *and* has the number of another
/// station cannot be detected in this protocol, and on a busy machine any reply may be late.
const MISNUMBERED: u8 = 100;

/// Rules for all faults except refused loop-backs, without which a client depends on time. Here
/// time is not reliable.
fn faults(stations: &[u8], transport: Transport, framing: Framing, seed: u64) -> Faults {
    let ms = Duration::from_millis;
    let some = |fault: Fault, per_mille: u16| Rule::new(fault).per_mille(per_mille);
    let mut faults = Faults::new(seed)
        .log_capacity(256)
        .journal_capacity(100_000)
        .line(sim::Line::default().response_time(ms(0), ms(3)))
        .rule(some(Fault::Ignore, 4))
        .rule(some(Fault::DropReply, 4))
        .rule(some(Fault::Split { pieces: 3, pause: ms(4) }, 20))
        .rule(some(Fault::GarbageBefore { max_len: 40 }, 8))
        .rule(some(Fault::GarbageInside { max_len: 10 }, 4))
        .rule(some(Fault::WrongCommand, 3))
        // By 2: a page without one character would be valid in its other form, with all digits
        // shifted.
        .rule(some(Fault::Truncated { by: 2 }, 3))
        .rule(some(Fault::Extended { by: 4 }, 3))
        .rule(some(Fault::BadChecksum, 4))
        .rule(some(Fault::duplicate(), 8))
        .rule(some(Fault::Disconnect(DisconnectAt::BeforeExecution), 1))
        .rule(some(Fault::Disconnect(DisconnectAt::BeforeReply), 1))
        .rule(some(Fault::Disconnect(DisconnectAt::WithinReply), 1))
        .rule(some(Fault::Disconnect(DisconnectAt::AfterReply), 1))
        .rule(some(Fault::Refuse, 100))
        .rule(some(Fault::Error(ErrorCode::IllegalFormat), 10).command(Code::ReadRegisters))
        .rule(some(Fault::Error(ErrorCode::IllegalAddress), 10).command(Code::WriteRegisters));
    for (n, &station) in stations.iter().enumerate() {
        faults = if n + 1 == stations.len() {
            faults.rule(some(Fault::WrongStation, 20).station(station))
        } else {
            // Longer than the response timeout, most often for the first stations, which are called
            // most.
            let late = Fault::Delay { min: ms(210), max: ms(600) };
            let often = if n < OFTEN_LATE { 25 } else { 5 };
            faults
                .rule(some(late, often).station(station))
                .rule(some(Fault::Delay { min: ms(1), max: ms(30) }, 50).station(station))
        };
    }
    if transport == Transport::Serial && framing == Framing::Ascii {
        faults = faults.rule(Rule::new(Fault::Echo));
    }
    faults
}

/// Number of stations with many late replies.
pub(crate) const OFTEN_LATE: usize = 3;

fn path_of_port(number: usize) -> PathBuf {
    std::env::temp_dir().join(format!("fatek-soak-{}-{number}", std::process::id()))
}
