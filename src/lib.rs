//! fatek
pub mod command;
pub mod element;
mod error;
#[cfg(feature = "sim")]
pub mod sim;
pub mod wire;

pub use element::{Discrete, Element, Register, Register32, Symbol, Width};
pub use error::{Error, ErrorCode};
