//! Where a PLC is: endpoints and how they are written.

use std::fmt;
use std::str::FromStr;

use crate::wire::Framing;

/// Where a PLC is, and how it talks.
///
/// Written as `tcp://host[:port][?framing=ascii|binary]`. The framing is ASCII unless stated; the port is 500 unless
/// stated, but must be stated for the binary framing, which has no usual one. An IPv6 address stands in brackets.
///
/// ```
/// use fatek::Endpoint;
/// use fatek::wire::Framing;
///
/// let endpoint: Endpoint = "tcp://192.168.2.3".parse()?;
/// assert_eq!(endpoint.to_string(), "tcp://192.168.2.3:500");
/// let endpoint: Endpoint = "tcp://[fe80::1]:5000?framing=binary".parse()?;
/// assert_eq!(endpoint.framing(), Framing::Binary);
/// # Ok::<(), fatek::ParseEndpointError>(())
/// ```
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct Endpoint {
    transport: Transport,
    framing: Framing,
}

/// What carries the bytes.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum Transport {
    /// A TCP connection.
    Tcp {
        /// A name or an address; an IPv6 address without its brackets.
        host: String,
        /// The port.
        port: u16,
    },
}

/// The port of FATEK's Ethernet modules.
pub const DEFAULT_PORT: u16 = 500;

impl Endpoint {
    /// A TCP endpoint with the ASCII framing.
    #[must_use]
    pub fn tcp(host: impl Into<String>, port: u16) -> Self {
        Self { transport: Transport::Tcp { host: host.into(), port }, framing: Framing::Ascii }
    }

    /// The same with another framing.
    #[must_use]
    pub fn with_framing(mut self, framing: Framing) -> Self {
        self.framing = framing;
        self
    }

    /// What carries the bytes.
    #[must_use]
    pub fn transport(&self) -> &Transport {
        &self.transport
    }

    /// How frames look.
    #[must_use]
    pub fn framing(&self) -> Framing {
        self.framing
    }
}

impl From<std::net::SocketAddr> for Endpoint {
    /// A TCP endpoint with the ASCII framing.
    fn from(address: std::net::SocketAddr) -> Self {
        Self::tcp(address.ip().to_string(), address.port())
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
        match &self.transport {
            Transport::Tcp { host, port } if host.contains(':') => write!(f, "tcp://[{host}]:{port}")?,
            Transport::Tcp { host, port } => write!(f, "tcp://{host}:{port}")?,
        }
        match self.framing {
            Framing::Ascii => Ok(()),
            framing @ Framing::Binary => write!(f, "?framing={framing}"),
        }
    }
}

/// A text that is not an endpoint: the text, and the rule it breaks.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("`{input}` is not an endpoint: {rule}")]
pub struct ParseEndpointError {
    input: String,
    rule: String,
}

fn parse(text: &str) -> Result<Endpoint, String> {
    let Some((scheme, rest)) = text.split_once("://") else {
        return Err("it must begin with `tcp://`".to_owned());
    };
    if !scheme.eq_ignore_ascii_case("tcp") {
        return Err(format!("the transport `{scheme}` is not known, only `tcp` is"));
    }
    let (authority, query) = match rest.split_once('?') {
        Some((authority, query)) => (authority, Some(query)),
        None => (rest, None),
    };
    let mut framing = Framing::Ascii;
    for option in query.into_iter().flat_map(|query| query.split('&')) {
        match option.split_once('=') {
            Some(("framing", value)) => framing = value.parse().map_err(|error| format!("{error}"))?,
            _ => {
                return Err(format!(
                    "the option `{option}` is not known, only `framing=ascii` and `framing=binary` are"
                ));
            }
        }
    }
    let authority = authority.strip_suffix('/').unwrap_or(authority);
    let (host, port) = split_authority(authority)?;
    let port = match port {
        Some(port) => match port.parse() {
            Ok(number) if number > 0 && port.bytes().all(|b| b.is_ascii_digit()) => number,
            _ => return Err(format!("the port `{port}` must be a number from 1 to 65535")),
        },
        None if framing == Framing::Ascii => DEFAULT_PORT,
        None => {
            return Err(
                "the binary framing has no usual port: state it, as in `tcp://host:port?framing=binary`".to_owned()
            );
        }
    };
    Ok(Endpoint { transport: Transport::Tcp { host: host.to_owned(), port }, framing })
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
    let strange = host.chars().find(|c| !(c.is_alphanumeric() || "-._:".contains(*c)));
    match strange {
        Some(c) => Err(format!("the host `{host}` has the character {c:?}, which no host name has")),
        None => Ok((host, port)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn endpoints_round_trip() {
        for (text, canonical) in [
            ("tcp://10.0.0.7", "tcp://10.0.0.7:500"),
            ("TCP://plc-1.example:501", "tcp://plc-1.example:501"),
            ("tcp://10.0.0.7:500?framing=ascii", "tcp://10.0.0.7:500"),
            ("tcp://10.0.0.7:4000/?framing=BINARY", "tcp://10.0.0.7:4000?framing=binary"),
            ("tcp://[::1]", "tcp://[::1]:500"),
            ("tcp://[fe80::1]:7?framing=binary", "tcp://[fe80::1]:7?framing=binary"),
        ] {
            let endpoint: Endpoint = text.parse().unwrap();
            assert_eq!(endpoint.to_string(), canonical);
            assert_eq!(canonical.parse(), Ok(endpoint));
        }
    }

    #[test]
    fn a_bad_endpoint_is_named_with_the_rule_it_breaks() {
        for (text, rule) in [
            ("", "it must begin with `tcp://`"),
            ("10.0.0.7:500", "it must begin with `tcp://`"),
            ("http://10.0.0.7", "the transport `http` is not known"),
            ("tcp://", "the host is missing"),
            ("tcp://:500", "the host is missing"),
            ("tcp://plc:0", "the port `0` must be a number from 1 to 65535"),
            ("tcp://plc:65536", "the port `65536` must be a number from 1 to 65535"),
            ("tcp://plc:+5", "the port `+5` must be a number from 1 to 65535"),
            ("tcp://plc:", "the port `` must be a number from 1 to 65535"),
            ("tcp://plc?framing=rtu", "`rtu` is not a framing"),
            ("tcp://plc?baud=9600", "the option `baud=9600` is not known"),
            ("tcp://plc?framing=binary", "the binary framing has no usual port"),
            ("tcp://[::1", "the bracket of the IPv6 address is not closed"),
            ("tcp://[plc]", "`plc` is not an IPv6 address"),
            ("tcp://[::1]500", "`500` follows the IPv6 address"),
            ("tcp://pl c", "the character ' '"),
            ("tcp://user@plc", "the character '@'"),
        ] {
            let message = text.parse::<Endpoint>().unwrap_err().to_string();
            assert!(message.starts_with(&format!("`{text}` is not an endpoint: ")), "{message}");
            assert!(message.contains(rule), "{message} should say: {rule}");
        }
    }

    proptest::proptest! {
        #[test]
        fn no_text_panics_and_every_accepted_text_round_trips(text in "(tcp://)?[\\PC]{0,24}") {
            if let Ok(endpoint) = text.parse::<Endpoint>() {
                proptest::prop_assert_eq!(endpoint.to_string().parse::<Endpoint>(), Ok(endpoint));
            }
        }
    }
}
