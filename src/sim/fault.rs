//! What can go wrong with a simulated PLC, on its line and with the connection to it.
//!
//! - A [`Fault`] is one thing that goes wrong, and a [`Rule`] says when: for which station, command and elements, how
//!   often, by what chance.
//! - [`Faults`] are the rules of one [`Bus`](super::Bus). It is a handle, so that a test can change them while a client
//!   talks to the bus: kill a station, bring it back.
//! - A [`Line`] makes it all take the time that it would take.
//! - The [`Log`] tells what arrived and what came of it.
//!
//! ```
//! use std::time::Duration;
//! use fatek::command::Code;
//! use fatek::sim::{self, Bus, Fault, Faults, Plc, Rule};
//! use fatek::{Link, register, wire::Framing};
//!
//! # #[tokio::main(flavor = "current_thread")]
//! # async fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let plc = Plc::new();
//! let faults = Faults::new(7).rule(Rule::new(Fault::DropReply).command(Code::WriteRegisters).times(1));
//! let bus = Bus::new().with_station(1, plc.clone())?.with_faults(faults.clone());
//! let link = Link::connector_builder("a bad line", Framing::Ascii, sim::connector(bus, Framing::Ascii))
//!     .response_timeout(Duration::from_millis(20))
//!     .build();
//!
//! let error = link.station(1)?.write_registers(register!("R0"), &[5]).await.unwrap_err();
//! assert!(error.may_have_executed());
//! assert_eq!(plc.read(register!("R0")), 5_u16.into()); // it has
//! assert_eq!(faults.log().writes(), 1);
//! # Ok(())
//! # }
//! ```
//!
//! # Which rules apply
//!
//! The rules are asked when a request has arrived, and never again about it; later changes concern later requests. Each
//! kind of fault, that is each variant of [`Fault`], can befall a request once: the first of its rules that strikes
//! counts, and those behind it are not asked. Different kinds combine, such as a delay, garbage and a wrong station. The
//! order of the rules has no other meaning; what is done first is said under *Order*.
//!
//! Only good frames are asked about; noise is never answered anyway. A rule is not asked, and does not count, where its
//! fault cannot be: [`Fault::Echo`] and [`Fault::Disconnect`] befall every frame, [`Fault::Ignore`] those to a station
//! that is there and broadcasts, all others only those to a station that is there. ([`Fault::Refuse`] befalls
//! connections.) A broadcast is to station 0; but a rule that has one station ignore what it hears has it ignore
//! broadcasts too.
//!
//! # Order
//!
//! ```text
//! arrival ─▶ the station's turn ─▶ turnaround ─▶ execution ─▶ delay ─▶ transmission
//!    │              │                                │                     │
//!  Echo         after all earlier           not with Error         one reply after the other,
//!  Ignore       requests to it                                     as they become ready
//!  Disconnect
//! ```
//!
//! - A station works off its requests one after the other, whatever connection they came by, and takes the next when it
//!   is ready with its reply. So a late reply is overtaken by none of the same station; other stations answer meanwhile.
//! - Execution comes before the delay: a late reply tells how things were.
//! - The reply is changed from the inside out: its content ([`Fault::Error`], [`Fault::WrongStation`],
//!   [`Fault::WrongCommand`], [`Fault::Truncated`], [`Fault::Extended`]), with a checksum to match; then
//!   [`Fault::BadChecksum`], [`Fault::GarbageInside`], [`Fault::Duplicate`], [`Fault::GarbageBefore`]; in the end it is
//!   [`Fault::Split`].
//! - Requests that have arrived are executed in their turn even when the connection is closed before that, as behind a
//!   gateway. A connection has at most 64 requests and replies under way; while it has more, nothing is read from it.
//!
//! # Time
//!
//! With a [`Line`] that has a speed, a request has arrived when its bytes would have come over it, one request after the
//! other, and a reply is handed over when its last byte would have come, one reply after the other. The two directions do
//! not disturb each other, and an echo takes no time of its own. All connections of a bus share the line. When something
//! happens is computed exactly; what is handed over waits for Tokio's timer, which counts in whole milliseconds, so that
//! it comes up to one later. Where no time is asked for, no timer is used. No delay is longer than a day.
//!
//! # Chance
//!
//! What befalls the n-th request to a station depends on the seed, on the rules, on the request and on n, and not on what
//! the other stations do meanwhile; only [`Rule::skip`] and [`Rule::times`] count over all stations of a rule. So equal
//! seeds and equal requests give equal faults.
//!
//! # What a client can rely on
//!
//! No fault makes a wrong reply that cannot be told from a right one, for a client that checks the checksum, the station,
//! the command and the exact shape that its request expects: garbage is drawn anew when it adds up to a good frame by
//! chance. The exceptions are those of the protocol:
//! - a reply that is truncated and extended by as much is as long as a right one: give the two rules other lengths, or other
//!   stations;
//! - a 53 may be of any length from 28 bytes on, and a 4F may lack its error digit;
//! - in the ASCII framing the echo of a 4E or of a STOP is its reply;
//! - a copy or a late reply looks like the reply to the next request of the same kind, and a late one with a wrong station
//!   like the reply to the next such request to that other station. The first is what a loop-back settles; the second
//!   nothing can tell. So give [`Fault::WrongStation`] and [`Fault::Delay`] to different stations, or a delay that is
//!   shorter than the client's timeout.

mod conversation;
mod dice;
mod faults;
mod line;
mod log;
mod rule;
mod spoil;

use std::time::Duration;

use crate::ErrorCode;

pub(crate) use self::conversation::{Conditions, Conversation, Output};
pub use self::faults::Faults;
pub use self::line::Line;
pub use self::log::{Applied, Heard, Log, LogEntry};
pub use self::rule::Rule;

/// One thing that goes wrong.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum Fault {
    /// The request is neither executed nor answered: the PLC is dead, or has not heard it.
    #[doc(alias = "silent")]
    Ignore,
    /// The request is executed and not answered.
    #[doc(alias = "silent")]
    DropReply,
    /// The reply comes this much later: for each request a time between the two, both included. With more than the
    /// client's timeout it is a late reply.
    #[doc(alias("late", "jitter"))]
    Delay {
        /// The shortest.
        min: Duration,
        /// The longest.
        max: Duration,
    },
    /// The reply comes in pieces.
    Split {
        /// How many, as equal as can be; no more than it has bytes.
        pieces: usize,
        /// The pause between one and the next. The line is not free meanwhile.
        pause: Duration,
    },
    /// Garbage comes before the reply, without a pause. In the binary framing it may look like the beginning of a frame
    /// that the reply is a part of.
    GarbageBefore {
        /// The most bytes; there is at least one, and no more than 1024.
        max_len: usize,
    },
    /// Garbage comes somewhere inside the reply, which is no good frame then.
    GarbageInside {
        /// The most bytes; there is at least one, and no more than 1024.
        max_len: usize,
    },
    /// The reply has the next station's number, with a good checksum; 254 has 1 for the next.
    WrongStation,
    /// The reply has another command's code, with a good checksum: the next one in the manuals' table, 47 instead of 46.
    WrongCommand,
    /// The end of the reply's data is missing, with a good checksum.
    #[doc(alias = "wrong length")]
    Truncated {
        /// How many characters (ASCII) or bytes (binary), or all there are.
        by: usize,
    },
    /// The reply's data is followed by zeros, with a good checksum.
    #[doc(alias = "wrong length")]
    Extended {
        /// How many characters (ASCII) or bytes (binary), at most 1024.
        by: usize,
    },
    /// The last character or byte of the reply's data is another one that could stand there, and the checksum is that of
    /// the right one.
    BadChecksum,
    /// The reply comes twice, without a pause.
    Duplicate,
    /// The bytes of the request come back when it has arrived, as from an adapter for RS-485 that hears itself. So do
    /// those of a broadcast and those for a station that is dead or not there.
    Echo,
    /// The connection is closed.
    Disconnect(Moment),
    /// The connection is not accepted: a [`Server`](super::Server) closes it at once, and a
    /// [`connector`](super::connector) fails with [`ConnectionRefused`](std::io::ErrorKind::ConnectionRefused). Rules
    /// with a scope of stations, commands or elements never do this.
    ///
    /// For a port where nobody listens, [shut the server down](super::Server::shutdown) and bind it again later.
    Refuse,
    /// The request is not executed, and answered by this error.
    Error(ErrorCode),
}

/// When a connection is closed. Other requests that have arrived by then are still executed, but not answered.
///
/// Without a reply, all but the first are when the request has been executed, or when it would have been.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum Moment {
    /// When the request has arrived; it is not executed.
    BeforeExecution,
    /// When the reply would begin; the request has been executed.
    BeforeReply,
    /// When half of the reply's bytes are out.
    WithinReply,
    /// When the whole reply is out.
    AfterReply,
}

/// Whom a frame is for, or a connection.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Addressee {
    /// A station that is there.
    Plc,
    /// A station that is not there.
    Nobody,
    /// All of them: a broadcast.
    Everybody,
    /// It is a connection.
    Server,
}

impl Fault {
    fn befalls(&self, addressee: Addressee) -> bool {
        match (self, addressee) {
            (Self::Refuse, addressee) => addressee == Addressee::Server,
            (_, Addressee::Server) => false,
            (_, Addressee::Plc) | (Self::Echo | Self::Disconnect(_), _) => true,
            (_, Addressee::Everybody) => *self == Self::Ignore,
            (_, Addressee::Nobody) => false,
        }
    }

    fn garbage_inside(&self) -> Option<usize> {
        match *self {
            Self::GarbageInside { max_len } => Some(max_len),
            _ => None,
        }
    }

    fn garbage_before(&self) -> Option<usize> {
        match *self {
            Self::GarbageBefore { max_len } => Some(max_len),
            _ => None,
        }
    }
}

#[cfg(test)]
mod tests;
