//! Endpoints: the address of a PLC as a URL.

mod in_step;
mod serial;

use std::fmt;
use std::str::FromStr;

use crate::wire::Framing;

use in_step::InStepOptions;
pub use in_step::{DEFAULT_COPIES, DEFAULT_COPY_WINDOW, DEFAULT_QUIET, InStepSettings, MAX_COPIES};
pub use serial::{DataBits, MAX_BAUD, MIN_BAUD, Parity, SerialSettings, StopBits};

/// Address, transport and framing of a PLC or a line of PLCs, written as a URL.
///
/// - `tcp://host[:port]`: a TCP connection, as to an Ethernet module
/// - `udp://host[:port]`: UDP, one frame per datagram
/// - `serial:path[?baud=9600&frame=7E1]`: a serial port, with its path or name, baud rate, and data
///   bits, parity (`N`, `E`, `O`) and stop bits
///
/// Options follow a `?`, separated by `&`. Options of all transports, with their defaults:
///
/// - `framing=ascii`: `ascii` or `binary`.
/// - `copies=1`: number of exchanges after which a duplicate of a reply can still come, 0 to 8. A
///   higher number costs more checks between requests of the same shape; 0 is for lines without
///   duplicates.
/// - `window=100ms`: silence of a station after which no duplicate comes. A longer time costs a
///   check between equal requests with a shorter pause.
/// - `quiet=1s`: silence that replaces the check of a station that refuses it (4E). The first
///   request of a connection waits this long, and so does the first after an unexpected reply.
/// - `one_request=false`: `true` if the gateway closes the connection after each reply. Each
///   request waits for the quiet time, since a check would use up the connection.
///
/// Times are in `ms` or `s`, at most a day, and can have decimals: `1.5s`. See [`InStepSettings`]
/// for the last four options.
///
/// Default port: 500 with the ASCII framing; required with the binary framing. An IPv6 address is
/// in brackets. Default of a serial port: 9600 baud and 7E1, or 8N1 with the binary framing,
/// which needs 8 data bits.
///
/// ```
/// use fatek::Endpoint;
/// use fatek::wire::Framing;
///
/// let endpoint: Endpoint = "tcp://192.168.2.3".parse()?;
/// assert_eq!(endpoint.to_string(), "tcp://192.168.2.3:500");
/// let endpoint: Endpoint = "udp://[fe80::1]:5000?framing=binary".parse()?;
/// assert_eq!(endpoint.framing(), Framing::Binary);
/// let endpoint: Endpoint = "serial:/dev/ttyUSB0?baud=19200&frame=7E1".parse()?;
/// assert_eq!(endpoint.to_string(), "serial:/dev/ttyUSB0?baud=19200");
/// let endpoint: Endpoint = "tcp://192.168.2.3?copies=2&quiet=500ms".parse()?;
/// assert_eq!(endpoint.in_step().copies(), 2);
/// # Ok::<(), fatek::ParseEndpointError>(())
/// ```
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct Endpoint {
    transport: Transport,
    framing: Framing,
    in_step: InStepSettings,
}

/// The transport of an endpoint, with its address.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum Transport {
    /// A TCP connection.
    #[non_exhaustive]
    Tcp {
        /// Host name or address; an IPv6 address without brackets.
        host: String,
        /// The port.
        port: u16,
    },
    /// UDP, one frame per datagram.
    #[non_exhaustive]
    Udp {
        /// Host name or address; an IPv6 address without brackets.
        host: String,
        /// The port.
        port: u16,
    },
    /// A serial port.
    #[non_exhaustive]
    Serial {
        /// Its name in the operating system: `/dev/ttyUSB0`, `COM3`.
        path: String,
        /// Baud rate, data bits, parity and stop bits.
        settings: SerialSettings,
    },
}

/// Default port, TCP and UDP: that of FATEK's Ethernet modules.
pub const DEFAULT_PORT: u16 = 500;

impl Endpoint {
    /// A TCP endpoint with the ASCII framing.
    #[must_use]
    pub fn tcp(host: impl Into<String>, port: u16) -> Self {
        Self::new(Transport::Tcp { host: host.into(), port })
    }

    /// A UDP endpoint with the ASCII framing.
    #[must_use]
    pub fn udp(host: impl Into<String>, port: u16) -> Self {
        Self::new(Transport::Udp { host: host.into(), port })
    }

    /// A serial endpoint with the ASCII framing, 9600 baud and 7E1.
    ///
    /// ```
    /// use fatek::Endpoint;
    /// use fatek::endpoint::SerialSettings;
    /// use fatek::wire::Framing;
    ///
    /// let fast = SerialSettings::new(Framing::Ascii).with_baud(115_200)?;
    /// let endpoint = Endpoint::serial("/dev/ttyUSB0").with_serial(fast)?;
    /// assert_eq!(endpoint.to_string(), "serial:/dev/ttyUSB0?baud=115200");
    /// # Ok::<(), fatek::endpoint::InvalidSettings>(())
    /// ```
    #[must_use]
    pub fn serial(path: impl Into<String>) -> Self {
        Self::new(Transport::Serial { path: path.into(), settings: SerialSettings::new(Framing::Ascii) })
    }

    fn new(transport: Transport) -> Self {
        Self { transport, framing: Framing::Ascii, in_step: InStepSettings::new() }
    }

    /// Sets the settings of the serial port.
    ///
    /// # Errors
    /// [`InvalidSettings::NotSerial`] for another transport; [`InvalidSettings::DataBits`] for 7 data
    /// bits with the binary framing.
    pub fn with_serial(mut self, serial: SerialSettings) -> Result<Self, InvalidSettings> {
        match &mut self.transport {
            Transport::Serial { settings, .. } => {
                *settings = serial.check(self.framing)?;
                Ok(self)
            }
            Transport::Tcp { .. } | Transport::Udp { .. } => {
                Err(InvalidSettings::NotSerial { endpoint: self.to_string() })
            }
        }
    }

    /// Sets the framing.
    ///
    /// The binary framing needs 8 data bits: a serial port with 7 is set to 8N1.
    #[must_use]
    pub fn with_framing(mut self, framing: Framing) -> Self {
        self.framing = framing;
        if let Transport::Serial { settings, .. } = &mut self.transport
            && settings.check(framing).is_err()
        {
            *settings =
                settings.with_data_bits(DataBits::Eight).with_parity(Parity::None).with_stop_bits(StopBits::One);
        }
        self
    }

    /// Sets the assumptions about late and duplicate replies.
    #[must_use]
    pub fn with_in_step(mut self, in_step: InStepSettings) -> Self {
        self.in_step = in_step;
        self
    }

    /// The transport, with its address.
    #[must_use]
    pub fn transport(&self) -> &Transport {
        &self.transport
    }

    /// The framing.
    #[must_use]
    pub fn framing(&self) -> Framing {
        self.framing
    }

    /// The assumptions about late and duplicate replies.
    #[must_use]
    pub fn in_step(&self) -> InStepSettings {
        self.in_step
    }
}

impl From<std::net::SocketAddr> for Endpoint {
    /// A TCP endpoint with the ASCII framing.
    fn from(address: std::net::SocketAddr) -> Self {
        Self::tcp(address.ip().to_string(), address.port())
    }
}

impl From<&Self> for Endpoint {
    fn from(endpoint: &Self) -> Self {
        endpoint.clone()
    }
}

impl TryFrom<&str> for Endpoint {
    type Error = ParseEndpointError;

    fn try_from(text: &str) -> Result<Self, Self::Error> {
        text.parse()
    }
}

impl TryFrom<&String> for Endpoint {
    type Error = ParseEndpointError;

    fn try_from(text: &String) -> Result<Self, Self::Error> {
        text.parse()
    }
}

impl TryFrom<String> for Endpoint {
    type Error = ParseEndpointError;

    fn try_from(text: String) -> Result<Self, Self::Error> {
        text.parse()
    }
}

impl FromStr for Endpoint {
    type Err = ParseEndpointError;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        parse(text).map_err(|rule| ParseEndpointError { input: text.to_owned(), rule })
    }
}

impl fmt::Display for Endpoint {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut options = Vec::new();
        match &self.transport {
            Transport::Tcp { host, port } => write!(f, "tcp://{}", Authority { host, port: *port })?,
            Transport::Udp { host, port } => write!(f, "udp://{}", Authority { host, port: *port })?,
            Transport::Serial { path, settings } => {
                write!(f, "serial:{path}")?;
                let usual = SerialSettings::new(self.framing);
                if settings.baud() != usual.baud() {
                    options.push(format!("baud={}", settings.baud()));
                }
                if settings.character() != usual.character() {
                    options.push(format!("frame={}", settings.character()));
                }
            }
        }
        match self.framing {
            Framing::Ascii => {}
            framing @ Framing::Binary => options.push(format!("framing={framing}")),
        }
        options.extend(self.in_step.options());
        for (position, option) in options.iter().enumerate() {
            write!(f, "{}{option}", if position == 0 { '?' } else { '&' })?;
        }
        Ok(())
    }
}

struct Authority<'a> {
    host: &'a str,
    port: u16,
}

impl fmt::Display for Authority<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { host, port } = self;
        if host.contains(':') { write!(f, "[{host}]:{port}") } else { write!(f, "{host}:{port}") }
    }
}

/// Invalid settings of an endpoint.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum InvalidSettings {
    /// The baud rate is not [`MIN_BAUD`] to [`MAX_BAUD`].
    #[error("the baud rate {baud} is not within {MIN_BAUD} to {MAX_BAUD}")]
    Baud {
        /// The baud rate.
        baud: u32,
    },
    /// The number of copies is more than [`MAX_COPIES`].
    #[error("the number of copies {copies} is not within 0 to {MAX_COPIES}")]
    Copies {
        /// The number.
        copies: u8,
    },
    /// The binary framing needs 8 data bits.
    #[error("the binary framing needs 8 data bits, and {settings} has {}", settings.data_bits())]
    DataBits {
        /// The settings.
        settings: SerialSettings,
    },
    /// The endpoint is not a serial port.
    #[error("{endpoint} is not a serial port")]
    NotSerial {
        /// The endpoint.
        endpoint: String,
    },
}

/// A text that is not an endpoint, with the rule that it breaks.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("`{input}` is not an endpoint: {rule}")]
pub struct ParseEndpointError {
    input: String,
    rule: String,
}

fn parse(text: &str) -> Result<Endpoint, String> {
    let (scheme, rest) = text.split_once(':').ok_or(SCHEMES)?;
    if scheme.eq_ignore_ascii_case("serial") {
        return parse_serial(rest);
    }
    let rest = rest.strip_prefix("//").ok_or(SCHEMES)?;
    let endpoint: fn(String, u16) -> Endpoint = match scheme.to_ascii_lowercase().as_str() {
        "tcp" => Endpoint::tcp,
        "udp" => Endpoint::udp,
        _ => return Err(format!("unknown transport `{scheme}`: it must be `tcp`, `udp` or `serial`")),
    };
    let (authority, options) = split_options(rest)?;
    if let Some(name) = options.baud.and(Some("baud")).or(options.frame.and(Some("frame"))) {
        return Err(format!("the option `{name}` is for serial ports, not for {scheme}"));
    }
    let authority = authority.strip_suffix('/').unwrap_or(authority);
    let (host, port) = split_authority(authority)?;
    let port = match port {
        Some(port) => match port.parse() {
            Ok(number) if number > 0 && port.bytes().all(|b| b.is_ascii_digit()) => number,
            _ => return Err(format!("the port `{port}` must be a number from 1 to 65535")),
        },
        None if options.framing == Framing::Ascii => DEFAULT_PORT,
        None => {
            return Err(format!(
                "the binary framing has no default port: state it, as in `{scheme}://host:port?framing=binary`"
            ));
        }
    };
    Ok(endpoint(host.to_owned(), port).with_framing(options.framing).with_in_step(options.in_step.parse()?))
}

const SCHEMES: &str = "it must begin with `tcp://`, `udp://` or `serial:`";

fn parse_serial(rest: &str) -> Result<Endpoint, String> {
    let (path, options) = split_options(rest)?;
    // A URL with an empty authority, `serial:///dev/ttyUSB0`, has the same path.
    let path = path.strip_prefix("//").filter(|path| path.starts_with('/')).unwrap_or(path);
    if path.is_empty() {
        return Err("the path of the port is missing, as in `serial:/dev/ttyUSB0` or `serial:COM3`".to_owned());
    }
    if path.starts_with("//") {
        return Err("the path follows `serial:` without `//`, as in `serial:/dev/ttyUSB0` or `serial:COM3`".to_owned());
    }
    if let Some(c) = path.chars().find(|c| c.is_control()) {
        return Err(format!("the path has the character {c:?}, which is not valid in the path of a port"));
    }
    let mut settings = SerialSettings::new(options.framing);
    if let Some(text) = options.baud {
        let baud = text.parse().ok().filter(|_| text.bytes().all(|b| b.is_ascii_digit()));
        settings = baud
            .and_then(|baud| settings.with_baud(baud).ok())
            .ok_or_else(|| format!("the baud rate `{text}` must be a number from {MIN_BAUD} to {MAX_BAUD}"))?;
    }
    if let Some(text) = options.frame {
        settings = settings.with_character(text).ok_or_else(|| {
            format!("the frame `{text}` must be data bits (7, 8), parity (N, E, O) and stop bits (1, 2), as in `7E1`")
        })?;
    }
    let endpoint = Endpoint::serial(path).with_framing(options.framing).with_in_step(options.in_step.parse()?);
    endpoint.with_serial(settings).map_err(|invalid| invalid.to_string())
}

/// The options behind the `?`.
#[derive(Default)]
struct Options<'a> {
    framing: Framing,
    baud: Option<&'a str>,
    frame: Option<&'a str>,
    in_step: InStepOptions<'a>,
}

fn split_options(text: &str) -> Result<(&str, Options<'_>), String> {
    let mut options = Options::default();
    let Some((address, query)) = text.split_once('?') else { return Ok((text, options)) };
    let mut framing = None;
    for option in query.split('&') {
        let (name, value) = option.split_once('=').unwrap_or((option, ""));
        let slot = match name {
            "framing" => &mut framing,
            "baud" => &mut options.baud,
            "frame" => &mut options.frame,
            "copies" => &mut options.in_step.copies,
            "window" => &mut options.in_step.window,
            "quiet" => &mut options.in_step.quiet,
            "one_request" => &mut options.in_step.one_request,
            _ => {
                return Err(format!(
                    "unknown option `{option}`: it must be `framing`, `copies`, `window`, `quiet` or `one_request`, \
                     or, for a serial port, `baud` or `frame`"
                ));
            }
        };
        if slot.replace(value).is_some() {
            return Err(format!("the option `{name}` is given twice"));
        }
    }
    if let Some(framing) = framing {
        options.framing = framing.parse().map_err(|error| format!("{error}"))?;
    }
    Ok((address, options))
}

/// Host and port of `host`, `host:port`, `[v6]` and `[v6]:port`.
fn split_authority(authority: &str) -> Result<(&str, Option<&str>), String> {
    let (host, port) = if let Some(bracketed) = authority.strip_prefix('[') {
        let (host, rest) = bracketed.split_once(']').ok_or("the bracket of the IPv6 address is not closed")?;
        if host.parse::<std::net::Ipv6Addr>().is_err() {
            return Err(format!("`{host}` is not an IPv6 address"));
        }
        match rest.strip_prefix(':') {
            Some(port) => (host, Some(port)),
            None if rest.is_empty() => (host, None),
            None => return Err(format!("`{rest}` follows the IPv6 address where only `:port` can")),
        }
    } else {
        match authority.split_once(':') {
            Some((host, port)) => (host, Some(port)),
            None => (authority, None),
        }
    };
    if host.is_empty() {
        return Err("the host is missing".to_owned());
    }
    let invalid = host.chars().find(|c| !(c.is_alphanumeric() || "-._:".contains(*c)));
    match invalid {
        Some(c) => Err(format!("the host `{host}` has the character {c:?}, which is not valid in a host name")),
        None => Ok((host, port)),
    }
}

#[cfg(test)]
mod tests;
