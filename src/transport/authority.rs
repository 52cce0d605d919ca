//! Host and port in a URL.

use std::fmt;

use crate::printable::excerpt;
use crate::wire::Framing;

/// Default port, TCP and UDP: that of FATEK's Ethernet modules.
pub const DEFAULT_PORT: u16 = 500;

/// Parses `host`, `host:port`, `[v6]` and `[v6]:port`, also with a `/` at the end.
///
/// `scheme` is for the message of an error.
pub(super) fn parse(scheme: &str, authority: &str, framing: Framing) -> Result<(String, u16), String> {
    let authority = authority.strip_suffix('/').unwrap_or(authority);
    let (host, port) = split(authority)?;
    let port = match (port, framing) {
        (Some(port), _) => match port.parse() {
            Ok(number) if number > 0 && port.bytes().all(|b| b.is_ascii_digit()) => number,
            _ => return Err(format!("the port `{}` must be a number from 1 to 65535", excerpt(port))),
        },
        (None, Framing::Ascii) => DEFAULT_PORT,
        (None, Framing::Binary) => {
            return Err(format!(
                "the binary framing has no default port: state it, as in `{scheme}://host:port?framing=binary`"
            ));
        }
    };
    Ok((host.to_owned(), port))
}

/// Writes host and port.
pub(super) fn write(f: &mut fmt::Formatter<'_>, host: &str, port: u16) -> fmt::Result {
    if host.contains(':') { write!(f, "[{host}]:{port}") } else { write!(f, "{host}:{port}") }
}

/// The identity of a host: names are case-insensitive.
pub(super) fn identity(host: &str) -> String {
    host.to_ascii_lowercase()
}

/// Splits an authority into the host, without brackets, and the port.
fn split(authority: &str) -> Result<(&str, Option<&str>), String> {
    let (host, port) = if let Some(bracketed) = authority.strip_prefix('[') {
        let (host, rest) = bracketed.split_once(']').ok_or("the bracket of the IPv6 address is not closed")?;
        if host.parse::<std::net::Ipv6Addr>().is_err() {
            return Err(format!("`{}` is not an IPv6 address", excerpt(host)));
        }
        match rest.strip_prefix(':') {
            Some(port) => (host, Some(port)),
            None if rest.is_empty() => (host, None),
            None => return Err(format!("`{}` follows the IPv6 address where only `:port` can", excerpt(rest))),
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
        Some(c) => {
            Err(format!("the host `{}` has the character {c:?}, which is not valid in a host name", excerpt(host)))
        }
        None => Ok((host, port)),
    }
}
