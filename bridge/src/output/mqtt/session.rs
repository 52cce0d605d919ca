//! A connection from its CONNACK until it is lost or the output is stopped.
//!
//! One task reads, writes, and waits for batches, replies and the clock, each independent of the others: a broker
//! that does not read is noticed by its silence, and one that is slow with its acknowledgements fills the window.
//!
//! Order of messages: subscriptions, states, replies, and then discovery and batches in turn.

mod closing;

use std::collections::VecDeque;
use std::time::Duration;

use bytes::Bytes;
use futures::future::BoxFuture;
use futures::stream::FuturesUnordered;
use futures::{FutureExt as _, StreamExt as _};
use tokio::time::{Instant, MissedTickBehavior, interval, sleep_until, timeout};

use self::closing::{Closing, OfflineState};
use super::Shared;
use super::commands::ReplyTo;
use super::connection::{Ack, Connection, Incoming, LostError, Message};
use super::delivery::{Delivery, Loss};
use super::discovery::Discovery;
use super::plcs::PublishedPlcs;
use super::retained::{Priority, Retained};
use super::window::Window;
use crate::buffer::Entry;

/// The bytes that wait to be written before no more messages are made.
const MAX_WAITING: usize = 64 << 10;
/// The time between two looks at the states of the PLCs.
const TICK: Duration = Duration::from_secs(1);
/// The time after which a member of a fleet publishes the states of its PLCs again.
const REPEAT_STATES: Duration = Duration::from_secs(10);
/// After this time the broker has sent all retained messages of an earlier run.
const EARLIER_RUN: Duration = Duration::from_secs(10);
/// The time in which Home Assistant makes its entities. Values that come before are lost for it.
const INTRODUCTION: Duration = Duration::from_secs(5);
/// The keep-alive times after which a batch without an acknowledgement is taken for lost.
const UNANSWERED: u32 = 3;
/// The time to read what came before the connection was lost.
const REST: Duration = Duration::from_millis(200);
/// The replies that wait for a connection. More are dropped, the oldest first.
const MAX_REPLIES: usize = 256;
/// The state of a bridge that is not connected.
pub(super) const OFFLINE: &[u8] = br#"{"online":false}"#;

/// The parts of an output that outlive its connections.
#[derive(Debug)]
pub(super) struct Carried {
    pub(super) delivery: Delivery,
    pub(super) retained: Retained,
    pub(super) plcs: PublishedPlcs,
    /// Commands under way. Each is begun at once, and ends also while there is no connection.
    commands: FuturesUnordered<BoxFuture<'static, Message>>,
    replies: VecDeque<Message>,
}

/// The end of a session.
#[derive(Debug)]
pub(super) enum End {
    /// The output was stopped.
    Stopped,
    /// The connection was lost.
    Lost(LostError),
}

pub(super) struct Session<'a> {
    shared: &'a Shared,
    carried: &'a mut Carried,
    connection: Connection,
    window: Window<Item>,
    last_received: Instant,
    last_sent: Instant,
    last_ping: Instant,
    /// When all states were queued last.
    last_states: Instant,
    /// When the subscriptions for messages of an earlier run end.
    earlier_run_ends: Option<Instant>,
    /// The end of the session, once the output is stopped.
    closing: Option<Closing>,
    is_turn_of_discovery: bool,
    /// When Home Assistant has made the entities of the last discovery messages: it needs their values then.
    introduced: Option<Instant>,
}

/// A packet that waits for an acknowledgement.
#[derive(Clone, Debug, PartialEq, Eq)]
enum Item {
    /// The batch at this position of the buffer.
    Batch(u64),
    Retained(String),
    /// The offline state of the bridge when the output ends.
    Offline,
    Reply(Message),
    Subscriptions(Vec<String>),
    EndOfSubscriptions,
}

impl Carried {
    pub(super) fn new(delivery: Delivery) -> Self {
        Self {
            delivery,
            retained: Retained::default(),
            plcs: PublishedPlcs::default(),
            commands: FuturesUnordered::new(),
            replies: VecDeque::new(),
        }
    }

    fn push_reply(&mut self, reply: Message) {
        if self.replies.len() == MAX_REPLIES {
            tracing::warn!("mqtt: the reply of a command is lost: more than {MAX_REPLIES} wait for a connection");
            self.replies.pop_front();
        }
        self.replies.push_back(reply);
    }
}

impl<'a> Session<'a> {
    pub(super) fn new(shared: &'a Shared, carried: &'a mut Carried, connection: Connection) -> Self {
        let now = Instant::now();
        let window = Window::new(connection.limits.in_flight);
        Self {
            shared,
            carried,
            connection,
            window,
            last_received: now,
            last_sent: now,
            last_ping: now,
            last_states: now,
            earlier_run_ends: Some(now + EARLIER_RUN),
            closing: None,
            is_turn_of_discovery: true,
            introduced: None,
        }
    }

    /// Runs until the connection is lost or the output is stopped.
    pub(super) async fn run(mut self) -> End {
        if !self.connection.limits.retain {
            tracing::warn!("mqtt: the broker keeps no retained messages: states are seen only as they change");
        }
        self.subscribe();
        self.carried.retained.set(self.shared.topics.bridge_state(), self.shared.birth.clone(), Priority::First, None);
        // Before the refresh, which announces what is lost on this connection.
        self.carried.retained.queue_all();
        self.refresh(true);
        let ended = self.serve().await;
        self.carry(&ended);
        ended
    }

    async fn serve(&mut self) -> End {
        let mut tick = interval(TICK);
        tick.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            self.fill();
            if let Some(closing) = &self.closing
                && self.is_over(closing)
            {
                let offline_state = closing.offline_state;
                return self.close(offline_state).await;
            }
            let ends = self.closing.as_ref().map(Closing::ends);
            let due = self.carried.delivery.due();
            let needs_batches = self.closing.is_none() && self.carried.delivery.needs_batches();
            let ready = tokio::select! {
                read = self.connection.reader.fill() => read.and_then(|()| self.receive()),
                written = self.connection.writer.write_some(), if !self.connection.writer.is_idle() => {
                    self.last_sent = Instant::now();
                    written
                }
                () = self.carried.delivery.fetch(), if needs_batches => Ok(()),
                () = sleep_until(due.unwrap_or(self.last_sent)), if due.is_some() => {
                    self.carried.delivery.resume(Instant::now());
                    Ok(())
                }
                Some(reply) = self.carried.commands.next() => {
                    self.carried.push_reply(reply);
                    self.progress();
                    Ok(())
                }
                _ = tick.tick() => self.tick(),
                () = sleep_until(ends.unwrap_or(self.last_sent)), if ends.is_some() => Ok(()),
                () = self.shared.stop.cancelled(), if self.closing.is_none() => {
                    self.begin_close();
                    Ok(())
                }
            };
            if let Err(error) = ready {
                return End::Lost(self.read_rest(error).await);
            }
        }
    }

    /// Reads what the broker has sent before it has closed the connection: acknowledgements, and the reason. A write
    /// may fail before they are read.
    async fn read_rest(&mut self, error: LostError) -> LostError {
        if !matches!(error, LostError::Io(_)) {
            return error;
        }
        let reading = async {
            loop {
                let read = self.connection.reader.fill().await.and_then(|()| self.receive());
                if let Err(last) = read {
                    return last;
                }
            }
        };
        match timeout(REST, reading).await {
            Ok(reason @ LostError::Disconnected(_)) => reason,
            Ok(_) | Err(_) => error,
        }
    }

    /// Sends what may be sent now.
    fn fill(&mut self) {
        let is_full = |session: &Self| session.window.room() == 0 || session.connection.writer.waiting() >= MAX_WAITING;
        // A batch under suspicion is alone in flight, but for the last states.
        let is_alone = |session: &Self| session.closing.is_none() && session.carried.delivery.is_probing_in_flight();
        while !is_full(self) && !is_alone(self) {
            let sent = self.send_state() || self.send_reply() || self.closing.is_none() && self.send_in_turn();
            if !sent {
                break;
            }
        }
    }

    fn send_in_turn(&mut self) -> bool {
        self.is_turn_of_discovery = !self.is_turn_of_discovery;
        let is_first = self.is_turn_of_discovery;
        is_first && self.send_retained(Priority::Between)
            || self.send_batch()
            || !is_first && self.send_retained(Priority::Between)
    }

    fn send_state(&mut self) -> bool {
        self.send_retained(Priority::First)
    }

    fn send_retained(&mut self, priority: Priority) -> bool {
        let Some((topic, payload)) = self.carried.retained.take(priority) else { return false };
        let is_entity = priority == Priority::Between && !payload.is_empty();
        self.introduced = is_entity.then(|| Instant::now() + INTRODUCTION).or(self.introduced);
        let message = Message { topic: topic.clone().into(), payload, retain: true, correlation: None };
        let is_last = self.closing.is_some() && topic == self.shared.topics.bridge_state();
        self.publish(&message, if is_last { Item::Offline } else { Item::Retained(topic) });
        true
    }

    fn send_reply(&mut self) -> bool {
        let Some(message) = self.carried.replies.pop_front() else { return false };
        self.publish(&message, Item::Reply(message.clone()));
        true
    }

    fn send_batch(&mut self) -> bool {
        if self.carried.delivery.is_probing() && !self.window.is_empty() {
            return false;
        }
        let Some(Entry { position, batch, replay }) = self.carried.delivery.take(Instant::now()) else { return false };
        let topic = Bytes::from(self.shared.topics.data(&batch.plc));
        let replay = replay || self.shared.registry.is_former(&batch);
        let message = Message { topic, payload: batch.message(replay), retain: false, correlation: None };
        self.publish(&message, Item::Batch(position));
        true
    }

    /// Sends a message. There is room for it.
    fn publish(&mut self, message: &Message, item: Item) {
        let Some(id) = self.window.free_id() else { return };
        match self.connection.writer.publish(id, message) {
            Ok(()) => self.window.insert(id, item),
            Err(too_large) => {
                let topic = String::from_utf8_lossy(&message.topic).into_owned();
                tracing::warn!(
                    topic,
                    size = too_large.size,
                    limit = too_large.limit,
                    "mqtt: a message is too large for the broker"
                );
                self.refuse(item, Ack::Never(0x95));
            }
        }
    }

    fn receive(&mut self) -> Result<(), LostError> {
        self.last_received = Instant::now();
        while let Some(packet) = self.connection.reader.next()? {
            self.handle(packet);
        }
        Ok(())
    }

    fn handle(&mut self, packet: Incoming) {
        match packet {
            Incoming::Ack { id, ack } => match self.window.take(id) {
                Some(item) => {
                    self.progress();
                    self.acknowledge(item, ack);
                }
                None => tracing::debug!(id, "mqtt: an acknowledgement of nothing, or a second one"),
            },
            Incoming::Subscribed { id, refused } => {
                let Some(Item::Subscriptions(filters)) = self.window.take(id) else { return };
                self.progress();
                for (filter, reason) in filters.iter().zip(refused) {
                    if let Some(reason) = reason {
                        tracing::warn!(filter, reason, "mqtt: the broker refuses a subscription");
                    }
                }
            }
            Incoming::Unsubscribed { id } => drop(self.window.take(id)),
            Incoming::Message { id, topic, payload, retain, response, correlation } => {
                if let Some(id) = id {
                    self.connection.writer.acknowledge(id);
                }
                self.take_message(&topic, payload, retain, response.as_deref(), correlation);
            }
            Incoming::Pong => {}
        }
    }

    /// Notes that the end of the session makes progress, if it has begun.
    fn progress(&mut self) {
        if let Some(closing) = &mut self.closing {
            closing.progressed(Instant::now());
        }
    }

    fn acknowledge(&mut self, item: Item, ack: Ack) {
        let is_lost = match (&item, ack) {
            (_, Ack::Taken) => false,
            (Item::Batch(_), Ack::NoSubscribers) => {
                self.shared.health.count_no_subscribers();
                self.shared.require_subscribers
            }
            (_, Ack::NoSubscribers) => false,
            (_, Ack::Never(_) | Ack::Refused(_)) => true,
        };
        match item {
            _ if is_lost => self.refuse(item, ack),
            Item::Batch(position) => self.carried.delivery.taken(position, Instant::now()),
            Item::Retained(topic) => self.carried.retained.acknowledged(&topic),
            Item::Offline => {
                if let Some(closing) = &mut self.closing {
                    closing.offline_state = OfflineState::Known;
                }
            }
            Item::Reply(_) | Item::Subscriptions(_) | Item::EndOfSubscriptions => {}
        }
    }

    /// Handles a message that the broker does not take.
    fn refuse(&mut self, item: Item, ack: Ack) {
        let now = Instant::now();
        let health = &self.shared.health;
        let why = match ack {
            Ack::Never(reason) | Ack::Refused(reason) => {
                health.count_refused();
                format!("the broker refuses messages: {}", Ack::reason_name(reason))
            }
            Ack::Taken | Ack::NoSubscribers => "no subscriber takes the batches".to_owned(),
        };
        match (item, ack) {
            (Item::Batch(position), Ack::Never(_)) => {
                tracing::warn!(why, "mqtt: a batch is given up");
                self.carried.delivery.skip(position, now);
            }
            (Item::Batch(position), Ack::Refused(_) | Ack::NoSubscribers | Ack::Taken) => {
                self.carried.delivery.refused(position, &why, now);
            }
            // It is sent again when it changes, or on the next connection: not now, which would not end.
            (Item::Retained(topic), _) => {
                tracing::warn!(topic, why, "mqtt: a state or a discovery message is not kept by the broker");
                self.carried.retained.acknowledged(&topic);
            }
            (Item::Reply(_), _) => tracing::warn!(why, "mqtt: the reply of a command is lost"),
            // The broker publishes the will.
            (Item::Offline, _) => {
                if let Some(closing) = &mut self.closing {
                    closing.offline_state = OfflineState::Refused;
                }
            }
            (Item::Subscriptions(_) | Item::EndOfSubscriptions, _) => {}
        }
    }

    fn subscribe(&mut self) {
        let filters = self.shared.subscriptions();
        let Some(id) = self.window.free_id() else { return };
        self.connection.writer.subscribe(id, &filters);
        self.window.insert(id, Item::Subscriptions(filters.into_iter().map(|filter| filter.path).collect()));
    }

    /// Ends the subscriptions that were for messages of an earlier run.
    fn unsubscribe(&mut self) {
        let Some(id) = self.window.free_id() else { return };
        self.earlier_run_ends = None;
        self.connection
            .writer
            .unsubscribe(id, self.shared.earlier_run().into_iter().map(|filter| filter.path).collect());
        self.window.insert(id, Item::EndOfSubscriptions);
    }

    fn take_message(
        &mut self,
        topic: &str,
        payload: Bytes,
        retain: bool,
        response: Option<&str>,
        correlation: Option<Bytes>,
    ) {
        if let Some((commands, plc)) = self.shared.commands.clone().zip(self.shared.topics.plc_of_commands(topic)) {
            if self.shared.registry.read().elsewhere(plc).is_some() {
                // The member that polls it executes and answers.
                return;
            }
            let discovery = self.shared.discovery.as_ref().map(Discovery::prefix);
            let reply_to = ReplyTo::new(&self.shared.topics, discovery, plc, response, correlation);
            // The result of a new one would come after the end of the session.
            let commands = if self.closing.is_some() { commands.closing() } else { commands };
            let plc = plc.to_owned();
            let command = async move {
                let reply = commands.execute(&plc, &payload, retain).await;
                reply_to.message(reply.to_json())
            };
            self.carried.commands.push(command.boxed());
            // Its first poll begins it: commands for a PLC are executed in this order, and now or never.
            while let Some(Some(reply)) = self.carried.commands.next().now_or_never() {
                self.carried.push_reply(reply);
            }
        } else if self.shared.is_birth_of_home_assistant(topic, &payload, retain) {
            self.carried.retained.queue_wanted(Priority::Between);
        } else if retain && !payload.is_empty() && self.shared.is_own_retained(topic) {
            // Of a PLC or a tag that went while the bridge was not running or not connected. In a fleet, it can be of
            // another member, whose configuration may be newer.
            if !self.carried.retained.is_wanted(topic) && !self.shared.topics.is_fleet() {
                self.carried.retained.clear(topic.to_owned());
            }
        }
    }

    fn tick(&mut self) -> Result<(), LostError> {
        let now = Instant::now();
        let keep_alive = self.connection.limits.keep_alive;
        let silence = now.duration_since(self.last_received);
        if silence >= keep_alive.mul_f64(1.5) {
            return Err(LostError::Silent(Duration::from_secs(silence.as_secs())));
        }
        let patience = keep_alive.saturating_mul(UNANSWERED);
        if self.carried.delivery.oldest().is_some_and(|sent| now.duration_since(sent) >= patience) {
            return Err(LostError::Unanswered(patience));
        }
        let oldest = self.last_received.min(self.last_sent);
        let is_due = |last: Instant| now.duration_since(last) >= keep_alive / 2;
        if is_due(oldest) && is_due(self.last_ping) {
            self.last_ping = now;
            self.connection.writer.ping();
        }
        if self.earlier_run_ends.is_some_and(|ends| ends <= now) {
            self.unsubscribe();
        }
        if self.introduced.is_some_and(|at| at <= now) {
            self.introduced = None;
            self.carried.delivery.want_present_values();
        }
        self.carried.delivery.give_up(now);
        if self.closing.is_none() {
            self.refresh(false);
            self.repeat_states(now);
        }
        Ok(())
    }

    fn refresh(&mut self, anew: bool) {
        let Shared { registry, topics, discovery, .. } = self.shared;
        let Carried { delivery, plcs, retained, .. } = &mut *self.carried;
        plcs.refresh(registry, topics, discovery.as_ref(), retained, anew);
        if delivery.has_refused() {
            let configured = registry.read();
            delivery.configured(|plc| configured.get(plc).is_some());
        }
    }

    /// In a fleet: publishes all states from time to time. A member that was cut off may publish late that a PLC is
    /// offline, which another one polls by then.
    fn repeat_states(&mut self, now: Instant) {
        if self.shared.topics.is_fleet() && now.duration_since(self.last_states) >= REPEAT_STATES {
            self.last_states = now;
            self.carried.retained.queue_wanted(Priority::First);
        }
    }

    /// Keeps what was not acknowledged for the next connection.
    fn carry(&mut self, ended: &End) {
        let items: Vec<Item> = self.window.drain().collect();
        let positions: Vec<u64> = items.iter().filter_map(Item::position).collect();
        let is_alone = positions.len() == items.len();
        let loss = match (ended, positions.as_slice()) {
            (End::Lost(error), [position]) if error.blames_a_message() && is_alone => Loss::Guilty(*position),
            (End::Lost(error), [_, ..]) if error.blames_a_message() => Loss::Suspect,
            (End::Lost(_) | End::Stopped, _) => Loss::Other,
        };
        self.carried.delivery.lost(loss, Instant::now());
        let replies: Vec<Message> = items.into_iter().filter_map(Item::into_reply).collect();
        replies.into_iter().for_each(|reply| self.carried.push_reply(reply));
    }
}

impl Item {
    fn position(&self) -> Option<u64> {
        match self {
            Self::Batch(position) => Some(*position),
            Self::Retained(_) | Self::Offline | Self::Reply(_) | Self::Subscriptions(_) | Self::EndOfSubscriptions => {
                None
            }
        }
    }

    fn into_reply(self) -> Option<Message> {
        match self {
            Self::Reply(message) => Some(message),
            Self::Batch(_) | Self::Retained(_) | Self::Offline | Self::Subscriptions(_) | Self::EndOfSubscriptions => {
                None
            }
        }
    }
}
