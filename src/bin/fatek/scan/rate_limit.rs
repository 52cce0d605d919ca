//! Rate of a scan: the times of TCP connections and UDP datagrams. No clock.

use std::time::Duration;

/// Spreads connections and datagrams evenly: no two are closer than the interval. Times count from the
/// beginning of the scan.
///
/// Invariant: in any time of length T, at most T / interval + 1 places are reserved, also after a
/// pause: unused places are not saved up.
#[derive(Debug)]
pub(crate) struct RateLimit {
    interval: Duration,
    next: Duration,
}

impl RateLimit {
    /// A limit of this number of places per second; 0 is taken as 1.
    pub(crate) fn per_second(rate: u32) -> Self {
        Self { interval: Duration::from_secs(1) / rate.max(1), next: Duration::ZERO }
    }

    /// Reserves the next place. Returns the time to wait for it.
    pub(crate) fn reserve(&mut self, now: Duration) -> Duration {
        let at = self.next.max(now);
        self.next = at + self.interval;
        at - now
    }
}

/// Time of a scan if no host answers. Hosts that answer take longer, each for itself.
///
/// `places`: connections and datagrams of each host. `time`: for each host.
pub(crate) fn if_silent(hosts: u128, at_once: u32, time: Duration, places: u32, rate: u32) -> Duration {
    let hosts = u64::try_from(hosts).unwrap_or(u64::MAX);
    let rounds = u32::try_from(hosts.div_ceil(at_once.max(1).into())).unwrap_or(u32::MAX);
    let by_rate = hosts.saturating_mul(places.into()).div_ceil(rate.max(1).into());
    time.saturating_mul(rounds).max(Duration::from_secs(by_rate))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_time_of_silent_hosts_follows_from_their_number_or_the_rate() {
        let seconds = Duration::from_secs;
        assert_eq!(if_silent(254, 128, seconds(5), 2, 100), seconds(10));
        assert_eq!(if_silent(254, 128, seconds(5), 2, 10), seconds(51));
        assert_eq!(if_silent(0, 0, seconds(5), 2, 0), seconds(0));
        assert!(if_silent(u128::MAX, 1, seconds(5), 2, 1) > seconds(1 << 30));
    }

    #[test]
    fn places_are_spread_evenly() {
        let (mut limit, ms) = (RateLimit::per_second(100), Duration::from_millis);
        let waits: Vec<Duration> = (0..4).map(|_| limit.reserve(ms(0))).collect();
        assert_eq!(waits, [ms(0), ms(10), ms(20), ms(30)]);
        assert_eq!(limit.reserve(ms(35)), ms(5));
        // A pause gives no right to a burst.
        let waits: Vec<Duration> = (0..3).map(|_| limit.reserve(ms(1000))).collect();
        assert_eq!(waits, [ms(0), ms(10), ms(20)]);
        assert_eq!(RateLimit::per_second(0).interval, ms(1000));
    }
}
