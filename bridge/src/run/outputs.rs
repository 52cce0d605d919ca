//! The tasks of the outputs.

use std::collections::HashMap;
use std::time::Duration;

use tokio::task::{AbortHandle, Id, JoinError, JoinSet};
use tokio::time::timeout;
use tokio_util::sync::CancellationToken;

use super::Bridge;
use crate::config::Config;
use crate::output::mqtt::{self, MqttParts};
use crate::output::nats::{self, NatsParts};
use crate::output::stdout;

/// The time in which an output must end: it says goodbye to its server.
const GOODBYE: Duration = Duration::from_secs(2);

/// The running outputs.
#[derive(Debug, Default)]
pub(super) struct Outputs {
    tasks: JoinSet<()>,
    running: HashMap<Id, Running>,
    /// Outputs that have panicked while another one was waited for.
    panicked: Vec<&'static str>,
}

#[derive(Debug)]
struct Running {
    name: &'static str,
    stop: CancellationToken,
    abort: AbortHandle,
}

impl Outputs {
    /// Starts the outputs of the configuration.
    pub(super) fn start(bridge: &Bridge) -> Self {
        let mut outputs = Self::default();
        bridge.outputs.iter().for_each(|health| outputs.start_one(bridge, health.name(), None));
        outputs
    }

    /// Waits until an output has panicked, and returns its name. Cancel-safe.
    pub(super) async fn panicked(&mut self) -> &'static str {
        loop {
            if let Some(name) = self.panicked.pop() {
                return name;
            }
            match self.tasks.join_next_with_id().await {
                None => std::future::pending().await,
                Some(ended) => self.note(ended),
            }
        }
    }

    /// Notes that a task has ended: by itself, such as stdout, by an abort, or by a panic.
    fn note(&mut self, ended: Result<(Id, ()), JoinError>) {
        let id = match &ended {
            Ok((id, ())) => *id,
            Err(error) => error.id(),
        };
        let name = self.running.remove(&id).map_or("output", |ended| ended.name);
        if ended.is_err_and(|error| error.is_panic()) {
            self.panicked.push(name);
        }
    }

    /// Starts those outputs anew whose settings are others. Returns their names.
    pub(super) async fn restart_changed(&mut self, bridge: &Bridge, old: &Config, new: &Config) -> Vec<&'static str> {
        let is_changed = |name: &str| match name {
            "mqtt" => old.mqtt != new.mqtt,
            "nats" => old.nats != new.nats,
            _ => false,
        };
        let names = bridge.outputs.iter().map(|health| health.name());
        let changed: Vec<&'static str> = names.filter(|name| is_changed(name)).collect();
        for name in &changed {
            self.stop_one(name).await;
            self.start_one(bridge, name, Some(old));
        }
        changed
    }

    /// Ends all outputs; those that do not end within 2 s are aborted.
    pub(super) async fn stop(mut self) {
        self.running.values().for_each(|running| running.stop.cancel());
        let ended = async { while self.tasks.join_next().await.is_some() {} };
        if timeout(GOODBYE, ended).await.is_err() {
            tracing::warn!("an output did not end within {GOODBYE:?}");
        }
    }

    /// `old`: the configuration before a reload.
    fn start_one(&mut self, bridge: &Bridge, name: &'static str, old: Option<&Config>) {
        let Some(number) = bridge.outputs.iter().position(|health| health.name() == name) else { return };
        let Some(health) = bridge.outputs.get(number).cloned() else { return };
        let (config, stop) = (bridge.config(), CancellationToken::new());
        let mut cursor = bridge.buffer.cursor(number);
        // An earlier task may have read batches that it did not deliver.
        cursor.rewind();
        let (id, registry, commands) = (config.bridge.id.clone(), bridge.registry.clone(), bridge.commands.clone());
        let task = match name {
            "stdout" => self.tasks.spawn(stdout::run(cursor, health, stop.clone())),
            "mqtt" => {
                let Some(section) = config.mqtt.clone() else { return };
                let commands = commands.filter(|_| section.write).map(|commands| commands.of_output(name));
                let former = old.and_then(|old| old.mqtt.clone());
                let parts = MqttParts { id, registry, former, cursor, health, commands, stop: stop.clone() };
                self.tasks.spawn(mqtt::run(section, parts))
            }
            "nats" => {
                let Some(section) = config.nats.clone() else { return };
                let commands = commands.filter(|_| section.write).map(|commands| commands.of_output(name));
                let parts = NatsParts { id, registry, cursor, health, commands, stop: stop.clone() };
                self.tasks.spawn(nats::run(section, parts))
            }
            // The configuration knows no other output.
            _ => return,
        };
        self.running.insert(task.id(), Running { name, stop, abort: task });
    }

    /// Ends an output. One that does not end in time is aborted: two tasks must never share a cursor.
    async fn stop_one(&mut self, name: &str) {
        let Some((&id, running)) = self.running.iter().find(|(_, running)| running.name == name) else { return };
        running.stop.cancel();
        let abort = running.abort.clone();
        if timeout(GOODBYE, self.join(id)).await.is_err() {
            tracing::warn!(output = name, "the output did not end within {GOODBYE:?}");
            abort.abort();
            self.join(id).await;
        }
    }

    /// Waits until a task has ended.
    async fn join(&mut self, id: Id) {
        while self.running.contains_key(&id)
            && let Some(ended) = self.tasks.join_next_with_id().await
        {
            self.note(ended);
        }
    }
}
