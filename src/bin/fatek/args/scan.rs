//! Arguments of `fatek scan`.

use std::ops::RangeInclusive;
use std::str::FromStr;

use clap::Args;
use fatek::wire::Framing;

use super::LinkArgs;
use crate::failure::Failure;
use crate::scan::discover::DEFAULT_BROADCAST;
use crate::scan::hosts::Hosts;
use crate::targets;

/// Scan a line for stations, or networks for PLCs
///
/// Reads the status of each station in turn, and the detailed status of each station that answers. It
/// never writes. All unexpected traffic is reported: bad replies, garbage, late and duplicate frames.
/// Exit status 0 if stations answer and all replies are good, 4 if no station answers, 6 if a reply is
/// bad, as with two stations of one number.
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  fatek scan --link tcp://192.168.2.3
  fatek scan 1-16 --timeout 1s --retries 2
  fatek scan --link 'serial:/dev/ttyUSB0?baud=19200'
  fatek scan --network 192.168.1.0/24
  fatek scan --network 192.168.1.10-20,plc-7 --tcp 500,5000 --stations 1-16
  fatek scan --discover --broadcast 192.168.1.255

A line: the default of --timeout is 200ms: all 254 stations take up to 51 s.

Networks: the default of --timeout is 500ms, of a connection 1.5s, and stations
1 to 4 are asked. UDP has no connection: a host that does not answer is unknown.
A host with an IPsec gateway may answer on UDP 500 in another protocol.

Column answer:
  ok       good replies
  refused  error code, such as for a command unknown to the station
  bad      no good reply, or other frames or garbage besides
  late     reply after the timeout: increase --timeout
  silent   the port accepts connections, and no station answers
  other    bytes that are no frame: another protocol?

The column model has the main unit and the version of its OS.
JSON: array of objects with station, answer, running, main_unit, os_version,
time_ms and note; of networks also link, host, transport, port and framing;
unknown values are null.

--discover sends two packets that Ethernet modules answer with their names and
addresses. Their meaning is known from one other program only: it is unverified
on hardware, and a single address at a time is the cautious way.")]
pub(crate) struct ScanArgs {
    /// Station range, both ends included, or one station; 1 to 254 [default: 1-254; networks: 1-4]
    #[arg(value_name = "FROM-TO")]
    pub(crate) range: Option<Stations>,
    /// The same as a list of stations and ranges, such as 1-4,9
    #[arg(long, value_name = "LIST", conflicts_with = "range")]
    pub(crate) stations: Option<String>,
    /// Retries after no reply or a bad reply, 0 to 10 [default: 0; UDP in networks: 1]
    ///
    /// In networks only the first station is asked again while nothing has come from a host.
    #[arg(long, value_parser = clap::value_parser!(u32).range(0..=10), value_name = "N")]
    pub(crate) retries: Option<u32>,
    #[command(flatten)]
    pub(crate) link: LinkArgs,
    #[command(flatten)]
    pub(crate) network: NetworkArgs,
    #[command(flatten)]
    pub(crate) discovery: DiscoverArgs,
}

impl ScanArgs {
    /// The numbers of the stations, each once and in order.
    pub(crate) fn numbers(&self, default: RangeInclusive<u8>) -> Result<Vec<u8>, Failure> {
        let mut numbers = match (&self.stations, self.range) {
            (Some(list), _) => targets::numbers(list)?,
            (None, Some(range)) => (range.first..=range.last).collect(),
            (None, None) => default.collect(),
        };
        numbers.sort_unstable();
        Ok(numbers)
    }
}

/// Options for the PLCs of networks.
#[derive(Debug, Args)]
#[command(next_help_heading = "Networks")]
pub(crate) struct NetworkArgs {
    /// Network, range or host: 192.168.1.0/24, 192.168.1.10-20, plc-7; repeat, or separate by commas
    ///
    /// Without the addresses of the network and of its broadcast. IPv6: hosts, and networks of /112 and
    /// longer prefixes.
    #[arg(long = "network", value_name = "HOSTS", value_delimiter = ',', conflicts_with = "links")]
    pub(crate) hosts: Vec<Hosts>,
    /// TCP ports, such as 500,5000 [default: 500, unless --udp is given alone]
    #[arg(
        long,
        value_name = "PORTS",
        value_delimiter = ',',
        requires = "hosts",
        value_parser = clap::value_parser!(u16).range(1..)
    )]
    pub(crate) tcp: Vec<u16>,
    /// UDP ports [default: 500, unless --tcp is given alone]
    #[arg(
        long,
        value_name = "PORTS",
        value_delimiter = ',',
        requires = "hosts",
        value_parser = clap::value_parser!(u16).range(1..)
    )]
    pub(crate) udp: Vec<u16>,
    /// Framing: ascii or binary [default: both, until a frame comes]
    #[arg(long, requires = "hosts")]
    pub(crate) framing: Option<Framing>,
    /// TCP connections and UDP datagrams per second, 1 to 10000
    #[arg(
        long,
        value_name = "N",
        default_value_t = 100,
        requires = "hosts",
        value_parser = clap::value_parser!(u32).range(1..=10_000)
    )]
    pub(crate) rate: u32,
    /// Hosts at once, 1 to 512; each with one connection
    #[arg(
        long,
        value_name = "N",
        default_value_t = 128,
        requires = "hosts",
        value_parser = clap::value_parser!(u32).range(1..=512)
    )]
    pub(crate) at_once: u32,
    /// Take more than 65536 hosts
    #[arg(long, requires = "hosts")]
    pub(crate) large: bool,
}

/// Options for the discovery of Ethernet modules.
#[derive(Debug, Args)]
#[command(next_help_heading = "Discovery of Ethernet modules (unverified on hardware)")]
pub(crate) struct DiscoverArgs {
    /// Find Ethernet modules by a broadcast to UDP port 111
    #[arg(long, conflicts_with_all = ["links", "hosts", "range", "stations", "retries"])]
    pub(crate) discover: bool,
    /// Address for --discover: of a broadcast or of one module, with a port if it is not 111; repeat
    #[arg(
        long,
        value_name = "ADDRESS",
        value_delimiter = ',',
        default_value = DEFAULT_BROADCAST,
        requires = "discover"
    )]
    pub(crate) broadcast: Vec<String>,
    /// Local UDP port of --discover; 0: any free port. Modules may answer to 53238 only
    #[arg(long, value_name = "PORT", default_value_t = 53238, requires = "discover")]
    pub(crate) source_port: u16,
}

/// Range of station numbers, both ends included.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Stations {
    pub(crate) first: u8,
    pub(crate) last: u8,
}

impl FromStr for Stations {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let number = |text: &str| {
            let digits = !text.is_empty() && text.bytes().all(|b| b.is_ascii_digit());
            text.parse().ok().filter(|number| digits && (1..=254).contains(number))
        };
        let (first, last) = text.split_once('-').unwrap_or((text, text));
        match (number(first), number(last)) {
            (Some(first), Some(last)) if first <= last => Ok(Self { first, last }),
            _ => Err("expected a station or a range of stations from 1 to 254, such as 5 or 1-16".to_owned()),
        }
    }
}
