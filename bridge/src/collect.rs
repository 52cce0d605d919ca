//! Collects the samples of the poller into batches.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::SystemTime;

use fatek::poll::{Poller, Sample};
use futures::{FutureExt, StreamExt};
use tokio::sync::broadcast;

use crate::batch::{Batch, Batcher, milliseconds};
use crate::buffer::Buffer;
use crate::registry::{Plcs, Registry};

/// Takes the samples of a poller and pushes them as batches.
#[derive(Debug)]
pub struct Collector {
    registry: Registry,
    batchers: HashMap<Arc<str>, Batcher>,
    /// The PLCs whose batches are open.
    open: Vec<Arc<str>>,
    /// The sequence numbers behind those of an earlier run.
    known: HashMap<Arc<str>, u64>,
    /// Larger than the numbers of an earlier run: a run makes less than a million batches a second.
    first_seq: u64,
    buffer: Buffer,
    live: broadcast::Sender<Arc<Batch>>,
}

/// The samples that are taken before the batches are ended, so that none waits for long.
const MAX_SAMPLES: usize = 10_000;

impl Collector {
    /// `live`: takes each batch for the page.
    #[must_use]
    pub fn new(registry: Registry, buffer: Buffer, live: broadcast::Sender<Arc<Batch>>) -> Self {
        let first_seq = milliseconds(SystemTime::now()).saturating_mul(1000);
        Self {
            registry,
            batchers: HashMap::new(),
            open: Vec::new(),
            known: buffer.next_seqs(),
            first_seq,
            buffer,
            live,
        }
    }

    /// Runs until the poller is closed and its samples are taken.
    pub async fn run(mut self, mut poller: Poller) {
        // Kept, so that no memory is allocated for each round.
        let mut samples = Vec::new();
        while let Some(first) = poller.next().await {
            samples.push(first);
            while samples.len() < MAX_SAMPLES
                && let Some(Some(sample)) = poller.next().now_or_never()
            {
                samples.push(sample);
            }
            let now = milliseconds(SystemTime::now());
            let registry = self.registry.clone();
            // Locked until all batches are ended: their places stay as they are.
            let plcs = registry.read();
            for sample in samples.drain(..) {
                match sample {
                    Ok(sample) => self.take(&sample, &plcs, now),
                    Err(missed) => tracing::warn!(%missed, "the bridge is too slow for its tags"),
                }
            }
            while let Some(plc) = self.open.pop() {
                let ended = self.batchers.get_mut(&plc).and_then(Batcher::end);
                ended.into_iter().for_each(|batch| self.push(batch));
            }
        }
    }

    fn take(&mut self, sample: &Sample, plcs: &Plcs, now: u64) {
        // A sample of a tag that was removed since.
        let Some(place) = plcs.place(sample.id) else { return };
        let known = &self.known;
        let batcher = self.batchers.entry(place.plc.clone()).or_insert_with(|| {
            let known = known.get(&place.plc).copied().unwrap_or(0);
            Batcher::new(place.plc.clone(), self.first_seq.max(known))
        });
        if !batcher.is_open() {
            self.open.push(place.plc.clone());
        }
        let ended = batcher.push(place, sample, now);
        ended.into_iter().for_each(|batch| self.push(batch));
    }

    fn push(&mut self, batch: Batch) {
        // Without a page there is no receiver.
        if self.live.receiver_count() > 0 {
            let _ = self.live.send(Arc::new(batch.clone()));
        }
        self.buffer.push(batch);
    }
}
