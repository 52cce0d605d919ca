//! Faults of a simulated PLC, of its line and of connections to it.
//!
//! - [`Fault`]: one deviation from a healthy PLC or line. [`Rule`]: the requests it applies to,
//!   by station, command, elements, count and chance. [`FaultRate`]: a fault with its chance as text.
//! - [`Faults`]: the rules of one [`Bus`](super::Bus). A handle: a test can change the rules while
//!   a client uses the bus, for instance to take a station offline and back.
//! - [`Line`]: transmission and response times.
//! - [`Log`]: the requests that arrived, their replies, and the [changes](Change) by them.
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
//! let rule = Rule::new(Fault::DropReply).command(Code::WriteRegisters).times(1);
//! let faults = Faults::new(7).rule(rule);
//! let bus = Bus::new().with_station(1, plc.clone())?.with_faults(faults.clone());
//! let connector = sim::connector(bus, Framing::Ascii);
//! let link = Link::connector_builder("in memory", Framing::Ascii, connector)
//!     .response_timeout(Duration::from_millis(20))
//!     .build();
//!
//! let error = link.station(1)?.write_registers(register!("R0"), &[5]).await.unwrap_err();
//! assert!(error.may_have_executed());
//! assert_eq!(plc.read(register!("R0")), 5_u16.into()); // executed
//! assert_eq!(faults.log().writes(), 1);
//! # Ok(())
//! # }
//! ```
//!
//! # Which rules apply
//!
//! Rules are evaluated once per request, on its arrival. A later change of the rules concerns later
//! requests only.
//!
//! - Per kind of fault, that is per variant of [`Fault`], the first rule that matches applies. The
//!   other rules of that kind are not evaluated. Otherwise the order of rules has no effect.
//! - Faults of different kinds combine, such as a delay, garbage and a wrong station.
//! - Rules are evaluated for good frames only. Noise is never answered.
//! - A rule is neither evaluated nor counted where its fault is impossible:
//!
//! | fault | applies to |
//! |---|---|
//! | [`Fault::Echo`], [`Fault::Disconnect`] | every frame |
//! | [`Fault::Ignore`] | requests to a station of the bus, and broadcasts |
//! | [`Fault::AnswerBroadcast`] | each station that obeys a broadcast, one evaluation per station |
//! | [`Fault::Refuse`] | connections |
//! | all others | requests to a station of the bus |
//!
//! A broadcast is a request to station 0. An [`Fault::Ignore`] rule for one station also makes that
//! station ignore broadcasts.
//!
//! # Order
//!
//! ```text
//! arrival ─▶ wait for station ─▶ response time ─▶ execution ─▶ delay ─▶ transmission
//!    │              │                                 │                      │
//!  Echo      earlier requests                  not with Error        one reply at a time,
//!  Ignore    to the station                                          in order of readiness
//!  Disconnect
//! ```
//!
//! - A station handles its requests one at a time, of all connections in order of arrival. It takes
//!   the next one when its reply is ready. So replies of one station stay in order, and other
//!   stations answer meanwhile.
//! - Execution precedes the delay: a delayed reply has the values of the time of execution.
//! - Changes of a reply go from the inside out: first its content ([`Fault::Error`],
//!   [`Fault::WrongStation`], [`Fault::WrongCommand`], [`Fault::Truncated`], [`Fault::Extended`])
//!   with a matching checksum, then [`Fault::BadChecksum`], [`Fault::GarbageInside`],
//!   [`Fault::GarbageBefore`], and [`Fault::Split`] last.
//! - Duplicates and second answers ([`Fault::Duplicate`], [`Fault::SecondAnswer`]) stay in order:
//!   each is sent at its time, but at the latest directly before the next reply of the station on
//!   the connection. Only a [`Fault::RoamingDuplicate`] can come after later replies.
//! - A duplicate has all changes of its reply except [`Fault::GarbageBefore`] and [`Fault::Split`].
//!   On a stream, one [without a pause](Timing::AT_ONCE) is split and delivered together with its
//!   reply. A reply that is dropped, or cut by the end of the connection, has no duplicate.
//! - On a stream, replies due at the same time are written at once, for instance a duplicate and
//!   the reply directly behind it. Over UDP each reply, duplicate and piece is a datagram.
//! - A [`Fault::LeftOver`] reply stays in the order of its station on the next connection, too. Its
//!   duplicates follow it there.
//! - A request that has arrived is executed even if its connection closes first, as behind a
//!   gateway.
//!
//! Limits per connection: 64 requests and replies in progress, while reading pauses above that, and
//! 64 duplicates and second answers. Limit per bus: 64 replies for the next connection. Duplicates,
//! second answers and left-over replies above these limits are discarded.
//!
//! # Time
//!
//! On a [`Line`] with a speed, a request has arrived after the transmission time of its bytes, one
//! request at a time. A reply is delivered after its own, one reply at a time. The two directions
//! are independent unless the line is [half-duplex](Line::half_duplex), an echo takes no time, and
//! all connections of a bus share the line.
//!
//! Times are computed exactly. Delivery uses Tokio's timer, which has whole milliseconds, so it can
//! be up to 1 ms late. Without delays and line speed no timer is used. A delay is at most a day.
//!
//! # Chance
//!
//! The faults of the n-th request to a station depend on the seed, the rules, the request and n.
//! They do not depend on requests to other stations, except through [`Rule::skip`] and
//! [`Rule::times`], which count over all stations of the rule. So equal seeds and equal requests
//! give equal faults.
//!
//! # Guarantees for the client under test
//!
//! A client that checks the checksum, the station, the command and the exact length that its
//! request expects never takes a faulty reply for a good one. Garbage that forms a good frame by
//! chance is drawn again. The exceptions are those of the protocol:
//!
//! - Truncation and extension by the same length cancel each other: use different lengths, or
//!   different stations.
//! - A reply to 53 has any length from 28 bytes on, and one to 4F can lack its error digit.
//! - In the ASCII framing, the echo of 4E or of STOP equals its reply.
//! - A late reply looks like the reply to the next request of the same shape. A loop-back resolves
//!   this.
//! - A late reply with a wrong station looks like the reply of that other station, and no client
//!   can detect it. Use [`Fault::WrongStation`] and [`Fault::Delay`] for different stations, or a
//!   delay shorter than the client's timeout.
//! - A [`Fault::Duplicate`] looks like the reply to the next request of the same shape. The true
//!   reply then looks like that to the request after it, and so on: one duplicate can shift all
//!   later replies. A reply of another shape proves that no duplicate of an earlier one is left.
//! - A [`Fault::SecondAnswer`] is like a duplicate, but can be a refusal or hold other values:
//!   comparing it with the first answer does not detect it.
//! - A [`Fault::RoamingDuplicate`] can come after any number of later replies: no exchange proves
//!   that none is left. TCP and serial lines exclude this fault; UDP does not.
//! - A [`Fault::LeftOver`] reply looks like the reply to the first request of a new connection.
//! - A reply to a broadcast ([`Fault::AnswerBroadcast`]) looks like the reply to the next request
//!   of the same command to that station, for instance the success of a RUN that is refused.

mod change;
mod corrupt;
mod faults;
mod kinds;
mod left_over;
mod line;
mod log;
mod rate;
mod rng;
mod rule;
mod session;
mod timing;

pub use self::change::Change;
pub use self::faults::Faults;
use self::kinds::FaultTarget;
pub use self::kinds::{DisconnectAt, Fault};
pub use self::left_over::LeftOver;
pub use self::line::Line;
pub use self::log::{Applied, Arrival, Log, LogEntry};
pub use self::rate::{FaultRate, ParseFaultError};
pub use self::rule::Rule;
pub(crate) use self::session::{Conditions, Output, Session};
pub use self::timing::Timing;

#[cfg(test)]
mod tests;
