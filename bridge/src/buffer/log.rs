//! The log of batches in memory, with the cursors of the outputs. No I/O, and no clock.

use std::collections::{HashMap, VecDeque};
use std::sync::Arc;

use super::{CursorStats, Entry};
use crate::batch::Batch;

/// Batches with consecutive positions.
#[derive(Debug)]
pub(super) struct Log {
    /// The position of the first batch in `batches`.
    first: u64,
    batches: VecDeque<Arc<Batch>>,
    bytes: usize,
    max_bytes: usize,
    cursors: Vec<CursorState>,
    next_seqs: HashMap<Arc<str>, u64>,
}

#[derive(Clone, Copy, Debug)]
struct CursorState {
    /// All batches before this position are acknowledged or dropped.
    acknowledged: u64,
    /// The position that is read next.
    next: u64,
    /// Batches before this position were read before.
    read: u64,
    dropped: u64,
}

impl Log {
    pub(super) fn new(outputs: usize, max_bytes: usize) -> Self {
        let cursor = CursorState { acknowledged: 1, next: 1, read: 1, dropped: 0 };
        let cursors = vec![cursor; outputs];
        Self { first: 1, batches: VecDeque::new(), bytes: 0, max_bytes, cursors, next_seqs: HashMap::new() }
    }

    pub(super) fn push(&mut self, batch: Batch) -> u64 {
        self.next_seqs.insert(batch.plc.clone(), batch.seq.saturating_add(1));
        let position = self.end();
        self.bytes = self.bytes.saturating_add(batch.size());
        self.batches.push_back(Arc::new(batch));
        // The newest stays, however large it is.
        while self.bytes > self.max_bytes && self.batches.len() > 1 {
            self.drop_oldest();
        }
        self.remove_acknowledged();
        position
    }

    pub(super) fn read(&mut self, output: usize, max: usize) -> Vec<Entry> {
        let (first, end) = (self.first, self.end());
        let Some(cursor) = self.cursors.get_mut(output) else { return Vec::new() };
        let begin = cursor.next;
        let until = begin.saturating_add(u64::try_from(max).unwrap_or(u64::MAX)).min(end);
        let already_read = cursor.read;
        let entry = |position: u64| {
            let at = usize::try_from(position.checked_sub(first)?).ok()?;
            Some(Entry { position, batch: self.batches.get(at)?.clone(), replay: position < already_read })
        };
        let entries: Vec<Entry> = (begin..until).filter_map(entry).collect();
        cursor.next = until.max(begin);
        cursor.read = cursor.read.max(cursor.next);
        entries
    }

    pub(super) fn acknowledge(&mut self, output: usize, position: u64) {
        if let Some(cursor) = self.cursors.get_mut(output) {
            // A position that was not read cannot have been delivered.
            let up_to = position.saturating_add(1).min(cursor.read);
            cursor.acknowledged = cursor.acknowledged.max(up_to);
            cursor.next = cursor.next.max(cursor.acknowledged);
        }
        self.remove_acknowledged();
    }

    pub(super) fn rewind(&mut self, output: usize) {
        if let Some(cursor) = self.cursors.get_mut(output) {
            cursor.next = cursor.acknowledged;
        }
    }

    pub(super) fn stats(&self) -> Vec<CursorStats> {
        let end = self.end();
        let stats = |cursor: &CursorState| CursorStats {
            lag: end.saturating_sub(cursor.acknowledged),
            dropped: cursor.dropped,
        };
        self.cursors.iter().map(stats).collect()
    }

    pub(super) fn bytes(&self) -> usize {
        self.bytes
    }

    pub(super) fn next_seqs(&self) -> HashMap<Arc<str>, u64> {
        self.next_seqs.clone()
    }

    /// The position of the next batch.
    fn end(&self) -> u64 {
        self.first.saturating_add(u64::try_from(self.batches.len()).unwrap_or(u64::MAX))
    }

    fn drop_oldest(&mut self) {
        let position = self.first;
        self.remove_first();
        for cursor in &mut self.cursors {
            if cursor.acknowledged <= position {
                cursor.acknowledged = position.saturating_add(1);
                cursor.dropped = cursor.dropped.saturating_add(1);
            }
            cursor.next = cursor.next.max(cursor.acknowledged);
            cursor.read = cursor.read.max(cursor.acknowledged);
        }
    }

    fn remove_acknowledged(&mut self) {
        let acknowledged = self.cursors.iter().map(|cursor| cursor.acknowledged).min().unwrap_or(self.end());
        while self.first < acknowledged && !self.batches.is_empty() {
            self.remove_first();
        }
    }

    fn remove_first(&mut self) {
        if let Some(batch) = self.batches.pop_front() {
            self.bytes = self.bytes.saturating_sub(batch.size());
            self.first = self.first.saturating_add(1);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn batch(seq: u64) -> Batch {
        Batch { plc: "mixer".into(), seq, ts: seq, samples: 1, data: "{\"level\":1}".into() }
    }

    fn seqs(entries: &[Entry]) -> Vec<u64> {
        entries.iter().map(|entry| entry.batch.seq).collect()
    }

    #[test]
    fn each_output_reads_all_batches_in_order_and_a_slow_one_keeps_them() {
        let mut log = Log::new(2, 1 << 20);
        (1..=5).for_each(|seq| {
            log.push(batch(seq));
        });
        assert_eq!(seqs(&log.read(0, 3)), [1, 2, 3]);
        assert_eq!(seqs(&log.read(0, 9)), [4, 5]);
        log.acknowledge(0, 5);
        assert_eq!(log.stats()[0].lag, 0);
        assert_eq!(seqs(&log.read(1, 9)), [1, 2, 3, 4, 5]);
        log.acknowledge(1, 2);
        assert_eq!((log.first, log.batches.len()), (3, 3));
        log.rewind(1);
        let again = log.read(1, 9);
        assert_eq!(seqs(&again), [3, 4, 5]);
        assert!(again.iter().all(|entry| entry.replay));
        log.push(batch(6));
        assert!(!log.read(1, 9)[0].replay);
    }

    #[test]
    fn a_full_log_drops_the_oldest_and_counts_it_for_those_that_lack_it() {
        let size = batch(1).size();
        let mut log = Log::new(2, 3 * size);
        (1..=3).for_each(|seq| {
            log.push(batch(seq));
        });
        log.read(0, 9);
        log.acknowledge(0, 2);
        (4..=5).for_each(|seq| {
            log.push(batch(seq));
        });
        assert_eq!((log.stats()[0].dropped, log.stats()[1].dropped), (0, 2));
        assert_eq!(seqs(&log.read(0, 9)), [4, 5]);
        assert_eq!(seqs(&log.read(1, 9)), [3, 4, 5]);
        assert_eq!(log.bytes(), 3 * size);
    }

    #[test]
    fn an_acknowledgement_of_what_was_not_read_has_no_effect() {
        let mut log = Log::new(1, 1 << 20);
        (1..=3).for_each(|seq| {
            log.push(batch(seq));
        });
        log.acknowledge(0, 99);
        assert_eq!(log.stats()[0].lag, 3);
        assert_eq!(seqs(&log.read(0, 2)), [1, 2]);
        log.acknowledge(0, 99);
        assert_eq!(log.stats()[0].lag, 1);
        log.acknowledge(0, 0);
        assert_eq!(seqs(&log.read(0, 2)), [3]);
    }
}
