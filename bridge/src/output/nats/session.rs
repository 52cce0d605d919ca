//! A connection until it is lost or the output is stopped.
//!
//! One task sends and waits for answers, commands and the clock, each independent of the others. A server that is
//! slow with its acknowledgements fills the window; commands and states are not held up by that.

use std::collections::{HashMap, HashSet};
use std::future::{Future, IntoFuture as _};
use std::pin::Pin;
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use async_nats::jetstream::context::{Context, ContextBuilder, PublishErrorKind};
use async_nats::jetstream::message::PublishMessage;
use async_nats::jetstream::{Error as JetStreamError, context::PublishError};
use async_nats::{Client, Message, RequestErrorKind, Subscriber};
use bytes::Bytes;
use futures::stream::{FuturesOrdered, FuturesUnordered};
use futures::{FutureExt as _, StreamExt as _};
use serde_json::json;
use tokio::time::{Instant, MissedTickBehavior, interval, sleep_until, timeout};

use super::connection::{Connection, with_sources};
use super::delivery::{Answer, Delivery};
use super::{Shared, replies, stream};
use crate::batch::milliseconds;
use crate::buffer::Entry;
use crate::plc_state::PlcState;
use crate::registry::Elsewhere;

/// The time for an acknowledgement, and for a request to the stream.
const ACK_TIMEOUT: Duration = Duration::from_secs(5);
/// The time between two looks at the states of the PLCs.
const TICK: Duration = Duration::from_secs(1);
/// The number of ticks after which states are published again.
const REPEAT: u32 = 10;
/// The commands that run at once. More wait in the subscription.
const MAX_COMMANDS: usize = 256;
/// The time for commands that run to end when the output ends.
const REPLIES: Duration = Duration::from_secs(1);
/// The time for the last states when the output ends, and for the server to read them.
const GOODBYE: Duration = Duration::from_secs(1);
/// The JetStream error of a message that is longer than its stream takes.
const TOO_LONG: u64 = 10054;

type Boxed<T> = Pin<Box<dyn Future<Output = T> + Send>>;

/// The parts of an output that outlive its connections.
pub(super) struct Carried {
    delivery: Delivery,
    /// Commands that run, with the subjects of their replies.
    commands: FuturesUnordered<Boxed<(String, Bytes)>>,
}

/// The end of a session.
#[derive(Debug)]
pub(super) enum End {
    /// The output was stopped.
    Stopped,
    /// The connection was lost.
    Lost(String),
}

/// A session.
pub(super) struct Session<'a> {
    shared: &'a Shared,
    carried: &'a mut Carried,
    connection: Connection,
    context: Context,
    acks: FuturesOrdered<Boxed<Answer>>,
    /// The attempt to prepare the stream.
    preparing: Option<Boxed<Result<(), String>>>,
    subscriber: Option<Subscriber>,
    states: HashMap<Arc<str>, PlcState>,
    /// PLCs that were published as lost.
    lost: HashSet<Arc<str>>,
    ticks: u32,
}

impl Carried {
    pub(super) fn new(delivery: Delivery) -> Self {
        Self { delivery, commands: FuturesUnordered::new() }
    }
}

impl<'a> Session<'a> {
    pub(super) fn new(shared: &'a Shared, carried: &'a mut Carried, connection: Connection) -> Self {
        let client = connection.client().clone();
        let context = ContextBuilder::new().timeout(ACK_TIMEOUT).build(client);
        carried.delivery.begin();
        Self {
            shared,
            carried,
            connection,
            context,
            acks: FuturesOrdered::new(),
            preparing: None,
            subscriber: None,
            states: HashMap::new(),
            lost: HashSet::new(),
            ticks: 0,
        }
    }

    /// Runs until the connection is lost or the output is stopped.
    pub(super) async fn run(mut self) -> End {
        match self.serve().await {
            Ok(()) => {
                self.say_goodbye().await;
                End::Stopped
            }
            Err(why) => End::Lost(why),
        }
    }

    async fn serve(&mut self) -> Result<(), String> {
        if self.shared.commands.is_some() {
            let commands = self.shared.topics.all_commands();
            let subscribed = self.connection.client().subscribe(commands).await;
            self.subscriber = Some(subscribed.map_err(|error| with_sources(&error))?);
        }
        let mut tick = interval(TICK);
        tick.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            self.prepare();
            self.send_batches().await;
            let due = self.carried.delivery.due();
            let takes_commands = self.carried.commands.len() < MAX_COMMANDS;
            tokio::select! {
                why = self.connection.lost() => return Err(why),
                Some(answer) = self.acks.next(), if !self.acks.is_empty() => {
                    self.carried.delivery.answered(answer, Instant::now())?;
                }
                result = ready(&mut self.preparing), if self.preparing.is_some() => {
                    self.preparing = None;
                    self.carried.delivery.prepared(result, Instant::now());
                }
                () = self.carried.delivery.fetch(), if self.carried.delivery.needs_batches() => {}
                () = sleep_until(due.unwrap_or_else(Instant::now)), if due.is_some() => {
                    self.carried.delivery.resume(Instant::now());
                }
                message = next(&mut self.subscriber), if takes_commands && self.subscriber.is_some() => {
                    self.take_command(message.ok_or_else(|| "the subscription of commands has ended".to_owned())?);
                }
                Some((subject, reply)) = self.carried.commands.next(), if !self.carried.commands.is_empty() => {
                    publish(self.connection.client(), subject, reply).await?;
                }
                _ = tick.tick() => self.publish_states().await?,
                () = self.shared.stop.cancelled() => return Ok(()),
            }
        }
    }

    /// Begins to prepare the stream, if that is necessary.
    fn prepare(&mut self) {
        if !self.carried.delivery.needs_stream() || self.preparing.is_some() {
            return;
        }
        let (context, topics) = (self.context.clone(), self.shared.topics.clone());
        let (name, prefix) = (self.shared.section.stream.clone(), self.shared.section.prefix.clone());
        let takes_commands = self.shared.commands.is_some();
        self.preparing = Some(Box::pin(async move {
            let prepared = stream::prepare(&context, name.as_str(), prefix.as_str(), &topics, takes_commands);
            timeout(ACK_TIMEOUT * 2, prepared).await.unwrap_or_else(|_| Err("the server does not answer".to_owned()))
        }));
    }

    /// Sends the batches that may be sent.
    async fn send_batches(&mut self) {
        while let Some(Entry { batch, replay, .. }) = self.carried.delivery.take() {
            let id = match batch.revision {
                0 => format!("{}.{}.{}", self.shared.id, batch.plc, batch.seq),
                revision => format!("{}.{}.{revision}.{}", self.shared.id, batch.plc, batch.seq),
            };
            let replay = replay || self.shared.registry.is_former(&batch);
            let message = PublishMessage::build()
                .payload(batch.message(replay))
                .message_id(id)
                .expected_stream(self.shared.section.stream.as_str());
            let subject = self.shared.topics.data(&batch.plc);
            let sent = self.context.send_publish(subject, message).await;
            self.acks.push_back(match sent {
                Ok(ack) => Box::pin(
                    ack.into_future().map(|result| result.map_or_else(|error| answer(&error), |_| Answer::Stored)),
                ),
                // The answer is part of the order.
                Err(error) => Box::pin(std::future::ready(answer(&error))),
            });
        }
    }

    fn take_command(&mut self, message: Message) {
        let (Some(commands), topics) = (self.shared.commands.clone(), &self.shared.topics) else { return };
        let Some(plc) = topics.plc_of_commands(&message.subject).map(str::to_owned) else { return };
        if self.shared.registry.read().elsewhere(&plc).is_some() {
            // The member that polls it executes and answers.
            return;
        }
        let subject = replies::subject(topics, &plc, message.reply.as_deref());
        let mut command: Boxed<(String, Bytes)> = Box::pin(async move {
            let reply = commands.execute(&plc, &message.payload, false).await;
            (subject, reply.to_json())
        });
        // The first poll decides the order.
        let command: Boxed<(String, Bytes)> = match (&mut command).now_or_never() {
            Some(reply) => Box::pin(std::future::ready(reply)),
            None => command,
        };
        self.carried.commands.push(command);
    }

    /// Publishes the states that have changed, and all of them from time to time.
    async fn publish_states(&mut self) -> Result<(), String> {
        let is_all = self.ticks.is_multiple_of(REPEAT);
        self.ticks = self.ticks.wrapping_add(1);
        if is_all {
            publish(self.connection.client(), self.shared.topics.bridge_state(), online()).await?;
        }
        let mut states = HashMap::new();
        let mut messages = Vec::new();
        for plc in self.shared.registry.read().iter() {
            let (name, state): (Arc<str>, _) = (plc.plc.name().into(), PlcState::of(plc));
            let is_news = self.states.get(&name).is_none_or(|before| state.differs_from(before));
            if is_all || is_news {
                messages.push((self.shared.topics.plc_state(&name), state.to_json()));
            }
            states.insert(name, state);
        }
        self.states = states;
        messages.extend(self.lost(is_all));
        for (subject, message) in messages {
            publish(self.connection.client(), subject, message).await?;
        }
        Ok(())
    }

    /// The states of PLCs that this member of a fleet has lost, so that perhaps none polls them: those that are news.
    fn lost(&mut self, is_all: bool) -> Vec<(String, Bytes)> {
        let plcs = self.shared.registry.read();
        self.lost.retain(|name| plcs.elsewhere(name) == Some(Elsewhere::Lost));
        let news = plcs.lost().filter(|name| self.lost.insert(Arc::clone(name)) || is_all);
        news.map(|name| (self.shared.topics.plc_state(name), PlcState::without_member().to_json())).collect()
    }

    /// Publishes replies of commands that run, the last states of the PLCs, and that the bridge is offline.
    async fn say_goodbye(&mut self) {
        // New ones find no responder.
        self.subscriber = None;
        let replies = async {
            while let Some((subject, reply)) = self.carried.commands.next().await {
                publish(self.connection.client(), subject, reply).await?;
            }
            Ok::<_, String>(())
        };
        match timeout(REPLIES, replies).await {
            Ok(Ok(())) => {}
            Ok(Err(error)) => tracing::warn!("nats: a reply was not sent: {error}"),
            Err(_) => {
                let lost = self.carried.commands.len();
                tracing::warn!(lost, "nats: commands did not end within {REPLIES:?}: their replies are lost");
            }
        }
        // PLCs that the last member of a fleet has given up are offline.
        let states = async {
            let states = self.publish_states().await;
            let offline = Bytes::from_static(br#"{"online":false}"#);
            // In any case.
            states.and(publish(self.connection.client(), self.shared.topics.bridge_state(), offline).await)
        };
        match timeout(GOODBYE, states).await {
            Ok(Ok(())) => {}
            Ok(Err(error)) => tracing::warn!("nats: a state was not sent: {error}"),
            Err(_) => {
                tracing::warn!("nats: the last states were not sent within {GOODBYE:?}: the server does not read")
            }
        }
        let (client, stream) = (self.connection.client().clone(), self.shared.section.stream.clone());
        tokio::select! {
            read = timeout(GOODBYE, reach_server(&client, stream.as_str())) => match read {
                Ok(Ok(())) => {}
                Ok(Err(error)) => tracing::warn!("nats: the last messages may be lost: {error}"),
                Err(_) => tracing::warn!("nats: the server did not confirm the last messages within {GOODBYE:?}"),
            },
            why = self.connection.lost() => tracing::warn!("nats: the last messages may be lost: {why}"),
        }
    }
}

/// Waits until the server has read all messages: it answers a request behind them. Messages that it has not read are
/// dropped when the connection ends while the server writes.
async fn reach_server(client: &Client, stream: &str) -> Result<(), String> {
    // A request that the bridge has the right for. Any answer will do, also that there is no such stream.
    match client.request(format!("$JS.API.STREAM.INFO.{stream}"), Bytes::new()).await {
        Ok(_) => Ok(()),
        Err(error) if error.kind() == RequestErrorKind::NoResponders => Ok(()),
        Err(error) => Err(with_sources(&error)),
    }
}

/// Publishes a message without an acknowledgement.
async fn publish(client: &Client, subject: String, payload: Bytes) -> Result<(), String> {
    // The queue of the client is full if the server does not read.
    let published = timeout(ACK_TIMEOUT, client.publish(subject, payload)).await;
    match published {
        Ok(Ok(())) => Ok(()),
        Ok(Err(error)) => Err(with_sources(&error)),
        Err(_) => Err("the server does not read".to_owned()),
    }
}

/// The state of a bridge that is connected.
fn online() -> Bytes {
    let ts = milliseconds(SystemTime::now());
    json!({ "online": true, "version": env!("CARGO_PKG_VERSION"), "ts": ts }).to_string().into()
}

/// The answer of an error.
fn answer(error: &PublishError) -> Answer {
    let source = std::error::Error::source(error);
    let code = source.and_then(|source| source.downcast_ref::<JetStreamError>()).map(|error| error.error_code().0);
    match error.kind() {
        PublishErrorKind::StreamNotFound => Answer::NoStream,
        PublishErrorKind::TimedOut | PublishErrorKind::BrokenPipe => Answer::Timeout,
        PublishErrorKind::MaxPayloadExceeded => Answer::Never(with_sources(error)),
        PublishErrorKind::Other if code == Some(TOO_LONG) => Answer::Never(with_sources(error)),
        PublishErrorKind::Other
        | PublishErrorKind::WrongLastMessageId
        | PublishErrorKind::WrongLastSequence
        | PublishErrorKind::MaxAckPending => Answer::Refused(with_sources(error)),
    }
}

/// The result of a future that is there.
async fn ready<T>(future: &mut Option<Boxed<T>>) -> T {
    match future {
        Some(future) => future.await,
        None => std::future::pending().await,
    }
}

async fn next(subscriber: &mut Option<Subscriber>) -> Option<Message> {
    match subscriber {
        Some(subscriber) => subscriber.next().await,
        None => std::future::pending().await,
    }
}
