//! From `--link` and `--station` to an endpoint, a link and a station.

use std::time::Duration;

use fatek::{CallOptions, Endpoint, Link, Station};

use crate::args::Plc;
use crate::failure::Failure;

/// The station that the command line names. Nothing is sent, and no connection opened, before its first call.
pub(crate) fn station(plc: &Plc, timeout: Option<Duration>) -> Result<Station, Failure> {
    let endpoint = endpoint(plc.link.as_deref())?;
    let Some(station) = &plc.station else {
        return Err(Failure::Usage("which station? Give --station N, or set FATEK_STATION".to_owned()));
    };
    let number = station.parse().ok().filter(|number| (1..=254).contains(number));
    let Some(number) = number.filter(|_| station.bytes().all(|b| b.is_ascii_digit())) else {
        return Err(Failure::Usage(format!("`{station}` is not a station: it must be a number from 1 to 254")));
    };
    link(endpoint, options(timeout), timeout).station(number).map_err(Failure::usage)
}

/// The endpoint that `--link` names.
pub(crate) fn endpoint(link: Option<&str>) -> Result<Endpoint, Failure> {
    let Some(link) = link else {
        return Err(Failure::Usage("which PLC? Give --link URL, or set FATEK_LINK".to_owned()));
    };
    link.parse().map_err(Failure::usage)
}

/// A link for one who waits: nobody waits at a prompt for a connection that has been refused, nor for a probe of an
/// offline station.
pub(crate) fn link(endpoint: Endpoint, options: CallOptions, connect_timeout: Option<Duration>) -> Link {
    let builder = Link::builder(endpoint).options(options).fail_fast(true).offline_after(0);
    match connect_timeout {
        Some(timeout) => builder.connect_timeout(timeout).build(),
        None => builder.build(),
    }
}

/// How calls are treated.
pub(crate) fn options(timeout: Option<Duration>) -> CallOptions {
    let Some(timeout) = timeout else { return CallOptions::new() };
    // Long enough for a connection, for three attempts and for a loop-back before each of them.
    CallOptions::new().response_timeout(timeout).call_timeout(timeout.saturating_mul(8))
}
