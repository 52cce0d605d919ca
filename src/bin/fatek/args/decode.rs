//! Arguments of `fatek decode`.

use clap::Args;
use fatek::wire::Framing;

/// Explain frames field by field, including bad ones
///
/// Exit status 0 if all frames are good, 6 if a frame is bad or there are bytes outside frames.
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  fatek decode 02 30 31 34 36 30 33 52 30 30 30 31 32 37 35 03
  fatek decode 0x51,0x10,0x00,0x02,0x01,0x40,0xA1,0x84,0x55,0xAA
  fatek decode --framing binary 5210000301410045D455AA")]
pub(crate) struct DecodeArgs {
    /// Framing: ascii or binary [default: by the first frame]
    #[arg(long)]
    pub(crate) framing: Option<Framing>,
    /// Bytes of the frames, two hexadecimal digits each; separators: space, comma, colon, 0x
    #[arg(required = true, value_name = "HEX")]
    pub(crate) hex: Vec<String>,
}
