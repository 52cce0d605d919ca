//! Metrics of the bridge, its poller, buffer, outputs and readers.

use std::fmt;
use std::sync::Arc;
use std::sync::atomic::Ordering;

use prometheus_client::registry::Unit;

use super::{Writer, as_u64};
use crate::buffer::CursorStats;
use crate::http::Shared;
use crate::http::hub::MAX_STREAMS;
use crate::output::{Health, RefusedPlc};

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
    let (figures, config) = (shared.bridge.buffer.figures(), shared.bridge.config());
    let limits = &config.bridge.buffer;
    let bytes = || Some(Unit::Bytes);
    to.gauge("buffer_fill_ratio", None, "Share of the buffer's limit that is used", [(vec![], figures.fill)])?;
    to.gauge("buffer_batches", None, "Batches that an output lacks", [(vec![], figures.batches)])?;
    let oldest = figures.oldest_age.map(|age| (vec![], age.as_secs_f64()));
    to.gauge("buffer_oldest_age", Some(Unit::Seconds), "Age of the oldest of them", oldest)?;
    to.gauge("buffer_memory", bytes(), "Batches in memory", [(vec![], figures.memory_bytes)])?;
    to.gauge("buffer_memory_limit", bytes(), "Limit of the batches in memory", [(vec![], limits.memory.0)])?;
    to.gauge("buffer_disk", bytes(), "Batches on disk", [(vec![], figures.disk_bytes)])?;
    let limit = limits.dir.is_some().then_some((vec![], limits.max.0));
    to.gauge("buffer_disk_limit", bytes(), "Limit of the batches on disk", limit)?;
    to.gauge("buffer_file", bytes(), "Length of the file", [(vec![], figures.file_bytes)])?;
    let takes = u64::from(figures.failure.is_none());
    to.gauge("buffer_disk_ok", None, "0 if the disk does not take batches", [(vec![], takes)])?;
    let counters = [
        ("buffer_spilled_batches", "Batches that were written to disk", figures.spilled_batches),
        ("buffer_disk_errors", "Reads and writes of the disk that failed", figures.disk_errors),
        ("buffer_corrupt_files", "Files that were damaged and moved aside", figures.corrupt_files),
        ("buffer_corrupt_batches", "Batches that could not be read back", figures.corrupt_batches),
    ];
    counters.into_iter().try_for_each(|(name, help, count)| to.counter(name, None, help, [(vec![], count)]))
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
            |(health, cursor): &(&Health, CursorStats)| (vec![("output", health.kind().name())], value(health, cursor));
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
    to.counter("output_reconnects", None, "Connections that were lost and opened anew", reconnects)?;
    let no_subscribers = of(&outputs, |health, _| health.no_subscribers());
    let help = "Batches that the server has taken without a subscriber, and thrown away";
    to.counter("output_no_subscriber_batches", None, help, no_subscribers)?;
    let refused = of(&outputs, |health, _| health.refused());
    to.counter("output_refused_messages", None, "Messages that the server has refused", refused)?;
    let skipped = of(&outputs, |health, _| health.skipped());
    to.counter("output_skipped_batches", None, "Batches given up, because the server does not take them", skipped)?;
    refused_plcs(to, shared)
}

/// The PLCs whose batches a server refuses, or has refused.
fn refused_plcs(to: &mut Writer<'_>, shared: &Shared) -> fmt::Result {
    let mut all: Vec<(&'static str, Arc<str>, RefusedPlc)> = Vec::new();
    for health in &shared.bridge.outputs {
        let plcs = shared.bridge.registry.read();
        let known = health.refused_plcs().into_iter().filter(|(plc, _)| plcs.get(plc).is_some());
        all.extend(known.map(|(plc, refused)| (health.kind().name(), plc, refused)));
    }
    let refused = all.iter().map(|(output, plc, of)| (labels(output, plc), u64::from(of.is_refused)));
    to.gauge("output_plc_refused", None, "1 while the server refuses the batches of the PLC", refused)?;
    let dropped = all.iter().map(|(output, plc, of)| (labels(output, plc), of.dropped));
    let help = "Batches given up, because the server refused those of the PLC and took those of others";
    to.counter("output_plc_dropped_batches", None, help, dropped)
}

fn labels<'l>(output: &'l str, plc: &'l str) -> super::Labels<'l> {
    vec![("output", output), ("plc", plc)]
}
