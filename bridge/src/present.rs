//! Present values after an outage: all tags are reported again, also those that are reported on change alone.
//!
//! A batch that is late is a replay. Home Assistant and others who want present values leave it out, since an old
//! alarm is no alarm. So after an outage they know nothing of a tag that has changed during it, until it changes
//! again. The same holds for users who were not there when a value was sent: after a start of Home Assistant, of
//! the broker or of the bridge.
//!
//! ```text
//! Cursor: the last replay is acknowledged, and nothing is late ──┐
//! Home Assistant has got its entities ───────────────────────────┼─▶ this task ──▶ PolledStation::report_all
//! the broker takes the batches of a PLC again ───────────────────┘                     │ samples
//!                                   outputs ◀── buffer ◀── batches ◀── collector ◀─────┘
//! ```
//!
//! Decisions:
//! - The samples come from the poller, in its queue. So they are in step with those of readings: the samples of
//!   a tag keep their order, `seq` grows as ever, and acknowledgement, buffer and replays need no exception.
//!   A batch made by the output would have no `seq`, and could overtake one with an older value.
//! - A good value has the time of its reply, and so has its batch: tags of other times are in other batches. A
//!   stale or bad one has no value, as ever. So no old value gets a new time.
//! - They go behind the backlog: before its end they would be late themselves.
//! - All outputs get them, since they share the buffer. They are rare: at most one round each 10 s.

use std::time::Duration;

use fatek::poll::PolledStation;
use tokio::time::sleep;

use crate::buffer::Buffer;
use crate::registry::Registry;

/// The time between two rounds: a connection that is lost again and again must not multiply the data.
const PAUSE: Duration = Duration::from_secs(10);
/// The samples that are queued at once: far fewer than the queue of the poller takes.
const MAX_AT_ONCE: usize = 2_000;
/// The time in which the collector takes them.
const BREATH: Duration = Duration::from_millis(20);

/// Reports all tags each time that the buffer says so. Never returns.
pub async fn run(buffer: Buffer, registry: Registry) {
    loop {
        buffer.present_values_wanted().await;
        report(&registry).await;
        sleep(PAUSE).await;
    }
}

async fn report(registry: &Registry) {
    let polled: Vec<PolledStation> = registry.read().iter().map(|plc| plc.polled.clone()).collect();
    tracing::debug!(plcs = polled.len(), "the present values of all tags are delivered");
    let mut queued: usize = 0;
    for station in polled {
        queued = queued.saturating_add(station.report_all());
        if queued >= MAX_AT_ONCE {
            queued = 0;
            sleep(BREATH).await;
        }
    }
}
