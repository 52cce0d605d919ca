//! Results of a scan of networks, and their output.

use std::collections::BTreeMap;
use std::net::SocketAddr;

use fatek::Endpoint;
use fatek::wire::Framing;

use crate::failure::Failure;
use crate::hint;
use crate::output::{Format, Output, Rows, version};
use crate::scan::trial::{Found, StationAnswer};

/// Kind of a port.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Kind {
    Tcp,
    Udp,
}

impl Kind {
    pub(super) fn as_str(self) -> &'static str {
        match self {
            Self::Tcp => "tcp",
            Self::Udp => "udp",
        }
    }

    /// The endpoint of a port, with the ASCII framing unless it is known.
    pub(super) fn endpoint(self, address: SocketAddr, framing: Option<Framing>) -> Endpoint {
        let host = host(address);
        let endpoint = match self {
            Self::Tcp => Endpoint::tcp(host, address.port()),
            Self::Udp => Endpoint::udp(host, address.port()),
        };
        endpoint.with_framing(framing.unwrap_or(Framing::Ascii))
    }
}

/// Address of a host as a text, with the zone of an IPv6 address.
pub(super) fn host(address: SocketAddr) -> String {
    match address {
        SocketAddr::V6(address) if address.scope_id() != 0 => format!("{}%{}", address.ip(), address.scope_id()),
        SocketAddr::V4(_) | SocketAddr::V6(_) => address.ip().to_string(),
    }
}

/// Results until now.
#[derive(Debug, Default)]
pub(super) struct Tally {
    pub(super) found: BTreeMap<(SocketAddr, Kind), Vec<Found>>,
    pub(super) hosts: u128,
    pub(super) refused: u64,
    pub(super) unanswered: u64,
    pub(super) failed: u64,
    /// The first failure of this computer, such as no route.
    pub(super) failure: Option<String>,
}

pub(super) fn hosts_text(count: u128) -> String {
    if count == 1 { "1 host".to_owned() } else { format!("{count} hosts") }
}

impl Tally {
    pub(super) fn stations(&self) -> impl Iterator<Item = &Found> {
        self.found.values().flatten().filter(|found| found.station.is_some())
    }

    /// The summary, in lines.
    pub(super) fn texts(&self) -> [String; 2] {
        let (stations, bad) = (self.stations().count(), self.stations().filter(|found| found.answer.is_bad()).count());
        let stations = if stations == 1 { "1 station".to_owned() } else { format!("{stations} stations") };
        let Self { refused, unanswered, failed, .. } = self;
        [
            format!("{} scanned, {stations} answered, {bad} with bad replies", hosts_text(self.hosts)),
            format!("ports: {refused} refused, {unanswered} without an answer, {failed} not tried"),
        ]
    }

    /// The next things to try.
    pub(super) fn hints(&self) -> Vec<String> {
        let mut hints = Vec::new();
        let good = self.found.iter().find_map(|((address, kind), all)| {
            let found = all.iter().find(|found| found.answer == StationAnswer::Ok)?;
            Some(hint::command(&kind.endpoint(*address, found.framing), found.station?, "status"))
        });
        hints.extend(good.map(|command| format!("to read more: {command}")));
        let silent = self.found.iter().find(|(_, all)| all.iter().any(|found| found.answer == StationAnswer::Silent));
        if let Some(((address, kind), _)) = silent {
            let link = kind.endpoint(*address, None);
            hints.push(format!("to find other stations of a silent port: fatek scan --link {link}"));
        }
        hints
    }

    pub(super) fn verdict(&self) -> Result<(), Failure> {
        if self.stations().next().is_none() {
            return Err(Failure::NoPlc { hosts: self.hosts, failure: self.failure.clone() });
        }
        match self.stations().filter(|found| found.answer.is_bad()).count() {
            0 => Ok(()),
            bad => Err(Failure::BadStations { bad }),
        }
    }
}

/// Prints all results, in the order of their addresses.
pub(super) fn print(all: &BTreeMap<(SocketAddr, Kind), Vec<Found>>, output: &Output) -> Result<(), Failure> {
    // People get the URL in place of its parts: all columns would not fit 80 characters.
    let mut table = Rows::new(["link", "station", "answer", "running", "model", "time_ms", "note"]);
    let mut rows = Rows::new([
        "link",
        "host",
        "transport",
        "port",
        "framing",
        "station",
        "answer",
        "running",
        "main_unit",
        "os_version",
        "time_ms",
        "note",
    ]);
    let all = all.iter().flat_map(|(port, all)| all.iter().map(move |found| (port, found)));
    for (&(address, kind), found) in all {
        let link = kind.endpoint(address, found.framing).to_string();
        let running = found.brief.map(|status| status.flags().running());
        let detailed = found.detailed.as_ref();
        let main_unit = detailed.map(|status| status.main_unit().to_string());
        let os_version = detailed.map(|status| version(status.os_version()));
        let note = (!found.notes.is_empty()).then(|| found.notes.join("; "));
        if output.format == Format::Table {
            let model = main_unit.zip(os_version).map(|(unit, version)| format!("{unit} {version}"));
            let answer = found.answer.as_str().into();
            table.push([
                link.into(),
                found.station.into(),
                answer,
                running.into(),
                model.into(),
                found.time.into(),
                note.into(),
            ]);
        } else {
            rows.push([
                link.into(),
                host(address).into(),
                kind.as_str().into(),
                u32::from(address.port()).into(),
                found.framing.map(|framing| framing.to_string()).into(),
                found.station.into(),
                found.answer.as_str().into(),
                running.into(),
                main_unit.into(),
                os_version.into(),
                found.time.into(),
                note.into(),
            ]);
        }
    }
    output.rows(&if output.format == Format::Table { table.without_empty("note") } else { rows })
}
