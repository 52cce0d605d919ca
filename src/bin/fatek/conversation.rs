//! Conversations between clients and PLCs: the bytes of both directions, with their times, are split
//! into frames, and requests are paired with their replies.
//!
//! Free of I/O and clocks. Sources of [traffic](crate::traffic) feed [`Event`]s to an [`Analysis`],
//! which returns [`Entry`]s: exchanges, and frames and bytes that belong to none.

mod entry;
mod framer;
mod pairing;

use std::collections::BTreeMap;
use std::fmt;
use std::time::Duration;

use bytes::Bytes;
use fatek::wire::{Framing, Received};

pub(crate) use self::entry::{Answer, Entry, Exchange, Found, Outcome, SeenFrame, StrayReply, Verdict};
use self::framer::{Framed, Framer};
use self::pairing::Pairer;

/// Time since 1970.
pub(crate) type Timestamp = Duration;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Direction {
    ToPlc,
    FromPlc,
}

impl fmt::Display for Direction {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::ToPlc => "to the PLC",
            Self::FromPlc => "from the PLC",
        })
    }
}

/// An event of one connection.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Event {
    /// Number of the connection, from 1.
    pub(crate) connection: u64,
    pub(crate) at: Timestamp,
    pub(crate) change: Change,
}

#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Change {
    /// It begins, or its source begins to see it. The text names its two ends.
    Open(String),
    /// Bytes pass. `is_datagram`: no frame goes on behind them.
    Bytes { direction: Direction, bytes: Bytes, is_datagram: bool },
    /// Bytes passed that the source does not have.
    Missing { direction: Direction, count: u64 },
    /// It ends.
    Close,
}

/// Frames and exchanges of any number of connections.
///
/// Invariants:
/// - At most [`MAX_CONNECTIONS`] are open. One more ends the one with the lowest number.
/// - A connection holds at most one incomplete frame of each direction, and [`pairing::MAX_OPEN`]
///   requests.
/// - All bytes of all events are in entries, unless they were in complete frames of exchanges.
#[derive(Debug)]
pub(crate) struct Analysis {
    /// Framing of all connections; `None`: that of the first frame of each.
    framing: Option<Framing>,
    connections: BTreeMap<u64, Connection>,
}

/// Connections that are open at a time.
const MAX_CONNECTIONS: usize = 4096;

#[derive(Debug)]
struct Connection {
    framer: Framer,
    pairer: Pairer,
    last_at: Timestamp,
}

impl Analysis {
    pub(crate) fn new(framing: Option<Framing>) -> Self {
        Self { framing, connections: BTreeMap::new() }
    }

    /// Takes the next event, and appends the entries that are complete with it.
    pub(crate) fn push(&mut self, event: Event, entries: &mut Vec<Entry>) {
        let Event { connection: number, at, change } = event;
        let framing = self.framing;
        if self.connections.len() >= MAX_CONNECTIONS
            && !self.connections.contains_key(&number)
            && let Some((_, first)) = self.connections.pop_first()
        {
            first.finish(entries);
        }
        let new = || Connection { framer: Framer::new(framing), pairer: Pairer::new(number), last_at: at };
        let connection = self.connections.entry(number).or_insert_with(new);
        connection.last_at = at;
        match change {
            Change::Open(_) => {}
            Change::Bytes { direction, bytes, is_datagram } => {
                let framed = connection.framer.push(direction, at, &bytes, is_datagram);
                connection.pair(framed, entries);
            }
            Change::Missing { direction, count } => {
                let framed = connection.framer.flush(direction, at);
                connection.pair(framed, entries);
                if direction == Direction::FromPlc {
                    connection.pairer.doubt();
                }
                let found = Found::Missing { direction, count };
                entries.push(Entry { connection: number, at, found });
            }
            Change::Close => {
                if let Some(connection) = self.connections.remove(&number) {
                    connection.finish(entries);
                }
            }
        }
    }

    /// Ends all connections.
    pub(crate) fn finish(&mut self, entries: &mut Vec<Entry>) {
        for (_, connection) in std::mem::take(&mut self.connections) {
            connection.finish(entries);
        }
    }
}

impl Connection {
    fn pair(&mut self, framed: Vec<Framed>, entries: &mut Vec<Entry>) {
        for Framed { direction, at, received, bytes, framing } in framed {
            match received {
                Received::Frame(frame) => {
                    self.pairer.push(direction, at, SeenFrame { frame, bytes, framing }, entries);
                }
                // All other items are bytes of no frame.
                Received::Discarded { .. } | _ => self.pairer.push_bad(direction, at, bytes, framing, entries),
            }
        }
    }

    fn finish(mut self, entries: &mut Vec<Entry>) {
        for direction in [Direction::ToPlc, Direction::FromPlc] {
            let framed = self.framer.flush(direction, self.last_at);
            self.pair(framed, entries);
        }
        self.pairer.finish(entries);
    }
}

#[cfg(test)]
mod tests;
