//! Outputs: each is a task that delivers the batches of its cursor, and acknowledges what its server has
//! taken. An output that fails or waits does not hold up the others.

pub mod mqtt;
pub mod nats;
pub mod stdout;

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use tokio_util::sync::CancellationToken;

use crate::buffer::Cursor;
use crate::command::Commands;
use crate::config::Name;
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

/// The parts of the bridge that the output to a server uses.
#[derive(Debug)]
pub struct OutputParts {
    /// The name of the bridge.
    pub id: Name,
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

    /// Batches that were given up, because the server can never take them: too large, or malformed for it.
    #[must_use]
    pub fn skipped(&self) -> u64 {
        self.skipped.load(Ordering::Relaxed)
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
