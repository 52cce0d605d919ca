//! The program `fatek-bridge` with its page, for tests.

use std::net::{SocketAddr, TcpListener};
use std::path::Path;
use std::process::Stdio;
use std::time::Duration;

use tempfile::TempDir;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpStream;
use tokio::process::{Child, Command};
use tokio::time::{Instant, sleep};

/// A bridge that runs until it is dropped.
#[derive(Debug)]
pub struct HttpBridge {
    /// The process.
    pub child: Child,
    /// The address of page and metrics.
    pub http: SocketAddr,
    folder: TempDir,
}

/// An answer of HTTP.
#[derive(Debug)]
pub struct Answer {
    /// The status code.
    pub status: u16,
    /// The lines of the head, in small letters.
    pub head: String,
    /// The content.
    pub body: String,
}

/// The time for a bridge to start.
const START: Duration = Duration::from_secs(60);

impl HttpBridge {
    /// Starts a bridge in a folder of its own and waits until it is ready. `HTTP` in the configuration becomes
    /// the address of the page.
    pub async fn start(config: &str) -> Self {
        Self::start_with(config, Stdio::null()).await
    }

    /// As [`start`](Self::start), with this stdout.
    pub async fn start_with(config: &str, stdout: Stdio) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let http = free_address();
        let path = folder.path().join("bridge.toml");
        std::fs::write(&path, config.replace("HTTP", &http.to_string())).unwrap();
        let bridge = Self { child: command(&path).stdout(stdout).spawn().unwrap(), http, folder };
        let began = Instant::now();
        while !matches!(bridge.try_get("/readyz", "").await, Ok(answer) if answer.status == 200) {
            assert!(began.elapsed() < START, "the bridge is not ready");
            sleep(Duration::from_millis(50)).await;
        }
        bridge
    }

    /// The folder of the configuration, `bridge.toml`.
    pub fn folder(&self) -> &Path {
        self.folder.path()
    }

    /// Gets a path of its page.
    pub async fn get(&self, path: &str) -> Answer {
        self.try_get(path, "").await.unwrap()
    }

    /// Gets a path, with more lines of the head: `"Accept: text/html\r\n"`.
    pub async fn get_with(&self, path: &str, head: &str) -> Answer {
        self.try_get(path, head).await.unwrap()
    }

    /// Gets a path and waits until the content passes a check, for a generous time.
    pub async fn get_until(&self, path: &str, check: impl Fn(&str) -> bool) -> String {
        let began = Instant::now();
        loop {
            let answer = self.get(path).await;
            if check(&answer.body) {
                return answer.body;
            }
            assert!(began.elapsed() < START, "{path} still is {}", answer.body);
            sleep(Duration::from_millis(100)).await;
        }
    }

    async fn try_get(&self, path: &str, head: &str) -> std::io::Result<Answer> {
        request(self.http, &format!("GET {path} HTTP/1.1\r\nHost: {}\r\n{head}Connection: close\r\n\r\n", self.http))
            .await
    }
}

/// The command that runs a configuration. Its stdout is thrown away.
pub fn command(config: &Path) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_fatek-bridge"));
    command.arg("run").arg(config).stdin(Stdio::null()).stdout(Stdio::null()).kill_on_drop(true);
    command
}

/// An address of the loopback interface that is free now.
pub fn free_address() -> SocketAddr {
    TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap()
}

/// Sends the text of a request and returns the answer, which must end the connection.
pub async fn request(address: SocketAddr, text: &str) -> std::io::Result<Answer> {
    let mut stream = TcpStream::connect(address).await?;
    stream.write_all(text.as_bytes()).await?;
    let mut answer = Vec::new();
    stream.read_to_end(&mut answer).await?;
    let answer = String::from_utf8_lossy(&answer).into_owned();
    let (head, body) = answer.split_once("\r\n\r\n").unwrap_or((&answer, ""));
    let status = head.split(' ').nth(1).and_then(|status| status.parse().ok()).unwrap_or(0);
    Ok(Answer { status, head: head.to_ascii_lowercase(), body: body.to_owned() })
}
