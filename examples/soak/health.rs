//! What the process uses, second by second, and whether that grows.

use std::fmt;
use std::time::Duration;

use tokio::runtime::Handle;

use crate::process;

/// What the process uses.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Use {
    /// Resident memory, in bytes. This and the next are 0 where the system does not tell.
    pub(crate) memory: u64,
    /// How much of it is not of files: the heap, and the stacks.
    pub(crate) heap: u64,
    /// Open files, sockets among them.
    pub(crate) files: u64,
    /// Tasks of the runtime.
    pub(crate) tasks: u64,
}

impl Use {
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

/// What may be more at the end than after the warm-up.
const BOUNDS: [Bound; 4] = [
    Bound { what: "resident memory", of: |used| used.memory, bytes: true, most: MEMORY_GROWTH },
    Bound { what: "heap", of: |used| used.heap, bytes: true, most: MEMORY_GROWTH },
    // Links and ports come and go all the time.
    Bound { what: "open files", of: |used| used.files, bytes: false, most: 25 },
    Bound { what: "tasks", of: |used| used.tasks, bytes: false, most: 30 },
];

/// What the allocator, the logs and the memories of the simulated PLCs may need more by chance; it takes a leak of four bytes a
/// call to exceed that in half an hour.
const MEMORY_GROWTH: u64 = 2 << 20;

struct Bound {
    what: &'static str,
    of: fn(&Use) -> u64,
    bytes: bool,
    most: u64,
}

/// The shortest run of which it is judged whether it grows.
pub(crate) const SHORTEST: Duration = Duration::from_secs(60);

/// Two medians of one thing that is used.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Growth {
    what: &'static str,
    bytes: bool,
    from: u64,
    to: u64,
    most: u64,
}

impl Growth {
    pub(crate) fn is_too_much(&self) -> bool {
        self.to > self.from + self.most
    }
}

impl fmt::Display for Growth {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let amount = |n| if self.bytes { mebibytes(n) } else { n.to_string() };
        let (from, to, most) = (amount(self.from), amount(self.to), amount(self.most));
        write!(f, "{}: {from} after the warm-up, {to} at the end (at most {most} more)", self.what)
    }
}

pub(crate) fn mebibytes(bytes: u64) -> String {
    format!("{:.1} MiB", bytes as f64 / f64::from(1 << 20))
}

/// Compares the median of the first sixth after the warm-up, which is a third but no more than five minutes, with that of
/// the last sixth. One use a second.
pub(crate) fn growth(uses: &[Use]) -> Vec<Growth> {
    let warm_up = (uses.len() / 3).min(300);
    let uses = &uses[warm_up..];
    let window = (uses.len() / 6).max(1).min(uses.len());
    let (first, last) = (&uses[..window], &uses[uses.len() - window..]);
    let growth = |bound: &Bound| Growth {
        what: bound.what,
        bytes: bound.bytes,
        from: median(first.iter().map(bound.of)),
        to: median(last.iter().map(bound.of)),
        most: bound.most,
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

    fn too_much(uses: &[Use]) -> Vec<&'static str> {
        growth(uses).iter().filter(|growth| growth.is_too_much()).map(|growth| growth.what).collect()
    }

    #[test]
    fn noise_and_a_warm_up_are_no_growth() {
        let noisy = |second: u64| Use {
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
    fn a_leak_is_growth() {
        let leaking = |second: u64| Use {
            memory: 10 * MIB + second * 100_000,
            heap: 5 * MIB + second * 100_000,
            files: 40 + second,
            tasks: 100 + second,
        };
        let uses: Vec<_> = (0..60).map(leaking).collect();
        assert_eq!(too_much(&uses), ["resident memory", "heap", "open files", "tasks"]);
    }

    #[test]
    fn a_peak_is_no_growth() {
        let mut uses = vec![Use { memory: 10 * MIB, heap: MIB, files: 10, tasks: 10 }; 600];
        uses[590] = Use { memory: 100 * MIB, heap: 100 * MIB, files: 100, tasks: 100 };
        assert_eq!(too_much(&uses), [""; 0]);
    }
}
