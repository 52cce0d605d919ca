//! Batches: the samples of one PLC with one time, as the message that the outputs deliver.

use std::sync::Arc;
use std::time::{SystemTime, UNIX_EPOCH};

use bytes::Bytes;
use fatek::poll::{Quality, Sample};
use serde_json::{Map, Value, json};

/// Samples of one PLC with one time.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Batch {
    /// The name of the PLC.
    pub plc: Arc<str>,
    /// Counts the batches of the PLC. It grows by one, and by more only when the bridge has started anew.
    pub seq: u64,
    /// The time of the reply, in milliseconds since 1970, UTC.
    pub ts: u64,
    /// The number of samples.
    pub samples: u32,
    /// The samples as a JSON object, with the names of the tags as keys.
    pub data: Bytes,
}

impl Batch {
    /// The message of an output: `{"seq":…,"ts":…,"d":{…}}`, of a replay with `"hist":true`.
    #[must_use]
    pub fn message(&self, replay: bool) -> Bytes {
        let hist = if replay { r#""hist":true,"# } else { "" };
        let mut message = format!(r#"{{"seq":{},"ts":{},{hist}"d":"#, self.seq, self.ts).into_bytes();
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
const OVERHEAD: usize = 128;

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
    seq: u64,
    open: Option<Open>,
}

#[derive(Debug)]
struct Open {
    ts: u64,
    data: Map<String, Value>,
}

impl Batcher {
    /// `first_seq`: of the first batch. Larger than all of an earlier run of the bridge.
    #[must_use]
    pub fn new(plc: Arc<str>, first_seq: u64) -> Self {
        Self { plc, seq: first_seq, open: None }
    }

    /// Adds a sample, whose tag has this name. Returns the batch that ends before it.
    pub fn push(&mut self, tag: &str, sample: &Sample) -> Option<Batch> {
        let ts = milliseconds(sample.at.time);
        let is_other = |open: &Open| open.ts != ts || open.data.contains_key(tag);
        let ended = if self.open.as_ref().is_some_and(is_other) { self.end() } else { None };
        let open = self.open.get_or_insert_with(|| Open { ts, data: Map::new() });
        open.data.insert(tag.to_owned(), value(sample, ts));
        ended
    }

    /// Ends the batch that is open, if there is one.
    pub fn end(&mut self) -> Option<Batch> {
        let Open { ts, data } = self.open.take()?;
        let seq = self.seq;
        self.seq = self.seq.saturating_add(1);
        let samples = u32::try_from(data.len()).unwrap_or(u32::MAX);
        Some(Batch { plc: self.plc.clone(), seq, ts, samples, data: Value::Object(data).to_string().into() })
    }
}

/// The value of a good sample; the quality and its reason otherwise, and never a value.
fn value(sample: &Sample, ts: u64) -> Value {
    let (quality, reason) = match &sample.quality {
        Quality::Good => return values(sample),
        Quality::Stale(reason) => ("stale", reason.to_string()),
        Quality::Bad(reason) => ("bad", reason.to_string()),
        // A quality of a later version.
        other => ("bad", other.to_string()),
    };
    json!({ "q": quality, "why": reason, "ts": ts })
}

fn values(sample: &Sample) -> Value {
    let value = |value| serde_json::to_value(value).unwrap_or(Value::Null);
    match sample.values() {
        [single] => value(single),
        several => several.iter().map(value).collect(),
    }
}
