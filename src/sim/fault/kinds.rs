use std::time::Duration;

use super::Timing;
use crate::ErrorCode;

/// One deviation from a healthy PLC, line or connection.
///
/// A [`Rule`](super::Rule) says which requests it applies to; the [module](super) says how faults
/// combine.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum Fault {
    /// No reply, and the request is not executed.
    ///
    /// For a PLC without power, or a request lost on the line.
    #[doc(alias = "silent")]
    Ignore,
    /// No reply, but the request is executed.
    ///
    /// For a reply lost on the line: the client cannot tell whether a write was executed.
    #[doc(alias = "silent")]
    DropReply,
    /// The reply comes late, by a delay drawn per request from `min` to `max`, both included.
    ///
    /// For jitter. A delay above the client's response timeout gives a late reply, which can be
    /// mistaken for the reply to the next request.
    #[doc(alias("late", "jitter"))]
    Delay {
        /// Shortest delay.
        min: Duration,
        /// Longest delay.
        max: Duration,
    },
    /// The reply comes in several pieces with pauses between them. The line is busy meanwhile.
    ///
    /// For serial device servers and slow streams.
    Split {
        /// Number of pieces, of nearly equal length; at most one per byte of the reply.
        pieces: usize,
        /// Pause between two pieces.
        pause: Duration,
    },
    /// Random bytes come directly before the reply.
    ///
    /// For noise on the line. In the binary framing the bytes can look like the beginning of a
    /// frame that the reply is a part of.
    GarbageBefore {
        /// Maximum number of bytes. The number is drawn per reply, from 1 to this, at most 1024.
        max_len: usize,
    },
    /// Random bytes come within the reply, which is not a good frame then.
    ///
    /// For noise on the line.
    GarbageInside {
        /// Maximum number of bytes. The number is drawn per reply, from 1 to this, at most 1024.
        max_len: usize,
    },
    /// The reply has the number of the next station and a good checksum. The next of 254 is 1.
    ///
    /// For a gateway that mixes up the replies of its stations.
    WrongStation,
    /// The reply has the code of another command and a good checksum.
    ///
    /// The code is the next one in the manuals' table: 47 instead of 46. For late replies to other
    /// requests.
    WrongCommand,
    /// The reply lacks the end of its data and has a good checksum.
    ///
    /// For a reply to a shorter request, or a PLC that sends less than was requested.
    #[doc(alias = "wrong length")]
    Truncated {
        /// Number of missing characters (ASCII) or bytes (binary); at most all data.
        by: usize,
    },
    /// The reply has zeros behind its data and a good checksum.
    ///
    /// For a reply to a longer request, or a PLC that sends more than was requested.
    #[doc(alias = "wrong length")]
    Extended {
        /// Number of additional characters (ASCII) or bytes (binary); at most 1024.
        by: usize,
    },
    /// The reply has a wrong value and the checksum of the right one.
    ///
    /// The last character or byte of the data is replaced by another valid one; without data, one
    /// of the checksum. For bit errors on the line.
    BadChecksum,
    /// The reply comes twice; the duplicate stays in order.
    ///
    /// The duplicate is sent at its time, but directly before the next reply of the station if that
    /// is ready earlier. [`Fault::duplicate`] is one without a pause, delivered together with the
    /// reply. For serial device servers and adapters that repeat what they received.
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
    /// // The duplicate of the first reply comes when the next request has arrived.
    /// let at_latest = Duration::from_secs(9);
    /// let timing = Timing::WithNextRequest { min_per_mille: 0, max_per_mille: 1000, at_latest };
    /// let faults = Faults::new(1).rule(Rule::new(Fault::Duplicate(timing)).times(1));
    /// let plc = Plc::new();
    /// let bus = Bus::new().with_station(1, plc.clone())?.with_faults(faults);
    /// let mut client = sim::connector(bus, Framing::Ascii)().await?;
    ///
    /// let mut reply = [0; 13];
    /// client.write_all(b"\x02014601R0000070\x03").await?; // read R0
    /// client.read_exact(&mut reply).await?;
    /// plc.write(register!("R0"), 5_u16)?;
    /// client.write_all(b"\x02014601R0000070\x03").await?; // read R0 again
    /// client.read_exact(&mut reply).await?;
    /// assert_eq!(&reply, b"\x02014600000BD\x03"); // the duplicate: 0
    /// client.read_exact(&mut reply).await?;
    /// assert_eq!(&reply, b"\x02014600005C2\x03"); // the reply: 5
    /// # Ok(())
    /// # }
    /// ```
    #[doc(alias = "copy")]
    Duplicate(Timing),
    /// The reply comes twice; the duplicate can come after later replies.
    ///
    /// The duplicate is sent at its time, also behind later replies. For UDP over a network with
    /// several paths.
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
    /// client.read_exact(&mut received).await?; // the duplicate, without a request
    /// assert_eq!(&received, b"\x02014600000BD\x03");
    /// # Ok(())
    /// # }
    /// ```
    #[doc(alias("copy", "reorder"))]
    RoamingDuplicate(Timing),
    /// The request gets two replies; the second is a new one, in order as a
    /// [`Duplicate`](Self::Duplicate).
    ///
    /// For a gateway that repeats the request to a busy PLC. The second reply is
    ///
    /// - with an `error`: that refusal,
    /// - to a read: the result of a second execution, at the time of sending,
    /// - to any other request, and to one that [`Error`](Self::Error) refuses: a duplicate of the
    ///   first reply. The request is executed at most once.
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
    /// // The second answer comes 20 ms after the first, with the values of that time.
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
    /// // From now on the second answer is a refusal.
    /// let busy = Fault::SecondAnswer { timing, error: Some(ErrorCode::NotSupported) };
    /// faults.set_rules([Rule::new(busy)]);
    /// # Ok(())
    /// # }
    /// ```
    #[doc(alias = "copy")]
    SecondAnswer {
        /// When it is sent.
        timing: Timing,
        /// The refusal to send, or `None` for a usual reply.
        error: Option<ErrorCode>,
    },
    /// The reply comes late, as with [`Delay`](Self::Delay), and on the next connection if its own
    /// has ended.
    ///
    /// For serial device servers: their serial side goes on when a client disconnects. If the
    /// client has closed the connection, or its half of it, the reply is sent on the next
    /// connection to the bus: when that opens, or at its time if that is later. Of several
    /// connections the latest gets it, provided that it was opened after the one that ended. Over
    /// UDP the reply goes to the address of the latest request.
    ///
    /// [`Faults::left_over`](super::Faults::left_over) adds such replies at the beginning of a run.
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
    /// let left_over = Fault::LeftOver { min: late, max: late };
    /// let faults = Faults::new(1).rule(Rule::new(left_over).times(1));
    /// let bus = Bus::new().with_station(1, Plc::new())?.with_faults(faults);
    /// let mut connect = sim::connector(bus, Framing::Ascii);
    ///
    /// let mut first = connect().await?;
    /// first.write_all(b"\x02014601R0000070\x03").await?; // read R0
    /// tokio::time::sleep(Duration::from_millis(100)).await;
    /// drop(first); // after a timeout
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
        /// Shortest delay.
        min: Duration,
        /// Longest delay.
        max: Duration,
    },
    /// Each station that obeys a broadcast replies to it, after a delay from `min` to `max`, both
    /// included.
    ///
    /// For PLCs or gateways that answer broadcasts against the protocol. [`Rule::station`] limits
    /// it to one station, and the chance of the rule is drawn per station.
    ///
    /// [`Rule::station`]: super::Rule::station
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
    /// let faults = Faults::new(1).rule(Rule::new(answer).station(2)); // station 2 only
    /// let bus = Bus::new().with_station(1, Plc::new())?.with_station(2, Plc::new())?;
    /// let mut client = sim::connector(bus.with_faults(faults), Framing::Ascii)().await?;
    ///
    /// let mut received = [0; 9];
    /// client.write_all(b"\x0200411F8\x03").await?; // RUN to all stations
    /// client.read_exact(&mut received).await?;
    /// assert_eq!(&received, b"\x0202410F9\x03"); // the success of station 2
    /// # Ok(())
    /// # }
    /// ```
    AnswerBroadcast {
        /// Station number in the reply, such as 0. `None` is the number of the station.
        station: Option<u8>,
        /// Shortest delay after the execution. The station is busy meanwhile.
        min: Duration,
        /// Longest delay.
        max: Duration,
        /// The refusal that it sends instead of executing the broadcast.
        error: Option<ErrorCode>,
    },
    /// The bytes of the request come back on its arrival, before any reply.
    ///
    /// For RS-485 adapters that receive their own transmission. Applies to broadcasts, too, and to
    /// requests for stations that are offline or not on the bus.
    Echo,
    /// The connection is closed, at the given point.
    ///
    /// For gateways that restart, and for connections that break at any time.
    Disconnect(DisconnectAt),
    /// The connection is not accepted.
    ///
    /// A [`Server`](super::super::Server) closes it at once; a
    /// [`connector`](super::super::connector) fails with
    /// [`ConnectionRefused`](std::io::ErrorKind::ConnectionRefused). For gateways with a limit of
    /// connections. Rules with a station, a command or elements never match.
    ///
    /// For a closed port, [shut the server down](super::super::Server::shutdown) and bind it again
    /// later.
    Refuse,
    /// The reply is this refusal, and the request is not executed.
    ///
    /// For handling of error codes that a healthy simulated PLC does not send.
    Error(ErrorCode),
}

/// The point at which [`Fault::Disconnect`] closes the connection.
///
/// Other requests that have arrived by then are still executed, but not answered. For a request
/// without a reply, all points but the first are the end of its execution, or the time at which it
/// would have been executed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum DisconnectAt {
    /// On arrival of the request, which is not executed.
    BeforeExecution,
    /// After the execution, before the reply.
    BeforeReply,
    /// After half of the bytes of the reply.
    WithinReply,
    /// After the whole reply.
    AfterReply,
}

/// Targets of faults.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum FaultTarget {
    /// A request to a station of the bus.
    Station,
    /// A request to a station that is not on the bus.
    AbsentStation,
    /// A request to all stations.
    Broadcast,
    /// One station that obeys a broadcast.
    BroadcastListener,
    /// A new connection.
    Connection,
}

impl Fault {
    /// A duplicate that follows the reply without a pause.
    #[must_use]
    pub const fn duplicate() -> Self {
        Self::Duplicate(Timing::AT_ONCE)
    }

    pub(super) fn applies_to(&self, target: FaultTarget) -> bool {
        match target {
            FaultTarget::Connection => *self == Self::Refuse,
            FaultTarget::BroadcastListener => matches!(self, Self::AnswerBroadcast { .. }),
            FaultTarget::Station => !matches!(self, Self::Refuse | Self::AnswerBroadcast { .. }),
            FaultTarget::Broadcast => matches!(self, Self::Ignore | Self::Echo | Self::Disconnect(_)),
            FaultTarget::AbsentStation => matches!(self, Self::Echo | Self::Disconnect(_)),
        }
    }

    pub(super) fn garbage_inside(&self) -> Option<usize> {
        if let Self::GarbageInside { max_len } = *self { Some(max_len) } else { None }
    }

    pub(super) fn garbage_before(&self) -> Option<usize> {
        if let Self::GarbageBefore { max_len } = *self { Some(max_len) } else { None }
    }
}
