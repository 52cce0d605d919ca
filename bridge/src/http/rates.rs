//! Rates of counters, smoothed so that they can be read.

use std::collections::HashMap;
use std::time::{Duration, Instant};

/// The time over which rates are smoothed.
const SMOOTHING: Duration = Duration::from_secs(5);

/// Rates of counters by key. No clock.
#[derive(Debug, Default)]
pub(super) struct Rates {
    counters: HashMap<String, Counter>,
    now: Option<Instant>,
    /// Since the look before.
    elapsed: Duration,
}

#[derive(Debug)]
struct Counter {
    last: f64,
    rate: Option<f64>,
    seen: Instant,
}

impl Rates {
    /// Begins a look at the counters. Forgets those that the look before did not have.
    pub(super) fn begin(&mut self, now: Instant) {
        if let Some(before) = self.now {
            self.elapsed = now.saturating_duration_since(before);
            self.counters.retain(|_, counter| counter.seen == before);
        }
        self.now = Some(now);
    }

    /// The rate of a counter per second; `None` at the first look.
    pub(super) fn rate(&mut self, key: String, count: f64) -> Option<f64> {
        let now = self.now?;
        let seconds = self.elapsed.as_secs_f64();
        let counter = self.counters.entry(key).or_insert(Counter { last: count, rate: None, seen: now });
        if counter.seen != now && seconds > 0.0 {
            // A counter that became smaller was reset.
            let rate = ((count - counter.last) / seconds).max(0.0);
            let weight = 1.0 - (-seconds / SMOOTHING.as_secs_f64()).exp();
            counter.rate = Some(counter.rate.map_or(rate, |before| before + (rate - before) * weight));
            counter.last = count;
        }
        counter.seen = now;
        counter.rate
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rates_follow_their_counters_smoothly() {
        let mut rates = Rates::default();
        let start = Instant::now();
        let mut at = |second: u64, count: f64| {
            rates.begin(start + Duration::from_secs(second));
            (rates.rate("a".to_owned(), count), rates.counters.len())
        };
        assert_eq!(at(0, 100.0), (None, 1));
        assert_eq!(at(1, 150.0), (Some(50.0), 1));
        let (slower, _) = at(2, 150.0);
        assert!(slower.is_some_and(|rate| (40.0..42.0).contains(&rate)), "{slower:?}");
        let (idle, _) = (3..60).map(|second| at(second, 150.0)).last().unwrap();
        assert!(idle.is_some_and(|rate| rate < 0.01), "{idle:?}");
        // The counter was reset.
        assert!(at(60, 3.0).0.is_some_and(|rate| (0.0..0.01).contains(&rate)));
        rates.begin(start + Duration::from_secs(61));
        rates.begin(start + Duration::from_secs(62));
        assert!(rates.counters.is_empty(), "counters that are gone are forgotten");
    }
}
