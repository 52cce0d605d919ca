//! Arguments of `fatek decode`.

use std::path::PathBuf;

use clap::{Args, ValueHint};
use fatek::wire::Framing;

/// Explain frames field by field, and conversations by exchanges
///
/// Frames are bytes in a text: hexadecimal digits with separators, \x02 escapes, arrays of C and
/// other languages, or a dump of xxd, hexdump -C or Wireshark. Bad frames are explained, too.
/// Conversations are captures (pcap, pcapng), recordings of `fatek record`, and logs of `fatek -vv`:
/// requests are paired with replies. They are read as a stream of any length.
///
/// Exit status 0 if all frames are good, 6 if a frame is bad or there are bytes outside frames.
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  fatek decode 02 30 31 34 36 30 33 52 30 30 30 31 32 37 35 03
  fatek decode 0x51,0x10,0x00,0x02,0x01,0x40,0xA1,0x84,0x55,0xAA
  fatek decode '\\x02014603R0001275\\x03'
  fatek decode --framing binary 5210000301410045D455AA
  fatek decode --file mixer.pcapng
  fatek decode --file mixer.recording --fields
  tcpdump -i eth0 -U -w - port 500 | fatek decode
  fatek -vv read R0-R9 2>&1 | fatek decode

Results of conversations:
  refused      error code of the PLC
  no reply     before a later request was answered, or before the end
  retried      no reply before the same request came again
  wrong reply  reply of another length or kind than the request asks for
  ambiguous    reply to this request, or to the one before or after
  doubled      copy of the last reply of the station
  late         reply to a request that was given up or retried
  unexpected   reply without a request
  bad          bytes of no good frame
  missing      bytes that the capture does not have

JSON of a conversation: one object per line.")]
pub(crate) struct DecodeArgs {
    /// Framing: ascii or binary [default: by the first frame]
    #[arg(long)]
    pub(crate) framing: Option<Framing>,
    /// File with frames or a conversation of any form; - for the standard input
    #[arg(short, long, value_name = "FILE", value_hint = ValueHint::FilePath, conflicts_with = "hex")]
    pub(crate) file: Option<PathBuf>,
    /// Port of the PLC in a capture, TCP and UDP; repeat for others
    #[arg(long = "port", value_name = "PORT", default_value = "500")]
    pub(crate) ports: Vec<u16>,
    /// Explain the frames of a conversation field by field, too
    #[arg(long)]
    pub(crate) fields: bool,
    /// Bytes of the frames: digits such as 02 46 or 0x02,0x46, escapes, an array, or a dump [default: the
    /// standard input]
    #[arg(value_name = "HEX")]
    pub(crate) hex: Vec<String>,
}
