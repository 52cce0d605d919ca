//! A connection to a server.
//!
//! `async-nats` reconnects by itself, and then sends what waits in its queue: messages behind those that were lost
//! with the connection, which breaks their order. So a client here has one connection. Its tasks run in a runtime
//! of their own, and end with it.

use std::time::Duration;

use async_nats::{Client, ConnectOptions, Event};
use futures::FutureExt as _;
use tokio::runtime::Runtime;
use tokio::sync::mpsc;

use crate::config::NatsSection;
use crate::secret::SecretError;
use crate::tls::{TlsError, TlsFiles};

/// The time for a connection, TLS and authentication included.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(5);
/// The period of pings. A server that misses two of them is lost.
const PING: Duration = Duration::from_secs(5);
/// The messages that wait for the client to write them. More than are in flight.
const QUEUE: usize = 2048;
/// The delay of a reconnect, which is never reached.
const NEVER: Duration = Duration::from_secs(24 * 3600);

/// The subscriptions of a connection.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Subscriptions {
    /// The messages of one that wait to be taken. The client drops more.
    pub(crate) capacity: usize,
    pub(crate) overflow: Overflow,
}

/// The consequence of messages of a subscription that were dropped.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Overflow {
    /// A warning.
    Warning(&'static str),
    /// The connection counts as lost.
    Lost,
}

/// A connection. Its tasks end when it is dropped.
#[derive(Debug)]
pub(crate) struct Connection {
    client: Client,
    lost: mpsc::UnboundedReceiver<String>,
    _runtime: Background,
}

/// A runtime that may be dropped in a task: its tasks are aborted, and not waited for.
#[derive(Debug)]
struct Background(Option<Runtime>);

impl Drop for Background {
    fn drop(&mut self) {
        if let Some(runtime) = self.0.take() {
            runtime.shutdown_background();
        }
    }
}

/// A connection that cannot be opened.
#[derive(Debug, thiserror::Error)]
pub(crate) enum OpenError {
    #[error("creds_file: {0}")]
    Secret(#[from] SecretError),
    #[error("password_file: {0}")]
    Password(SecretError),
    #[error("creds_file: it has no credentials of NATS: {0}")]
    Credentials(std::io::Error),
    #[error("{0}")]
    Tls(#[from] TlsError),
    #[error("{0}")]
    Connect(String),
    #[error("cannot start a runtime: {0}")]
    Runtime(std::io::Error),
}

impl Connection {
    /// Opens a connection, with the present content of the files. Cancel-safe.
    pub(crate) async fn open(
        section: &NatsSection,
        name: &str,
        subscriptions: Subscriptions,
    ) -> Result<Self, OpenError> {
        let files = section.clone();
        let options = tokio::task::spawn_blocking(move || options(&files)).await;
        // An error: it was aborted, since the runtime ends.
        let options = options.map_err(|error| OpenError::Connect(error.to_string()))??;
        let (sender, lost) = mpsc::unbounded_channel();
        let options = options
            .name(format!("fatek-bridge {name}"))
            .connection_timeout(CONNECT_TIMEOUT)
            .ping_interval(PING)
            .client_capacity(QUEUE)
            .subscription_capacity(subscriptions.capacity)
            .ignore_discovered_servers()
            .reconnect_delay_callback({
                let begun = std::sync::atomic::AtomicBool::new(false);
                move |_| {
                    let is_again = begun.swap(true, std::sync::atomic::Ordering::Relaxed);
                    if is_again { NEVER } else { Duration::ZERO }
                }
            })
            .event_callback(move |event| {
                report(&sender, &event, subscriptions.overflow);
                std::future::ready(())
            });
        let scheme = if section.url.is_tls() { "tls" } else { "nats" };
        let host = section.url.host();
        let host = if host.contains(':') { format!("[{host}]") } else { host.to_owned() };
        let url = format!("{scheme}://{host}:{}", section.url.port());
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(1)
            .thread_name("nats")
            .enable_all()
            .build()
            .map_err(OpenError::Runtime)?;
        let connecting = runtime.spawn(async move { options.connect(url).await });
        // This future may be dropped while it waits.
        let runtime = Background(Some(runtime));
        let connected = tokio::time::timeout(CONNECT_TIMEOUT * 2, connecting).await;
        let client = match connected {
            Ok(Ok(Ok(client))) => Ok(client),
            Ok(Ok(Err(error))) => Err(with_sources(&error)),
            Ok(Err(error)) => Err(error.to_string()),
            Err(_) => Err("no answer".to_owned()),
        };
        client.map(|client| Self { client, lost, _runtime: runtime }).map_err(OpenError::Connect)
    }

    pub(crate) fn client(&self) -> &Client {
        &self.client
    }

    /// Waits until the connection is lost, and returns why. Cancel-safe.
    pub(crate) async fn lost(&mut self) -> String {
        let why = self.lost.recv().await;
        // The reason can come before or after the loss itself.
        let more = self.lost.recv().now_or_never().flatten();
        let why = [why, more].into_iter().flatten().find(|why| why != LOST);
        why.unwrap_or_else(|| LOST.to_owned())
    }
}

const LOST: &str = "the connection was lost";

fn report(lost: &mpsc::UnboundedSender<String>, event: &Event, overflow: Overflow) {
    let why = match event {
        Event::Disconnected | Event::Closed => LOST.to_owned(),
        Event::LameDuckMode => "the server is shutting down".to_owned(),
        Event::SlowConsumer(_) => match overflow {
            Overflow::Warning(text) => return tracing::warn!("nats: {text}"),
            Overflow::Lost => "messages came faster than they were taken".to_owned(),
        },
        // Such as missing permissions: the connection stays.
        Event::ServerError(error) => return tracing::warn!("nats: the server reports: {error}"),
        Event::ClientError(error) => return tracing::debug!("nats: {error}"),
        Event::Connected | Event::Draining => return,
    };
    // The session has ended.
    let _ = lost.send(why);
}

/// Reads the files of a section. Blocks until the disk has read them.
fn options(section: &NatsSection) -> Result<ConnectOptions, OpenError> {
    let mut options = ConnectOptions::new();
    if let Some(credentials) = section.credentials()? {
        options = options.credentials(credentials.expose()).map_err(OpenError::Credentials)?;
    }
    if let Some(user) = &section.user {
        let password = section.password().map_err(OpenError::Password)?;
        let password = password.map(|password| password.expose().to_owned()).unwrap_or_default();
        options = options.user_and_password(user.clone(), password);
    }
    if section.url.is_tls() {
        let files = TlsFiles {
            ca: section.ca_file.as_deref(),
            cert: section.cert_file.as_deref(),
            key: section.key_file.as_deref(),
        };
        options = options.require_tls(true).tls_client_config(files.load()?);
    }
    Ok(options)
}

/// The text of an error with those of its causes that it does not have.
pub(crate) fn with_sources(error: &dyn std::error::Error) -> String {
    let mut text = error.to_string();
    let mut source = error.source();
    while let Some(cause) = source {
        let cause_text = cause.to_string();
        if !text.contains(&cause_text) {
            text = format!("{text}: {cause_text}");
        }
        source = cause.source();
    }
    text
}

#[cfg(test)]
mod tests {
    use tokio::net::TcpListener;

    use super::*;

    /// Seen without the cure: "Cannot drop a runtime in a context where blocking is not allowed". A member of a fleet
    /// that was to leave while it connected ended with a panic.
    #[tokio::test]
    async fn opening_may_be_given_up() {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let url = format!("nats://{}", listener.local_addr().unwrap());
        let section: NatsSection = toml::from_str(&format!("url = '{url}'")).unwrap();
        let subscriptions = Subscriptions { capacity: 16, overflow: Overflow::Lost };
        tokio::select! {
            opened = Connection::open(&section, "hall-1", subscriptions) => panic!("{opened:?}"),
            accepted = listener.accept() => assert!(accepted.is_ok()),
        }
    }
}
