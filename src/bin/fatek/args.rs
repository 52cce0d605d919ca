//! What can stand on the command line.

mod backup;
mod program;

use std::str::FromStr;
use std::time::Duration;

use clap::{ArgAction, Args, Parser, Subcommand};
use fatek::tag::{Assignment, Tag};
use fatek::wire::Framing;
use fatek::{Discrete, Element};

pub(crate) use self::backup::{BackupArgs, RestoreArgs};
pub(crate) use self::program::{ProgramCommand, ProgramFile, ProgramReadArgs, ProgramVerifyArgs, ProgramWriteArgs};
use crate::duration;
use crate::output::Format;

/// Reads and writes FATEK / FACON PLCs, plays one, and explains frames.
///
/// Data goes to stdout, all else to stderr. Commands that change a PLC act at once, without asking; only those that write a
/// file to it ask first.
#[derive(Debug, Parser)]
#[command(version, after_help = AFTER_HELP, after_long_help = AFTER_LONG_HELP)]
pub(crate) struct Cli {
    #[command(flatten)]
    pub(crate) plc: DefaultPlc,
    #[command(flatten)]
    pub(crate) common: Common,
    #[command(subcommand)]
    pub(crate) command: Command,
}

const AFTER_HELP: &str = "See `fatek --help` for links, tags, exit statuses and examples.";

const AFTER_LONG_HELP: &str = "\
Links:
  tcp://HOST[:PORT][?framing=ascii|binary]
  udp://HOST[:PORT][?framing=ascii|binary]
  serial:PATH[?baud=9600&frame=7E1&framing=ascii|binary]
  The framing is ascii unless stated; binary is for the M series. The port is 500 unless stated, and
  must be stated with binary.

Tags:
  M100       a discrete: on or off (X Y M S T C)
  R5         a 16-bit register, unsigned (R D F RT RC WX WY WM WS WT WC)
  DR2        a 32-bit register, unsigned (DR DD DF DRT DRC DWX DWY DWM DWS DWT DWC)
  R0-R9      a range, both ends included
  R5:i16     a type: bool, u16, i16, u32, i32, f32, hex, text or text-hi
  R100:f32   32 bits of two 16-bit registers: R100, the low word, and R101
  R5:i16*0.1-40   a number times a gain, plus an offset; one of the two will do
  R0-R9:text      up to 64 registers as one text of two characters each, the low byte first;
                  text-hi has the high byte first

Exit status:
  0  ok
  1  a file or the output could not be written, the runtime not be started, or it was not confirmed
  2  usage: the command line has an error, and nothing was sent
  3  the PLC answered with an error, also (backup) for a part of what was asked
  4  timeout: the PLC did not answer, or (scan) no station did
  5  no connection
  6  bad reply, also (scan) of one station among others, or (decode) a bad frame
  7  a file is damaged or does not fit the PLC, or the PLC holds something else than it should

Examples:
  fatek sim --listen tcp://127.0.0.1:5000 --set R0=5
  fatek --link tcp://192.168.2.3 --station 1 read R0-R9 R100:f32 M0-M7
  fatek --link tcp://192.168.2.3 --station 1 write R0=5 DR2:i32=-7 R100:f32=1.5 M0-M2=1,0,1
  export FATEK_LINK=tcp://192.168.2.3 FATEK_STATION=1
  fatek status
  fatek read R0-R9 --format json
  fatek program read pump.program
  fatek backup plant.backup R0-R3839 M0-M1911
  fatek scan 1-16
  fatek plan R0-R9 R900 --baud 9600
  fatek decode 02 30 31 34 36 30 33 52 30 30 30 31 32 37 35 03";

/// Options of every subcommand, before or after it.
#[derive(Debug, Args)]
pub(crate) struct Common {
    /// How data is printed [default: table]
    #[arg(long, global = true, value_enum, value_name = "FORMAT")]
    pub(crate) format: Option<Format>,
    /// How long to wait for the PLC's answer, and for a connection, such as 500ms or 2s [default: 1s, and 3s]
    ///
    /// Reads are sent up to three times, all else once. `scan` has a default of its own.
    #[arg(long, global = true, value_parser = duration::parse_timeout, value_name = "TIME")]
    pub(crate) timeout: Option<Duration>,
    /// Say nothing on stderr but errors
    #[arg(short, long, global = true)]
    pub(crate) quiet: bool,
    /// Show on stderr what happens; twice for more. The variable RUST_LOG does the same
    #[arg(short, long, global = true, action = ArgAction::Count)]
    pub(crate) verbose: u8,
}

/// Which PLC, before the subcommand or from the environment.
///
/// The texts are parsed where they are used: a bad `FATEK_STATION` is no reason to refuse `fatek decode`.
#[derive(Debug, Args)]
pub(crate) struct DefaultPlc {
    /// Where the PLC is, such as tcp://192.168.2.3:500
    #[arg(long, env = "FATEK_LINK", value_name = "URL")]
    link: Option<String>,
    /// The station number of the PLC, 1 to 254 (`sim` takes its own, behind that word)
    #[arg(long, env = "FATEK_STATION", value_name = "N")]
    station: Option<String>,
}

impl DefaultPlc {
    /// What stands after the subcommand has precedence. A variable that is set to nothing is not set.
    pub(crate) fn or(&self, plc: &Plc) -> Plc {
        let first = |plc: &Option<String>, default: &Option<String>| {
            plc.clone().or_else(|| default.clone()).filter(|text| !text.is_empty())
        };
        Plc { link: first(&plc.link, &self.link), station: first(&plc.station, &self.station) }
    }

    /// The same for commands that have no single station.
    pub(crate) fn link(&self, own: &LinkArgs) -> Option<String> {
        self.or(&Plc { link: own.link.clone(), station: None }).link
    }
}

/// Which PLC.
#[derive(Debug, Args)]
#[command(next_help_heading = "PLC")]
pub(crate) struct Plc {
    /// Where the PLC is, such as tcp://192.168.2.3:500 [env: FATEK_LINK=]
    #[arg(long, value_name = "URL")]
    pub(crate) link: Option<String>,
    /// The station number of the PLC, 1 to 254 [env: FATEK_STATION=]
    #[arg(long, value_name = "N")]
    pub(crate) station: Option<String>,
}

/// Which link.
#[derive(Debug, Args)]
#[command(next_help_heading = "PLC")]
pub(crate) struct LinkArgs {
    /// Where the PLCs are, such as tcp://192.168.2.3:500 [env: FATEK_LINK=]
    #[arg(long, value_name = "URL")]
    link: Option<String>,
}

#[derive(Debug, Subcommand)]
pub(crate) enum Command {
    Sim(SimArgs),
    Read(ReadArgs),
    Write(WriteArgs),
    /// Print what state the PLC is in, and how large its memory is
    Status(PlcArgs),
    /// Start the PLC's program
    Run(PlcArgs),
    /// Stop the PLC's program
    Stop(PlcArgs),
    /// Let discretes follow the program or the input again
    Enable(DiscreteArgs),
    /// Force discretes: they keep their state, whatever the program or the input does
    Disable(DiscreteArgs),
    /// Set discretes on
    Set(DiscreteArgs),
    /// Set discretes off
    Reset(DiscreteArgs),
    Ping(PingArgs),
    Watch(WatchArgs),
    Scan(ScanArgs),
    Plan(PlanArgs),
    /// Read, write and verify the whole program of a PLC, and look into a saved one
    #[command(subcommand)]
    Program(ProgramCommand),
    Backup(BackupArgs),
    Restore(RestoreArgs),
    Decode(DecodeArgs),
}

/// Play a PLC, or several, and serve until stopped
///
/// Prints one line, `listening tcp://HOST:PORT`, once it can be connected to.
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  fatek sim --listen tcp://127.0.0.1:0 --set R0=5 R100:f32=1.5 M0-M2=1,0,1
  fatek sim --listen tcp://0.0.0.0:5000 --station 1 --station 2 --framing binary")]
pub(crate) struct SimArgs {
    /// Where to listen; port 0 takes a free one
    #[arg(long, value_name = "URL", default_value = "tcp://127.0.0.1:0")]
    pub(crate) listen: String,
    /// The station number of a PLC, 1 to 254; repeat it for several PLCs, each with a memory of its own
    #[arg(long = "station", value_name = "N", default_value = "1", value_parser = clap::value_parser!(u8).range(1..=254))]
    pub(crate) stations: Vec<u8>,
    /// The framing: ascii or binary
    #[arg(long, default_value_t)]
    pub(crate) framing: Framing,
    /// What the PLCs hold at first; all else is 0
    #[arg(long = "set", value_name = "TAG=VALUE", num_args = 1..)]
    pub(crate) assignments: Vec<Assignment>,
    /// The last element of a memory, such as R3839; a PLC answers an error beyond it [default: the protocol's last]
    #[arg(long = "last", value_name = "ELEMENT")]
    pub(crate) last: Vec<Element>,
    /// The size of the ladder that `status` tells, in words
    #[arg(long, value_name = "N")]
    pub(crate) ladder_words: Option<u16>,
}

/// Print what tags hold
///
/// Nothing is sent unless every tag is good, and nothing is printed unless all of them have been read.
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  fatek read R0-R9 R100:f32 M0-M7 --link tcp://192.168.2.3 --station 1
  fatek read WY8:hex DR2:i32 --format csv

JSON is an array of objects with tag, type and value, one for each value of a range. The value is
true or false for bool, a string for hex and text, else a number; a float that JSON has no number
for is \"NaN\", \"inf\" or \"-inf\". In the table a text stands in double quotes, with a backslash
before what could not be seen.")]
pub(crate) struct ReadArgs {
    /// An element, or a range, with an optional type: R5, R0-R9, R100:f32, R5:i16*0.1, WY8:hex, M0-M7
    #[arg(required = true, value_name = "TAG")]
    pub(crate) tags: Vec<Tag>,
    #[command(flatten)]
    pub(crate) plc: Plc,
}

/// Write values to tags, at once, in the order given
///
/// Nothing is sent unless every tag and value is good. A value of two registers is never split over two requests.
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  fatek write R0=5 R5:i16=-1 WY8=0xAAAA --link tcp://192.168.2.3 --station 1
  fatek write R100:f32=1.5 R0-R2=1,2,3 M0-M2=on,off,on
  fatek write R5:i16*0.1=21.5 R10-R19:text='two words'

Numbers are decimal, or the bits after 0x: 0xFFFF as i16 is -1. hex takes 0x only, f32 also nan
and inf, bool 0 or 1, false or true, off or on. A number with gain or offset is decimal, and what
is written is the nearest that the register can hold. A range takes as many values as it has
elements, or pairs of them, with commas between; a text takes one. A text with a comma, a quote, a
backslash or what cannot be seen stands in double quotes, with \\\" \\\\ \\n \\r \\t \\0 \\x1B in it.")]
pub(crate) struct WriteArgs {
    /// A tag and its value, or its values: R0=5, R100:f32=1.5, R0-R2=1,2,3
    #[arg(required = true, value_name = "TAG=VALUE")]
    pub(crate) assignments: Vec<Assignment>,
    #[command(flatten)]
    pub(crate) plc: Plc,
}

#[derive(Debug, Args)]
pub(crate) struct PlcArgs {
    #[command(flatten)]
    pub(crate) plc: Plc,
}

#[derive(Debug, Args)]
pub(crate) struct DiscreteArgs {
    /// X, Y, M, S, T or C and an address: Y3
    #[arg(required = true, value_name = "DISCRETE")]
    pub(crate) discretes: Vec<Discrete>,
    #[command(flatten)]
    pub(crate) plc: Plc,
}

/// Send data that the PLC returns, and print how long that takes
///
/// The first time includes opening the connection. Exit status 4 if any answer stays out.
#[derive(Debug, Args)]
pub(crate) struct PingArgs {
    /// How often
    #[arg(short, long, default_value_t = 4, value_parser = clap::value_parser!(u32).range(1..))]
    pub(crate) count: u32,
    /// How long to pause between an answer and the next request
    #[arg(short, long, default_value = "1s", value_parser = duration::parse, value_name = "TIME")]
    pub(crate) interval: Duration,
    /// How much data, in bytes: 0 to 256
    #[arg(short, long, default_value_t = 16, value_parser = clap::value_parser!(u16).range(0..=256))]
    pub(crate) size: u16,
    #[command(flatten)]
    pub(crate) plc: Plc,
}

/// Read tags again and again, and print what they hold
///
/// A line for each value, until it is stopped with Ctrl-C. What cannot be read is told, and read again.
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  fatek watch R0-R9 R100:f32 --interval 500ms --on-change
  fatek watch R5:i16*0.1-40 --deadband 0.5 --format csv --count 1000

The time is that of the answer, in UTC. A value that is not good has the reason behind it: (stale: …) is
the last one that was read, (bad: …) stands alone. JSON is one object a line, with time, tag, value and
quality; the value is null if there is none.")]
pub(crate) struct WatchArgs {
    /// What to read
    #[arg(required = true, value_name = "TAG")]
    pub(crate) tags: Vec<Tag>,
    /// How often, such as 500ms or 10s
    #[arg(long, default_value = "1s", value_parser = duration::parse_timeout, value_name = "TIME")]
    pub(crate) interval: Duration,
    /// Print a value only when it is another one, or is not good any more, or is again
    #[arg(long)]
    pub(crate) on_change: bool,
    /// As --on-change, and a number is another one when it is further than this from the one printed last
    #[arg(long, value_name = "NUMBER")]
    pub(crate) deadband: Option<f64>,
    /// Stop after so many lines
    #[arg(long, value_parser = clap::value_parser!(u64).range(1..), value_name = "N")]
    pub(crate) count: Option<u64>,
    #[command(flatten)]
    pub(crate) plc: Plc,
}

/// Find out which stations answer
///
/// Asks each station for its status, one after the other, and those that answer for more about themselves. Nothing that
/// comes is passed over in silence: bad answers, garbage, answers that come late or twice. Exit status 0 if a station
/// answers and none badly, 4 if none answers, 6 if one answers badly, as two stations with one number do.
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  fatek scan --link tcp://192.168.2.3
  fatek scan 1-16 --timeout 1s --retries 2 --link 'serial:/dev/ttyUSB0?baud=19200'

A station is not waited for longer than --timeout, 200ms unless given: all 254 take up to 51 s.

The answer is ok, refused (an error code, such as for a command that the station does not know),
bad (no good reply, or something besides one) or late (it came when nobody waited for it any more:
give a longer --timeout). JSON is an array of objects with station, answer, running, main_unit,
os_version, time_ms and note; what is not known is null.")]
pub(crate) struct ScanArgs {
    /// The stations to ask, both ends included: FROM-TO, or one number; 0 is the broadcast and asks nobody
    #[arg(default_value = "1-254", value_name = "FROM-TO")]
    pub(crate) stations: Stations,
    /// How often a station that has not answered, or badly, is asked again
    #[arg(long, default_value_t = 0, value_parser = clap::value_parser!(u32).range(0..=10), value_name = "N")]
    pub(crate) retries: u32,
    #[command(flatten)]
    pub(crate) link: LinkArgs,
}

/// Station numbers from the first to the last.
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
            _ => Err("it must be a number from 1 to 254, or two of them, the lower one first: 1-16".to_owned()),
        }
    }
}

/// Print which requests would read tags, and how long they would take
///
/// Nothing is sent. How long bytes take is that of the link: of a serial line by its settings, of a network 10 Mbit/s.
/// Without a link it is a network.
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  fatek plan R0-R9 R12:f32 R900 D7 M3 --baud 9600
  fatek plan R0-R299 D0-D9:text --round-trip 12ms --max-registers 32 --no-mixed
  fatek plan R0-R9 R900 --link 'serial:/dev/ttyUSB0?baud=19200' --format json

JSON is an object: requests is an array of objects with request, values, bytes, time_ms, reads and
tags, and values, bytes and time_ms are the sums. CSV has the requests alone.")]
pub(crate) struct PlanArgs {
    /// An element, or a range, with an optional type, as for read
    #[arg(required = true, value_name = "TAG")]
    pub(crate) tags: Vec<Tag>,
    /// The framing [default: the link's, or ascii]
    #[arg(long)]
    pub(crate) framing: Option<Framing>,
    /// The speed of the serial line, also of one behind a network module, in bits a second
    #[arg(long, value_name = "BAUD")]
    pub(crate) baud: Option<u32>,
    /// How long an answer takes beside its bytes: the round trip of a network, or the time the PLC needs [default: 5ms]
    #[arg(long, value_parser = duration::parse, value_name = "TIME")]
    pub(crate) round_trip: Option<Duration>,
    /// All tags must come from one scan of the PLC, so from one request
    #[arg(long)]
    pub(crate) one_scan: bool,
    /// The most 16-bit registers that the PLC gives in one read, 2 to 64
    #[arg(long, value_name = "N")]
    pub(crate) max_registers: Option<usize>,
    /// The most discretes that the PLC gives in one read, 1 to 256
    #[arg(long, value_name = "N")]
    pub(crate) max_points: Option<usize>,
    /// The most registers and discretes that the PLC gives in one mixed read, 1 to 64, where 32 bits count two
    #[arg(long, value_name = "N", conflicts_with = "no_mixed")]
    pub(crate) max_mixed: Option<usize>,
    /// The PLC has no mixed reads
    #[arg(long)]
    pub(crate) no_mixed: bool,
    /// A range that can be read, such as R0-R3839; repeat it for more. Of a symbol with a range, nothing else is read
    #[arg(long, value_name = "RANGE")]
    pub(crate) readable: Vec<Tag>,
    #[command(flatten)]
    pub(crate) link: LinkArgs,
}

/// Whether something may be changed.
#[derive(Debug, Args)]
pub(crate) struct Consent {
    /// Do not ask
    #[arg(short, long)]
    pub(crate) yes: bool,
    /// Change nothing: print what would be written
    #[arg(short = 'n', long)]
    pub(crate) dry_run: bool,
}

/// Explain frames field by field, bad ones too
///
/// Exit status 0 for good frames, 6 if there is a bad one, or anything besides frames.
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  fatek decode 02 30 31 34 36 30 33 52 30 30 30 31 32 37 35 03
  fatek decode 0x51,0x10,0x00,0x02,0x01,0x40,0xA1,0x84,0x55,0xAA
  fatek decode --framing binary 5210000301410045D455AA")]
pub(crate) struct DecodeArgs {
    /// The framing, ascii or binary; without it, whichever the bytes begin like
    #[arg(long)]
    pub(crate) framing: Option<Framing>,
    /// The bytes as hexadecimal digits, two each; spaces, commas, colons and 0x can stand between
    #[arg(required = true, value_name = "HEX")]
    pub(crate) hex: Vec<String>,
}
