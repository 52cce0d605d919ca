//! Arguments of `fatek sim`.

use clap::Args;
use fatek::Element;
use fatek::tag::Assignment;
use fatek::wire::Framing;

/// Simulate one or more PLCs on a TCP port until interrupted
///
/// Prints one line, `listening tcp://HOST:PORT`, as soon as clients can connect.
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  fatek sim --listen tcp://127.0.0.1:0 --set R0=5 R100:f32=1.5 M0-M2=1,0,1
  fatek sim --listen tcp://0.0.0.0:5000 --station 1 --station 2 --framing binary")]
pub(crate) struct SimArgs {
    /// Listening address; port 0: any free port
    #[arg(long, value_name = "URL", default_value = "tcp://127.0.0.1:0")]
    pub(crate) listen: String,
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
    /// Last element of a memory area, such as R3839; repeat for other areas [default: last of the
    /// protocol]
    ///
    /// Requests for higher addresses are refused.
    #[arg(long = "last", value_name = "ELEMENT")]
    pub(crate) last: Vec<Element>,
    /// Ladder size in the detailed status, in words
    #[arg(long, value_name = "N")]
    pub(crate) ladder_words: Option<u16>,
}
