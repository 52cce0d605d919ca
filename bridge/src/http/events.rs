//! The event stream of the page: a snapshot, and then changes.

use std::time::Duration;

use axum::body::{Body, Bytes};
use axum::extract::State;
use axum::http::StatusCode;
use axum::http::header::{self, HeaderName};
use axum::response::{IntoResponse as _, Response};
use futures::stream;
use tokio::sync::OwnedSemaphorePermit;
use tokio::sync::broadcast::{self, error::RecvError};
use tokio::time::timeout;

use super::Shared;
use super::hub::MAX_STREAMS;

/// The time without an event after which a comment shows that the connection is alive.
const HEARTBEAT: Duration = Duration::from_secs(10);
/// A comment, which browsers ignore.
const COMMENT: Bytes = Bytes::from_static(b": alive\n\n");
/// The time before a browser connects anew.
const RETRY: Bytes = Bytes::from_static(b"retry: 2000\n\n");

/// An event stream that a reader is connected to.
struct Reader {
    shared: Shared,
    /// The answer to what comes first, second …
    state: Progress,
    /// One stream of a limited number.
    _permit: OwnedSemaphorePermit,
}

enum Progress {
    New,
    Joining,
    Following(broadcast::Receiver<Bytes>),
}

/// Answers with the events, until the bridge stops.
pub(super) async fn stream(State(shared): State<Shared>) -> Response {
    let Ok(permit) = shared.hub.streams.clone().try_acquire_owned() else {
        let why = format!("there are {MAX_STREAMS} readers already\n");
        return (StatusCode::SERVICE_UNAVAILABLE, [(header::RETRY_AFTER, "10")], why).into_response();
    };
    let reader = Reader { shared, state: Progress::New, _permit: permit };
    let events = stream::unfold(reader, |mut reader| async {
        let event = reader.next().await?;
        Some((Ok::<_, std::convert::Infallible>(event), reader))
    });
    // The last one tells a proxy (nginx) to pass events on at once.
    let headers = [
        (header::CONTENT_TYPE, "text/event-stream"),
        (header::CACHE_CONTROL, "no-store"),
        (HeaderName::from_static("x-accel-buffering"), "no"),
    ];
    (headers, Body::from_stream(events)).into_response()
}

impl Reader {
    /// The next event; `None` when the bridge stops.
    async fn next(&mut self) -> Option<Bytes> {
        let (snapshot, frames) = match &mut self.state {
            Progress::New => {
                self.state = Progress::Joining;
                return Some(RETRY);
            }
            Progress::Joining => self.shared.hub.join(),
            Progress::Following(frames) => {
                let next = self.shared.stop.run_until_cancelled(timeout(HEARTBEAT, frames.recv())).await?;
                match next {
                    Ok(Ok(frame)) => return Some(frame),
                    Ok(Err(RecvError::Lagged(_))) => self.shared.hub.join_again(),
                    Ok(Err(RecvError::Closed)) => return None,
                    Err(_) => return Some(COMMENT),
                }
            }
        };
        self.state = Progress::Following(frames);
        Some(snapshot)
    }
}
