//! A client that subscribes to a broker.

use std::time::Duration;

use rumqttc::v5::mqttbytes::QoS;
use rumqttc::v5::{AsyncClient, Event, Incoming, MqttOptions};
use serde_json::Value;
use tokio::sync::mpsc;
use tokio::time::{sleep, timeout};

use super::bridge::PATIENCE;
use super::mosquitto::Mosquitto;

/// A client that receives messages of a filter: topic, content, and whether the broker had kept it.
pub struct Subscriber {
    pub messages: mpsc::UnboundedReceiver<(String, Value, bool)>,
    task: tokio::task::JoinHandle<()>,
}

impl Subscriber {
    /// Subscribes, also again after the broker was restarted.
    pub async fn start(mosquitto: &Mosquitto, filter: &str) -> Self {
        // Each has its own id.
        let id = format!("subscriber-{}", fastrand::u64(..));
        let mut options = MqttOptions::new(id, "127.0.0.1", mosquitto.port());
        options.set_keep_alive(Duration::from_secs(5));
        let (client, mut events) = AsyncClient::new(options, 10);
        let (sender, messages) = mpsc::unbounded_channel();
        let (subscribed, mut is_subscribed) = mpsc::unbounded_channel();
        let filter = filter.to_owned();
        let task = tokio::spawn(async move {
            loop {
                match events.poll().await {
                    Ok(Event::Incoming(Incoming::ConnAck(_))) => {
                        client.subscribe(filter.clone(), QoS::AtLeastOnce).await.unwrap();
                    }
                    Ok(Event::Incoming(Incoming::SubAck(_))) => drop(subscribed.send(())),
                    Ok(Event::Incoming(Incoming::Publish(publish))) => {
                        let topic = String::from_utf8(publish.topic.to_vec()).unwrap();
                        let content = serde_json::from_slice(&publish.payload).unwrap_or(Value::Null);
                        let _ = sender.send((topic, content, publish.retain));
                    }
                    Ok(_) => {}
                    Err(_) => sleep(Duration::from_millis(50)).await,
                }
            }
        });
        is_subscribed.recv().await.unwrap();
        Self { messages, task }
    }

    /// Waits for a message for which this holds.
    pub async fn wait_for(&mut self, what: &str, holds: impl Fn(&str, &Value) -> bool) -> (String, Value, bool) {
        let waiting = async {
            loop {
                let message = self.messages.recv().await.unwrap();
                if holds(&message.0, &message.1) {
                    return message;
                }
            }
        };
        // Present values can take 25 s on a quiet machine.
        let limit = PATIENCE * 3;
        timeout(limit, waiting).await.unwrap_or_else(|_| panic!("{what}: not within {limit:?}"))
    }
}

impl Drop for Subscriber {
    fn drop(&mut self) {
        self.task.abort();
    }
}
