//! Buffers, batches and outputs for the tests.

use std::path::Path;
use std::str::FromStr;
use std::time::{Duration, Instant};

use fatek_bridge::batch::Batch;
use fatek_bridge::buffer::{Buffer, BufferSettings, Cursor, Entry};

/// The time that no step of a test exceeds on the slowest machine.
pub(crate) const PATIENCE: Duration = Duration::from_secs(60);

pub(crate) fn settings(dir: &Path) -> BufferSettings {
    BufferSettings {
        dir: Some(dir.to_owned()),
        max: 64 << 20,
        max_age: Duration::from_secs(3600),
        memory: 4 << 20,
        sync: false,
    }
}

/// A batch whose content follows from its sequence number, of 40 to 400 bytes.
pub(crate) fn batch(seq: u64) -> Batch {
    let length = usize::try_from(seq % 37).unwrap() * 10;
    let data = format!("{{\"level\":{seq},\"text\":\"{}\"}}", "x".repeat(length));
    Batch { plc: "mixer".into(), revision: 0, seq, ts: 1_700_000_000_000 + seq, samples: 2, data: data.into() }
}

/// A number of the environment.
pub(crate) fn number<T: FromStr>(name: &str, default: T) -> T {
    std::env::var(name).ok().and_then(|text| text.parse().ok()).unwrap_or(default)
}

/// Reads until all that is there was read, and checks order and content. Acknowledges it if asked to.
pub(crate) async fn take_all(buffer: &Buffer, output: usize, acknowledge: bool) -> Vec<Entry> {
    let mut cursor = buffer.cursor(output);
    let mut taken: Vec<Entry> = Vec::new();
    let begin = Instant::now();
    let lag = |buffer: &Buffer| usize::try_from(buffer.stats()[output].lag).unwrap();
    while taken.len() < lag(buffer) {
        let read = tokio::time::timeout(Duration::from_millis(500), cursor.next(512)).await;
        // A damaged batch is not there, and the lag falls.
        taken.extend(read.unwrap_or_default());
        let state = || (taken.len(), buffer.stats(), buffer.figures());
        assert!(begin.elapsed() < PATIENCE, "timeout: {:?}", state());
    }
    check(&taken);
    if let Some(last) = taken.last().filter(|_| acknowledge) {
        cursor.acknowledge(last.position);
    }
    taken
}

/// Each batch is one that was pushed, and they are in order.
pub(crate) fn check(entries: &[Entry]) {
    assert!(entries.is_sorted_by(|a, b| a.position < b.position), "positions grow");
    assert!(entries.is_sorted_by(|a, b| a.batch.seq < b.batch.seq), "sequence numbers grow");
    for entry in entries {
        assert_eq!(*entry.batch, batch(entry.batch.seq), "the content is the one that was pushed");
    }
}

pub(crate) fn seqs(entries: &[Entry]) -> Vec<u64> {
    entries.iter().map(|entry| entry.batch.seq).collect()
}

/// Waits until a condition holds.
pub(crate) async fn wait_until(what: &str, condition: impl Fn() -> bool) {
    let waited = async {
        while !condition() {
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
    };
    tokio::time::timeout(PATIENCE, waited).await.unwrap_or_else(|_| panic!("timeout: {what}"));
}

/// Pushes batches while an output is stalled, not faster than the disk takes them. Returns the last.
pub(crate) async fn push_stalled(
    buffer: &Buffer,
    memory: usize,
    first: u64,
    count: u64,
    mut each: impl FnMut(),
) -> u64 {
    // A commit has an eighth of the memory, and the slots have a half; a batch takes 350 bytes.
    let ahead = u64::try_from(memory / 1500).unwrap();
    let before = buffer.figures().spilled_batches;
    for pushed in 0..count {
        buffer.push(batch(first + pushed));
        if pushed % (ahead / 4) == 0 {
            let is_near = || buffer.figures().spilled_batches - before + ahead >= pushed;
            wait_until("the disk takes batches", is_near).await;
            each();
        }
    }
    wait_until("all is written", || buffer.figures().spilled_batches - before >= count).await;
    first + count - 1
}

/// Reads and acknowledges at once.
pub(crate) async fn deliver(mut cursor: Cursor, mut each: impl FnMut(&Entry)) {
    loop {
        let entries = cursor.next(256).await;
        entries.iter().for_each(&mut each);
        if let Some(last) = entries.last() {
            cursor.acknowledge(last.position);
        }
    }
}
