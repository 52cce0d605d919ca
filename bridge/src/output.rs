//! Outputs: each is a task that delivers the batches of its cursor, and acknowledges what its server has
//! taken. An output that fails or waits does not hold up the others.

pub mod mqtt;
pub mod nats;
pub mod stdout;

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use tokio_util::sync::CancellationToken;

use crate::buffer::Cursor;
use crate::command::Commands;
use crate::config::{Config, Name};
use crate::registry::Registry;

/// A kind of output. A bridge has at most one of each.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum OutputKind {
    /// Lines of JSON at stdout.
    Stdout,
    /// An MQTT broker.
    Mqtt,
    /// NATS JetStream.
    Nats,
}

impl OutputKind {
    /// The name of its section, of its cursor, and in metrics.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Stdout => "stdout",
            Self::Mqtt => "mqtt",
            Self::Nats => "nats",
        }
    }
}

/// The names of a bridge at its outputs.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct BridgeNames {
    /// In topics: that of the bridge, or of its fleet.
    pub id: Name,
    /// In a fleet: that of this member.
    pub member: Option<Name>,
}

impl BridgeNames {
    /// The names of the bridge of a configuration.
    #[must_use]
    pub fn of(config: &Config) -> Self {
        let member = config.fleet.as_ref().map(|_| config.bridge.id.clone());
        Self { id: config.topic_id().clone(), member }
    }

    /// A name that no other bridge has: clients of a server need one.
    fn unique(&self) -> String {
        match &self.member {
            None => self.id.to_string(),
            Some(member) => format!("{}-{member}", self.id),
        }
    }
}

/// The parts of the bridge that the output to a server uses.
#[derive(Debug)]
pub struct OutputParts {
    /// The names of the bridge.
    pub names: BridgeNames,
    /// The PLCs.
    pub registry: Registry,
    /// The batches.
    pub cursor: Cursor,
    /// The state of the output.
    pub health: Arc<Health>,
    /// Executes commands; without it none are taken.
    pub commands: Option<Commands>,
    /// Ends the output.
    pub stop: CancellationToken,
}

/// A PLC whose batches a server refuses, or has refused.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct RefusedPlc {
    /// `true` if it refuses them now.
    pub is_refused: bool,
    /// Batches that were given up for that reason.
    pub dropped: u64,
}

/// The state of an output, for metrics and the page.
#[derive(Debug)]
pub struct Health {
    kind: OutputKind,
    connected: AtomicBool,
    batches: AtomicU64,
    samples: AtomicU64,
    reconnects: AtomicU64,
    no_subscribers: AtomicU64,
    refused: AtomicU64,
    skipped: AtomicU64,
    failure: Mutex<Option<String>>,
    refused_plcs: Mutex<BTreeMap<Arc<str>, RefusedPlc>>,
}

impl Health {
    /// Of an output that is not connected yet.
    #[must_use]
    pub fn new(kind: OutputKind) -> Self {
        Self {
            kind,
            connected: AtomicBool::new(false),
            batches: AtomicU64::new(0),
            samples: AtomicU64::new(0),
            reconnects: AtomicU64::new(0),
            no_subscribers: AtomicU64::new(0),
            refused: AtomicU64::new(0),
            skipped: AtomicU64::new(0),
            failure: Mutex::new(None),
            refused_plcs: Mutex::default(),
        }
    }

    /// The kind of the output.
    #[must_use]
    pub fn kind(&self) -> OutputKind {
        self.kind
    }

    /// Returns whether it is connected.
    #[must_use]
    pub fn is_connected(&self) -> bool {
        self.connected.load(Ordering::Relaxed)
    }

    /// Batches and samples that its server has acknowledged.
    #[must_use]
    pub fn delivered(&self) -> (u64, u64) {
        (self.batches.load(Ordering::Relaxed), self.samples.load(Ordering::Relaxed))
    }

    /// Connections that were lost and opened anew.
    #[must_use]
    pub fn reconnects(&self) -> u64 {
        self.reconnects.load(Ordering::Relaxed)
    }

    /// Batches that its server has taken without a subscriber, and thrown away.
    #[must_use]
    pub fn no_subscribers(&self) -> u64 {
        self.no_subscribers.load(Ordering::Relaxed)
    }

    /// Messages that its server has refused. Batches among them are sent again, unless they are skipped.
    #[must_use]
    pub fn refused(&self) -> u64 {
        self.refused.load(Ordering::Relaxed)
    }

    /// Batches that were given up: the server can never take them, since they are too large or malformed for it, or
    /// it refuses those of their PLC.
    #[must_use]
    pub fn skipped(&self) -> u64 {
        self.skipped.load(Ordering::Relaxed)
    }

    /// The PLCs whose batches its server has refused while it took those of others, or refuses now.
    #[must_use]
    pub fn refused_plcs(&self) -> BTreeMap<Arc<str>, RefusedPlc> {
        self.refused_plcs.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Notes whether the server refuses the batches of a PLC.
    pub fn set_plc_refused(&self, plc: &str, is_refused: bool) {
        let mut plcs = self.refused_plcs.lock().unwrap_or_else(PoisonError::into_inner);
        plcs.entry(plc.into()).or_default().is_refused = is_refused;
    }

    /// Counts a batch of a refused PLC that was given up.
    pub fn count_plc_dropped(&self, plc: &str) {
        self.count_skipped();
        let mut plcs = self.refused_plcs.lock().unwrap_or_else(PoisonError::into_inner);
        let plc = plcs.entry(plc.into()).or_default();
        plc.dropped = plc.dropped.saturating_add(1);
    }

    /// The last failure since it was connected.
    #[must_use]
    pub fn failure(&self) -> Option<String> {
        self.failure.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Notes that it is connected. `again`: it was before.
    pub fn set_connected(&self, again: bool) {
        self.connected.store(true, Ordering::Relaxed);
        self.reconnects.fetch_add(u64::from(again), Ordering::Relaxed);
        *self.failure.lock().unwrap_or_else(PoisonError::into_inner) = None;
    }

    /// Notes that it is not connected, and why.
    pub fn set_failed(&self, failure: impl ToString) {
        self.connected.store(false, Ordering::Relaxed);
        *self.failure.lock().unwrap_or_else(PoisonError::into_inner) = Some(failure.to_string());
    }

    /// Notes a failure of messages on a connection that works otherwise; `None`: they are taken again.
    pub fn set_refusal(&self, refusal: Option<String>) {
        *self.failure.lock().unwrap_or_else(PoisonError::into_inner) = refusal;
    }

    /// Counts a batch that the server has taken without a subscriber.
    pub fn count_no_subscribers(&self) {
        self.no_subscribers.fetch_add(1, Ordering::Relaxed);
    }

    /// Counts a message that the server has refused.
    pub fn count_refused(&self) {
        self.refused.fetch_add(1, Ordering::Relaxed);
    }

    /// Counts a batch that was given up.
    pub fn count_skipped(&self) {
        self.skipped.fetch_add(1, Ordering::Relaxed);
    }

    /// Counts a batch that was acknowledged.
    pub fn count(&self, samples: u32) {
        self.batches.fetch_add(1, Ordering::Relaxed);
        self.samples.fetch_add(samples.into(), Ordering::Relaxed);
    }
}
