//! A broker of MQTT 5 for one kind of client, the bridge: it records everything, and fails on command.

use std::collections::{BTreeMap, VecDeque};
use std::net::SocketAddr;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use bytes::{Bytes, BytesMut};
use rumqttc::v5::mqttbytes::QoS;
use rumqttc::v5::mqttbytes::v5::{
    ConnAck, ConnAckProperties, Connect, ConnectReturnCode, LastWill, Packet, PingResp, Publish, PublishProperties,
    SubAck, SubscribeReasonCode, UnsubAck, UnsubAckReason,
};
use serde_json::Value;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::broadcast;
use tokio::task::JoinHandle;

use super::bridge::PATIENCE;

/// The answer to a message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Action {
    /// PUBACK.
    Ack,
    /// PUBACK with a reason.
    AckWith(u8),
    /// Two of them.
    AckTwice,
    /// None.
    Silence,
    /// None yet: when this number of them is held, all are sent, the last one first.
    HoldAndReverse(usize),
    /// PUBACK, so much later.
    AckAfter(Duration),
    /// None, and the message is lost.
    LoseAndStay,
    /// The connection is closed, and the message is lost.
    Lose,
    /// The connection is closed, and the message is not lost.
    Cut,
    /// DISCONNECT with a reason; the message is lost.
    Disconnect(u8),
    /// It is not read any more from this connection, which stays open.
    StopReading,
}

/// A message of a client.
#[derive(Clone, Debug)]
pub struct Received {
    /// The number of the connection, from 1.
    pub connection: usize,
    pub topic: String,
    pub payload: Bytes,
    pub retain: bool,
    pub qos: QoS,
    pub properties: Option<PublishProperties>,
    pub at: Instant,
}

/// A connection of a client.
#[derive(Clone, Debug)]
pub struct Connected {
    pub connect: Connect,
    pub will: Option<LastWill>,
    pub at: Instant,
    /// `true`: it has ended with a DISCONNECT, and the broker does not publish the will.
    pub said_goodbye: bool,
    /// `true`: it has ended.
    pub is_closed: bool,
    /// The largest number of messages that had no answer at once.
    pub most_in_flight: usize,
    /// The number of messages that had no answer when it ended.
    pub unanswered: usize,
}

type Behaviour = Box<dyn FnMut(&Received) -> Action + Send>;

/// The broker.
pub struct Broker {
    address: SocketAddr,
    shared: Arc<Shared>,
    task: JoinHandle<()>,
}

struct Shared {
    behaviour: Mutex<Behaviour>,
    limits: Mutex<ConnAckProperties>,
    state: Mutex<State>,
    to_clients: broadcast::Sender<Publish>,
}

#[derive(Default)]
struct State {
    received: Vec<Received>,
    connected: Vec<Connected>,
    retained: BTreeMap<String, Bytes>,
    subscriptions: Vec<String>,
}

impl Broker {
    /// A broker that acknowledges all messages.
    pub async fn start() -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap();
        let (to_clients, _) = broadcast::channel(4096);
        let shared = Arc::new(Shared {
            behaviour: Mutex::new(Box::new(|_| Action::Ack)),
            limits: Mutex::new(no_limits()),
            state: Mutex::new(State::default()),
            to_clients,
        });
        let serving = shared.clone();
        let task = tokio::spawn(async move {
            while let Ok((stream, _)) = listener.accept().await {
                tokio::spawn(serve(stream, serving.clone()));
            }
        });
        Self { address, shared, task }
    }

    pub fn url(&self) -> String {
        format!("mqtt://{}", self.address)
    }

    /// Sets the answers to messages from now on.
    pub fn behave(&self, behaviour: impl FnMut(&Received) -> Action + Send + 'static) {
        *self.shared.behaviour.lock().unwrap() = Box::new(behaviour);
    }

    /// Sets the limits of CONNACKs from now on.
    pub fn limit(&self, change: impl FnOnce(&mut ConnAckProperties)) {
        change(&mut self.shared.limits.lock().unwrap());
    }

    /// Keeps a message, as one that an earlier client has left.
    pub fn retain(&self, topic: &str, payload: &str) {
        self.shared.state.lock().unwrap().retained.insert(topic.to_owned(), payload.to_owned().into());
    }

    /// The messages that it keeps.
    pub fn retained(&self) -> BTreeMap<String, Bytes> {
        self.shared.state.lock().unwrap().retained.clone()
    }

    /// A message that it keeps, as JSON.
    pub fn retained_json(&self, topic: &str) -> Option<Value> {
        self.retained().get(topic).and_then(|payload| serde_json::from_slice(payload).ok())
    }

    /// Sends a message to all clients.
    pub fn send(&self, topic: &str, payload: &str, retain: bool, properties: Option<PublishProperties>) {
        let mut publish = Publish::new(topic, QoS::AtLeastOnce, payload.to_owned(), properties);
        publish.retain = retain;
        let _ = self.shared.to_clients.send(publish);
    }

    pub fn received(&self) -> Vec<Received> {
        self.shared.state.lock().unwrap().received.clone()
    }

    pub fn connected(&self) -> Vec<Connected> {
        self.shared.state.lock().unwrap().connected.clone()
    }

    pub fn subscriptions(&self) -> Vec<String> {
        self.shared.state.lock().unwrap().subscriptions.clone()
    }

    /// The batches of all connections.
    pub fn batches(&self) -> Vec<Value> {
        let is_batch = |received: &Received| received.topic.ends_with("/data");
        let batches = self.received().into_iter().filter(is_batch);
        batches.map(|received| serde_json::from_slice(&received.payload).unwrap()).collect()
    }

    /// Waits until something holds.
    pub async fn wait_for(&self, what: &str, mut holds: impl FnMut(&Self) -> bool) {
        let until = Instant::now() + PATIENCE;
        while !holds(self) {
            assert!(Instant::now() < until, "{what}: not within {PATIENCE:?}");
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    }
}

impl Drop for Broker {
    fn drop(&mut self) {
        self.task.abort();
    }
}

/// Properties of a CONNACK without any.
fn no_limits() -> ConnAckProperties {
    ConnAckProperties {
        session_expiry_interval: None,
        receive_max: None,
        max_qos: None,
        retain_available: None,
        max_packet_size: None,
        assigned_client_identifier: None,
        topic_alias_max: None,
        reason_string: None,
        user_properties: Vec::new(),
        wildcard_subscription_available: None,
        subscription_identifiers_available: None,
        shared_subscription_available: None,
        server_keep_alive: None,
        response_information: None,
        server_reference: None,
        authentication_method: None,
        authentication_data: None,
    }
}

/// A client, until its connection ends.
struct Client {
    number: usize,
    shared: Arc<Shared>,
    out: BytesMut,
    held: Vec<u16>,
    /// Acknowledgements that are due later.
    late: VecDeque<(Instant, u16)>,
    in_flight: usize,
    filters: Vec<String>,
}

async fn serve(mut stream: TcpStream, shared: Arc<Shared>) {
    let mut to_clients = shared.to_clients.subscribe();
    let mut client = Client {
        number: 0,
        shared,
        out: BytesMut::new(),
        held: Vec::new(),
        late: VecDeque::new(),
        in_flight: 0,
        filters: Vec::new(),
    };
    let mut buffer = BytesMut::new();
    loop {
        tokio::select! {
            read = stream.read_buf(&mut buffer) => if !matches!(read, Ok(1..)) { break },
            Ok(publish) = to_clients.recv() => client.forward(publish),
            id = next_late(&client.late) => {
                client.late.retain(|(_, late)| *late != id);
                client.acknowledge(id, 0);
            }
        }
        // PUBACKs of the client are taken and ignored.
        while let Some(next) = client.take_next(&mut buffer) {
            match next {
                Next::Go => {}
                Next::Close => {
                    let _ = stream.write_all(&client.out).await;
                    client.closed(false);
                    return;
                }
                Next::Goodbye => {
                    client.closed(true);
                    return;
                }
                Next::StopReading => {
                    let _ = stream.write_all(&client.out).await;
                    // The client closes it when it is tired of waiting.
                    while stream.writable().await.is_ok() && stream.try_write(&[]).is_ok() {
                        tokio::time::sleep(Duration::from_millis(50)).await;
                        if client.is_replaced() {
                            break;
                        }
                    }
                    client.closed(false);
                    return;
                }
            }
        }
        if stream.write_all(&client.out).await.is_err() {
            break;
        }
        client.out.clear();
    }
    client.closed(false);
}

/// Waits for the next late acknowledgement; forever without one.
async fn next_late(late: &VecDeque<(Instant, u16)>) -> u16 {
    let Some((due, id)) = late.iter().min() else { return std::future::pending().await };
    tokio::time::sleep_until((*due).into()).await;
    *id
}

enum Next {
    Go,
    Close,
    Goodbye,
    StopReading,
}

impl Client {
    fn take_next(&mut self, buffer: &mut BytesMut) -> Option<Next> {
        // A DISCONNECT without a reason, which `rumqttc` does not decode.
        if buffer.starts_with(&[0xE0, 0]) {
            return Some(Next::Goodbye);
        }
        Packet::read(buffer, None).ok().map(|packet| self.take(packet))
    }

    fn take(&mut self, packet: Packet) -> Next {
        #[expect(clippy::wildcard_enum_match_arm, reason = "packets that a client does not send")]
        match packet {
            Packet::Connect(connect, will, _) => self.connect(connect, will),
            Packet::Publish(publish) => return self.publish(publish),
            Packet::Subscribe(subscribe) => {
                let filters: Vec<String> = subscribe.filters.into_iter().map(|filter| filter.path).collect();
                let return_codes = filters.iter().map(|_| SubscribeReasonCode::Success(QoS::AtLeastOnce)).collect();
                let ack = SubAck { pkid: subscribe.pkid, return_codes, properties: None };
                self.send(&Packet::SubAck(ack));
                let mut state = self.shared.state.lock().unwrap();
                state.subscriptions.extend(filters.iter().cloned());
                let is_one = |topic: &str| filters.iter().any(|filter| matches(filter, topic));
                let retained: Vec<_> = state.retained.clone().into_iter().filter(|(topic, _)| is_one(topic)).collect();
                drop(state);
                self.filters.extend(filters);
                for (topic, payload) in retained {
                    let mut publish = Publish::new(topic, QoS::AtMostOnce, payload, None);
                    publish.retain = true;
                    self.send(&Packet::Publish(publish));
                }
            }
            Packet::Unsubscribe(unsubscribe) => {
                let reasons = unsubscribe.filters.iter().map(|_| UnsubAckReason::Success).collect();
                self.filters.retain(|filter| !unsubscribe.filters.contains(filter));
                self.send(&Packet::UnsubAck(UnsubAck { pkid: unsubscribe.pkid, reasons, properties: None }));
            }
            Packet::PingReq(_) => self.send(&Packet::PingResp(PingResp)),
            Packet::Disconnect(_) => return Next::Goodbye,
            _ => {}
        }
        Next::Go
    }

    fn connect(&mut self, connect: Connect, will: Option<LastWill>) {
        let mut state = self.shared.state.lock().unwrap();
        state.connected.push(Connected {
            connect,
            will,
            at: Instant::now(),
            said_goodbye: false,
            is_closed: false,
            most_in_flight: 0,
            unanswered: 0,
        });
        self.number = state.connected.len();
        drop(state);
        let properties = Some(self.shared.limits.lock().unwrap().clone());
        self.send(&Packet::ConnAck(ConnAck { session_present: false, code: ConnectReturnCode::Success, properties }));
    }

    fn publish(&mut self, publish: Publish) -> Next {
        let Publish { qos, retain, topic, pkid, payload, properties, .. } = publish;
        let topic = String::from_utf8(topic.to_vec()).unwrap();
        let received =
            Received { connection: self.number, topic, payload, retain, qos, properties, at: Instant::now() };
        let action = (self.shared.behaviour.lock().unwrap())(&received);
        self.in_flight += 1;
        let mut state = self.shared.state.lock().unwrap();
        let connected = &mut state.connected[self.number - 1];
        connected.most_in_flight = connected.most_in_flight.max(self.in_flight);
        if !matches!(action, Action::Lose | Action::LoseAndStay | Action::Disconnect(_) | Action::StopReading) {
            if retain && received.payload.is_empty() {
                state.retained.remove(&received.topic);
            } else if retain {
                state.retained.insert(received.topic.clone(), received.payload.clone());
            }
            state.received.push(received);
        }
        drop(state);
        match action {
            Action::Ack => self.acknowledge(pkid, 0),
            Action::AckWith(reason) => self.acknowledge(pkid, reason),
            Action::AckTwice => {
                self.acknowledge(pkid, 0);
                self.out.extend_from_slice(&puback(pkid, 0));
            }
            Action::AckAfter(delay) => self.late.push_back((Instant::now() + delay, pkid)),
            Action::Silence | Action::LoseAndStay => {}
            Action::HoldAndReverse(number) => {
                self.held.push(pkid);
                if self.held.len() >= number {
                    let held = std::mem::take(&mut self.held);
                    held.into_iter().rev().for_each(|id| self.acknowledge(id, 0));
                }
            }
            Action::Lose | Action::Cut => return Next::Close,
            Action::Disconnect(reason) => {
                self.out.extend_from_slice(&[0xE0, 2, reason, 0]);
                return Next::Close;
            }
            Action::StopReading => return Next::StopReading,
        }
        Next::Go
    }

    fn acknowledge(&mut self, id: u16, reason: u8) {
        self.in_flight -= 1;
        self.out.extend_from_slice(&puback(id, reason));
    }

    /// Forwards a message with a flag that stays as it was published.
    fn forward(&mut self, mut publish: Publish) {
        let topic = std::str::from_utf8(&publish.topic).unwrap();
        if self.filters.iter().any(|filter| matches(filter, topic)) {
            publish.pkid = 77;
            self.send(&Packet::Publish(publish));
        }
    }

    fn send(&mut self, packet: &Packet) {
        packet.write(&mut self.out, None).unwrap();
    }

    fn closed(&self, said_goodbye: bool) {
        let mut state = self.shared.state.lock().unwrap();
        if let Some(connected) = self.number.checked_sub(1).and_then(|at| state.connected.get_mut(at)) {
            connected.said_goodbye = said_goodbye;
            connected.unanswered = self.in_flight;
            connected.is_closed = true;
        }
    }

    fn is_replaced(&self) -> bool {
        self.shared.state.lock().unwrap().connected.len() > self.number
    }
}

fn puback(id: u16, reason: u8) -> [u8; 5] {
    let [high, low] = id.to_be_bytes();
    [0x40, 3, high, low, reason]
}

/// Returns whether a topic matches a filter with `+`.
fn matches(filter: &str, topic: &str) -> bool {
    let (filter, topic): (Vec<_>, Vec<_>) = (filter.split('/').collect(), topic.split('/').collect());
    filter.len() == topic.len() && filter.iter().zip(&topic).all(|(a, b)| *a == "+" || a == b)
}
