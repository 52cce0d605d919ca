//! The tasks of the outputs.

use std::collections::HashMap;
use std::time::Duration;

use tokio::task::{AbortHandle, Id, JoinError, JoinSet};
use tokio::time::timeout;
use tokio_util::sync::CancellationToken;

use super::Bridge;
use crate::config::Config;
use crate::output::{BridgeNames, OutputKind, OutputParts, mqtt, nats, stdout};

/// The time in which an output must end. It publishes the last states before: to MQTT for 4 s and 0.5 s for
/// DISCONNECT, to NATS for 2 s.
const GOODBYE: Duration = Duration::from_secs(5);

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
    output: OutputKind,
    stop: CancellationToken,
    abort: AbortHandle,
}

impl Outputs {
    /// Starts the outputs of the configuration.
    pub(super) fn start(bridge: &Bridge) -> Self {
        let mut outputs = Self::default();
        bridge.outputs.iter().for_each(|health| outputs.start_one(bridge, health.kind(), None));
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
        let name = self.running.remove(&id).map_or("output", |ended| ended.output.name());
        if ended.is_err_and(|error| error.is_panic()) {
            self.panicked.push(name);
        }
    }

    /// Starts those outputs anew whose settings are others. Returns them.
    pub(super) async fn restart_changed(&mut self, bridge: &Bridge, old: &Config, new: &Config) -> Vec<OutputKind> {
        let is_changed = |output: &OutputKind| match output {
            OutputKind::Stdout => false,
            OutputKind::Mqtt => old.mqtt != new.mqtt,
            OutputKind::Nats => old.nats != new.nats,
        };
        let changed: Vec<OutputKind> = bridge.outputs.iter().map(|health| health.kind()).filter(is_changed).collect();
        // All at once: each may wait for its server.
        let is_changed = |running: &&Running| changed.contains(&running.output);
        self.running.values().filter(is_changed).for_each(|running| running.stop.cancel());
        for output in &changed {
            self.stop_one(*output).await;
            self.start_one(bridge, *output, Some(old));
        }
        changed
    }

    /// Ends all outputs; those that do not end within 5 s are aborted.
    pub(super) async fn stop(mut self) {
        self.running.values().for_each(|running| running.stop.cancel());
        let ended = async { while self.tasks.join_next().await.is_some() {} };
        if timeout(GOODBYE, ended).await.is_err() {
            tracing::warn!("an output did not end within {GOODBYE:?}");
        }
    }

    /// `old`: the configuration before a reload.
    fn start_one(&mut self, bridge: &Bridge, output: OutputKind, old: Option<&Config>) {
        let config = bridge.config();
        let known = bridge.outputs.iter().enumerate().find(|(_, health)| health.kind() == output);
        let Some((number, health)) = known else { return unknown(output) };
        let mut cursor = bridge.buffer.cursor(number);
        // An earlier task may have read batches that it did not deliver.
        cursor.rewind();
        let takes_commands = config.takes_commands(output);
        let commands = bridge.commands.as_ref().filter(|_| takes_commands);
        let stop = CancellationToken::new();
        let parts = OutputParts {
            names: BridgeNames::of(&config),
            registry: bridge.registry.clone(),
            cursor,
            health: health.clone(),
            commands: commands.map(|commands| commands.of_output(output)),
            stop: stop.clone(),
        };
        let abort = match (output, config.mqtt.clone(), config.nats.clone()) {
            (OutputKind::Stdout, _, _) => {
                self.tasks.spawn(stdout::run(parts.cursor, parts.health, parts.registry, parts.stop))
            }
            (OutputKind::Mqtt, Some(section), _) => {
                let former = old.and_then(|old| old.mqtt.clone());
                self.tasks.spawn(mqtt::run(section, former, parts))
            }
            (OutputKind::Nats, _, Some(section)) => self.tasks.spawn(nats::run(section, parts)),
            (OutputKind::Mqtt, None, _) | (OutputKind::Nats, _, None) => return unknown(output),
        };
        self.running.insert(abort.id(), Running { output, stop, abort });
    }

    /// Ends an output. One that does not end in time is aborted: two tasks must never share a cursor.
    async fn stop_one(&mut self, output: OutputKind) {
        let Some((&id, running)) = self.running.iter().find(|(_, running)| running.output == output) else { return };
        running.stop.cancel();
        let abort = running.abort.clone();
        if timeout(GOODBYE, self.join(id)).await.is_err() {
            tracing::warn!(output = output.name(), "the output did not end within {GOODBYE:?}");
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

/// Reports an output that the configuration has not: a reload keeps their number.
fn unknown(output: OutputKind) {
    debug_assert!(false, "the configuration has no output {output:?}");
    tracing::error!(output = output.name(), "the output is not started: this is a fault of the bridge");
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Adds a task in the place of an output.
    fn add(outputs: &mut Outputs, output: OutputKind, task: impl Future<Output = ()> + Send + 'static) {
        let abort = outputs.tasks.spawn(task);
        outputs.running.insert(abort.id(), Running { output, stop: CancellationToken::new(), abort });
    }

    #[tokio::test(start_paused = true)]
    async fn an_output_that_does_not_end_is_aborted_before_the_next_one_starts() {
        let mut outputs = Outputs::default();
        let cursor = std::sync::Arc::new(());
        let held = cursor.clone();
        add(&mut outputs, OutputKind::Mqtt, async move {
            let _held = held;
            std::future::pending().await
        });
        outputs.stop_one(OutputKind::Mqtt).await;
        assert_eq!((std::sync::Arc::strong_count(&cursor), outputs.running.len()), (1, 0));
    }

    #[tokio::test(start_paused = true)]
    async fn a_panic_while_another_output_is_stopped_is_not_lost() {
        let mut outputs = Outputs::default();
        add(&mut outputs, OutputKind::Nats, async { panic!("a fault of an output") });
        add(&mut outputs, OutputKind::Mqtt, tokio::time::sleep(Duration::from_secs(1)));
        outputs.stop_one(OutputKind::Mqtt).await;
        let panicked = timeout(Duration::from_secs(1), outputs.panicked()).await;
        assert_eq!(panicked, Ok("nats"));
    }
}
