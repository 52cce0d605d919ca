//! Output: figures at intervals, each finding at once, and a summary.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use fatek::{LinkStats, StationStats};
use tokio::time::Instant;

use crate::counters::load;
use crate::health::{Growth, Usage, mebibytes};
use crate::line::Line;
use crate::process;

pub(crate) struct Report {
    lines: Vec<Arc<Line>>,
    began: Instant,
    last: Figures,
}

/// Sums of all lines.
#[derive(Clone, Copy, Debug)]
struct Figures {
    at: Instant,
    calls: u64,
    requests: u64,
    processor_time: Option<Duration>,
}

impl Report {
    pub(crate) fn new(lines: &[Arc<Line>]) -> Self {
        Self { lines: lines.to_vec(), began: Instant::now(), last: Figures::take(lines) }
    }

    /// Prints new findings. Returns the number of all findings.
    pub(crate) fn findings(&self) -> u64 {
        for finding in self.lines.iter().flat_map(|line| line.counters.take_findings()) {
            println!("WRONG after {:.1?}: {finding}", self.began.elapsed());
        }
        self.sum(|line| load(&line.counters.wrong))
    }

    /// Prints a line of figures: totals since the start, and rates since the last line.
    pub(crate) fn show(&mut self, used: Usage) {
        let now = Figures::take(&self.lines);
        let seconds = (now.at - self.last.at).as_secs_f64();
        let per_second = |now: u64, before: u64| (now - before) as f64 / seconds;
        let processor = now.processor_time.zip(self.last.processor_time);
        let processor = processor.map(|(now, before)| 100.0 * (now - before).as_secs_f64() / seconds);
        let LinkStats { stations, garbage_bytes, stale_bytes, .. } = self.link_stats();
        let StationStats { requests, replies, retries, timeouts, refusals, .. } = stations;
        println!(
            "{:>5.0?} s: {requests} requests ({:.0}/s; {:.0} calls/s), {replies} replies, {retries} retries, {timeouts} timeouts, \
             {refusals} refusals, {} bytes discarded, {} wrong; {} resident, {} heap, {} files, {} tasks, {:.0} % CPU",
            self.began.elapsed().as_secs_f64(),
            per_second(now.requests, self.last.requests),
            per_second(now.calls, self.last.calls),
            garbage_bytes + stale_bytes,
            self.sum(|line| load(&line.counters.wrong)),
            mebibytes(used.memory),
            mebibytes(used.heap),
            used.files,
            used.tasks,
            processor.unwrap_or_default(),
        );
        self.last = now;
    }

    pub(crate) fn summary(&self, interruptions: u64, growth: &[Growth]) {
        let seconds = self.began.elapsed().as_secs_f64();
        let stats = self.link_stats();
        let calls = self.sum(|line| load(&line.counters.calls));
        println!();
        for line in &self.lines {
            let counters = &line.counters;
            let failed: Vec<_> = counters.failures().iter().map(|(kind, times)| format!("{times} {kind}")).collect();
            println!(
                "{}: {} calls, {} good, {} cancelled, failed: {}; {} good samples, {} others; {} writes in {} audits",
                line.name(),
                load(&counters.calls),
                load(&counters.confirmed),
                load(&counters.cancelled),
                failed.join(", "),
                load(&counters.samples),
                load(&counters.not_good),
                load(&counters.writes),
                load(&counters.audits),
            );
        }
        let mut applied: BTreeMap<String, u64> = BTreeMap::new();
        for rule in self.lines.iter().flat_map(|line| line.faults.rules()) {
            let fault = format!("{:?}", rule.fault());
            let kind = fault.split(|c: char| !c.is_alphanumeric()).next().unwrap_or_default();
            *applied.entry(kind.to_owned()).or_default() += rule.times_applied();
        }
        println!("faults: {} {applied:?}, and {interruptions} interruptions", applied.values().sum::<u64>());
        println!("links: {stats:?}");
        for growth in growth {
            println!("{growth}{}", if growth.is_too_much() { ": TOO MUCH" } else { "" });
        }
        println!(
            "{:.0} s, {calls} calls ({:.0}/s), {} requests by the links of the lines, {} values checked: {} wrong",
            seconds,
            calls as f64 / seconds,
            stats.stations.requests,
            self.sum(|line| load(&line.counters.values)),
            self.sum(|line| load(&line.counters.wrong)),
        );
    }

    fn sum(&self, of: impl Fn(&Line) -> u64) -> u64 {
        self.lines.iter().map(|line| of(line)).sum()
    }

    fn link_stats(&self) -> LinkStats {
        let mut sum = LinkStats::default();
        for stats in self.lines.iter().map(|line| line.link.stats()) {
            sum.garbage_bytes += stats.garbage_bytes;
            sum.stale_bytes += stats.stale_bytes;
            sum.checksum_errors += stats.checksum_errors;
            sum.echoes += stats.echoes;
            sum.broadcasts += stats.broadcasts;
            sum.connects += stats.connects;
            sum.disconnects += stats.disconnects;
            sum.connect_failures += stats.connect_failures;
            sum.stations.requests += stats.stations.requests;
            sum.stations.replies += stats.stations.replies;
            sum.stations.refusals += stats.stations.refusals;
            sum.stations.timeouts += stats.stations.timeouts;
            sum.stations.bad_replies += stats.stations.bad_replies;
            sum.stations.retries += stats.stations.retries;
            sum.stations.checks += stats.stations.checks;
            sum.stations.stray_frames += stats.stations.stray_frames;
        }
        sum
    }
}

impl Figures {
    fn take(lines: &[Arc<Line>]) -> Self {
        Self {
            at: Instant::now(),
            calls: lines.iter().map(|line| load(&line.counters.calls)).sum(),
            requests: lines.iter().map(|line| line.link.stats().stations.requests).sum(),
            processor_time: process::processor_time(std::process::id()),
        }
    }
}
