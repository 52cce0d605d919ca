//! Metrics of PLCs, scan classes, links and the pool.

use std::fmt;

use fatek::poll::{ClassStats, Counters};
use fatek::pool::PoolEndpoint;
use fatek::{LinkState, LinkStats, StationStats};
use prometheus_client::registry::Unit;

use super::{Labels, Writer};
use crate::http::Shared;
use crate::plc_state::PlcState;
use crate::registry::PolledPlc;

pub(super) fn write(to: &mut Writer<'_>, shared: &Shared) -> fmt::Result {
    let registry = shared.bridge.registry.read();
    let plcs: Vec<&PolledPlc> = registry.iter().collect();
    stations(to, &plcs)?;
    classes(to, shared, &plcs)?;
    drop(registry);
    links(to, shared)?;
    pool(to, shared)
}

/// A counter of some statistics: the end of its name, its help, and its value.
type Counter<S> = (&'static str, &'static str, fn(&S) -> u64);

/// The statistics of a PLC with its labels.
type LabelledStation = (Vec<(&'static str, String)>, StationStats, PlcState);

/// Counters of a station.
const STATION_COUNTERS: [Counter<StationStats>; 12] = [
    ("requests", "Requests sent, retries included", |stats| stats.requests),
    ("replies", "Replies, refusals included", |stats| stats.replies),
    ("refusals", "Replies with an error code", |stats| stats.refusals),
    ("timeouts", "Requests and checks that were not answered in time", |stats| stats.timeouts),
    ("bad_replies", "Replies that were corrupt or of another shape", |stats| stats.bad_replies),
    ("retries", "Requests that were sent again", |stats| stats.retries),
    ("checks", "Loop-back requests of the link itself", |stats| stats.checks),
    ("silences", "Silences that replaced a check", |stats| stats.silences),
    ("unproven_replies", "Replies without proof that they answer the request", |stats| stats.unproven_replies),
    ("duplicates", "Duplicates of replies", |stats| stats.duplicates),
    ("late_replies", "Replies to requests that had timed out", |stats| stats.late_replies),
    ("stray_frames", "Frames that did not answer the request on the wire", |stats| stats.stray_frames),
];

fn stations(to: &mut Writer<'_>, plcs: &[&PolledPlc]) -> fmt::Result {
    let labels = |plc: &'_ PolledPlc| vec![("plc", plc.plc.name().to_owned())];
    let stats: Vec<LabelledStation> =
        plcs.iter().map(|plc| (labels(plc), plc.station.stats(), PlcState::of(plc))).collect();
    let online = stats.iter().map(|(labels, _, state)| (refs(labels), u64::from(state.online)));
    to.gauge("plc_online", None, "1 if the PLC has answered and its link is not down", online)?;
    let round_trips =
        stats.iter().filter_map(|(labels, _, state)| Some((refs(labels), state.round_trip?.as_secs_f64())));
    to.gauge("plc_round_trip", Some(Unit::Seconds), "Time from request to reply, a moving average", round_trips)?;
    for (name, help, count) in STATION_COUNTERS {
        let counts = stats.iter().map(|(labels, stats, _)| (refs(labels), count(stats)));
        to.counter(&format!("plc_{name}"), None, help, counts)?;
    }
    Ok(())
}

/// Counters of a scan class.
const CLASS_COUNTERS: [Counter<Counters>; 4] = [
    ("cycles", "Cycles that were started", |class| class.cycles),
    ("overruns", "Cycles that were skipped because the one before had not ended", |class| class.overruns),
    ("abandoned_cycles", "Cycles that were abandoned because a reply did not come", |class| class.abandoned),
    ("refused_requests", "Requests that the PLC refused", |class| class.refusals),
];

fn classes(to: &mut Writer<'_>, shared: &Shared, plcs: &[&PolledPlc]) -> fmt::Result {
    let config = shared.bridge.config();
    let name = |stats: &ClassStats| {
        let named = config.plant.classes().find(|class| class.scan_class() == stats.class);
        named.map_or("default", fatek::plant::PlantClass::name).to_owned()
    };
    let mut classes = Vec::new();
    for plc in plcs {
        for class in plc.polled.classes() {
            classes.push((vec![("plc", plc.plc.name().to_owned()), ("class", name(&class))], class));
        }
    }
    let of = |value: fn(&ClassStats) -> f64| classes.iter().map(move |(labels, class)| (refs(labels), value(class)));
    to.gauge(
        "class_period",
        Some(Unit::Seconds),
        "Period of the scan class",
        of(|class| class.class.period().as_secs_f64()),
    )?;
    to.gauge(
        "class_last_cycle",
        Some(Unit::Seconds),
        "Duration of the last cycle",
        of(|class| class.last_cycle.as_secs_f64()),
    )?;
    let counts = |value: fn(&ClassStats) -> usize| {
        classes.iter().map(move |(labels, class)| (refs(labels), u64::try_from(value(class)).unwrap_or(u64::MAX)))
    };
    to.gauge("class_tags", None, "Tags in the scan class", counts(|class| class.tags))?;
    let help = "Requests that read all tags of the scan class once";
    to.gauge("class_requests_per_cycle", None, help, counts(|class| class.requests_per_cycle))?;
    for (name, help, count) in CLASS_COUNTERS {
        let counts = classes.iter().map(|(labels, class)| (refs(labels), count(class)));
        to.counter(&format!("class_{name}"), None, help, counts)?;
    }
    Ok(())
}

/// Counters of a link.
const LINK_COUNTERS: [Counter<LinkStats>; 12] = [
    ("connects", "Connections opened", |link| link.connects),
    ("disconnects", "Connections lost", |link| link.disconnects),
    ("connect_failures", "Attempts to connect that failed", |link| link.connect_failures),
    ("idle_closes", "Connections closed because the link was idle", |link| link.idle_closes),
    ("mute_connections", "Connections replaced because nothing was answered", |link| link.mute_connections),
    ("requests", "Requests sent to all of its PLCs", |link| link.stations.requests),
    ("timeouts", "Requests and checks that were not answered in time", |link| link.stations.timeouts),
    ("checksum_errors", "Frames with a bad checksum", |link| link.checksum_errors),
    ("late_datagrams", "Datagrams that came to the port of an earlier request", |link| link.late_datagrams),
    ("echoes", "Echoes of requests from an RS-485 adapter", |link| link.echoes),
    ("long_gaps", "Times that the frame gap became long", |link| link.long_gaps),
    ("withheld_requests", "Requests not sent, since this member of a fleet did not own the link", |link| link.withheld),
];

fn links(to: &mut Writer<'_>, shared: &Shared) -> fmt::Result {
    let mut endpoints: Vec<(Vec<(&'static str, String)>, PoolEndpoint)> = shared
        .bridge
        .pool
        .endpoints()
        .into_iter()
        .map(|endpoint| (vec![("link", endpoint.endpoint.to_string())], endpoint))
        .collect();
    endpoints.sort_by(|(a, _), (b, _)| a.cmp(b));
    let up = |endpoint: &PoolEndpoint| endpoint.links.iter().any(|link| matches!(link, LinkState::Up));
    let ups = endpoints.iter().map(|(labels, endpoint)| (refs(labels), u64::from(up(endpoint))));
    to.gauge("link_up", None, "1 if the link has a connection", ups)?;
    for (name, help, count) in LINK_COUNTERS {
        let counts = endpoints.iter().map(|(labels, endpoint)| (refs(labels), count(&endpoint.traffic)));
        to.counter(&format!("link_{name}"), None, help, counts)?;
    }
    let garbage = endpoints.iter().map(|(labels, endpoint)| (refs(labels), endpoint.traffic.garbage_bytes));
    to.counter("link_garbage", Some(Unit::Bytes), "Bytes that were part of no good frame", garbage)?;
    let busy = endpoints.iter().map(|(labels, endpoint)| (refs(labels), endpoint.traffic.bus_time.as_secs_f64()));
    to.counter("link_busy", Some(Unit::Seconds), "Time in which the line was in use", busy)
}

fn pool(to: &mut Writer<'_>, shared: &Shared) -> fmt::Result {
    let stats = shared.bridge.pool.stats();
    let states = [
        ("idle", stats.idle),
        ("waiting", stats.waiting),
        ("connecting", stats.connecting),
        ("up", stats.up),
        ("down", stats.down),
        ("closed", stats.closed),
    ];
    let links = states.map(|(state, count)| (vec![("state", state)], u64::try_from(count).unwrap_or(u64::MAX)));
    to.gauge("pool_links", None, "Links by state", links)?;
    to.counter("pool_evicted_endpoints", None, "Endpoints that were evicted", [(vec![], stats.evicted)])
}

/// Borrows the values of labels.
fn refs<'l>(labels: &'l [(&'static str, String)]) -> Labels<'l> {
    labels.iter().map(|(name, value)| (*name, value.as_str())).collect()
}
