//! Metrics of the bridge, its poller, buffer, outputs and readers.

use std::fmt;
use std::sync::atomic::Ordering;

use prometheus_client::registry::Unit;

use super::Writer;
use crate::buffer::CursorStats;
use crate::http::Shared;
use crate::http::hub::MAX_STREAMS;
use crate::output::Health;

pub(super) fn write(to: &mut Writer<'_>, shared: &Shared) -> fmt::Result {
    let bridge = &shared.bridge;
    let config = bridge.config();
    let labels = vec![("id", config.bridge.id.as_str()), ("version", env!("CARGO_PKG_VERSION"))];
    to.info("bridge", "Name and version of the bridge", [labels])?;
    let uptime = bridge.started.elapsed().as_secs_f64();
    to.gauge("bridge_uptime", Some(Unit::Seconds), "Time since the bridge was started", [(vec![], uptime)])?;
    poller(to, shared)?;
    buffer(to, shared)?;
    outputs(to, shared)?;
    let streams = MAX_STREAMS.saturating_sub(shared.hub.streams.available_permits());
    to.gauge("page_streams", None, "Open event streams of the page", [(vec![], as_u64(streams))])?;
    let resyncs = shared.hub.resyncs.load(Ordering::Relaxed);
    let help = "Snapshots sent to readers of the page that were too slow for all changes";
    to.counter("page_resyncs", None, help, [(vec![], resyncs)])
}

fn poller(to: &mut Writer<'_>, shared: &Shared) -> fmt::Result {
    let stats = shared.bridge.poller.stats();
    to.gauge("poller_tags", None, "Tags that are polled", [(vec![], as_u64(stats.tags))])?;
    let help = "Tags that their PLC refuses";
    to.gauge("poller_refused_tags", None, help, [(vec![], as_u64(stats.refused_tags))])?;
    to.counter("poller_samples", None, "Samples of all tags", [(vec![], stats.samples)])?;
    let help = "Samples dropped because the bridge was too slow for its tags";
    to.counter("poller_missed_samples", None, help, [(vec![], stats.missed)])
}

fn buffer(to: &mut Writer<'_>, shared: &Shared) -> fmt::Result {
    let (buffer, limit) = (&shared.bridge.buffer, shared.bridge.config().bridge.buffer.memory.0);
    let help = "Size of the batches in memory";
    to.gauge("buffer_memory", Some(Unit::Bytes), help, [(vec![], as_u64(buffer.bytes()))])?;
    let help = "Limit of the batches in memory";
    to.gauge("buffer_memory_limit", Some(Unit::Bytes), help, [(vec![], limit)])
}

fn outputs(to: &mut Writer<'_>, shared: &Shared) -> fmt::Result {
    let cursors = shared.bridge.buffer.stats();
    let outputs: Vec<(&Health, CursorStats)> =
        shared.bridge.outputs.iter().map(|health| &**health).zip(cursors).collect();
    fn of<V>(
        outputs: &[(&Health, CursorStats)],
        value: impl Fn(&Health, &CursorStats) -> V,
    ) -> Vec<(super::Labels<'static>, V)> {
        let sample =
            |(health, cursor): &(&Health, CursorStats)| (vec![("output", health.name())], value(health, cursor));
        outputs.iter().map(sample).collect()
    }
    let connected = of(&outputs, |health, _| u64::from(health.is_connected()));
    to.gauge("output_connected", None, "1 if the output is connected to its server", connected)?;
    let lag = of(&outputs, |_, cursor| cursor.lag);
    to.gauge("output_lag_batches", None, "Batches that the server has not acknowledged", lag)?;
    let dropped = of(&outputs, |_, cursor| cursor.dropped);
    to.counter(
        "output_dropped_batches",
        None,
        "Batches that the buffer dropped before they were acknowledged",
        dropped,
    )?;
    let batches = of(&outputs, |health, _| health.delivered().0);
    to.counter("output_batches", None, "Batches that the server has acknowledged", batches)?;
    let samples = of(&outputs, |health, _| health.delivered().1);
    to.counter("output_samples", None, "Samples that the server has acknowledged", samples)?;
    let reconnects = of(&outputs, |health, _| health.reconnects());
    to.counter("output_reconnects", None, "Connections that were lost and opened anew", reconnects)
}

fn as_u64(count: usize) -> u64 {
    u64::try_from(count).unwrap_or(u64::MAX)
}
