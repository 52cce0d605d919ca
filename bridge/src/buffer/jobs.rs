//! The work that the log has for the disk. No I/O, and no clock.
//!
//! The storage thread asks for a [`Job`], does it and reports how it ended; there is one job at a time.
//!
//! States of a batch on its way to the disk: *unspilled* → *in flight* (in a [`Commit`]) → *durable* (in a
//! chunk) or, after a failure, unspilled again. A commit that failed may be on disk all the same, so a
//! commit begins by removing all rows that the log does not know.

use std::sync::Arc;

use super::chunk::{Chunk, Chunks, PAGE_OVERHEAD, cost};
use super::log::{Log, Slot};
use super::record;

/// The age at which a batch without an acknowledgement is written: it is on disk at 1 s, with the time
/// that a commit takes.
const SPILL_AFTER: u64 = 500;
/// The time between commits of acknowledgements.
const COMMIT_EVERY: u64 = 500;
/// The time between commits of positions and sequence numbers alone.
const STATE_EVERY: u64 = 60_000;
/// The time between two compactions.
const COMPACT_EVERY: u64 = 60_000;
/// The file that is not worth a compaction, in bytes.
const SMALL_FILE: u64 = 4 << 20;
/// The delays after failures: the first, and the longest.
const RETRY: (u64, u64) = (1_000, 30_000);

/// The limits of the disk.
#[derive(Clone, Copy, Debug)]
pub(super) struct DiskLimits {
    /// The bytes of all chunks.
    pub(super) max: u64,
    /// The length of a chunk.
    pub(super) chunk: u32,
    /// The bytes of batches in a commit.
    pub(super) job: usize,
    /// The bytes that are read back for an output before it needs them.
    pub(super) read_ahead: usize,
    /// Batches are on disk before an output reads them.
    pub(super) sync: bool,
}

/// The state of the disk, as the log knows it.
#[derive(Debug)]
pub(super) struct DiskState {
    pub(super) limits: DiskLimits,
    pub(super) chunks: Chunks,
    /// All batches before this position are on disk, if they are still needed.
    pub(super) durable_end: u64,
    /// The bytes of slots at or behind `durable_end`.
    pub(super) unspilled: usize,
    /// The position behind the batches that are being written.
    pub(super) in_flight: Option<u64>,
    /// Acknowledgements or removals are not in the file.
    pub(super) is_changed: bool,
    /// The end of the log in the file.
    pub(super) stored_end: u64,
    /// The last commit was written.
    pub(super) is_closed: bool,
    pub(super) failing: Option<Failing>,
    pub(super) counters: Counters,
    last_commit: u64,
    last_state: Option<u64>,
    last_compaction: Option<u64>,
    was_commit: bool,
    pub(super) file_len: u64,
}

/// A disk that fails.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Failing {
    pub(super) why: String,
    retry_at: u64,
    delay: u64,
    /// Removals have been written since.
    has_removed: bool,
}

/// Counters since the start.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Counters {
    pub(super) errors: u64,
    pub(super) corrupt_files: u64,
    pub(super) corrupt_batches: u64,
    pub(super) spilled_batches: u64,
}

/// Work for the disk.
#[derive(Clone, Debug)]
pub(super) enum Job {
    Commit(Commit),
    Load(Load),
    Compact,
}

/// Changes of the file, all or none of which happen.
#[derive(Clone, Debug)]
pub(super) struct Commit {
    /// Rows before this key are removed.
    pub(super) remove_before: u64,
    /// Rows from this key on are removed before `chunks` are written.
    pub(super) remove_from: u64,
    pub(super) chunks: Vec<NewChunk>,
    /// The positions that the outputs have acknowledged.
    pub(super) cursors: Vec<(Arc<str>, u64)>,
    /// The end of the log.
    pub(super) end: u64,
    /// The buffer's time.
    pub(super) time: u64,
    pub(super) next_seqs: Option<Vec<(Arc<str>, u64)>>,
    /// Nothing is left to be written before the end of the process.
    pub(super) is_last: bool,
}

/// A chunk that is written, or the rest of one.
#[derive(Clone, Debug)]
pub(super) struct NewChunk {
    /// The chunk when it is written.
    pub(super) chunk: Chunk,
    /// The bytes that are in the file already; what follows them there is cut off.
    pub(super) keep: u32,
    pub(super) slots: Vec<Slot>,
}

/// Chunks that are read back for an output.
#[derive(Clone, Debug)]
pub(super) struct Load {
    pub(super) output: usize,
    pub(super) from: u64,
    pub(super) chunks: Vec<Chunk>,
}

impl DiskState {
    pub(super) fn new(limits: DiskLimits, chunks: Chunks, end: u64, now: u64) -> Self {
        Self {
            limits,
            chunks,
            durable_end: end,
            unspilled: 0,
            in_flight: None,
            is_changed: true,
            stored_end: end,
            is_closed: false,
            failing: None,
            counters: Counters::default(),
            last_commit: now,
            last_state: None,
            last_compaction: None,
            was_commit: false,
            file_len: 0,
        }
    }
}

impl Log {
    /// Returns whether the storage thread has work that cannot wait for its next look.
    pub(super) fn is_urgent(&self) -> bool {
        let Some(disk) = &self.disk else { return false };
        let is_full = disk.unspilled >= disk.limits.job || (disk.limits.sync && disk.unspilled > 0);
        disk.failing.is_none() && (is_full || self.is_load_wanted())
    }

    /// The next job, if there is one. `is_closing`: all is to be written now.
    pub(super) fn plan(&mut self, now: u64, is_closing: bool) -> Option<Job> {
        self.expire(now);
        let disk = self.disk.as_ref()?;
        let waits = disk.failing.as_ref().is_some_and(|failing| now < failing.retry_at);
        if waits && !is_closing {
            return None;
        }
        let is_due = self.is_commit_due(now, is_closing);
        // Neither commits nor loads hold up the others.
        let load_first = disk.was_commit && !is_closing;
        if is_due && !(load_first && self.is_load_wanted()) {
            return Some(Job::Commit(self.plan_commit(now, is_closing)));
        }
        if is_closing {
            return None;
        }
        if let Some(load) = self.plan_load() {
            return Some(Job::Load(load));
        }
        let disk = self.disk.as_mut()?;
        let is_idle = disk.chunks.is_empty() && disk.unspilled == 0 && !disk.is_changed;
        let is_recent = disk.last_compaction.is_some_and(|at| now.saturating_sub(at) < COMPACT_EVERY);
        if is_idle && !is_recent && disk.file_len > SMALL_FILE {
            disk.last_compaction = Some(now);
            return Some(Job::Compact);
        }
        None
    }

    fn is_commit_due(&self, now: u64, is_closing: bool) -> bool {
        let Some(disk) = &self.disk else { return false };
        let begin = self.slots.partition_point(|slot| slot.position < disk.durable_end);
        let spill = self.slots.get(begin).is_some_and(|slot| {
            is_closing
                || disk.limits.sync
                || disk.unspilled >= disk.limits.job
                || now.saturating_sub(slot.pushed) >= SPILL_AFTER
        });
        let since = now.saturating_sub(disk.last_commit);
        let changed = disk.is_changed && since >= COMMIT_EVERY;
        let state = disk.stored_end != self.end && since >= STATE_EVERY;
        spill || changed || state || (is_closing && !disk.is_closed)
    }

    pub(super) fn plan_commit(&mut self, now: u64, is_closing: bool) -> Commit {
        let slots = self.unspilled_slots();
        let new_cost = slots.iter().fold(0_u64, |sum, slot| sum.saturating_add(record_len(slot).into()));
        // Both ends of the job may fill their pages badly.
        let slack = self.disk.as_ref().map_or(0, |disk| cost(disk.limits.chunk).saturating_mul(2));
        let new_cost = if slots.is_empty() { 0 } else { new_cost.saturating_add(new_cost / 32).saturating_add(slack) };
        while self.disk.as_ref().is_some_and(|disk| {
            !disk.chunks.is_empty() && disk.chunks.cost().saturating_add(new_cost) > disk.limits.max
        }) {
            self.drop_for_room(now, Self::drop_chunk);
        }
        let cursors = self.cursors.iter().map(|cursor| (cursor.name.clone(), cursor.acknowledged)).collect();
        let newest = self.slots.back().map(|slot| slot.position);
        let spilled = slots.last().map(|slot| slot.position);
        let (end, all_seqs) = (self.end, &self.next_seqs);
        let durable_end = self.disk.as_ref().map_or(end, |disk| disk.durable_end);
        let is_last = is_closing && (spilled == newest || newest.is_none_or(|newest| newest < durable_end));
        let mut commit = Commit {
            remove_before: end,
            remove_from: end,
            chunks: Vec::new(),
            cursors,
            end,
            time: now,
            next_seqs: None,
            is_last,
        };
        let Some(disk) = &mut self.disk else { return commit };
        commit.chunks = cut(slots, disk.chunks.back(), disk.limits.chunk);
        let first_new = commit.chunks.first().map_or(end, |new| new.chunk.first);
        commit.remove_before = disk.chunks.front().map_or(first_new, |chunk| chunk.first);
        commit.remove_from = disk.chunks.back().map_or(first_new, |chunk| chunk.end());
        let is_state_old = disk.last_state.is_none_or(|at| now.saturating_sub(at) >= STATE_EVERY);
        if is_state_old || is_last {
            commit.next_seqs = Some(all_seqs.iter().map(|(plc, seq)| (plc.clone(), *seq)).collect());
        }
        disk.in_flight = spilled.map(|position| position.saturating_add(1));
        disk.is_changed = false;
        disk.was_commit = true;
        commit
    }

    /// The batches for the next commit.
    fn unspilled_slots(&self) -> Vec<Slot> {
        let Some(disk) = &self.disk else { return Vec::new() };
        // On a full disk, removals make place first.
        if disk.failing.as_ref().is_some_and(|failing| !failing.has_removed) {
            return Vec::new();
        }
        let begin = self.slots.partition_point(|slot| slot.position < disk.durable_end);
        let mut bytes = 0_usize;
        let fits = |slot: &&Slot| {
            let is_first = bytes == 0;
            bytes = bytes.saturating_add(slot.batch.size());
            is_first || bytes <= disk.limits.job
        };
        self.slots.range(begin..).take_while(fits).cloned().collect()
    }

    fn plan_load(&mut self) -> Option<Load> {
        let front = self.slots.front().map_or(self.end, |slot| slot.position);
        let disk = self.disk.as_mut()?;
        let wants = |cursor: &super::log::CursorState| cursor.ahead.is_wanted && cursor.ahead.loading.is_none();
        let output = self.cursors.iter().position(wants)?;
        let cursor = self.cursors.get_mut(output)?;
        cursor.ahead.is_wanted = false;
        let from = cursor.next.max(cursor.ahead.end);
        let mut bytes = 0_usize;
        let fits = |chunk: &Chunk| {
            let is_first = bytes == 0;
            bytes = bytes.saturating_add(usize::try_from(chunk.len).unwrap_or(usize::MAX));
            chunk.first < front && (is_first || bytes <= disk.limits.read_ahead / 2)
        };
        let chunks: Vec<Chunk> = disk.chunks.from(from).take_while(fits).collect();
        if chunks.is_empty() {
            return None;
        }
        cursor.ahead.loading = Some(from);
        disk.was_commit = false;
        Some(Load { output, from, chunks })
    }

    /// Notes that a commit is on disk. `file_len`: the length of the file.
    pub(super) fn committed(&mut self, commit: &Commit, now: u64, file_len: u64) {
        let Some(disk) = &mut self.disk else { return };
        for new in &commit.chunks {
            disk.chunks.put(new.chunk);
            let count = u64::try_from(new.slots.len()).unwrap_or(u64::MAX);
            disk.counters.spilled_batches = disk.counters.spilled_batches.saturating_add(count);
        }
        if let Some(end) = disk.in_flight.take() {
            let begin = self.slots.partition_point(|slot| slot.position < disk.durable_end);
            let written = self.slots.range(begin..).take_while(|slot| slot.position < end);
            let bytes = written.fold(0_usize, |sum, slot| sum.saturating_add(slot.batch.size()));
            disk.unspilled = disk.unspilled.saturating_sub(bytes);
            disk.durable_end = end;
        }
        disk.stored_end = commit.end;
        disk.is_closed = commit.is_last;
        disk.last_commit = now;
        if commit.next_seqs.is_some() {
            disk.last_state = Some(now);
        }
        disk.file_len = file_len;
        match &mut disk.failing {
            // It has taken no batches yet.
            Some(failing) if disk.unspilled > 0 && commit.chunks.is_empty() => failing.has_removed = true,
            _ => disk.failing = None,
        }
        self.remove_acknowledged();
        self.evict(now);
    }

    /// Takes the batches of chunks that were read back: for each chunk those that are good.
    pub(super) fn loaded(&mut self, load: &Load, read: Vec<Vec<Slot>>) {
        let Some(disk) = &mut self.disk else { return };
        if disk.unspilled == 0 {
            disk.failing = None;
        }
        let Some(cursor) = self.cursors.get_mut(load.output) else { return };
        // The output has gone back since.
        if cursor.ahead.loading != Some(load.from) {
            return;
        }
        cursor.ahead.loading = None;
        for (chunk, slots) in load.chunks.iter().zip(read) {
            let expected = chunk.first..chunk.end();
            let good = slots.into_iter().zip(expected).take_while(|(slot, position)| slot.position == *position);
            let good: Vec<Slot> = good.map(|(slot, _)| slot).collect();
            let count = u32::try_from(good.len()).unwrap_or(u32::MAX);
            if count < chunk.count {
                let len = good.iter().fold(0_u32, |sum, slot| sum.saturating_add(record_len(slot)));
                let lost = self.truncate_chunk(*chunk, count, len);
                if let Some(disk) = &mut self.disk {
                    disk.counters.corrupt_batches = disk.counters.corrupt_batches.saturating_add(lost);
                }
            }
            let Some(cursor) = self.cursors.get_mut(load.output) else { return };
            let ahead = &mut cursor.ahead;
            ahead.end = chunk.end();
            for slot in good.into_iter().filter(|slot| slot.position >= load.from) {
                ahead.bytes = ahead.bytes.saturating_add(slot.batch.size());
                ahead.slots.push_back(slot);
            }
        }
    }

    /// Notes that a job failed: all is as before it, and is tried again after a delay.
    pub(super) fn failed(&mut self, why: String, now: u64) {
        let Some(disk) = &mut self.disk else { return };
        let (first, longest) = RETRY;
        let delay = disk.failing.as_ref().map_or(first, |failing| failing.delay.saturating_mul(2).min(longest));
        disk.counters.errors = disk.counters.errors.saturating_add(1);
        let retry_at = now.saturating_add(delay);
        disk.failing = Some(Failing { why, retry_at, delay, has_removed: false });
        disk.in_flight = None;
        disk.is_changed = true;
        self.forget_loads();
        self.evict(now);
    }

    /// Notes that the file was lost and is empty now.
    pub(super) fn file_lost(&mut self, now: u64) {
        let front = self.slots.front().map_or(self.end, |slot| slot.position);
        let Some(disk) = &mut self.disk else { return };
        let oldest = self.cursors.iter().map(|cursor| cursor.acknowledged).min().unwrap_or(front);
        let lost = disk.chunks.count(oldest, front.max(oldest));
        disk.counters.corrupt_files = disk.counters.corrupt_files.saturating_add(1);
        disk.counters.corrupt_batches = disk.counters.corrupt_batches.saturating_add(lost);
        for cursor in &mut self.cursors {
            let begin = cursor.acknowledged;
            let missed = disk.chunks.count(begin, front.max(begin));
            cursor.dropped = cursor.dropped.saturating_add(missed);
            cursor.skip_to(front);
            cursor.ahead.clear();
        }
        disk.chunks.clear();
        disk.durable_end = front;
        disk.unspilled = self.bytes;
        disk.in_flight = None;
        disk.is_changed = true;
        disk.last_state = None;
        self.evict(now);
    }

    /// Notes that the file was made smaller.
    pub(super) fn compacted(&mut self, file_len: u64) {
        if let Some(disk) = &mut self.disk {
            disk.file_len = file_len;
        }
    }

    /// The number of batches that are in memory alone.
    pub(super) fn unspilled_count(&self) -> usize {
        let durable_end = self.disk.as_ref().map_or(0, |disk| disk.durable_end);
        self.slots.len().saturating_sub(self.slots.partition_point(|slot| slot.position < durable_end))
    }

    /// Returns whether all batches are on disk.
    pub(super) fn is_written(&self) -> bool {
        self.unspilled_count() == 0
    }

    /// Why the disk does not take batches, if it does not.
    pub(super) fn failure(&self) -> Option<&str> {
        self.disk.as_ref()?.failing.as_ref().map(|failing| failing.why.as_str())
    }

    fn forget_loads(&mut self) {
        for cursor in &mut self.cursors {
            cursor.ahead.is_wanted |= cursor.ahead.loading.take().is_some();
        }
    }
}

fn record_len(slot: &Slot) -> u32 {
    u32::try_from(record::size(&slot.batch)).unwrap_or(u32::MAX)
}

/// Distributes batches over chunks. The first of them goes on with `last` if that is not full.
fn cut(slots: Vec<Slot>, last: Option<Chunk>, target: u32) -> Vec<NewChunk> {
    let mut chunks: Vec<NewChunk> = Vec::new();
    let target = target.saturating_sub(PAGE_OVERHEAD);
    for slot in slots {
        let len = record_len(&slot);
        let open = match chunks.last_mut() {
            Some(open) => Some(open),
            None => {
                let open = last.filter(|last| last.end() == slot.position && last.len < target / 2);
                chunks.extend(open.map(|chunk| NewChunk { chunk, keep: chunk.len, slots: Vec::new() }));
                chunks.last_mut()
            }
        };
        let goes_on =
            |open: &NewChunk| open.chunk.end() == slot.position && open.chunk.len.saturating_add(len) <= target;
        match open.filter(|open| goes_on(open)) {
            Some(open) => {
                open.chunk.count = open.chunk.count.saturating_add(1);
                open.chunk.len = open.chunk.len.saturating_add(len);
                open.chunk.newest = slot.pushed;
                open.slots.push(slot);
            }
            None => {
                let (oldest, newest) = (slot.pushed, slot.pushed);
                let chunk = Chunk { first: slot.position, count: 1, len, oldest, newest };
                chunks.push(NewChunk { chunk, keep: 0, slots: vec![slot] });
            }
        }
    }
    chunks.retain(|new| !new.slots.is_empty());
    chunks
}
