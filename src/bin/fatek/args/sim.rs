//! Arguments of `fatek sim`.

use std::time::Duration;

use clap::Args;
use fatek::Element;
use fatek::memory_map::{ParsePlcModelError, PlcModel};
use fatek::sim::Model;
use fatek::tag::Assignment;
use fatek::wire::Framing;

use crate::duration;

/// Simulate PLCs over TCP, UDP or a serial port
///
/// Runs until it is interrupted. Prints a line such as `listening tcp://HOST:PORT` for each --listen, as
/// soon as clients can connect. At Ctrl-C, SIGTERM and SIGHUP requests that have arrived are answered, and the exit
/// status is 0.
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  fatek sim --listen tcp://127.0.0.1:0 --set R0=5 R100:f32=1.5 M0-M2=1,0,1
  fatek sim --listen tcp://0.0.0.0:5000 --station 1 --station 2 --framing binary
  fatek sim --listen udp://127.0.0.1:5000 --listen tcp://127.0.0.1:5000
  fatek sim --listen \"serial:/dev/ttyUSB1?baud=19200\"")]
pub(crate) struct SimArgs {
    /// Where to listen: tcp://HOST:PORT, udp://HOST:PORT or serial:PATH?baud=9600&frame=7E1; port 0: any
    /// free port; repeat to serve the same PLCs there, too
    #[arg(long, value_name = "URL", default_value = "tcp://127.0.0.1:0")]
    pub(crate) listen: Vec<String>,
    /// Idle time after which a TCP connection makes room for a new one, when there are 64
    #[arg(long, value_name = "TIME", default_value = "5s", value_parser = duration::parse_positive)]
    pub(crate) make_room_after: Duration,
    /// Station number, 1 to 254; repeat for several PLCs, each with its own memory
    #[arg(
        long = "station",
        value_name = "N",
        default_value = "1",
        value_parser = clap::value_parser!(u8).range(1..=254)
    )]
    pub(crate) stations: Vec<u8>,
    /// Framing: ascii or binary
    #[arg(long, default_value_t)]
    pub(crate) framing: Framing,
    /// Initial values; all others are 0
    #[arg(long = "set", value_name = "TAG=VALUE", num_args = 1..)]
    pub(crate) assignments: Vec<Assignment>,
    /// Model with its memory and status: fbe-28mc or fbs-20mc, or `largest` for all addresses of the
    /// protocol
    ///
    /// Other addresses are refused. File registers F are in `largest` only, or by --last.
    #[arg(long, value_name = "MODEL", default_value = "fbe-28mc", value_parser = model)]
    pub(crate) model: Model,
    /// Last element of a memory area, such as R3839; repeat for other areas [default: of the model]
    ///
    /// Requests for higher addresses are refused.
    #[arg(long = "last", value_name = "ELEMENT")]
    pub(crate) last: Vec<Element>,
    /// Ladder size in the detailed status, in words
    #[arg(long, value_name = "N")]
    pub(crate) ladder_words: Option<u16>,
}

fn model(name: &str) -> Result<Model, ParsePlcModelError> {
    if name.eq_ignore_ascii_case("largest") { Ok(Model::largest()) } else { name.parse::<PlcModel>().map(Model::of) }
}
