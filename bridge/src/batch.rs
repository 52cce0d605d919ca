//! Batches: the samples of one PLC with one time, as the message that the outputs deliver.

use std::sync::Arc;
use std::time::{SystemTime, UNIX_EPOCH};

use bytes::Bytes;
use fatek::poll::{Quality, Sample};
use fatek::tag::TagValue;
use serde::Serialize;
use serde_json::json;

use crate::registry::Place;

/// Samples of one PLC with one time.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Batch {
    /// The name of the PLC.
    pub plc: Arc<str>,
    /// In a fleet: the fencing token of the owner that has read them; 0 without a fleet. Another one is a gap.
    pub revision: u64,
    /// Counts the batches of the PLC. It grows by one, and by more only when the bridge has started anew.
    pub seq: u64,
    /// The time of the reply, in milliseconds since 1970, UTC; of stale samples, the time when they became so.
    pub ts: u64,
    /// The number of samples.
    pub samples: u32,
    /// The samples as a JSON object, with the names of the tags as keys.
    pub data: Bytes,
}

impl Batch {
    /// The message of an output: `{"seq":…,"ts":…,"d":{…}}`, of a replay with `"hist":true`, in a fleet with
    /// `"rev":…`.
    #[must_use]
    pub fn message(&self, replay: bool) -> Bytes {
        let hist = if replay { r#""hist":true,"# } else { "" };
        let rev = if self.revision == 0 { String::new() } else { format!(r#""rev":{},"#, self.revision) };
        let mut message = format!(r#"{{"seq":{},{rev}"ts":{},{hist}"d":"#, self.seq, self.ts).into_bytes();
        message.extend_from_slice(&self.data);
        message.push(b'}');
        message.into()
    }

    /// The memory that it takes, in bytes.
    #[must_use]
    pub fn size(&self) -> usize {
        self.data.len().saturating_add(OVERHEAD)
    }
}

/// The memory of a batch besides its data.
const OVERHEAD: usize = 136;
/// Sequence numbers begin with this multiple of the time: a run makes fewer batches.
pub const SEQS_A_MILLISECOND: u64 = 1000;

/// Milliseconds since 1970; 0 before.
#[must_use]
pub fn milliseconds(time: SystemTime) -> u64 {
    time.duration_since(UNIX_EPOCH).map_or(0, |since| u64::try_from(since.as_millis()).unwrap_or(u64::MAX))
}

/// Makes batches of the samples of one PLC. No I/O, and no clock.
///
/// Invariants: a batch has one time, and each tag at most once; samples of a tag keep their order.
#[derive(Debug)]
pub struct Batcher {
    plc: Arc<str>,
    revision: u64,
    seq: u64,
    /// The open batch: its time, its samples, and its data without the brace at the end.
    ts: u64,
    samples: u32,
    data: Vec<u8>,
    /// For each tag, by its index, the number of the batch that has it, plus one.
    in_batch: Vec<u64>,
}

impl Batcher {
    /// `first_seq`: of the first batch. Larger than all of an earlier run of the bridge.
    #[must_use]
    pub fn new(plc: Arc<str>, first_seq: u64) -> Self {
        Self { plc, revision: 0, seq: first_seq, ts: 0, samples: 0, data: Vec::new(), in_batch: Vec::new() }
    }

    /// Returns whether a batch is open.
    #[must_use]
    pub fn is_open(&self) -> bool {
        self.samples > 0
    }

    /// Adds a sample. Returns the batch that ends before it. Places must not change while a batch is open.
    pub fn push(&mut self, place: &Place, sample: &Sample) -> Option<Batch> {
        // Of a stale sample, `at` is the time of the last value.
        let ts = milliseconds(sample.stale_since.unwrap_or(sample.at).time);
        let is_repeated = self.in_batch.get(place.index).is_some_and(|batch| *batch == self.seq.saturating_add(1));
        let is_other = self.ts != ts || is_repeated || self.revision != place.revision;
        let ended = if self.is_open() && is_other { self.end() } else { None };
        if self.revision != place.revision {
            self.revision = place.revision;
            // Behind those of the owners before, as far as the clocks of the members agree.
            self.seq = self.seq.max(ts.saturating_mul(SEQS_A_MILLISECOND));
        }
        self.ts = ts;
        self.samples = self.samples.saturating_add(1);
        if self.in_batch.len() <= place.index {
            self.in_batch.resize(place.index.saturating_add(1), 0);
        }
        if let Some(batch) = self.in_batch.get_mut(place.index) {
            *batch = self.seq.saturating_add(1);
        }
        self.data.push(if self.data.is_empty() { b'{' } else { b',' });
        self.data.push(b'"');
        // A name has no character that JSON escapes.
        self.data.extend_from_slice(place.tag.as_bytes());
        self.data.extend_from_slice(b"\":");
        append_sample(&mut self.data, sample);
        ended
    }

    /// Ends the batch that is open, if there is one.
    pub fn end(&mut self) -> Option<Batch> {
        if !self.is_open() {
            return None;
        }
        let mut data = Vec::with_capacity(self.data.len().saturating_add(1));
        data.append(&mut self.data);
        data.push(b'}');
        let batch = Batch {
            plc: self.plc.clone(),
            revision: self.revision,
            seq: self.seq,
            ts: self.ts,
            samples: self.samples,
            data: data.into(),
        };
        self.seq = self.seq.saturating_add(1);
        self.samples = 0;
        Some(batch)
    }
}

/// Appends the value of a good sample; the quality, its reason and the time of the sample otherwise, and never a
/// value.
fn append_sample(data: &mut Vec<u8>, sample: &Sample) {
    let (quality, reason) = match &sample.quality {
        Quality::Good => return append_values(data, sample.values()),
        Quality::Stale(reason) => ("stale", reason.to_string()),
        Quality::Bad(reason) => ("bad", reason.to_string()),
        // A quality of a later version.
        other => ("bad", other.to_string()),
    };
    append_json(data, &json!({ "q": quality, "why": reason, "ts": milliseconds(sample.at.time) }));
}

fn append_values(data: &mut Vec<u8>, values: &[TagValue]) {
    match values {
        [single] => append_json(data, single),
        several => append_json(data, several),
    }
}

fn append_json<T: Serialize + ?Sized>(data: &mut Vec<u8>, value: &T) {
    let before = data.len();
    if serde_json::to_writer(&mut *data, value).is_err() {
        // A value of a later version without a form in JSON.
        data.truncate(before);
        data.extend_from_slice(b"null");
    }
}

#[cfg(test)]
mod tests;
