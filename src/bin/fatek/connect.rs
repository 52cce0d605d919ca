//! From `--link` and `--station` to a station.

use std::time::Duration;

use fatek::{CallOptions, Endpoint, Link, Station};

use crate::args::Plc;
use crate::failure::Failure;

/// The station that the command line names. Nothing is sent, and no connection opened, before its first call.
pub(crate) fn station(plc: &Plc, timeout: Option<Duration>) -> Result<Station, Failure> {
    let Some(link) = &plc.link else {
        return Err(Failure::Usage("which PLC? Give --link URL, or set FATEK_LINK".to_owned()));
    };
    let Some(station) = &plc.station else {
        return Err(Failure::Usage("which station? Give --station N, or set FATEK_STATION".to_owned()));
    };
    let endpoint: Endpoint = link.parse().map_err(Failure::usage)?;
    let number = station.parse().ok().filter(|number| (1..=254).contains(number));
    let Some(number) = number.filter(|_| station.bytes().all(|b| b.is_ascii_digit())) else {
        return Err(Failure::Usage(format!("`{station}` is not a station: it must be a number from 1 to 254")));
    };
    // Nobody waits at a prompt for a connection that has been refused, nor for a probe of an offline station.
    let mut builder = Link::builder(endpoint).options(options(timeout)).fail_fast(true).offline_after(0);
    if let Some(timeout) = timeout {
        builder = builder.connect_timeout(timeout);
    }
    builder.build().station(number).map_err(Failure::usage)
}

/// How calls are treated.
pub(crate) fn options(timeout: Option<Duration>) -> CallOptions {
    let Some(timeout) = timeout else { return CallOptions::new() };
    // Long enough for a connection, for three attempts and for a loop-back before each of them.
    CallOptions::new().response_timeout(timeout).call_timeout(timeout.saturating_mul(8))
}
