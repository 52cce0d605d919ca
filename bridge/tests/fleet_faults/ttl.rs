//! Expiry of sessions by the server, for the naive variant that relies on it.
//!
//! nats-server 2.9 expires no single key, so a task does it in place of the server: it ends sessions whose entry is a
//! lease old by the wall clock of the server, and frees their links. That clock steps at a start of the server, as on
//! a machine that sets it by the network.

use std::collections::BTreeSet;
use std::sync::{Arc, Mutex};
use std::time::{Duration, SystemTime};

use async_nats::jetstream::{self, Context};
use tokio::task::JoinHandle;
use tokio::time::{sleep, timeout};

use super::plan::LEASE;
use super::proxy::Sessions;
use super::recorder::STREAM;

/// The steps of the clock: at a time, by a time, in nanoseconds.
type Steps = Arc<Mutex<Vec<(i128, i128)>>>;

/// The task.
pub(crate) struct Expiry {
    steps: Steps,
    task: JoinHandle<()>,
}

impl Expiry {
    pub(crate) fn start(port: u16, sessions: Sessions, links: Vec<String>) -> Self {
        let steps = Steps::default();
        let clock = steps.clone();
        let task = tokio::spawn(async move {
            let options = async_nats::ConnectOptions::new().retry_on_initial_connect();
            let client = options.connect(format!("nats://127.0.0.1:{port}")).await.unwrap();
            let (context, mut ended) = (jetstream::new(client), BTreeSet::new());
            loop {
                sleep(LEASE / 10).await;
                let names: Vec<String> = sessions.lock().unwrap().keys().cloned().collect();
                for name in names.iter().filter(|name| !ended.contains(*name)).cloned().collect::<Vec<_>>() {
                    // Without an answer the server is away.
                    let expiring = timeout(LEASE, expire(&context, &clock, &name, &links)).await;
                    if expiring.is_ok_and(|is_over| is_over) {
                        ended.insert(name);
                    }
                }
            }
        });
        Self { steps, task }
    }

    /// The wall clock of the server steps forward.
    pub(crate) fn step(&self, by: Duration) {
        self.steps.lock().unwrap().push((wall(), i128::try_from(by.as_nanos()).unwrap()));
    }
}

impl Drop for Expiry {
    fn drop(&mut self) {
        self.task.abort();
    }
}

fn wall() -> i128 {
    let since = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap();
    i128::try_from(since.as_nanos()).unwrap()
}

/// Ends a session that is too old. Returns whether it is over.
async fn expire(context: &Context, clock: &Steps, name: &str, links: &[String]) -> bool {
    let Ok(stream) = context.get_stream(STREAM).await else { return false };
    let subject = format!("$KV.leases.w.{name}");
    let Ok(entry) = stream.get_last_raw_message_by_subject(&subject).await else { return false };
    let stored = entry.time.unix_timestamp_nanos();
    let stepped: i128 = clock.lock().unwrap().iter().filter(|(at, _)| *at > stored).map(|(_, by)| by).sum();
    if &*entry.payload == b"dead" {
        return true;
    }
    if wall() + stepped - stored < i128::try_from(LEASE.as_nanos()).unwrap() {
        return false;
    }
    let mut is_done = put(context, subject, "dead").await;
    for link in links {
        let subject = format!("$KV.leases.l.{link}");
        let owner = stream.get_last_raw_message_by_subject(&subject).await;
        if owner.is_ok_and(|owner| &*owner.payload == name.as_bytes()) {
            is_done &= put(context, subject, "").await;
        }
    }
    is_done
}

async fn put(context: &Context, subject: String, value: &'static str) -> bool {
    match context.publish(subject, value.into()).await {
        Ok(ack) => ack.await.is_ok(),
        Err(_) => false,
    }
}
