//! The bucket of a fleet in NATS JetStream: opened, watched, written, and made.
//!
//! A connection here does not reconnect by itself, so that all that is known of the store is known of one
//! connection. The watch is a pull consumer, whose entries have consecutive numbers: a gap ends it.
//!
//! Revisions are consecutive, too, but for entries that were replaced or removed before they were delivered. A consumer
//! of nats-server 2.9 was seen to skip an entry that is in the store, under load: a link that its owner had released
//! stayed free, since no other member knew. So a revision that was not delivered is looked up, and one that is in the
//! store ends the watch.

mod snapshot;

use std::pin::Pin;
use std::time::Duration;

use async_nats::header::NATS_EXPECTED_LAST_SUBJECT_SEQUENCE;
use async_nats::jetstream::consumer::{AckPolicy, DeliverPolicy, pull};
use async_nats::jetstream::context::{Context, ContextBuilder, CreateStreamErrorKind, GetStreamErrorKind};
use async_nats::jetstream::context::{PublishError, PublishErrorKind};
use async_nats::jetstream::stream::{
    Config, DiscardPolicy, Info, LastRawMessageErrorKind, RawMessageErrorKind, StorageType, Stream,
};
use async_nats::jetstream::{self, ErrorCode};
use async_nats::{HeaderMap, HeaderValue};
use futures::StreamExt as _;
use futures::stream::FuturesUnordered;

use self::snapshot::Snapshot;
use super::core::{Operation, Outcome};
use crate::config::{Name, NatsSection};
use crate::output::nats::connection::{Connection, Overflow, Subscriptions, with_sources};

/// The time for opening all of it, at most.
pub(super) const OPEN: Duration = Duration::from_secs(10);
/// The entries of one request of a watch.
const BATCH: usize = 200;
/// The entries that wait to be taken. A watch has up to two requests at once. An entry that is dropped ends it.
const SUBSCRIPTIONS: Subscriptions = Subscriptions { capacity: 4 * BATCH, overflow: Overflow::Lost };
/// The server forgets a watch that is not read for this time.
const INACTIVE: Duration = Duration::from_secs(60);
/// The revisions in a row that are looked up. If more are missing, the watch is begun again.
const MAX_MISSING: u64 = 1000;
/// The header of an entry that is not a value.
const OPERATION: &str = "KV-Operation";
/// The versions of a plant that are kept.
const PLANT_HISTORY: i64 = 16;
/// The replicas of the store in a cluster.
const REPLICAS: usize = 3;

/// The store, over one connection.
#[derive(Debug)]
pub(super) struct Bucket {
    connection: Connection,
    store: Store,
}

/// Sends requests. Cheap to clone.
#[derive(Clone, Debug)]
pub(super) struct Store {
    context: Context,
    stream: Stream,
    prefix: String,
}

/// A store that was opened.
pub(super) struct Opened {
    pub(super) bucket: Bucket,
    pub(super) watch: Watch,
    /// Its creation time: nanoseconds since 1970.
    pub(super) created: u64,
    /// Its last revision before the watch began.
    pub(super) last_revision: u64,
    /// Its replicas.
    pub(super) replicas: usize,
    /// The time of the server when the watch began: nanoseconds since 1970.
    pub(super) server_time: u64,
}

/// All entries, and then their changes.
pub(super) struct Watch {
    messages: pull::Stream,
    prefix: String,
    snapshot: Snapshot,
    has_told: bool,
    /// The number of the last entry.
    last: u64,
    /// The highest revision that was delivered, at least the last one when the watch began.
    newest: u64,
    stream: Stream,
    /// Lookups of revisions that were not delivered.
    lookups: FuturesUnordered<Lookup>,
}

/// Returns a revision, and whether the store lacks it.
type Lookup = Pin<Box<dyn Future<Output = (u64, bool)> + Send>>;

/// An entry of a watch.
#[derive(Debug)]
pub(super) struct Entry {
    pub(super) key: String,
    pub(super) value: Option<String>,
    pub(super) revision: u64,
    /// The time at which the server stored it: nanoseconds since 1970.
    pub(super) stored_at: u64,
}

/// The next of a watch.
#[derive(Debug)]
pub(super) enum Seen {
    Entry(Entry),
    /// All entries that were there when it began have come.
    Complete,
}

/// A store that cannot be opened.
#[derive(Debug, thiserror::Error)]
pub(super) enum OpenError {
    /// The server says that it does not exist.
    #[error("the store {0} does not exist: fatek-bridge fleet init makes it")]
    Missing(String),
    #[error("the server does not answer")]
    NoAnswer,
    #[error("{0}")]
    Other(String),
}

/// A store that cannot be made.
#[derive(Debug, thiserror::Error)]
#[error("the store {bucket} cannot be made: {error}")]
pub struct InitError {
    bucket: String,
    error: String,
}

/// The result of [`init`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Initialized {
    /// The store was made, with this number of replicas.
    Made(usize),
    /// It was there already, and nothing has changed.
    Exists,
}

/// Opens the store, and a watch of all its entries.
pub(super) async fn open(
    section: &NatsSection,
    id: &Name,
    bucket: &Name,
    limit: Duration,
) -> Result<Opened, OpenError> {
    let opened = tokio::time::timeout(limit, open_now(section, id, bucket)).await;
    opened.unwrap_or(Err(OpenError::NoAnswer))
}

async fn open_now(section: &NatsSection, id: &Name, bucket: &Name) -> Result<Opened, OpenError> {
    let (connection, context) = connect(section, id).await?;
    let name = stream_name(bucket);
    let stream = match context.get_stream(&name).await {
        Ok(stream) => stream,
        Err(error) if is_missing(&error.kind()) => return Err(OpenError::Missing(bucket.to_string())),
        Err(error) => return Err(OpenError::Other(with_sources(&error))),
    };
    let info = stream.cached_info();
    check(info)?;
    let (created, last_revision, replicas) = (created(info), info.state.last_sequence, info.config.num_replicas);
    let prefix = prefix(bucket);
    let (mut watch, server_time) = Watch::new(&stream, &prefix).await?;
    let listed = stream.info_with_subjects(format!("{prefix}>")).await;
    let mut listed = listed.map_err(|error| OpenError::Other(with_sources(&error)))?;
    // It may have been made again since.
    if self::created(&listed.info) != created {
        return Err(OpenError::Other("the store was made again meanwhile".to_owned()));
    }
    let (mut keys, end) = (Vec::new(), listed.info.state.last_sequence);
    while let Some(subject) = listed.next().await {
        let (subject, _) = subject.map_err(|error| OpenError::Other(with_sources(&error)))?;
        keys.extend(subject.strip_prefix(&prefix).map(str::to_owned));
    }
    (watch.snapshot, watch.newest) = (Snapshot::new(keys, end), end);
    let store = Store { context, stream, prefix };
    Ok(Opened { bucket: Bucket { connection, store }, watch, created, last_revision, replicas, server_time })
}

async fn connect(section: &NatsSection, id: &Name) -> Result<(Connection, Context), OpenError> {
    let connection = Connection::open(section, id.as_str(), SUBSCRIPTIONS)
        .await
        .map_err(|error| OpenError::Other(error.to_string()))?;
    let context = ContextBuilder::new().timeout(OPEN).build(connection.client().clone());
    Ok((connection, context))
}

fn stream_name(bucket: &Name) -> String {
    format!("KV_{bucket}")
}

fn prefix(bucket: &Name) -> String {
    format!("$KV.{bucket}.")
}

fn is_missing(kind: &GetStreamErrorKind) -> bool {
    matches!(kind, GetStreamErrorKind::JetStream(error) if error.error_code() == ErrorCode::STREAM_NOT_FOUND)
}

fn created(info: &Info) -> u64 {
    since_1970(info.created.unix_timestamp_nanos())
}

/// Nanoseconds since 1970; a time before that is 0.
fn since_1970(nanoseconds: i128) -> u64 {
    u64::try_from(nanoseconds).unwrap_or(0)
}

/// Checks the rules that the protocol needs.
fn check(info: &Info) -> Result<(), OpenError> {
    let config = &info.config;
    let name = &config.name;
    if !config.max_age.is_zero() {
        let text = format!("the stream {name} drops entries by their age: its max_age must be 0");
        return Err(OpenError::Other(text));
    }
    if config.no_ack {
        return Err(OpenError::Other(format!("the stream {name} acknowledges nothing (no_ack)")));
    }
    Ok(())
}

/// The content of a bucket.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Content {
    Leases,
    Plants,
}

/// Makes the store, with three replicas in a cluster. A store that exists is left as it is.
///
/// # Errors
/// [`InitError`] with the error of the server.
pub async fn init(section: &NatsSection, id: &Name, bucket: &Name) -> Result<Initialized, InitError> {
    make(section, id, bucket, Content::Leases).await
}

/// Makes a bucket that does not exist.
pub(super) async fn make(
    section: &NatsSection,
    id: &Name,
    bucket: &Name,
    content: Content,
) -> Result<Initialized, InitError> {
    let fail = |error: String| InitError { bucket: bucket.to_string(), error };
    // The connection must last as long as its context.
    let (connection, context) = connect(section, id).await.map_err(|error| fail(error.to_string()))?;
    match context.get_stream(stream_name(bucket)).await {
        Ok(_) => return Ok(Initialized::Exists),
        Err(error) if is_missing(&error.kind()) => {}
        Err(error) => return Err(fail(with_sources(&error))),
    }
    let is_cluster = connection.client().server_info().cluster.is_some();
    let replicas = if is_cluster { REPLICAS } else { 1 };
    let made = match context.create_stream(config(bucket, content, replicas)).await {
        // A server alone can have the name of a cluster.
        Err(error) if replicas > 1 && is_refused_for_replicas(&error.kind()) => {
            context.create_stream(config(bucket, content, 1)).await.map(|_| 1)
        }
        made => made.map(|_| replicas),
    };
    made.map(Initialized::Made).map_err(|error| fail(with_sources(&error)))
}

fn is_refused_for_replicas(kind: &CreateStreamErrorKind) -> bool {
    matches!(kind, CreateStreamErrorKind::JetStream(error)
        if error.error_code() == ErrorCode::STREAM_REPLICAS_NOT_SUPPORTED)
}

/// The stream of a bucket, as clients of NATS make it. It has the last values of each key, without an age.
fn config(bucket: &Name, content: Content, replicas: usize) -> Config {
    let (description, history) = match content {
        Content::Leases => ("Leases of a fleet of fatek-bridge", 1),
        Content::Plants => ("Plant of a fleet of fatek-bridge", PLANT_HISTORY),
    };
    Config {
        name: stream_name(bucket),
        subjects: vec![format!("{}>", prefix(bucket))],
        description: Some(description.to_owned()),
        max_messages_per_subject: history,
        max_age: Duration::ZERO,
        storage: StorageType::File,
        discard: DiscardPolicy::New,
        num_replicas: replicas,
        allow_rollup: true,
        deny_delete: true,
        // Entries are read from the leader.
        allow_direct: false,
        ..Config::default()
    }
}

impl Bucket {
    pub(super) fn store(&self) -> Store {
        self.store.clone()
    }

    /// The bytes that a message can have.
    pub(super) fn max_payload(&self) -> usize {
        self.connection.client().server_info().max_payload
    }

    /// Waits until the connection is lost, and returns why. Cancel-safe.
    pub(super) async fn lost(&mut self) -> String {
        self.connection.lost().await
    }
}

impl Store {
    /// Performs a request. An error is [`Outcome::Unknown`], as a timeout is.
    pub(super) async fn perform(self, operation: Operation) -> Outcome {
        match operation {
            Operation::Put { key, value, expected } => self.put(&key, value, expected).await,
            Operation::Get { key } => self.get(&key).await,
            Operation::Purge { key, revision } => {
                let subject = format!("{}{key}", self.prefix);
                let purge = self.stream.purge().sequence(revision.saturating_add(1)).filter(subject);
                purge.await.map_or(Outcome::Unknown, |_| Outcome::Purged)
            }
        }
    }

    async fn put(&self, key: &str, value: String, expected: u64) -> Outcome {
        let mut headers = HeaderMap::new();
        headers.insert(NATS_EXPECTED_LAST_SUBJECT_SEQUENCE, HeaderValue::from(expected));
        let subject = format!("{}{key}", self.prefix);
        let failure = match self.context.publish_with_headers(subject, headers, value.into()).await {
            Ok(ack) => match ack.await {
                Ok(ack) => return Outcome::Stored(ack.sequence),
                Err(error) => error,
            },
            Err(error) => error,
        };
        if is_wrong_revision(&failure) {
            return Outcome::WrongRevision;
        }
        tracing::debug!("fleet: {key}: {}", with_sources(&failure));
        Outcome::Unknown
    }

    /// Stores a value without a condition, and returns its revision.
    #[cfg(feature = "naive-fleet")]
    pub(super) async fn put_always(&self, key: &str, value: String) -> Outcome {
        let Ok(ack) = self.context.publish(format!("{}{key}", self.prefix), value.into()).await else {
            return Outcome::Unknown;
        };
        ack.await.map_or(Outcome::Unknown, |ack| Outcome::Stored(ack.sequence))
    }

    /// Stores a value without a condition: an order of an operator.
    pub(super) async fn set(&self, key: &str, value: String) -> Result<(), String> {
        let subject = format!("{}{key}", self.prefix);
        let ack = self.context.publish(subject, value.into()).await.map_err(|error| with_sources(&error))?;
        ack.await.map(|_| ()).map_err(|error| with_sources(&error))
    }

    async fn get(&self, key: &str) -> Outcome {
        match self.stream.get_last_raw_message_by_subject(&format!("{}{key}", self.prefix)).await {
            Ok(message) => {
                let is_value = message.headers.get(OPERATION).is_none();
                let value = is_value.then(|| String::from_utf8_lossy(&message.payload).into_owned());
                Outcome::Found { value, revision: message.sequence }
            }
            Err(error) if matches!(error.kind(), LastRawMessageErrorKind::NoMessageFound) => Outcome::Missing,
            Err(error) => {
                tracing::debug!("fleet: {key}: {}", with_sources(&error));
                Outcome::Unknown
            }
        }
    }
}

fn is_wrong_revision(error: &PublishError) -> bool {
    let source = std::error::Error::source(error);
    let code = source.and_then(|source| source.downcast_ref::<jetstream::Error>()).map(jetstream::Error::error_code);
    error.kind() == PublishErrorKind::WrongLastSequence || code == Some(ErrorCode::STREAM_WRONG_LAST_SEQUENCE_CONSTANT)
}

impl Watch {
    /// Begins a watch. Returns the time of the server at which it began, too.
    async fn new(stream: &Stream, prefix: &str) -> Result<(Self, u64), OpenError> {
        let config = pull::Config {
            description: Some("watch of fatek-bridge".to_owned()),
            ack_policy: AckPolicy::None,
            deliver_policy: DeliverPolicy::LastPerSubject,
            filter_subject: format!("{prefix}>"),
            inactive_threshold: INACTIVE,
            memory_storage: true,
            num_replicas: 1,
            ..pull::Config::default()
        };
        let consumer = stream.create_consumer(config).await;
        let consumer = consumer.map_err(|error| OpenError::Other(with_sources(&error)))?;
        let server_time = since_1970(consumer.cached_info().created.unix_timestamp_nanos());
        let messages = consumer.stream().max_messages_per_batch(BATCH).messages().await;
        let messages = messages.map_err(|error| OpenError::Other(with_sources(&error)))?;
        let prefix = prefix.to_owned();
        let watch = Self {
            messages,
            prefix,
            snapshot: Snapshot::default(),
            has_told: false,
            last: 0,
            newest: 0,
            stream: stream.clone(),
            lookups: FuturesUnordered::new(),
        };
        Ok((watch, server_time))
    }

    /// The next entry. Cancel-safe.
    ///
    /// # Errors
    /// The watch has ended: entries may be missing.
    pub(super) async fn next(&mut self) -> Result<Seen, String> {
        if !self.has_told && self.snapshot.is_complete() {
            self.has_told = true;
            return Ok(Seen::Complete);
        }
        let message = loop {
            tokio::select! {
                message = self.messages.next() => match message {
                    Some(Ok(message)) => break message,
                    Some(Err(error)) => return Err(with_sources(&error)),
                    None => return Err("the watch has ended".to_owned()),
                },
                Some((revision, is_gone)) = self.lookups.next(), if !self.lookups.is_empty() => {
                    if !is_gone {
                        return Err(format!("the watch lacks revision {revision}"));
                    }
                }
            }
        };
        let info = message.info().map_err(|error| error.to_string())?;
        if info.consumer_sequence != self.last + 1 {
            return Err(format!("the watch lacks entries after number {}", self.last));
        }
        self.last = info.consumer_sequence;
        let (revision, stored_at) = (info.stream_sequence, since_1970(info.published.unix_timestamp_nanos()));
        let is_value = message.headers.as_ref().is_none_or(|headers| headers.get(OPERATION).is_none());
        let value = is_value.then(|| String::from_utf8_lossy(&message.payload).into_owned());
        let key = message.subject.strip_prefix(&self.prefix).unwrap_or_default().to_owned();
        self.snapshot.delivered(&key, revision);
        self.look_up_missing(revision)?;
        Ok(Seen::Entry(Entry { key, value, revision, stored_at }))
    }

    /// Looks up the revisions before this one that were not delivered.
    fn look_up_missing(&mut self, revision: u64) -> Result<(), String> {
        let newest = self.newest;
        self.newest = newest.max(revision);
        let missing = newest.saturating_add(1)..revision;
        if missing.end.saturating_sub(missing.start) > MAX_MISSING {
            return Err(format!("the watch lacks the entries after revision {newest}"));
        }
        for revision in missing {
            let stream = self.stream.clone();
            self.lookups.push(Box::pin(async move {
                let found = stream.get_raw_message(revision).await;
                let is_gone = matches!(&found, Err(error) if error.kind() == RawMessageErrorKind::NoMessageFound);
                (revision, is_gone)
            }));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests;
