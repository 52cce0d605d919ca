//! Transports: the addresses of endpoints, and the streams that are opened to them.
//!
//! Everything that differs between transports is a field of [`Kind`] or an arm in a method of
//! [`Transport`]; each transport has a file of its own. No other file of the crate matches the
//! variants, so a new transport takes its file and its arms here.

mod authority;
mod lookup;
mod serial;
mod tcp;
mod udp;

use std::any::Any;
use std::fmt;
use std::io;

use tokio::io::{AsyncRead, AsyncWrite};

use crate::printable::excerpt;
use crate::settings::{SerialSettings, UrlOptions, one_of};
use crate::wire::Framing;

pub use self::authority::DEFAULT_PORT;
pub(crate) use self::udp::LateDatagrams;

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

/// The properties of a transport that do not depend on the address.
struct Kind {
    /// The beginning of its URLs: scheme, colon and, before a host, two slashes.
    prefix: &'static str,
    /// The options of its own in a URL.
    own_options: Option<OwnOptions>,
    /// See [`Transport::is_remote`].
    is_remote: bool,
    /// See [`Transport::is_one_line`].
    is_one_line: bool,
    /// Parses the address in a URL. The error is the rule that it breaks.
    parse: fn(&Address<'_>) -> Result<Transport, String>,
}

/// Options of a single transport.
struct OwnOptions {
    names: &'static [&'static str],
    /// The endpoints that have them, for messages: singular and plural.
    owner: (&'static str, &'static str),
}

/// The parts of a URL that an address is parsed from.
struct Address<'a> {
    /// The scheme as it was written.
    scheme: &'a str,
    text: &'a str,
    framing: Framing,
    options: &'a UrlOptions<'a>,
}

/// The scheme of a URL.
pub(crate) struct Scheme<'a> {
    kind: &'static Kind,
    /// As it was written.
    written: &'a str,
}

/// All transports, in the order of messages.
static KINDS: [&Kind; 3] = [&tcp::KIND, &udp::KIND, &serial::KIND];

impl Kind {
    fn scheme(&self) -> &'static str {
        self.prefix.split_once(':').map_or(self.prefix, |(scheme, _)| scheme)
    }

    fn option_names(&self) -> &'static [&'static str] {
        self.own_options.as_ref().map_or(&[], |own| own.names)
    }
}

impl Transport {
    fn kind(&self) -> &'static Kind {
        match self {
            Self::Tcp { .. } => &tcp::KIND,
            Self::Udp { .. } => &udp::KIND,
            Self::Serial { .. } => &serial::KIND,
        }
    }

    /// Writes the address as in a URL, without options.
    pub(crate) fn write_address(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.kind().prefix)?;
        match self {
            Self::Tcp { host, port } | Self::Udp { host, port } => authority::write(f, host, *port),
            Self::Serial { path, .. } => f.write_str(path),
        }
    }

    /// The options of the transport's own for a URL: those that differ from their defaults.
    pub(crate) fn url_options(&self, framing: Framing) -> Vec<String> {
        match self {
            Self::Tcp { .. } | Self::Udp { .. } => Vec::new(),
            Self::Serial { settings, .. } => settings.url_options(framing).collect(),
        }
    }

    /// Returns the identity of the address: equal for all spellings and settings of one host and
    /// port, or of one serial port.
    pub(crate) fn identity(&self) -> Self {
        match self {
            Self::Tcp { host, port } => Self::Tcp { host: authority::identity(host), port: *port },
            Self::Udp { host, port } => Self::Udp { host: authority::identity(host), port: *port },
            Self::Serial { path, .. } => serial::identity(path),
        }
    }

    /// The settings of the serial port, if it is one.
    #[must_use]
    pub fn serial_settings(&self) -> Option<SerialSettings> {
        match self {
            Self::Tcp { .. } | Self::Udp { .. } => None,
            Self::Serial { settings, .. } => Some(*settings),
        }
    }

    /// The settings of the serial port, to be changed.
    pub(crate) fn serial_settings_mut(&mut self) -> Option<&mut SerialSettings> {
        match self {
            Self::Tcp { .. } | Self::Udp { .. } => None,
            Self::Serial { settings, .. } => Some(settings),
        }
    }

    /// Opens a stream to the address. `keep_alive` is TCP's; `address` is the number
    /// by which UDP chooses among several addresses of the host.
    pub(crate) async fn open(&self, framing: Framing, keep_alive: bool, address: usize) -> io::Result<BoxIo> {
        Ok(match self {
            Self::Tcp { host, port } => Box::new(tcp::connect(host, *port, keep_alive).await?),
            Self::Udp { host, port } => Box::new(udp::connect(host, *port, framing, address).await?),
            Self::Serial { path, settings } => Box::new(serial::open(path, *settings).await?),
        })
    }

    /// Returns whether opening it puts load on a PLC or its module: then a pool limits the
    /// attempts.
    pub(crate) fn is_remote(&self) -> bool {
        self.kind().is_remote
    }

    /// Returns whether all connections to the address would share one line, with one set of
    /// settings: then a pool opens only one.
    pub(crate) fn is_one_line(&self) -> bool {
        self.kind().is_one_line
    }

    /// Splits a URL into its scheme and the rest: address and options. The error is the rule that
    /// the URL breaks.
    pub(crate) fn split_scheme(url: &str) -> Result<(Scheme<'_>, &str), String> {
        let prefixes = || format!("it must begin with {}", one_of(KINDS.map(|kind| kind.prefix)));
        let (written, rest) = url.split_once(':').ok_or_else(prefixes)?;
        match KINDS.into_iter().find(|kind| kind.scheme().eq_ignore_ascii_case(written)) {
            Some(kind) => {
                let slashes = if kind.prefix.ends_with("//") { "//" } else { "" };
                let rest = rest.strip_prefix(slashes).ok_or_else(prefixes)?;
                Ok((Scheme { kind, written }, rest))
            }
            None if rest.starts_with("//") => {
                let schemes = one_of(KINDS.map(Kind::scheme));
                Err(format!("unknown transport `{}`: it must be {schemes}", excerpt(written)))
            }
            None => Err(prefixes()),
        }
    }

    /// Parses the address of a URL, with the options of the transport's own. The error is the rule
    /// that it breaks.
    pub(crate) fn from_url(
        scheme: &Scheme<'_>,
        text: &str,
        framing: Framing,
        options: &UrlOptions<'_>,
    ) -> Result<Self, String> {
        let Scheme { kind, written: scheme } = *scheme;
        for other in KINDS.iter().filter_map(|kind| kind.own_options.as_ref()) {
            let foreign =
                other.names.iter().find(|name| options.get(name).is_some() && !kind.option_names().contains(name));
            if let Some(name) = foreign {
                return Err(format!("the option `{name}` is for {}, not for {scheme}", other.owner.1));
            }
        }
        (kind.parse)(&Address { scheme, text, framing, options })
    }

    /// Returns whether a transport has an option of this name.
    pub(crate) fn has_url_option(name: &str) -> bool {
        KINDS.iter().any(|kind| kind.option_names().contains(&name))
    }

    /// The end of a message about an unknown option: the options of single transports.
    pub(crate) fn own_url_options() -> String {
        let own = KINDS.iter().filter_map(|kind| kind.own_options.as_ref());
        own.map(|own| format!(", or, for {}, {}", own.owner.0, one_of(own.names.iter().copied()))).collect()
    }
}

/// A connection.
pub(crate) trait Io: AsyncRead + AsyncWrite + Send + Unpin + Any {}
impl<T: AsyncRead + AsyncWrite + Send + Unpin + Any> Io for T {}

pub(crate) type BoxIo = Box<dyn Io>;

impl dyn Io {
    /// Returns whether the peer has closed the connection, as the operating system knows: the
    /// runtime may not have looked since. Of TCP only.
    pub(crate) fn is_closed_by_peer(&self) -> bool {
        let io: &dyn Any = self;
        io.downcast_ref().is_some_and(tcp::is_closed_by_peer)
    }

    /// Returns whether another connection may go to another address of the host: of UDP only, whose
    /// opening does not show which of them are there.
    pub(crate) fn has_other_addresses(&self) -> bool {
        let io: &dyn Any = self;
        io.downcast_ref().is_some_and(udp::Datagrams::has_other_addresses)
    }

    /// Returns the datagrams of earlier requests dropped since the last call; none for anything but
    /// UDP.
    ///
    /// Not a method of the trait: it would be found on the box first, which is itself a connection.
    pub(crate) fn take_late(&mut self) -> LateDatagrams {
        let io: &mut dyn Any = self;
        io.downcast_mut().map(udp::Datagrams::take_late).unwrap_or_default()
    }
}

#[cfg(test)]
mod tests;
