//! An async client for FATEK / FACON PLCs: the ASCII and the binary framing, one link shared by many callers and many
//! stations, and a simulated PLC to test against.
//!
//! ```
//! # #[cfg(feature = "sim")]
//! # #[tokio::main(flavor = "current_thread")]
//! # async fn main() -> Result<(), Box<dyn std::error::Error>> {
//! use fatek::sim::{Bus, Plc, Server};
//! use fatek::wire::Framing;
//! use fatek::{Endpoint, Link, discrete, register};
//!
//! // A PLC to talk to. Yours is at an address such as "tcp://192.168.2.3:500".
//! let server = Server::bind("127.0.0.1:0", Bus::new().with_station(1, Plc::new())?, Framing::Ascii).await?;
//! let endpoint = Endpoint::from(server.local_addr());
//!
//! let link = Link::new(endpoint); // connects when it is first used
//! let station = link.station(1)?;
//! station.write_registers(register!("R12"), &[0x10A5, 0x7FC4, 1]).await?;
//! station.set(discrete!("Y3")).await?;
//! assert_eq!(station.read_registers(register!("R12"), 3).await?, [0x10A5, 0x7FC4, 1]);
//! # Ok(())
//! # }
//! # #[cfg(not(feature = "sim"))]
//! # fn main() {}
//! ```
//!
//! # The layers
//!
//! ```text
//! station.read_registers(R12, 3)                    Station      one async method per command
//!   → ReadRegisters { first, count }                command      what is asked: typed, checked, framing-free
//!   → "03" "R00012"  |  03 52 00 0C                 wire         its fields, in ASCII or in binary
//!   → STX 01 46 … ETX  |  51 10 00 06 … 55 AA       wire         tokio_util codec: frames in, frames out
//!   → queued, sent, awaited, matched                link         one task owns one connection
//! and back the same way: bytes → frame → matched to its request → fields → Vec<u16>
//! ```
//!
//! - [`mod@element`]: what a PLC is made of: `X0`, `WM8`, `R12`, `DR100` …
//! - [`tag`]: an element, or a range of them, with a type: `R100:f32`.
//! - [`command`]: the fourteen commands, each one type.
//! - [`plan`]: the cheapest requests for a set of tags.
//! - [`poll`]: [`Poller`], tags read again and again, as a stream of samples.
//! - [`wire`]: the two framings, usable alone.
//! - [`link`]: [`Link`], [`Station`] and [`Broadcast`], and what decides between them.
//! - [`pool`]: [`Pool`], the links to many PLCs.
//! - [`mod@backup`]: [`Backup`], ranges of registers and discretes: read, saved, compared, written back.
//! - [`program`]: [`Program`], the pages of a PLC together: read, saved, compared, written.
//! - [`file`](mod@file): what is saved in files, and what can be wrong with them; [`progress`]: how far a transfer has come.
#![cfg_attr(feature = "sim", doc = "- [`sim`]: a PLC in memory, and its server.")]
//!
//! # What it promises
//!
//! 1. **No reply reaches the wrong request**, also when replies come late, twice, from an earlier connection or to a broadcast.
//!    The protocol has no transaction id. So a reply must match station, command and exact shape, and nothing that may still
//!    come could answer the request: equal requests in turn are spelt differently, and a check (a loop-back with a new nonce)
//!    goes between where that cannot be, on each new connection, and after any doubt. See
//!    [`endpoint::InStepSettings`] for what is assumed of a line.
//! 2. **No write is repeated behind the caller's back.** Reads are repeated, writes and control only by choice
//!    ([`CallOptions::retry_writes`]); [`Error::may_have_executed`] tells what is known.
//! 3. **Every call ends by its deadline**, queueing, connecting and retries included.
//! 4. **One silent station does not stop the others.** Its calls fail at once while it is offline.
//! 5. **No bytes from the wire can panic, hang or grow it.**
//! 6. **A dropped future harms nobody.**
//! 7. **Broadcasts never wait for an answer.**
//!
//! # Features
//!
//! - `serial` (default): serial lines.
//! - `sim`: the simulated PLC.
//! - `cli`: the `fatek` command line.
#![cfg_attr(docsrs, feature(doc_cfg))]
#![warn(clippy::print_stdout, clippy::print_stderr)]
#![cfg_attr(test, allow(clippy::wildcard_enum_match_arm, reason = "tests name the variants they expect"))]
// Input of any kind must not cause a panic.
#![cfg_attr(
    not(test),
    deny(
        clippy::unwrap_used,
        clippy::expect_used,
        clippy::panic,
        clippy::indexing_slicing,
        clippy::arithmetic_side_effects
    )
)]

pub mod backup;
#[allow(
    clippy::arithmetic_side_effects,
    clippy::indexing_slicing,
    reason = "counts and lengths are within the limits of a request"
)]
pub mod command;
#[allow(
    clippy::arithmetic_side_effects,
    clippy::indexing_slicing,
    reason = "constant functions over the table and short texts"
)]
pub mod element;
pub mod endpoint;
mod error;
pub mod file;
mod hex;
pub mod link;
#[allow(
    clippy::arithmetic_side_effects,
    clippy::indexing_slicing,
    reason = "indexes of its own lists; property tests cover it"
)]
pub mod plan;
pub mod poll;
pub mod pool;
pub mod program;
pub mod progress;
mod random;
#[cfg(feature = "sim")]
#[allow(
    clippy::arithmetic_side_effects,
    clippy::indexing_slicing,
    clippy::panic,
    reason = "for tests, which may fail by a panic"
)]
pub mod sim;
#[allow(clippy::arithmetic_side_effects, reason = "counts are checked before the first request")]
mod station;
#[allow(clippy::arithmetic_side_effects, reason = "counts and digits are checked when a tag is parsed")]
pub mod tag;
mod transfer;
pub mod wire;

pub use backup::Backup;
pub use element::{Discrete, Element, Register, Register32, Symbol, Value, Width};
pub use endpoint::{Endpoint, ParseEndpointError};
pub use error::{Error, ErrorCode};
pub use link::{CallOptions, EchoMode, Link, LinkBuilder, LinkState, LinkStats, StationState, StationStats};
pub use plan::{CostModel, Limits, Plan};
pub use poll::Poller;
pub use pool::{Pool, PoolBuilder, PoolError, PoolStats};
pub use program::Program;
pub use station::{Broadcast, Station};

/// The code in the README compiles and runs.
#[cfg(all(doctest, feature = "sim"))]
#[doc = include_str!("../README.md")]
pub struct Readme;
