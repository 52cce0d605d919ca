//! Resources of a process, from `/proc`, and its limit of open files.

use std::time::Duration;

use crate::Result;

/// Resident memory of this process in bytes. `None`, here and below, on systems without `/proc`.
pub(crate) fn memory() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"))?;
    let kib: u64 = line.split_whitespace().next()?.parse().ok()?;
    Some(kib * 1024)
}

/// Number of open files of this process, including sockets.
pub(crate) fn open_files() -> Option<usize> {
    Some(std::fs::read_dir("/proc/self/fd").ok()?.count())
}

/// Processor time of a process, all threads together.
pub(crate) fn processor_time(process: u32) -> Option<Duration> {
    let stat = std::fs::read_to_string(format!("/proc/{process}/stat")).ok()?;
    // Field 2 is the name in parentheses, which may contain spaces; field 3 follows it.
    let (_, fields) = stat.rsplit_once(") ")?;
    let ticks = |n: usize| fields.split(' ').nth(n - 3)?.parse::<u64>().ok();
    let (user, system) = (ticks(14)?, ticks(15)?);
    Some(Duration::from_secs_f64((user + system) as f64 / ticks_per_second() as f64))
}

#[cfg(unix)]
fn ticks_per_second() -> u64 {
    rustix::param::clock_ticks_per_second()
}

#[cfg(not(unix))]
fn ticks_per_second() -> u64 {
    100
}

/// Raises the limit of open files to `needed`.
pub(crate) fn allow_open_files(needed: u64) -> Result<()> {
    #[cfg(unix)]
    {
        use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
        let Rlimit { current, maximum } = getrlimit(Resource::Nofile);
        if current.is_none_or(|current| current >= needed) {
            return Ok(());
        }
        if maximum.is_some_and(|maximum| maximum < needed) {
            let limit = maximum.unwrap_or_default();
            return Err(format!("{needed} open files are needed, the system limit is {limit} (`ulimit -Hn`)").into());
        }
        setrlimit(Resource::Nofile, Rlimit { current: Some(needed), maximum })?;
    }
    Ok(())
}
