//! A nats-server on loopback, with JetStream, started by the test.
//!
//! `FATEK_NATS_SERVER` is the path of another program than that of the system.

use std::ffi::OsString;
use std::fmt::Write as _;
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use async_nats::Client;
use async_nats::jetstream::consumer::{AckPolicy, DeliverPolicy, pull};
use async_nats::jetstream::{self, Context};
use futures::StreamExt as _;
use serde_json::Value;

/// The longest wait for anything: much longer than on a loaded machine.
pub const PATIENCE: Duration = Duration::from_secs(60);

/// A server. It is killed when it is dropped.
#[derive(Debug)]
pub struct NatsServer {
    folder: PathBuf,
    port: u16,
    extra: String,
    child: Option<Child>,
}

/// A message of a stream.
#[derive(Clone, Debug, PartialEq)]
pub struct Stored {
    pub subject: String,
    pub id: String,
    pub message: Value,
}

fn program() -> OsString {
    std::env::var_os("FATEK_NATS_SERVER").unwrap_or_else(|| "nats-server".into())
}

impl NatsServer {
    /// Starts a server, whose data is in a folder. `None`: the program is missing, and the test is skipped.
    pub fn start(folder: &Path) -> Option<Self> {
        Self::start_with(folder, "")
    }

    /// As [`start`](Self::start), with more lines of its configuration.
    pub fn start_with(folder: &Path, extra: &str) -> Option<Self> {
        let mut server = Self::stopped(folder, extra)?;
        server.run();
        Some(server)
    }

    /// A server that is not started yet.
    pub fn stopped(folder: &Path, extra: &str) -> Option<Self> {
        if Command::new(program()).arg("--version").stdout(Stdio::null()).status().is_err() {
            assert!(std::env::var_os("FATEK_BRIDGE_REQUIRE_SERVERS").is_none(), "nats-server is not installed");
            println!("skipped: nats-server is not installed");
            return None;
        }
        let port = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
        Some(Self { folder: folder.to_owned(), port, extra: extra.to_owned(), child: None })
    }

    /// Starts it, again with the same data and the same port.
    pub fn run(&mut self) {
        let mut config = format!("listen: 127.0.0.1:{}\n", self.port);
        let store = self.folder.join("jetstream");
        writeln!(config, "jetstream {{ store_dir: {:?}, max_file_store: 1GB }}", store.display().to_string()).unwrap();
        config.push_str(&self.extra);
        let path = self.folder.join("nats.conf");
        std::fs::write(&path, config).unwrap();
        let log = std::fs::File::options().create(true).append(true).open(self.folder.join("nats.log")).unwrap();
        let mut command = Command::new(program());
        command.arg("-c").arg(&path).stdin(Stdio::null()).stdout(log.try_clone().unwrap()).stderr(log);
        self.child = Some(command.spawn().unwrap());
        let until = Instant::now() + PATIENCE;
        while std::net::TcpStream::connect(("127.0.0.1", self.port)).is_err() {
            assert!(Instant::now() < until, "nats-server does not listen; its log:\n{}", self.log());
            std::thread::sleep(Duration::from_millis(10));
        }
    }

    /// Kills it at once, as a power failure would.
    pub fn kill(&mut self) {
        if let Some(mut child) = self.child.take() {
            child.kill().unwrap();
            child.wait().unwrap();
        }
    }

    /// Sends it a signal, such as `STOP` or `CONT`.
    pub fn signal(&self, name: &str) {
        let pid = self.child.as_ref().unwrap().id().to_string();
        assert!(Command::new("kill").args(["-s", name, &pid]).status().unwrap().success());
    }

    pub fn port(&self) -> u16 {
        self.port
    }

    pub fn log(&self) -> String {
        std::fs::read_to_string(self.folder.join("nats.log")).unwrap_or_default()
    }

    /// A client of the test, which waits for the server.
    pub async fn client(&self) -> Client {
        let options = async_nats::ConnectOptions::new().retry_on_initial_connect();
        options.connect(format!("nats://127.0.0.1:{}", self.port)).await.unwrap()
    }

    /// All messages of a stream, in their order.
    pub async fn stored(&self, stream: &str) -> Vec<Stored> {
        let context: Context = jetstream::new(self.client().await);
        let mut stream = context.get_stream(stream).await.unwrap();
        let count = stream.info().await.unwrap().state.messages;
        let config =
            pull::Config { ack_policy: AckPolicy::None, deliver_policy: DeliverPolicy::All, ..pull::Config::default() };
        let consumer = stream.create_consumer(config).await.unwrap();
        let messages = consumer.messages().await.unwrap();
        let stored = messages.take(usize::try_from(count).unwrap()).map(|message| {
            let message = message.unwrap();
            let id = message.headers.as_ref().and_then(|headers| headers.get("Nats-Msg-Id")).unwrap().to_string();
            let subject = message.subject.to_string();
            Stored { subject, id, message: serde_json::from_slice(&message.payload).unwrap() }
        });
        if count == 0 { Vec::new() } else { stored.collect().await }
    }
}

impl Drop for NatsServer {
    fn drop(&mut self) {
        self.kill();
    }
}
