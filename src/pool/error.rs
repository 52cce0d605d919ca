use std::convert::Infallible;

use crate::command::InvalidRequest;
use crate::endpoint::ParseEndpointError;

/// Why a pool gives no station.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum PoolError {
    /// The caller's fault: a text that is no endpoint.
    #[error(transparent)]
    Endpoint(#[from] ParseEndpointError),
    /// The caller's fault: a number that is no station's.
    #[error(transparent)]
    Invalid(#[from] InvalidRequest),
    /// There are as many endpoints as there may be, and all of them are in use.
    #[error(
        "no place for {endpoint}: the pool has its {limit} endpoints (`PoolBuilder::max_endpoints`), and all are in use"
    )]
    #[non_exhaustive]
    Full {
        /// The endpoint that was asked for.
        endpoint: String,
        /// How many there may be.
        limit: usize,
    },
    /// The serial port is in use with other settings, and there is only one line behind it.
    #[error("{asked}: the port is in use as {known}")]
    #[non_exhaustive]
    OtherSettings {
        /// The endpoint that was asked for.
        asked: String,
        /// The endpoint that the pool has.
        known: String,
    },
    /// The pool has been closed.
    #[error("the pool is closed")]
    Closed,
}

impl From<Infallible> for PoolError {
    fn from(never: Infallible) -> Self {
        match never {}
    }
}
