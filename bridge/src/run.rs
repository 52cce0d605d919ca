//! Runs a configuration: poller, buffer and outputs, until a signal.
//!
//! ```text
//! start ──▶ running ──SIGHUP──▶ reload ──▶ running
//!              │ SIGTERM, SIGINT
//!              ▼
//!           draining: no new samples; outputs deliver what is in the buffer, for 5 s at most
//!              │ all delivered, or the time is up, or a second signal
//!              ▼
//!           closing: outputs say goodbye, the buffer is written to disk, links are closed
//! ```
//!
//! A member of a fleet polls the PLCs that the fleet gives to it; see [`fleet`]. It gives them to the others before
//! it drains.
//!
//! A part that panics ends the bridge with an error, so that the service manager starts it anew: a bridge that
//! runs without its collector would look alive.

mod drain;
pub mod fleet;
mod outputs;
mod plant;
mod reload;
mod service;

use std::collections::HashMap;
use std::io;
use std::sync::{Arc, PoisonError, RwLock};
use std::time::Instant;

use fatek::poll::{Poller, PollerHandle};
use fatek::{Pool, PoolBuilder};
use tokio::signal::unix::{Signal, SignalKind, signal};
use tokio_util::sync::CancellationToken;

use self::fleet::{Membership, OwnedLinks};
use self::outputs::Outputs;
pub use self::plant::PlantError;
use self::plant::Update;
pub use self::reload::ReloadError;
use self::service::Service;
use crate::availability;
use crate::buffer::{Buffer, BufferError, BufferSettings};
use crate::collect::Collector;
use crate::command::{Commands, NoFolder};
use crate::config::{BridgeSection, Config};
use crate::file_limit;
use crate::fleet::FleetError;
use crate::http::{self, BindError};
use crate::liveness::Liveness;
use crate::output::{Health, OutputKind};
use crate::present;
use crate::registry::{AddError, Registry, Share};

/// The bridge that runs, for outputs, page and metrics. Cheap to clone.
#[derive(Clone, Debug)]
pub struct Bridge {
    config: Arc<RwLock<Arc<Config>>>,
    /// The PLCs that are polled.
    pub registry: Registry,
    /// The links to them.
    pub pool: Pool,
    /// The poller.
    pub poller: PollerHandle,
    /// The buffer.
    pub buffer: Buffer,
    /// The commands, if an output takes any.
    pub commands: Option<Commands>,
    /// The outputs, in the order of their cursors.
    pub outputs: Vec<Arc<Health>>,
    /// Signs of life of the collector.
    pub liveness: Liveness,
    /// When it was started.
    pub started: Instant,
    /// The membership in a fleet, if there is one.
    pub fleet: Option<Membership>,
    /// Held while the configuration or the share of a member of a fleet changes.
    changing: Arc<tokio::sync::Mutex<()>>,
}

/// An error that ends the bridge.
#[derive(Debug, thiserror::Error)]
pub enum RunError {
    /// A PLC cannot be polled.
    #[error(transparent)]
    Add(#[from] AddError),
    /// Commands cannot be executed.
    #[error(transparent)]
    Commands(#[from] NoFolder),
    /// The buffer cannot be opened.
    #[error(transparent)]
    Buffer(#[from] BufferError),
    /// The address of the page cannot be bound.
    #[error(transparent)]
    Bind(#[from] BindError),
    /// The fleet cannot be joined, or its store cannot be used any more.
    #[error(transparent)]
    Fleet(#[from] FleetError),
    /// The store of the fleet has no plant that can be used.
    #[error(transparent)]
    Plant(#[from] PlantError),
    /// A signal handler cannot be installed.
    #[error("cannot start: {0}")]
    Start(#[from] io::Error),
    /// A part of the bridge has panicked.
    #[error("the {0} has failed: this is a fault of the bridge")]
    Panicked(&'static str),
}

impl Bridge {
    /// The configuration that is in force; a reload changes it.
    #[must_use]
    pub fn config(&self) -> Arc<Config> {
        self.config.read().unwrap_or_else(PoisonError::into_inner).clone()
    }

    fn set_config(&self, config: Config) {
        *self.config.write().unwrap_or_else(PoisonError::into_inner) = Arc::new(config);
    }
}

/// Signals that the bridge knows.
#[derive(Debug)]
struct Signals {
    interrupt: Signal,
    terminate: Signal,
    hangup: Signal,
}

impl Signals {
    fn new() -> io::Result<Self> {
        let [interrupt, terminate, hangup] =
            [SignalKind::interrupt(), SignalKind::terminate(), SignalKind::hangup()].map(signal);
        Ok(Self { interrupt: interrupt?, terminate: terminate?, hangup: hangup? })
    }

    /// Waits for a signal that ends the bridge. Cancel-safe.
    async fn end(&mut self) {
        tokio::select! {
            _ = self.interrupt.recv() => {}
            _ = self.terminate.recv() => {}
        }
    }

    /// Waits for a signal that ends the bridge (`true`) or reloads the configuration (`false`). Cancel-safe.
    async fn next(&mut self) -> bool {
        tokio::select! {
            _ = self.interrupt.recv() => true,
            _ = self.terminate.recv() => true,
            _ = self.hangup.recv() => false,
        }
    }
}

/// The connections to the PLCs of a configuration.
fn connections(bridge: &BridgeSection) -> PoolBuilder {
    // The configuration is the limit of the PLCs. The rate is that of the attempts: with a limit of those at once, PLCs
    // that do not answer would take all places.
    Pool::builder()
        .max_endpoints(usize::MAX)
        .connects_at_once(usize::MAX)
        .connects_per_second(bridge.connects_per_second)
}

/// Runs until SIGINT or SIGTERM, and then delivers what is in the buffer, for a limited time.
///
/// # Errors
/// [`RunError`] if it cannot start, or if a part of it has panicked.
pub async fn run(config: Config) -> Result<(), RunError> {
    let mut signals = Signals::new()?;
    file_limit::raise();
    let service = Service::new();
    let config = tokio::select! {
        loaded = plant::load(config) => loaded?,
        () = signals.end() => return Ok(()),
    };
    let poller = Poller::new();
    let polling = poller.handle();
    let buffer = open_buffer(&config).await?;
    let owned = OwnedLinks::new(config.bridge.id.clone());
    let is_member = config.fleet.is_some();
    let connections = connections(&config.bridge);
    let (registry, pool) = (Registry::default(), if is_member { owned.pool(connections) } else { connections.build() });
    let listener = http::bind(config.bridge.http)?;
    // Before the commands: a pulse that an earlier run has not ended needs its PLC.
    let none = HashMap::new();
    let share = if is_member { Share::Owned(&none) } else { Share::All };
    // Readings begin while thousands of PLCs are still being added.
    let liveness = Liveness::new();
    let collecting = Collector::new(registry.clone(), buffer.clone(), liveness.clone()).run(poller);
    let mut collector = tokio::spawn(collecting);
    let changes = registry.apply_share(&config.plant, share, &pool, &polling)?;
    let joined = if is_member {
        fleet::check(&config.plant, &config.bridge)?;
        fleet::join(&config, owned)?
    } else {
        None
    };
    let (membership, mut fleet_task, events) = match joined {
        Some((membership, events, task)) => (Some(membership), Some(task), Some(events)),
        None => (None, None, None),
    };
    let commands = Commands::start_for(&config, registry.clone(), pool.clone()).await?;
    let bridge = Bridge {
        registry,
        commands,
        pool,
        poller: polling,
        buffer: buffer.clone(),
        outputs: config.outputs().into_iter().map(|output| Arc::new(Health::new(output))).collect(),
        liveness: liveness.clone(),
        started: Instant::now(),
        fleet: membership.clone(),
        changing: Arc::default(),
        config: Arc::new(RwLock::new(Arc::new(config))),
    };
    let mut share = membership.clone().zip(events).map(|(membership, events)| {
        let bridge = bridge.clone();
        tokio::spawn(fleet::run(bridge, membership, events))
    });
    let mut present = tokio::spawn(present::run(bridge.buffer.clone(), bridge.registry.clone()));
    let mut availability = tokio::spawn(availability::run(bridge.registry.clone()));
    let stop_http = CancellationToken::new();
    let mut http = tokio::spawn(http::serve(bridge.clone(), listener, stop_http.clone()));
    let mut outputs = Outputs::start(&bridge);
    let (updates_in, mut updates) = tokio::sync::mpsc::channel(1);
    let mut plants = tokio::spawn(plant::watch(Config::clone(&bridge.config()), updates_in));
    tracing::info!("started; {changes}");
    service.ready();
    let ended = loop {
        tokio::select! {
            ends = signals.next() => match ends {
                true => break Ok(()),
                false => {
                    service.reloading();
                    tokio::select! {
                        // A fault is in the log, and nothing has changed.
                        _ = reload::reload(&bridge, &mut outputs) => service.ready(),
                        () = service.stay_alive(&bridge.liveness) => {}
                        () = signals.end() => break Ok(()),
                    }
                }
            },
            Some(Update { plant, done }) = updates.recv() => {
                service.reloading();
                tokio::select! {
                    result = reload::take_plant(&bridge, &mut outputs, plant.clone()) => {
                        plant::finish(&bridge.config(), &plant, result, done).await;
                        service.ready();
                    }
                    () = service.stay_alive(&bridge.liveness) => {}
                    () = signals.end() => break Ok(()),
                }
            }
            _ = &mut plants => break Err(RunError::Panicked("watch of the plant")),
            name = outputs.panicked() => break Err(RunError::Panicked(name)),
            _ = &mut collector => break Err(RunError::Panicked("collector")),
            _ = &mut http => break Err(RunError::Panicked("page")),
            _ = &mut present => break Err(RunError::Panicked("task of present values")),
            _ = &mut availability => break Err(RunError::Panicked("log of the PLCs")),
            () = bridge.buffer.ended() => break Err(RunError::Panicked("buffer")),
            () = commands_ended(bridge.commands.as_ref()) => break Err(RunError::Panicked("commands")),
            result = fleet::end_of(&mut fleet_task) => {
                fleet_task = None;
                break Err(fleet::ended(result));
            }
            result = fleet::end_of(&mut share) => {
                share = None;
                // It ends when the fleet has ended, and that is the reason. Their tasks end in either order.
                if !matches!(result, Ok(Ok(()))) {
                    break Err(fleet::ended_share(result));
                }
            }
            () = service.stay_alive(&bridge.liveness) => {}
        }
    };
    service.stopping();
    let has_share_failed = matches!(ended, Err(RunError::Add(_) | RunError::Panicked(fleet::SHARE)));
    if has_share_failed {
        // Nothing closes the links that the fleet takes back.
        fleet::close_all(&bridge).await;
    }
    let hurries = match membership.zip(fleet_task) {
        Some((membership, task)) => fleet::leave(&bridge, &membership, task, &mut signals).await,
        None => false,
    };
    drop(share);
    plants.abort();
    present.abort();
    // Links that close are no news.
    availability.abort();
    // A collector that has ended must not be waited for again.
    let collector = ended.is_ok().then_some(collector);
    let hurries = drain::drain(&bridge, outputs, collector, &mut signals, hurries).await;
    // The metrics show the drain.
    stop_http.cancel();
    if !hurries && !matches!(ended, Err(RunError::Panicked("page"))) {
        let _ = http.await;
    }
    ended
}

/// Waits until the commands have ended; forever without commands.
async fn commands_ended(commands: Option<&Commands>) {
    match commands {
        Some(commands) => commands.ended().await,
        None => std::future::pending().await,
    }
}

/// Opens the buffer. That reads the whole file, so it has a thread of its own.
async fn open_buffer(config: &Config) -> Result<Buffer, RunError> {
    let settings = BufferSettings::of(&config.bridge.buffer);
    let outputs: Vec<&str> = config.outputs().into_iter().map(OutputKind::name).collect();
    let opened = tokio::task::spawn_blocking(move || Buffer::open(&settings, &outputs)).await;
    Ok(opened.map_err(|_| RunError::Panicked("buffer"))??)
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use tokio::time::timeout;

    use super::*;
    use crate::command::{CommandSettings, Storage};

    /// Seen without the cure, a wait that never ends: the bridge went on without commands.
    #[tokio::test(start_paused = true)]
    async fn the_end_of_the_commands_is_noticed() {
        let settings = CommandSettings::new(Storage::Memory);
        let commands = Commands::start(settings, Registry::default()).await.unwrap();
        let day = Duration::from_secs(86_400);
        assert!(timeout(day, commands_ended(Some(&commands))).await.is_err(), "they run");
        assert!(timeout(day, commands_ended(None)).await.is_err(), "there are none");
        commands.close().await;
        assert!(timeout(day, commands_ended(Some(&commands))).await.is_ok());
    }
}
