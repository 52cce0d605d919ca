//! Arguments of `fatek sim`.

use std::path::PathBuf;
use std::time::Duration;

use clap::{Args, ValueHint};
use fatek::memory_map::PlcModel;
use fatek::sim::Model;
use fatek::wire::Framing;
use fatek::{Clock, Element};

use crate::printable::excerpt;
use crate::{clock, duration};

/// Simulate PLCs over TCP, UDP or a serial port
///
/// Runs until it is interrupted. Prints a line such as `listening tcp://HOST:PORT` for each --listen, as
/// soon as clients can connect. At Ctrl-C, SIGTERM and SIGHUP requests that have arrived are answered, and
/// the exit status is 0. With --config or @NAME, the PLCs are those of the plant configuration.
#[derive(Debug, Args)]
#[command(after_help = AFTER_HELP)]
pub(crate) struct SimArgs {
    /// Where to listen: tcp://HOST:PORT, udp://HOST:PORT or serial:PATH?baud=9600&frame=7E1; port 0: any
    /// free port; repeat to serve the same PLCs there, too [default: tcp://127.0.0.1:0]
    ///
    /// Each takes ?framing=ascii|binary in place of --framing. For a plant: the host and the port of the first
    /// link, as tcp://HOST:PORT; the others have the next ports.
    #[arg(long, value_name = "URL")]
    pub(crate) listen: Vec<String>,
    /// Idle time after which a TCP connection makes room for a new one, when there are 64
    #[arg(long, value_name = "TIME", default_value = "5s", value_parser = duration::parse_positive)]
    pub(crate) make_room_after: Duration,
    /// Station number, 1 to 254; repeat for several PLCs, each with its own memory [default: that of
    /// --memory, else 1]
    #[arg(long = "station", value_name = "N", value_parser = clap::value_parser!(u8).range(1..=254))]
    pub(crate) stations: Vec<u8>,
    /// Framing: ascii or binary [default: ascii]
    #[arg(long)]
    pub(crate) framing: Option<Framing>,
    /// Initial values, or movements; all other values are 0
    ///
    /// A tag can be given by its name in the plant.
    #[arg(long = "set", value_name = "[PLC/]TAG=VALUE", num_args = 1.., help_heading = "Memory")]
    pub(crate) sets: Vec<String>,
    /// Saved backup as memory; its PLC is the model unless --model is given
    #[arg(long, value_name = "[PLC=]FILE", value_hint = ValueHint::FilePath, help_heading = "Memory")]
    pub(crate) memory: Vec<String>,
    /// Saved program
    #[arg(long, value_name = "[PLC=]FILE", value_hint = ValueHint::FilePath, help_heading = "Memory")]
    pub(crate) program: Vec<String>,
    /// Model with its memory and status: fbe-28mc or fbs-20mc, or `largest` for all addresses of the
    /// protocol [default: that of --memory, else fbe-28mc]
    ///
    /// Other addresses are refused. File registers F are in `largest` only, or by --last.
    #[arg(long, value_name = "MODEL", value_parser = model, help_heading = "Memory")]
    pub(crate) model: Option<Model>,
    /// Last element of a memory area, such as R3839; repeat for other areas [default: of the model]
    ///
    /// Requests for higher addresses are refused.
    #[arg(long = "last", value_name = "ELEMENT", help_heading = "Memory")]
    pub(crate) last: Vec<Element>,
    /// Ladder size in the detailed status, in words
    #[arg(long, value_name = "N", help_heading = "Memory")]
    pub(crate) ladder_words: Option<u16>,
    /// Clock with this time, which stands still: now (UTC), or date and time such as 2026-11-29T06:30:00
    /// [default: none]
    #[arg(long, value_name = "TIME", value_parser = clock, help_heading = "Memory")]
    pub(crate) clock: Option<Clock>,
    /// Faults with their chances: drop=1%,late=5%:300ms; counted, and printed on stderr at the end
    #[arg(long = "fault", value_name = "[PLC/]FAULTS", help_heading = "Line and faults")]
    pub(crate) faults: Vec<String>,
    /// Seed of faults and random values: equal seeds and equal requests have equal faults
    #[arg(long, value_name = "N", default_value_t = 0, help_heading = "Line and faults")]
    pub(crate) seed: u64,
    /// Speed of the line in bit/s, 10 bits per character, also over a network [default: no time; for a
    /// serial link of a plant, its speed]
    #[arg(
        long,
        value_name = "BAUD",
        value_parser = clap::value_parser!(u32).range(1..),
        help_heading = "Line and faults"
    )]
    pub(crate) baud: Option<u32>,
    /// Response time of the PLCs: from request to reply, such as 5ms or 5ms..20ms [default: none]
    #[arg(long, value_name = "TIME", value_parser = response_time, help_heading = "Line and faults")]
    pub(crate) response_time: Option<ResponseTime>,
    /// Write a copy of the plant configuration there, with links that lead to this simulator
    ///
    /// A file that is not such a copy is not replaced.
    #[arg(long, value_name = "FILE", value_hint = ValueHint::FilePath, help_heading = "Plant")]
    pub(crate) client_config: Option<PathBuf>,
}

const AFTER_HELP: &str = "Examples:
  fatek sim --listen tcp://127.0.0.1:0 --set R0=5 R100:f32=1.5 M0-M2=1,0,1
  fatek sim --set 'R0=ramp(0..100,10s)' 'R5:i16*0.1=sine(-40..60,1m)'
  fatek sim --fault drop=1%,late=5%:300ms --baud 9600 --seed 7
  fatek sim --memory plant.backup --program pump.program
  fatek sim --listen udp://127.0.0.1:5000 --listen tcp://127.0.0.1:5000
  fatek sim --listen \"serial:/dev/ttyUSB1?baud=19200\"
  fatek sim --config plant.toml --client-config sim.toml
  fatek --config sim.toml @all watch

Movements, of numbers and discretes:
  ramp(0..100,10s)   triangle(0..100,10s)  sine(0..100,10s)  step(0..1,10s)
  square(0..1,1s)    random(0..100,1s)     counter(0..9,1s)
  The simulated process overwrites the values that a client writes to them.

Faults, as NAME=CHANCE or NAME=CHANCE:DETAIL:
  drop, ignore       no reply; ignore: the request is not executed either
  late, stuck        reply is late [500ms..1500ms], [5s]; later requests wait
  double             reply comes twice, this time apart [0s]
  corrupt            bad checksum
  garbage, noise     up to this number of bytes before a reply, or inside [8]
  split              reply in two pieces with this pause [20ms]
  short, long        reply lacks this number of characters [1], or has more [2]
  wrong-station      reply with the number of another station
  wrong-command      reply with the code of another command
  error              this error code in place of the execution [4]
  echo               request comes back
  disconnect         connection is closed before the reply
  refuse             connection is not accepted

Each is drawn for itself. Of one kind, such as late and stuck, the first that
applies counts, and the others are not drawn.

PLC/ and PLC= are a station number, or a name of the plant. Without: all PLCs.
The section `sim` of a plant configuration has the same settings: docs/CLI.md.";

/// Shortest and longest response time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct ResponseTime {
    pub(crate) min: Duration,
    pub(crate) max: Duration,
}

fn response_time(text: &str) -> Result<ResponseTime, String> {
    let (min, max) = text.split_once("..").unwrap_or((text, text));
    let (min, max) = (duration::parse(min)?, duration::parse(max)?);
    if min <= max { Ok(ResponseTime { min, max }) } else { Err("the first time must not be the longer one".to_owned()) }
}

/// Parses the name of a model.
pub(crate) fn model(name: &str) -> Result<Model, String> {
    const LARGEST: &str = "largest";
    if name.eq_ignore_ascii_case(LARGEST) {
        return Ok(Model::largest());
    }
    name.parse::<PlcModel>().map(Model::of).map_err(|_| {
        let known = PlcModel::ALL.iter().map(|model| model.name().to_ascii_lowercase());
        let known: Vec<String> = known.chain([LARGEST.to_owned()]).collect();
        format!("`{}` is not a known model (known: {})", excerpt(name), known.join(" "))
    })
}

fn clock(time: &str) -> Result<Clock, String> {
    clock::simulated(time).map_err(|failure| failure.to_string())
}
