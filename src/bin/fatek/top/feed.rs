//! Events from the library: samples, states of PLCs, health of links.

use std::time::Duration;

use fatek::Station;
use fatek::link::{LinkState, RoundTripStats, StationState};
use fatek::poll::{Quality, Reason, Sample};
use tokio::sync::mpsc::Sender;
use tokio::time::MissedTickBehavior;

use super::model::{Connection, Counters, Event, Health, Level, Reading, RoundTrip, Trouble};
use crate::printable::printable;

/// The reading of a tag.
pub(super) fn reading(tag: usize, sample: &Sample) -> Reading {
    let level = match &sample.quality {
        Quality::Good => Level::Good,
        Quality::Stale(_) => Level::Stale,
        Quality::Bad(Reason::NotYetRead) => Level::Unread,
        Quality::Bad(_) | _ => Level::Bad,
    };
    let reason = sample.quality.reason();
    let trouble = if let Some(Reason::Failed(error)) = reason { Some(Trouble::of(error)) } else { None };
    Reading {
        tag,
        value: sample.value().cloned(),
        level,
        reason: reason.map(|reason| printable(&reason.to_string()).to_string()).unwrap_or_default(),
        trouble,
        at: sample.at.instant,
    }
}

/// The present health of a station and its link.
pub(super) fn health(station: &Station) -> Health {
    let (stats, state) = (station.stats(), station.link().state());
    let reason = if let LinkState::Down { error, .. } = &state { error.to_string() } else { String::new() };
    let connection = match state {
        LinkState::Idle => Connection::Idle,
        LinkState::Waiting | LinkState::Connecting => Connection::Opening,
        LinkState::Up => Connection::Up,
        LinkState::Down { .. } => Connection::Down,
        LinkState::Closed | _ => Connection::Closed,
    };
    let trip = |stats: RoundTripStats| RoundTrip { last: stats.last, mean: stats.smoothed, longest: stats.longest };
    Health {
        connection,
        reason: printable(&reason).to_string(),
        is_offline: matches!(*station.watch_state().borrow(), StationState::Offline { .. }),
        has_answered: stats.replies > 0,
        counters: Counters {
            round_trip: stats.round_trip.map(trip),
            requests: stats.requests,
            errors: stats.bad_replies.saturating_add(stats.refusals),
            timeouts: stats.timeouts,
            retries: stats.retries,
        },
    }
}

/// Reads the status of a PLC (40) periodically. Ends when the receiver is closed.
pub(super) async fn poll_status(plc: usize, station: Station, interval: Duration, events: Sender<Event>) {
    let station = station.with_options(station.options().with_background(true));
    let mut rounds = tokio::time::interval(interval);
    rounds.set_missed_tick_behavior(MissedTickBehavior::Skip);
    loop {
        rounds.tick().await;
        let status = station.read_status().await;
        let status = status.map(|status| status.flags()).map_err(|error| Trouble::of(&error));
        if events.send(Event::Status { plc, status }).await.is_err() {
            return;
        }
    }
}
