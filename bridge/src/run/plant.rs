//! The plant of a member whose `fleet.config` is `store`: loaded at the start, and whenever there is a new version.
//!
//! ```text
//! store ──version──▶ watch ──Update──▶ bridge: reload ──accepted──▶ copy in the state folder
//!   ▲                                     │
//!   └────────────── refusal ◀──faults─────┘
//! ```
//!
//! A member without the store starts with its copy: serial ports need no store. The copy is not more than that: the
//! version of the store takes its place as soon as it is there.

use std::path::{Path, PathBuf};
use std::time::Duration;

use tokio::sync::{mpsc, oneshot};
use tokio::time::sleep;

use super::reload::ReloadError;
use crate::config::{Config, ConfigError, Name, NatsSection, StoredPlant};
use crate::fleet::{PlantStore, PlantStoreError};

/// The delay before another attempt to connect.
const RECONNECT: Duration = Duration::from_secs(1);
/// The name of the copy in the state folder.
const COPY: &str = "fleet-plant.toml";

/// A member that has no plant to start with.
#[derive(Debug, thiserror::Error)]
pub enum PlantError {
    /// The store of the plant does not exist.
    #[error("{0}")]
    NoStore(String),
    /// The store has no plant.
    #[error("the store has no plant yet: fatek-bridge fleet push puts it there")]
    NoPlant,
    /// The plant cannot be used.
    #[error(transparent)]
    Config(#[from] ConfigError),
}

/// A new version, for the bridge.
#[derive(Debug)]
pub(super) struct Update {
    /// The version.
    pub(super) plant: StoredPlant,
    /// Takes the faults for which the bridge has refused it.
    pub(super) done: oneshot::Sender<Result<(), String>>,
}

/// The configuration with the plant of the store, if it is to have that. Waits for the store, unless there is a copy.
/// Cancel-safe.
///
/// # Errors
/// [`PlantError`] without a store or a plant, or with faults of the plant.
pub(super) async fn load(config: Config) -> Result<Config, PlantError> {
    let Some((nats, id, bucket)) = parts(&config) else { return Ok(config) };
    if config.plant.plcs().next().is_some() {
        tracing::info!("fleet: the PLCs of {} are not used: fleet.config is store", config.path.display());
    }
    let mut has_told = false;
    let plant = loop {
        let error = match PlantStore::open(&nats, &id, &bucket).await {
            Ok(store) => break store.current().cloned().ok_or(PlantError::NoPlant)?,
            Err(PlantStoreError::Missing(error)) => return Err(PlantError::NoStore(error)),
            Err(error) => error,
        };
        if let Some(text) = read_copy(&config).await {
            tracing::warn!("fleet: {}: {error}: starting with the copy of the plant in the state folder", nats.url);
            break StoredPlant { version: None, text: text.into() };
        }
        if !has_told {
            tracing::warn!("fleet: {}: {error}: waiting for the plant, of which there is no copy here", nats.url);
            has_told = true;
        }
        sleep(RECONNECT).await;
    };
    let loaded = config.with_plant(plant)?;
    if let Some(stored) = &loaded.stored {
        tracing::info!("fleet: {}", stored.name().display());
    }
    keep_copy(&loaded).await;
    Ok(loaded)
}

/// The server, the id of the member and the bucket of a configuration with a plant of the store.
fn parts(config: &Config) -> Option<(NatsSection, Name, Name)> {
    let (fleet, nats) = config.fleet.as_ref().zip(config.nats.as_ref())?;
    config.has_stored_plant().then(|| (nats.clone(), config.bridge.id.clone(), fleet.bucket.clone()))
}

/// Hands each new version to the bridge, and tells the store when it was refused. Ends with the receiver; without a
/// plant of the store it never sends.
pub(super) async fn watch(config: Config, updates: mpsc::Sender<Update>) {
    let Some((nats, id, bucket)) = parts(&config) else { return updates.closed().await };
    let mut known = config.stored.and_then(|stored| stored.version);
    let mut last_error = String::new();
    loop {
        let lost = match PlantStore::open(&nats, &id, &bucket).await {
            Ok(mut store) => {
                last_error.clear();
                match follow(&mut store, &id, &mut known, &updates).await {
                    Some(error) => error,
                    None => return,
                }
            }
            Err(error) => error,
        };
        let text = lost.to_string();
        if text != last_error {
            tracing::warn!("fleet: {}: the plant in the store: {text}", nats.url);
            last_error = text;
        }
        tokio::select! {
            () = sleep(RECONNECT) => {}
            () = updates.closed() => return,
        }
    }
}

/// Follows the versions over one connection. Returns why it was lost; `None` when the bridge ends.
async fn follow(
    store: &mut PlantStore,
    id: &Name,
    known: &mut Option<u64>,
    updates: &mpsc::Sender<Update>,
) -> Option<PlantStoreError> {
    loop {
        if let Some(plant) = store.current().filter(|plant| plant.version != *known).cloned() {
            *known = plant.version;
            let (done, result) = oneshot::channel();
            updates.send(Update { plant, done }).await.ok()?;
            // Without an answer, the bridge ends.
            if let Err(why) = result.await.ok()?
                && let Err(error) = store.refuse(id, &why).await
            {
                tracing::warn!("fleet: the refusal was not stored: {error}");
            }
        }
        tokio::select! {
            changed = store.changed() => match changed {
                Ok(()) => {}
                Err(error) => return Some(error),
            },
            () = updates.closed() => return None,
        }
    }
}

/// Logs the result of a version, keeps a copy of it, and answers.
pub(super) async fn finish(
    config: &Config,
    plant: &StoredPlant,
    result: Result<(), ReloadError>,
    done: oneshot::Sender<Result<(), String>>,
) {
    let name = plant.name();
    let answer = result.map_err(|error| error.to_string());
    match &answer {
        Ok(()) => {
            tracing::info!("fleet: {} is in force", name.display());
            keep_copy(config).await;
        }
        Err(error) => {
            tracing::error!("fleet: {} is refused, and nothing has changed", name.display());
            error.lines().for_each(|line| tracing::error!("{line}"));
        }
    }
    // The watch has ended.
    let _ = done.send(answer);
}

/// The copy, if there is a folder for it.
fn copy_path(config: &Config) -> Option<PathBuf> {
    let folder = config.bridge.buffer.dir.as_ref().or(config.environment.state.as_ref())?;
    Some(folder.join(COPY))
}

async fn read_copy(config: &Config) -> Option<String> {
    tokio::fs::read_to_string(copy_path(config)?).await.ok()
}

async fn keep_copy(config: &Config) {
    let Some((path, stored)) = copy_path(config).zip(config.stored.as_ref()) else { return };
    if let Err(error) = write_copy(&path, &stored.text).await {
        tracing::warn!("fleet: {}: the copy of the plant was not written: {error}", path.display());
    }
}

/// Writes a file as a whole: a crash leaves the old one.
async fn write_copy(path: &Path, text: &str) -> std::io::Result<()> {
    let new = path.with_extension("new");
    if let Some(folder) = path.parent() {
        tokio::fs::create_dir_all(folder).await?;
    }
    let mut file = tokio::fs::File::create(&new).await?;
    tokio::io::AsyncWriteExt::write_all(&mut file, text.as_bytes()).await?;
    file.sync_all().await?;
    tokio::fs::rename(&new, path).await
}
