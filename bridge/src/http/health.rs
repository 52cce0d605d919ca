//! Health: whether the bridge works, and whether it can take data.

use std::time::Duration;

use axum::extract::State;
use axum::http::StatusCode;

use super::Shared;
use crate::liveness::HANGS_AFTER;

type Answer = (StatusCode, &'static str);

/// 200 while the bridge works: its registry is not locked up, and its collector runs.
pub(super) async fn healthz(State(shared): State<Shared>) -> Answer {
    health(shared.hub.lock().looked.elapsed().max(shared.bridge.liveness.age()))
}

fn health(since_look: Duration) -> Answer {
    if since_look < HANGS_AFTER {
        (StatusCode::OK, "ok\n")
    } else {
        (StatusCode::SERVICE_UNAVAILABLE, "the bridge hangs\n")
    }
}

/// 200 while the bridge can take data: its buffer is not full. A PLC that does not answer does not matter.
pub(super) async fn readyz(State(shared): State<Shared>) -> Answer {
    readiness(shared.bridge.buffer.figures().is_full)
}

fn readiness(is_full: bool) -> Answer {
    if is_full {
        (StatusCode::SERVICE_UNAVAILABLE, "the buffer is full: the oldest data are dropped\n")
    } else {
        (StatusCode::OK, "ok\n")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_bridge_that_hangs_is_not_healthy() {
        assert_eq!(health(Duration::from_secs(3)).0, StatusCode::OK);
        assert_eq!(health(HANGS_AFTER).0, StatusCode::SERVICE_UNAVAILABLE);
    }

    #[test]
    fn a_full_buffer_is_not_ready() {
        assert_eq!(readiness(false).0, StatusCode::OK);
        assert_eq!(readiness(true).0, StatusCode::SERVICE_UNAVAILABLE);
    }
}
