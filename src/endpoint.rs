//! Endpoints: the address of a PLC as a URL.

mod stream;

use std::fmt;
use std::io;
use std::str::FromStr;

use crate::printable::excerpt;
use crate::settings::{URL_OPTIONS, UrlOptions, one_of};
use crate::wire::Framing;

pub use self::stream::EndpointStream;
pub use crate::settings::{
    DEFAULT_COPIES, DEFAULT_COPY_WINDOW, DEFAULT_QUIET, DataBits, InStepSettings, InvalidSettings, MAX_BAUD,
    MAX_COPIES, MIN_BAUD, Parity, Rts, SerialSettings, StopBits,
};
pub use crate::transport::{DEFAULT_PORT, Transport};

/// Address, transport and framing of a PLC or a line of PLCs, written as a URL.
///
/// - `tcp://host[:port]`: a TCP connection, as to an Ethernet module
/// - `udp://host[:port]`: UDP, one frame per datagram
/// - `serial:path[?baud=9600&frame=7E1]`: a serial port, with its path or name, baud rate, and data
///   bits, parity (`N`, `E`, `O`) and stop bits
///
/// Further options of a serial port:
///
/// - `dtr=on`, `dtr=off`, `rts=on`, `rts=off`: levels of these lines while the port is open. Default:
///   as the operating system leaves them.
/// - `rs485=rts`, `rs485=rts-inverted`: RTS is the direction of an RS-485 driver, on or off while
///   sending; see [`Rts`]. Most RS-485 adapters switch by themselves and need neither.
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
/// - `settle=0ms`: pause after the connection is opened, for devices that lose what they are sent
///   just after that.
///
/// Times are in `ms` or `s`, at most a day, and can have decimals: `1.5s`. See [`InStepSettings`]
/// for the last five options.
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

impl Endpoint {
    /// A TCP endpoint with the ASCII framing.
    #[must_use]
    pub fn tcp(host: impl Into<String>, port: u16) -> Self {
        Transport::Tcp { host: host.into(), port }.into()
    }

    /// A UDP endpoint with the ASCII framing.
    #[must_use]
    pub fn udp(host: impl Into<String>, port: u16) -> Self {
        Transport::Udp { host: host.into(), port }.into()
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
        Transport::Serial { path: path.into(), settings: SerialSettings::new(Framing::Ascii) }.into()
    }

    /// Sets the settings of the serial port.
    ///
    /// # Errors
    /// [`InvalidSettings::NotSerial`] for another transport; [`InvalidSettings::DataBits`] for 7 data
    /// bits with the binary framing.
    pub fn with_serial(mut self, serial: SerialSettings) -> Result<Self, InvalidSettings> {
        match self.transport.serial_settings_mut() {
            Some(settings) => {
                *settings = serial.check(self.framing)?;
                Ok(self)
            }
            None => Err(InvalidSettings::NotSerial { endpoint: self.to_string() }),
        }
    }

    /// Sets the framing.
    ///
    /// The binary framing needs 8 data bits: a serial port with 7 is set to 8N1.
    #[must_use]
    pub fn with_framing(mut self, framing: Framing) -> Self {
        self.framing = framing;
        if let Some(settings) = self.transport.serial_settings_mut() {
            *settings = settings.for_framing(framing);
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

    /// Opens a connection as a plain stream, for the codecs of [`wire`](crate::wire) without a
    /// [`Link`](crate::Link).
    ///
    /// Opens the host or the port as a link does, but checks nothing: frames can be late, doubled,
    /// or echoes. It does not wait for the time of [`settle`](InStepSettings::settle). Over UDP
    /// each write is one datagram, and the reads after it return only datagrams that answer it.
    ///
    /// ```
    /// use fatek::command::ReadStatus;
    /// use fatek::sim::Plc;
    /// use fatek::wire::{Codec, Frame, Framing, Received, Side};
    /// use futures::{SinkExt, StreamExt};
    /// use tokio_util::codec::Framed;
    ///
    /// # #[tokio::main(flavor = "current_thread")]
    /// # async fn main() -> Result<(), Box<dyn std::error::Error>> {
    /// let plc = Plc::new().serve("127.0.0.1:0").await?;
    /// let codec = Codec::new(Framing::Ascii, Side::Client);
    /// let mut line = Framed::new(plc.endpoint().open().await?, codec);
    /// line.send(Frame::request(1, &ReadStatus, Framing::Ascii)?).await?;
    /// let Some(Received::Frame(reply)) = line.next().await.transpose()? else { panic!("no frame") };
    /// assert!(!reply.decode_reply(&ReadStatus, Framing::Ascii)?.flags().running());
    /// # Ok(())
    /// # }
    /// ```
    ///
    /// Cancel-safe: a connection that is open by then is closed.
    ///
    /// # Errors
    /// Those of the operating system; of a serial port also without the feature `serial`. There is no
    /// timeout: one of TCP takes minutes, so set your own.
    pub async fn open(&self) -> io::Result<EndpointStream> {
        self.transport.open(self.framing, true, 0).await.map(EndpointStream::new)
    }
}

impl From<Transport> for Endpoint {
    /// An endpoint with the ASCII framing.
    fn from(transport: Transport) -> Self {
        Self { transport, framing: Framing::Ascii, in_step: InStepSettings::new() }
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
        self.transport.write_address(f)?;
        let mut options = self.transport.url_options(self.framing);
        match self.framing {
            Framing::Ascii => {}
            framing @ Framing::Binary => options.push(format!("framing={framing}")),
        }
        options.extend(self.in_step.url_options());
        for (position, option) in options.iter().enumerate() {
            write!(f, "{}{option}", if position == 0 { '?' } else { '&' })?;
        }
        Ok(())
    }
}

/// A text that is not an endpoint, with the rule that it breaks.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("`{}` is not an endpoint: {rule}", excerpt(input))]
pub struct ParseEndpointError {
    input: String,
    rule: String,
}

fn parse(text: &str) -> Result<Endpoint, String> {
    let (scheme, rest) = Transport::split_scheme(text)?;
    let (address, options) = split_options(rest)?;
    let framing = match options.get("framing") {
        Some(framing) => framing.parse().map_err(|error| format!("{error}"))?,
        None => Framing::Ascii,
    };
    let transport = Transport::from_url(&scheme, address, framing, &options)?;
    let in_step = InStepSettings::from_url(&options)?;
    if let Some(settings) = transport.serial_settings() {
        settings.check(framing).map_err(|invalid| invalid.to_string())?;
    }
    Ok(Endpoint { transport, framing, in_step })
}

fn split_options(text: &str) -> Result<(&str, UrlOptions<'_>), String> {
    let mut options = UrlOptions::default();
    let Some((address, query)) = text.split_once('?') else { return Ok((text, options)) };
    for option in query.split('&') {
        let (name, value) = option.split_once('=').unwrap_or((option, ""));
        if name != "framing" && !URL_OPTIONS.contains(&name) && !Transport::has_url_option(name) {
            let (common, own) = (one_of(["framing"].into_iter().chain(URL_OPTIONS)), Transport::own_url_options());
            return Err(format!("unknown option `{}`: it must be {common}{own}", excerpt(option)));
        }
        if !options.add(name, value) {
            return Err(format!("the option `{}` is given twice", excerpt(name)));
        }
    }
    Ok((address, options))
}

#[cfg(test)]
mod tests;
