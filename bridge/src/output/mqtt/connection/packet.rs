//! Packets of the broker: frames, and their content as far as the bridge needs it.

use bytes::{Buf as _, Bytes, BytesMut};
use rumqttc::v5::mqttbytes::QoS;
use rumqttc::v5::mqttbytes::v5::{Packet, Publish, SubscribeReasonCode};

use super::error::LostError;

/// A packet of the broker.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(in crate::output::mqtt) enum Incoming {
    /// PUBACK.
    Ack {
        /// The packet id.
        id: u16,
        /// Its reason.
        ack: Ack,
    },
    /// SUBACK, with a reason for each filter that was not accepted.
    Subscribed {
        /// The packet id.
        id: u16,
        /// For each filter, in their order, why it was not accepted.
        refused: Vec<Option<String>>,
    },
    /// UNSUBACK.
    Unsubscribed {
        /// The packet id.
        id: u16,
    },
    /// PUBLISH.
    Message {
        /// The packet id to acknowledge; `None` with QoS 0.
        id: Option<u16>,
        /// The topic.
        topic: String,
        /// The payload.
        payload: Bytes,
        /// `true` if the broker had kept it, or, of some filters, if the publisher has asked it to.
        retain: bool,
        /// The topic of the reply.
        response: Option<String>,
        /// The data that the reply repeats.
        correlation: Option<Bytes>,
    },
    /// PINGRESP.
    Pong,
}

/// The reason of a PUBACK.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::output::mqtt) enum Ack {
    /// The broker has the message.
    Taken,
    /// The broker has thrown it away: it has no subscriber.
    NoSubscribers,
    /// The broker can never take this message, with this reason.
    Never(u8),
    /// The broker does not take it now, with this reason.
    Refused(u8),
}

/// A message to the broker.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(in crate::output::mqtt) struct Message {
    pub(in crate::output::mqtt) topic: Bytes,
    pub(in crate::output::mqtt) payload: Bytes,
    pub(in crate::output::mqtt) retain: bool,
    pub(in crate::output::mqtt) correlation: Option<Bytes>,
}

impl Ack {
    fn of(reason: u8) -> Self {
        match reason {
            0x00 => Self::Taken,
            0x10 => Self::NoSubscribers,
            // Topic name invalid, packet too large, payload format invalid.
            0x90 | 0x95 | 0x99 => Self::Never(reason),
            _ => Self::Refused(reason),
        }
    }

    /// The name of a reason of MQTT 5 by which a PUBACK refuses a message.
    pub(in crate::output::mqtt) fn reason_name(reason: u8) -> String {
        let name = match reason {
            0x83 => "implementation specific error",
            0x87 => "not authorized",
            0x90 => "topic name invalid",
            0x91 => "packet identifier in use",
            0x95 => "packet too large",
            0x97 => "quota exceeded",
            0x99 => "payload format invalid",
            _ => "unspecified error",
        };
        format!("{name} (0x{reason:02X})")
    }
}

/// The first byte and the lengths of a frame.
#[derive(Clone, Copy, Debug)]
struct Frame {
    kind: u8,
    header: usize,
    body: usize,
}

/// Looks for a complete frame at the begin of a buffer.
fn frame(buffer: &[u8], max: u32) -> Result<Option<Frame>, LostError> {
    let Some((first, rest)) = buffer.split_first() else { return Ok(None) };
    let mut body = 0usize;
    for (place, byte) in rest.iter().take(4).enumerate() {
        body |= usize::from(byte & 0x7F) << (7 * place);
        if byte & 0x80 == 0 {
            if body > max as usize {
                return Err(LostError::Malformed(format!("a packet of {body} bytes: {max} are the limit")));
            }
            let header = place.saturating_add(2);
            let is_complete = buffer.len() >= header.saturating_add(body);
            return Ok(is_complete.then_some(Frame { kind: first >> 4, header, body }));
        }
    }
    if rest.len() >= 4 {
        return Err(LostError::Malformed("the length of a packet has more than 4 bytes".to_owned()));
    }
    Ok(None)
}

/// Takes a packet of `rumqttc` from a buffer, if it is complete.
pub(super) fn next_raw(buffer: &mut BytesMut, max: u32) -> Result<Option<Packet>, LostError> {
    let Some(frame) = frame(buffer, max)? else { return Ok(None) };
    // A packet that misses a part of its content must not take it from the next one.
    let mut one = buffer.split_to(frame.header.saturating_add(frame.body));
    Packet::read(&mut one, None).map(Some).map_err(|error| LostError::Malformed(error.to_string()))
}

/// Takes a packet from a buffer, if it is complete.
pub(super) fn next(buffer: &mut BytesMut, max: u32) -> Result<Option<Incoming>, LostError> {
    const PUBACK: u8 = 4;
    const DISCONNECT: u8 = 14;
    let Some(frame) = frame(buffer, max)? else { return Ok(None) };
    if frame.kind == PUBACK {
        let mut packet = buffer.split_to(frame.header.saturating_add(frame.body));
        packet.advance(frame.header);
        return puback(&packet).map(Some);
    }
    if frame.kind == DISCONNECT {
        let reason = buffer.get(frame.header).copied().filter(|_| frame.body > 0);
        return Err(LostError::Disconnected(reason.unwrap_or(0)));
    }
    let Some(packet) = next_raw(buffer, max)? else { return Ok(None) };
    let incoming = match packet {
        Packet::Publish(publish) => message(publish)?,
        Packet::SubAck(ack) => {
            let is_ok = |code: &SubscribeReasonCode| matches!(code, SubscribeReasonCode::Success(_));
            let refused = |code: &SubscribeReasonCode| (!is_ok(code)).then(|| format!("{code:?}"));
            Incoming::Subscribed { id: ack.pkid, refused: ack.return_codes.iter().map(refused).collect() }
        }
        Packet::UnsubAck(ack) => Incoming::Unsubscribed { id: ack.pkid },
        Packet::PingResp(_) => Incoming::Pong,
        Packet::Auth(_)
        | Packet::Connect(..)
        | Packet::ConnAck(_)
        | Packet::PubAck(_)
        | Packet::PingReq(_)
        | Packet::Subscribe(_)
        | Packet::PubRec(_)
        | Packet::PubRel(_)
        | Packet::PubComp(_)
        | Packet::Unsubscribe(_)
        | Packet::Disconnect(_) => {
            return Err(LostError::Malformed(format!("a packet of kind {} that a broker does not send", frame.kind)));
        }
    };
    Ok(Some(incoming))
}

/// PUBACK: packet id, and a reason unless it is success.
fn puback(body: &[u8]) -> Result<Incoming, LostError> {
    match body {
        [high, low, rest @ ..] => {
            let reason = rest.first().copied().unwrap_or(0);
            Ok(Incoming::Ack { id: u16::from_be_bytes([*high, *low]), ack: Ack::of(reason) })
        }
        [] | [_] => Err(LostError::Malformed("a PUBACK without packet id".to_owned())),
    }
}

fn message(publish: Publish) -> Result<Incoming, LostError> {
    let Publish { qos, retain, topic, pkid, payload, properties, .. } = publish;
    let id = match qos {
        QoS::AtMostOnce => None,
        QoS::AtLeastOnce => Some(pkid),
        QoS::ExactlyOnce => {
            return Err(LostError::Malformed("a message with QoS 2: no filter asked for it".to_owned()));
        }
    };
    let topic =
        String::from_utf8(topic.to_vec()).map_err(|_| LostError::Malformed("a topic that is not UTF-8".to_owned()))?;
    let (response, correlation) = properties.map_or((None, None), |all| (all.response_topic, all.correlation_data));
    Ok(Incoming::Message { id, topic, payload, retain, response, correlation })
}

#[cfg(test)]
mod tests {
    use rumqttc::v5::mqttbytes::v5::PublishProperties;

    use super::*;

    const MAX: u32 = 1000;

    fn taken(bytes: &[u8]) -> (Result<Option<Incoming>, String>, usize) {
        let mut buffer = BytesMut::from(bytes);
        let taken = next(&mut buffer, MAX).map_err(|error| error.to_string());
        (taken, buffer.len())
    }

    #[test]
    fn a_puback_has_a_reason_of_any_kind() {
        let ack = |reason: &[u8]| {
            let body = [&[1, 2], reason].concat();
            match taken(&[&[0x40, u8::try_from(body.len()).unwrap()], &body[..]].concat()).0 {
                Ok(Some(Incoming::Ack { id: 0x0102, ack })) => ack,
                other => panic!("{other:?}"),
            }
        };
        assert_eq!(ack(&[]), Ack::Taken);
        assert_eq!(ack(&[0x00, 0]), Ack::Taken);
        assert_eq!(ack(&[0x10]), Ack::NoSubscribers);
        assert_eq!(ack(&[0x87, 0]), Ack::Refused(0x87));
        assert_eq!(ack(&[0x95]), Ack::Never(0x95));
        assert_eq!(ack(&[0xEE]), Ack::Refused(0xEE));
        assert_eq!(Ack::reason_name(0x87), "not authorized (0x87)");
    }

    #[test]
    fn a_message_has_the_topic_of_its_reply() {
        let properties = PublishProperties {
            response_topic: Some("reply/7".to_owned()),
            correlation_data: Some("c".into()),
            ..PublishProperties::default()
        };
        let mut publish = Publish::new("fatek/a/b/cmd", QoS::AtLeastOnce, "{}", Some(properties));
        (publish.pkid, publish.retain) = (9, true);
        let mut buffer = BytesMut::new();
        publish.write(&mut buffer).unwrap();
        let whole = buffer.to_vec();
        let expected = Incoming::Message {
            id: Some(9),
            topic: "fatek/a/b/cmd".to_owned(),
            payload: "{}".into(),
            retain: true,
            response: Some("reply/7".to_owned()),
            correlation: Some("c".into()),
        };
        assert_eq!(taken(&[&whole[..], &[0xD0]].concat()), (Ok(Some(expected)), 1));
        (0..whole.len()).for_each(|cut| assert_eq!(taken(&whole[..cut]), (Ok(None), cut)));
    }

    #[test]
    fn a_malformed_packet_ends_the_connection() {
        for (bytes, error) in [
            (&[0x40, 1, 0][..], "PUBACK without packet id"),
            (&[0x30, 0xFF, 0xFF, 0xFF, 0x7F], "limit"),
            (&[0x30, 0xFF, 0xFF, 0xFF, 0xFF], "more than 4 bytes"),
            (&[0x34, 6, 0, 1, b'a', 0, 1, 0], "QoS 2"),
            (&[0x30, 4, 0, 1, 0xFF, 0], "not UTF-8"),
            // The content ends before its fields do: they are not taken from the next packet.
            (&[0x30, 2, 0, 9, 0xD0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0], "malformed packet"),
            (&[0xC0, 0], "kind 12"),
            (&[0xE0, 0], "broker has ended"),
            (&[0xE0, 1, 0x8E], "0x8E"),
        ] {
            let (taken, _) = taken(bytes);
            let text = taken.unwrap_err();
            assert!(text.contains(error), "{bytes:02X?}: {text}");
        }
        assert_eq!(taken(&[0xD0, 0]).0, Ok(Some(Incoming::Pong)));
    }

    #[test]
    fn no_bytes_cause_a_panic() {
        let mut random = fastrand::Rng::with_seed(7);
        for _ in 0..200_000 {
            let length = random.usize(0..40);
            let mut bytes: Vec<u8> = (0..length).map(|_| random.u8(..)).collect();
            // Mostly packets with a good length, which reach the decoder of their content.
            if let [first, second, ..] = bytes.as_mut_slice() {
                *second = u8::try_from(length - 2).unwrap();
                *first = *random.choice([0x20, 0x30, 0x32, 0x40, 0x90, 0xB0, 0xD0, 0xE0, *first].iter()).unwrap();
            }
            let mut buffer = BytesMut::from(&bytes[..]);
            while let Ok(Some(_)) = next(&mut buffer, MAX) {}
        }
    }
}
