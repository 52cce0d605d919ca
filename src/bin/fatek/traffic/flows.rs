//! The connections of a capture: packets in, events out.
//!
//! The PLC is at the end with one of the ports. If both ends have such a port, the client is the one
//! whose packet comes first. A connection of TCP ends with FIN of both ends or RST of one, one of UDP
//! with the capture. Of too many connections, those with the oldest packets end.

use std::collections::{BTreeMap, HashMap};
use std::net::SocketAddr;

use bytes::Bytes;

use super::packet::{Packet, Segment};
use super::reassembly::{Stream, StreamPart};
use crate::conversation::{Change, Direction, Event, Timestamp};

/// Connections at a time. One more ends the quarter of them with the oldest packets.
const MAX_FLOWS: usize = 1024;

/// Ports of other packets that are counted, for a message.
const MAX_OTHER_PORTS: usize = 4096;

#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
struct Key {
    is_tcp: bool,
    client: SocketAddr,
    plc: SocketAddr,
}

#[derive(Debug)]
struct Flow {
    number: u64,
    to_plc: Stream,
    from_plc: Stream,
    /// Directions that have ended.
    ended: [bool; 2],
    /// Number of its last packet.
    used: u64,
}

#[derive(Debug)]
pub(super) struct Flows<'p> {
    ports: &'p [u16],
    by_key: HashMap<Key, Flow>,
    connections: u64,
    packets: u64,
    /// Packets with a payload between other ports.
    others: BTreeMap<u16, u64>,
}

impl<'p> Flows<'p> {
    pub(super) fn new(ports: &'p [u16]) -> Self {
        Self { ports, by_key: HashMap::new(), connections: 0, packets: 0, others: BTreeMap::new() }
    }

    /// Number of connections so far.
    pub(super) fn connections(&self) -> u64 {
        self.connections
    }

    /// The other port with the most packets, for a capture without a connection.
    pub(super) fn other_port(&self) -> Option<u16> {
        let (port, _) = self.others.iter().max_by_key(|&(&port, &count)| (count, std::cmp::Reverse(port)))?;
        Some(*port)
    }

    pub(super) fn push(&mut self, at: Timestamp, packet: &Packet<'_>) -> Vec<Event> {
        let Some((key, direction)) = self.classify(packet) else {
            for port in [packet.from.port(), packet.to.port()] {
                if !packet.payload.is_empty()
                    && (self.others.len() < MAX_OTHER_PORTS || self.others.contains_key(&port))
                {
                    *self.others.entry(port).or_default() += 1;
                }
            }
            return Vec::new();
        };
        let mut events = Vec::new();
        self.packets += 1;
        match packet.segment {
            Segment::Udp => {
                let Some(flow) = self.flow(key, at, &mut events) else { return events };
                let bytes = Bytes::copy_from_slice(packet.payload);
                let change = Change::Bytes { direction, bytes, is_datagram: true };
                events.push(Event { connection: flow.number, at, change });
                if packet.missing > 0 {
                    let count = u64::try_from(packet.missing).unwrap_or(u64::MAX);
                    let change = Change::Missing { direction, count };
                    events.push(Event { connection: flow.number, at, change });
                }
            }
            Segment::Tcp { sequence, acknowledged, begins, ends, resets } => {
                let tcp = Tcp { sequence, acknowledged, begins, ends, resets };
                self.tcp(key, direction, at, tcp, packet, &mut events);
            }
        }
        events
    }

    /// Ends all connections, in the order of their numbers.
    pub(super) fn finish(&mut self, at: Timestamp) -> Vec<Event> {
        let mut flows: Vec<Flow> = self.by_key.drain().map(|(_, flow)| flow).collect();
        flows.sort_by_key(|flow| flow.number);
        flows.into_iter().flat_map(|flow| flow.close(at)).collect()
    }

    fn tcp(
        &mut self,
        key: Key,
        direction: Direction,
        at: Timestamp,
        tcp: Tcp,
        packet: &Packet<'_>,
        events: &mut Vec<Event>,
    ) {
        // The last packets of a connection that has ended begin no other one.
        if packet.payload.is_empty() && !tcp.begins && !self.by_key.contains_key(&key) {
            return;
        }
        let is_other = |flow: &Flow| tcp.begins && flow.stream(direction).is_other_connection(tcp.sequence);
        if self.by_key.get(&key).is_some_and(is_other)
            && let Some(flow) = self.by_key.remove(&key)
        {
            events.extend(flow.close(at));
        }
        let Some(flow) = self.flow(key, at, events) else { return };
        let parts = flow.stream_mut(direction).push(tcp.sequence, tcp.begins, packet.payload, packet.missing);
        events.extend(flow.events(at, direction, parts));
        if let Some(acknowledged) = tcp.acknowledged {
            let other = opposite(direction);
            let parts = flow.stream_mut(other).acknowledge(acknowledged);
            events.extend(flow.events(at, other, parts));
        }
        if tcp.ends || tcp.resets {
            flow.ended[usize::from(direction == Direction::ToPlc)] = true;
            if tcp.resets {
                flow.ended = [true; 2];
            }
            if flow.ended == [true; 2]
                && let Some(flow) = self.by_key.remove(&key)
            {
                events.extend(flow.close(at));
            }
        }
    }

    /// The connection of a packet, and its direction; `None` for other ports.
    fn classify(&self, packet: &Packet<'_>) -> Option<(Key, Direction)> {
        let is_tcp = packet.segment != Segment::Udp;
        let to_plc = Key { is_tcp, client: packet.from, plc: packet.to };
        let from_plc = Key { is_tcp, client: packet.to, plc: packet.from };
        match (self.ports.contains(&packet.to.port()), self.ports.contains(&packet.from.port())) {
            (false, false) => None,
            (true, false) => Some((to_plc, Direction::ToPlc)),
            (false, true) => Some((from_plc, Direction::FromPlc)),
            (true, true) if self.by_key.contains_key(&from_plc) => Some((from_plc, Direction::FromPlc)),
            (true, true) => Some((to_plc, Direction::ToPlc)),
        }
    }

    fn flow(&mut self, key: Key, at: Timestamp, events: &mut Vec<Event>) -> Option<&mut Flow> {
        if !self.by_key.contains_key(&key) {
            if self.by_key.len() >= MAX_FLOWS {
                self.make_room(at, events);
            }
            self.connections += 1;
            let number = self.connections;
            let flow = Flow {
                number,
                to_plc: Stream::default(),
                from_plc: Stream::default(),
                ended: [false; 2],
                used: self.packets,
            };
            self.by_key.insert(key, flow);
            let transport = if key.is_tcp { "tcp" } else { "udp" };
            let ends = format!("{transport} {} > {}", key.client, key.plc);
            events.push(Event { connection: number, at, change: Change::Open(ends) });
        }
        let flow = self.by_key.get_mut(&key)?;
        flow.used = self.packets;
        Some(flow)
    }

    fn make_room(&mut self, at: Timestamp, events: &mut Vec<Event>) {
        let mut used: Vec<u64> = self.by_key.values().map(|flow| flow.used).collect();
        used.sort_unstable();
        let oldest = used.get(MAX_FLOWS / 4).copied().unwrap_or(u64::MAX);
        let mut closed: Vec<Flow> =
            self.by_key.extract_if(|_, flow| flow.used < oldest).map(|(_, flow)| flow).collect();
        closed.sort_by_key(|flow| flow.number);
        events.extend(closed.into_iter().flat_map(|flow| flow.close(at)));
    }
}

struct Tcp {
    sequence: u32,
    acknowledged: Option<u32>,
    begins: bool,
    ends: bool,
    resets: bool,
}

impl Flow {
    fn stream(&self, direction: Direction) -> &Stream {
        match direction {
            Direction::ToPlc => &self.to_plc,
            Direction::FromPlc => &self.from_plc,
        }
    }

    fn stream_mut(&mut self, direction: Direction) -> &mut Stream {
        match direction {
            Direction::ToPlc => &mut self.to_plc,
            Direction::FromPlc => &mut self.from_plc,
        }
    }

    fn events(&self, at: Timestamp, direction: Direction, parts: Vec<StreamPart>) -> Vec<Event> {
        let change = |part| match part {
            StreamPart::Bytes(bytes) => Change::Bytes { direction, bytes, is_datagram: false },
            StreamPart::Missing(count) => Change::Missing { direction, count },
        };
        parts.into_iter().map(|part| Event { connection: self.number, at, change: change(part) }).collect()
    }

    fn close(mut self, at: Timestamp) -> Vec<Event> {
        let (to_plc, from_plc) = (self.to_plc.finish(), self.from_plc.finish());
        let mut events = self.events(at, Direction::ToPlc, to_plc);
        events.extend(self.events(at, Direction::FromPlc, from_plc));
        events.push(Event { connection: self.number, at, change: Change::Close });
        events
    }
}

fn opposite(direction: Direction) -> Direction {
    match direction {
        Direction::ToPlc => Direction::FromPlc,
        Direction::FromPlc => Direction::ToPlc,
    }
}

#[cfg(test)]
mod tests;
