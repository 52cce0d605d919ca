//! Write-back: commands of an output become writes to a PLC, if the configuration allows them.
//!
//! - [`reply`]: the replies, with the reasons of refusals.
//! - [`request`] parses payloads, [`rules`] checks them against the configuration, [`rate`] limits them.
//! - [`journal`]: ids with their replies, so that each is executed once. [`store`]: the same on disk.
//! - [`pulse`]: discretes that are reset after a time, also after a crash.
//! - [`core`]: the state machine of all of these, without I/O and clocks. [`driver`] performs its outputs.
//!
//! The forms of messages and all limits are in `docs/commands.md`.

mod core;
mod driver;
mod journal;
mod pulse;
mod rate;
mod reply;
mod request;
mod rules;
mod stats;
mod store;

use std::collections::BTreeMap;
use std::fmt;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, SystemTime};

use fatek::Pool;
use tokio::sync::{Semaphore, mpsc, oneshot};
use tokio::task::JoinHandle;
use tokio::time::Instant;
use tokio_util::sync::CancellationToken;

use self::core::{Core, Received, Stored};
use self::driver::{Clock, Driver, Message};
use self::journal::Key;
use self::reply::Refusal;
pub use self::reply::{Outcome, Reply};
use self::request::Request;
use self::rules::Gate;
use self::stats::Figures;
pub use self::stats::{CommandStats, PlcCommandStats};
use self::store::Store;
pub use self::store::StoreError;
use crate::batch::milliseconds;
use crate::config::{Config, Environment};
use crate::output::OutputKind;
use crate::registry::Registry;

/// The name of the file of the commands.
pub const FILE_NAME: &str = "commands.redb";

/// Settings of the commands.
#[derive(Clone, Debug)]
pub struct CommandSettings {
    /// Where ids and pulses are stored.
    pub storage: Storage,
    /// The limits.
    pub limits: CommandLimits,
    /// The links to PLCs that left the configuration before the end of a pulse.
    pub pool: Pool,
    /// The clock that the `ts` of commands is compared with.
    pub clock: WallClock,
}

impl CommandSettings {
    /// With the default limits, links of its own and the clock of the system.
    #[must_use]
    pub fn new(storage: Storage) -> Self {
        Self { storage, pool: Pool::new(), limits: CommandLimits::default(), clock: WallClock::system() }
    }
}

/// Where ids of commands and pulses are stored.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Storage {
    /// In this file.
    File(PathBuf),
    /// In memory alone: after a restart an id can be executed again, and a pulse that was lost is not ended.
    /// For simulated PLCs.
    Memory,
}

impl Storage {
    /// In [`FILE_NAME`] in the folder of the buffer, or without one in `$STATE_DIRECTORY`.
    ///
    /// # Errors
    /// [`NoFolder`] without both.
    pub fn of_config(config: &Config) -> Result<Self, NoFolder> {
        let folder = config.bridge.buffer.dir.clone().or_else(|| Environment::of_process().state);
        folder.map(|folder| Self::File(folder.join(FILE_NAME))).ok_or(NoFolder)
    }

    /// Returns whether there is a file of an earlier run, which may have pulses to end.
    #[must_use]
    pub fn exists(&self) -> bool {
        match self {
            Self::File(path) => path.exists(),
            Self::Memory => false,
        }
    }
}

/// Writes are allowed, and there is no folder for the ids of commands.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("write = true needs a folder for the ids of commands: set bridge.buffer.dir, or $STATE_DIRECTORY")]
pub struct NoFolder;

/// Limits of the commands.
#[derive(Clone, Copy, Debug)]
pub struct CommandLimits {
    /// Commands per second for one PLC, on average.
    pub per_second: u32,
    /// Commands for one PLC at once, after a pause.
    pub burst: u32,
    /// Commands for one PLC that wait while another one is executed.
    pub max_waiting: usize,
    journal: journal::Limits,
}

impl Default for CommandLimits {
    fn default() -> Self {
        Self { per_second: 10, burst: 20, max_waiting: 32, journal: journal::Limits::default() }
    }
}

/// Commands of all outputs at once, waiting for their replies.
const MAX_CALLS: usize = 1024;

/// The clock of the day, which tests can set.
#[derive(Clone)]
pub struct WallClock(Arc<dyn Fn() -> SystemTime + Send + Sync>);

impl WallClock {
    /// The clock of the system.
    #[must_use]
    pub fn system() -> Self {
        Self(Arc::new(SystemTime::now))
    }

    /// Another clock.
    #[must_use]
    pub fn new(clock: impl Fn() -> SystemTime + Send + Sync + 'static) -> Self {
        Self(Arc::new(clock))
    }

    fn milliseconds(&self) -> u64 {
        milliseconds((self.0)())
    }
}

impl fmt::Debug for WallClock {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("WallClock")
    }
}

/// A time for the state machine.
#[derive(Clone, Copy, Debug)]
struct Now {
    /// The time since the start, which never goes back.
    run: Duration,
    /// Milliseconds since 1970, by a clock that may be set.
    wall: u64,
}

/// Executes commands. Cheap to clone.
#[derive(Clone, Debug)]
pub struct Commands {
    shared: Arc<Shared>,
    gate: Gate,
}

#[derive(Debug)]
struct Shared {
    registry: Registry,
    clock: Clock,
    messages: mpsc::UnboundedSender<Message>,
    calls: Semaphore,
    figures: Figures,
    /// Why none can be executed.
    failure: Option<Failure>,
    gates: Mutex<BTreeMap<OutputKind, Gate>>,
    task: tokio::sync::Mutex<Option<JoinHandle<()>>>,
    /// Cancelled when the task has ended.
    ended: CancellationToken,
}

/// A file that cannot be used.
#[derive(Debug)]
struct Failure {
    why: String,
    /// When the bridge was started, in milliseconds since 1970.
    begin: u64,
}

impl Failure {
    /// The reply to any command. An earlier run may have executed one that was sent before the start.
    fn reply(&self, request: &Request) -> Reply {
        let ahead = u64::try_from(rules::MAX_AHEAD.as_millis()).unwrap_or(u64::MAX);
        if request.ts > self.begin.saturating_add(ahead) {
            return Reply::refused(Some(&request.id), &Refusal::Storage(self.why.clone()));
        }
        let why = format!("storage: an earlier run may have executed it: {}", self.why);
        Reply::unknown(Some(&request.id), why)
    }
}

impl Commands {
    /// Opens the file, and ends the pulses that an earlier run has not ended.
    ///
    /// # Errors
    /// [`StoreError`] if the file cannot be used: another bridge has it open, it is damaged, or the folder
    /// cannot be written.
    pub async fn start(settings: CommandSettings, registry: Registry) -> Result<Self, StoreError> {
        let (sender, results) = mpsc::unbounded_channel();
        let (store, stored) = match settings.storage {
            Storage::Memory => (Store::Memory(sender), Stored::default()),
            Storage::File(path) => {
                let failed = StoreError::new(&path, "the thread that opens it has ended");
                let opened = tokio::task::spawn_blocking(move || Store::open(&path, sender)).await;
                opened.unwrap_or(Err(failed))?
            }
        };
        let clock = Clock { start: Instant::now(), wall: settings.clock };
        let figures = Figures::default();
        let core = Core::new(settings.limits, stored, figures.clone(), clock.now());
        let (messages, receiver) = mpsc::unbounded_channel();
        let driver = Driver::new(core, registry.clone(), settings.pool, store, clock.clone());
        let ended = CancellationToken::new();
        let end = ended.clone().drop_guard();
        let task = tokio::spawn(async move {
            let _end = end;
            driver.run(receiver, results).await;
        });
        let (calls, task) = (Semaphore::new(MAX_CALLS), tokio::sync::Mutex::new(Some(task)));
        let gates = Mutex::default();
        let shared = Shared { registry, clock, messages, calls, figures, failure: None, gates, task, ended };
        Ok(Self { shared: Arc::new(shared), gate: Gate::new(true) })
    }

    /// Refuses all commands, since their ids cannot be stored.
    fn failed(why: String, registry: Registry) -> Self {
        let (messages, _) = mpsc::unbounded_channel();
        let clock = Clock { start: Instant::now(), wall: WallClock::system() };
        let (calls, task) = (Semaphore::new(MAX_CALLS), tokio::sync::Mutex::new(None));
        let (figures, ended) = (Figures::default(), CancellationToken::new());
        let failure = Some(Failure { why, begin: clock.now().wall });
        let gates = Mutex::default();
        let shared = Shared { registry, clock, messages, calls, figures, failure, gates, task, ended };
        Self { shared: Arc::new(shared), gate: Gate::new(true) }
    }

    /// Starts the commands of a configuration. `None`: no output takes any, and no earlier run has left a file,
    /// which may have pulses to end. If that file cannot be used, all commands are refused, and the log says so:
    /// data goes on.
    ///
    /// # Errors
    /// [`NoFolder`] if an output takes commands and there is no folder for their ids.
    pub async fn start_for(config: &Config, registry: Registry, pool: Pool) -> Result<Option<Self>, NoFolder> {
        let takes_commands = config.outputs().into_iter().any(|output| config.takes_commands(output));
        let storage = match Storage::of_config(config) {
            Err(error) if takes_commands => return Err(error),
            Err(NoFolder) => return Ok(None),
            Ok(storage) if !takes_commands && !storage.exists() => return Ok(None),
            Ok(storage) => storage,
        };
        let settings = CommandSettings { pool, ..CommandSettings::new(storage) };
        let started = Self::start(settings, registry.clone()).await;
        Ok(Some(started.unwrap_or_else(|error| {
            tracing::error!("commands are refused, and pulses of an earlier run are not ended: {error}");
            tracing::error!(
                "if the file is damaged, check the outputs of pulses, move the file aside, and restart: \
                 ids of earlier commands are then not known"
            );
            Self::failed(error.to_string(), registry)
        })))
    }

    /// The commands of an output: whether any is executed is set by [`allow`](Self::allow).
    #[must_use]
    pub fn of_output(&self, output: OutputKind) -> Self {
        let mut gates = self.shared.gates.lock().unwrap_or_else(PoisonError::into_inner);
        let gate = gates.entry(output).or_insert_with(|| Gate::new(true)).clone();
        Self { shared: self.shared.clone(), gate }
    }

    /// Sets which outputs take commands, also for commands that wait.
    pub fn allow(&self, takes_commands: impl Fn(OutputKind) -> bool) {
        let gates = self.shared.gates.lock().unwrap_or_else(PoisonError::into_inner);
        gates.iter().for_each(|(output, gate)| gate.set_open(takes_commands(*output)));
    }

    /// Commands that are refused, since their output is closing. A repetition gets its reply.
    #[must_use]
    pub fn closing(&self) -> Self {
        Self { shared: self.shared.clone(), gate: Gate::new(false) }
    }

    /// Executes the command of a message for a PLC, and returns the reply to send. `retained`: the server has
    /// kept the message, so that it may be of any age; such commands are refused.
    ///
    /// Commands for one PLC are executed in the order of the first polls of these futures. Each takes as long as
    /// its PLC and those before it, at most some seconds each, and a pulse as long as it lasts: callers run
    /// several at once.
    ///
    /// Cancel-safe: the command is executed all the same, and a repetition of its id gets its reply.
    pub async fn execute(&self, plc: &str, payload: &[u8], retained: bool) -> Reply {
        let Shared { registry, clock, messages, calls, figures, failure, .. } = &*self.shared;
        let counted = |reply: Reply| {
            match registry.read().get(plc) {
                Some(polled) => figures.count(polled.plc.name(), &reply),
                None => figures.count_no_plc(),
            }
            reply
        };
        let refused = |id: Option<&str>, refusal: &Refusal| counted(Reply::refused(id, refusal));
        let Ok(_call) = calls.try_acquire() else {
            return refused(None, &Refusal::Busy { waiting: MAX_CALLS });
        };
        let request = match request::parse(payload) {
            Ok(request) => request,
            Err((id, refusal)) => return refused(id.as_deref(), &refusal),
        };
        if retained {
            return refused(Some(&request.id), &Refusal::Retained);
        }
        if let Some(failure) = failure {
            return counted(failure.reply(&request));
        }
        let plan = rules::check(&request, plc, &self.gate, &*registry.read(), clock.now().wall);
        if let Err(refusal @ Refusal::FormerOwner) = &plan {
            // This member does not execute it.
            return counted(Reply::unknown(
                Some(&request.id),
                format!("{refusal}: the one before may have executed it"),
            ));
        }
        let (digest, id) = (request.digest(), request.id);
        let received = Received { key: Key { plc: plc.into(), id: id.clone() }, digest, plan };
        let (sender, reply) = oneshot::channel();
        if messages.send(Message::Command(received, sender)).is_err() {
            return refused(Some(&id), &Refusal::Closed);
        }
        reply.await.unwrap_or_else(|_| Reply::unknown(Some(&id), "closed: the bridge has stopped"))
    }

    /// The figures.
    #[must_use]
    pub fn stats(&self) -> CommandStats {
        self.shared.figures.snapshot()
    }

    /// Why no command can be executed: the file of their ids cannot be used.
    #[must_use]
    pub fn failure(&self) -> Option<&str> {
        self.shared.failure.as_ref().map(|failure| failure.why.as_str())
    }

    /// Waits until the task has ended, after [`close`](Self::close) or by a panic. Cancel-safe.
    pub async fn ended(&self) {
        self.shared.ended.cancelled().await;
    }

    /// Refuses new commands, and waits until those under way have ended, for some seconds at most. Pulses that
    /// would last for longer are ended early. The outputs can still send replies then.
    pub async fn close(&self) {
        // An error: it was closed before.
        let _ = self.shared.messages.send(Message::Close);
        if let Some(task) = self.shared.task.lock().await.take() {
            // A panic was reported by the panic hook.
            let _ = task.await;
        }
    }
}
