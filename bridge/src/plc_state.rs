//! The state of a PLC, as outputs publish it: whether it answers, why it does not, and its round trip.

use std::time::Duration;

use bytes::Bytes;
use fatek::link::{LinkState, StationState};
use serde_json::json;

use crate::registry::PolledPlc;

/// Availability of a PLC, with the reason and the round trip.
#[derive(Clone, Debug, PartialEq)]
pub struct PlcState {
    /// `true` if it has answered and its link is not down.
    pub online: bool,
    /// Why it is not online.
    pub why: Option<String>,
    /// The smoothed round trip, if it has ever answered.
    pub round_trip: Option<Duration>,
}

impl PlcState {
    /// The present state. Does no I/O.
    #[must_use]
    pub fn of(plc: &PolledPlc) -> Self {
        let station = *plc.station.watch_state().borrow();
        let round_trip = plc.station.stats().round_trip.map(|times| times.smoothed);
        Self::new(station, &plc.station.link().state(), round_trip)
    }

    /// The state of a PLC that a member of a fleet has lost, so that perhaps none polls it.
    #[must_use]
    pub fn without_member() -> Self {
        Self { online: false, why: Some("fleet: no member polls it".to_owned()), round_trip: None }
    }

    fn new(station: StationState, link: &LinkState, round_trip: Option<Duration>) -> Self {
        let why = match (link, station) {
            (LinkState::Down { error, .. }, _) => Some(format!("link: {error}")),
            (LinkState::Closed, _) => Some("link: closed".to_owned()),
            (_, StationState::Online) => None,
            (_, StationState::Offline { .. }) => Some("no answer".to_owned()),
            // `Unknown`, and states of later versions.
            (_, _) => Some("no answer yet".to_owned()),
        };
        Self { online: why.is_none(), why, round_trip }
    }

    /// Returns whether it must be published again. Another round trip, which changes all the time, does not count;
    /// the first one does.
    #[must_use]
    pub fn differs_from(&self, other: &Self) -> bool {
        let (first, second) = (self.round_trip.is_some(), other.round_trip.is_some());
        (self.online, &self.why, first) != (other.online, &other.why, second)
    }

    /// `{"online":true,"rtt_ms":2.1}`, or `{"online":false,"why":"no answer"}`.
    #[must_use]
    pub fn to_json(&self) -> Bytes {
        let mut state = json!({ "online": self.online });
        if let Some(why) = &self.why {
            state["why"] = json!(why);
        }
        if let Some(round_trip) = self.round_trip {
            state["rtt_ms"] = json!((round_trip.as_secs_f64() * 10_000.0).round() / 10.0);
        }
        state.to_string().into()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_plc_is_online_when_it_answers_and_its_link_is_not_down() {
        let rtt = Some(Duration::from_micros(2149));
        let online = PlcState::new(StationState::Online, &LinkState::Up, rtt);
        assert_eq!(online.to_json(), r#"{"online":true,"rtt_ms":2.1}"#);
        // An idle link is opened by the next request.
        assert!(PlcState::new(StationState::Online, &LinkState::Idle, rtt).online);
        let unknown = PlcState::new(StationState::Unknown, &LinkState::Connecting, None);
        assert_eq!(unknown.to_json(), r#"{"online":false,"why":"no answer yet"}"#);
        assert!(!PlcState::new(StationState::Online, &LinkState::Closed, rtt).online);
    }

    #[test]
    fn another_round_trip_alone_is_no_change() {
        let state = |ms| PlcState::new(StationState::Online, &LinkState::Up, Some(Duration::from_millis(ms)));
        assert!(!state(2).differs_from(&state(3)));
        // It can be known later than the reply.
        assert!(state(2).differs_from(&PlcState::new(StationState::Online, &LinkState::Up, None)));
        assert!(state(2).differs_from(&PlcState::new(StationState::Unknown, &LinkState::Up, None)));
    }
}
