//! Reload: the configuration is read again, and the difference is applied.

use super::outputs::Outputs;
use super::{AddError, Bridge, Membership, fleet};
use crate::command::Commands;
use crate::config::{Config, ConfigError, FleetSection, NatsSection, StoredPlant};
use crate::output::OutputKind;
use crate::registry::Share;

/// A configuration that is not in force: the one before still is.
#[derive(Debug, thiserror::Error)]
pub enum ReloadError {
    /// It cannot be used.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// A PLC cannot be polled.
    #[error(transparent)]
    Add(#[from] AddError),
    /// The reload has panicked.
    #[error("the reload has failed: this is a fault of the bridge")]
    Panicked,
}

/// Reads the file again and applies the difference: by PLC and tag, and by output. A fault changes nothing.
///
/// Outputs that are new or gone, and the section `bridge`, need a restart: a warning names them.
///
/// # Errors
/// [`ReloadError`], which is in the log, too.
pub(super) async fn reload(bridge: &Bridge, outputs: &mut Outputs) -> Result<(), ReloadError> {
    let result = apply(bridge, outputs, Config::reload).await;
    if let Err(error) = &result {
        tracing::error!("the configuration was not reloaded, and nothing has changed");
        error.to_string().lines().for_each(|line| tracing::error!("{line}"));
    }
    result
}

/// Applies the difference to a plant of the store of the fleet. A fault changes nothing.
///
/// # Errors
/// [`ReloadError`].
pub(super) async fn take_plant(bridge: &Bridge, outputs: &mut Outputs, plant: StoredPlant) -> Result<(), ReloadError> {
    apply(bridge, outputs, move |config| config.with_plant(plant)).await
}

/// Applies the difference to a configuration that is made of the present one. `make` may block.
async fn apply(
    bridge: &Bridge,
    outputs: &mut Outputs,
    make: impl FnOnce(&Config) -> Result<Config, ConfigError> + Send + 'static,
) -> Result<(), ReloadError> {
    // The share of a member of a fleet is of one configuration.
    let _changing = bridge.changing.lock().await;
    let old = bridge.config();
    let membership = bridge.fleet.clone();
    let (registry, pool, poller) = (bridge.registry.clone(), bridge.pool.clone(), bridge.poller.clone());
    let (runtime, commands) = (tokio::runtime::Handle::current(), bridge.commands.clone());
    // Files are read and thousands of tags planned: that blocks.
    let applied = tokio::task::spawn_blocking(move || {
        let _runtime = runtime.enter();
        let mut config = make(&old)?;
        let needs_restart =
            keep_fixed(&mut config, &old, membership.as_ref().map(Membership::nats), commands.is_some());
        // No output writes a tag that its new section does not let it write, or its old one.
        allow(commands.as_ref(), |output| config.takes_commands(output) && old.takes_commands(output));
        let owned = match &membership {
            Some(membership) => {
                fleet::check(&config.plant, &config.bridge)?;
                Some(membership.owned_plcs(&config.plant))
            }
            None => None,
        };
        let share = owned.as_ref().map_or(Share::All, Share::Owned);
        let applied = registry.apply_share(&config.plant, share, &pool, &poller);
        let in_force = if applied.is_ok() { &config } else { &*old };
        allow(commands.as_ref(), |output| in_force.takes_commands(output));
        let changes = applied?;
        Ok::<_, ReloadError>((config, changes, needs_restart, old))
    });
    let (config, changes, needs_restart, old) = applied.await.map_err(|_| ReloadError::Panicked)??;
    bridge.set_config(config);
    if let Some(membership) = &bridge.fleet {
        membership.configure(&bridge.config());
    }
    let restarted = outputs.restart_changed(bridge, &old, &bridge.config()).await;
    tracing::info!("reloaded; {changes}");
    restarted.iter().for_each(|output| tracing::info!(output = output.name(), "the output was started anew"));
    needs_restart.iter().for_each(|what| tracing::warn!("{what} is in force after a restart of the bridge"));
    Ok(())
}

/// Sets which outputs take commands.
fn allow(commands: Option<&Commands>, takes_commands: impl Fn(OutputKind) -> bool) {
    if let Some(commands) = commands {
        commands.allow(takes_commands);
    }
}

/// Keeps the settings that cannot change while the bridge runs. Returns the names of those that differ.
///
/// `store`: the section of the server that the fleet uses. `takes_commands`: the bridge was started with an output that
/// takes commands.
fn keep_fixed(
    config: &mut Config,
    old: &Config,
    store: Option<&NatsSection>,
    takes_commands: bool,
) -> Vec<&'static str> {
    let mut differ = Vec::new();
    if config.bridge != old.bridge {
        config.bridge = old.bridge.clone();
        differ.push("section bridge");
    }
    if let (Some(fleet), Some(before)) = (&mut config.fleet, &old.fleet) {
        // The weight alone can change.
        let kept = FleetSection { weight: fleet.weight, ..before.clone() };
        if *fleet != kept {
            *fleet = kept;
            differ.push("section fleet, but for its weight,");
        }
    } else if config.fleet.is_some() != old.fleet.is_some() {
        config.fleet.clone_from(&old.fleet);
        differ.push("section fleet, which is new or gone,");
    }
    if let (Some(nats), Some(before)) = (&config.nats, store) {
        // The output takes the new section. The fleet keeps its connection, which needs none of these.
        let NatsSection { prefix, stream, write, .. } = nats.clone();
        if *nats != (NatsSection { prefix, stream, write, ..before.clone() }) {
            differ.push("for the fleet, section nats");
        }
    }
    if config.mqtt.is_some() != old.mqtt.is_some() {
        config.mqtt.clone_from(&old.mqtt);
        differ.push("section mqtt, which is new or gone,");
    }
    if config.nats.is_some() != old.nats.is_some() {
        config.nats.clone_from(&old.nats);
        differ.push("section nats, which is new or gone,");
    }
    if config.stdout.is_some() != old.stdout.is_some() {
        config.stdout = old.stdout;
        differ.push("section stdout, which is new or gone,");
    }
    // The file of the commands is opened at the start.
    let writes = [config.mqtt.as_mut().map(|mqtt| &mut mqtt.write), config.nats.as_mut().map(|nats| &mut nats.write)];
    for write in writes.into_iter().flatten().filter(|write| **write && !takes_commands) {
        *write = false;
        differ.push("write = true");
    }
    differ
}

#[cfg(test)]
mod tests {
    use super::*;

    const PLANT: &str = "[plc.mixer]\nlink = 'tcp://127.0.0.1:9'\nstation = 1\n";

    fn config(text: &str) -> Config {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("plant.toml");
        std::fs::write(&path, format!("{text}{PLANT}")).unwrap();
        Config::load(&path).unwrap()
    }

    /// The output moved to another server, the fleet stayed, and nothing said so.
    #[test]
    fn a_fleet_stays_with_its_server_until_a_restart() {
        let with = |nats: &str| config(&format!("[nats]\n{nats}\n[fleet]\nid = 'plant-a'\n"));
        let (a, b) = ("url = 'nats://a'", "url = 'nats://b'");
        let store = with(a).nats.unwrap();
        let differ = |old: &str, new: &str| keep_fixed(&mut with(new), &with(old), Some(&store), false);
        assert_eq!(differ(a, b), ["for the fleet, section nats"]);
        assert_eq!(differ(b, b), ["for the fleet, section nats"], "it still is");
        assert_eq!(differ(b, a), [""; 0]);
        assert_eq!(differ(a, "url = 'nats://a'\nprefix = 'hall'\nstream = 'HALL'"), [""; 0]);
        let alone = |nats: &str| config(&format!("[nats]\n{nats}\n"));
        assert_eq!(keep_fixed(&mut alone(b), &alone(a), None, false), [""; 0]);
    }
}
