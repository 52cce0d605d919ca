//! The listener: accepts a limited number of connections, each with time limits.

use std::sync::Arc;
use std::time::Duration;

use axum::Router;
use hyper::server::conn::http1;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::Semaphore;
use tokio::time::{sleep, timeout};
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;

use super::write_timeout::WriteTimeout;

/// The connections at once; others wait in the queue of the system.
const MAX_CONNECTIONS: usize = 128;
/// The time for the head of a request, also of the next one of an open connection.
const HEAD_TIMEOUT: Duration = Duration::from_secs(15);
/// The time without progress of a write after which a connection is closed.
const WRITE_TIMEOUT: Duration = Duration::from_secs(30);
/// The largest head of a request, and what is buffered of an answer.
const MAX_BUFFER: usize = 64 * 1024;
/// The pause after a failure to accept, for example without free file descriptors.
const ACCEPT_PAUSE: Duration = Duration::from_millis(500);
/// The time for answers that are on their way when it stops.
const END: Duration = Duration::from_secs(1);

/// Serves connections until `stop` is cancelled.
pub(super) async fn accept(listener: TcpListener, router: Router, stop: CancellationToken) {
    let permits = Arc::new(Semaphore::new(MAX_CONNECTIONS));
    let connections = TaskTracker::new();
    let next = async || {
        // The semaphore is never closed.
        let permit = permits.clone().acquire_owned().await.ok()?;
        let (stream, _) = match listener.accept().await {
            Ok(accepted) => accepted,
            Err(error) => {
                tracing::warn!(%error, "cannot accept a connection of HTTP");
                sleep(ACCEPT_PAUSE).await;
                return None;
            }
        };
        Some((permit, stream))
    };
    while let Some(accepted) = stop.run_until_cancelled(next()).await {
        let Some((permit, stream)) = accepted else { continue };
        let (router, stop) = (router.clone(), stop.clone());
        connections.spawn(async move {
            serve(stream, router, stop).await;
            drop(permit);
        });
    }
    connections.close();
    // Those that are still open after the time end with the runtime.
    let _ = timeout(END, connections.wait()).await;
}

async fn serve(stream: TcpStream, router: Router, stop: CancellationToken) {
    // A frame of events is written at once; a failure costs time alone.
    let _ = stream.set_nodelay(true);
    let stream = TokioIo::new(WriteTimeout::new(stream, WRITE_TIMEOUT));
    let mut http = http1::Builder::new();
    http.timer(TokioTimer::new()).header_read_timeout(HEAD_TIMEOUT).max_buf_size(MAX_BUFFER);
    let connection = http.serve_connection(stream, TowerToHyperService::new(router));
    let mut connection = std::pin::pin!(connection);
    let result = tokio::select! {
        result = connection.as_mut() => result,
        () = stop.cancelled() => {
            connection.as_mut().graceful_shutdown();
            connection.await
        }
    };
    if let Err(error) = result {
        tracing::debug!(%error, "a connection of HTTP ended");
    }
}
