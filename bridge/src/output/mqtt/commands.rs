//! Commands that come over MQTT: their topics, and where their replies go. No I/O.

use bytes::Bytes;

use super::connection::Message;
use crate::topic::Topics;

/// The longest topic of a reply that is used.
const MAX_TOPIC: usize = 1024;
/// The most correlation data that is repeated.
const MAX_CORRELATION: usize = 1024;

/// Where the reply of a command goes.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct ReplyTo {
    topic: Bytes,
    correlation: Option<Bytes>,
}

impl ReplyTo {
    /// The response topic of a command, or the one of its PLC.
    ///
    /// A client that may send commands must not write to other topics by them: the topics of the bridge itself,
    /// those of discovery, and those that begin with `$` are not used.
    pub(super) fn new(
        topics: &Topics,
        discovery: Option<&str>,
        plc: &str,
        response: Option<&str>,
        correlation: Option<Bytes>,
    ) -> Self {
        let own = topics.replies(plc);
        let is_below = |topic: &str, base: &str| topic.strip_prefix(base).is_some_and(|rest| rest.starts_with('/'));
        let is_allowed = |topic: &str| {
            topic == own
                || is_topic(topic)
                    && !is_below(topic, topics.base())
                    && !discovery.is_some_and(|prefix| is_below(topic, prefix))
        };
        let response = response.filter(|topic| is_allowed(topic));
        let correlation = correlation.filter(|data| data.len() <= MAX_CORRELATION);
        Self { topic: Bytes::copy_from_slice(response.unwrap_or(&own).as_bytes()), correlation }
    }

    /// The message with a reply.
    pub(super) fn message(self, payload: Bytes) -> Message {
        Message { topic: self.topic, payload, retain: false, correlation: self.correlation }
    }
}

/// Returns whether a text is a topic that a client may publish to.
fn is_topic(text: &str) -> bool {
    (1..=MAX_TOPIC).contains(&text.len()) && !text.starts_with('$') && !text.contains(['+', '#', '\0'])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Name;

    #[test]
    fn a_reply_goes_to_the_response_topic_unless_that_is_not_the_clients_to_use() {
        let topics = Topics::mqtt(&Name::constant("fatek"), &Name::constant("hall-2"));
        let long = "a".repeat(MAX_TOPIC + 1);
        let own = "fatek/hall-2/mixer/cmd/reply";
        for (response, expected) in [
            (None, own),
            (Some("client-7/replies"), "client-7/replies"),
            (Some("/"), "/"),
            (Some(own), own),
            (Some("fatek/hall-20/state"), "fatek/hall-20/state"),
            // Not topics.
            (Some(""), own),
            (Some("a/+/b"), own),
            (Some("#"), own),
            (Some("a\0b"), own),
            (Some("$SYS/broker"), own),
            (Some(long.as_str()), own),
            // Of the bridge.
            (Some("fatek/hall-2/state"), own),
            (Some("fatek/hall-2/boiler/cmd"), own),
            (Some("fatek/hall-2/mixer/data"), own),
            (Some("homeassistant/sensor/x/config"), own),
        ] {
            let reply = ReplyTo::new(&topics, Some("homeassistant"), "mixer", response, None);
            assert_eq!(reply.message("{}".into()).topic, expected, "{response:?}");
        }
    }

    #[test]
    fn correlation_data_is_repeated_up_to_a_limit() {
        let topics = Topics::mqtt(&Name::constant("fatek"), &Name::constant("hall-2"));
        for (length, expected) in [(0, true), (MAX_CORRELATION, true), (MAX_CORRELATION + 1, false)] {
            let data = Bytes::from(vec![0xFF; length]);
            let reply = ReplyTo::new(&topics, None, "mixer", Some("r"), Some(data.clone()));
            assert_eq!(reply.correlation, expected.then_some(data));
        }
    }
}
