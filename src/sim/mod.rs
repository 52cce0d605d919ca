//! Simulated PLCs and servers for them, for tests of programs that use this crate.
//!
//! - [`Plc`]: one PLC of a given [`Model`], with memory, program and RUN/STOP. A cheap handle: a
//!   test can keep one to read the PLC, or to act as the process, while a client is connected.
//! - [`Movement`]: a value that changes with time: a ramp, a sine, random numbers, a counter.
//! - [`station`]: a connected [`Station`](crate::Station) with its PLC, in memory, for tests.
//! - [`Plc::serve`]: one PLC over TCP.
//! - [`Bus`]: a line with PLCs at their station numbers. Frames in, replies out, no I/O.
//! - [`serve`] serves a bus over any stream, [`Server`] over TCP, [`UdpServer`] over UDP,
//!   [`SerialServer`] on a serial port.
//!   [`connector`] connects a [`Link`](crate::Link) to it in memory.
//! - [`Faults`]: silence, delays, garbage, lost connections and line speed, with a log of the
//!   requests that arrived. See [`fault`].
//! - [`Quirk`]: lasting differences of a PLC from the protocol documents.
//!
//! The simulator shares commands and framings with the client, and nothing else. Where the manuals
//! do not specify a PLC's behaviour, the documentation here specifies that of the simulated one.
//!
//! ```
//! use fatek::register;
//! use fatek::sim::Plc;
//! use tokio::io::{AsyncReadExt, AsyncWriteExt};
//! use tokio::net::TcpStream;
//!
//! # #[tokio::main(flavor = "current_thread")]
//! # async fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let plc = Plc::new();
//! plc.write(register!("R12"), 0x10A5_u16)?;
//! let server = plc.serve("127.0.0.1:0").await?;
//!
//! let mut stream = TcpStream::connect(server.local_addr()).await?;
//! stream.write_all(b"\x02014601R0001273\x03").await?; // read R12
//! let mut reply = [0; 13];
//! stream.read_exact(&mut reply).await?;
//! assert_eq!(&reply, b"\x020146010A5D4\x03");
//!
//! server.shutdown().await;
//! # Ok(())
//! # }
//! ```

mod bench;
mod bus;
mod doctest;
mod error;
mod execute;
pub mod fault;
mod memory;
mod model;
mod movement;
mod plc;
mod quirk;
mod saved;
mod server;
mod span;

pub use bench::{Bench, station};
pub use bus::Bus;
#[doc(hidden)]
pub use doctest::doctest;
pub use error::Error;
pub use execute::Execute;
pub use fault::{
    Change, DisconnectAt, Fault, FaultRate, Faults, LeftOver, Line, Log, LogEntry, ParseFaultError, Rule, Timing,
};
#[cfg(test)]
pub(crate) use fault::{Output, Session};
pub use model::{Model, PageReply};
pub use movement::{Movement, MovementError, ParseMovementError, Shape};
pub use plc::Plc;
pub use quirk::Quirk;
pub use server::{MAX_CONNECTIONS, SerialServer, Server, UdpServer, connector, serve};
