//! Places to listen: the URLs of `--listen`.

use std::io;
use std::net::SocketAddr;
use std::time::Duration;

use fatek::Endpoint;
use fatek::endpoint::{InStepSettings, SerialSettings, Transport};
use fatek::sim::{Bus, SerialServer, Server, UdpServer};
use fatek::wire::Framing;

use crate::failure::Failure;
use crate::printable::excerpt;

/// Place to listen. Also of `record` and `replay`.
#[derive(Debug)]
pub(crate) struct Place {
    kind: PlaceKind,
    framing: Framing,
    /// The options of its URL, with `?`, to be printed as given.
    options: String,
    url: String,
}

/// Transport of a place to listen.
#[derive(Debug)]
pub(crate) enum PlaceKind {
    /// Host and port.
    Tcp(String),
    Udp(String),
    Serial(String, SerialSettings),
}

/// Running server.
pub(super) enum Listening {
    Tcp(Server, String),
    Udp(UdpServer, String),
    /// With its URL.
    Serial(SerialServer, String),
}

impl Place {
    /// Parses the URL of a `--listen`. `framing`: unless the URL has one.
    pub(crate) fn parse(url: &str, framing: Framing) -> Result<Self, Failure> {
        parse(url, framing).map_err(|rule| Failure::Usage(format!("cannot listen on `{}`: {rule}", excerpt(url))))
    }

    /// Transport and framing.
    pub(crate) fn into_parts(self) -> (PlaceKind, Framing) {
        (self.kind, self.framing)
    }

    /// A place for the link of a plant, on a host of this machine.
    pub(super) fn for_link(link: &Endpoint, host: &str, port: u16) -> Self {
        let address = format!("{host}:{port}");
        let (kind, scheme) = match link.transport() {
            Transport::Udp { .. } => (PlaceKind::Udp(address.clone()), "udp"),
            Transport::Tcp { .. } | Transport::Serial { .. } | _ => (PlaceKind::Tcp(address.clone()), "tcp"),
        };
        Self { kind, framing: link.framing(), options: String::new(), url: format!("{scheme}://{address}") }
    }

    pub(super) async fn listen(self, bus: &Bus, make_room_after: Duration) -> Result<Listening, Failure> {
        let url = self.url.clone();
        self.open(bus.clone(), make_room_after).await.map_err(|error| Failure::Listen { url, error })
    }

    async fn open(self, bus: Bus, make_room_after: Duration) -> io::Result<Listening> {
        Ok(match self.kind {
            PlaceKind::Tcp(address) => {
                let server = Server::bind(address, bus, self.framing).await?;
                server.make_room_after(make_room_after);
                Listening::Tcp(server, self.options)
            }
            PlaceKind::Udp(address) => Listening::Udp(UdpServer::bind(address, bus, self.framing).await?, self.options),
            PlaceKind::Serial(path, settings) => {
                Listening::Serial(SerialServer::open(path, settings, bus, self.framing).await?, self.url)
            }
        })
    }
}

impl Listening {
    /// Its URL, with the port that it has.
    pub(super) fn url(&self) -> String {
        match self {
            Self::Tcp(server, options) => format!("tcp://{}{options}", server.local_addr()),
            Self::Udp(server, options) => format!("udp://{}{options}", server.local_addr()),
            Self::Serial(_, url) => url.clone(),
        }
    }

    /// Its address in a network.
    pub(super) fn local_addr(&self) -> Option<SocketAddr> {
        match self {
            Self::Tcp(server, _) => Some(server.local_addr()),
            Self::Udp(server, _) => Some(server.local_addr()),
            Self::Serial(..) => None,
        }
    }

    pub(super) async fn shutdown(self) {
        match self {
            Self::Tcp(server, _) => server.shutdown().await,
            Self::Udp(server, _) => server.shutdown().await,
            Self::Serial(server, _) => server.shutdown().await,
        }
    }
}

/// Host and first port of the links of a plant, of the only `--listen`.
pub(super) fn host_and_port(listen: &[String]) -> Result<(String, u16), Failure> {
    const DEFAULT: &str = "tcp://127.0.0.1:0";
    let url = match listen {
        [] => DEFAULT,
        [url] => url,
        several => {
            return Err(Failure::Usage(format!(
                "one --listen has the host and the first port of a plant, not {}",
                several.len()
            )));
        }
    };
    let address = url.strip_prefix("tcp://").map(|address| address_of(address, "tcp"));
    let address = address.unwrap_or_else(|| Err("for a plant it must begin with `tcp://`".to_owned()));
    let address = address.map_err(|rule| Failure::Usage(format!("cannot listen on `{}`: {rule}", excerpt(url))))?;
    // The address has a port.
    let (host, port) = address.rsplit_once(':').unwrap_or((address, "0"));
    Ok((host.to_owned(), port.parse().unwrap_or(0)))
}

/// The error is the rule that the URL breaks.
fn parse(url: &str, default: Framing) -> Result<Place, String> {
    if url.starts_with("serial:") {
        let (path, settings, framing) = serial_port(url, default)?;
        let kind = PlaceKind::Serial(path, settings);
        return Ok(Place { kind, framing, options: String::new(), url: url.to_owned() });
    }
    let (address, query) = url.split_once('?').unwrap_or((url, ""));
    let framing = match query.split_once('=') {
        None if query.is_empty() => default,
        Some(("framing", framing)) => framing.parse().map_err(|error| format!("{error}"))?,
        Some(_) | None => return Err("it takes the option `framing` only".to_owned()),
    };
    let kind = if let Some(address) = address.strip_prefix("tcp://") {
        PlaceKind::Tcp(address_of(address, "tcp")?.to_owned())
    } else if let Some(address) = address.strip_prefix("udp://") {
        PlaceKind::Udp(address_of(address, "udp")?.to_owned())
    } else {
        return Err("it must begin with `tcp://`, `udp://` or `serial:`".to_owned());
    };
    let options = if query.is_empty() { String::new() } else { format!("?{query}") };
    Ok(Place { kind, framing, options, url: url.to_owned() })
}

/// Returns `HOST:PORT` after the scheme. The error is the rule that it breaks.
fn address_of<'a>(address: &'a str, scheme: &str) -> Result<&'a str, String> {
    let address = address.strip_suffix('/').unwrap_or(address);
    match address.rsplit_once(':') {
        Some((host, port)) if !host.is_empty() && port.parse::<u16>().is_ok() => Ok(address),
        _ => Err(format!("it must have a host and a port from 0 to 65535, as in `{scheme}://127.0.0.1:0`")),
    }
}

/// Returns path, settings and framing of a serial port. The error is the rule that it breaks.
fn serial_port(url: &str, framing: Framing) -> Result<(String, SerialSettings, Framing), String> {
    let options = url.split_once('?').map_or("", |(_, options)| options);
    // The defaults of a port depend on the framing.
    let url = if options.split('&').any(|option| option.starts_with("framing=")) {
        url.to_owned()
    } else {
        let separator = if options.is_empty() { '?' } else { '&' };
        format!("{}{separator}framing={framing}", url.trim_end_matches('?'))
    };
    let parsed: Result<Endpoint, _> = url.parse();
    let endpoint = parsed.map_err(|error| {
        // The rule alone: the message has the URL already.
        let text = error.to_string();
        text.split_once(" is not an endpoint: ").map_or(text.clone(), |(_, rule)| rule.to_owned())
    })?;
    if endpoint.in_step() != InStepSettings::new() {
        return Err("it takes the options `baud`, `frame` and `framing` only".to_owned());
    }
    match (endpoint.transport(), endpoint.transport().serial_settings()) {
        (Transport::Serial { path, .. }, Some(settings)) => Ok((path.clone(), settings, endpoint.framing())),
        _ => Err("it must be a serial port".to_owned()),
    }
}
