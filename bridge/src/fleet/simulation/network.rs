//! Connections between the members and the server, and the messages on them.
//!
//! A connection ends with the server's life. While it lasts, requests and replies are delayed, doubled, lost and
//! overtake each other, which is more than TCP does. The entries of a watch keep their order, as NATS promises, and
//! are lost with the connection alone.

use std::collections::VecDeque;

use super::store::Change;
use super::world::{Event, World};
use super::{LEASE, Variant};
use crate::fleet::core::{Input, Operation, Outcome};
use crate::fleet::keys::{DEAD, Key};

/// A connection of a node.
#[derive(Debug)]
pub(super) struct Connection {
    node: usize,
    start: u32,
    /// The life of the server in which it was made.
    life: u64,
    /// The creation time of the store, as it was told.
    created: u64,
    is_watching: bool,
    /// Inputs on their way, in their order.
    watch: VecDeque<Input>,
}

/// A message, or a step of a connection.
#[derive(Clone, Debug)]
pub(super) enum Message {
    /// A node tries to connect.
    Connect { node: usize, start: u32 },
    /// The server tells the state of the store.
    Identify { connection: u64 },
    /// The server begins a watch.
    Watch { connection: u64 },
    /// The next input of a watch reaches its node.
    Entry { connection: u64, node: usize },
    /// A request reaches the server.
    Request { node: usize, start: u32, connection: u64, life: u64, request: u64, operation: Operation },
    /// A reply reaches its node.
    Reply { node: usize, start: u32, connection: u64, request: u64, outcome: Outcome },
    /// A node notices that its connection is lost.
    Lost { node: usize, start: u32, connection: u64 },
}

impl Message {
    /// The node whose process handles it.
    pub(super) fn receiver(&self) -> Option<usize> {
        match self {
            Self::Connect { node, .. }
            | Self::Entry { node, .. }
            | Self::Reply { node, .. }
            | Self::Lost { node, .. } => Some(*node),
            Self::Identify { .. } | Self::Watch { .. } | Self::Request { .. } => None,
        }
    }
}

impl World {
    pub(super) fn connect_soon(&mut self, node: usize) {
        let start = self.nodes[node].starts;
        let delay = self.rng.u64(1..LEASE / 5);
        self.after(delay, Event::Network(Message::Connect { node, start }));
    }

    /// A delay of a message.
    fn delay(&mut self) -> u64 {
        let delay = self.rng.u64(1..self.delay * 2);
        if self.rng.u8(..50) == 0 { delay * 8 } else { delay }
    }

    pub(super) fn deliver(&mut self, message: Message) {
        match message {
            Message::Connect { node, start } => self.connect(node, start),
            Message::Identify { connection } => self.identify(connection),
            Message::Watch { connection } => self.watch(connection),
            Message::Entry { connection, node } => self.entry(connection, node),
            Message::Request { node, start, connection, life, request, operation } => {
                self.serve(node, start, connection, life, request, &operation);
            }
            Message::Reply { node, start, connection, request, outcome } => {
                self.reply(node, start, connection, request, outcome);
            }
            Message::Lost { node, start, connection } => {
                if self.nodes[node].connection == Some(connection) && self.process(node, start).is_some() {
                    self.note(|| format!("node {node} notices that its connection is lost"));
                    self.lose_connection(node, start);
                }
            }
        }
    }

    fn connect(&mut self, node: usize, start: u32) {
        if self.process(node, start).is_none() || self.nodes[node].connection.is_some() {
            return;
        }
        if !self.store.is_up || self.nodes[node].is_cut {
            return self.connect_soon(node);
        }
        self.next_connection += 1;
        let connection = self.next_connection;
        self.nodes[node].connection = Some(connection);
        let (life, watch) = (self.store.life, VecDeque::new());
        let open = Connection { node, start, life, created: 0, is_watching: false, watch };
        self.connections.insert(connection, open);
        let delay = self.delay();
        self.after(delay, Event::Network(Message::Identify { connection }));
    }

    /// A node drops its connection. The requests on it may still reach the server.
    pub(super) fn lose_connection(&mut self, node: usize, start: u32) {
        if let Some(connection) = self.nodes[node].connection.take() {
            self.connections.remove(&connection);
        }
        self.connect_soon(node);
        self.feed(node, start, Input::Disconnected);
    }

    /// A connection that works, as the server sees it. If its node is cut off, the message waits.
    fn live(&mut self, connection: u64, message: &Message) -> Option<&mut Connection> {
        let life = self.store.life;
        let node = self.connections.get(&connection).filter(|connection| connection.life == life)?.node;
        if !self.store.is_up {
            return None;
        }
        if self.nodes[node].is_cut {
            self.after(LEASE / 50, Event::Network(message.clone()));
            return None;
        }
        self.connections.get_mut(&connection)
    }

    fn identify(&mut self, connection: u64) {
        let (created, last_revision) = (self.store.created, self.store.last_revision());
        let message = Message::Identify { connection };
        let Some(open) = self.live(connection, &message) else { return };
        let Some(created) = created else { return self.find_no_store(connection) };
        open.created = created;
        open.watch.push_back(Input::Connected { created, last_revision });
        self.send_entry(connection);
        let delay = self.delay();
        self.after(delay, Event::Network(Message::Watch { connection }));
    }

    fn find_no_store(&mut self, connection: u64) {
        let Some(open) = self.connections.get_mut(&connection) else { return };
        open.watch.push_back(Input::StoreMissing);
        let (node, start) = (open.node, open.start);
        self.send_entry(connection);
        self.after(LEASE / 4, Event::Network(Message::Lost { node, start, connection }));
    }

    fn watch(&mut self, connection: u64) {
        let created = self.store.created;
        let entries = self.store.entries();
        let message = Message::Watch { connection };
        let Some(open) = self.live(connection, &message) else { return };
        // The driver compares the creation time again when the watch is there.
        if created != Some(open.created) {
            return self.find_no_store(connection);
        }
        open.is_watching = true;
        let count = entries.len() + 1;
        let input = |Change { key, value, revision }| Input::Entry { key, value, revision };
        open.watch.extend(entries.into_iter().map(input).chain([Input::Complete]));
        for _ in 0..count {
            self.send_entry(connection);
        }
    }

    /// Schedules the arrival of one input of a watch. They arrive in their order, also if their delays differ.
    fn send_entry(&mut self, connection: u64) {
        let Some(node) = self.connections.get(&connection).map(|open| open.node) else { return };
        let mut delay = self.delay();
        if !self.is_healed && self.rng.u8(..100) == 0 {
            delay += self.rng.u64(..LEASE);
        }
        self.after(delay, Event::Network(Message::Entry { connection, node }));
    }

    fn entry(&mut self, connection: u64, node: usize) {
        if self.nodes[node].is_cut {
            return self.after(LEASE / 50, Event::Network(Message::Entry { connection, node }));
        }
        if self.nodes[node].connection != Some(connection) {
            return;
        }
        let Some(open) = self.connections.get_mut(&connection) else { return };
        let (start, input) = (open.start, open.watch.pop_front());
        if let Some(input) = input {
            let is_complete = matches!(input, Input::Complete);
            self.note(|| format!("node {node} sees {input:?}"));
            self.feed(node, start, input);
            if is_complete {
                self.moment(node, 0);
            }
        }
    }

    /// All watchers get a change.
    pub(super) fn publish(&mut self, change: &Change) {
        let life = self.store.life;
        let watching = self.connections.iter_mut().filter(|(_, open)| open.is_watching && open.life == life);
        let mut connections = Vec::new();
        for (connection, open) in watching {
            let Change { key, value, revision } = change.clone();
            open.watch.push_back(Input::Entry { key, value, revision });
            connections.push(*connection);
        }
        connections.into_iter().for_each(|connection| self.send_entry(connection));
        if self.rng.u8(..8) == 0 {
            self.store.keep();
        }
    }

    /// The connections that the server no longer serves are lost, which their nodes notice later.
    pub(super) fn drop_connections(&mut self, within: u64) {
        let open: Vec<_> = self.connections.iter().map(|(id, open)| (*id, open.node, open.start)).collect();
        for (connection, node, start) in open {
            if let Some(open) = self.connections.get_mut(&connection) {
                open.is_watching = false;
            }
            let delay = self.rng.u64(1..within);
            self.after(delay, Event::Network(Message::Lost { node, start, connection }));
        }
    }

    pub(super) fn send(&mut self, node: usize, start: u32, request: u64, operation: Operation, timeout: u64) {
        let local = self.local(node);
        let at = self.true_time(node, local + timeout);
        let Some(process) = self.process(node, start) else { return };
        process.requests.insert(request);
        self.at(at, Event::Timeout { node, start, request });
        let Some(connection) = self.nodes[node].connection else { return };
        // A request over a connection of an earlier life reaches nothing.
        let Some(life) = self.connections.get(&connection).map(|open| open.life) else { return };
        let mut copies = 1;
        if !self.is_healed {
            match self.rng.u8(..100) {
                0..=3 => copies = 0,
                4..=9 => copies = 2,
                10.. => {}
            }
        }
        for _ in 0..copies {
            let mut delay = self.delay();
            if !self.is_healed && self.rng.u8(..33) == 0 {
                delay += self.rng.u64(..LEASE * 3);
            }
            let operation = operation.clone();
            let message = Message::Request { node, start, connection, life, request, operation };
            self.after(delay, Event::Network(message));
        }
        self.moment(node, 0);
    }

    fn serve(&mut self, node: usize, start: u32, connection: u64, life: u64, request: u64, operation: &Operation) {
        if !self.store.is_up || life != self.store.life {
            return;
        }
        if self.nodes[node].is_cut {
            // Data in a socket is sent after a cut, or lost with the connection.
            if self.rng.bool() {
                let operation = operation.clone();
                let message = Message::Request { node, start, connection, life, request, operation };
                self.after(LEASE / 50, Event::Network(message));
            }
            return;
        }
        let wall = self.wall();
        let (outcome, change) = if is_fence(node, operation) && self.variant == Variant::NoFence {
            // It is told that it has fenced the session, which nothing was done about.
            let change = self.store.put("nothing", None, wall);
            (Outcome::Stored(change.revision), Some(change))
        } else if is_fence(node, operation) && self.variant == Variant::ServerTtl {
            (Outcome::WrongRevision, None)
        } else {
            self.store.perform(operation, wall)
        };
        self.note(|| format!("server: {operation:?} of node {node}: {outcome:?}"));
        if let Some(change) = &change {
            self.figures.fences += u64::from(is_fence(node, operation));
            self.publish(change);
        }
        self.moment(node, 0);
        for _ in 0..if !self.is_healed && self.rng.u8(..20) == 0 { 2 } else { 1 } {
            let mut delay = self.delay();
            if !self.is_healed && self.rng.u8(..20) == 0 {
                delay += self.rng.u64(..LEASE / 2);
            }
            if self.now < self.nodes[node].slow_until {
                // Just within the timeout, or not.
                delay += self.rng.u64(LEASE / 8..LEASE / 4);
            }
            let outcome = outcome.clone();
            self.after(delay, Event::Network(Message::Reply { node, start, connection, request, outcome }));
        }
    }

    fn reply(&mut self, node: usize, start: u32, connection: u64, request: u64, outcome: Outcome) {
        if self.nodes[node].connection != Some(connection) {
            return;
        }
        if self.nodes[node].is_cut {
            if self.rng.bool() {
                let message = Message::Reply { node, start, connection, request, outcome };
                self.after(LEASE / 50, Event::Network(message));
            }
            return;
        }
        let Some(process) = self.process(node, start) else { return };
        if !process.requests.remove(&request) {
            return;
        }
        self.note(|| format!("node {node} gets {outcome:?} for {request}"));
        self.feed(node, start, Input::Reply { request, outcome });
        self.moment(node, 0);
    }

    pub(super) fn timeout(&mut self, node: usize, start: u32, request: u64) {
        let Some(process) = self.process(node, start) else { return };
        if process.requests.remove(&request) {
            self.note(|| format!("node {node} has no reply for {request}"));
            self.feed(node, start, Input::Reply { request, outcome: Outcome::Unknown });
        }
    }

    /// The wall clock of the server.
    pub(super) fn wall(&self) -> u64 {
        self.now + self.wall_step
    }
}

/// Returns whether a request fences the session of another process.
fn is_fence(node: usize, operation: &Operation) -> bool {
    let Operation::Put { key, value, .. } = operation else { return false };
    matches!(Key::parse(key), Some(Key::Session(session)) if !session.starts_with(&format!("n{node}s")))
        && value == DEAD
}
