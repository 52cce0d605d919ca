//! A connection to a broker, as a client of MQTT 5: the only module that uses `rumqttc`.
//!
//! Of `rumqttc` it uses the codec of packets, and not its event loop. That one chooses packet ids by itself,
//! drops its queue when the broker has no session, ends the connection at a second PUBACK or at a reason that it
//! does not know (mosquitto sends 0x95), and waits in its write while a broker does not read, without noticing.
//! Here packets are numbered, sent and matched by the session that owns the buffer's cursor.
//!
//! Reader and writer are separate, so that a broker that does not read does not keep acknowledgements from
//! being read.

mod error;
mod packet;

use std::io;
use std::sync::Arc;
use std::time::Duration;

use bytes::{Bytes, BytesMut};
use rumqttc::v5::mqttbytes::QoS;
use rumqttc::v5::mqttbytes::v5::{
    ConnAck, Connect, ConnectProperties, ConnectReturnCode, Disconnect, DisconnectReasonCode, LastWill, Login, Packet,
    PubAck, Publish, PublishProperties, RetainForwardRule, Subscribe, Unsubscribe,
};
use rustls::pki_types::ServerName;
use tokio::io::{AsyncRead, AsyncReadExt as _, AsyncWrite, AsyncWriteExt as _, ReadHalf, WriteHalf};
use tokio::net::TcpStream;
use tokio::time::timeout;
use tokio_rustls::TlsConnector;

use super::credentials::Credentials;
use crate::config::{Mqtt, ServerUrl};

pub(super) use self::error::{ConnectError, LostError};
pub(super) use self::packet::{Ack, Incoming, Message};

/// The time to open a connection, from the name of the broker to its CONNACK.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(10);
/// A client sends something at least this often; see [`Limits::keep_alive`].
const KEEP_ALIVE: Duration = Duration::from_secs(20);
/// The largest packet that the broker may send: of commands, and of retained messages of an earlier run.
const MAX_INCOMING: u32 = 128 << 10;
/// The bytes that are read at once.
const READ_SIZE: usize = 16 << 10;
/// The packets in flight, unless the broker takes fewer.
const MAX_IN_FLIGHT: u16 = 512;
/// The longest packet of MQTT, without its first bytes.
const MAX_PACKET: usize = 268_435_455;

trait Socket: AsyncRead + AsyncWrite + Send + Unpin {}
impl<T: AsyncRead + AsyncWrite + Send + Unpin> Socket for T {}

/// The identity of a client, and what the broker says of it when it is lost.
#[derive(Clone, Debug)]
pub(super) struct Client {
    pub(super) id: String,
    pub(super) will_topic: String,
    pub(super) will: Bytes,
}

/// Limits that the broker has set in its CONNACK.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Limits {
    /// The packets that may be in flight.
    pub(super) in_flight: u16,
    /// The largest packet, in bytes.
    pub(super) packet: usize,
    /// `true` if it keeps retained messages.
    pub(super) retain: bool,
    /// The time within which the client sends something.
    pub(super) keep_alive: Duration,
}

/// An open connection.
pub(super) struct Connection {
    pub(super) reader: Reader,
    pub(super) writer: Writer,
    pub(super) limits: Limits,
}

/// The packets of the broker.
pub(super) struct Reader {
    half: ReadHalf<Box<dyn Socket>>,
    buffer: BytesMut,
}

/// The packets to the broker.
pub(super) struct Writer {
    half: WriteHalf<Box<dyn Socket>>,
    buffer: BytesMut,
    needs_flush: bool,
    max_packet: usize,
    retain: bool,
}

/// A message that the broker does not take, because of its size.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct TooLarge {
    pub(super) size: usize,
    pub(super) limit: usize,
}

/// Subscriptions, by the topics that they match.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Filter {
    pub(super) path: String,
    /// `true`: the flag of retained messages stays as the publisher has set it, so that a live message is
    /// marked that the broker also keeps.
    pub(super) as_published: bool,
}

impl Connection {
    /// Opens a connection without a session of an earlier one.
    pub(super) async fn open(url: &ServerUrl<Mqtt>, files: Credentials, client: &Client) -> Result<Self, ConnectError> {
        let opening = async {
            let socket = open_socket(url, files.tls.clone()).await?;
            Self::handshake(socket, files, client).await
        };
        timeout(CONNECT_TIMEOUT, opening).await.unwrap_or(Err(ConnectError::Timeout(CONNECT_TIMEOUT)))
    }

    async fn handshake(socket: Box<dyn Socket>, files: Credentials, client: &Client) -> Result<Self, ConnectError> {
        let (read, write) = tokio::io::split(socket);
        let mut reader = Reader { half: read, buffer: BytesMut::new() };
        let mut writer =
            Writer { half: write, buffer: BytesMut::new(), needs_flush: false, max_packet: MAX_PACKET, retain: true };
        let properties = ConnectProperties {
            session_expiry_interval: Some(0),
            max_packet_size: Some(MAX_INCOMING),
            ..ConnectProperties::new()
        };
        let keep_alive = u16::try_from(KEEP_ALIVE.as_secs()).unwrap_or(u16::MAX);
        let connect =
            Connect { keep_alive, client_id: client.id.clone(), clean_start: true, properties: Some(properties) };
        let will = LastWill::new(client.will_topic.clone(), client.will.to_vec(), QoS::AtLeastOnce, true, None);
        let login = (files.user.is_some() || files.password.is_some()).then(|| {
            let password = files.password.map(|password| password.expose().to_owned());
            Login::new(files.user.unwrap_or_default(), password.unwrap_or_default())
        });
        writer.send(&Packet::Connect(connect, Some(will), login));
        while !writer.is_idle() {
            writer.write_some().await.map_err(|error| error::lost_at_connect(&error))?;
        }
        loop {
            match packet::next_raw(&mut reader.buffer, MAX_INCOMING) {
                Ok(Some(Packet::ConnAck(ack))) => {
                    let limits = limits(&ack)?;
                    (writer.max_packet, writer.retain) = (limits.packet, limits.retain);
                    return Ok(Self { reader, writer, limits });
                }
                Ok(Some(_)) | Err(_) => return Err(ConnectError::NotMqtt5),
                Ok(None) => {}
            }
            reader.fill().await.map_err(|error| error::lost_at_connect(&error))?;
        }
    }
}

async fn open_socket(
    url: &ServerUrl<Mqtt>,
    tls: Option<rustls::ClientConfig>,
) -> Result<Box<dyn Socket>, ConnectError> {
    let stream = TcpStream::connect((url.host(), url.port())).await.map_err(ConnectError::Connect)?;
    stream.set_nodelay(true).map_err(ConnectError::Connect)?;
    let Some(config) = tls else { return Ok(Box::new(stream)) };
    let name = ServerName::try_from(url.host().to_owned()).map_err(|_| ConnectError::HostName)?;
    let connector = TlsConnector::from(Arc::new(config));
    let stream = connector.connect(name, stream).await.map_err(|error| error::of_tls(&error))?;
    Ok(Box::new(stream))
}

fn limits(ack: &ConnAck) -> Result<Limits, ConnectError> {
    if ack.code != ConnectReturnCode::Success {
        return Err(ConnectError::Refused(ack.code));
    }
    let properties = ack.properties.as_ref();
    if properties.and_then(|all| all.max_qos) == Some(0) {
        return Err(ConnectError::NoAcknowledgements);
    }
    let in_flight = properties.and_then(|all| all.receive_max).unwrap_or(u16::MAX);
    let packet = properties.and_then(|all| all.max_packet_size).map_or(MAX_PACKET, |size| size as usize);
    let keep_alive = properties.and_then(|all| all.server_keep_alive).filter(|seconds| *seconds > 0);
    Ok(Limits {
        in_flight: in_flight.clamp(1, MAX_IN_FLIGHT),
        packet: packet.min(MAX_PACKET),
        retain: properties.and_then(|all| all.retain_available) != Some(0),
        keep_alive: keep_alive.map_or(KEEP_ALIVE, |seconds| Duration::from_secs(seconds.into()).min(KEEP_ALIVE)),
    })
}

impl Reader {
    /// Reads what has come, and waits if there is nothing. Cancel-safe.
    pub(super) async fn fill(&mut self) -> Result<(), LostError> {
        self.buffer.reserve(READ_SIZE);
        match self.half.read_buf(&mut self.buffer).await {
            Ok(0) => Err(LostError::Closed),
            Ok(_) => Ok(()),
            Err(error) => Err(LostError::Io(error)),
        }
    }

    /// The next packet, if it is complete.
    pub(super) fn next(&mut self) -> Result<Option<Incoming>, LostError> {
        packet::next(&mut self.buffer, MAX_INCOMING)
    }
}

impl Writer {
    /// The bytes that wait to be written.
    pub(super) fn waiting(&self) -> usize {
        self.buffer.len()
    }

    pub(super) fn is_idle(&self) -> bool {
        self.buffer.is_empty() && !self.needs_flush
    }

    /// Writes a part of what waits. Cancel-safe.
    pub(super) async fn write_some(&mut self) -> Result<(), LostError> {
        let written = async {
            if self.buffer.is_empty() {
                self.half.flush().await?;
                self.needs_flush = false;
                return Ok(());
            }
            if self.half.write_buf(&mut self.buffer).await? == 0 {
                return Err(io::Error::from(io::ErrorKind::WriteZero));
            }
            self.needs_flush = true;
            Ok(())
        };
        written.await.map_err(LostError::Io)
    }

    /// Sends a message with QoS 1.
    pub(super) fn publish(&mut self, id: u16, message: &Message) -> Result<(), TooLarge> {
        let properties = message.correlation.as_ref().map(|correlation| PublishProperties {
            correlation_data: Some(correlation.clone()),
            ..PublishProperties::default()
        });
        let publish = Publish {
            dup: false,
            qos: QoS::AtLeastOnce,
            retain: message.retain && self.retain,
            topic: message.topic.clone(),
            pkid: id,
            payload: message.payload.clone(),
            properties,
        };
        let size = publish.size();
        if size > self.max_packet {
            return Err(TooLarge { size, limit: self.max_packet });
        }
        self.send(&Packet::Publish(publish));
        Ok(())
    }

    pub(super) fn subscribe(&mut self, id: u16, filters: &[Filter]) {
        let filters = filters.iter().map(|filter| rumqttc::v5::mqttbytes::v5::Filter {
            path: filter.path.clone(),
            qos: QoS::AtLeastOnce,
            nolocal: false,
            preserve_retain: filter.as_published,
            retain_forward_rule: RetainForwardRule::OnEverySubscribe,
        });
        self.send(&Packet::Subscribe(Subscribe { pkid: id, filters: filters.collect(), properties: None }));
    }

    pub(super) fn unsubscribe(&mut self, id: u16, filters: Vec<String>) {
        self.send(&Packet::Unsubscribe(Unsubscribe { pkid: id, filters, properties: None }));
    }

    pub(super) fn acknowledge(&mut self, id: u16) {
        self.send(&Packet::PubAck(PubAck::new(id, None)));
    }

    pub(super) fn ping(&mut self) {
        self.send(&Packet::PingReq(rumqttc::v5::mqttbytes::v5::PingReq));
    }

    /// Ends the connection; the broker does not publish the will.
    pub(super) fn disconnect(&mut self) {
        self.send(&Packet::Disconnect(Disconnect::new(DisconnectReasonCode::NormalDisconnection)));
    }

    fn send(&mut self, packet: &Packet) {
        // Sizes were checked, and packets have an id: there is no other error.
        if let Err(error) = packet.write(&mut self.buffer, None) {
            tracing::error!(%error, "a packet cannot be encoded");
        }
    }
}

#[cfg(test)]
mod tests {
    use rumqttc::v5::mqttbytes::v5::ConnAckProperties;

    use super::*;

    fn ack(code: ConnectReturnCode, change: impl FnOnce(&mut ConnAckProperties)) -> ConnAck {
        let mut properties = ConnAckProperties {
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
        };
        change(&mut properties);
        ConnAck { session_present: false, code, properties: Some(properties) }
    }

    #[test]
    fn the_limits_of_the_broker_are_kept() {
        let ok = ConnectReturnCode::Success;
        let default = Limits { in_flight: 512, packet: MAX_PACKET, retain: true, keep_alive: KEEP_ALIVE };
        assert_eq!(limits(&ack(ok, |_| ())).unwrap(), default);
        let limited = limits(&ack(ok, |all| {
            all.receive_max = Some(20);
            all.max_packet_size = Some(2000);
            all.retain_available = Some(0);
            all.server_keep_alive = Some(5);
        }));
        let expected = Limits { in_flight: 20, packet: 2000, retain: false, keep_alive: Duration::from_secs(5) };
        assert_eq!(limited.unwrap(), expected);
        assert_eq!(limits(&ack(ok, |all| all.receive_max = Some(0))).unwrap().in_flight, 1);
        assert_eq!(limits(&ack(ok, |all| all.server_keep_alive = Some(0))).unwrap().keep_alive, KEEP_ALIVE);
        assert!(matches!(limits(&ack(ok, |all| all.max_qos = Some(0))), Err(ConnectError::NoAcknowledgements)));
        let refused = limits(&ack(ConnectReturnCode::BadUserNamePassword, |_| ()));
        assert!(refused.unwrap_err().to_string().contains("user name or password"));
    }
}
