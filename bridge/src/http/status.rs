//! The figures of PLCs, links, buffer and outputs, as the page and `/api/status` show them.

use std::time::{Duration, Instant};

use fatek::link::LinkState;
use fatek::plant::PlantPlc;
use serde::Serialize;

use super::fleet::FleetForm;
use super::rates::Rates;
use super::view::{Grade, View};
use crate::command::CommandStats;
use crate::plc_state::PlcState;
use crate::run::Bridge;

/// All figures.
#[derive(Clone, Debug, Default, Serialize)]
pub(super) struct Status {
    id: String,
    version: &'static str,
    /// Since the bridge was started.
    uptime_seconds: u64,
    tags: TagCounts,
    plcs: Vec<PlcStatus>,
    links: Vec<LinkStatus>,
    poller: PollerStatus,
    buffer: BufferStatus,
    outputs: Vec<OutputStatus>,
    /// `null` if no output takes commands.
    commands: Option<CommandStatus>,
    /// `null` without a fleet.
    fleet: Option<FleetForm>,
}

/// Commands of all PLCs since the start.
#[derive(Clone, Copy, Debug, Default, Serialize)]
struct CommandStatus {
    ok: u64,
    refused: u64,
    /// They may have been executed.
    unknown: u64,
    repeated: u64,
    waiting: usize,
    /// Pulses that have begun and whose end is not confirmed.
    open_pulses: usize,
}

/// Tags by quality.
#[derive(Clone, Copy, Debug, Default, Serialize)]
struct TagCounts {
    good: usize,
    stale: usize,
    bad: usize,
}

#[derive(Clone, Debug, Serialize)]
struct PlcStatus {
    plc: String,
    link: String,
    bus: Option<String>,
    station: u8,
    online: bool,
    /// Why it is not online.
    why: Option<String>,
    /// Smoothed.
    round_trip_ms: Option<f64>,
    tags: TagCounts,
    requests_per_second: Option<f64>,
    requests: u64,
    refusals: u64,
    timeouts: u64,
    retries: u64,
    /// Cycles that were skipped because the one before had not ended.
    overruns: u64,
}

#[derive(Clone, Debug, Serialize)]
struct LinkStatus {
    link: String,
    /// Of its connections, the best one.
    state: &'static str,
    /// Why it is down.
    why: Option<String>,
    plcs: usize,
    /// The part of the time in which the line was in use: 0 to 1.
    load: Option<f64>,
    requests_per_second: Option<f64>,
    connects: u64,
    disconnects: u64,
    connect_failures: u64,
    checksum_errors: u64,
}

#[derive(Clone, Copy, Debug, Default, Serialize)]
struct PollerStatus {
    samples: u64,
    samples_per_second: Option<f64>,
    /// Samples that were dropped because the bridge was too slow for its tags.
    missed: u64,
}

#[derive(Clone, Debug, Default, Serialize)]
struct BufferStatus {
    /// The share of its limit that is used: 0 to 1.
    fill: f64,
    /// The batches that an output lacks.
    batches: u64,
    /// The age of the oldest of them.
    oldest_age_seconds: Option<u64>,
    memory_bytes: u64,
    memory_limit_bytes: u64,
    disk_bytes: u64,
    /// `null` without a disk.
    disk_limit_bytes: Option<u64>,
    /// Why the disk does not take batches.
    failure: Option<String>,
}

#[derive(Clone, Debug, Serialize)]
struct OutputStatus {
    output: &'static str,
    connected: bool,
    failure: Option<String>,
    /// The batches that are not acknowledged.
    lag: u64,
    dropped: u64,
    /// Taken by its server without a subscriber, and thrown away.
    no_subscribers: u64,
    /// Given up, because the server can never take them.
    skipped: u64,
    batches: u64,
    samples: u64,
    samples_per_second: Option<f64>,
    reconnects: u64,
}

/// Counters of the last look, from which the next one gets rates.
#[derive(Debug, Default)]
pub(super) struct Memory {
    rates: Rates,
}

impl Memory {
    /// Collects the figures.
    pub(super) fn status(&mut self, bridge: &Bridge, view: &View, now: Instant) -> Status {
        self.rates.begin(now);
        let plcs = self.plcs(view);
        Status {
            id: bridge.config().bridge.id.to_string(),
            version: env!("CARGO_PKG_VERSION"),
            uptime_seconds: now.saturating_duration_since(bridge.started).as_secs(),
            tags: counts(view, 0..view.states().len()),
            links: self.links(bridge, &plcs),
            plcs,
            poller: self.poller(bridge),
            buffer: buffer(bridge),
            outputs: self.outputs(bridge),
            commands: bridge.commands.as_ref().map(|commands| sum(&commands.stats())),
            fleet: FleetForm::of(bridge),
        }
    }

    fn plcs(&mut self, view: &View) -> Vec<PlcStatus> {
        let mut plcs = Vec::new();
        for plc in view.plcs() {
            let (stats, settings) = (plc.polled.station.stats(), &plc.polled.plc);
            let state = PlcState::of(&plc.polled);
            let (name, link) = (settings.name().to_owned(), link_of(settings));
            plcs.push(PlcStatus {
                requests_per_second: self.rates.rate(format!("plc {name}"), as_f64(stats.requests)),
                plc: name,
                link,
                bus: settings.bus().map(str::to_owned),
                station: settings.station(),
                online: state.online,
                why: state.why,
                round_trip_ms: state.round_trip.map(milliseconds),
                tags: counts(view, plc.places.clone()),
                requests: stats.requests,
                refusals: stats.refusals,
                timeouts: stats.timeouts,
                retries: stats.retries,
                overruns: plc.polled.polled.classes().iter().map(|class| class.overruns).sum(),
            });
        }
        plcs
    }

    fn links(&mut self, bridge: &Bridge, plcs: &[PlcStatus]) -> Vec<LinkStatus> {
        let mut links = Vec::new();
        for endpoint in bridge.pool.endpoints() {
            let (link, traffic) = (endpoint.endpoint.to_string(), &endpoint.traffic);
            let (state, why) = best(&endpoint.links);
            let bus_time = traffic.bus_time.as_secs_f64();
            links.push(LinkStatus {
                state,
                why,
                plcs: plcs.iter().filter(|plc| plc.link == link).count(),
                load: self.rates.rate(format!("bus time {link}"), bus_time).map(|load| load.min(1.0)),
                requests_per_second: self.rates.rate(format!("link {link}"), as_f64(traffic.stations.requests)),
                connects: traffic.connects,
                disconnects: traffic.disconnects,
                connect_failures: traffic.connect_failures,
                checksum_errors: traffic.checksum_errors,
                link,
            });
        }
        // The pool has them in no order.
        links.sort_by(|a, b| a.link.cmp(&b.link));
        links
    }

    fn poller(&mut self, bridge: &Bridge) -> PollerStatus {
        let stats = bridge.poller.stats();
        let samples_per_second = self.rates.rate("samples".to_owned(), as_f64(stats.samples));
        PollerStatus { samples: stats.samples, samples_per_second, missed: stats.missed }
    }

    fn outputs(&mut self, bridge: &Bridge) -> Vec<OutputStatus> {
        let cursors = bridge.buffer.stats();
        let mut outputs = Vec::new();
        for (health, cursor) in bridge.outputs.iter().zip(cursors) {
            let (batches, samples) = health.delivered();
            outputs.push(OutputStatus {
                output: health.kind().name(),
                connected: health.is_connected(),
                failure: health.failure(),
                lag: cursor.lag,
                dropped: cursor.dropped,
                no_subscribers: health.no_subscribers(),
                skipped: health.skipped(),
                batches,
                samples,
                samples_per_second: self.rates.rate(format!("output {}", health.kind().name()), as_f64(samples)),
                reconnects: health.reconnects(),
            });
        }
        outputs
    }
}

/// The text of a link in labels and on the page.
pub(super) fn link_of(plc: &PlantPlc) -> String {
    plc.endpoint().to_string()
}

fn counts(view: &View, places: std::ops::Range<usize>) -> TagCounts {
    let mut counts = TagCounts::default();
    for state in view.states().get(places).unwrap_or_default() {
        // A tag that was not looked at yet has no value.
        match state.as_ref().map_or(Grade::Bad, |state| state.grade) {
            Grade::Good => counts.good += 1,
            Grade::Stale => counts.stale += 1,
            Grade::Bad => counts.bad += 1,
        }
    }
    counts
}

fn buffer(bridge: &Bridge) -> BufferStatus {
    let (figures, config) = (bridge.buffer.figures(), bridge.config());
    let limits = &config.bridge.buffer;
    BufferStatus {
        fill: figures.fill,
        batches: figures.batches,
        oldest_age_seconds: figures.oldest_age.map(|age| age.as_secs()),
        memory_bytes: figures.memory_bytes,
        memory_limit_bytes: limits.memory.0,
        disk_bytes: figures.disk_bytes,
        disk_limit_bytes: limits.dir.is_some().then_some(limits.max.0),
        failure: figures.failure,
    }
}

fn sum(stats: &CommandStats) -> CommandStatus {
    // Those for no PLC are refused, too.
    let first = CommandStatus { refused: stats.no_plc, ..CommandStatus::default() };
    stats.plcs.values().fold(first, |sum, plc| CommandStatus {
        ok: sum.ok.saturating_add(plc.ok),
        refused: sum.refused.saturating_add(plc.refused),
        unknown: sum.unknown.saturating_add(plc.unknown),
        repeated: sum.repeated.saturating_add(plc.repeated),
        waiting: sum.waiting.saturating_add(plc.waiting),
        open_pulses: sum.open_pulses.saturating_add(plc.pulses_open),
    })
}

/// The best state of an endpoint's connections, and why it is not better.
#[expect(clippy::wildcard_enum_match_arm, reason = "the enum of the library may grow")]
fn best(links: &[LinkState]) -> (&'static str, Option<String>) {
    let rank = |link: &LinkState| match link {
        LinkState::Up => (5, "up", None),
        LinkState::Connecting => (4, "connecting", None),
        LinkState::Waiting => (3, "waiting", None),
        LinkState::Down { error, .. } => (2, "down", Some(error.to_string())),
        LinkState::Idle => (1, "idle", None),
        // `Closed`, and a state of a later version.
        _ => (0, "closed", None),
    };
    let best = links.iter().map(rank).max_by_key(|(rank, ..)| *rank);
    best.map_or(("idle", None), |(_, state, why)| (state, why))
}

/// A time as milliseconds, to a microsecond.
fn milliseconds(time: Duration) -> f64 {
    (time.as_secs_f64() * 1e6).round() / 1e3
}

#[expect(clippy::cast_precision_loss, reason = "rates need no more than 15 digits")]
pub(super) fn as_f64(count: u64) -> f64 {
    count as f64
}
