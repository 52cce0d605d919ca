//! A PLC in memory, and its server: for the tests of programs that use this crate.
//!
//! - [`Plc`] is one PLC of some [`Model`]: memory, program, RUN/STOP. It is a cheap handle, so a test can keep one and
//!   look at the PLC, or play the process, while a client talks to it.
//! - [`Bus`] is a line with PLCs at their station numbers: frames in, replies out, no I/O.
//! - [`serve`] puts a bus behind any stream, [`Server`] behind a TCP port, [`UdpServer`] behind a UDP port;
//!   [`connector`] connects a [`Link`](crate::Link) to it in memory.
//! - [`Faults`] make it go wrong: silence, delays, garbage, lost connections, line speed; and they keep a log of what
//!   arrived. See [`fault`].
//!
//! It shares the commands and the framings with the client, and nothing else. Where the manuals do not say what a PLC
//! does, the documentation here says what this one does.
//!
//! ```
//! use fatek::register;
//! use fatek::sim::{Bus, Plc, Server};
//! use fatek::wire::Framing;
//! use tokio::io::{AsyncReadExt, AsyncWriteExt};
//! use tokio::net::TcpStream;
//!
//! # #[tokio::main(flavor = "current_thread")]
//! # async fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let plc = Plc::new();
//! plc.write(register!("R12"), 0x10A5_u16)?;
//! let bus = Bus::new().with_station(1, plc)?;
//! let server = Server::bind("127.0.0.1:0", bus, Framing::Ascii).await?;
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

mod bus;
mod doctest;
mod error;
mod execute;
pub mod fault;
mod memory;
mod model;
mod plc;
mod server;

pub use bus::Bus;
#[doc(hidden)]
pub use doctest::doctest;
pub use error::Error;
pub use execute::Execute;
#[cfg(test)]
pub(crate) use fault::{Conversation, Output};
pub use fault::{Fault, Faults, LeftOver, Line, Log, LogEntry, Moment, Rule, Timing};
pub use model::{Model, PageReply};
pub use plc::Plc;
pub use server::{MAX_CONNECTIONS, Server, UdpServer, connector, serve};
