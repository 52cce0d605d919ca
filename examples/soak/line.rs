//! One line: its PLCs, what goes wrong with them, where they are, and the link to them.

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
use crate::dice::Dice;
use crate::ends::End;
use crate::layout::{self, Kind, Place};
use crate::options::Options;
use crate::shadow::Shadow;
use crate::tally::Tally;

/// What a line goes over.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Over {
    Tcp,
    Serial,
    Udp,
}

/// What the lines are, as often as it takes.
const KINDS: [(Over, Framing); 6] = [
    (Over::Tcp, Framing::Ascii),
    (Over::Tcp, Framing::Binary),
    (Over::Serial, Framing::Ascii),
    (Over::Serial, Framing::Binary),
    (Over::Udp, Framing::Ascii),
    (Over::Udp, Framing::Binary),
];

/// A serial port is a pseudo-terminal here. macOS refuses a baud rate for them.
const HAS_SERIAL: bool = cfg!(all(target_os = "linux", feature = "serial"));

pub(crate) struct Line {
    pub(crate) number: usize,
    pub(crate) over: Over,
    pub(crate) framing: Framing,
    /// How many callers the line has, and how many with the guests: each owns its cells.
    pub(crate) callers: usize,
    pub(crate) owners: usize,
    /// The stations' numbers.
    pub(crate) stations: Vec<u8>,
    pub(crate) bus: Bus,
    pub(crate) faults: Faults,
    pub(crate) endpoint: Endpoint,
    pub(crate) link: Link,
    pub(crate) tally: Tally,
    /// Held for reading by each call, for writing by an audit.
    pub(crate) calls: RwLock<()>,
    shadow: Mutex<Shadow>,
}

impl Line {
    /// The line, and the end that its PLCs are to be served at.
    pub(crate) async fn new(number: usize, options: &Options) -> Result<(Self, End)> {
        let mut dice = Dice::new(options.seed ^ (number as u64) << 32);
        let stations = options.stations;
        let (over, framing) = match KINDS[number % KINDS.len()] {
            (Over::Serial, framing) if !HAS_SERIAL => (Over::Tcp, framing),
            kind => kind,
        };
        let numbers: Vec<u8> =
            (1..=stations as u8).map(|n| if n == stations as u8 { n + MISNUMBERED } else { n }).collect();
        let faults = faults(&numbers, over, framing, dice.roll());
        let mut bus = Bus::new();
        for (station, &station_number) in numbers.iter().enumerate() {
            let plc = Plc::with_model(Model::default().pages_while_running(true));
            layout::prepare_constants(&plc, number, station)?;
            for owner in 0..options.callers + options.guests {
                for kind in Kind::ALL {
                    Place { station, owner, kind }.prepare(&plc, number)?;
                }
            }
            bus = bus.with_station(station_number, plc)?;
        }
        let bus = bus.with_faults(faults.clone());
        let end = match over {
            Over::Tcp => End::tcp(bus.clone(), framing).await?,
            Over::Udp => End::udp(bus.clone(), framing).await?,
            Over::Serial => End::serial(bus.clone(), framing, path_of_port(number))?,
        };
        let endpoint = match over {
            Over::Tcp => Endpoint::from(end.address()?).with_framing(framing),
            Over::Udp => Endpoint::udp("127.0.0.1", end.address()?.port()).with_framing(framing),
            Over::Serial => {
                let port = path_of_port(number);
                let settings = SerialSettings::new(framing).with_baud(115_200)?;
                let path = port.to_str().ok_or("the path of the port is no text")?;
                Endpoint::serial(path).with_framing(framing).with_serial(settings)?
            }
        };
        let link = configure(Link::builder(endpoint.clone())).seed(dice.roll()).build();
        let line = Self {
            number,
            over,
            framing,
            callers: options.callers,
            owners: options.callers + options.guests,
            stations: numbers,
            bus,
            faults,
            endpoint,
            link,
            tally: Tally::default(),
            calls: RwLock::new(()),
            shadow: Mutex::new(Shadow::new(number, options.stations, options.callers + options.guests)),
        };
        Ok((line, end))
    }

    pub(crate) fn shadow(&self) -> MutexGuard<'_, Shadow> {
        self.shadow.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(crate) fn plc(&self, station: usize) -> Result<&Plc> {
        Ok(self.bus.plc(self.stations[station]).ok_or("every station has a PLC")?)
    }

    pub(crate) fn name(&self) -> String {
        format!("line {} ({:?}, {})", self.number, self.over, self.framing)
    }

    /// A value that cannot be, or a write that went wrong; and what the PLCs have last heard of that station.
    pub(crate) fn wrong(&self, station: usize, what: &str) {
        let number = self.stations[station];
        let mut text = format!("{}, station {number}: {what}", self.name());
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
        self.tally.wrong(text);
    }
}

/// How all links to the lines are set. Impatient, so that there are many late replies.
pub(crate) fn configure(link: LinkBuilder) -> LinkBuilder {
    link.response_timeout(RESPONSE_TIMEOUT)
        .connect_backoff(Duration::from_millis(20), Duration::from_millis(500))
        .probe_interval(Duration::from_millis(50), Duration::from_millis(500))
}

pub(crate) const RESPONSE_TIMEOUT: Duration = Duration::from_millis(200);

/// The last station of a line sometimes answers under the next number, which is nobody's: a reply that is late *and* under
/// the number of another station is beyond what a client of this protocol can tell, and on a busy machine any reply is late
/// now and then.
const MISNUMBERED: u8 = 100;

/// Faults of every kind, but for refused loop-backs: without them a client has to rely on time, and here time is no measure.
fn faults(stations: &[u8], over: Over, framing: Framing, seed: u64) -> Faults {
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
        // A page that lacks one character is one in the other of its two forms, with every digit in the wrong place.
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
            // Later than anybody waits; most of all the first few, which are asked most.
            let late = Fault::Delay { min: ms(210), max: ms(600) };
            let often = if n < OFTEN_LATE { 25 } else { 5 };
            faults
                .rule(some(late, often).station(station))
                .rule(some(Fault::Delay { min: ms(1), max: ms(30) }, 50).station(station))
        };
    }
    if over == Over::Serial && framing == Framing::Ascii {
        faults = faults.rule(Rule::new(Fault::Echo));
    }
    faults
}

/// How many stations are often late.
pub(crate) const OFTEN_LATE: usize = 3;

fn path_of_port(number: usize) -> PathBuf {
    std::env::temp_dir().join(format!("fatek-soak-{}-{number}", std::process::id()))
}
