//! Response times of an examination, as figures and as a histogram.

use std::time::Duration;

use serde_json::{Value, json};

/// Upper ends of the bars, in milliseconds. The last bar has all longer times.
const BARS: [u32; 10] = [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000];
/// Characters of the longest bar.
const WIDTH: usize = 40;

/// Response times in ascending order; at least one.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Times(Vec<Duration>);

impl Times {
    /// `None` without a time.
    pub(crate) fn new(mut times: Vec<Duration>) -> Option<Self> {
        times.sort_unstable();
        (!times.is_empty()).then_some(Self(times))
    }

    /// The time that this many thousandths of all do not exceed (nearest rank).
    fn quantile(&self, per_mille: usize) -> Duration {
        let rank = (self.0.len() * per_mille).div_ceil(1000).max(1);
        self.0.get(rank - 1).or(self.0.last()).copied().unwrap_or_default()
    }

    fn figures(&self) -> [(&'static str, Duration); 5] {
        [("min", 0), ("median", 500), ("p95", 950), ("p99", 990), ("max", 1000)]
            .map(|(name, n)| (name, self.quantile(n)))
    }

    /// The number of times in each bar.
    fn bars(&self) -> Vec<(String, usize)> {
        let place = |time: &Duration| BARS.iter().position(|&end| *time <= Duration::from_millis(end.into()));
        let mut counts = vec![0; BARS.len() + 1];
        for time in &self.0 {
            counts[place(time).unwrap_or(BARS.len())] += 1;
        }
        let names = BARS.iter().map(|end| format!("to {end} ms")).chain([format!("over {} ms", BARS[BARS.len() - 1])]);
        names.zip(counts).collect()
    }

    /// One line of figures, and a line for each bar from the first to the last that is not empty.
    pub(crate) fn lines(&self) -> Vec<String> {
        let figures = self.figures().map(|(name, time)| format!("{name} {:.1}", millis(time)));
        let mut lines = vec![format!("{} short replies, in ms: {}", self.0.len(), figures.join(", "))];
        let bars = self.bars();
        let most = bars.iter().map(|(_, count)| *count).max().unwrap_or(1).max(1);
        let first = bars.iter().position(|(_, count)| *count > 0).unwrap_or(0);
        let behind = bars.iter().rposition(|(_, count)| *count > 0).map_or(bars.len(), |last| last + 1);
        for (name, count) in &bars[first..behind] {
            let line = format!("{name:>12} {count:>5} {}", "#".repeat((count * WIDTH).div_ceil(most)));
            lines.push(line.trim_end().to_owned());
        }
        lines
    }

    pub(crate) fn json(&self) -> Value {
        let figures = self.figures().map(|(name, time)| (name.to_owned(), json!((millis(time) * 1e3).round() / 1e3)));
        let bars: Value = self.bars().into_iter().map(|(name, count)| (name, Value::from(count))).collect();
        let mut document = json!({ "replies": self.0.len() });
        if let Some(fields) = document.as_object_mut() {
            fields.extend(figures);
            fields.insert("histogram".to_owned(), bars);
        }
        document
    }
}

fn millis(time: Duration) -> f64 {
    time.as_secs_f64() * 1e3
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn figures_and_bars_are_those_of_the_times() {
        assert_eq!(Times::new(Vec::new()), None);
        let times = Times::new((1..=200).rev().map(Duration::from_millis).collect()).unwrap();
        let lines = times.lines();
        assert_eq!(lines[0], "200 short replies, in ms: min 1.0, median 100.0, p95 190.0, p99 198.0, max 200.0");
        assert_eq!(lines[1], "     to 1 ms     1 #");
        assert_eq!(lines[8], format!("   to 200 ms   100 {}", "#".repeat(40)));
        assert_eq!(lines.len(), 9);
        assert_eq!(times.json()["histogram"]["to 100 ms"], 50);
        assert_eq!(times.json()["p95"], 190.0);
        let slow = Times::new(vec![Duration::from_secs(3)]).unwrap();
        assert_eq!(slow.lines()[1], format!("over 1000 ms     1 {}", "#".repeat(40)));
    }
}
