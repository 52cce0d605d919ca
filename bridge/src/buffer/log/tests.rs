//! Tests of the log.

use super::*;
use crate::buffer::disk::Restored;
use crate::buffer::jobs::{DiskLimits, Job};
use crate::buffer::restore::continue_log;

fn batch(seq: u64) -> Batch {
    Batch { plc: "mixer".into(), revision: 0, seq, ts: seq, samples: 1, data: "{\"level\":1}".into() }
}

fn log(outputs: usize, memory: usize) -> Log {
    Log::in_memory(outputs, Limits { memory, max_age: Some(1000) })
}

/// Reads batches and sends them at once.
fn take(log: &mut Log, output: usize, max: usize) -> Vec<Entry> {
    let read = log.read(output, max);
    read.into_iter().map(|slot| log.send(output, slot, 0)).collect()
}

fn seqs(entries: &[Entry]) -> Vec<u64> {
    entries.iter().map(|entry| entry.batch.seq).collect()
}

#[test]
fn each_output_reads_all_batches_in_order_and_a_slow_one_keeps_them() {
    let mut log = log(2, 1 << 20);
    (1..=5).for_each(|seq| {
        log.push(batch(seq), seq);
    });
    assert_eq!(seqs(&take(&mut log, 0, 3)), [1, 2, 3]);
    assert_eq!(seqs(&take(&mut log, 0, 9)), [4, 5]);
    log.acknowledge(0, 5);
    assert_eq!(log.stats()[0].lag, 0);
    assert_eq!(seqs(&take(&mut log, 1, 9)), [1, 2, 3, 4, 5]);
    log.acknowledge(1, 2);
    assert_eq!((log.slots[0].position, log.slots.len()), (3, 3));
    log.rewind(1);
    let again = take(&mut log, 1, 9);
    assert_eq!(seqs(&again), [3, 4, 5]);
    assert!(again.iter().all(|entry| entry.replay));
    log.push(batch(6), 6);
    assert!(!take(&mut log, 1, 9)[0].replay);
}

#[test]
fn an_output_has_caught_up_when_its_last_replay_is_acknowledged() {
    let mut log = Log::in_memory(2, Limits { memory: 1 << 20, max_age: None });
    let late = |at: u64| at + LATE_AFTER + 1;
    (1..=4).for_each(|seq| {
        log.push(batch(seq), 0);
    });
    let send = |log: &mut Log, count: usize, now: u64| {
        let read = log.read(0, count);
        replays(log, read, now)
    };
    // Without a replay there is nothing to catch up with.
    assert_eq!(send(&mut log, 1, 0), [false]);
    log.acknowledge(0, 1);
    assert!(!log.has_caught_up(0, 0, 0));
    // Two of three late batches are sent: the third is missing.
    assert_eq!(send(&mut log, 2, late(0)), [true, true]);
    log.acknowledge(0, 2);
    assert!(!log.has_caught_up(0, 0, late(0)), "the third is not acknowledged");
    log.acknowledge(0, 3);
    assert!(!log.has_caught_up(0, 0, late(0)), "the fourth is late");
    log.push(batch(5), late(0));
    assert_eq!(send(&mut log, 1, late(0)), [true]);
    log.acknowledge(0, 4);
    assert!(log.has_caught_up(0, 0, late(0)), "the fifth is news");
    assert!(!log.has_caught_up(0, 0, late(0)) && !log.has_caught_up(1, 0, late(0)), "once, and of this output");
    // After a loss, batches that may have been sent are replays.
    assert_eq!(send(&mut log, 1, late(0)), [false]);
    log.rewind(0);
    assert_eq!(send(&mut log, 1, late(0)), [true]);
    log.acknowledge(0, 5);
    assert!(log.has_caught_up(0, 0, late(0)));
}

#[test]
fn an_output_has_caught_up_but_for_the_batches_that_it_keeps() {
    let mut log = Log::in_memory(1, Limits { memory: 1 << 20, max_age: None });
    (1..=4).for_each(|seq| {
        log.push(batch(seq), 0);
    });
    let late = LATE_AFTER + 1;
    let read = log.read(0, 3);
    assert_eq!(replays(&mut log, read, late), [true; 3]);
    // The first is kept, the second is acknowledged, and the third is in flight.
    assert!(!log.has_caught_up(0, 3, late));
    assert!(!log.has_caught_up(0, u64::MAX, late), "the fourth is late");
    let read = log.read(0, 1);
    assert_eq!(replays(&mut log, read, late), [true]);
    assert!(!log.has_caught_up(0, 4, late));
    assert!(log.has_caught_up(0, 5, late) && !log.has_caught_up(0, 5, late), "once");
    assert_eq!(log.stats()[0].lag, 4, "nothing is acknowledged");
}

/// Sends batches, and tells which ones are replays.
fn replays(log: &mut Log, slots: Vec<Slot>, now: u64) -> Vec<bool> {
    slots.into_iter().map(|slot| log.send(0, slot, now).replay).collect()
}

#[test]
fn a_batch_that_may_have_been_sent_is_a_replay_and_one_that_was_only_read_is_not() {
    let mut log = log(1, 1 << 20);
    (1..=4).for_each(|seq| {
        log.push(batch(seq), 100);
    });
    let mut read = log.read(0, 4);
    read.truncate(2);
    assert_eq!(replays(&mut log, read, 100), [false, false]);
    // A second connection that is lost sooner forgets nothing of the first one.
    log.rewind(0);
    let mut read = log.read(0, 4);
    read.truncate(1);
    assert_eq!(replays(&mut log, read, 100), [true]);
    log.rewind(0);
    let read = log.read(0, 4);
    assert_eq!(replays(&mut log, read, 100), [true, true, false, false]);
}

#[test]
fn a_batch_that_is_late_when_it_is_sent_is_a_replay() {
    let mut log = log(1, 1 << 20);
    (1..=3).for_each(|seq| {
        log.push(batch(seq), 100);
    });
    let mut read = log.read(0, 3);
    let rest = read.split_off(1);
    assert_eq!(replays(&mut log, read, 100 + LATE_AFTER), [false]);
    assert_eq!(replays(&mut log, rest, 101 + LATE_AFTER), [true, true]);
}

#[test]
fn a_full_log_drops_the_oldest_and_counts_it_for_those_that_lack_it() {
    let size = batch(1).size();
    let mut log = log(2, 3 * size);
    (1..=3).for_each(|seq| {
        log.push(batch(seq), seq);
    });
    take(&mut log, 0, 9);
    log.acknowledge(0, 2);
    (4..=5).for_each(|seq| {
        log.push(batch(seq), seq);
    });
    assert_eq!((log.stats()[0].dropped, log.stats()[1].dropped), (0, 2));
    assert_eq!(seqs(&take(&mut log, 0, 9)), [4, 5]);
    assert_eq!(seqs(&take(&mut log, 1, 9)), [3, 4, 5]);
    assert_eq!(log.bytes(), 3 * size);
}

#[test]
fn an_acknowledgement_of_what_was_not_read_has_no_effect() {
    let mut log = log(1, 1 << 20);
    (1..=3).for_each(|seq| {
        log.push(batch(seq), seq);
    });
    log.acknowledge(0, 99);
    assert_eq!(log.stats()[0].lag, 3);
    assert_eq!(seqs(&take(&mut log, 0, 2)), [1, 2]);
    log.acknowledge(0, 99);
    assert_eq!(log.stats()[0].lag, 1);
    log.acknowledge(0, 0);
    assert_eq!(seqs(&take(&mut log, 0, 2)), [3]);
}

#[test]
fn batches_that_are_too_old_are_dropped_and_counted() {
    let mut log = log(1, 1 << 20);
    log.push(batch(1), 0);
    log.push(batch(2), 600);
    log.push(batch(3), 1000);
    assert_eq!(log.stats()[0], CursorStats { lag: 3, dropped: 0 });
    log.push(batch(4), 1001);
    assert_eq!(log.stats()[0], CursorStats { lag: 3, dropped: 1 });
    assert_eq!(seqs(&take(&mut log, 0, 9)), [2, 3, 4]);
}

#[test]
fn the_sequence_numbers_of_a_bounded_number_of_plcs_are_kept() {
    let mut log = log(1, 1 << 20);
    for seq in 1..=u64::try_from(MAX_PLCS).unwrap() + 3 {
        log.push(Batch { plc: format!("plc{seq}").as_str().into(), ..batch(seq) }, seq);
    }
    let kept = log.next_seqs();
    assert_eq!(kept.len(), MAX_PLCS);
    assert!(!kept.contains_key("plc3") && kept.contains_key("plc4"));
}

#[test]
fn a_log_without_room_is_full_until_nothing_was_dropped_for_ten_seconds() {
    let size = batch(1).size();
    // The share of three batches in 3.5 is not that of a full one.
    let mut log = Log::in_memory(1, Limits { memory: 3 * size + size / 2, max_age: Some(60_000) });
    (1..=3).for_each(|seq| {
        log.push(batch(seq), 0);
    });
    assert!(!log.figures(0).is_full);
    log.push(batch(4), 1_000);
    let figures = log.figures(1_000);
    assert!(figures.is_full && figures.fill < FULL && log.stats()[0].dropped == 1, "{figures:?}");
    assert!(log.figures(1_000 + FULL_FOR - 1).is_full);
    assert!(!log.figures(1_000 + FULL_FOR).is_full);
    // One that is too old does not lack room.
    log.expire(60_500);
    assert_eq!((log.stats()[0].dropped, log.figures(60_500).is_full), (3, false));
    // A batch that all outputs have is no loss.
    take(&mut log, 0, 9);
    log.acknowledge(0, 4);
    log.push(batch(5), 61_000);
    assert!(!log.figures(61_000).is_full);
}

/// A log on a disk of this size.
fn log_on_disk(memory: usize, max: u64) -> Log {
    let limits = Limits { memory, max_age: Some(60_000) };
    let disk = DiskLimits { max, chunk: 16 << 10, job: 1 << 16, read_ahead: 1 << 16, sync: false };
    continue_log(Restored::default(), &["mqtt"], limits, disk, 0).0
}

#[test]
fn while_the_disk_fails_the_memory_counts() {
    let size = batch(1).size();
    let mut log = log_on_disk(10 * size, 1 << 30);
    log.failed("no space".to_owned(), 0);
    (1..=9).for_each(|seq| {
        log.push(batch(seq), 0);
    });
    let figures = log.figures(0);
    assert!((figures.fill - 0.9).abs() < 0.01 && !figures.is_full, "{figures:?}");
    log.push(batch(10), 0);
    assert!(log.figures(0).is_full && log.stats()[0].dropped == 0, "there is no room");
    log.push(batch(11), 0);
    assert!(log.figures(9_000).is_full && log.stats()[0].dropped == 1);
}

#[test]
fn a_small_disk_is_full_below_its_limit() {
    let mut log = log_on_disk(1 << 20, 1 << 20);
    for seq in 1..20_000 {
        log.push(Batch { data: vec![b'x'; 500].into(), ..batch(seq) }, seq);
        if let Some(Job::Commit(commit)) = log.plan(seq, false) {
            log.committed(&commit, seq, 0);
        }
        let figures = log.figures(seq);
        if log.stats()[0].dropped > 0 {
            assert!(figures.is_full && figures.fill < FULL, "{figures:?}");
            return;
        }
    }
    panic!("the disk has room without end");
}
