//! Resources of the process, sampled once per second, and their growth.

use std::fmt;
use std::time::Duration;

use tokio::runtime::Handle;

use crate::process;

/// Resource usage of the process.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Usage {
    /// Resident memory in bytes. Memory, heap and files are 0 on systems without `/proc`.
    pub(crate) memory: u64,
    /// Anonymous part of it in bytes: heap and stacks.
    pub(crate) heap: u64,
    /// Open files, including sockets.
    pub(crate) files: u64,
    /// Tasks of the runtime.
    pub(crate) tasks: u64,
}

impl Usage {
    pub(crate) fn now() -> Self {
        Self {
            memory: process::memory().unwrap_or_default(),
            heap: heap().unwrap_or_default(),
            files: process::open_files().unwrap_or_default() as u64,
            tasks: Handle::current().metrics().num_alive_tasks() as u64,
        }
    }
}

fn heap() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("RssAnon:"))?;
    let kib: u64 = line.split_whitespace().next()?.parse().ok()?;
    Some(kib * 1024)
}

/// Allowed growth after the warm-up.
const BOUNDS: [Bound; 4] = [
    Bound { resource: "resident memory", of: |used| used.memory, bytes: true, limit: MEMORY_GROWTH },
    Bound { resource: "heap", of: |used| used.heap, bytes: true, limit: MEMORY_GROWTH },
    // The number of links and ports varies all the time.
    Bound { resource: "open files", of: |used| used.files, bytes: false, limit: 25 },
    Bound { resource: "tasks", of: |used| used.tasks, bytes: false, limit: 30 },
];

/// Allowance for allocator, logs and simulated memories. A leak of four bytes per call exceeds it
/// in half an hour.
const MEMORY_GROWTH: u64 = 2 << 20;

struct Bound {
    resource: &'static str,
    of: fn(&Usage) -> u64,
    bytes: bool,
    limit: u64,
}

/// Shortest run with a check of growth.
pub(crate) const MIN_RUN: Duration = Duration::from_secs(60);

/// Growth of one resource, as two medians.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Growth {
    resource: &'static str,
    bytes: bool,
    from: u64,
    to: u64,
    limit: u64,
}

impl Growth {
    pub(crate) fn is_too_much(&self) -> bool {
        self.to > self.from + self.limit
    }
}

impl fmt::Display for Growth {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let amount = |n| if self.bytes { mebibytes(n) } else { n.to_string() };
        let (from, to, limit) = (amount(self.from), amount(self.to), amount(self.limit));
        write!(f, "{}: {from} after the warm-up, {to} at the end (limit: {limit} more)", self.resource)
    }
}

pub(crate) fn mebibytes(bytes: u64) -> String {
    format!("{:.1} MiB", bytes as f64 / f64::from(1 << 20))
}

/// Compares the medians of the first and the last sixth after the warm-up, for one sample per
/// second.
///
/// The warm-up is a third of the samples, at most five minutes.
pub(crate) fn growth(samples: &[Usage]) -> Vec<Growth> {
    let warm_up = (samples.len() / 3).min(300);
    let samples = &samples[warm_up..];
    let window = (samples.len() / 6).max(1).min(samples.len());
    let (first, last) = (&samples[..window], &samples[samples.len() - window..]);
    let growth = |bound: &Bound| Growth {
        resource: bound.resource,
        bytes: bound.bytes,
        from: median(first.iter().map(bound.of)),
        to: median(last.iter().map(bound.of)),
        limit: bound.limit,
    };
    BOUNDS.iter().map(growth).collect()
}

fn median(values: impl Iterator<Item = u64>) -> u64 {
    let mut values: Vec<u64> = values.collect();
    values.sort_unstable();
    values.get(values.len() / 2).copied().unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    const MIB: u64 = 1 << 20;

    fn too_much(samples: &[Usage]) -> Vec<&'static str> {
        growth(samples).iter().filter(|growth| growth.is_too_much()).map(|growth| growth.resource).collect()
    }

    #[test]
    fn noise_and_a_warm_up_are_not_growth() {
        let noisy = |second: u64| Usage {
            memory: 10 * MIB.min(second * MIB / 10) + second * 7919 % MIB,
            heap: 5 * MIB,
            files: 40 + second % 10,
            tasks: 100 + second % 30,
        };
        assert_eq!(too_much(&(0..120).map(noisy).collect::<Vec<_>>()), [""; 0]);
        assert_eq!(too_much(&(0..1800).map(noisy).collect::<Vec<_>>()), [""; 0]);
        assert_eq!(too_much(&[]), [""; 0]);
    }

    #[test]
    fn leak_is_growth() {
        let leaking = |second: u64| Usage {
            memory: 10 * MIB + second * 100_000,
            heap: 5 * MIB + second * 100_000,
            files: 40 + second,
            tasks: 100 + second,
        };
        let samples: Vec<_> = (0..60).map(leaking).collect();
        assert_eq!(too_much(&samples), ["resident memory", "heap", "open files", "tasks"]);
    }

    #[test]
    fn peak_is_not_growth() {
        let mut samples = vec![Usage { memory: 10 * MIB, heap: MIB, files: 10, tasks: 10 }; 600];
        samples[590] = Usage { memory: 100 * MIB, heap: 100 * MIB, files: 100, tasks: 100 };
        assert_eq!(too_much(&samples), [""; 0]);
    }
}
