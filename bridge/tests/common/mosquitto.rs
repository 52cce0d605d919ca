//! A real mosquitto, started by a test on a free port.

use std::net::{TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use tempfile::TempDir;

use super::bridge::PATIENCE;

/// A running mosquitto. It is killed when it is dropped.
#[derive(Debug)]
pub struct Mosquitto {
    folder: TempDir,
    port: u16,
    child: Option<Child>,
}

/// The program; `None`, with a message: it is not installed, and the test is skipped.
///
/// # Panics
/// It is missing, and `FATEK_BRIDGE_REQUIRE_SERVERS` is set.
fn program() -> Option<PathBuf> {
    let path = std::env::var_os("PATH").unwrap_or_default();
    let folders = std::env::split_paths(&path).chain(["/usr/sbin".into(), "/usr/local/sbin".into()]);
    let found = folders.map(|folder| folder.join("mosquitto")).find(|program| program.is_file());
    let required = std::env::var_os("FATEK_BRIDGE_REQUIRE_SERVERS").is_some();
    assert!(found.is_some() || !required, "mosquitto is not installed");
    if found.is_none() {
        eprintln!("SKIPPED: mosquitto is not installed");
    }
    found
}

/// A port of loopback that was free a moment ago.
pub fn free_port() -> u16 {
    TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port()
}

impl Mosquitto {
    /// Starts one that everyone may use. `None`: it is not installed.
    pub fn start() -> Option<Self> {
        Self::start_with("allow_anonymous true\n")
    }

    /// Starts one with these lines of configuration for its listener. `FOLDER` is replaced by its folder.
    pub fn start_with(lines: &str) -> Option<Self> {
        Self::start_in(TempDir::new().unwrap(), lines)
    }

    /// As [`start_with`](Self::start_with), in a folder that has the files which the lines name.
    pub fn start_in(folder: TempDir, lines: &str) -> Option<Self> {
        program()?;
        let port = free_port();
        // Nothing is dropped for a slow subscriber, and nothing is kept over a restart. As root it would change
        // to a user who cannot read the folder.
        let text = format!(
            "user root\nper_listener_settings false\nmax_queued_messages 0\nmax_inflight_messages 200\n\
             persistence false\nlog_type all\nlog_dest file FOLDER/log\nlistener {port} 127.0.0.1\n{lines}"
        );
        let text = text.replace("FOLDER", folder.path().to_str().unwrap());
        std::fs::write(folder.path().join("mosquitto.conf"), text).unwrap();
        let mut mosquitto = Self { folder, port, child: None };
        mosquitto.launch();
        Some(mosquitto)
    }

    pub fn port(&self) -> u16 {
        self.port
    }

    pub fn url(&self) -> String {
        format!("mqtt://127.0.0.1:{}", self.port)
    }

    pub fn folder(&self) -> &Path {
        self.folder.path()
    }

    /// Starts it on its port, and waits until it listens.
    pub fn launch(&mut self) {
        let config = self.folder.path().join("mosquitto.conf");
        let mut command = Command::new(program().unwrap());
        command.arg("-c").arg(config).stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
        let mut child = command.spawn().unwrap();
        let until = Instant::now() + PATIENCE;
        while TcpStream::connect(("127.0.0.1", self.port)).is_err() {
            assert!(child.try_wait().unwrap().is_none(), "mosquitto has ended: {}", self.log());
            assert!(Instant::now() < until, "mosquitto does not listen: {}", self.log());
            std::thread::sleep(Duration::from_millis(10));
        }
        self.child = Some(child);
    }

    /// Kills it with SIGKILL.
    pub fn kill(&mut self) {
        if let Some(mut child) = self.child.take() {
            let _ = child.kill();
            let _ = child.wait();
        }
    }

    /// Sends it a signal, such as `HUP`: it reads its rules again.
    pub fn signal(&self, name: &str) {
        let pid = self.child.as_ref().unwrap().id().to_string();
        assert!(Command::new("kill").args(["-s", name, &pid]).status().unwrap().success(), "kill -s {name}");
    }

    /// Its log.
    pub fn log(&self) -> String {
        std::fs::read_to_string(self.folder.path().join("log")).unwrap_or_default()
    }
}

impl Drop for Mosquitto {
    fn drop(&mut self) {
        self.kill();
    }
}
