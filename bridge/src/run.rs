//! Runs a configuration: poller, buffer and outputs, until a signal.

use std::sync::Arc;
use std::time::{Duration, Instant};

use fatek::Pool;
use fatek::poll::{Poller, PollerHandle};
use tokio::signal::unix::{SignalKind, signal};
use tokio::sync::broadcast;
use tokio::time::timeout;

use crate::batch::Batch;
use crate::buffer::Buffer;
use crate::collect::Collector;
use crate::config::Config;
use crate::output::{Health, stdout};
use crate::registry::Registry;

/// The bridge that runs, for page and metrics. Cheap to clone.
#[derive(Clone, Debug)]
pub struct Bridge {
    /// The configuration.
    pub config: Arc<Config>,
    /// The PLCs that are polled.
    pub registry: Registry,
    /// The links to them.
    pub pool: Pool,
    /// The poller.
    pub poller: PollerHandle,
    /// The buffer.
    pub buffer: Buffer,
    /// The outputs, in the order of their cursors.
    pub outputs: Vec<Arc<Health>>,
    /// Each batch, for the page.
    pub live: broadcast::Sender<Arc<Batch>>,
    /// When it was started.
    pub started: Instant,
}

/// The batches that wait for a slow reader of the page before it misses some.
const LIVE_CAPACITY: usize = 1024;
/// The time for the outputs to deliver what is in the buffer at the end.
const DRAIN: Duration = Duration::from_secs(5);

/// An error that ends the bridge.
#[derive(Debug, thiserror::Error)]
pub enum RunError {
    /// A PLC cannot be polled.
    #[error(transparent)]
    Add(#[from] crate::registry::AddError),
    /// A signal handler cannot be installed.
    #[error("cannot start: {0}")]
    Start(#[from] std::io::Error),
}

/// Runs until SIGINT or SIGTERM, and then delivers what is in the buffer, for a limited time.
///
/// # Errors
/// [`RunError`] if it cannot start.
pub async fn run(config: Config) -> Result<(), RunError> {
    let mut interrupt = signal(SignalKind::interrupt())?;
    let mut terminate = signal(SignalKind::terminate())?;
    let poller = Poller::new();
    let outputs = config.outputs();
    let memory = usize::try_from(config.bridge.buffer.memory.0).unwrap_or(usize::MAX);
    let buffer = Buffer::in_memory(outputs.len(), memory);
    let (live, _) = broadcast::channel(LIVE_CAPACITY);
    let bridge = Bridge {
        registry: Registry::default(),
        pool: Pool::new(),
        poller: poller.handle(),
        buffer: buffer.clone(),
        outputs: outputs.iter().map(|name| Arc::new(Health::new(name))).collect(),
        live: live.clone(),
        started: Instant::now(),
        config: Arc::new(config),
    };
    for plc in bridge.config.plant.plcs() {
        bridge.registry.write().add(&bridge.config.plant, plc, &bridge.pool, &bridge.poller)?;
    }
    let collector = tokio::spawn(Collector::new(bridge.registry.clone(), buffer.clone(), live).run(poller));
    let mut tasks = tokio::task::JoinSet::new();
    for (number, health) in bridge.outputs.iter().enumerate() {
        let cursor = buffer.cursor(number);
        if health.name() == "stdout" {
            tasks.spawn(stdout::run(cursor, health.clone()));
        }
    }
    tokio::select! {
        _ = interrupt.recv() => {}
        _ = terminate.recv() => {}
    }
    // No new samples, and then the rest of the buffer.
    bridge.poller.close().await;
    let drained = async {
        let _ = collector.await;
        while (0..bridge.outputs.len()).any(|number| !buffer.cursor(number).is_drained()) {
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
    };
    if timeout(DRAIN, drained).await.is_err() {
        tracing::warn!("an output did not take all batches within {DRAIN:?}");
    }
    Ok(())
}
