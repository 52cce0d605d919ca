//! Reading a backup as a [`Transfer`]: its states are the cells of the backup.

use super::block::{Chunk, Chunks, runs};
use super::{Backup, Missing};
use crate::command::{RequestLengths, Value};
use crate::error::Error;
use crate::progress::Phase;
use crate::transfer::{HoldLimit, Position, Reply, Step, Transfer};

/// The most requests whose values are held before a check, so the most that a run that fails can lose.
const MAX_HELD: usize = 32;

/// The reading of a backup, for all its runs.
#[derive(Debug)]
pub(super) struct Taking {
    /// Cells have a value when a check has confirmed it.
    pub(super) backup: Backup,
    chunks: Chunks,
    /// Elements that are read, held ones included.
    done: usize,
    limit: HoldLimit,
    /// Replies that are not confirmed, and the number of requests of this run before them.
    held: Vec<(Chunk, Vec<Value>)>,
    before: usize,
    is_over: bool,
}

impl Taking {
    pub(super) fn new(backup: Backup) -> Self {
        Self {
            backup,
            chunks: Chunks::EMPTY,
            done: 0,
            limit: HoldLimit::new(MAX_HELD),
            held: Vec::new(),
            before: 0,
            is_over: false,
        }
    }

    /// Begins a run: reads the cells that are not read, with requests of these lengths. Values that
    /// are held are dropped.
    pub(super) fn begin(&mut self, lengths: RequestLengths) {
        if !self.held.is_empty() {
            self.limit.lower();
        }
        (self.before, self.is_over) = (0, false);
        self.held.clear();
        self.done = self.confirmed_elements();
        let is_unread = |cell: &Result<Value, Missing>| *cell == Err(Missing::NotRead);
        let blocks = self.backup.blocks.iter().enumerate();
        let unread = blocks.flat_map(|(number, block)| {
            runs(&block.cells, is_unread).into_iter().map(move |run| (number, block.range, run))
        });
        self.chunks = Chunks::new(unread, lengths);
    }

    /// Elements that have a value, or were refused.
    pub(super) fn confirmed_elements(&self) -> usize {
        self.backup.elements().filter(|(_, cell)| *cell != Err(Missing::NotRead)).count()
    }

    /// The number of held replies before a mark.
    fn held_before(&self, mark: usize) -> usize {
        debug_assert!(mark >= self.before, "the replies before {mark} are confirmed");
        mark.saturating_sub(self.before).min(self.held.len())
    }
}

impl Transfer for Taking {
    /// The number of requests of the run before this one.
    type Mark = usize;
    type Failure = Error;

    const KEEPS_PARTIAL: bool = true;

    fn next(&mut self) -> Result<Step, Error> {
        Ok(match self.chunks.next() {
            _ if self.is_over => Step::Done,
            Some(chunk) if !self.limit.is_reached(self.held.len()) => Step::Send(chunk.read(true)),
            Some(_) | None => Step::Confirm,
        })
    }

    fn mark(&self) -> usize {
        self.before.saturating_add(self.held.len())
    }

    fn handle(&mut self, result: Result<Reply, Error>) -> Result<(), Error> {
        match (result, self.chunks.next()) {
            (Ok(Reply::Values(values)), Some(chunk)) => {
                let chunk = chunk.first(values.len());
                self.held.push((chunk, values));
                self.chunks.done_first(chunk.count);
                self.done = self.done.saturating_add(chunk.count);
            }
            (Err(Error::Plc { error, .. }), _) => {
                if let Some(single) = self.chunks.refused() {
                    self.done = self.done.saturating_add(single.count);
                    self.backup.blocks.get_mut(single.block).into_iter().for_each(|block| block.refuse(single, error));
                }
            }
            (Err(error), _) => return Err(error),
            (Ok(reply), _) => debug_assert!(false, "{reply:?} is no reply to a read"),
        }
        Ok(())
    }

    fn confirmed(&mut self, result: Result<(), Error>) -> Result<(), Error> {
        result?;
        self.keep(None);
        self.limit.raise();
        self.is_over = self.chunks.next().is_none();
        Ok(())
    }

    fn rewind(&mut self, mark: usize) {
        let kept = self.held_before(mark);
        let dropped: Vec<Chunk> = self.held.split_off(kept).into_iter().map(|(chunk, _)| chunk).collect();
        let elements: usize = dropped.iter().map(|chunk| chunk.count).sum();
        debug_assert!(self.done >= elements, "held elements count as done");
        self.done = self.done.saturating_sub(elements);
        self.chunks.again(dropped);
    }

    fn keep(&mut self, first_held: Option<usize>) {
        let count = first_held.map_or(self.held.len(), |mark| self.held_before(mark));
        self.before = self.before.saturating_add(count);
        for (chunk, values) in self.held.drain(..count) {
            self.backup.blocks.get_mut(chunk.block).into_iter().for_each(|block| block.fill(chunk, &values));
        }
    }

    fn position(&self) -> Position {
        Position { phase: Phase::Reading, done: self.done, total: self.backup.element_count() }
    }
}

#[cfg(all(test, feature = "sim"))]
mod tests {
    use super::*;
    use crate::random::Random;
    use crate::sim::{Model, Plc};
    use crate::transfer::contract::{self, End};

    #[test]
    fn taking_keeps_the_contract_of_a_transfer() {
        let ranges = ["R0-R2999", "M0-M499", "DR4000-DR4198", "D0-D199:u32"];
        for seed in 0..40 {
            let mut random = Random::new(seed);
            let plc = Plc::with_model(Model::largest());
            let backup = Backup::of(ranges.map(|range| range.parse().unwrap())).unwrap();
            for address in 0..3000_u16 {
                plc.write(crate::Register::r(address), random.next() as u16).unwrap();
            }
            let mut taking = Taking::new(backup);
            let mut done = 0;
            loop {
                taking.begin(RequestLengths::PROTOCOL);
                if let End::Done = contract::run(&mut taking, &plc, &mut random, 10) {
                    break;
                }
                assert!(taking.confirmed_elements() >= done, "seed {seed}: confirmed elements are lost");
                done = taking.confirmed_elements();
            }
            assert!(taking.backup.is_complete(), "seed {seed}");
            for (element, value) in taking.backup.elements() {
                assert_eq!(value, Ok(plc.read(element)), "seed {seed}: {element}");
            }
        }
    }
}
