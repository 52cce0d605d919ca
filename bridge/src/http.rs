//! HTTP: the page, its events, metrics, health and the API. Nothing here writes.
//!
//! ```text
//! GET /             page, with /app.js, /style.css …
//! GET /events       server-sent events: a snapshot, then changes
//! GET /metrics      OpenMetrics, or the older text format of Prometheus
//! GET /healthz      200 while the bridge works
//! GET /readyz       200 while the bridge can take data
//! GET /api/tags     each tag with value, quality and age; ?plc=NAME for one PLC
//! GET /api/history  the last values of tags: ?plc=NAME&tags=NAME,NAME
//! GET /api/status   PLCs, links, buffer and outputs
//! ```
//!
//! ```text
//! Registry, Pool, Buffer, Health ──every tick──▶ Hub: View, History, Status
//!                                                 │ one frame for all readers
//!                                                 ▼
//!                                              broadcast ──▶ reader (an event stream)
//! ```
//!
//! Invariants:
//! - all methods besides GET and HEAD are refused: no endpoint writes, so none asks for a token;
//! - a listener of the loopback address answers only requests whose `Host` is a loopback address, because a
//!   page of another site reaches it by a name that resolves to 127.0.0.1 (DNS rebinding);
//! - memory is bounded: connections, event streams, and the frames that a slow reader leaves are limited;
//! - a bad tag has no value, in no answer.

mod api;
mod assets;
mod events;
mod fleet;
mod guard;
mod health;
mod history;
mod hub;
mod metrics;
mod rates;
mod server;
mod status;
mod view;
mod write_timeout;

use std::io;
use std::net::SocketAddr;
use std::sync::Arc;

use axum::Router;
use axum::middleware::from_fn_with_state;
use axum::routing::get;
use tokio::net::{TcpListener, TcpSocket};
use tokio_util::sync::CancellationToken;

use self::guard::Guard;
use self::hub::Hub;
use crate::run::Bridge;

/// An address that cannot be bound.
#[derive(Debug, thiserror::Error)]
#[error("bridge.http: cannot listen on {address}: {error}{}", hint(error))]
pub struct BindError {
    address: SocketAddr,
    error: io::Error,
}

/// The key of the configuration that helps, as part of an error.
fn hint(error: &io::Error) -> &'static str {
    if error.kind() == io::ErrorKind::AddrInUse { "; another program has this port" } else { "" }
}

/// Binds the address of page, metrics and health, within a runtime.
///
/// # Errors
/// [`BindError`], for example if the port is in use.
pub fn bind(address: SocketAddr) -> Result<TcpListener, BindError> {
    listen(address).map_err(|error| BindError { address, error })
}

fn listen(address: SocketAddr) -> io::Result<TcpListener> {
    let socket = if address.is_ipv4() { TcpSocket::new_v4() } else { TcpSocket::new_v6() }?;
    // A bridge that is started anew takes the port over from connections that are ending.
    socket.set_reuseaddr(true)?;
    // Connections inherit it.
    socket.set_send_buffer_size(SEND_BUFFER)?;
    socket.bind(address)?;
    socket.listen(BACKLOG)
}

/// The memory of the system for each connection, which a slow reader fills.
const SEND_BUFFER: u32 = 256 * 1024;
/// The connections that wait to be accepted.
const BACKLOG: u32 = 1024;

/// The parts that handlers share.
#[derive(Clone, Debug)]
struct Shared {
    bridge: Bridge,
    hub: Arc<Hub>,
    stop: CancellationToken,
}

/// Serves until `stop` is cancelled, and then ends all connections within a second.
pub async fn serve(bridge: Bridge, listener: TcpListener, stop: CancellationToken) {
    let address = listener.local_addr();
    if let Ok(address) = address {
        tracing::info!("the page is at http://{address}");
    }
    let is_loopback = address.is_ok_and(|address| address.ip().to_canonical().is_loopback());
    let hub = Arc::new(Hub::new(&bridge));
    let watching = tokio::spawn(hub.clone().run(bridge.clone(), stop.clone()));
    let shared = Shared { bridge, hub, stop: stop.clone() };
    server::accept(listener, router(shared, Guard { is_loopback }), stop).await;
    // It ends with `stop`; it fails only if it panicked, which is in the log.
    let _ = watching.await;
}

fn router(shared: Shared, guard: Guard) -> Router {
    let pages = assets::ASSETS.iter().fold(Router::new(), |router, asset| {
        router.route(asset.path, get(move |headers| assets::answer(asset, headers)))
    });
    pages
        .route("/events", get(events::stream))
        .route("/metrics", get(metrics::answer))
        .route("/healthz", get(health::healthz))
        .route("/readyz", get(health::readyz))
        .route("/api/tags", get(api::tags))
        .route("/api/history", get(api::history))
        .route("/api/status", get(api::status))
        .route("/api/fleet", get(fleet::fleet))
        .with_state(shared)
        .layer(from_fn_with_state(guard, guard::check))
}
