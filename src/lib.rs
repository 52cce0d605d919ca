//! fatek
pub mod command;
pub mod element;
pub mod endpoint;
mod error;
pub mod link;
#[cfg(feature = "sim")]
pub mod sim;
mod station;
pub mod tag;
pub mod wire;

pub use command::Value;
pub use element::{Discrete, Element, Register, Register32, Symbol, Width};
pub use endpoint::{Endpoint, ParseEndpointError};
pub use error::{Error, ErrorCode};
pub use link::{CallOptions, Link, LinkBuilder, LinkState};
pub use station::{Broadcast, Station};
