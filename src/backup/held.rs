//! Values that were read and are not confirmed yet: see [`Job`](crate::link::job::Job). No I/O, and no clock.

use super::block::Chunk;
use crate::command::Value;

/// The most requests whose values are held: then a check confirms them. A run that is broken off loses no more than these.
const MOST: usize = 32;

/// Values that were read and are not confirmed yet. The marks of the job count the requests of the run.
#[derive(Debug)]
pub(super) struct Held {
    /// The most requests that are held now.
    most: usize,
    /// The requests before those held.
    first: usize,
    requests: Vec<(Chunk, Vec<Value>)>,
}

impl Default for Held {
    fn default() -> Self {
        Self { most: MOST, first: 0, requests: Vec::new() }
    }
}

impl Held {
    /// A run begins. After one that was broken off with values held, fewer are held at a time: short runs keep something, too.
    pub(super) fn begin(&mut self) {
        let lost = !self.requests.is_empty();
        let most = if lost { self.most.checked_div(4).unwrap_or(1).max(1) } else { self.most };
        *self = Self { most, ..Self::default() };
    }

    /// A check has confirmed all.
    pub(super) fn checked(&mut self) {
        self.most = self.most.saturating_mul(2).min(MOST);
    }

    /// The mark of the next request.
    pub(super) fn mark(&self) -> usize {
        self.first.saturating_add(self.requests.len())
    }

    pub(super) fn is_full(&self) -> bool {
        self.requests.len() >= self.most
    }

    pub(super) fn hold(&mut self, chunk: Chunk, values: Vec<Value>) {
        self.requests.push((chunk, values));
    }

    /// Takes what is confirmed: all before this mark; `None`: all.
    pub(super) fn confirmed(&mut self, first_held: Option<usize>) -> Vec<(Chunk, Vec<Value>)> {
        let count = first_held.map_or(usize::MAX, |mark| mark.saturating_sub(self.first)).min(self.requests.len());
        self.first = self.first.saturating_add(count);
        self.requests.drain(..count).collect()
    }

    /// Drops all from this mark on, and gives what is to be read again.
    pub(super) fn rewind(&mut self, mark: usize) -> Vec<Chunk> {
        let dropped = self.requests.split_off(mark.saturating_sub(self.first).min(self.requests.len()));
        dropped.into_iter().map(|(chunk, _)| chunk).collect()
    }
}
