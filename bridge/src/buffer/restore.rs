//! Opens the buffer on disk and goes on where an earlier run ended.

use std::fs;
use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use super::chunk::Chunks;
use super::disk::{Disk, DiskError, FILE, Opener, Restored};
use super::jobs::{DiskLimits, DiskState};
use super::log::{CursorState, Limits, Log};
use super::settings::{BufferError, BufferSettings};
use super::storage::{self, Shared};
use super::{Buffer, Closer};
use crate::batch::milliseconds;

/// The positions that are left out at a start. An earlier run may have used positions behind the last in
/// the file, but less than a million a second for the time between two commits, or an hour of a disk that fails.
const POSITION_GAP: u64 = 1 << 32;
/// The sequence numbers of a PLC that are left out at a start, for the same reason.
const SEQ_GAP: u64 = 10_000_000;
/// The longest time without the bridge that is believed: a clock that is wrong does not drop everything.
const LONGEST_PAUSE: Duration = Duration::from_secs(366 * 24 * 3600);

/// Opens a buffer. See [`Buffer::open`].
pub(super) fn open(settings: &BufferSettings, outputs: &[&str], opener: Opener) -> Result<Buffer, BufferError> {
    settings.check()?;
    let max_age = Some(settings.max_age_ms());
    let Some(dir) = &settings.dir else {
        let log = Log::in_memory(outputs.len(), Limits { memory: settings.memory, max_age });
        return Ok(Buffer { shared: Arc::new(Shared::new(log, 0)), closer: None });
    };
    fs::create_dir_all(dir).map_err(|error| BufferError::io(dir, &error))?;
    let mut disk = Disk::new(dir.join(FILE), settings.cache(), opener);
    let (restored, damaged_files) = open_disk(&mut disk)?;
    let clock = milliseconds(SystemTime::now());
    let limits = Limits { memory: settings.slots(), max_age };
    let (mut log, now) = continue_log(restored, outputs, limits, settings.disk_limits(outputs.len()), clock);
    if let Some(disk) = &mut log.disk {
        disk.counters.corrupt_files = damaged_files;
    }
    store_start(&mut log, &mut disk, now, clock);
    let shared = Arc::new(Shared::new(log, now));
    let path = disk.path().to_owned();
    let ended = storage::start(shared.clone(), disk).map_err(|error| BufferError::io(&path, &error))?;
    let closer = Some(Arc::new(Closer { shared: shared.clone(), ended }));
    Ok(Buffer { shared, closer })
}

/// Opens the file, or a new one in place of a damaged one. Returns the number of damaged files.
fn open_disk(disk: &mut Disk) -> Result<(Restored, u64), BufferError> {
    let failed = |error: DiskError, path: &Path| match error {
        DiskError::InUse => BufferError::InUse { path: path.to_owned() },
        DiskError::Io(why) | DiskError::Damaged(why) => BufferError::Io { path: path.to_owned(), why },
    };
    let path = disk.path().to_owned();
    match disk.open() {
        Ok(restored) => Ok((restored.unwrap_or_default(), 0)),
        Err(DiskError::Damaged(why)) => {
            let place = disk.move_aside().map_err(|error| BufferError::io(&path, &error))?;
            tracing::error!("the buffer {} is damaged ({why}): it is now {}", path.display(), place.display());
            let restored = disk.open().map_err(|error| failed(error, &path))?;
            Ok((restored.unwrap_or_default(), 1))
        }
        Err(error @ (DiskError::InUse | DiskError::Io(_))) => Err(failed(error, &path)),
    }
}

/// Makes the log that goes on behind the restored one, and the buffer's time now.
pub(super) fn continue_log(
    restored: Restored,
    outputs: &[&str],
    limits: Limits,
    disk: DiskLimits,
    clock: u64,
) -> (Log, u64) {
    let Restored { chunks: rows, cursors, next_seqs, end, time, clock: stopped } = restored;
    let now = time.saturating_add(pause(stopped, clock));
    let mut chunks = Chunks::default();
    rows.into_iter().for_each(|chunk| chunks.put(chunk));
    let stored_end = end.max(chunks.back().map_or(0, |last| last.end()));
    let end = if stored_end == 0 { 1 } else { stored_end.saturating_add(POSITION_GAP) };
    // An output without a cursor is new: it gets all that is here.
    let oldest = chunks.front().map_or(end, |chunk| chunk.first);
    let cursor = |name: &&str| {
        let acknowledged = cursors.get(*name).copied().unwrap_or(oldest);
        CursorState::new((*name).into(), acknowledged.min(end))
    };
    let states: Vec<CursorState> = outputs.iter().map(cursor).collect();
    let needed_from = states.iter().map(|cursor| cursor.acknowledged).min().unwrap_or(end);
    for (name, acknowledged) in cursors.iter().filter(|(name, _)| !outputs.contains(&name.as_str())) {
        let batches = chunks.count(*acknowledged, needed_from.max(*acknowledged));
        tracing::warn!(output = name, batches, "an output was removed: batches that it alone lacked are removed");
    }
    let mut log = Log::in_memory(0, limits);
    log.cursors = states;
    log.end = end;
    log.run_first = end;
    log.next_seqs = next_seqs.into_iter().map(|(plc, seq)| (plc, seq.saturating_add(SEQ_GAP))).collect();
    log.disk = Some(DiskState::new(disk, chunks, end, now));
    log.remove_acknowledged();
    log.expire(now);
    (log, now)
}

/// The time between two runs. The clock may have been set: a time that cannot be is none.
fn pause(stopped: u64, clock: u64) -> u64 {
    let longest = u64::try_from(LONGEST_PAUSE.as_millis()).unwrap_or(u64::MAX);
    clock.checked_sub(stopped).filter(|pause| *pause <= longest).unwrap_or(0)
}

/// Stores that the positions behind the gap are in use.
fn store_start(log: &mut Log, disk: &mut Disk, now: u64, clock: u64) {
    let commit = log.plan_commit(now, false);
    match disk.commit(&commit, clock) {
        Ok(file_len) => log.committed(&commit, now, file_len),
        Err(error) => {
            let path = disk.path().display();
            tracing::error!(%error, "the buffer cannot write {path}: it goes on in memory and tries again");
            disk.close();
            log.failed(error.to_string(), now);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::buffer::chunk::Chunk;

    const LIMITS: Limits = Limits { memory: 1 << 20, max_age: Some(10_000) };
    const DISK: DiskLimits =
        DiskLimits { max: 1 << 20, chunk: 16 << 10, job: 1 << 16, read_ahead: 1 << 16, sync: false };

    fn restored() -> Restored {
        let chunk = |first, newest| Chunk { first, count: 10, len: 1000, oldest: newest - 10, newest };
        let chunks = vec![chunk(10, 90_000), chunk(20, 95_000), chunk(40, 99_000)];
        let cursors = [("mqtt", 25), ("nats", 15), ("gone", 10)].map(|(name, at)| (name.to_owned(), at)).into();
        let next_seqs = [("mixer".into(), 77)].into();
        Restored { chunks, cursors, next_seqs, end: 60, time: 100_000, clock: 5_000_000 }
    }

    fn lags(outputs: &[&str], clock: u64) -> (Vec<u64>, u64) {
        let (log, _) = continue_log(restored(), outputs, LIMITS, DISK, clock);
        (log.stats().iter().map(|stats| stats.lag).collect(), log.stats().iter().map(|stats| stats.dropped).sum())
    }

    #[test]
    fn outputs_go_on_by_name_and_a_new_one_gets_all() {
        assert_eq!(lags(&["nats", "mqtt"], 5_000_000), (vec![25, 15], 0));
        assert_eq!(lags(&["mqtt"], 5_000_000), (vec![15], 0));
        assert_eq!(lags(&["stdout", "mqtt"], 5_000_000), (vec![30, 15], 0));
        assert_eq!(lags(&[], 5_000_000), (vec![], 0));
    }

    #[test]
    fn a_removed_output_holds_nothing_back() {
        let (log, _) = continue_log(restored(), &["mqtt"], LIMITS, DISK, 5_000_000);
        assert_eq!(log.disk.and_then(|disk| disk.chunks.front()).map(|chunk| chunk.first), Some(20));
    }

    #[test]
    fn positions_and_sequence_numbers_grow_over_a_start() {
        let (mut log, _) = continue_log(restored(), &["mqtt"], LIMITS, DISK, 5_000_000);
        assert!(log.next_seqs()["mixer"] > 77);
        let batch =
            crate::batch::Batch { plc: "mixer".into(), revision: 0, seq: 1, ts: 1, samples: 1, data: "{}".into() };
        assert!(log.push(batch, 100_000) > 60);
    }

    #[test]
    fn the_pause_counts_for_the_age_unless_the_clock_is_wrong() {
        // Two of the chunks are older than 10 s after a pause of 5.5 s.
        assert_eq!(lags(&["stdout"], 5_005_500), (vec![10], 20));
        // A clock that was set back, has lost its time, or is many years ahead.
        for clock in [4_000_000, 0, u64::MAX, 5_000_000 + 2 * 366 * 24 * 3_600_000] {
            assert_eq!(lags(&["stdout"], clock), (vec![30], 0), "clock {clock}");
        }
    }
}
