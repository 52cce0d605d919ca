//! Endpoint, link and station of `--link` and `--station`.

use std::io;
use std::time::Duration;

use fatek::endpoint::EndpointStream;
use fatek::link::defaults;
use fatek::{CallOptions, Capabilities, Endpoint, Link, LinkBuilder, Station};
use tokio::time;

use crate::args::Plc;
use crate::failure::Failure;
use crate::printable::excerpt;

/// Station of the command line. No connection is opened before its first call.
pub(crate) fn station(plc: &Plc, timeout: Option<Duration>) -> Result<Station, Failure> {
    let endpoint = endpoint(plc.link()?)?;
    let number = number(plc)?;
    with_capabilities(link(endpoint, options(timeout), timeout).station(number).map_err(Failure::usage)?, plc)
}

/// Number of the station.
pub(crate) fn number(plc: &Plc) -> Result<u8, Failure> {
    let Some(station) = &plc.station else {
        return Err(Failure::Usage("no station: give --station N, or set FATEK_STATION".to_owned()));
    };
    let number = station.parse().ok().filter(|number| (1..=254).contains(number));
    number.filter(|_| station.bytes().all(|b| b.is_ascii_digit())).ok_or_else(|| {
        Failure::Usage(format!("`{}` is not a station: it must be a number from 1 to 254", excerpt(station)))
    })
}

/// Link of a command that reads several stations, or reads much at once: a station that does not answer is
/// offline then, and the calls of the others may wait for it.
pub(crate) fn link_of_several(endpoint: Endpoint, timeout: Option<Duration>, stations: usize) -> Link {
    let options = options(timeout);
    // No list has more than 254.
    let stations = u32::try_from(stations).unwrap_or(u32::MAX);
    let options = options.with_call_timeout(options.call_timeout().saturating_mul(stations));
    builder(endpoint, options, timeout).build()
}

/// The same station, with the capabilities of `--capabilities`.
pub(crate) fn with_capabilities(station: Station, plc: &Plc) -> Result<Station, Failure> {
    if let Some(path) = &plc.capabilities {
        station.set_capabilities(capabilities(path)?);
    }
    Ok(station)
}

/// Capabilities of a file.
pub(crate) fn capabilities(path: &str) -> Result<Capabilities, Failure> {
    let fault = |error: &dyn std::fmt::Display| {
        Failure::Usage(format!("the capabilities in {}: {}", excerpt(path), excerpt(&error.to_string())))
    };
    let text = std::fs::read_to_string(path).map_err(|error| fault(&error))?;
    serde_json::from_str(&text).map_err(|error| fault(&error))
}

/// Endpoint of `--link`.
pub(crate) fn endpoint(link: Option<&str>) -> Result<Endpoint, Failure> {
    let Some(link) = link else {
        return Err(Failure::Usage("no link: give --link URL, or set FATEK_LINK".to_owned()));
    };
    link.parse().map_err(Failure::usage)
}

/// Opens a stream of bytes to an endpoint, without a link, and waits until it may be used (`?settle=`).
pub(crate) async fn open(endpoint: &Endpoint, timeout: Option<Duration>) -> io::Result<EndpointStream> {
    let within = timeout.unwrap_or(defaults::CONNECT_TIMEOUT);
    let opened = time::timeout(within, endpoint.open()).await;
    let late = || io::Error::new(io::ErrorKind::TimedOut, format!("no connection within {} s", within.as_secs_f64()));
    let stream = opened.unwrap_or_else(|_| Err(late()))?;
    time::sleep(endpoint.in_step().settle()).await;
    Ok(stream)
}

/// Link for interactive use: a refused connection fails at once, and no station is treated as
/// offline.
pub(crate) fn link(endpoint: Endpoint, options: CallOptions, connect_timeout: Option<Duration>) -> Link {
    builder(endpoint, options, connect_timeout).offline_after(0).build()
}

fn builder(endpoint: Endpoint, options: CallOptions, connect_timeout: Option<Duration>) -> LinkBuilder {
    let builder = Link::builder(endpoint).options(options).fail_fast(true);
    match connect_timeout {
        Some(timeout) => builder.connect_timeout(timeout),
        None => builder,
    }
}

/// Call options of `--timeout`.
pub(crate) fn options(timeout: Option<Duration>) -> CallOptions {
    let Some(timeout) = timeout else { return CallOptions::new() };
    // One connection and three attempts with a loop-back before each need at most 7 timeouts.
    CallOptions::new().with_response_timeout(timeout).with_call_timeout(timeout.saturating_mul(8))
}
