//! The end of the bridge.

use std::time::Duration;

use tokio::task::JoinHandle;
use tokio::time::{sleep, timeout};

use super::outputs::Outputs;
use super::{Bridge, Signals};

/// The time for the outputs to deliver what is in the buffer.
const DRAIN: Duration = Duration::from_secs(5);
/// The time for the links to end their requests.
const CLOSE: Duration = Duration::from_secs(2);
/// The time for outputs and buffer after a second signal.
const HURRY: Duration = Duration::from_millis(500);
/// The time between two looks at the buffer.
const LOOK: Duration = Duration::from_millis(10);

/// Delivers what can be delivered in time, and closes everything. A second signal ends the bridge within a second:
/// returns whether there was one. `is_hurried`: there was one before.
pub(super) async fn drain(
    bridge: &Bridge,
    outputs: Outputs,
    collector: Option<JoinHandle<()>>,
    signals: &mut Signals,
    is_hurried: bool,
) -> bool {
    let delivered = async {
        bridge.poller.close().await;
        if let Some(collector) = collector {
            // A panic was logged by the runtime; the outputs deliver the rest.
            let _ = collector.await;
        }
        while (0..bridge.outputs.len()).any(|number| !bridge.buffer.cursor(number).is_drained()) {
            sleep(LOOK).await;
        }
    };
    // The outputs send the replies.
    let executed = async {
        if let Some(commands) = &bridge.commands {
            commands.close().await;
        }
    };
    let mut hurries = tokio::select! {
        () = std::future::ready(()), if is_hurried => true,
        (delivered, ()) = async { tokio::join!(timeout(DRAIN, delivered), executed) } => {
            if delivered.is_err() {
                tracing::warn!("an output did not take all batches within {DRAIN:?}");
            }
            false
        }
        () = signals.end() => true,
    };
    let in_order = !hurries;
    let closed = async {
        if in_order {
            outputs.stop().await;
            write_buffer(bridge).await;
        } else {
            tokio::join!(outputs.stop(), write_buffer(bridge));
        }
        if timeout(CLOSE, bridge.pool.close()).await.is_err() {
            tracing::warn!("a link did not close within {CLOSE:?}");
        }
    };
    let hurried = async {
        if !hurries {
            signals.end().await;
            hurries = true;
        }
        tracing::warn!("a second signal: the bridge ends without waiting");
        sleep(HURRY).await;
    };
    tokio::select! {
        () = closed => {}
        () = hurried => tracing::error!("not all was ended: batches that were not delivered or written are lost"),
    }
    hurries
}

async fn write_buffer(bridge: &Bridge) {
    if !bridge.buffer.close().await {
        tracing::error!("the buffer was not written: batches that were not delivered are lost");
    }
}
