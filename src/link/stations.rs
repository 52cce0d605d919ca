//! The state of each station: whether it is in step, and whether it is online.
//!
//! ```text
//! in step ──stray, timeout, new connection──▶ suspect ──nonce echoed, or silence──▶ in step   (`in_step`)
//! online  ──timeouts in a row──▶ offline ──any answer──▶ online
//! ```
//!
//! Invariant: probes use no more than their share of the bus, however many stations are offline.

use std::num::NonZeroU64;
use std::time::Duration;

use tokio::time::Instant;

use super::by_station::ByStation;
use super::in_step::InStep;
use super::{later, nanoseconds};

#[derive(Debug)]
pub(crate) struct Stations {
    stations: ByStation<Health>,
    offline_rules: OfflineRules,
    probe_allowed_at: Option<Instant>,
    /// Number of stations that are offline.
    offline: usize,
}

/// When a station is offline, and how it is probed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct OfflineRules {
    /// After this many timeouts in a row.
    pub(crate) offline_after: u32,
    /// The shortest and the longest time between two probes of a station.
    pub(crate) probe_interval: (Duration, Duration),
    /// Pause after a probe, as a multiple of its duration.
    pub(crate) probe_pause: u32,
}

#[derive(Debug)]
struct Health {
    in_step: InStep,
    /// The longest response timeout that the station was ever given, in nanoseconds: half of a `Duration`.
    longest_timeout: u64,
    /// Timeouts in a row.
    timeouts: u32,
    /// Boxed: most stations are online.
    offline: Option<Box<Offline>>,
    round_trip: RoundTrip,
    /// When it was sent something last.
    sent_at: Option<Instant>,
}

#[derive(Clone, Copy, Debug)]
struct Offline {
    probe_at: Instant,
    interval: Duration,
    /// When it was probed last.
    probed_at: Option<Instant>,
}

impl Stations {
    pub(crate) fn new(offline_rules: OfflineRules) -> Self {
        Self { stations: ByStation::new(), offline_rules, probe_allowed_at: None, offline: 0 }
    }

    /// The in-step state of a station. `None`: it was never sent a request.
    pub(crate) fn in_step(&mut self, station: u8) -> Option<&mut InStep> {
        self.stations.get_mut(station).map(|health| &mut health.in_step)
    }

    /// Runs `work` with the in-step state of a station.
    pub(crate) fn with_in_step<R>(&mut self, station: u8, work: impl FnOnce(&mut InStep) -> R) -> R {
        self.health(station, |health| work(&mut health.in_step))
    }

    /// Runs `work` for all stations that were sent a request.
    pub(crate) fn for_all(&mut self, work: impl Fn(&mut InStep)) {
        self.stations.values_mut().for_each(|health| work(&mut health.in_step));
    }

    /// The longest response timeout that the station was ever given; probes use it, too.
    pub(crate) fn longest_timeout(&self, station: u8) -> Duration {
        Duration::from_nanos(self.stations.get(station).map_or(0, |health| health.longest_timeout))
    }

    /// Returns whether the last request to the station was answered in time.
    pub(crate) fn is_answering(&self, station: u8) -> bool {
        self.stations.get(station).is_some_and(|health| health.timeouts == 0)
    }

    /// Notes that the station has answered within this round trip. Returns whether it was offline.
    pub(crate) fn answered(&mut self, station: u8, within: Duration, now: Instant) -> bool {
        let back = self.health(station, |health| {
            health.timeouts = 0;
            health.round_trip.measured(within);
            health.offline.take().is_some()
        });
        if back {
            self.offline = self.offline.saturating_sub(1);
            // The same cause has probably kept other stations away.
            self.probe_soon(now);
        }
        back
    }

    /// Notes that the station has not answered within its full response timeout. Returns when the
    /// first probe is due if the station is offline from now on.
    pub(crate) fn timed_out(&mut self, station: u8, now: Instant) -> Option<Instant> {
        let OfflineRules { offline_after, probe_interval: (interval, _), .. } = self.offline_rules;
        let goes_offline = self.health(station, |health| {
            health.timeouts = health.timeouts.saturating_add(1);
            health.round_trip.timed_out();
            let goes_offline = health.timeouts >= offline_after && health.offline.is_none();
            if goes_offline {
                let offline = Offline { probe_at: later(now, interval), interval, probed_at: None };
                health.offline = Some(Box::new(offline));
            }
            goes_offline
        });
        if !goes_offline {
            return None;
        }
        self.offline = self.offline.saturating_add(1);
        self.offline_until(station)
    }

    /// Returns whether any station is offline.
    #[inline]
    pub(crate) fn has_offline(&self) -> bool {
        self.offline > 0
    }

    /// When the next probe of an offline station is due; later, if others are due as well. `None`:
    /// online.
    pub(crate) fn offline_until(&self, station: u8) -> Option<Instant> {
        if self.offline == 0 {
            return None;
        }
        Some(self.not_before_pause(self.stations.get(station)?.offline.as_ref()?.probe_at))
    }

    /// Makes the probes of all offline stations due now: the cause may be over.
    pub(crate) fn probe_soon(&mut self, now: Instant) {
        self.probe_allowed_at = None;
        for offline in self.stations.values_mut().filter_map(|health| health.offline.as_mut()) {
            offline.probe_at = now;
        }
    }

    /// Restarts the growth of the intervals between probes.
    pub(crate) fn restart_probe_intervals(&mut self) {
        let (shortest, _) = self.offline_rules.probe_interval;
        for offline in self.stations.values_mut().filter_map(|health| health.offline.as_mut()) {
            offline.interval = shortest;
        }
    }

    /// Makes offline stations unknown, but keeps their in-step state. Returns their numbers.
    pub(crate) fn forget_offline(&mut self) -> Vec<u8> {
        self.offline = 0;
        let offline = self.stations.iter_mut().filter(|(_, health)| health.offline.is_some());
        let forget = |(station, health): (u8, &mut Health)| {
            health.offline = None;
            health.timeouts = 0;
            station
        };
        offline.map(forget).collect()
    }

    /// The station whose probe is due; of several, the one probed longest ago.
    pub(crate) fn due_probe(&self, now: Instant) -> Option<u8> {
        if self.offline == 0 {
            return None;
        }
        let probes = self.stations.iter().filter_map(|(station, health)| Some((health.offline.as_deref()?, station)));
        let due = probes.filter(|(offline, _)| self.not_before_pause(offline.probe_at) <= now);
        due.min_by_key(|&(offline, station)| (offline.probed_at, station)).map(|(_, station)| station)
    }

    /// When the next probe is due.
    pub(crate) fn next_probe(&self) -> Option<Instant> {
        if self.offline == 0 {
            return None;
        }
        let due = self.stations.values().filter_map(|health| Some(health.offline.as_ref()?.probe_at)).min()?;
        Some(self.not_before_pause(due))
    }

    /// Delays a probe until the pause after the last one is over. The pause serves stations that
    /// are online; if none is, there is no pause.
    fn not_before_pause(&self, at: Instant) -> Instant {
        let protects = self.stations.values().any(|health| health.offline.is_none());
        self.probe_allowed_at.filter(|_| protects).map_or(at, |allowed| at.max(allowed))
    }

    /// Notes that a probe has ended after this time on the bus.
    pub(crate) fn probe_ended(&mut self, took: Duration, now: Instant) {
        self.probe_allowed_at = Some(later(now, took.saturating_mul(self.offline_rules.probe_pause)));
    }

    /// Notes that a probe was not answered. Returns when the next one is due.
    pub(crate) fn probe_failed(&mut self, station: u8, now: Instant) -> Option<Instant> {
        let (_, longest) = self.offline_rules.probe_interval;
        let offline = self.stations.get_mut(station)?.offline.as_mut()?;
        offline.interval = offline.interval.saturating_mul(2).min(longest);
        offline.probe_at = later(now, offline.interval);
        offline.probed_at = Some(now);
        self.offline_until(station)
    }

    /// The adaptive response timeout of a station, between the limits.
    pub(crate) fn adaptive_timeout(&self, station: u8, shortest: Duration, longest: Duration) -> Duration {
        let estimate = self.stations.get(station).and_then(|health| health.round_trip.timeout());
        estimate.map_or(longest, |estimate| estimate.max(shortest).min(longest))
    }

    /// Notes that the station is sent something: the request of a call, which is given this response
    /// timeout, or one of the link itself. Station 0 has no state.
    #[inline]
    pub(crate) fn note_sent(&mut self, station: u8, timeout: Option<Duration>, now: Instant) {
        if station != 0 {
            self.health(station, |health| {
                health.sent_at = Some(now);
                health.longest_timeout = health.longest_timeout.max(timeout.map_or(0, nanoseconds));
            });
        }
    }

    /// Returns whether the station was sent something within this time.
    pub(crate) fn was_sent_within(&self, station: u8, time: Duration, now: Instant) -> bool {
        let sent_at = self.stations.get(station).and_then(|health| health.sent_at);
        sent_at.is_some_and(|at| now.saturating_duration_since(at) < time)
    }

    /// The round trip of a station, with a margin for its deviation; `None`: not known.
    pub(crate) fn round_trip(&self, station: u8) -> Option<Duration> {
        self.stations.get(station)?.round_trip.expected()
    }

    fn health<R>(&mut self, station: u8, work: impl FnOnce(&mut Health) -> R) -> R {
        let new = || Health {
            in_step: InStep::new(),
            longest_timeout: 0,
            timeouts: 0,
            offline: None,
            round_trip: RoundTrip::default(),
            sent_at: None,
        };
        self.stations.with(station, new, work)
    }
}

/// The round trip, smoothed as TCP does it (RFC 6298). In nanoseconds: each reply is counted, and a
/// `Duration` costs several times as much to divide.
#[derive(Debug, Default)]
struct RoundTrip {
    smoothed: Option<NonZeroU64>,
    deviation: u64,
    /// Number of times that the estimate was doubled since the last answer.
    doublings: u32,
}

fn at_least_one(nanoseconds: u64) -> NonZeroU64 {
    NonZeroU64::new(nanoseconds).unwrap_or(NonZeroU64::MIN)
}

impl RoundTrip {
    fn measured(&mut self, sample: Duration) {
        let sample = nanoseconds(sample);
        self.doublings = 0;
        let Some(smoothed) = self.smoothed.map(NonZeroU64::get) else {
            self.smoothed = Some(at_least_one(sample));
            self.deviation = sample / 2;
            return;
        };
        let off = smoothed.abs_diff(sample);
        self.deviation = self.deviation.saturating_sub(self.deviation / 4).saturating_add(off / 4);
        self.smoothed = Some(at_least_one(smoothed.saturating_sub(smoothed / 8).saturating_add(sample / 8)));
    }

    /// The smoothed round trip, and its deviation or a quarter, whichever is more.
    fn expected(&self) -> Option<Duration> {
        let smoothed = self.smoothed?.get();
        Some(Duration::from_nanos(smoothed.saturating_add(self.deviation.max(smoothed / 4))))
    }

    fn timed_out(&mut self) {
        self.doublings = self.doublings.saturating_add(1).min(16);
    }

    fn timeout(&self) -> Option<Duration> {
        let timeout = self.smoothed?.get().saturating_add(self.deviation.saturating_mul(4));
        Some(Duration::from_nanos(timeout).saturating_mul(1_u32.checked_shl(self.doublings).unwrap_or(u32::MAX)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: Duration = Duration::from_millis(1);

    fn stations() -> Stations {
        let probe_interval = (Duration::from_secs(1), Duration::from_secs(60));
        Stations::new(OfflineRules { offline_after: 3, probe_interval, probe_pause: 19 })
    }

    #[test]
    fn the_adaptive_timeout_follows_round_trips_within_its_limits() {
        let mut stations = stations();
        let now = Instant::now();
        let (shortest, longest) = (20 * MS, 1000 * MS);
        assert_eq!(stations.adaptive_timeout(1, shortest, longest), longest, "no round trip was measured yet");
        for _ in 0..50 {
            stations.answered(1, 40 * MS, now);
        }
        let steady = stations.adaptive_timeout(1, shortest, longest);
        assert!((40 * MS..45 * MS).contains(&steady), "{steady:?}");
        stations.answered(1, 80 * MS, now);
        assert!(stations.adaptive_timeout(1, shortest, longest) > 75 * MS, "one slow answer raises it");
        let before = stations.adaptive_timeout(1, shortest, longest);
        stations.timed_out(1, now);
        assert_eq!(stations.adaptive_timeout(1, shortest, longest), 2 * before);
        for _ in 0..50 {
            stations.answered(1, MS, now);
        }
        assert_eq!(stations.adaptive_timeout(1, shortest, longest), shortest);
        for _ in 0..40 {
            stations.timed_out(1, now);
        }
        assert_eq!(stations.adaptive_timeout(1, shortest, longest), longest);
    }

    #[test]
    fn after_three_timeouts_probes_back_off_up_to_a_minute() {
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
        assert!(stations.answered(1, MS, now), "any answer puts it online");
        assert_eq!(stations.offline_until(1), None);
    }

    #[test]
    fn a_probe_is_followed_by_a_pause_while_any_station_is_online() {
        let mut stations = stations();
        let now = Instant::now();
        for station in [1, 2] {
            while stations.timed_out(station, now).is_none() {}
        }
        let due = now + Duration::from_secs(1);
        assert_eq!((stations.due_probe(now), stations.due_probe(due)), (None, Some(1)));
        stations.probe_ended(300 * MS, due);
        stations.probe_failed(1, due);
        assert_eq!(stations.due_probe(due), Some(2), "no station is online, so there is no pause");
        stations.answered(3, MS, due);
        let allowed = due + 19 * 300 * MS;
        assert_eq!(stations.due_probe(due), None);
        assert_eq!((stations.next_probe(), stations.offline_until(2)), (Some(allowed), Some(allowed)));
        assert_eq!(stations.due_probe(allowed), Some(2));
        stations.answered(2, MS, due);
        assert_eq!(stations.due_probe(due), Some(1), "after one is back, the other is probed at once");
    }
}
