//! Output to an MQTT 5 broker.
//!
//! ```text
//!             ┌───────────────────── back-off ◀──────────────────────┐
//!             ▼                                                      │ fails, or is lost
//! start ──▶ connecting ──CONNACK──▶ session: birth, states, discovery, batches ──stop──▶ last states
//! ```
//!
//! A stop ends the output at once if it has no connection. The last member of a fleet goes on for up to 4 s: nothing
//! else tells the broker that no member polls its PLCs.
//!
//! Batches are messages with QoS 1, several in flight. A batch is acknowledged in the buffer when the broker has
//! acknowledged it and all before it. After a loss all others are sent again. There is no session at the broker
//! that outlives a connection: the buffer is the only memory, and commands do not wait for a client.
//!
//! | module | content |
//! |---|---|
//! | [`credentials`] | files of a connection |
//! | `connection` | packets; the only module that uses `rumqttc` |
//! | `session` | a connection from its CONNACK to its end |
//! | `window` | packet ids, and the prefix of acknowledged batches |
//! | `delivery` | batches: sent, sent again, acknowledged |
//! | `refusals` | PLCs whose batches the broker refuses |
//! | `retained` | states and discovery messages that the broker should have |
//! | `plcs` | PLCs of the registry as such messages |
//! | `discovery` | entities of Home Assistant |
//! | `commands` | topics of replies |
//! | `subscriptions` | messages that the broker sends |

mod commands;
mod connection;
pub mod credentials;
mod delivery;
mod discovery;
mod plcs;
mod refusals;
mod retained;
mod session;
mod subscriptions;
mod window;

use std::sync::{Arc, OnceLock};
use std::time::{Duration, SystemTime};

use bytes::Bytes;
use serde_json::json;
use tokio::time::{Instant, sleep, sleep_until};
use tokio_util::sync::CancellationToken;

use self::connection::{Client, Connection};
use self::credentials::Credentials;
use self::delivery::Delivery;
use self::discovery::Discovery;
use self::session::{Carried, End, OFFLINE, Session};
use super::{BridgeNames, Health, OutputParts};
use crate::backoff::Backoff;
use crate::batch::milliseconds;
use crate::command::Commands;
use crate::config::{MqttSection, Name};
use crate::registry::Registry;
use crate::topic::Topics;

/// A connection that lasts longer than this, or delivers a batch, was good: the next delay is short.
const GOOD: Duration = Duration::from_secs(5);
/// The time for the last messages after the stop.
const LAST_MESSAGES: Duration = Duration::from_secs(4);
/// The longest delay of a connection that is opened for them.
const LAST_RETRY: Duration = Duration::from_millis(500);
/// The delay after another client with the same id has connected: two that do not wait would fight.
const TAKEN_OVER: Duration = Duration::from_secs(10);

/// The parts of an output that do not change.
#[derive(Debug)]
struct Shared {
    topics: Topics,
    discovery: Option<Discovery>,
    /// Those before a reload.
    former: Option<(Topics, Option<Discovery>)>,
    registry: Registry,
    health: Arc<Health>,
    commands: Option<Commands>,
    stop: CancellationToken,
    /// `true`: a batch without a subscriber is not delivered.
    require_subscribers: bool,
    /// The state of the bridge while it is connected.
    birth: Bytes,
    /// The end of the time for the last messages, once the output is stopped.
    end: OnceLock<Instant>,
}

impl Shared {
    /// The end of the time for the last messages. The first call, when the output is stopped, sets it.
    fn limit_of_the_end(&self, now: Instant) -> Instant {
        *self.end.get_or_init(|| now + LAST_MESSAGES)
    }

    /// Returns whether the output is stopped and ends now, without a connection.
    fn is_over(&self, now: Instant) -> bool {
        let is_last_member = || self.topics.is_fleet() && self.registry.read().lost().next().is_some();
        self.stop.is_cancelled() && (now >= self.limit_of_the_end(now) || !is_last_member())
    }

    /// Waits for this time, but not beyond the end of the output.
    async fn wait(&self, delay: Duration) {
        let stopped = async {
            self.stop.cancelled().await;
            let now = Instant::now();
            if !self.is_over(now) {
                sleep_until(self.limit_of_the_end(now).min(now + delay.min(LAST_RETRY))).await;
            }
        };
        tokio::select! {
            () = sleep(delay) => {}
            () = stopped => {}
        }
    }
}

/// Delivers batches, states and discovery messages until it is stopped. It connects again after each loss.
/// `former`: the section before a reload. The messages that the broker keeps under its names are cleared.
pub async fn run(section: MqttSection, former: Option<MqttSection>, parts: OutputParts) {
    let OutputParts { names: bridge, registry, cursor, health, commands, stop } = parts;
    let (topics, discovery) = names(&section, &bridge, commands.is_some());
    let former = former.map(|section| names(&section, &bridge, false));
    let client = Client {
        id: format!("{}-{}", section.prefix, bridge.unique()),
        will_topic: topics.bridge_state(),
        will: Bytes::from_static(OFFLINE),
    };
    let mut carried = Carried::new(Delivery::new(cursor, health.clone()));
    if let Some((former, _)) = former.as_ref().filter(|(former, _)| *former != topics) {
        carried.retained.clear(former.bridge_state());
    }
    let shared = Shared {
        discovery,
        former,
        registry,
        health: health.clone(),
        commands,
        stop: stop.clone(),
        require_subscribers: section.require_subscribers,
        birth: birth(),
        end: OnceLock::new(),
        topics,
    };
    let mut backoff = Backoff::default();
    let mut was_connected = false;
    while !shared.is_over(Instant::now()) {
        let over = async {
            stop.cancelled().await;
            let now = Instant::now();
            if !shared.is_over(now) {
                sleep_until(shared.limit_of_the_end(now)).await;
            }
        };
        let opened = tokio::select! {
            opened = open(&section, &client) => opened,
            () = over => return,
        };
        let delay = match opened {
            Err(failure) => {
                report(&health, &section, &failure);
                backoff.next_delay()
            }
            Ok(connection) => {
                tracing::info!("mqtt: connected to {}", section.url);
                health.set_connected(was_connected);
                was_connected = true;
                let (begin, delivered) = (Instant::now(), health.delivered());
                let End::Lost(error) = Session::new(&shared, &mut carried, connection).run().await else { return };
                // Some brokers refuse a message and close the connection without a reason.
                let refusal = health.failure().map(|refusal| format!("{refusal}; ")).unwrap_or_default();
                report(&health, &section, &format!("{refusal}{error}"));
                if begin.elapsed() >= GOOD || health.delivered() != delivered {
                    backoff.reset();
                }
                if error.is_taken_over() { TAKEN_OVER } else { backoff.next_delay() }
            }
        };
        shared.wait(delay).await;
    }
}

/// The names of the messages of a section. `writes`: commands are taken.
fn names(section: &MqttSection, names: &BridgeNames, writes: bool) -> (Topics, Option<Discovery>) {
    let topics = Topics::mqtt(&section.prefix, &names.id).with_member(names.member.clone());
    let bridge = [section.prefix.as_str(), names.id.as_str()];
    let discovery = |prefix: Name| Discovery::new(prefix, topics.clone(), bridge, writes);
    let discovery = section.home_assistant.clone().map(discovery);
    (topics, discovery)
}

/// Opens a connection, with the present content of the files.
async fn open(section: &MqttSection, client: &Client) -> Result<Connection, String> {
    let files = section.clone();
    let credentials = match tokio::task::spawn_blocking(move || Credentials::load(&files)).await {
        Ok(credentials) => credentials.map_err(|error| error.to_string())?,
        // It was aborted: the runtime ends.
        Err(error) => return Err(error.to_string()),
    };
    Connection::open(&section.url, credentials, client).await.map_err(|error| error.to_string())
}

/// Notes a failure, and logs it unless it is the same as before.
fn report(health: &Health, section: &MqttSection, failure: &str) {
    let is_news = health.is_connected() || health.failure().as_deref() != Some(failure);
    if is_news {
        tracing::warn!("mqtt: {}: {failure}", section.url);
    } else {
        tracing::debug!("mqtt: {}: {failure}", section.url);
    }
    health.set_failed(failure);
}

/// The state of a bridge that is connected.
fn birth() -> Bytes {
    let started = milliseconds(SystemTime::now());
    json!({ "online": true, "version": env!("CARGO_PKG_VERSION"), "started": started }).to_string().into()
}
