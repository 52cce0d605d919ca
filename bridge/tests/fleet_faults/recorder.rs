//! Records all entries of links in the store, by a connection of its own to the server.
//!
//! The store has the last entry of each key alone, and an entry that is replaced soon may be delivered to no consumer.
//! So the server republishes them. A consumer delivers those that were stored while the recorder was not connected.
//! After a restart of the server it is there long before members take anything, which they do a lease after they are
//! connected.

use std::collections::BTreeSet;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant, SystemTime};

use async_nats::jetstream;
use async_nats::jetstream::consumer::{AckPolicy, DeliverPolicy, pull};
use async_nats::jetstream::stream::{Config, Republish, Stream};
use futures::StreamExt as _;
use tokio::sync::watch;
use tokio::task::JoinHandle;

/// The stream of the store.
pub(crate) const STREAM: &str = "KV_leases";
const PREFIX: &str = "$KV.leases.";
/// The server sends each entry of a link to this subject, too, when it stores it.
const LIVE: &str = "live.";
/// The longest time on the way of a republished entry.
const LAG: Duration = Duration::from_millis(500);

/// A token of an ownership: of two, the greater one is newer.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct Token {
    /// Rises when the store is deleted, or set back.
    pub(crate) epoch: u32,
    pub(crate) revision: u64,
}

/// An entry of a link.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Entry {
    pub(crate) link: String,
    /// Empty: it was released.
    pub(crate) session: String,
    pub(crate) token: Token,
    /// It was stored after this time.
    pub(crate) after: Instant,
    /// It was stored before this time.
    pub(crate) stored: Instant,
}

#[derive(Debug, Default)]
struct State {
    epoch: u32,
    /// The revisions with their times that were seen: a store that is set back shows them again.
    seen: BTreeSet<(u64, i128)>,
    entries: Vec<Entry>,
}

/// The recorder.
pub(crate) struct Recorder {
    port: u16,
    state: Arc<Mutex<State>>,
    last: watch::Sender<u64>,
    task: Option<JoinHandle<()>>,
}

impl Recorder {
    /// Waits until it reads the store.
    pub(crate) async fn start(port: u16) -> Self {
        let mut recorder = Self { port, state: Arc::default(), last: watch::channel(0).0, task: None };
        recorder.resume(false).await;
        recorder
    }

    /// Reads on, after a restart of the server or the end of the store. `is_new_epoch`: revisions do not go on.
    pub(crate) async fn resume(&mut self, is_new_epoch: bool) {
        if let Some(task) = self.task.take() {
            task.abort();
            let _ = task.await;
        }
        if is_new_epoch {
            self.state.lock().unwrap().epoch += 1;
            self.last.send_replace(0);
        }
        let (client, stream) = open(self.port).await;
        let mut live = follow(&client).await;
        let from = *self.last.borrow() + 1;
        let config = pull::Config {
            ack_policy: AckPolicy::None,
            deliver_policy: DeliverPolicy::ByStartSequence { start_sequence: from },
            filter_subject: format!("{PREFIX}>"),
            memory_storage: true,
            num_replicas: 1,
            ..pull::Config::default()
        };
        let consumer = stream.create_consumer(config).await.unwrap();
        let mut messages = consumer.messages().await.unwrap();
        let (state, last) = (self.state.clone(), self.last.clone());
        self.task = Some(tokio::spawn(async move {
            // It ends with the server, and is resumed then.
            loop {
                tokio::select! {
                    message = messages.next() => {
                        let Some(Ok(message)) = message else { break };
                        let info = message.info().unwrap();
                        let (revision, published) = (info.stream_sequence, info.published.unix_timestamp_nanos());
                        let key = message.subject.strip_prefix(PREFIX).unwrap_or_default();
                        let value = String::from_utf8_lossy(&message.payload);
                        state.lock().unwrap().add(key, &value, revision, published);
                        last.send_replace(revision);
                    }
                    message = live.next() => {
                        let Some(message) = message else { break };
                        let link = message.subject.strip_prefix(LIVE).unwrap_or_default();
                        let header = |name| message.headers.as_ref().unwrap().get(name).unwrap().as_str();
                        let value = String::from_utf8_lossy(&message.payload);
                        let revision = header("Nats-Sequence").parse().unwrap();
                        state.lock().unwrap().add_live(&format!("l.{link}"), &value, revision);
                    }
                }
            }
            drop(client);
        }));
    }

    /// Waits until it has read all that is in the store now.
    pub(crate) async fn catch_up(&self) {
        let (_client, stream) = open(self.port).await;
        let revision = stream.get_info().await.unwrap().state.last_sequence;
        let mut last = self.last.subscribe();
        let waiting = last.wait_for(|last| *last >= revision);
        let caught = tokio::time::timeout(Duration::from_secs(20), waiting).await;
        caught.expect("the recorder lags behind").unwrap();
    }

    /// Takes the entries of links since the last call.
    pub(crate) fn take(&self) -> Vec<Entry> {
        std::mem::take(&mut self.state.lock().unwrap().entries)
    }
}

impl Drop for Recorder {
    fn drop(&mut self) {
        if let Some(task) = &self.task {
            task.abort();
        }
    }
}

impl State {
    fn add(&mut self, key: &str, value: &str, revision: u64, published: i128) {
        if !self.seen.insert((revision, published)) {
            return;
        }
        let stored = instant_of(published);
        self.push(key, value, revision, (stored, stored));
    }

    /// Adds an entry that was stored just now: nats-server 2.9 does not tell the time.
    fn add_live(&mut self, key: &str, value: &str, revision: u64) {
        let now = Instant::now();
        self.push(key, value, revision, (now - LAG, now));
    }

    fn push(&mut self, key: &str, value: &str, revision: u64, (after, stored): (Instant, Instant)) {
        if let Some(link) = key.strip_prefix("l.") {
            let token = Token { epoch: self.epoch, revision };
            self.entries.push(Entry { link: link.to_owned(), session: value.to_owned(), token, after, stored });
        }
    }
}

/// The time of the server, which has the clock of this machine.
fn instant_of(published: i128) -> Instant {
    let (now, wall) = (Instant::now(), SystemTime::now());
    let wall = wall.duration_since(SystemTime::UNIX_EPOCH).unwrap().as_nanos();
    let ago = i128::try_from(wall).unwrap() - published;
    now - Duration::from_nanos(u64::try_from(ago.max(0)).unwrap())
}

/// Opens the store, once the server and the store are there.
async fn open(port: u16) -> (async_nats::Client, Stream) {
    let opening = async {
        loop {
            let options = async_nats::ConnectOptions::new().retry_on_initial_connect();
            let client = options.connect(format!("nats://127.0.0.1:{port}")).await.unwrap();
            if let Ok(stream) = jetstream::new(client.clone()).get_stream(STREAM).await {
                return (client, stream);
            }
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
    };
    tokio::time::timeout(Duration::from_secs(30), opening).await.expect("the server has no store")
}

/// Makes the store as a member needs it, and lets the server republish its entries of links.
pub(crate) async fn make_store(client: async_nats::Client, config: Config) -> Config {
    let republish = Republish { source: format!("{PREFIX}l.>"), destination: format!("{LIVE}>"), headers_only: false };
    let config = Config { republish: Some(republish), ..config };
    jetstream::new(client).create_stream(config.clone()).await.unwrap();
    config
}

/// Subscribes to the entries that the server republishes.
async fn follow(client: &async_nats::Client) -> async_nats::Subscriber {
    let live = client.subscribe(format!("{LIVE}>")).await.unwrap();
    client.flush().await.unwrap();
    live
}
