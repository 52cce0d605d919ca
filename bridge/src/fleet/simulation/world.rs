//! The world of one seed: its nodes, their clocks, and its events in their order.

mod actions;
mod checks;

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet, BinaryHeap};
use std::sync::Arc;

pub(super) use self::checks::Figures;
use super::faults::Fault;
use super::network::{Connection, Message};
use super::oracle::{Oracle, Owner};
use super::store::Store;
use super::{LEASE, Variant};
use crate::fleet::core::{Core, Input, Member, Settings};
use crate::fleet::keys::Key;
use crate::fleet::{LinkSpec, LinkToken, Reach};

/// The longest way of a request from the gate to its PLC.
const TO_PLC: u64 = LEASE / 100 * 3;
/// The largest error of a clock's rate, in millionths.
const DRIFT: i64 = 30_000;
/// The period of the requests to a PLC.
const POLL: u64 = LEASE / 12;
/// The least time between two calls of a core for its timers.
const TIMER: u64 = LEASE / 5000;
/// More events than a run has: it makes no progress.
const MAX_EVENTS: u64 = 3_000_000;
/// After the faults all must be well within this time.
const SETTLE: u64 = LEASE * 10;

/// An event. `start` counts the starts of its node: events of a former process are dropped.
#[derive(Clone, Debug)]
pub(super) enum Event {
    Start {
        node: usize,
    },
    Wake {
        node: usize,
        start: u32,
    },
    Timeout {
        node: usize,
        start: u32,
        request: u64,
    },
    /// `is_extra`: no other one follows.
    Poll {
        node: usize,
        start: u32,
        owner: Owner,
        link: Arc<str>,
        is_extra: bool,
    },
    Closed {
        node: usize,
        start: u32,
        link: Arc<str>,
        token: LinkToken,
    },
    Arrive {
        link: Arc<str>,
        owner: Owner,
    },
    Network(Message),
    Fault(Fault),
    Resume {
        node: usize,
    },
    EndCut {
        node: usize,
    },
    ServerUp {
        is_set_back: bool,
        step: u64,
    },
    Expire,
    MakeStore,
    Heal,
}

/// A machine with a clock, on which a process of the bridge runs.
#[derive(Debug)]
pub(super) struct Node {
    pub(super) starts: u32,
    pub(super) process: Option<Process>,
    offset: u64,
    /// The error of the rate of its clock, in millionths.
    drift: i64,
    weight: u32,
    /// `true` while its process is stopped.
    pub(super) is_stopped: bool,
    /// The events that wait for the process to go on.
    backlog: Vec<Event>,
    pub(super) is_cut: bool,
    /// Messages to it are slow until then.
    pub(super) slow_until: u64,
    /// Its connection.
    pub(super) connection: Option<u64>,
}

/// A process of the bridge.
#[derive(Debug)]
pub(super) struct Process {
    pub(super) core: Core,
    /// The end of the gates of its sessions.
    pub(super) gates: BTreeMap<Arc<str>, u64>,
    /// The links that it owns.
    pub(super) owned: BTreeMap<Arc<str>, Owner>,
    /// Requests without a reply or a timeout.
    pub(super) requests: BTreeSet<u64>,
    wake_at: Option<u64>,
    pub(super) is_leaving: bool,
    pub(super) has_left: bool,
    pub(super) has_failed: bool,
}

#[derive(Debug)]
pub(super) struct World {
    pub(super) variant: Variant,
    pub(super) rng: fastrand::Rng,
    /// The true time.
    pub(super) now: u64,
    queue: BinaryHeap<Reverse<(u64, u64, usize)>>,
    events: Vec<Option<Event>>,
    free: Vec<usize>,
    sequence: u64,
    pub(super) store: Store,
    /// The creation time of the last store that was deleted.
    pub(super) deleted: u64,
    /// The error of the wall clock of the server.
    pub(super) wall_step: u64,
    pub(super) connections: BTreeMap<u64, Connection>,
    pub(super) next_connection: u64,
    pub(super) nodes: Vec<Node>,
    links: Vec<LinkSpec>,
    oracle: Oracle,
    /// The typical delay of a message.
    pub(super) delay: u64,
    pub(super) faults_left: u32,
    pub(super) heal_at: u64,
    pub(super) is_healed: bool,
    check_at: u64,
    pub(super) figures: Figures,
    is_tracing: bool,
    failure: Option<String>,
}

impl World {
    pub(super) fn new(seed: u64, variant: Variant) -> Self {
        let mut rng = fastrand::Rng::with_seed(seed);
        let links = (0..rng.usize(2..=6)).map(|n| format!("plc{n}").into());
        let links: Vec<Arc<str>> = links.collect();
        let node = |rng: &mut fastrand::Rng| Node {
            starts: 0,
            process: None,
            offset: rng.u64(1..LEASE * 1000),
            drift: rng.i64(-DRIFT..=DRIFT),
            weight: rng.u32(1..=2),
            is_stopped: false,
            backlog: Vec::new(),
            is_cut: false,
            slow_until: 0,
            connection: None,
        };
        let nodes: Vec<_> = (0..rng.usize(3..=5)).map(|_| node(&mut rng)).collect();
        let mut spec = |id: Arc<str>| {
            let only = (0..nodes.len()).filter(|_| rng.bool()).map(|node| id_of(node).into()).collect();
            let reach = if rng.u8(..4) == 0 { Reach::Only(only) } else { Reach::All };
            LinkSpec { id, reach }
        };
        let links: Vec<_> = links.into_iter().map(&mut spec).collect();
        let heal_at = LEASE * rng.u64(8..30);
        let mut world = Self {
            variant,
            delay: rng.u64(LEASE / 2000..LEASE / 60),
            faults_left: rng.u32(2..=16),
            rng,
            now: LEASE,
            queue: BinaryHeap::new(),
            events: Vec::new(),
            free: Vec::new(),
            sequence: 0,
            store: Store::new(),
            deleted: 0,
            wall_step: 0,
            connections: BTreeMap::new(),
            next_connection: 0,
            nodes,
            links,
            oracle: Oracle::default(),
            heal_at: LEASE + heal_at,
            is_healed: false,
            check_at: u64::MAX,
            figures: Figures::default(),
            is_tracing: false,
            failure: None,
        };
        world.leave_remains();
        for node in 0..world.nodes.len() {
            let longest = if world.rng.bool() { LEASE / 10 } else { LEASE * 5 };
            let at = world.rng.u64(..longest);
            world.after(at, Event::Start { node });
        }
        world.plan_faults();
        if variant == Variant::ServerTtl {
            world.after(LEASE / 10, Event::Expire);
        }
        world.at(world.heal_at, Event::Heal);
        world
    }

    /// Some runs begin with a store that a former fleet has left.
    fn leave_remains(&mut self) {
        if self.rng.bool() {
            return;
        }
        let sessions: Vec<String> = (0..3).map(|n| format!("old-{n}")).collect();
        for (n, session) in sessions.iter().enumerate() {
            let value = format!(
                r#"{{"member":"{}","version":"0","config":"c","weight":1,"draining":false,"lease_ms":500,"beat":7}}"#,
                id_of(n)
            );
            let value = match self.rng.u8(..3) {
                0 => Some(value),
                1 => Some("dead".to_owned()),
                // Its links remain.
                _ => continue,
            };
            self.store.put(&Key::Session(session).text(), value, 0);
        }
        for link in self.links.clone() {
            let value = match self.rng.u8(..4) {
                0 => Some(String::new()),
                1 => None,
                _ => Some(sessions[self.rng.usize(..sessions.len())].clone()),
            };
            if self.rng.u8(..4) > 0 {
                self.store.put(&Key::Link(&link.id).text(), value, 0);
            }
        }
        self.store.keep();
    }

    pub(super) fn trace(&mut self) {
        self.is_tracing = true;
    }

    pub(super) fn note(&self, text: impl FnOnce() -> String) {
        if self.is_tracing {
            println!("{:>9.4} {}", self.now as f64 / LEASE as f64, text());
        }
    }

    pub(super) fn figures(&self) -> Figures {
        let mut figures = self.figures.clone();
        figures.requests = self.oracle.requests;
        figures.handovers = self.oracle.handovers();
        figures
    }

    /// Runs until all is well again after the faults.
    ///
    /// # Errors
    /// The first rule that was broken.
    pub(super) fn run(&mut self) -> Result<(), String> {
        while let Some(Reverse((at, _, slot))) = self.queue.pop() {
            self.now = at;
            if self.now >= self.check_at {
                if self.nodes.iter().filter_map(|node| node.process.as_ref()).all(Process::goes_on) {
                    return self.check_all_is_well();
                }
                // It will be replaced.
                self.check_at = self.now + SETTLE;
            }
            self.figures.events += 1;
            if self.figures.events > MAX_EVENTS {
                return Err("it makes no progress".to_owned());
            }
            self.free.push(slot);
            if let Some(event) = self.events[slot].take() {
                self.perform(event);
            }
            if let Some(failure) = self.failure.take() {
                return Err(format!("{failure} (at {:.4} leases)", self.now as f64 / LEASE as f64));
            }
        }
        Err("nothing happens any more".to_owned())
    }

    pub(super) fn at(&mut self, at: u64, event: Event) {
        let slot = self.free.pop().unwrap_or_else(|| {
            self.events.push(None);
            self.events.len() - 1
        });
        self.events[slot] = Some(event);
        self.sequence += 1;
        self.queue.push(Reverse((at.max(self.now), self.sequence, slot)));
    }

    pub(super) fn after(&mut self, delay: u64, event: Event) {
        self.at(self.now + delay, event);
    }

    fn perform(&mut self, event: Event) {
        // A process that is stopped sees its events when it goes on.
        let node = match &event {
            Event::Wake { node, .. }
            | Event::Timeout { node, .. }
            | Event::Poll { node, .. }
            | Event::Closed { node, .. } => Some(*node),
            Event::Network(message) => message.receiver(),
            Event::Start { .. }
            | Event::Arrive { .. }
            | Event::Fault(_)
            | Event::Resume { .. }
            | Event::EndCut { .. }
            | Event::ServerUp { .. }
            | Event::Expire
            | Event::MakeStore
            | Event::Heal => None,
        };
        if let Some(node) = node.filter(|node| self.nodes[*node].is_stopped) {
            return self.nodes[node].backlog.push(event);
        }
        match event {
            Event::Start { node } => self.start(node),
            Event::Wake { node, start } => self.wake(node, start),
            Event::Timeout { node, start, request } => self.timeout(node, start, request),
            Event::Poll { node, start, owner, link, is_extra } => self.poll(node, start, owner, link, is_extra),
            Event::Closed { node, start, link, token } => {
                self.feed(node, start, Input::Closed { link, token });
            }
            Event::Arrive { link, owner } => self.arrive(&link, &owner),
            Event::Network(message) => self.deliver(message),
            Event::Fault(fault) => self.strike(fault),
            Event::Resume { node } => self.resume(node),
            Event::EndCut { node } => self.nodes[node].is_cut = false,
            Event::ServerUp { is_set_back, step } => self.server_up(is_set_back, step),
            Event::Expire => self.expire(),
            Event::MakeStore => self.make_store(),
            Event::Heal => self.heal(),
        }
    }

    /// The time of a node's clock.
    pub(super) fn local(&self, node: usize) -> u64 {
        let node = &self.nodes[node];
        let drift = i128::from(self.now) * i128::from(node.drift) / 1_000_000;
        let local = i128::from(node.offset) + i128::from(self.now) + drift;
        u64::try_from(local).unwrap_or(0)
    }

    /// The true time at which a node's clock has a time.
    pub(super) fn true_time(&self, node: usize, local: u64) -> u64 {
        let node = &self.nodes[node];
        let passed = i128::from(local) - i128::from(node.offset);
        let time = passed * 1_000_000 / (1_000_000 + i128::from(node.drift));
        u64::try_from(time + 1).unwrap_or(0)
    }

    fn start(&mut self, node: usize) {
        if self.nodes[node].process.is_some() {
            return;
        }
        self.nodes[node].starts += 1;
        let start = self.nodes[node].starts;
        self.note(|| format!("node {node} starts, {start}"));
        let settings = Settings { lease: LEASE, process: format!("n{node}s{start}"), max_requests: 4 };
        let member = Member {
            id: id_of(node).into(),
            version: "1".to_owned(),
            config: "c".to_owned(),
            weight: self.nodes[node].weight,
        };
        let mut core = Core::new(settings, member.clone());
        if self.variant == Variant::DeadlineFromReply {
            core.count_from_reply();
        }
        self.nodes[node].process = Some(Process {
            core,
            gates: BTreeMap::new(),
            owned: BTreeMap::new(),
            requests: BTreeSet::new(),
            wake_at: None,
            is_leaving: false,
            has_left: false,
            has_failed: false,
        });
        let links = self.links.clone();
        self.feed(node, start, Input::Configure { member, links });
        self.connect_soon(node);
        if self.is_healed {
            self.check_at = self.check_at.max(self.now + SETTLE);
        }
    }

    /// Ends the process of a node at once.
    pub(super) fn end_process(&mut self, node: usize) {
        self.nodes[node].process = None;
        self.nodes[node].connection = None;
        self.nodes[node].backlog.clear();
        self.nodes[node].is_stopped = false;
    }

    fn wake(&mut self, node: usize, start: u32) {
        let now = self.now;
        if let Some(process) = self.process(node, start)
            && process.wake_at.is_some_and(|at| at <= now)
        {
            process.wake_at = None;
            self.feed(node, start, Input::Tick);
        }
    }

    pub(super) fn process(&mut self, node: usize, start: u32) -> Option<&mut Process> {
        let node = self.nodes.get_mut(node).filter(|node| node.starts == start)?;
        node.process.as_mut()
    }

    fn resume(&mut self, node: usize) {
        self.nodes[node].is_stopped = false;
        let mut backlog = std::mem::take(&mut self.nodes[node].backlog);
        self.note(|| format!("node {node} goes on with {} events", backlog.len()));
        // The tasks of a runtime run in any order.
        self.rng.shuffle(&mut backlog);
        if self.rng.bool() {
            backlog.sort_by_key(|event| !matches!(event, Event::Poll { .. }));
        }
        for event in backlog {
            self.perform(event);
        }
    }

    /// Hands an input to a core, and performs its actions.
    pub(super) fn feed(&mut self, node: usize, start: u32, input: Input) {
        let now = self.local(node);
        let Some(process) = self.process(node, start) else { return };
        process.core.handle(now, input);
        while let Some(action) = self.process(node, start).and_then(|process| process.core.next_action()) {
            self.act(node, start, action);
        }
        let Some(wake_at) = self.process(node, start).and_then(|process| process.core.wake_at()) else { return };
        if wake_at <= now {
            return self.fail(format!("node {node} wakes at once, again and again"));
        }
        let at = self.true_time(node, wake_at).max(self.now + TIMER);
        if let Some(process) = self.process(node, start)
            && process.wake_at.is_none_or(|before| at < before)
        {
            process.wake_at = Some(at);
            self.at(at, Event::Wake { node, start });
        }
    }

    pub(super) fn fail(&mut self, failure: String) {
        self.note(|| format!("FAILURE: {failure}"));
        self.failure.get_or_insert(failure);
    }

    /// The end of the faults.
    fn heal(&mut self) {
        self.note(|| "the faults end".to_owned());
        self.is_healed = true;
        self.check_at = self.now + SETTLE;
        for node in 0..self.nodes.len() {
            self.nodes[node].is_cut = false;
            if self.nodes[node].is_stopped {
                self.resume(node);
            }
        }
        if !self.store.is_up {
            self.server_up(false, 0);
        }
        self.make_store();
        let survivor = self.rng.usize(..self.nodes.len());
        for node in 0..self.nodes.len() {
            if node == survivor || self.rng.u8(..4) > 0 {
                self.after(0, Event::Start { node });
            }
        }
    }
}

impl Process {
    /// Returns whether it is to own links from now on.
    fn goes_on(&self) -> bool {
        !self.is_leaving && !self.has_left && !self.has_failed
    }
}

/// The id of the member on a node.
pub(super) fn id_of(node: usize) -> String {
    format!("hall-{node}")
}
