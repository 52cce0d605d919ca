//! Seeded test of the log against a model: outputs that read, acknowledge and go back, a file that is slow,
//! fails, rots or is lost, crashes and restarts. No I/O, and no clock.
//!
//! `FATEK_BUFFER_SEEDS` sets the number of seeds, and `FATEK_BUFFER_SEED` the first.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::sync::Arc;

use super::disk::Restored;
use super::jobs::{Commit, DiskLimits, Job, Load};
use super::log::{Limits, Log, Slot};
use super::restore::continue_log;
use crate::batch::Batch;

const MAX_DATA: usize = 600;
const STEPS: u32 = 4_000;

/// A file, as the disk has it.
#[derive(Clone, Debug, Default)]
struct File {
    rows: BTreeMap<u64, Row>,
    cursors: HashMap<String, u64>,
    next_seqs: HashMap<Arc<str>, u64>,
    end: u64,
    time: u64,
}

#[derive(Clone, Debug)]
struct Row {
    slots: Vec<Slot>,
    /// The first record that is damaged.
    rotten_from: usize,
    chunk: super::chunk::Chunk,
}

/// An output, and what it knows.
#[derive(Debug, Default)]
struct Output {
    /// The batches of this run that it is to get: all that are not acknowledged at the start, and later ones.
    owed: BTreeSet<u64>,
    /// Those of them that were acknowledged.
    acknowledged: BTreeSet<u64>,
    delivered: BTreeSet<u64>,
    /// The last that was read since the last rewind.
    last: u64,
    last_acknowledged: u64,
}

struct World {
    seed: u64,
    rng: fastrand::Rng,
    limits: Limits,
    disk: DiskLimits,
    log: Log,
    file: File,
    in_flight: Option<Job>,
    names: Vec<&'static str>,
    outputs: Vec<Output>,
    now: u64,
    /// The sequence number of each position.
    truth: HashMap<u64, u64>,
    next_seq: u64,
    figures: Figures,
}

#[derive(Debug, Default)]
struct Figures {
    pushed: u64,
    delivered: u64,
    replayed: u64,
    dropped: u64,
    loads: u64,
    commits: u64,
    failures: u64,
    losses: u64,
    crashes: u64,
}

impl File {
    fn apply(&mut self, commit: &Commit) {
        self.rows.retain(|key, _| (commit.remove_before..commit.remove_from).contains(key));
        for new in &commit.chunks {
            let kept = usize::try_from(new.chunk.count).unwrap() - new.slots.len();
            assert_eq!(kept > 0, new.keep > 0);
            let old = self.rows.remove(&new.chunk.first);
            let mut row = old.unwrap_or(Row { slots: Vec::new(), rotten_from: usize::MAX, chunk: new.chunk });
            row.slots.truncate(kept);
            assert_eq!(row.slots.len(), kept, "a chunk goes on where it ended");
            row.rotten_from = if row.rotten_from < kept { row.rotten_from } else { usize::MAX };
            row.slots.extend(new.slots.iter().cloned());
            row.chunk = new.chunk;
            self.rows.insert(new.chunk.first, row);
        }
        self.cursors = commit.cursors.iter().map(|(name, at)| (name.to_string(), *at)).collect();
        self.end = commit.end;
        self.time = commit.time;
        if let Some(next_seqs) = &commit.next_seqs {
            self.next_seqs = next_seqs.iter().cloned().collect();
        }
    }

    fn read(&self, load: &Load) -> Vec<Vec<Slot>> {
        let row = |key: &u64| {
            let row = self.rows.get(key)?;
            Some(row.slots.iter().take(row.rotten_from).cloned().collect())
        };
        load.chunks.iter().map(|chunk| row(&chunk.first).unwrap_or_default()).collect()
    }

    fn restored(&self) -> Restored {
        Restored {
            chunks: self.rows.values().map(|row| row.chunk).collect(),
            cursors: self.cursors.clone(),
            next_seqs: self.next_seqs.clone(),
            end: self.end,
            time: self.time,
            clock: 1_000_000,
        }
    }

    fn has(&self, position: u64) -> bool {
        self.rows.values().any(|row| row.slots.iter().any(|slot| slot.position == position))
    }
}

impl World {
    fn new(seed: u64) -> Self {
        let mut rng = fastrand::Rng::with_seed(seed);
        let memory = rng.usize(4_000..40_000);
        let max_age = rng.bool().then(|| rng.u64(5_000..60_000));
        let limits = Limits { memory, max_age };
        let disk = DiskLimits {
            max: rng.u64(60_000..400_000),
            chunk: 4096,
            job: rng.usize(1_000..memory / 2),
            read_ahead: rng.usize(500..8_000),
            sync: rng.bool(),
        };
        let names = ["mqtt", "nats", "stdout"];
        let names = names.into_iter().take(rng.usize(1..=3)).collect();
        let (log, now) = continue_log(Restored::default(), &[], limits, disk, 0);
        let mut world = Self {
            seed,
            rng,
            limits,
            disk,
            log,
            file: File::default(),
            in_flight: None,
            names,
            outputs: Vec::new(),
            now,
            truth: HashMap::new(),
            next_seq: 1,
            figures: Figures::default(),
        };
        world.restart();
        world
    }

    /// The process ends without a word, and a new one goes on with the file.
    fn restart(&mut self) {
        self.in_flight = None;
        if self.rng.u8(..10) == 0 {
            let all = ["nats", "mqtt", "stdout"];
            self.names = all.into_iter().filter(|_| self.rng.bool()).collect();
        }
        let before = self.log.end;
        let pause = self.rng.u64(0..1_000);
        let restored = self.file.restored();
        let (log, now) = continue_log(restored, &self.names, self.limits, self.disk, 1_000_000 + pause);
        assert!(log.end >= before, "seed {}: positions are not used again", self.seed);
        self.log = log;
        self.now = now;
        let file = &self.file;
        self.outputs = self
            .names
            .iter()
            .zip(self.log.stats())
            .map(|(name, stats)| {
                let from = file.cursors.get(*name).copied().unwrap_or(0);
                let all = file.rows.values().flat_map(|row| &row.slots).map(|slot| slot.position);
                let owed: BTreeSet<u64> = all.filter(|position| *position >= from).collect();
                let count = u64::try_from(owed.len()).unwrap();
                assert_eq!(count, stats.lag + stats.dropped, "all that was written and not acknowledged is there");
                Output { owed, ..Output::default() }
            })
            .collect();
        let commit = self.log.plan_commit(self.now, false);
        self.file.apply(&commit);
        self.log.committed(&commit, self.now, 0);
    }

    fn step(&mut self) {
        match self.rng.u32(..1000) {
            0..=399 => self.push(),
            400..=549 => self.read(),
            550..=629 => self.acknowledge(),
            630..=639 => self.rewind(),
            640..=749 => self.now += self.rng.u64(..80),
            750..=959 => self.storage(),
            960..=964 => self.rot(),
            965..=966 => self.crash(),
            967 => self.close(),
            // A burst while the disk is slow.
            968..=971 => (0..self.rng.u32(..200)).for_each(|_| self.push()),
            _ => {}
        }
        self.check();
    }

    fn push(&mut self) {
        let seq = self.next_seq;
        self.next_seq += 1;
        let data = vec![b'x'; self.rng.usize(..MAX_DATA)].into();
        let batch = Batch { plc: "mixer".into(), revision: 0, seq, ts: 0, samples: 1, data };
        let position = self.log.push(batch, self.now);
        assert_eq!(self.truth.insert(position, seq), None, "positions are not used again");
        for output in &mut self.outputs {
            output.owed.insert(position);
        }
        self.figures.pushed += 1;
    }

    fn read(&mut self) {
        if self.outputs.is_empty() {
            return;
        }
        let at = self.rng.usize(..self.outputs.len());
        let max = self.rng.usize(1..40);
        self.read_some(at, max);
    }

    fn read_some(&mut self, at: usize, max: usize) {
        let is_ok = self.log.failure().is_none();
        let run_first = self.log.run_first;
        let slots = self.log.read(at, max);
        assert!(slots.len() <= max);
        let output = &mut self.outputs[at];
        for slot in slots {
            let is_late = self.now - slot.pushed > 5_000;
            let entry = self.log.send(at, slot, self.now);
            let position = entry.position;
            assert!(position > output.last, "seed {}: {} reads in order", self.seed, self.names[at]);
            assert_eq!(Some(&entry.batch.seq), self.truth.get(&position), "the batch is the one that was pushed");
            let is_replay = output.delivered.contains(&position) || position < run_first || is_late;
            assert_eq!(entry.replay, is_replay, "seed {}: {position}", self.seed);
            if self.disk.sync && is_ok {
                assert!(self.file.has(position), "seed {}: {position} is on disk before it is delivered", self.seed);
            }
            output.last = position;
            output.delivered.insert(position);
            self.figures.delivered += 1;
            self.figures.replayed += u64::from(entry.replay);
        }
    }

    fn acknowledge(&mut self) {
        if self.outputs.is_empty() {
            return;
        }
        let at = self.rng.usize(..self.outputs.len());
        let output = &self.outputs[at];
        let since: Vec<u64> = output.delivered.range(output.last_acknowledged..=output.last).copied().collect();
        if let Some(position) = self.rng.choice(since) {
            self.acknowledge_to(at, position);
        }
    }

    fn acknowledge_to(&mut self, at: usize, position: u64) {
        self.log.acknowledge(at, position);
        let output = &mut self.outputs[at];
        output.acknowledged.extend(output.delivered.range(..=position));
        output.last_acknowledged = output.last_acknowledged.max(position);
    }

    fn rewind(&mut self) {
        if self.outputs.is_empty() {
            return;
        }
        let at = self.rng.usize(..self.outputs.len());
        self.log.rewind(at);
        let output = &mut self.outputs[at];
        output.last = output.last_acknowledged;
    }

    /// The storage thread begins a job, or ends one.
    fn storage(&mut self) {
        let Some(job) = self.in_flight.take() else {
            self.in_flight = self.log.plan(self.now, false);
            if self.in_flight.is_none() && self.log.failure().is_none() {
                self.check_spilled();
            }
            return;
        };
        match self.rng.u32(..100) {
            0..=4 => {
                // It failed, but it may be in the file.
                if let Job::Commit(commit) = &job
                    && self.rng.bool()
                {
                    self.file.apply(commit);
                }
                self.log.failed("injected".to_owned(), self.now);
                self.figures.failures += 1;
            }
            5 if self.rng.u8(..4) == 0 => {
                self.file = File { end: self.file.end, time: self.file.time, ..File::default() };
                self.log.file_lost(self.now);
                self.figures.losses += 1;
            }
            _ => self.finish(&job),
        }
    }

    fn finish(&mut self, job: &Job) {
        match job {
            Job::Commit(commit) => {
                self.file.apply(commit);
                self.log.committed(commit, self.now, 0);
                self.figures.commits += 1;
            }
            Job::Load(load) => {
                let read = self.file.read(load);
                self.log.loaded(load, read);
                self.figures.loads += 1;
            }
            Job::Compact => self.log.compacted(0),
        }
    }

    /// A record in the file is damaged.
    fn rot(&mut self) {
        let keys: Vec<u64> = self.file.rows.keys().copied().collect();
        if self.rng.u8(..4) > 0 {
            return;
        }
        if let Some(key) = self.rng.choice(keys)
            && let Some(row) = self.file.rows.get_mut(&key)
        {
            row.rotten_from = self.rng.usize(..row.slots.len());
        }
    }

    fn crash(&mut self) {
        self.count_dropped();
        self.figures.crashes += 1;
        self.restart();
    }

    /// All is written, and the process ends.
    fn close(&mut self) {
        self.in_flight = None;
        self.log.failed("the job was given up".to_owned(), self.now);
        while let Some(job) = self.log.plan(self.now, true) {
            self.finish(&job);
        }
        assert!(self.log.is_written(), "seed {}", self.seed);
        let lags: Vec<u64> = self.log.stats().iter().map(|stats| stats.lag).collect();
        let names = self.names.clone();
        self.crash();
        if self.names == names && self.limits.max_age.is_none() {
            let restored: Vec<u64> = self.log.stats().iter().map(|stats| stats.lag).collect();
            // A damaged record is noticed once more.
            let is_kept = restored.iter().zip(&lags).all(|(restored, lag)| restored >= lag);
            assert!(is_kept, "seed {}: nothing is lost when the buffer is closed", self.seed);
        }
    }

    /// No batch without an acknowledgement is in memory alone for longer than half a second.
    fn check_spilled(&self) {
        let disk = self.log.disk.as_ref().expect("there is a disk");
        for slot in self.log.slots.iter().filter(|slot| slot.position >= disk.durable_end) {
            assert!(self.now - slot.pushed < 600, "seed {}: {} is not on disk", self.seed, slot.position);
        }
    }

    fn check(&self) {
        let seed = self.seed;
        let disk = self.log.disk.as_ref().expect("there is a disk");
        let sizes = |from: u64| {
            let slots = self.log.slots.iter().filter(|slot| slot.position >= from);
            slots.map(|slot| slot.batch.size()).sum::<usize>()
        };
        assert_eq!(self.log.bytes, sizes(0), "seed {seed}");
        assert_eq!(disk.unspilled, sizes(disk.durable_end), "seed {seed}");
        let batch = MAX_DATA + 200;
        assert!(self.log.bytes <= self.limits.memory + disk.limits.job + batch, "seed {seed}: {}", self.log.bytes);
        let job = u64::try_from(disk.limits.job).unwrap() * 2 + 50_000;
        assert!(disk.chunks.cost() <= self.disk.max + job, "seed {seed}: {} on disk", disk.chunks.cost());
        for (cursor, (output, stats)) in self.log.cursors.iter().zip(self.outputs.iter().zip(self.log.stats())) {
            assert!(cursor.ahead.bytes <= 2 * self.disk.read_ahead + 8192, "seed {seed}");
            let count = |set: &BTreeSet<u64>| u64::try_from(set.len()).unwrap();
            let accounted = count(&output.acknowledged) + stats.lag + stats.dropped;
            assert!(count(&output.owed) <= accounted, "seed {seed}: lost without a count: {output:?} {stats:?}");
            assert!(stats.lag + stats.dropped <= count(&output.owed), "seed {seed}: {stats:?} is too much");
        }
    }

    fn count_dropped(&mut self) {
        self.figures.dropped += self.log.stats().iter().map(|stats| stats.dropped).sum::<u64>();
    }

    /// A disk that works again, and outputs that take all.
    fn drain(&mut self) {
        self.in_flight = None;
        self.log.failed("the job was given up".to_owned(), self.now);
        self.now += 40_000;
        for _ in 0..100_000 {
            if let Some(job) = self.log.plan(self.now, false) {
                self.finish(&job);
            }
            for at in 0..self.outputs.len() {
                self.read_some(at, 50);
                let last = self.outputs[at].last;
                self.acknowledge_to(at, last);
            }
            self.now += 20;
            self.check();
            if self.log.stats().iter().all(|stats| stats.lag == 0) {
                break;
            }
        }
        for (output, stats) in self.outputs.iter().zip(self.log.stats()) {
            assert_eq!(stats.lag, 0, "seed {}: all is delivered", self.seed);
            let missing = output.owed.difference(&output.delivered).count();
            assert!(u64::try_from(missing).unwrap() <= stats.dropped, "seed {}: {missing} missing", self.seed);
        }
        for _ in 0..3 {
            self.now += 2_000;
            while let Some(job) = self.log.plan(self.now, false) {
                self.finish(&job);
            }
        }
        assert!(self.file.rows.is_empty(), "seed {}: what was delivered is removed", self.seed);
        self.count_dropped();
    }
}

#[test]
fn the_log_agrees_with_a_model() {
    let number = |name: &str, default| std::env::var(name).ok().and_then(|n| n.parse().ok()).unwrap_or(default);
    let first: u64 = number("FATEK_BUFFER_SEED", 1);
    let mut sum = Figures::default();
    for seed in first..first + number("FATEK_BUFFER_SEEDS", 60) {
        let mut world = World::new(seed);
        (0..STEPS).for_each(|_| world.step());
        world.drain();
        let Figures { pushed, delivered, replayed, dropped, loads, commits, failures, losses, crashes } = world.figures;
        sum.pushed += pushed;
        sum.delivered += delivered;
        sum.replayed += replayed;
        sum.dropped += dropped;
        sum.loads += loads;
        sum.commits += commits;
        sum.failures += failures;
        sum.losses += losses;
        sum.crashes += crashes;
    }
    println!("{sum:?}");
    assert!(sum.loads > 0 && sum.dropped > 0 && sum.failures > 0 && sum.losses > 0 && sum.crashes > 0, "{sum:?}");
}
