//! Output to NATS JetStream.
//!
//! ```text
//!             ┌────────────── back-off ◀───────────────┐
//!             ▼                                        │ fails, or is lost
//! start ──▶ connecting ──▶ session: stream, states, batches, commands ──stop──▶ offline state
//! ```
//!
//! Batches are published with acknowledgements of the stream, several in flight. A batch is acknowledged in the
//! buffer when the stream has stored it and all before it. After a loss all others are sent again, with the same
//! `Nats-Msg-Id`, so that the server drops duplicates. States are messages without a stream: NATS has neither
//! retained messages nor last wills, so they are repeated.
//!
//! | module | content |
//! |---|---|
//! | `connection` | a client that does not reconnect by itself |
//! | `session` | a connection until it is lost |
//! | `delivery` | batches: sent, stored, sent again; no I/O and no clock |
//! | `stream` | the stream: made, or checked |
//! | `replies` | subjects of replies to commands |

pub(crate) mod connection;
mod delivery;
mod replies;
mod session;
mod stream;

use std::sync::Arc;
use std::time::Duration;

use tokio::time::{Instant, sleep};
use tokio_util::sync::CancellationToken;

use self::connection::{Connection, Overflow, Subscriptions};
use self::delivery::Delivery;
use self::session::{Carried, End, Session};
use super::{Health, OutputParts};
use crate::backoff::Backoff;
use crate::command::Commands;
use crate::config::{Name, NatsSection};
use crate::registry::Registry;
use crate::topic::Topics;

/// A connection that lasts longer than this, or delivers a batch, was good: the next delay is short.
const GOOD: Duration = Duration::from_secs(5);
/// The commands that wait to be taken.
const COMMANDS: Subscriptions =
    Subscriptions { capacity: 256, overflow: Overflow::Warning("too many commands at once: some are lost") };

/// The parts of an output that do not change.
#[derive(Debug)]
struct Shared {
    section: NatsSection,
    /// The name of its connections.
    client: String,
    /// The first level of the ids of messages.
    id: Name,
    topics: Topics,
    registry: Registry,
    health: Arc<Health>,
    commands: Option<Commands>,
    stop: CancellationToken,
}

/// Delivers batches and states, and takes commands, until it is stopped. It connects again after each loss.
pub async fn run(section: NatsSection, parts: OutputParts) {
    let OutputParts { names, registry, cursor, health, commands, stop } = parts;
    let client = names.unique();
    let topics = Topics::nats(&section.prefix, &names.id).with_member(names.member);
    if section.write && commands.is_none() {
        tracing::warn!("nats: write = true applies after a restart of the bridge");
    }
    let commands = commands.filter(|_| section.write);
    let shared = Shared {
        section,
        client,
        id: names.id,
        topics,
        registry,
        health: health.clone(),
        commands,
        stop: stop.clone(),
    };
    let mut carried = Carried::new(Delivery::new(cursor, health.clone()));
    let mut backoff = Backoff::default();
    let mut was_connected = false;
    while !stop.is_cancelled() {
        let opened = tokio::select! {
            opened = Connection::open(&shared.section, &shared.client, COMMANDS) => opened,
            () = stop.cancelled() => return,
        };
        match opened {
            Err(error) => shared.report(&error.to_string()),
            Ok(connection) => {
                tracing::info!("nats: connected to {}", shared.section.url);
                health.set_connected(was_connected);
                was_connected = true;
                let (begin, delivered) = (Instant::now(), health.delivered());
                let End::Lost(why) = Session::new(&shared, &mut carried, connection).run().await else { return };
                shared.report(&why);
                if begin.elapsed() >= GOOD || health.delivered() != delivered {
                    backoff.reset();
                }
            }
        }
        tokio::select! {
            () = sleep(backoff.next_delay()) => {}
            () = stop.cancelled() => {}
        }
    }
}

impl Shared {
    /// Notes that there is no connection, and logs it unless it is the same as before.
    fn report(&self, failure: &str) {
        let Self { section, health, .. } = self;
        if health.is_connected() || health.failure().as_deref() != Some(failure) {
            tracing::warn!("nats: {}: {failure}", section.url);
        } else {
            tracing::debug!("nats: {}: {failure}", section.url);
        }
        health.set_failed(failure);
    }
}
