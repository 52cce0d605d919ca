//! The program under test, as a process.

use std::io::{BufRead as _, BufReader, Read};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use serde_json::Value;

/// The longest wait for anything: much longer than on a loaded machine.
pub const PATIENCE: Duration = Duration::from_secs(30);

/// A running `fatek-bridge`. It is killed when it is dropped.
#[derive(Debug)]
pub struct Bridge {
    child: Child,
    lines: Receiver<String>,
    log: Arc<Mutex<String>>,
}

/// Writes a configuration into a folder.
pub fn write_config(folder: &Path, text: &str) -> PathBuf {
    let path = folder.join("plant.toml");
    // Renamed, so that a bridge never reads half of it.
    let new = folder.join("plant.toml.new");
    std::fs::write(&new, text).unwrap();
    std::fs::rename(&new, &path).unwrap();
    path
}

impl Bridge {
    /// Starts `fatek-bridge run CONFIG`, whose state is in a folder.
    pub fn start(config: &Path, state: &Path) -> Self {
        Self::start_with(config, state, &[])
    }

    /// As [`start`](Self::start), with variables of the environment.
    pub fn start_with(config: &Path, state: &Path, variables: &[(&str, &str)]) -> Self {
        let mut command = Command::new(env!("CARGO_BIN_EXE_fatek-bridge"));
        command.arg("run").arg(config).env("STATE_DIRECTORY", state).env_remove("RUST_LOG");
        command.envs(variables.iter().copied());
        Self::spawn(command)
    }

    /// Starts a command whose lines are taken.
    pub fn spawn(mut command: Command) -> Self {
        command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
        let mut child = command.spawn().unwrap();
        let (stdout, stderr) = (child.stdout.take().unwrap(), child.stderr.take().unwrap());
        let (sender, lines) = channel();
        std::thread::spawn(move || {
            for line in BufReader::new(stdout).lines().map_while(Result::ok) {
                if sender.send(line).is_err() {
                    return;
                }
            }
        });
        let log = Arc::new(Mutex::new(String::new()));
        let shared = log.clone();
        std::thread::spawn(move || {
            let mut stderr = stderr;
            let mut bytes = [0; 4096];
            while let Ok(len @ 1..) = stderr.read(&mut bytes) {
                shared.lock().unwrap().push_str(&String::from_utf8_lossy(&bytes[..len]));
            }
        });
        Self { child, lines, log }
    }

    /// The process id.
    pub fn pid(&self) -> u32 {
        self.child.id()
    }

    /// The log so far.
    pub fn log(&self) -> String {
        self.log.lock().unwrap().clone()
    }

    /// Waits until the log has this text.
    pub fn wait_for_log(&self, text: &str) {
        let until = Instant::now() + PATIENCE;
        while !self.log().contains(text) {
            assert!(Instant::now() < until, "no {text:?} in the log:\n{}", self.log());
            std::thread::sleep(Duration::from_millis(5));
        }
    }

    /// The lines of stdout, for a caller that takes them by itself.
    pub fn take_lines(&mut self) -> Receiver<String> {
        std::mem::replace(&mut self.lines, channel().1)
    }

    /// The next line of stdout; `None` at its end.
    pub fn line(&self) -> Option<String> {
        match self.lines.recv_timeout(PATIENCE) {
            Ok(line) => Some(line),
            Err(RecvTimeoutError::Disconnected) => None,
            Err(RecvTimeoutError::Timeout) => panic!("no line within {PATIENCE:?}; the log:\n{}", self.log()),
        }
    }

    /// The next batch of stdout.
    pub fn batch(&self) -> Value {
        let line = self.line().unwrap_or_else(|| panic!("the bridge has ended; its log:\n{}", self.log()));
        serde_json::from_str(&line).unwrap_or_else(|error| panic!("{line}: {error}"))
    }

    /// All batches until stdout ends.
    pub fn rest(&self) -> Vec<Value> {
        std::iter::from_fn(|| self.line()).map(|line| serde_json::from_str(&line).unwrap()).collect()
    }

    /// Sends a signal, such as `HUP`, `TERM` or `KILL`.
    pub fn signal(&self, name: &str) {
        let status = Command::new("kill").args(["-s", name, &self.pid().to_string()]).status().unwrap();
        assert!(status.success(), "kill -s {name}");
    }

    /// Its status, if it has ended.
    pub fn ended(&mut self) -> Option<ExitStatus> {
        self.child.try_wait().unwrap()
    }

    /// Waits until it has ended.
    pub fn wait(&mut self) -> ExitStatus {
        let until = Instant::now() + PATIENCE;
        loop {
            if let Some(status) = self.child.try_wait().unwrap() {
                return status;
            }
            assert!(Instant::now() < until, "it does not end; its log:\n{}", self.log());
            std::thread::sleep(Duration::from_millis(5));
        }
    }
}

impl Drop for Bridge {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
