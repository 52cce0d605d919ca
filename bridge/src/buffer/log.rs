//! The log of batches with the cursors of the outputs: which batches are in memory, which on disk, and what
//! is dropped. No I/O, and no clock: callers pass the time, and [`super::jobs`] has the work for the disk.
//!
//! ```text
//!            chunks (on disk)                   slots (in memory)
//! [acknowledged by all … first ──────────────── slots.front ──── durable_end ── in flight ── end]
//!    removed             │ read back on demand  │ on disk, too  │ being written │ not on disk
//! ```
//!
//! Times are milliseconds of the buffer's time: it goes on while the bridge runs, and a step of the clock
//! does not change it.
//!
//! Invariants:
//! - each batch that an output lacks is in `slots`, in `chunks` or in both, unless it was counted as dropped;
//! - all batches at or behind the first slot are in `slots`: chunks behind it are copies;
//! - batches before `durable_end` that are left are in `chunks`;
//! - `bytes` is at most `limits.memory`, plus one batch.

use std::collections::{HashMap, VecDeque};
use std::sync::Arc;
use std::time::Duration;

use super::chunk::Chunk;
use super::jobs::{Counters, DiskState};
use super::{BufferStats, CursorStats, Entry};
use crate::batch::Batch;

/// The PLCs whose sequence numbers are kept. Numbers begin with the time of a start, so the smallest is of
/// the PLC that was removed first.
const MAX_PLCS: usize = 16_384;

/// The age, in milliseconds, from which a batch is sent as a replay: it is no news any more.
const LATE_AFTER: u64 = 5_000;

/// The share of a limit from which the buffer counts as full.
const FULL: f64 = 0.98;
/// The time, in milliseconds, for which a buffer that had no room counts as full. A full disk may be below
/// [`FULL`]: chunks are dropped whole.
const FULL_FOR: u64 = 10_000;

/// A batch in memory.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Slot {
    pub(super) position: u64,
    /// When it was pushed.
    pub(super) pushed: u64,
    pub(super) batch: Arc<Batch>,
}

/// The limits of a log.
#[derive(Clone, Copy, Debug)]
pub(super) struct Limits {
    /// The bytes of all slots.
    pub(super) memory: usize,
    /// The largest age of a batch.
    pub(super) max_age: Option<u64>,
}

/// Batches by position, with the cursors.
#[derive(Debug)]
pub(super) struct Log {
    pub(super) limits: Limits,
    pub(super) slots: VecDeque<Slot>,
    /// The sizes of all slots.
    pub(super) bytes: usize,
    /// The position of the next batch.
    pub(super) end: u64,
    /// Batches before this position are of an earlier run.
    pub(super) run_first: u64,
    pub(super) cursors: Vec<CursorState>,
    pub(super) next_seqs: HashMap<Arc<str>, u64>,
    /// When a batch that an output lacked was last dropped for want of room.
    pub(super) full_at: Option<u64>,
    /// The disk, if there is one.
    pub(super) disk: Option<DiskState>,
}

/// The state of an output.
#[derive(Debug)]
pub(super) struct CursorState {
    /// The name of the output.
    pub(super) name: Arc<str>,
    /// All batches before this position are acknowledged or dropped.
    pub(super) acknowledged: u64,
    /// No batch before this position is read next.
    pub(super) next: u64,
    /// Batches before this position may have been sent.
    pub(super) sent: u64,
    pub(super) dropped: u64,
    /// The position behind the last replay, until it is settled and the output has caught up.
    pub(super) replays_end: Option<u64>,
    pub(super) ahead: ReadAhead,
}

/// Batches that were read back from disk for an output.
#[derive(Debug, Default)]
pub(super) struct ReadAhead {
    pub(super) slots: VecDeque<Slot>,
    pub(super) bytes: usize,
    /// The position behind the last chunk that was read back.
    pub(super) end: u64,
    /// The output needs more.
    pub(super) is_wanted: bool,
    /// The position from which chunks are being read.
    pub(super) loading: Option<u64>,
}

impl CursorState {
    /// Of an output that has acknowledged all before this position.
    pub(super) fn new(name: Arc<str>, acknowledged: u64) -> Self {
        let (next, sent) = (acknowledged, acknowledged);
        Self { name, acknowledged, next, sent, dropped: 0, replays_end: None, ahead: ReadAhead::default() }
    }

    /// Moves behind batches that are not there any more.
    pub(super) fn skip_to(&mut self, position: u64) {
        self.acknowledged = self.acknowledged.max(position);
        self.next = self.next.max(self.acknowledged);
        self.sent = self.sent.max(self.acknowledged);
    }
}

impl ReadAhead {
    /// Forgets what was read back, and what is being read.
    pub(super) fn clear(&mut self) {
        *self = Self::default();
    }

    fn pop(&mut self) -> Option<Slot> {
        let slot = self.slots.pop_front()?;
        self.bytes = self.bytes.saturating_sub(slot.batch.size());
        Some(slot)
    }
}

impl Log {
    /// A log in memory alone.
    pub(super) fn in_memory(outputs: usize, limits: Limits) -> Self {
        let cursors = (0..outputs).map(|_| CursorState::new("".into(), 1)).collect();
        Self {
            limits,
            slots: VecDeque::new(),
            bytes: 0,
            end: 1,
            run_first: 1,
            cursors,
            next_seqs: HashMap::new(),
            full_at: None,
            disk: None,
        }
    }

    /// Appends a batch and returns its position.
    pub(super) fn push(&mut self, batch: Batch, now: u64) -> u64 {
        let next_seq = batch.seq.saturating_add(1);
        match self.next_seqs.get_mut(&batch.plc) {
            Some(known) => *known = next_seq,
            None => self.insert_next_seq(batch.plc.clone(), next_seq),
        }
        let position = self.end;
        self.end = self.end.saturating_add(1);
        let size = batch.size();
        self.bytes = self.bytes.saturating_add(size);
        if let Some(disk) = &mut self.disk {
            disk.unspilled = disk.unspilled.saturating_add(size);
        }
        self.slots.push_back(Slot { position, pushed: now, batch: Arc::new(batch) });
        self.evict(now);
        self.expire(now);
        self.remove_acknowledged();
        position
    }

    /// The batches that an output reads next, at most `max`. None if there are none, or if they have to be
    /// read back from disk first; then [`Self::is_load_wanted`].
    pub(super) fn read(&mut self, output: usize, max: usize) -> Vec<Slot> {
        let visible = self.visible_end();
        let on_disk_before = self.slots.front().map_or(self.end, |slot| slot.position);
        let Some(cursor) = self.cursors.get_mut(output) else { return Vec::new() };
        let mut read = Vec::new();
        while read.len() < max
            && let Some(slot) = cursor.ahead.pop()
        {
            // Dropped since it was read back.
            if slot.position >= cursor.next {
                cursor.next = slot.position.saturating_add(1);
                read.push(slot);
            }
        }
        if cursor.ahead.slots.is_empty() {
            cursor.next = cursor.next.max(cursor.ahead.end);
        }
        let from = cursor.next.max(cursor.ahead.end);
        let is_on_disk = self.disk.as_ref().is_some_and(|disk| disk.chunks.count(from, on_disk_before) > 0);
        if is_on_disk {
            let low = self.disk.as_ref().map_or(0, |disk| disk.limits.read_ahead / 2);
            let is_low = cursor.ahead.bytes < low || cursor.ahead.slots.is_empty();
            cursor.ahead.is_wanted = is_low && cursor.ahead.loading.is_none();
        } else if cursor.ahead.slots.is_empty() && read.len() < max {
            let begin = self.slots.partition_point(|slot| slot.position < cursor.next);
            let slots = self.slots.range(begin..).take_while(|slot| slot.position < visible);
            read.extend(slots.take(max.saturating_sub(read.len())).cloned());
        }
        if let Some(last) = read.last() {
            cursor.next = cursor.next.max(last.position.saturating_add(1));
        }
        read
    }

    /// Notes that an output sends a batch that it has read, and returns it as it is to be sent.
    pub(super) fn send(&mut self, output: usize, slot: Slot, now: u64) -> Entry {
        let Slot { position, pushed, batch } = slot;
        let mut replay = self.is_late(position, pushed, now);
        if let Some(cursor) = self.cursors.get_mut(output) {
            replay |= position < cursor.sent;
            cursor.sent = cursor.sent.max(position.saturating_add(1));
            if replay {
                cursor.replays_end = cursor.replays_end.max(Some(position.saturating_add(1)));
            }
        }
        Entry { position, batch, replay }
    }

    pub(super) fn acknowledge(&mut self, output: usize, position: u64) {
        if let Some(cursor) = self.cursors.get_mut(output) {
            // A position that was not sent cannot have been delivered.
            let up_to = position.saturating_add(1).min(cursor.sent);
            if up_to > cursor.acknowledged {
                cursor.acknowledged = up_to;
                cursor.next = cursor.next.max(up_to);
                if let Some(disk) = &mut self.disk {
                    disk.is_changed |= !disk.chunks.is_empty();
                }
            }
        }
        self.remove_acknowledged();
    }

    /// Returns whether an output has caught up since the last call: it has sent replays, the last of them is
    /// settled, and no batch that it lacks is late. Batches before the position `settled` are settled without an
    /// acknowledgement: an output keeps some of them, which its server refuses.
    pub(super) fn has_caught_up(&mut self, output: usize, settled: u64, now: u64) -> bool {
        let Some(cursor) = self.cursors.get(output) else { return false };
        let settled = settled.min(cursor.sent).max(cursor.acknowledged);
        if cursor.replays_end.is_none_or(|end| settled < end) {
            return false;
        }
        let begin = self.slots.partition_point(|slot| slot.position < cursor.sent);
        let in_memory = self.slots.front().map_or(self.end, |slot| slot.position);
        let is_late = self.slots.get(begin).is_some_and(|slot| self.is_late(slot.position, slot.pushed, now))
            || self.disk.as_ref().is_some_and(|disk| disk.chunks.count(cursor.sent, in_memory) > 0);
        if let Some(cursor) = self.cursors.get_mut(output).filter(|_| !is_late) {
            cursor.replays_end = None;
        }
        !is_late
    }

    /// Returns whether a batch is no news.
    fn is_late(&self, position: u64, pushed: u64, now: u64) -> bool {
        position < self.run_first || now.saturating_sub(pushed) > LATE_AFTER
    }

    pub(super) fn rewind(&mut self, output: usize) {
        if let Some(cursor) = self.cursors.get_mut(output) {
            cursor.next = cursor.acknowledged;
            cursor.ahead.clear();
        }
    }

    /// Returns whether an output waits for batches from disk.
    pub(super) fn is_load_wanted(&self) -> bool {
        self.cursors.iter().any(|cursor| cursor.ahead.is_wanted && cursor.ahead.loading.is_none())
    }

    pub(super) fn stats(&self) -> Vec<CursorStats> {
        let stats =
            |cursor: &CursorState| CursorStats { lag: self.count_from(cursor.acknowledged), dropped: cursor.dropped };
        self.cursors.iter().map(stats).collect()
    }

    /// The number of batches at or behind a position.
    pub(super) fn count_from(&self, position: u64) -> u64 {
        let in_memory = self.slots.len().saturating_sub(self.slots.partition_point(|slot| slot.position < position));
        let front = self.slots.front().map_or(self.end, |slot| slot.position);
        let on_disk = self.disk.as_ref().map_or(0, |disk| disk.chunks.count(position, front.max(position)));
        on_disk.saturating_add(u64::try_from(in_memory).unwrap_or(u64::MAX))
    }

    /// When the oldest batch was pushed.
    pub(super) fn oldest(&self) -> Option<u64> {
        let chunk = self.disk.as_ref().and_then(|disk| disk.chunks.front());
        chunk.map(|chunk| chunk.oldest).or_else(|| self.slots.front().map(|slot| slot.pushed))
    }

    /// The bytes in memory: slots, and batches that were read back.
    pub(super) fn bytes(&self) -> usize {
        self.cursors.iter().fold(self.bytes, |bytes, cursor| bytes.saturating_add(cursor.ahead.bytes))
    }

    pub(super) fn figures(&self, now: u64) -> BufferStats {
        let bytes = |bytes: usize| u64::try_from(bytes).unwrap_or(u64::MAX);
        let oldest = self.cursors.iter().map(|cursor| cursor.acknowledged).min().unwrap_or(self.end);
        let age = |pushed: u64| Duration::from_millis(now.saturating_sub(pushed));
        let memory = share(bytes(self.bytes), bytes(self.limits.memory));
        let mut stats = BufferStats {
            batches: self.count_from(oldest),
            oldest_age: self.oldest().map(age),
            memory_bytes: bytes(self.bytes()),
            fill: memory,
            ..BufferStats::default()
        };
        if let Some(disk) = &self.disk {
            let Counters { errors, corrupt_files, corrupt_batches, spilled_batches } = disk.counters;
            stats.disk_bytes = disk.chunks.cost();
            stats.file_bytes = disk.file_len;
            let on_disk = share(disk.chunks.cost(), disk.limits.max);
            // New batches are in memory alone while the disk fails.
            stats.fill = if disk.failing.is_some() { on_disk.max(memory) } else { on_disk };
            stats.spilled_batches = spilled_batches;
            stats.disk_errors = errors;
            stats.corrupt_files = corrupt_files;
            stats.corrupt_batches = corrupt_batches;
            stats.failure = self.failure().map(str::to_owned);
        }
        let had_no_room = self.full_at.is_some_and(|at| now.saturating_sub(at) < FULL_FOR);
        stats.is_full = had_no_room || stats.fill >= FULL;
        stats
    }

    pub(super) fn next_seqs(&self) -> HashMap<Arc<str>, u64> {
        self.next_seqs.clone()
    }

    /// Adds a PLC. The one without a batch for the longest is forgotten if there are too many.
    fn insert_next_seq(&mut self, plc: Arc<str>, next_seq: u64) {
        if self.next_seqs.len() >= MAX_PLCS
            && let Some(oldest) = self.next_seqs.iter().min_by_key(|(_, seq)| **seq).map(|(plc, _)| plc.clone())
        {
            self.next_seqs.remove(&oldest);
        }
        self.next_seqs.insert(plc, next_seq);
    }

    /// The position up to which outputs may read.
    fn visible_end(&self) -> u64 {
        match &self.disk {
            // While the disk fails, delivery protects a batch better than memory does.
            Some(disk) if disk.limits.sync && disk.failing.is_none() && !disk.is_closed => disk.durable_end,
            _ => self.end,
        }
    }

    /// Removes slots until they are within the limit: those on disk first, and then the oldest.
    pub(super) fn evict(&mut self, now: u64) {
        while self.bytes > self.limits.memory && self.slots.len() > 1 {
            let front = self.slots.front().map_or(self.end, |slot| slot.position);
            if self.disk.as_ref().is_some_and(|disk| front < disk.durable_end) {
                self.pop_slot();
            } else if let Some(end) = self.disk.as_ref().and_then(|disk| disk.in_flight) {
                self.drop_for_room(now, |log| log.drop_behind(end));
                return;
            } else {
                self.drop_for_room(now, Self::drop_slot);
            }
        }
    }

    /// Drops batches for want of room.
    pub(super) fn drop_for_room(&mut self, now: u64, work: impl FnOnce(&mut Self)) {
        let dropped = |log: &Self| log.cursors.iter().fold(0_u64, |sum, one| sum.saturating_add(one.dropped));
        let before = dropped(self);
        work(self);
        if dropped(self) > before {
            self.full_at = Some(now);
        }
    }

    /// Drops batches that are too old.
    pub(super) fn expire(&mut self, now: u64) {
        let Some(max_age) = self.limits.max_age else { return };
        let is_old = |pushed: u64| now.saturating_sub(pushed) > max_age;
        while let Some(chunk) = self.disk.as_ref().and_then(|disk| disk.chunks.front()) {
            if !is_old(chunk.newest) {
                return;
            }
            self.drop_chunk();
        }
        // All that is written at the moment is newer than its first batch.
        while self.slots.front().is_some_and(|slot| is_old(slot.pushed)) && self.in_flight().is_none() {
            self.drop_slot();
        }
    }

    /// Removes the batches that all outputs have acknowledged.
    pub(super) fn remove_acknowledged(&mut self) {
        let acknowledged = self.cursors.iter().map(|cursor| cursor.acknowledged).min().unwrap_or(self.end);
        while self.slots.front().is_some_and(|slot| slot.position < acknowledged) {
            self.pop_slot();
        }
        while let Some(disk) = &mut self.disk
            && disk.chunks.front().is_some_and(|chunk| chunk.end() <= acknowledged)
        {
            disk.chunks.pop_front();
            disk.is_changed = true;
        }
    }

    /// Drops the oldest chunk, with its copy in memory.
    pub(super) fn drop_chunk(&mut self) {
        let Some(disk) = &mut self.disk else { return };
        let Some(chunk) = disk.chunks.front() else { return };
        for cursor in &mut self.cursors {
            let missed = disk.chunks.count(cursor.acknowledged, chunk.end());
            cursor.dropped = cursor.dropped.saturating_add(missed);
            cursor.skip_to(chunk.end());
        }
        disk.chunks.pop_front();
        disk.is_changed = true;
        while self.slots.front().is_some_and(|slot| slot.position < chunk.end()) {
            self.pop_slot();
        }
    }

    /// Drops the end of a chunk, which could not be read back: all but its first `count` batches of `len`
    /// bytes. Returns the number of batches that are lost.
    pub(super) fn truncate_chunk(&mut self, chunk: Chunk, count: u32, len: u32) -> u64 {
        let Some(disk) = &mut self.disk else { return 0 };
        let begin = chunk.first.saturating_add(count.into());
        // Dropped or acknowledged meanwhile, or found by another output.
        let lost = disk.chunks.count(begin, chunk.end());
        if lost == 0 {
            return 0;
        }
        for cursor in &mut self.cursors {
            let missed = disk.chunks.count(cursor.acknowledged.max(begin), chunk.end());
            cursor.dropped = cursor.dropped.saturating_add(missed);
        }
        disk.chunks.truncate(chunk.first, count, len);
        disk.is_changed = true;
        // Batches before `durable_end` are in chunks.
        let copies = self.slots.partition_point(|slot| slot.position < begin)
            ..self.slots.partition_point(|slot| slot.position < chunk.end());
        for slot in self.slots.drain(copies) {
            self.bytes = self.bytes.saturating_sub(slot.batch.size());
        }
        lost
    }

    fn in_flight(&self) -> Option<u64> {
        self.disk.as_ref().and_then(|disk| disk.in_flight)
    }

    /// Drops the first slot, which is not on disk.
    fn drop_slot(&mut self) {
        let Some(slot) = self.pop_slot() else { return };
        // Otherwise there are older batches, on disk.
        let is_oldest = self.disk.as_ref().is_none_or(|disk| disk.chunks.is_empty());
        for cursor in &mut self.cursors {
            cursor.dropped = cursor.dropped.saturating_add(u64::from(cursor.acknowledged <= slot.position));
            if is_oldest {
                cursor.skip_to(slot.position.saturating_add(1));
            }
        }
    }

    /// Drops the oldest slots behind those that are being written. Several at once, since they are in the
    /// middle of the queue.
    fn drop_behind(&mut self, in_flight: u64) {
        let begin = self.slots.partition_point(|slot| slot.position < in_flight);
        let target = self.limits.memory.saturating_sub(self.limits.memory / 16);
        let mut bytes = self.bytes;
        let newest = self.slots.len().saturating_sub(1);
        let too_much = |slot: &&Slot| {
            let is_too_much = bytes > target;
            bytes = bytes.saturating_sub(slot.batch.size());
            is_too_much
        };
        let candidates = self.slots.range(begin.min(newest)..newest);
        let count = candidates.take_while(too_much).count();
        for slot in self.slots.drain(begin.min(newest)..begin.min(newest).saturating_add(count)) {
            let size = slot.batch.size();
            self.bytes = self.bytes.saturating_sub(size);
            if let Some(disk) = &mut self.disk {
                disk.unspilled = disk.unspilled.saturating_sub(size);
            }
            for cursor in &mut self.cursors {
                cursor.dropped = cursor.dropped.saturating_add(u64::from(cursor.acknowledged <= slot.position));
            }
        }
    }

    fn pop_slot(&mut self) -> Option<Slot> {
        let slot = self.slots.pop_front()?;
        let size = slot.batch.size();
        self.bytes = self.bytes.saturating_sub(size);
        if let Some(disk) = &mut self.disk
            && slot.position >= disk.durable_end
        {
            disk.unspilled = disk.unspilled.saturating_sub(size);
        }
        Some(slot)
    }
}

/// The share of a limit that is used, in steps of a thousandth.
fn share(used: u64, limit: u64) -> f64 {
    let thousandths = used.saturating_mul(1000).checked_div(limit).unwrap_or(0).min(1000);
    f64::from(u16::try_from(thousandths).unwrap_or(u16::MAX)) / 1000.0
}

#[cfg(test)]
mod tests;
