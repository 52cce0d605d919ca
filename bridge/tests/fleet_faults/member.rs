//! A member: a process of the bridge, with a way of its own to NATS and a wall clock of its own.

use std::path::{Path, PathBuf};
use std::process::{Command, ExitStatus};
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process};

use super::common::bridge::Bridge;
use super::processes::Processes;
use super::proxy::Proxy;

/// The longest wait for the end of a process.
const PATIENCE: Duration = Duration::from_secs(30);

/// The folder of libfaketime in the folder of libraries of a machine.
const FAKETIME: &str = "faketime/libfaketime.so.1";

/// A process that runs, or has ended by itself.
pub(crate) struct Member {
    pub(crate) number: usize,
    pub(crate) proxy: Proxy,
    bridge: Bridge,
    processes: Processes,
    clock: PathBuf,
    is_stopped: bool,
}

/// The parts of a start.
pub(crate) struct Start<'a> {
    pub(crate) id: &'a str,
    pub(crate) number: usize,
    pub(crate) config: &'a Path,
    pub(crate) proxy: Proxy,
    pub(crate) processes: &'a Processes,
    /// A naive variant of the protocol.
    pub(crate) naive: Option<&'a str>,
}

impl Member {
    pub(crate) fn start(start: Start<'_>) -> Self {
        let Start { id, number, config, proxy, processes, naive } = start;
        let state = config.parent().unwrap();
        let clock = state.join("clock");
        let mut command = Command::new(env!("CARGO_BIN_EXE_fatek-bridge"));
        command.arg("run").arg(config).args(["--id", id]).env("STATE_DIRECTORY", state).env_remove("RUST_LOG");
        // Such as fatek_bridge=debug,fatek=debug.
        command.envs(std::env::var("FATEK_FLEET_LOG").map(|filter| ("RUST_LOG", filter)));
        command.env_remove("FATEK_FLEET_NAIVE").envs(naive.map(|naive| ("FATEK_FLEET_NAIVE", naive)));
        set_clock(&clock, 0);
        if let Some(library) = faketime() {
            fake_clock(&mut command, &library, &clock);
        }
        let bridge = Bridge::spawn(command);
        processes.started(number, bridge.pid());
        Self { number, proxy, bridge, processes: processes.clone(), clock, is_stopped: false }
    }

    fn signal(&self, signal: Signal) {
        let pid = Pid::from_raw(i32::try_from(self.bridge.pid()).unwrap()).unwrap();
        // It may have ended, and is not waited for by then.
        let _ = kill_process(pid, signal);
    }

    pub(crate) fn kill(&mut self) {
        self.processes.ended(self.number);
        self.signal(Signal::KILL);
        self.bridge.wait();
    }

    /// Returns `false` if it is stopped already.
    pub(crate) fn stop(&mut self) -> bool {
        let was_stopped = std::mem::replace(&mut self.is_stopped, true);
        if !was_stopped {
            self.signal(Signal::STOP);
        }
        !was_stopped
    }

    pub(crate) fn resume(&mut self) {
        if std::mem::take(&mut self.is_stopped) {
            self.signal(Signal::CONT);
        }
    }

    pub(crate) fn terminate(&self) {
        self.signal(Signal::TERM);
    }

    /// Steps its wall clock.
    pub(crate) fn step_clock(&self, step: i64) {
        set_clock(&self.clock, step);
    }

    /// Its status, if it has ended.
    pub(crate) fn ended(&mut self) -> Option<ExitStatus> {
        let status = self.bridge.ended();
        if status.is_some() {
            self.processes.ended(self.number);
        }
        status
    }

    /// Waits until it ends.
    pub(crate) async fn wait(&mut self) -> Option<ExitStatus> {
        let until = Instant::now() + PATIENCE;
        while Instant::now() < until {
            if let Some(status) = self.ended() {
                return Some(status);
            }
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
        None
    }

    pub(crate) fn log(&self) -> String {
        self.bridge.log()
    }
}

/// The library that fakes wall clocks.
pub(crate) fn faketime() -> Option<PathBuf> {
    let folders = std::fs::read_dir("/usr/lib").ok()?.flatten().map(|folder| folder.path().join(FAKETIME));
    folders.into_iter().find(|library| library.exists())
}

/// Lets a command take its wall clock from a file, and all other clocks from the system.
pub(crate) fn fake_clock(command: &mut Command, library: &Path, clock: &Path) {
    command.env("LD_PRELOAD", library).env("FAKETIME_TIMESTAMP_FILE", clock);
    command.env("FAKETIME_CACHE_DURATION", "1").env("FAKETIME_DISABLE_SHM", "1");
    command.env("FAKETIME_DONT_FAKE_MONOTONIC", "1").env("DONT_FAKE_MONOTONIC", "1");
}

/// Sets the step of a wall clock, in seconds.
pub(crate) fn set_clock(clock: &Path, step: i64) {
    let new = clock.with_extension("new");
    std::fs::write(&new, format!("{step:+}\n")).unwrap();
    std::fs::rename(&new, clock).unwrap();
}
