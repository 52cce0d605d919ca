use std::convert::Infallible;

use crate::command::InvalidRequest;
use crate::endpoint::ParseEndpointError;

/// The reason why a pool returns no station.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum PoolError {
    /// The text is not an endpoint.
    #[error(transparent)]
    Endpoint(#[from] ParseEndpointError),
    /// The number is not that of a station.
    #[error(transparent)]
    Invalid(#[from] InvalidRequest),
    /// The maximum of endpoints is reached, and all of them are in use.
    #[error("no room for {endpoint}: all {limit} endpoints of the pool are in use (see `PoolBuilder::max_endpoints`)")]
    #[non_exhaustive]
    Full {
        /// The requested endpoint.
        endpoint: String,
        /// The maximum of endpoints.
        limit: usize,
    },
    /// The serial port is in use with other settings. A port has one line.
    #[error("{asked}: the port is in use as {known}")]
    #[non_exhaustive]
    OtherSettings {
        /// The requested endpoint.
        asked: String,
        /// The endpoint in use.
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
