//! Measurements: run them with `--release`, alone. See [`super`].

use std::time::{Duration, Instant};

use fatek_bridge::batch::Batch;
use fatek_bridge::buffer::{Buffer, BufferSettings};

use super::common::{deliver, number};

const SAMPLES: u32 = 64;
const PLCS: u64 = 200;

/// A batch of 64 samples of about 12 bytes.
fn batch(seq: u64) -> Batch {
    let data = (0..SAMPLES).map(|tag| format!("\"tag{tag}\":{}", seq % 1000)).collect::<Vec<_>>().join(",");
    Batch {
        plc: format!("plc{}", seq % PLCS).as_str().into(),
        revision: 0,
        seq,
        ts: seq,
        samples: SAMPLES,
        data: format!("{{{data}}}").into(),
    }
}

/// The CPU time of this process.
fn cpu() -> Duration {
    let stat = std::fs::read_to_string("/proc/self/stat").unwrap();
    let fields: Vec<&str> = stat.rsplit(')').next().unwrap().split_whitespace().collect();
    let ticks: u64 = fields[11].parse::<u64>().unwrap() + fields[12].parse::<u64>().unwrap();
    Duration::from_millis(ticks * 10)
}

/// The memory of this process in MiB.
fn resident() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap();
    let line = status.lines().find(|line| line.starts_with("VmRSS")).unwrap();
    line.split_whitespace().nth(1).unwrap().parse::<u64>().unwrap() / 1024
}

fn settings(dir: &std::path::Path, sync: bool) -> BufferSettings {
    BufferSettings {
        dir: Some(dir.to_owned()),
        max: 2 << 30,
        max_age: Duration::from_secs(3600),
        memory: 64 << 20,
        sync,
    }
}

#[derive(Clone, Copy, Debug)]
struct Rates {
    per_second: u64,
    per_core: u64,
}

/// The batches, of about 900 bytes, that may wait for the disk: they take a third of what memory has for them.
const MOST_UNWRITTEN: u64 = 12_000;

/// Pushes batches that were made before, at most 2000 ahead of the fast output. `stalled`: another output takes none,
/// so all go to the disk, and are pushed as fast as that takes them.
async fn push_all(buffer: &Buffer, count: u64, stalled: bool) -> Rates {
    let made: Vec<Batch> = (0..1000).map(batch).collect();
    let (start, before) = (Instant::now(), cpu());
    for seq in 0..count {
        let index = usize::try_from(seq % 1000).unwrap();
        buffer.push(Batch { seq, ..made[index].clone() });
        if seq % 100 == 0 {
            let is_far = || stalled && seq.saturating_sub(buffer.figures().spilled_batches) > MOST_UNWRITTEN;
            while buffer.stats()[0].lag > 2000 || is_far() {
                tokio::time::sleep(Duration::from_micros(200)).await;
            }
        }
    }
    while buffer.stats()[0].lag > 0 {
        tokio::time::sleep(Duration::from_micros(200)).await;
    }
    let rate = |time: Duration| {
        u64::try_from(u128::from(count * u64::from(SAMPLES)) * 1_000_000 / time.as_micros().max(1)).unwrap()
    };
    Rates { per_second: rate(start.elapsed()), per_core: rate(cpu() - before) }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "a measurement"]
async fn figures_of_throughput() {
    let count = number("FATEK_BUFFER_BATCHES", 100_000);
    for (name, sync, outputs) in [
        ("all acknowledged at once", false, &["fast"][..]),
        ("a stalled output: all is written", false, &["fast", "slow"]),
        ("sync: all is written first", true, &["fast"]),
    ] {
        let dir = tempfile::tempdir().unwrap();
        let buffer = Buffer::open(&settings(dir.path(), sync), outputs).unwrap();
        let task = tokio::spawn(deliver(buffer.cursor(0), |_| {}));
        let Rates { per_second, per_core } = push_all(&buffer, count, outputs.len() > 1).await;
        let spilled = buffer.figures().spilled_batches;
        println!("{name}: {per_second} samples/s, {per_core} samples/s a core; {spilled} of {count} batches written");
        task.abort();
        buffer.close().await;
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "a measurement"]
async fn figures_of_a_backlog() {
    let mib: u64 = number("FATEK_BUFFER_MIB", 256);
    let dir = tempfile::tempdir().unwrap();
    let buffer = Buffer::open(&settings(dir.path(), false), &["fast", "slow"]).unwrap();
    let task = tokio::spawn(deliver(buffer.cursor(0), |_| {}));
    let count = (mib << 20) / u64::try_from(batch(500).data.len() + 60).unwrap();
    let before = resident();
    let Rates { per_second, .. } = push_all(&buffer, count, true).await;
    let full = resident();
    let figures = buffer.figures();
    println!(
        "{count} batches at {per_second} samples/s: {} MiB on disk, memory {before} to {full} MiB",
        figures.disk_bytes >> 20
    );
    assert!(full < before + 160, "memory is bounded");
    task.abort();
    let closing = Instant::now();
    assert!(buffer.close().await);
    let closed = closing.elapsed();
    let opening = Instant::now();
    let buffer = Buffer::open(&settings(dir.path(), false), &["fast", "slow"]).unwrap();
    println!("closed in {closed:?}, opened and verified in {:?}", opening.elapsed());
    let (start, mut cursor, mut taken, mut most) = (Instant::now(), buffer.cursor(1), 0, 0);
    let mut expected = 0;
    while taken < count {
        for entry in cursor.next(256).await {
            assert_eq!(entry.batch.seq, expected, "in order, without a gap");
            expected += 1;
            taken += 1;
            cursor.acknowledge(entry.position);
        }
        if taken % 16 == 0 {
            most = most.max(resident());
        }
    }
    let time = start.elapsed();
    let rate = taken * u64::from(SAMPLES) * 1000 / u64::try_from(time.as_millis()).unwrap().max(1);
    println!("backlog read back in {time:?}: {rate} samples/s, memory at most {most} MiB");
    assert!(buffer.close().await);
}
