//! An async client for FATEK / FACON PLCs: ASCII and binary framing, one link shared by many
//! callers and many stations, and a simulated PLC for tests.
//!
//! ```
//! # #[cfg(feature = "sim")]
//! # #[tokio::main(flavor = "current_thread")]
//! # async fn main() -> Result<(), Box<dyn std::error::Error>> {
//! use fatek::sim::Plc;
//! use fatek::{Link, discrete, register};
//!
//! // A PLC to talk to. Yours is at an endpoint such as "tcp://192.168.2.3:500".
//! let server = Plc::new().serve("127.0.0.1:0").await?;
//!
//! let link = Link::new(server.endpoint()); // connects when it is first used
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
//!   → ReadRegisters { first, count }                command      typed and checked, independent of framing
//!   → "03" "R00012"  |  03 52 00 0C                 wire         its fields, in ASCII or in binary
//!   → STX 01 46 … ETX  |  51 10 00 06 … 55 AA       wire         tokio_util codec: frames in, frames out
//!   → queued, sent, awaited, matched                link         one task owns one connection
//! and back the same way: bytes → frame → matched to its request → fields → Vec<u16>
//! ```
//!
//! - [`mod@element`]: the elements of a PLC: `X0`, `WM8`, `R12`, `DR100` …
//! - [`mod@tag`]: an element or a range with a type: `R100:f32`.
//! - [`command`]: the fourteen commands, one type each.
//! - [`memory_map`]: [`MemoryMap`], the elements that a model of PLC has.
//! - [`plan`]: the cheapest requests for a set of tags.
//! - [`poll`]: [`Poller`] polls tags periodically and yields samples as a stream.
//! - [`wire`]: the two framings, usable alone.
//! - [`link`]: [`Link`], one connection, with its options and counters.
//! - [`Station`] and [`Broadcast`]: the handles to one PLC, and to all PLCs of a link.
//! - [`pool`]: [`Pool`], links to many PLCs by endpoint.
//! - [`clock`]: the clock of a PLC, read and set.
//! - [`mod@backup`]: [`Backup`], ranges of registers and discretes: take, save, compare, restore.
//! - [`program`]: [`Program`], all pages of the user program: read, save, compare, write.
//! - [`file`](mod@file): saved files and their errors. [`progress`]: the progress of a transfer.
#![cfg_attr(feature = "sim", doc = "- [`sim`]: a PLC in memory, and its server.")]
//!
//! # Guarantees
//!
//! 1. **No reply reaches the wrong request**, also when replies come late, twice, from an earlier
//!    connection or to a broadcast. The protocol has no transaction id. So a reply must match
//!    station, command and exact shape, and nothing that may still come could answer the request:
//!    equal requests in turn are spelt differently. A check (a loop-back with a new nonce)
//!    separates them where that is impossible, on each new connection, and after any doubt. See
//!    [`endpoint::InStepSettings`] for the assumptions about a line.
//! 2. **No write is retried without consent.** Reads are retried; writes and control commands only
//!    with [`CallOptions::with_retry_writes`]. [`Error::may_have_executed`] tells whether the PLC
//!    may have executed them.
//! 3. **Every call ends by its deadline**, queueing, connecting and retries included.
//! 4. **One silent station does not stop the others.** Its calls fail at once while it is offline.
//! 5. **No input can cause a panic, a hang or unbounded memory use.**
//! 6. **All futures are cancel-safe.**
//! 7. **Broadcasts never wait for an answer.**
//!
//! # Features
//!
//! - `serial` (default): serial lines.
//! - `sim`: the simulated PLC.
//! - `serde`: `Serialize` and `Deserialize` of tags, values, samples, statistics and options, in the
//!   forms of `docs/SERDE.md`.
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
pub mod capabilities;
#[allow(clippy::arithmetic_side_effects, reason = "divisions by constants")]
pub mod clock;
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
pub mod memory_map;
#[allow(
    clippy::arithmetic_side_effects,
    clippy::indexing_slicing,
    reason = "indexes of its own lists; property tests cover it"
)]
pub mod plan;
#[cfg(feature = "config")]
pub mod plant;
pub mod poll;
pub mod pool;
mod printable;
pub mod program;
pub mod progress;
mod random;
#[cfg(feature = "serde")]
pub mod serde_forms;
mod settings;
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
#[allow(
    clippy::arithmetic_side_effects,
    clippy::indexing_slicing,
    reason = "counts and digits are checked when a tag is parsed; constant functions over its text"
)]
pub mod tag;
#[cfg(feature = "config")]
pub mod tag_table;
mod transfer;
mod transport;
pub mod wire;

pub use backup::Backup;
pub use capabilities::Capabilities;
pub use clock::Clock;
pub use command::InvalidRequest;
pub use element::{Discrete, Element, Register, Register32, Symbol, Value, Width};
pub use endpoint::{Endpoint, ParseEndpointError};
pub use error::{Error, ErrorCode, Seen};
#[cfg(feature = "derive")]
pub use fatek_derive::Tags;
pub use link::{CallOptions, EchoMode, Link, LinkBuilder, LinkState, LinkStats, SendGate, StationState, StationStats};
pub use memory_map::MemoryMap;
pub use plan::{CostModel, Limits, Plan};
pub use poll::Poller;
pub use pool::{Pool, PoolBuilder, PoolError, PoolStats};
pub use program::Program;
pub use station::{Broadcast, Station};
pub use tag::{Tag, Tags};
pub use wire::Framing;

/// Compiles and runs the examples of the README.
#[cfg(all(doctest, feature = "sim", feature = "derive"))]
#[doc = include_str!("../README.md")]
pub struct Readme;
