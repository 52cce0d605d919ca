//! Signals that end a command: SIGINT, SIGTERM and SIGHUP on Unix, Ctrl-C elsewhere.
//!
//! A command that has something to report or to close waits for them through [`Stop`]. All other
//! commands are ended by the system. A thread of its own waits for signals. Thus a command that
//! is blocked, for instance by a full pipe at stdout, ends, too: after [`GRACE`], or at the second
//! signal.

use std::sync::OnceLock;
use std::time::Duration;
use std::{fmt, io, process, thread};

use tokio::sync::watch;
use tokio::time::timeout;

use crate::failure::Failure;

/// Time for a command to end by itself after a signal.
const GRACE: Duration = Duration::from_secs(2);

/// Signal that ends a command.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Signal {
    /// Ctrl-C.
    Interrupt,
    #[cfg(unix)]
    Terminate,
    /// The terminal was closed.
    #[cfg(unix)]
    Hangup,
}

impl Signal {
    /// Exit status of a command that it ends: 128 and its number.
    pub(crate) fn exit_status(self) -> u8 {
        match self {
            Self::Interrupt => 128 + 2,
            #[cfg(unix)]
            Self::Terminate => 128 + 15,
            #[cfg(unix)]
            Self::Hangup => 128 + 1,
        }
    }
}

impl fmt::Display for Signal {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Interrupt if cfg!(unix) => "SIGINT",
            Self::Interrupt => "Ctrl-C",
            #[cfg(unix)]
            Self::Terminate => "SIGTERM",
            #[cfg(unix)]
            Self::Hangup => "SIGHUP",
        })
    }
}

/// The first signal of the process.
#[derive(Clone, Debug)]
pub(crate) struct Stop(watch::Receiver<Option<Signal>>);

impl Stop {
    /// Installs the handlers, on the first call. From then on a signal does not end the process by
    /// itself: wait for [`signalled`](Self::signalled).
    pub(crate) fn new() -> Result<Self, Failure> {
        static STOP: OnceLock<Stop> = OnceLock::new();
        if let Some(stop) = STOP.get() {
            return Ok(stop.clone());
        }
        let stop = Self(listen().map_err(Failure::Runtime)?);
        Ok(STOP.get_or_init(|| stop).clone())
    }

    /// Waits for the first signal; returns at once after it.
    pub(crate) async fn signalled(&mut self) -> Signal {
        match self.0.wait_for(Option::is_some).await.map(|signal| *signal) {
            Ok(Some(signal)) => signal,
            // The thread of the signals never ends before the process.
            Ok(None) | Err(_) => std::future::pending().await,
        }
    }
}

/// Waits for the end of a command, or for a signal. The command is dropped then.
pub(crate) async fn unless_signalled<T>(command: impl Future<Output = T>) -> Result<Result<T, Signal>, Failure> {
    let mut stop = Stop::new()?;
    Ok(tokio::select! {
        biased;
        signal = stop.signalled() => Err(signal),
        ended = command => Ok(ended),
    })
}

/// Sets the function that is called before a blocked command is ended. It must not wait; the first one stays.
pub(crate) fn before_forced_exit(restore: fn()) {
    let _ = BEFORE_FORCED_EXIT.set(restore);
}

static BEFORE_FORCED_EXIT: OnceLock<fn()> = OnceLock::new();

/// Starts the thread that waits for signals.
fn listen() -> io::Result<watch::Receiver<Option<Signal>>> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    // Not `block_on`: the caller is a task of the runtime of the command.
    let mut signals = {
        let _entered = runtime.enter();
        Signals::new()?
    };
    let (sender, receiver) = watch::channel(None);
    let wait = async move {
        let first = signals.next().await;
        let _ = sender.send(Some(first));
        let signal = timeout(GRACE, signals.next()).await.unwrap_or(first);
        if let Some(restore) = BEFORE_FORCED_EXIT.get() {
            restore();
        }
        process::exit(signal.exit_status().into());
    };
    thread::Builder::new().name("signals".to_owned()).spawn(move || runtime.block_on(wait))?;
    Ok(receiver)
}

#[cfg(unix)]
struct Signals {
    interrupt: tokio::signal::unix::Signal,
    terminate: tokio::signal::unix::Signal,
    /// `None` if the process was started with SIGHUP ignored, as by `nohup`: it stays ignored.
    hangup: Option<tokio::signal::unix::Signal>,
}

#[cfg(unix)]
impl Signals {
    fn new() -> io::Result<Self> {
        use tokio::signal::unix::{SignalKind, signal};

        let hangup = if is_hangup_ignored() { None } else { Some(signal(SignalKind::hangup())?) };
        Ok(Self { interrupt: signal(SignalKind::interrupt())?, terminate: signal(SignalKind::terminate())?, hangup })
    }

    async fn next(&mut self) -> Signal {
        let hangup = async {
            match &mut self.hangup {
                Some(hangup) => hangup.recv().await,
                None => std::future::pending().await,
            }
        };
        tokio::select! {
            _ = self.interrupt.recv() => Signal::Interrupt,
            _ = self.terminate.recv() => Signal::Terminate,
            _ = hangup => Signal::Hangup,
        }
    }
}

/// Returns whether SIGHUP is ignored, as Linux states it. `false` on other systems.
#[cfg(unix)]
fn is_hangup_ignored() -> bool {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let ignored = status.lines().find_map(|line| u64::from_str_radix(line.strip_prefix("SigIgn:")?.trim(), 16).ok());
    // The lowest bit is signal 1, SIGHUP.
    ignored.is_some_and(|signals| signals & 1 != 0)
}

#[cfg(not(unix))]
struct Signals(tokio::signal::windows::CtrlC);

#[cfg(not(unix))]
impl Signals {
    fn new() -> io::Result<Self> {
        tokio::signal::windows::ctrl_c().map(Self)
    }

    async fn next(&mut self) -> Signal {
        self.0.recv().await;
        Signal::Interrupt
    }
}
