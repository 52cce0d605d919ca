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
//! broadcasts too. [`Fault::AnswerBroadcast`] befalls each station that obeys a broadcast, so its rule is asked once a
//! station.
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
//!   [`Fault::BadChecksum`], [`Fault::GarbageInside`], [`Fault::GarbageBefore`]; in the end it is [`Fault::Split`].
//! - Copies and second answers ([`Fault::Duplicate`], [`Fault::SecondAnswer`]) keep the order: they are sent at their
//!   time, but at the latest directly before the next reply of the same station on that connection. A copy has all
//!   changes of the reply but [`Fault::GarbageBefore`], and is not split. One [without a pause](Timing::AT_ONCE) is one
//!   with its reply on a stream: it is split with it, and handed over with it. There is none of a reply that is dropped
//!   or that the end of the connection cuts. [`Fault::RoamingDuplicate`] alone is sent later than other replies.
//! - What is sent at the same time on a stream is written at once, for instance a copy and the reply that it comes
//!   directly before. Over UDP each reply, each copy and each piece is a datagram.
//! - A reply with [`Fault::LeftOver`] keeps its place in the order of its station, also on the next connection, and what
//!   follows it goes with it.
//! - Requests that have arrived are executed in their turn even when the connection is closed before that, as behind a
//!   gateway. A connection has at most 64 requests and replies under way; while it has more, nothing is read from it. It
//!   has at most 64 copies and second answers under way, and at most 64 replies wait for the next connection; further
//!   ones are lost.
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
//! - a late reply looks like the reply to the next request of the same shape, and one with a wrong station like the reply
//!   to such a request to that other station. The first is what a loop-back settles; the second nothing can tell. So give
//!   [`Fault::WrongStation`] and [`Fault::Delay`] to different stations, or a delay that is shorter than the client's
//!   timeout;
//! - a copy ([`Fault::Duplicate`]) looks like the reply to the next request of the same shape, and the true reply then like
//!   that to the one after: one copy can shift every later reply by one. As it comes before the true reply to any later
//!   request, a reply of another shape proves that there is no copy of an earlier one left;
//! - a [`Fault::SecondAnswer`] is like a copy, but may be a refusal after a value, or another value: comparing it with the
//!   first answer does not find it;
//! - a [`Fault::RoamingDuplicate`] may come after any number of later replies: no exchange proves that there is none left.
//!   It breaks what is assumed of TCP and of serial lines, and happens over UDP;
//! - a [`Fault::LeftOver`] reply looks like the reply to the first request of a new connection. Opening a connection
//!   proves nothing about the line behind it;
//! - an answered broadcast ([`Fault::AnswerBroadcast`]) looks like the reply to the next request of the same command to
//!   that station, for instance "done" to a RUN that is refused.

mod conversation;
mod dice;
mod faults;
mod left_over;
mod line;
mod log;
mod rule;
mod spoil;
mod timing;

use std::time::Duration;

use crate::ErrorCode;

pub(crate) use self::conversation::{Conditions, Conversation, Output};
pub use self::faults::Faults;
pub use self::left_over::LeftOver;
pub use self::line::Line;
pub use self::log::{Applied, Heard, Log, LogEntry};
pub use self::rule::Rule;
pub use self::timing::Timing;

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
    /// The reply comes once more, in order: at its time, but directly before the next reply of the same station if that
    /// is ready earlier. [`Fault::duplicate`] is the copy without a pause, which is handed over together with the reply.
    ///
    /// ```
    /// use std::time::Duration;
    /// use fatek::register;
    /// use fatek::sim::{self, Bus, Fault, Faults, Plc, Rule, Timing};
    /// use fatek::wire::Framing;
    /// use tokio::io::{AsyncReadExt, AsyncWriteExt};
    ///
    /// # #[tokio::main(flavor = "current_thread", start_paused = true)]
    /// # async fn main() -> Result<(), Box<dyn std::error::Error>> {
    /// // The copy of the first reply comes when the next request has arrived.
    /// let timing =
    ///     Timing::WithNextRequest { min_per_mille: 0, max_per_mille: 1000, at_latest: Duration::from_secs(9) };
    /// let faults = Faults::new(1).rule(Rule::new(Fault::Duplicate(timing)).times(1));
    /// let plc = Plc::new();
    /// let bus = Bus::new().with_station(1, plc.clone())?.with_faults(faults);
    /// let mut client = sim::connector(bus, Framing::Ascii)().await?;
    ///
    /// let mut reply = [0; 13];
    /// client.write_all(b"\x02014601R0000070\x03").await?; // read R0
    /// client.read_exact(&mut reply).await?;
    /// plc.write(register!("R0"), 5_u16)?;
    /// client.write_all(b"\x02014601R0000070\x03").await?; // again
    /// client.read_exact(&mut reply).await?;
    /// assert_eq!(&reply, b"\x02014600000BD\x03"); // the copy: 0
    /// client.read_exact(&mut reply).await?;
    /// assert_eq!(&reply, b"\x02014600005C2\x03"); // the reply: 5
    /// # Ok(())
    /// # }
    /// ```
    #[doc(alias = "copy")]
    Duplicate(Timing),
    /// The reply comes once more, and keeps no order: it is sent at its time even when later replies have been sent
    /// before, as over a network with several ways.
    ///
    /// ```
    /// use std::time::Duration;
    /// use fatek::sim::{self, Bus, Fault, Faults, Plc, Rule, Timing};
    /// use fatek::wire::Framing;
    /// use tokio::io::{AsyncReadExt, AsyncWriteExt};
    ///
    /// # #[tokio::main(flavor = "current_thread", start_paused = true)]
    /// # async fn main() -> Result<(), Box<dyn std::error::Error>> {
    /// let after = Duration::from_millis(50);
    /// let roaming = Fault::RoamingDuplicate(Timing::After { min: after, max: after });
    /// let faults = Faults::new(1).rule(Rule::new(roaming).times(1));
    /// let bus = Bus::new().with_station(1, Plc::new())?.with_faults(faults);
    /// let mut client = sim::connector(bus, Framing::Ascii)().await?;
    ///
    /// let mut received = [0; 13];
    /// client.write_all(b"\x02014601R0000070\x03").await?; // read R0
    /// client.read_exact(&mut received).await?;
    /// client.write_all(b"\x0201411F9\x03").await?; // RUN
    /// client.read_exact(&mut received[..9]).await?;
    /// assert_eq!(&received[..9], b"\x0201410F8\x03");
    /// client.read_exact(&mut received).await?; // without a request
    /// assert_eq!(&received, b"\x02014600000BD\x03");
    /// # Ok(())
    /// # }
    /// ```
    #[doc(alias("copy", "reorder"))]
    RoamingDuplicate(Timing),
    /// The request is answered a second time, in order like a [`Duplicate`](Self::Duplicate): a gateway has asked a busy
    /// PLC again.
    ///
    /// Without an error a read is executed again when its second answer is sent, so that it has the values of that time.
    /// Any other request is executed once, and its second answer is a copy of the first; so it is if [`Error`](Self::Error)
    /// refuses the request.
    ///
    /// ```
    /// use std::time::Duration;
    /// use fatek::{ErrorCode, register};
    /// use fatek::sim::{self, Bus, Fault, Faults, Plc, Rule, Timing};
    /// use fatek::wire::Framing;
    /// use tokio::io::{AsyncReadExt, AsyncWriteExt};
    ///
    /// # #[tokio::main(flavor = "current_thread", start_paused = true)]
    /// # async fn main() -> Result<(), Box<dyn std::error::Error>> {
    /// // The second answer comes 20 ms after the first, and says what is true then.
    /// let after = Duration::from_millis(20);
    /// let timing = Timing::After { min: after, max: after };
    /// let faults = Faults::new(1).rule(Rule::new(Fault::SecondAnswer { timing, error: None }));
    /// let plc = Plc::new();
    /// let bus = Bus::new().with_station(1, plc.clone())?.with_faults(faults.clone());
    /// let mut client = sim::connector(bus, Framing::Ascii)().await?;
    ///
    /// let mut reply = [0; 13];
    /// client.write_all(b"\x02014601R0000070\x03").await?; // read R0
    /// client.read_exact(&mut reply).await?;
    /// assert_eq!(&reply, b"\x02014600000BD\x03"); // 0
    /// plc.write(register!("R0"), 5_u16)?;
    /// client.read_exact(&mut reply).await?;
    /// assert_eq!(&reply, b"\x02014600005C2\x03"); // 5
    ///
    /// // Now the second answer is a refusal.
    /// let busy = Fault::SecondAnswer { timing, error: Some(ErrorCode::NotSupported) };
    /// faults.set_rules([Rule::new(busy)]);
    /// # Ok(())
    /// # }
    /// ```
    #[doc(alias = "copy")]
    SecondAnswer {
        /// When it is sent.
        timing: Timing,
        /// The error that it is.
        error: Option<ErrorCode>,
    },
    /// The reply comes this much later, like a [`Delay`](Self::Delay), and outlives its connection.
    ///
    /// If the client has closed the connection, or its half of it, by then, the reply is sent on the next connection to
    /// the bus: when that opens, or at its time if that is later. So does a serial device server whose serial side goes
    /// on when a client leaves. Of several connections the latest counts, if it was opened after the one that ended. Over
    /// UDP the reply goes to the address of the latest request.
    ///
    /// [`Faults::left_over`] has a run begin with such replies.
    ///
    /// ```
    /// use std::time::Duration;
    /// use fatek::sim::{self, Bus, Fault, Faults, Plc, Rule};
    /// use fatek::wire::Framing;
    /// use tokio::io::{AsyncReadExt, AsyncWriteExt};
    ///
    /// # #[tokio::main(flavor = "current_thread", start_paused = true)]
    /// # async fn main() -> Result<(), Box<dyn std::error::Error>> {
    /// let late = Duration::from_millis(500);
    /// let faults = Faults::new(1).rule(Rule::new(Fault::LeftOver { min: late, max: late }).times(1));
    /// let bus = Bus::new().with_station(1, Plc::new())?.with_faults(faults);
    /// let mut connect = sim::connector(bus, Framing::Ascii);
    ///
    /// let mut first = connect().await?;
    /// first.write_all(b"\x02014601R0000070\x03").await?; // read R0
    /// tokio::time::sleep(Duration::from_millis(100)).await;
    /// drop(first); // a timeout
    ///
    /// let mut second = connect().await?;
    /// let mut received = [0; 13];
    /// second.read_exact(&mut received).await?; // without a request
    /// assert_eq!(&received, b"\x02014600000BD\x03");
    /// # Ok(())
    /// # }
    /// ```
    #[doc(alias("late", "stale"))]
    LeftOver {
        /// The shortest delay.
        min: Duration,
        /// The longest delay.
        max: Duration,
    },
    /// Each station that obeys a broadcast replies to it, between the two times after the execution, both included.
    ///
    /// [`Rule::station`] narrows it to one of them, and the chance of a rule is drawn for each.
    ///
    /// ```
    /// use std::time::Duration;
    /// use fatek::sim::{self, Bus, Fault, Faults, Plc, Rule};
    /// use fatek::wire::Framing;
    /// use tokio::io::{AsyncReadExt, AsyncWriteExt};
    ///
    /// # #[tokio::main(flavor = "current_thread", start_paused = true)]
    /// # async fn main() -> Result<(), Box<dyn std::error::Error>> {
    /// let (min, max) = (Duration::ZERO, Duration::from_millis(5));
    /// let answer = Fault::AnswerBroadcast { station: None, min, max, error: None };
    /// let faults = Faults::new(1).rule(Rule::new(answer).station(2)); // only station 2
    /// let bus = Bus::new().with_station(1, Plc::new())?.with_station(2, Plc::new())?.with_faults(faults);
    /// let mut client = sim::connector(bus, Framing::Ascii)().await?;
    ///
    /// let mut received = [0; 9];
    /// client.write_all(b"\x0200411F8\x03").await?; // all stations, RUN
    /// client.read_exact(&mut received).await?;
    /// assert_eq!(&received, b"\x0202410F9\x03"); // station 2: done
    /// # Ok(())
    /// # }
    /// ```
    AnswerBroadcast {
        /// The station number of the reply, such as 0; `None` is each station's own.
        station: Option<u8>,
        /// The shortest delay. The station is busy meanwhile.
        min: Duration,
        /// The longest delay.
        max: Duration,
        /// The refusal that it answers with instead of executing the broadcast.
        error: Option<ErrorCode>,
    },
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
    /// One of the stations that obey a broadcast.
    Listener,
    /// It is a connection.
    Server,
}

impl Fault {
    /// A copy that follows the reply without a pause.
    #[must_use]
    pub const fn duplicate() -> Self {
        Self::Duplicate(Timing::AT_ONCE)
    }

    fn befalls(&self, addressee: Addressee) -> bool {
        match addressee {
            Addressee::Server => *self == Self::Refuse,
            Addressee::Listener => matches!(self, Self::AnswerBroadcast { .. }),
            Addressee::Plc => !matches!(self, Self::Refuse | Self::AnswerBroadcast { .. }),
            Addressee::Everybody => matches!(self, Self::Ignore | Self::Echo | Self::Disconnect(_)),
            Addressee::Nobody => matches!(self, Self::Echo | Self::Disconnect(_)),
        }
    }

    fn garbage_inside(&self) -> Option<usize> {
        if let Self::GarbageInside { max_len } = *self { Some(max_len) } else { None }
    }

    fn garbage_before(&self) -> Option<usize> {
        if let Self::GarbageBefore { max_len } = *self { Some(max_len) } else { None }
    }
}

#[cfg(test)]
mod tests;
