//! Addresses of servers: `mqtts://broker.plant:8883`, `nats://10.0.0.7`.

use std::fmt;
use std::marker::PhantomData;

use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::de::Error as _;
use serde::{Deserialize, Deserializer, Serialize, Serializer};

use crate::printable::excerpt;

/// A protocol with its schemes.
pub trait Protocol {
    /// Scheme and default port without TLS.
    const PLAIN: (&'static str, u16);
    /// Scheme and default port with TLS.
    const TLS: (&'static str, u16);
    /// The keys that take the credentials, which are no part of the URL.
    const CREDENTIALS: &'static str;
}

/// MQTT.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Mqtt {}

impl Protocol for Mqtt {
    const PLAIN: (&'static str, u16) = ("mqtt", 1883);
    const TLS: (&'static str, u16) = ("mqtts", 8883);
    const CREDENTIALS: &'static str = "user and password_file";
}

/// NATS.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Nats {}

impl Protocol for Nats {
    const PLAIN: (&'static str, u16) = ("nats", 4222);
    const TLS: (&'static str, u16) = ("tls", 4222);
    const CREDENTIALS: &'static str = "creds_file, or in user and password_file";
}

/// The address of a server: `SCHEME://HOST[:PORT]`.
///
/// It has no user, no password and no path, so that it can be logged.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ServerUrl<P> {
    host: String,
    port: u16,
    is_tls: bool,
    protocol: PhantomData<P>,
}

impl<P: Protocol> ServerUrl<P> {
    /// Parses a URL.
    ///
    /// # Errors
    /// The rule that the text breaks. It does not repeat the text, which may have a password.
    pub fn parse(text: &str) -> Result<Self, String> {
        let example = format!("{}://broker.plant:{}", P::TLS.0, P::TLS.1);
        let (scheme, rest) = text.split_once("://").ok_or_else(|| format!("a URL is as `{example}`"))?;
        let (is_tls, default_port) = match scheme {
            scheme if scheme == P::PLAIN.0 => (false, P::PLAIN.1),
            scheme if scheme == P::TLS.0 => (true, P::TLS.1),
            other => {
                let (plain, tls) = (P::PLAIN.0, P::TLS.0);
                return Err(format!("the scheme is {plain}, or {tls} with TLS, and not {}", excerpt(other)));
            }
        };
        if rest.contains('@') {
            return Err(format!("the URL has no user and no password: they are in {}", P::CREDENTIALS));
        }
        if rest.contains(['/', '?', '#']) {
            return Err(format!("nothing follows host and port of a URL, as in `{example}`"));
        }
        let (host, port) = split_port(rest)?;
        let port = match port {
            None => default_port,
            Some(port) => {
                let port = port.parse().ok().filter(|&port| port > 0);
                port.ok_or_else(|| "a port is a number from 1 to 65535".to_owned())?
            }
        };
        Ok(Self { host: host.to_owned(), port, is_tls, protocol: PhantomData })
    }

    /// Name or address; an IPv6 address without brackets.
    #[must_use]
    pub fn host(&self) -> &str {
        &self.host
    }

    /// The port.
    #[must_use]
    pub fn port(&self) -> u16 {
        self.port
    }

    /// Returns whether the connection uses TLS.
    #[must_use]
    pub fn is_tls(&self) -> bool {
        self.is_tls
    }

    /// Returns whether the server is on this host.
    #[must_use]
    pub fn is_loopback(&self) -> bool {
        let address = self.host.parse::<std::net::IpAddr>();
        self.host == "localhost" || address.is_ok_and(|address| address.is_loopback())
    }
}

/// Splits host and port. The host of an IPv6 address is in brackets, which are removed.
fn split_port(text: &str) -> Result<(&str, Option<&str>), String> {
    if let Some(rest) = text.strip_prefix('[') {
        let rule = "an IPv6 address is in brackets, as in `[fd00::7]:8883`";
        let (host, rest) = rest.split_once(']').ok_or(rule)?;
        host.parse::<std::net::Ipv6Addr>().map_err(|_| rule)?;
        return match (rest, rest.strip_prefix(':')) {
            ("", _) => Ok((host, None)),
            (_, Some(port)) => Ok((host, Some(port))),
            (_, None) => Err(rule.to_owned()),
        };
    }
    let (host, port) = match text.split_once(':') {
        Some((host, port)) => (host, Some(port)),
        None => (text, None),
    };
    if host.is_empty() {
        return Err("the host is missing".to_owned());
    }
    let is_part = |c: char| c.is_ascii_alphanumeric() || matches!(c, '.' | '-' | '_');
    if !host.chars().all(is_part) {
        return Err("a host has the characters A-Z a-z 0-9 . - _, or is an IPv6 address in brackets".to_owned());
    }
    Ok((host, port))
}

impl<P: Protocol> fmt::Display for ServerUrl<P> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { host, port, is_tls, .. } = self;
        let scheme = if *is_tls { P::TLS.0 } else { P::PLAIN.0 };
        if host.contains(':') { write!(f, "{scheme}://[{host}]:{port}") } else { write!(f, "{scheme}://{host}:{port}") }
    }
}

impl<P: Protocol> Serialize for ServerUrl<P> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

impl<'de, P: Protocol> Deserialize<'de> for ServerUrl<P> {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        Self::parse(&String::deserialize(deserializer)?).map_err(D::Error::custom)
    }
}

impl<P: Protocol> JsonSchema for ServerUrl<P> {
    fn inline_schema() -> bool {
        true
    }

    fn schema_name() -> std::borrow::Cow<'static, str> {
        format!("url_{}", P::PLAIN.0).into()
    }

    fn json_schema(_: &mut SchemaGenerator) -> Schema {
        let (plain, tls) = (P::PLAIN.0, P::TLS.0);
        let host = r"(\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9._-]+)";
        json_schema!({ "type": "string", "pattern": format!("^({plain}|{tls})://{host}(:[0-9]{{1,5}})?$") })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn urls_have_a_scheme_a_host_and_a_port() {
        for (text, shown) in [
            ("mqtt://broker", "mqtt://broker:1883"),
            ("mqtts://broker.plant", "mqtts://broker.plant:8883"),
            ("mqtts://[fd00::7]", "mqtts://[fd00::7]:8883"),
            ("mqtt://10.0.0.7:1884", "mqtt://10.0.0.7:1884"),
        ] {
            let url: ServerUrl<Mqtt> = ServerUrl::parse(text).unwrap();
            assert_eq!(url.to_string(), shown);
            assert_eq!(url, ServerUrl::parse(shown).unwrap());
        }
        let url: ServerUrl<Nats> = ServerUrl::parse("tls://nats.plant").unwrap();
        assert_eq!((url.host(), url.port(), url.is_tls(), url.is_loopback()), ("nats.plant", 4222, true, false));
        let is_loopback = |text| ServerUrl::<Mqtt>::parse(text).unwrap().is_loopback();
        assert!(is_loopback("mqtt://localhost") && is_loopback("mqtt://[::1]") && is_loopback("mqtt://127.0.0.9"));
    }

    #[test]
    fn refused_urls_name_the_rule_and_no_password() {
        for (text, rule) in [
            ("broker", "a URL is as"),
            ("http://broker", "the scheme is mqtt, or mqtts with TLS, and not http"),
            ("mqtt://me:hunter2@broker", "the URL has no user and no password: they are in user and password_file"),
            ("mqtt://broker/hunter2", "nothing follows host and port"),
            ("mqtt://:1883", "the host is missing"),
            ("mqtt://", "the host is missing"),
            ("mqtt://a b", "a host has the characters"),
            ("mqtt://fd00::7", "a port is a number"),
            ("mqtt://[fd00::7", "an IPv6 address is in brackets"),
            ("mqtt://[fd00::7]1", "an IPv6 address is in brackets"),
            ("mqtt://a:0", "a port is a number from 1 to 65535"),
            ("mqtt://a:65536", "a port is a number from 1 to 65535"),
        ] {
            let error = ServerUrl::<Mqtt>::parse(text).unwrap_err();
            assert!(error.contains(rule) && !error.contains("hunter2"), "{text}: {error}");
        }
    }
}
