//! Arguments of the commands for tags and discretes.

use std::time::Duration;

use clap::Args;
use clap_complete::ArgValueCompleter;
use fatek::memory_map::PlcModel;
use fatek::tag::Tag;
use fatek::wire::Framing;

use super::{LinkArgs, ModelArgs, Plc};
use crate::names::TableArgs;
use crate::ranges::DiscreteRange;
use crate::{complete, duration};

/// Read tags and print their values
///
/// All tags are checked before the first request. `fatek plan` shows the requests. A tag that the PLC
/// refuses does not hide the others: its reason is on stderr, and the exit status is 3. Of a range
/// that ends outside the memory of the PLC, the values up to there are printed.
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  fatek read R0-R9 R100:f32 M0-M7 --link tcp://192.168.2.3 --station 1
  fatek read R0 --link tcp://192.168.2.3 --station 1-4,9
  fatek --config plant.toml @mixer read level
  fatek read WY8:hex DR2:i32 --format csv
  fatek read level alarm --tags mixer.csv

JSON: array of objects with tag, type and value, one for each value of a range;
with several PLCs also plc.
The value is true or false for bool, a string for hex and text, else a number;
floats without a JSON number are \"NaN\", \"inf\" and \"-inf\". The table shows texts
in double quotes, with backslash escapes for control characters.")]
pub(crate) struct ReadArgs {
    /// Element or range, with an optional type: R5, R0-R9, R100:f32, R5:i16*0.1, WY8:hex, M0-M7
    ///
    /// Also a name of the table of --tags or of the PLC of --config; without any, all of these.
    #[arg(value_name = "TAG", add = ArgValueCompleter::new(complete::tags))]
    pub(crate) tags: Vec<String>,
    /// Print nothing unless all tags were read
    #[arg(long)]
    pub(crate) strict: bool,
    #[command(flatten)]
    pub(crate) table: TableArgs,
    #[command(flatten)]
    pub(crate) model: ModelArgs,
    #[command(flatten)]
    pub(crate) plc: Plc,
}

/// Write values to tags, without confirmation, in the order given
///
/// All tags and values are checked before the first request. A 32-bit value is always written in
/// one request.
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  fatek write R0=5 R5:i16=-1 WY8=0xAAAA --link tcp://192.168.2.3 --station 1
  fatek write R100:f32=1.5 R0-R2=1,2,3 M0-M2=on,off,on
  fatek write R5:i16*0.1=21.5 R10-R19:text='two words'

Values:
  integers  decimal, or the bits after 0x: 0xFFFF as i16 is -1
  hex       0x only
  f32       decimal, nan or inf
  bool      0 or 1, false or true, off or on
  scaled    decimal; the nearest number that the register can hold is written
  text      one text for the whole range; with a comma, quote, backslash or
            control character in double quotes, escapes \\\" \\\\ \\n \\r \\t \\0 \\x1B
A range takes one value per element, or per two elements for 32-bit values,
separated by commas.")]
pub(crate) struct WriteArgs {
    /// Tag with its value or values: R0=5, R100:f32=1.5, R0-R2=1,2,3
    #[arg(required = true, value_name = "TAG=VALUE", add = ArgValueCompleter::new(complete::tags))]
    pub(crate) assignments: Vec<String>,
    /// Take bits of registers, such as R5.3=1: read the register, change the bits, write it
    ///
    /// A change of its other bits by the program of the PLC or by another master between the read and
    /// the write is undone.
    #[arg(long)]
    pub(crate) modify_bits: bool,
    /// Read each value back and compare it; exit status 7 if one differs
    ///
    /// A program that sets the element itself can be the reason.
    #[arg(long)]
    pub(crate) verify: bool,
    /// Write again and again, at this interval, until Ctrl-C: for a watchdog of the PLC
    ///
    /// After a round without a reply the next one is written at its time; a refusal ends the command.
    #[arg(long, value_parser = duration::parse_positive, value_name = "TIME")]
    pub(crate) every: Option<Duration>,
    #[command(flatten)]
    pub(crate) table: TableArgs,
    /// Write special elements, too: R3840-R4167 and M1912-M2001
    ///
    /// Writing them can cause system or I/O errors, or cut the line. Without it nothing is written if
    /// a tag touches them.
    #[arg(long)]
    pub(crate) special: bool,
    #[command(flatten)]
    pub(crate) model: ModelArgs,
    #[command(flatten)]
    pub(crate) plc: Plc,
}

#[derive(Debug, Args)]
pub(crate) struct DiscreteArgs {
    /// Discrete or range: X, Y, M, S, T or C with an address, such as Y3 or M0-M7
    ///
    /// One command is sent for each discrete.
    #[arg(required = true, value_name = "DISCRETE")]
    pub(crate) discretes: Vec<DiscreteRange>,
    /// Change special relays, too: M1912-M2001
    #[arg(long)]
    pub(crate) special: bool,
    #[command(flatten)]
    pub(crate) plc: Plc,
}

/// List the disabled (forced) discretes with their states
///
/// Reads only. Without a range all discretes of the PLC are examined, as many as its status (53) says.
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  fatek forced
  fatek forced X0-X23 Y0-Y15 --format csv
  fatek disable M0-M7 && fatek set M0-M7 && fatek forced M0-M99

JSON: array of objects with discrete and state, true for on.")]
pub(crate) struct ForcedArgs {
    /// Range of discretes, such as M0-M99, or one discrete
    #[arg(value_name = "RANGE")]
    pub(crate) ranges: Vec<DiscreteRange>,
    #[command(flatten)]
    pub(crate) plc: Plc,
}

/// Print the requests that would read tags, with bytes and time
///
/// Sends nothing. The time per byte follows from the settings of a serial link; a network has
/// 10 Mbit/s. Without a link the cost is that of a network. Checks between requests count as
/// `copies` and `one_request` of the link say.
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  fatek plan R0-R9 R12:f32 R900 D7 M3 --baud 9600
  fatek plan R0-R299 D0-D9:text --round-trip 12ms --max-registers 32 --no-mixed
  fatek plan R0-R9 R900 --link 'serial:/dev/ttyUSB0?baud=19200' --format json

JSON: object with requests, an array of objects with request, values, bytes,
time_ms, reads and tags; the sums values and bytes; proofs_ms, the time of the
checks between requests; and time_ms, the time of the requests with proofs_ms.
CSV: the requests alone.")]
pub(crate) struct PlanArgs {
    /// Element or range, with an optional type, as for read
    ///
    /// Also a name of the table of --tags or of the PLC of --config; without any, all of these.
    #[arg(value_name = "TAG", add = ArgValueCompleter::new(complete::tags))]
    pub(crate) tags: Vec<String>,
    #[command(flatten)]
    pub(crate) table: TableArgs,
    /// Framing: ascii or binary [default: of the link, else ascii]
    #[arg(long)]
    pub(crate) framing: Option<Framing>,
    /// Speed of the serial line, also behind a network module, in bit/s
    #[arg(long, value_name = "BAUD")]
    pub(crate) baud: Option<u32>,
    /// Time per request besides its bytes: network round trip, or response time of the PLC
    /// [default: that of --capabilities, else 5ms]
    #[arg(long, value_parser = duration::parse, value_name = "TIME")]
    pub(crate) round_trip: Option<Duration>,
    /// One request for all tags, so that all values come from one scan cycle
    #[arg(long)]
    pub(crate) one_scan: bool,
    /// Limit of 16-bit registers per read, 2 to 64 [default: 64]
    #[arg(long, value_name = "N")]
    pub(crate) max_registers: Option<usize>,
    /// Limit of discretes per read, 1 to 256 [default: 256]
    #[arg(long, value_name = "N")]
    pub(crate) max_points: Option<usize>,
    /// Limit of units per mixed read, 1 to 64 [default: 64]
    ///
    /// A discrete or a 16-bit register is one unit, a 32-bit register is two.
    #[arg(long, value_name = "N", conflicts_with = "no_mixed")]
    pub(crate) max_mixed: Option<usize>,
    /// No mixed reads (command 48)
    #[arg(long)]
    pub(crate) no_mixed: bool,
    /// No words of discretes: M0 to M15 are not read as WM0
    #[arg(long)]
    pub(crate) no_words: bool,
    /// Capabilities of the PLC: a file of `fatek probe --format json` [env: FATEK_CAPABILITIES=]
    #[arg(long, value_name = "FILE")]
    pub(crate) capabilities: Option<String>,
    /// Memory of this model: fbe-28mc or fbs-20mc
    #[arg(long, value_name = "MODEL", conflicts_with = "readable")]
    pub(crate) model: Option<PlcModel>,
    /// Readable range, such as R0-R3839; repeat for more [default: all addresses]
    ///
    /// Of a symbol with readable ranges no other addresses are read.
    #[arg(long, value_name = "RANGE")]
    pub(crate) readable: Vec<Tag>,
    #[command(flatten)]
    pub(crate) link: LinkArgs,
}
