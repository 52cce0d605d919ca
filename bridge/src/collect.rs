//! Collects the samples of the poller into batches.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use fatek::poll::{Poller, Sample};
use futures::{FutureExt, StreamExt};
use tokio::time::timeout;

use crate::batch::{Batch, Batcher, SEQS_A_MILLISECOND, milliseconds};
use crate::buffer::Buffer;
use crate::fleet::boot_time;
use crate::liveness::Liveness;
use crate::registry::{Plcs, Registry};

/// Takes the samples of a poller and pushes them as batches.
#[derive(Debug)]
pub struct Collector {
    registry: Registry,
    batchers: Vec<Batcher>,
    /// The batchers of the PLCs, by their places.
    places: HashMap<Arc<str>, usize>,
    /// The PLC of the last sample and the place of its batcher: most samples are of the PLC of the sample before.
    recent: Option<(Arc<str>, usize)>,
    /// The places of the batchers whose batches are open.
    open: Vec<usize>,
    /// The sequence numbers behind those of an earlier run.
    known: HashMap<Arc<str>, u64>,
    /// Larger than the numbers of an earlier run: a run makes less than a million batches a second.
    first_seq: u64,
    buffer: Buffer,
    liveness: Liveness,
    /// Samples of tags that a reload has added to the poller, and not to the registry yet.
    early: Vec<Sample>,
    /// The time of the present round, by [`boot_time`].
    now: u64,
}

/// The samples that are taken before the batches are ended, so that none waits for long.
const MAX_SAMPLES: usize = 10_000;
/// The samples of a reload under way that are kept.
const MAX_EARLY: usize = 1_000_000;
/// The time between two signs of life while there are no samples.
const SIGN_OF_LIFE: Duration = Duration::from_secs(1);

impl Collector {
    /// `liveness`: gets the signs of life.
    #[must_use]
    pub fn new(registry: Registry, buffer: Buffer, liveness: Liveness) -> Self {
        let first_seq = milliseconds(SystemTime::now()).saturating_mul(SEQS_A_MILLISECOND);
        Self {
            registry,
            batchers: Vec::new(),
            places: HashMap::new(),
            recent: None,
            open: Vec::new(),
            known: buffer.next_seqs(),
            first_seq,
            buffer,
            liveness,
            early: Vec::new(),
            now: 0,
        }
    }

    /// Runs until the poller is closed and its samples are taken.
    pub async fn run(mut self, mut poller: Poller) {
        // Kept, so that no memory is allocated for each round.
        let mut samples = Vec::new();
        loop {
            self.liveness.beat();
            match timeout(SIGN_OF_LIFE, poller.next()).await {
                Ok(Some(first)) => samples.push(first),
                Ok(None) => return,
                Err(_) if self.early.is_empty() => continue,
                Err(_) => {}
            }
            while samples.len() < MAX_SAMPLES
                && let Some(Some(sample)) = poller.next().now_or_never()
            {
                samples.push(sample);
            }
            let registry = self.registry.clone();
            // Locked until all batches are ended: their places stay as they are.
            let plcs = registry.read();
            self.now = boot_time();
            self.take_early(&plcs);
            for sample in samples.drain(..) {
                match sample {
                    Ok(sample) => {
                        if let Some(early) = self.take(sample, &plcs) {
                            self.keep(early);
                        }
                    }
                    Err(missed) => tracing::warn!(%missed, "the bridge is too slow for its tags"),
                }
            }
            while let Some(place) = self.open.pop() {
                let ended = self.batchers.get_mut(place).and_then(Batcher::end);
                ended.into_iter().for_each(|batch| self.push(batch));
            }
        }
    }

    /// Takes the samples of an earlier round whose tags the registry has got since, in their order.
    fn take_early(&mut self, plcs: &Plcs) {
        for sample in std::mem::take(&mut self.early) {
            if let Some(early) = self.take(sample, plcs) {
                self.keep(early);
            }
        }
    }

    /// Keeps a sample without a place while a configuration is applied. Otherwise its tag was removed.
    fn keep(&mut self, sample: Sample) {
        if self.registry.is_applying() && self.early.len() < MAX_EARLY {
            self.early.push(sample);
        }
    }

    /// Adds a sample to the batch of its PLC. Returns it if its tag has no place.
    fn take(&mut self, sample: Sample, plcs: &Plcs) -> Option<Sample> {
        let Some(place) = plcs.place(sample.id) else { return Some(sample) };
        if !place.gate.is_open_at(self.now) {
            // The next owner may have delivered newer values: a reply can wait in a socket while a process is stopped.
            return None;
        }
        let number = self.batcher_of(&place.plc);
        let Some(batcher) = self.batchers.get_mut(number) else { return Some(sample) };
        if !batcher.is_open() {
            self.open.push(number);
        }
        let ended = batcher.push(place, &sample);
        ended.into_iter().for_each(|batch| self.push(batch));
        None
    }

    /// The place of the batcher of a PLC, which is made for its first sample.
    fn batcher_of(&mut self, plc: &Arc<str>) -> usize {
        match &self.recent {
            Some((recent, place)) if Arc::ptr_eq(recent, plc) => return *place,
            Some(_) | None => {}
        }
        let place = match self.places.get(plc) {
            Some(place) => *place,
            None => {
                let known = self.known.get(plc).copied().unwrap_or(0);
                self.batchers.push(Batcher::new(plc.clone(), self.first_seq.max(known)));
                let place = self.places.len();
                self.places.insert(plc.clone(), place);
                place
            }
        };
        self.recent = Some((plc.clone(), place));
        place
    }

    fn push(&mut self, batch: Batch) {
        self.buffer.push(batch);
    }
}

#[cfg(test)]
mod tests;
