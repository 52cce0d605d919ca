//! `fatek scan --network`: opens the ports of many hosts and asks the stations behind them.
//!
//! [`Trial`] has the order of the requests to a port, [`RateLimit`] the times of the connections and datagrams, and
//! [`HostList`] the hosts.

mod results;

use std::cell::RefCell;
use std::io;
use std::net::{Ipv4Addr, Ipv6Addr, SocketAddr};
use std::time::Duration;

use fatek::command::{ReadDetailedStatus, ReadStatus};
use fatek::endpoint;
use fatek::wire::Framing;
use futures::StreamExt;
use tokio::net::{TcpStream, UdpSocket, lookup_host};
use tokio::time::{Instant, sleep, timeout};

use self::results::{Kind, Tally, host, hosts_text, print};
use super::hosts::{HostList, Hosts, MAX_HOSTS};
use super::rate_limit::{RateLimit, if_silent};
use super::trial::{Found, Questions, Trial, TrialStep};
use crate::args::ScanArgs;
use crate::enquiry::exchange::{Datagrams, Line, Stream, ask, listen};
use crate::failure::Failure;
use crate::output::Output;
use crate::printable::excerpt;
use crate::progress::StatusLine;
use crate::signal::unless_signalled;

/// Response timeout without `--timeout`: the modules themselves wait 300 ms for a station.
pub(crate) const DEFAULT_TIMEOUT: Duration = Duration::from_millis(500);
/// Shortest connection timeout: systems send a lost request to connect again after 1 s.
pub(crate) const MIN_CONNECT_TIMEOUT: Duration = Duration::from_millis(1500);
/// Stations without a choice: numbers of a module with few PLCs.
pub(crate) const DEFAULT_STATIONS: std::ops::RangeInclusive<u8> = 1..=4;
const UDP_RETRIES: u32 = 1;

pub(crate) async fn scan(args: &ScanArgs, given: Option<Duration>, output: &Output) -> Result<(), Failure> {
    let plan = Plan::new(args, given).await?;
    let progress = StatusLine::new(output);
    let remark = |text: std::fmt::Arguments<'_>| output.remark(text);
    remark(format_args!("scanning {}", plan.text()));
    let scan = Scan {
        plan: &plan,
        progress: &progress,
        begun: Instant::now(),
        rate: RefCell::new(RateLimit::per_second(args.network.rate)),
        tally: RefCell::default(),
    };
    let ended = unless_signalled(scan.all()).await?;
    let tally = scan.tally.take();
    drop(progress);
    print(&tally.found, output)?;
    tally.texts().iter().for_each(|text| remark(format_args!("{text}")));
    ended.map_err(Failure::interrupted(""))?;
    tally.hints().iter().for_each(|hint| remark(format_args!("hint: {hint}")));
    tally.verdict()
}

/// All that the command line says about a scan.
#[derive(Debug)]
struct Plan {
    hosts: HostList,
    ports: Vec<(Kind, u16)>,
    tcp: Questions,
    udp: Questions,
    timeout: Duration,
    connect_timeout: Duration,
    at_once: u32,
    /// Time if no host answers.
    if_silent: Duration,
}

impl Plan {
    async fn new(args: &ScanArgs, given: Option<Duration>) -> Result<Self, Failure> {
        let network = &args.network;
        let stations = args.numbers(DEFAULT_STATIONS)?;
        let (tcp, udp): (&[u16], &[u16]) = match (&network.tcp[..], &network.udp[..]) {
            ([], []) => (&[endpoint::DEFAULT_PORT], &[endpoint::DEFAULT_PORT]),
            chosen => chosen,
        };
        let ports = tcp.iter().map(|&port| (Kind::Tcp, port)).chain(udp.iter().map(|&port| (Kind::Udp, port)));
        let framings = network.framing.map_or(vec![Framing::Ascii, Framing::Binary], |framing| vec![framing]);
        let questions = |default| Questions {
            stations: stations.clone(),
            framings: framings.clone(),
            retries: args.retries.unwrap_or(default),
        };
        let mut plan = Self {
            hosts: hosts(&network.hosts, network.large).await?,
            ports: ports.collect(),
            tcp: questions(0),
            udp: questions(UDP_RETRIES),
            timeout: given.unwrap_or(DEFAULT_TIMEOUT),
            connect_timeout: given.unwrap_or_default().max(MIN_CONNECT_TIMEOUT),
            at_once: network.at_once,
            if_silent: Duration::ZERO,
        };
        let places = plan.ports.iter().map(|(kind, _)| plan.places_if_silent(*kind)).fold(0, u32::saturating_add);
        let of_host = plan.ports.iter().map(|(kind, _)| plan.time_if_silent(*kind)).sum();
        plan.if_silent = if_silent(plan.hosts.count(), plan.at_once, of_host, places, network.rate);
        Ok(plan)
    }

    fn questions(&self, kind: Kind) -> &Questions {
        match kind {
            Kind::Tcp => &self.tcp,
            Kind::Udp => &self.udp,
        }
    }

    /// Time for a port of a host that is not there.
    fn time_if_silent(&self, kind: Kind) -> Duration {
        match kind {
            Kind::Tcp => self.connect_timeout,
            Kind::Udp => self.timeout.saturating_mul(self.udp.when_silent()),
        }
    }

    /// Connections and datagrams to a port of a host that is not there.
    fn places_if_silent(&self, kind: Kind) -> u32 {
        match kind {
            Kind::Tcp => 1,
            Kind::Udp => self.udp.when_silent(),
        }
    }

    fn text(&self) -> String {
        let hosts = hosts_text(self.hosts.count());
        let ports: Vec<String> = self.ports.iter().map(|(kind, port)| format!("{} {port}", kind.as_str())).collect();
        let stations = crate::targets::numbers_text(&self.tcp.stations);
        let time = seconds(self.if_silent);
        format!("{hosts}, {}, {stations}: up to {time} if none answers", ports.join(", "))
    }
}

/// Whole seconds, at least one.
fn seconds(time: Duration) -> String {
    format!("{} s", time.as_secs_f64().ceil().max(1.0))
}

/// The hosts of the command line, with the addresses of names.
async fn hosts(all: &[Hosts], is_large: bool) -> Result<HostList, Failure> {
    let mut list = HostList::default();
    for hosts in all {
        match hosts {
            Hosts::Range(range) => list.add_range(*range),
            Hosts::Name(name) => {
                let inner = name.strip_prefix('[').and_then(|name| name.strip_suffix(']')).unwrap_or(name);
                let addresses =
                    lookup_host((inner, 0)).await.map_err(|error| Failure::Host { host: name.clone(), error })?;
                for address in addresses {
                    let refused = |rule| Failure::Usage(format!("{}: {rule}", excerpt(name)));
                    list.add_address(address).map_err(refused)?;
                }
            }
        }
    }
    let count = list.count();
    if count > MAX_HOSTS && !is_large {
        return Err(Failure::Usage(format!(
            "{count} hosts are more than {MAX_HOSTS}: choose smaller networks, or give --large"
        )));
    }
    Ok(list)
}

/// A running scan. All parts are of one task.
struct Scan<'s> {
    plan: &'s Plan,
    progress: &'s StatusLine,
    begun: Instant,
    rate: RefCell<RateLimit>,
    tally: RefCell<Tally>,
}

/// Result of opening a port.
enum Opened {
    Line(AnyLine),
    Refused,
    /// No answer in time, or the network says that the host is not there.
    Unanswered,
    /// This computer cannot open it.
    Failed(io::Error),
}

/// A connection to a port.
enum AnyLine {
    Tcp(Stream<TcpStream>),
    Udp(Datagrams),
}

impl Line for AnyLine {
    async fn send(&mut self, request: &[u8]) -> io::Result<()> {
        match self {
            Self::Tcp(line) => line.send(request).await,
            Self::Udp(line) => line.send(request).await,
        }
    }

    async fn receive(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        match self {
            Self::Tcp(line) => line.receive(buffer).await,
            Self::Udp(line) => line.receive(buffer).await,
        }
    }
}

impl Scan<'_> {
    async fn all(&self) {
        self.show();
        let at_once = usize::try_from(self.plan.at_once).unwrap_or(1);
        let hosts = futures::stream::iter(self.plan.hosts.iter());
        hosts.map(|address| self.host(address)).buffer_unordered(at_once).for_each(|()| async { self.show() }).await;
    }

    fn show(&self) {
        let tally = self.tally.borrow();
        let (all, stations) = (self.plan.hosts.count(), tally.stations().count());
        let left = all.saturating_sub(tally.hosts) as f64 / all.max(1) as f64;
        let left = seconds(self.plan.if_silent.mul_f64(left));
        self.progress
            .show(format_args!("{} of {all} hosts, {stations} stations found, up to {left} left", tally.hosts));
    }

    /// Tries all ports of a host, one after the other.
    async fn host(&self, address: SocketAddr) {
        let mut framing = None;
        for &(kind, port) in &self.plan.ports {
            let address = with_port(address, port);
            match self.port(kind, address, &mut framing).await {
                Opened::Line(_) => {}
                Opened::Refused => self.tally.borrow_mut().refused += 1,
                Opened::Unanswered => self.tally.borrow_mut().unanswered += 1,
                Opened::Failed(error) => {
                    let mut tally = self.tally.borrow_mut();
                    tally.failed += 1;
                    let (kind, host) = (kind.as_str(), host(address));
                    tally.failure.get_or_insert_with(|| format!("{host} {kind} {}: {error}", address.port()));
                }
            }
        }
        self.tally.borrow_mut().hosts += 1;
    }

    /// Asks the stations behind a port. `framing`: that of the host, if it is known.
    async fn port(&self, kind: Kind, address: SocketAddr, framing: &mut Option<Framing>) -> Opened {
        let mut line = match self.open(kind, address).await {
            Opened::Line(line) => line,
            other @ (Opened::Refused | Opened::Unanswered | Opened::Failed(_)) => return other,
        };
        let within = self.plan.timeout;
        let mut trial = Trial::new(self.plan.questions(kind), *framing, kind == Kind::Tcp);
        loop {
            let lost = match trial.step() {
                TrialStep::Status { framing, station } => {
                    self.datagram(kind).await;
                    let outcome = ask(&mut line, ReadStatus, framing, station, within).await;
                    match (outcome.reply, outcome.lost) {
                        (None, Some(error)) => Some((error, outcome.traffic)),
                        (reply, _) => {
                            let is_answered = reply.is_some();
                            trial.status(reply, outcome.traffic);
                            if is_answered {
                                self.note(kind, address, trial.found());
                                self.progress.event(format_args!(
                                    "{} station {station}: answers",
                                    kind.endpoint(address, Some(framing))
                                ));
                                self.show();
                            }
                            None
                        }
                    }
                }
                TrialStep::Detail { framing, station } => {
                    self.datagram(kind).await;
                    let outcome = ask(&mut line, ReadDetailedStatus, framing, station, within).await;
                    match (outcome.reply, outcome.lost) {
                        (None, Some(error)) => Some((error, outcome.traffic)),
                        (reply, _) => {
                            trial.detail(reply.map(|(reply, _)| reply), outcome.traffic);
                            None
                        }
                    }
                }
                TrialStep::Listen { framing } => {
                    let (traffic, lost) = listen(&mut line, framing, within).await;
                    trial.listened(traffic, lost.is_some());
                    None
                }
                TrialStep::Open => {
                    match self.open(kind, address).await {
                        Opened::Line(new) => {
                            line = new;
                            trial.opened();
                        }
                        Opened::Refused | Opened::Unanswered => {
                            trial.end("the port accepts no second connection");
                        }
                        Opened::Failed(error) => trial.end(&error.to_string()),
                    }
                    None
                }
                TrialStep::End => break,
            };
            if let Some((error, traffic)) = lost {
                // The host says over UDP that the port is closed.
                if kind == Kind::Udp && trial.found().is_empty() {
                    return classified(error);
                }
                trial.lost(&error.to_string(), traffic);
            }
        }
        *framing = framing.or(trial.framing());
        let found = trial.into_found();
        if found.is_empty() {
            return Opened::Unanswered;
        }
        self.note(kind, address, &found);
        Opened::Line(line)
    }

    fn note(&self, kind: Kind, address: SocketAddr, found: &[Found]) {
        self.tally.borrow_mut().found.insert((address, kind), found.to_vec());
    }

    /// Waits for the next place in the rate.
    async fn place(&self) {
        let wait = self.rate.borrow_mut().reserve(self.begun.elapsed());
        if !wait.is_zero() {
            sleep(wait).await;
        }
    }

    /// Waits for the place of a datagram. Requests on a connection need none.
    async fn datagram(&self, kind: Kind) {
        match kind {
            Kind::Tcp => {}
            Kind::Udp => self.place().await,
        }
    }

    /// Opens a connection, in its turn. A UDP socket sends nothing for that.
    async fn open(&self, kind: Kind, address: SocketAddr) -> Opened {
        if kind == Kind::Tcp {
            self.place().await;
        }
        let opened = match kind {
            Kind::Tcp => match timeout(self.plan.connect_timeout, TcpStream::connect(address)).await {
                Ok(connected) => connected.map(|stream| AnyLine::Tcp(Stream(stream))),
                Err(_) => return Opened::Unanswered,
            },
            Kind::Udp => udp(address).await.map(|socket| AnyLine::Udp(Datagrams(socket))),
        };
        opened.map_or_else(classified, Opened::Line)
    }
}

async fn udp(address: SocketAddr) -> io::Result<UdpSocket> {
    let any: SocketAddr = match address {
        SocketAddr::V4(_) => (Ipv4Addr::UNSPECIFIED, 0).into(),
        SocketAddr::V6(_) => (Ipv6Addr::UNSPECIFIED, 0).into(),
    };
    let socket = UdpSocket::bind(any).await?;
    socket.connect(address).await?;
    Ok(socket)
}

fn classified(error: io::Error) -> Opened {
    // The kinds that are not named here are failures of this computer.
    #[allow(clippy::wildcard_enum_match_arm, reason = "the enum of the standard library has more kinds each year")]
    match error.kind() {
        io::ErrorKind::ConnectionRefused | io::ErrorKind::ConnectionReset => Opened::Refused,
        io::ErrorKind::TimedOut | io::ErrorKind::HostUnreachable => Opened::Unanswered,
        _ => Opened::Failed(error),
    }
}

fn with_port(mut address: SocketAddr, port: u16) -> SocketAddr {
    address.set_port(port);
    address
}
