//! Subcommand `fatek sim`.

use std::io;

use fatek::Endpoint;
use fatek::endpoint::{InStepSettings, SerialSettings, Transport};
use fatek::sim::{Bus, Model, Plc, SerialServer, Server, UdpServer};
use fatek::wire::Framing;
use futures::future::join_all;

use crate::args::SimArgs;
use crate::failure::Failure;
use crate::output::print;
use crate::printable::excerpt;
use crate::signal::Stop;

pub(crate) async fn sim(args: &SimArgs) -> Result<(), Failure> {
    let bus = bus(args)?;
    let places: Vec<Place<'_>> =
        args.listen.iter().map(|url| Place::parse(url, args.framing)).collect::<Result<_, _>>()?;
    let mut stop = Stop::new()?;
    let mut servers = Vec::new();
    for (place, url) in places.into_iter().zip(&args.listen) {
        let server = place.listen(&bus, args).await;
        servers.push(server.map_err(|error| Failure::Listen { url: url.clone(), error })?);
    }
    for (server, url) in servers.iter().zip(&args.listen) {
        match server {
            Listening::Tcp(server) => print(format_args!("listening tcp://{}", server.local_addr())),
            Listening::Udp(server) => print(format_args!("listening udp://{}", server.local_addr())),
            Listening::Serial(_) => print(format_args!("listening {url}")),
        }?;
    }
    stop.signalled().await;
    join_all(servers.into_iter().map(Listening::shutdown)).await;
    Ok(())
}

/// Place to listen, of `--listen`. Also of `record` and `replay`.
pub(crate) enum Place<'a> {
    Tcp { address: &'a str },
    Udp { address: &'a str },
    Serial { path: String, settings: SerialSettings },
}

/// Running server.
enum Listening {
    Tcp(Server),
    Udp(UdpServer),
    Serial(SerialServer),
}

impl<'a> Place<'a> {
    pub(crate) fn parse(url: &'a str, framing: Framing) -> Result<Self, Failure> {
        let parsed = if let Some(address) = url.strip_prefix("tcp://") {
            address_of(address, "tcp").map(|address| Self::Tcp { address })
        } else if let Some(address) = url.strip_prefix("udp://") {
            address_of(address, "udp").map(|address| Self::Udp { address })
        } else if url.starts_with("serial:") {
            serial_port(url, framing).map(|(path, settings)| Self::Serial { path, settings })
        } else {
            Err("it must begin with `tcp://`, `udp://` or `serial:`".to_owned())
        };
        parsed.map_err(|rule| Failure::Usage(format!("cannot listen on `{}`: {rule}", excerpt(url))))
    }

    async fn listen(self, bus: &Bus, args: &SimArgs) -> io::Result<Listening> {
        let (bus, framing) = (bus.clone(), args.framing);
        Ok(match self {
            Self::Tcp { address } => {
                let server = Server::bind(address, bus, framing).await?;
                server.make_room_after(args.make_room_after);
                Listening::Tcp(server)
            }
            Self::Udp { address } => Listening::Udp(UdpServer::bind(address, bus, framing).await?),
            Self::Serial { path, settings } => {
                Listening::Serial(SerialServer::open(path, settings, bus, framing).await?)
            }
        })
    }
}

impl Listening {
    async fn shutdown(self) {
        match self {
            Self::Tcp(server) => server.shutdown().await,
            Self::Udp(server) => server.shutdown().await,
            Self::Serial(server) => server.shutdown().await,
        }
    }
}

/// Bus with one PLC per `--station`, each with the values of `--set`.
fn bus(args: &SimArgs) -> Result<Bus, Failure> {
    let mut bus = Bus::new();
    for &station in &args.stations {
        let plc = Plc::with_model(model(args));
        for assignment in &args.assignments {
            for (element, value) in assignment.tag().elements().zip(assignment.encode()) {
                plc.write(element, value)
                    .map_err(|error| Failure::Usage(format!("--set {}: {error}", excerpt(&assignment.to_string()))))?;
            }
        }
        bus = bus.with_station(station, plc).map_err(Failure::usage)?;
    }
    Ok(bus)
}

fn model(args: &SimArgs) -> Model {
    let model = args.last.iter().fold(args.model.clone(), |model, &element| model.last(element));
    match args.ladder_words {
        Some(words) => model.ladder_words(words),
        None => model,
    }
}

/// Returns `HOST:PORT` after the scheme. The error is the rule that it breaks.
fn address_of<'a>(address: &'a str, scheme: &str) -> Result<&'a str, String> {
    if address.contains('?') {
        return Err("it takes no options; for the framing give --framing".to_owned());
    }
    let address = address.strip_suffix('/').unwrap_or(address);
    match address.rsplit_once(':') {
        Some((host, port)) if !host.is_empty() && port.parse::<u16>().is_ok() => Ok(address),
        _ => Err(format!("it must have a host and a port from 0 to 65535, as in `{scheme}://127.0.0.1:0`")),
    }
}

/// Returns path and settings of a serial port. The error is the rule that it breaks.
fn serial_port(url: &str, framing: Framing) -> Result<(String, SerialSettings), String> {
    let options = url.split_once('?').map_or("", |(_, options)| options);
    if options.split('&').any(|option| option.starts_with("framing")) {
        return Err("it takes no framing: give --framing".to_owned());
    }
    // The defaults of a port depend on the framing.
    let separator = if options.is_empty() { '?' } else { '&' };
    let parsed: Result<Endpoint, _> = format!("{}{separator}framing={framing}", url.trim_end_matches('?')).parse();
    let endpoint = parsed.map_err(|error| {
        // The rule alone: the message has the URL already.
        let text = error.to_string();
        text.split_once(" is not an endpoint: ").map_or(text.clone(), |(_, rule)| rule.to_owned())
    })?;
    if endpoint.in_step() != InStepSettings::new() {
        return Err("it takes the options `baud` and `frame` only".to_owned());
    }
    match (endpoint.transport(), endpoint.transport().serial_settings()) {
        (Transport::Serial { path, .. }, Some(settings)) => Ok((path.clone(), settings)),
        _ => Err("it must be a serial port".to_owned()),
    }
}
