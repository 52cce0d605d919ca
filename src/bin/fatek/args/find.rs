//! Arguments of `fatek ports` and `fatek detect`.

use std::path::PathBuf;

use clap::{Args, ValueHint};
use fatek::wire::Framing;

use crate::detect::trials::{Baud, Character};

/// List the serial ports of this computer
///
/// With driver, USB names and the right to open them. No port is opened.
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  fatek ports
  fatek ports --format json

The column access says whether this user may open the port, by the rights of its
device file (Linux); another program may have it open.
JSON: array of objects with port, driver, usb (numbers of vendor and product),
manufacturer, product, serial, by_id (a name that stays the same), access and
note; unknown values are null.")]
pub(crate) struct PortsArgs {
    /// Folder with the sys, dev and etc of the system to list (Linux)
    #[cfg_attr(not(target_os = "linux"), allow(dead_code, reason = "other systems have a library for it"))]
    #[arg(long, hide = true, default_value = "/", value_name = "FOLDER")]
    pub(crate) root: PathBuf,
}

/// Find speed, frame, framing and station of a serial line
///
/// Reads the status of a station with one setting after the other, the likely ones first, until a
/// station answers, and then asks the others. It never writes. The port is opened for itself alone:
/// close other programs. On a serial line that another master is working on, nothing is sent.
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  fatek detect /dev/ttyUSB0
  fatek detect COM3 --baud 9600,19200 --stations 1-16
  fatek detect 'serial:/dev/ttyS1?rs485=rts' --frame 7E1,8N1
  fatek detect tcp://192.168.2.9:4001

The time that it can take is printed first. `fatek ports` lists the ports. Of
tcp:// and udp:// only framing and station are found: speed and frame are set in
the module or device server.

Column answer:
  sure    each of several requests was answered, and nothing else came
  likely  some were not answered, or other bytes came besides
  heard   good frames of another master or station came, and no answer

The column model has the main unit and the version of its OS.
JSON: array of objects with link, baud, frame, framing, station, answer,
requests, replies, running, main_unit, os_version, time_ms and note; unknown
values are null.
Exit status 0 if a station answers, 4 if none does or the line is busy, 5 if the
port cannot be opened or the line is lost at each request.")]
pub(crate) struct DetectArgs {
    /// Port such as /dev/ttyUSB0 or COM3, or a URL: serial:PATH, tcp://HOST:PORT, udp://HOST:PORT
    #[arg(value_name = "SERIAL", value_hint = ValueHint::AnyPath)]
    pub(crate) line: String,
    /// Speeds to try, in this order [default: 9600,19200,38400,115200,57600]
    ///
    /// PLCs also have 4800, 76800, 153600, 230400, 307200, 614400 and 921600.
    #[arg(long, value_name = "BAUD", value_delimiter = ',')]
    pub(crate) baud: Vec<Baud>,
    /// Frames to try: data bits, parity, stop bits [default: 7E1,8N1,8E1,7N1,7O1,8O1]
    #[arg(long, value_name = "FRAME", value_delimiter = ',')]
    pub(crate) frame: Vec<Character>,
    /// Framing: ascii or binary [default: both; binary with 8 data bits only]
    #[arg(long)]
    pub(crate) framing: Option<Framing>,
    /// Stations to try, such as 1-4,9
    #[arg(long, value_name = "LIST", default_value = "1-4")]
    pub(crate) stations: String,
    /// Send requests even if another master is heard on the line: they disturb each other
    #[arg(long)]
    pub(crate) busy: bool,
}
