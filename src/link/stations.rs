//! What the link knows of each station: whether it can be believed, and whether it is there.
//!
//! ```text
//! clean  ──doubt──▶ dirty   ──nonce echoed, or (where loop-backs are refused) silence──▶ clean
//! online ──timeouts in a row──▶ offline ──any answer──▶ online
//! ```
//!
//! Invariant: probes take no more than their share of the bus, however many stations are offline.

use std::time::Duration;

use tokio::time::Instant;

use super::by_station::ByStation;
use super::in_step::InStep;
use super::later;

#[derive(Debug)]
pub(crate) struct Stations {
    known: ByStation<Health>,
    rules: Rules,
    probe_allowed_at: Option<Instant>,
}

/// When a station is offline, and how it is probed.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Rules {
    /// After how many timeouts in a row.
    pub(crate) offline_after: u32,
    /// The shortest and the longest time between two probes of a station.
    pub(crate) probe_interval: (Duration, Duration),
    /// After a probe that took a time, none for so many times as long.
    pub(crate) probe_pause: u32,
}

#[derive(Debug)]
struct Health {
    in_step: InStep,
    /// The longest response timeout that it was ever given.
    allowed: Duration,
    /// Timeouts in a row.
    timeouts: u32,
    offline: Option<Offline>,
    round_trip: RoundTrip,
}

#[derive(Clone, Copy, Debug)]
struct Offline {
    probe_at: Instant,
    interval: Duration,
    /// When it was probed last.
    probed_at: Option<Instant>,
}

impl Stations {
    pub(crate) fn new(rules: Rules) -> Self {
        Self { known: ByStation::new(), rules, probe_allowed_at: None }
    }

    /// What is known of the station's replies; `None`: it has not been asked anything yet.
    pub(crate) fn in_step(&mut self, station: u8) -> Option<&mut InStep> {
        self.known.get_mut(station).map(|health| &mut health.in_step)
    }

    /// Does something with what is known of the station's replies.
    pub(crate) fn with_in_step<R>(&mut self, station: u8, work: impl FnOnce(&mut InStep) -> R) -> R {
        self.health(station, |health| work(&mut health.in_step))
    }

    /// Does something for all stations that have been asked anything.
    pub(crate) fn for_all(&mut self, work: impl Fn(&mut InStep)) {
        self.known.values_mut().for_each(|health| work(&mut health.in_step));
    }

    /// The station is given this long for an answer.
    pub(crate) fn allow(&mut self, station: u8, timeout: Duration) {
        self.health(station, |health| health.allowed = health.allowed.max(timeout));
    }

    /// The longest time that the station was ever given for an answer: what a probe must give it, too.
    pub(crate) fn allowed(&self, station: u8) -> Duration {
        self.known.get(station).map(|health| health.allowed).unwrap_or_default()
    }

    /// The station has answered, within this time; says whether it was offline.
    pub(crate) fn answered(&mut self, station: u8, within: Duration, now: Instant) -> bool {
        let back = self.health(station, |health| {
            health.timeouts = 0;
            health.round_trip.measured(within);
            health.offline.take().is_some()
        });
        if back {
            // What kept it away has most likely kept others away, too.
            self.hurry(now);
        }
        back
    }

    /// The station has not answered within its whole response timeout; says when the first probe is due if it is
    /// offline from now on.
    pub(crate) fn timed_out(&mut self, station: u8, now: Instant) -> Option<Instant> {
        let Rules { offline_after, probe_interval: (interval, _), .. } = self.rules;
        let goes_offline = self.health(station, |health| {
            health.timeouts = health.timeouts.saturating_add(1);
            health.round_trip.timed_out();
            let goes_offline = health.timeouts >= offline_after && health.offline.is_none();
            if goes_offline {
                health.offline = Some(Offline { probe_at: later(now, interval), interval, probed_at: None });
            }
            goes_offline
        });
        if goes_offline { self.offline_until(station) } else { None }
    }

    /// If the station is offline: when it is probed next, or soon after if others are due as well.
    pub(crate) fn offline_until(&self, station: u8) -> Option<Instant> {
        Some(self.not_before_pause(self.known.get(station)?.offline?.probe_at))
    }

    /// Whatever was the matter with the stations may be over: those that are offline are probed at once.
    pub(crate) fn hurry(&mut self, now: Instant) {
        self.probe_allowed_at = None;
        for offline in self.known.values_mut().filter_map(|health| health.offline.as_mut()) {
            offline.probe_at = now;
        }
    }

    /// Takes those that are offline for what they were before anything was known of them, doubts apart; says which.
    pub(crate) fn forget_offline(&mut self) -> Vec<u8> {
        let offline = self.known.iter_mut().filter(|(_, health)| health.offline.is_some());
        let forget = |(station, health): (u8, &mut Health)| {
            health.offline = None;
            health.timeouts = 0;
            station
        };
        offline.map(forget).collect()
    }

    /// The station whose probe is due: of several, the one that has waited longest.
    pub(crate) fn due_probe(&self, now: Instant) -> Option<u8> {
        let probes = self.known.iter().filter_map(|(station, health)| Some((health.offline?, station)));
        let due = probes.filter(|(offline, _)| self.not_before_pause(offline.probe_at) <= now);
        due.min_by_key(|&(offline, station)| (offline.probed_at, station)).map(|(_, station)| station)
    }

    /// When the next probe is due.
    pub(crate) fn next_probe(&self) -> Option<Instant> {
        let due = self.known.values().filter_map(|health| Some(health.offline?.probe_at)).min()?;
        Some(self.not_before_pause(due))
    }

    /// The pause between probes is for the stations that are there: if none is, there is none.
    fn not_before_pause(&self, at: Instant) -> Instant {
        let protects = self.known.values().any(|health| health.offline.is_none());
        self.probe_allowed_at.filter(|_| protects).map_or(at, |allowed| at.max(allowed))
    }

    /// A probe has ended, having used this much of the bus.
    pub(crate) fn probe_ended(&mut self, took: Duration, now: Instant) {
        self.probe_allowed_at = Some(later(now, took.saturating_mul(self.rules.probe_pause)));
    }

    /// A probe of the station was not answered; says when the next one is due.
    pub(crate) fn probe_failed(&mut self, station: u8, now: Instant) -> Option<Instant> {
        let (_, longest) = self.rules.probe_interval;
        let offline = self.known.get_mut(station)?.offline.as_mut()?;
        offline.interval = offline.interval.saturating_mul(2).min(longest);
        offline.probe_at = later(now, offline.interval);
        offline.probed_at = Some(now);
        self.offline_until(station)
    }

    /// How long the station should be given, by what it has needed so far: between the two limits.
    pub(crate) fn patience(&self, station: u8, shortest: Duration, longest: Duration) -> Duration {
        let estimate = self.known.get(station).and_then(|health| health.round_trip.timeout());
        estimate.map_or(longest, |estimate| estimate.max(shortest).min(longest))
    }

    fn health<R>(&mut self, station: u8, work: impl FnOnce(&mut Health) -> R) -> R {
        let new = || Health {
            in_step: InStep::new(),
            allowed: Duration::ZERO,
            timeouts: 0,
            offline: None,
            round_trip: RoundTrip::default(),
        };
        self.known.with(station, new, work)
    }
}

/// The round-trip time, smoothed as TCP does it (RFC 6298).
#[derive(Debug, Default)]
struct RoundTrip {
    smoothed: Option<Duration>,
    deviation: Duration,
    /// How often the estimate has been doubled since the last answer.
    doublings: u32,
}

impl RoundTrip {
    fn measured(&mut self, sample: Duration) {
        self.doublings = 0;
        let Some(smoothed) = self.smoothed else {
            self.smoothed = Some(sample);
            self.deviation = half(sample);
            return;
        };
        let off = smoothed.abs_diff(sample);
        self.deviation = self.deviation.saturating_sub(quarter(self.deviation)).saturating_add(quarter(off));
        let eighth = |time| half(quarter(time));
        self.smoothed = Some(smoothed.saturating_sub(eighth(smoothed)).saturating_add(eighth(sample)));
    }

    fn timed_out(&mut self) {
        self.doublings = self.doublings.saturating_add(1).min(16);
    }

    fn timeout(&self) -> Option<Duration> {
        let timeout = self.smoothed?.saturating_add(self.deviation.saturating_mul(4));
        Some(timeout.saturating_mul(1_u32.checked_shl(self.doublings).unwrap_or(u32::MAX)))
    }
}

fn half(time: Duration) -> Duration {
    time.checked_div(2).unwrap_or_default()
}

fn quarter(time: Duration) -> Duration {
    time.checked_div(4).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: Duration = Duration::from_millis(1);

    fn stations() -> Stations {
        let probe_interval = (Duration::from_secs(1), Duration::from_secs(60));
        Stations::new(Rules { offline_after: 3, probe_interval, probe_pause: 19 })
    }

    #[test]
    fn patience_follows_the_round_trip_between_its_limits_and_doubles_with_each_timeout() {
        let mut stations = stations();
        let now = Instant::now();
        let (shortest, longest) = (20 * MS, 1000 * MS);
        assert_eq!(stations.patience(1, shortest, longest), longest, "nothing is known yet");
        for _ in 0..50 {
            stations.answered(1, 40 * MS, now);
        }
        let steady = stations.patience(1, shortest, longest);
        assert!((40 * MS..45 * MS).contains(&steady), "{steady:?}");
        stations.answered(1, 80 * MS, now);
        assert!(stations.patience(1, shortest, longest) > 75 * MS, "one slow answer asks for more");
        let before = stations.patience(1, shortest, longest);
        stations.timed_out(1, now);
        assert_eq!(stations.patience(1, shortest, longest), 2 * before);
        for _ in 0..50 {
            stations.answered(1, MS, now);
        }
        assert_eq!(stations.patience(1, shortest, longest), shortest);
        for _ in 0..40 {
            stations.timed_out(1, now);
        }
        assert_eq!(stations.patience(1, shortest, longest), longest);
    }

    #[test]
    fn a_station_is_offline_after_three_timeouts_in_a_row_and_probed_ever_less_often() {
        let mut stations = stations();
        let now = Instant::now();
        assert_eq!(stations.timed_out(1, now), None);
        assert_eq!(stations.timed_out(1, now), None);
        stations.answered(1, MS, now);
        assert_eq!(stations.timed_out(1, now), None, "not in a row");
        assert_eq!(stations.timed_out(1, now), None);
        assert_eq!(stations.timed_out(1, now), Some(now + Duration::from_secs(1)));
        let mut waits = Vec::new();
        for _ in 0..8 {
            waits.push(stations.probe_failed(1, now).unwrap().duration_since(now).as_secs());
        }
        assert_eq!(waits, [2, 4, 8, 16, 32, 60, 60, 60]);
        assert!(stations.answered(1, MS, now), "any answer brings it back");
        assert_eq!(stations.offline_until(1), None);
    }

    #[test]
    fn no_probe_follows_another_before_19_times_its_length_while_somebody_else_is_there() {
        let mut stations = stations();
        let now = Instant::now();
        for station in [1, 2] {
            while stations.timed_out(station, now).is_none() {}
        }
        let due = now + Duration::from_secs(1);
        assert_eq!((stations.due_probe(now), stations.due_probe(due)), (None, Some(1)));
        stations.probe_ended(300 * MS, due);
        stations.probe_failed(1, due);
        assert_eq!(stations.due_probe(due), Some(2), "there is nobody whom the pause could serve");
        stations.answered(3, MS, due);
        let allowed = due + 19 * 300 * MS;
        assert_eq!(stations.due_probe(due), None);
        assert_eq!((stations.next_probe(), stations.offline_until(2)), (Some(allowed), Some(allowed)));
        assert_eq!(stations.due_probe(allowed), Some(2));
        stations.answered(2, MS, due);
        assert_eq!(stations.due_probe(due), Some(1), "one is back, perhaps the other is, too");
    }
}
