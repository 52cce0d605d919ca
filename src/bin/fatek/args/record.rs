//! Arguments of `fatek record` and `fatek replay`.

use std::path::PathBuf;

use clap::{Args, ValueEnum, ValueHint};
use fatek::wire::Framing;

use super::LinkArgs;
use crate::byte_size;

/// Record a conversation between another client and a PLC
///
/// Listens like a PLC, and passes the bytes of each connection on to the PLC and back, unchanged, until
/// Ctrl-C. Each event is written at once. The file is text, one JSON object per line; `decode`
/// explains it, `replay` repeats it. An existing file is not replaced.
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  fatek record a.recording --listen tcp://0.0.0.0:5000 --link tcp://192.168.2.3
  fatek record b.recording --listen serial:/dev/ttyS1 --link serial:/dev/ttyS0
  fatek record - --listen udp://0.0.0.0:500 --link udp://10.0.0.3 | fatek decode

Over a serial port one client is connected at a time. When one end closes its
connection, the other has 30 s more for the rest, a PLC at a serial port 2 s.")]
pub(crate) struct RecordArgs {
    /// File of the recording, which must not exist; - for stdout
    #[arg(value_name = "FILE", value_hint = ValueHint::FilePath)]
    pub(crate) file: PathBuf,
    /// Where clients connect: tcp://HOST:PORT, udp://HOST:PORT or serial:PATH?baud=9600&frame=7E1; port 0:
    /// any free port
    #[arg(long, value_name = "URL", default_value = "tcp://127.0.0.1:0")]
    pub(crate) listen: String,
    /// Largest size of the file, such as 500K, 20M or 2G; the rest is passed on, but not recorded
    #[arg(long, value_name = "SIZE", default_value = "1G", value_parser = byte_size::parse)]
    pub(crate) max_size: u64,
    #[command(flatten)]
    pub(crate) link: LinkArgs,
}

/// Repeat a recorded conversation with a PLC, or as a simulated PLC
///
/// With a link, the recorded requests are sent to the PLC in order, and its replies are compared with
/// the recorded ones: exit status 0 if all are equal, 7 if not. Requests that may change the PLC are
/// refused before anything is sent, unless --writes is given.
///
/// With --listen it answers as recorded, until Ctrl-C. A request that was recorded several times gets
/// the recorded replies in turn, and then the last one. A request without a recorded reply gets none,
/// and is reported on stderr.
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  fatek replay mixer.recording --link tcp://192.168.2.3
  fatek replay mixer.recording --writes skip --timing recorded
  fatek replay mixer.recording --listen tcp://127.0.0.1:5000
  fatek replay mixer.pcapng --listen \"serial:/dev/ttyUSB1?baud=19200\"

The file is one of `fatek record`, a capture, or a log of `fatek -vv`.
With --link a request is sent once, also if it was sent again in the recording.
With --listen, loop-backs (4E) are echoed for stations that have echoed one:
each client puts other data into them.")]
pub(crate) struct ReplayArgs {
    /// Recording, capture or log; - for the standard input
    #[arg(value_name = "FILE", value_hint = ValueHint::FilePath)]
    pub(crate) file: PathBuf,
    /// Answer as recorded: tcp://HOST:PORT, udp://HOST:PORT or serial:PATH?baud=9600&frame=7E1
    #[arg(long, value_name = "URL", conflicts_with_all = ["writes", "yes", "dry_run", "links"])]
    pub(crate) listen: Option<String>,
    /// Pauses between requests, or before replies
    #[arg(long, value_enum, value_name = "TIMING", default_value = "fast")]
    pub(crate) timing: TimingArg,
    /// Requests that may change the PLC [default: refuse the recording]
    #[arg(long, value_enum, value_name = "CHOICE")]
    pub(crate) writes: Option<WritesArg>,
    /// Port of the PLC in a capture; repeat for others
    #[arg(long = "port", value_name = "PORT", default_value = "500")]
    pub(crate) ports: Vec<u16>,
    /// Framing: ascii or binary [default: by the first frame]
    #[arg(long)]
    pub(crate) framing: Option<Framing>,
    #[command(flatten)]
    pub(crate) consent: super::Consent,
    #[command(flatten)]
    pub(crate) link: LinkArgs,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum TimingArg {
    /// As short as possible
    Fast,
    /// As in the recording
    Recorded,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum WritesArg {
    /// They are sent as all others, after a confirmation
    Send,
    /// All others are sent
    Skip,
}
