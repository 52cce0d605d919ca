//! Serial ports: their URL. `port` opens them.

#[cfg_attr(not(feature = "serial"), path = "serial/no_port.rs")]
mod port;

pub(super) use self::port::open;
use super::{Address, Kind, OwnOptions, Transport};
use crate::settings::{SERIAL_URL_OPTIONS, SerialSettings};
use crate::wire::Framing;

pub(super) static KIND: Kind = Kind {
    prefix: "serial:",
    own_options: Some(OwnOptions { names: SERIAL_URL_OPTIONS, owner: ("a serial port", "serial ports") }),
    is_remote: false,
    is_one_line: true,
    parse,
};

/// The port with this path, with the default settings of the ASCII framing.
pub(super) fn new(path: &str) -> Transport {
    Transport::Serial { path: path.to_owned(), settings: SerialSettings::new(Framing::Ascii) }
}

/// The identity of a port. Names of ports of Windows, `COM1` and so on, are case-insensitive, and
/// can have the prefix of a device, `\\.\`, which is added when they are opened.
pub(super) fn identity(path: &str) -> Transport {
    let name = path.strip_prefix(r"\\.\").unwrap_or(path);
    let number = name.get(..3).filter(|begin| begin.eq_ignore_ascii_case("COM")).and_then(|_| name.get(3..));
    match number {
        Some(number) if !number.is_empty() && number.bytes().all(|b| b.is_ascii_digit()) => {
            new(&format!("COM{number}"))
        }
        Some(_) | None => new(path),
    }
}

fn parse(address: &Address<'_>) -> Result<Transport, String> {
    // A URL with an empty authority, `serial:///dev/ttyUSB0`, has the same path.
    let path = address.text.strip_prefix("//").filter(|path| path.starts_with('/')).unwrap_or(address.text);
    if path.is_empty() {
        return Err("the path of the port is missing, as in `serial:/dev/ttyUSB0` or `serial:COM3`".to_owned());
    }
    if path.starts_with("//") {
        return Err("the path follows `serial:` without `//`, as in `serial:/dev/ttyUSB0` or `serial:COM3`".to_owned());
    }
    if let Some(c) = path.chars().find(|c| c.is_control()) {
        return Err(format!("the path has the character {c:?}, which is not valid in the path of a port"));
    }
    let settings = SerialSettings::from_url(address.options, address.framing)?;
    Ok(Transport::Serial { path: path.to_owned(), settings })
}
